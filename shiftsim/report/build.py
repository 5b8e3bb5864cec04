"""All tables and pictures of some runs, what they are of, and the folder they are written to."""

import base64
import html
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from string import Template
from typing import Any

from shiftsim.errors import ConfigError, import_extra, one_of, plural
from shiftsim.files import write_text
from shiftsim.report import dataset, details, paper
from shiftsim.report.figures import Figure
from shiftsim.report.groups import Group, planner_identities
from shiftsim.report.paper import Published
from shiftsim.report.scores import planner_notes, scores
from shiftsim.report.tables import ENDINGS, FORMATS, Table, latex_picture, markdown_escape, render
from shiftsim.runs.config import named_checkpoint
from shiftsim.runs.results import Run

_HASH = 12  # characters shown of a hash
_PACKAGES = ("python", "numpy", "numba", "torch")
CITED = "cite.bib"  # the file with the citation
_HERE = Path(__file__).parent

# the kinds of tables, names up to the first "_", and what they show
TABLES = {
    "ranking": "planners by score, without noise and under the hardest, and what that says",
    "semantic-shift": "clean scores by site, beside the published ones",
    "noise-robustness": "scores under every noise",
    "drift": "scores by planner, traffic and what planners see, and what latency they bear",
    "edits": "scores of edited scenarios by kind and difficulty",
    "planner-comparison": "every pair of planners scenario by scenario, clean",
    "planner-comparison-noise": "the same under every noise",
    "scenario-types": "clean scores by scenario type",
    "scores": "every planner, noise and metric",
    "open-loop": "nuPlan's open-loop scores, of runs with --open-loop",
    "navsim": "PDMS and EPDMS of plans and of what was driven, of runs with --metric navsim",
    "planning-time": "how long planners think, steps on a fallback plan",
    "data-statistics": "what the scenarios hold",
    "benchmark-comparison": "the data beside that of other benchmarks",
    "runs": "settings, weights and versions",
}
_ASK_FOR_WEIGHTS = "the run must say --checkpoint PLANNER=shiftsim"
_ABOUT_DATA = ("data-statistics", "benchmark-comparison", "runs")
BRIEF = tuple(name for name in TABLES if name not in _ABOUT_DATA)  # what a terminal shows


@dataclass(frozen=True, slots=True)
class Options:
    """What a report shows."""

    tables: tuple[str, ...] = tuple(TABLES)  # kinds of tables, of `TABLES`
    by: str | None = None  # splits the rows of the score table further
    with_published: bool = False  # show the published figures as well

    def __post_init__(self) -> None:
        for name in self.tables:
            one_of("table", name, TABLES)


def make_tables(
    groups: Sequence[Group], published: Published | None = None, options: Options | None = None
) -> list[Table]:
    """The tables of a report; beside published figures no weights that nobody asked for."""
    chosen = options or Options()
    left_out = [group for group in groups if chosen.with_published and _is_unasked(group)]
    weights = {f"{group.name}, {group.weights}" for group in left_out}
    default_weights = "; ".join(sorted(weights))
    groups = [group for group in groups if group not in left_out]
    if left_out and not groups:
        what = f"nothing to show beside published figures: {default_weights}"
        raise ConfigError(what, hint=_ASK_FOR_WEIGHTS)
    runs = list({group.run.path: group.run for group in groups}.values())
    notes = planner_notes(runs)
    if left_out:
        notes.append(f"left out: {default_weights}; {_ASK_FOR_WEIGHTS}")
    out: list[Table] = []
    for name, make in _makers(groups, published, chosen, runs).items():
        for table in filter(None, make() if name in chosen.tables else ()):
            of_planners = [] if name in _ABOUT_DATA else notes
            more = (n for n in of_planners if not any(n in other for other in table.notes))
            # the name is numbered where tables have it already
            names = (table.name, *(f"{table.name}-{n}" for n in range(2, len(out) + 2)))
            named = next(one for one in names if one not in {made.name for made in out})
            out.append(replace(table, name=named, notes=(*table.notes, *more)))
    return out


def _is_unasked(group: Group) -> bool:
    """Whether a planner drove with weights of our own that nobody asked for by `--checkpoint`."""
    config = group.run.manifest["config"]
    return bool(group.weights) and not named_checkpoint(config, group.name)


def _makers(
    groups: Sequence[Group], published: Published | None, options: Options, runs: Sequence[Run]
) -> dict[str, Callable[[], Sequence[Table | None]]]:
    """What makes the tables of each kind of `TABLES`, in their order."""
    shown = published if options.with_published else None
    statistics = cache(lambda: dataset.own_statistics(groups))
    edited = {group.data.label for group in groups if group.data.edits}
    return {
        "ranking": lambda: [details.ranking(groups)],
        "semantic-shift": lambda: paper.semantic_shift(
            groups, published, with_published=options.with_published
        ),
        "noise-robustness": lambda: [paper.noise_robustness(groups, shown)],
        "drift": lambda: [details.drift_matrix(groups)],
        "edits": lambda: details.edited_scores(groups),
        "planner-comparison": lambda: [details.planner_comparison(groups)],
        "planner-comparison-noise": lambda: [details.planner_comparison(groups, noisy=True)],
        "scenario-types": lambda: details.scenario_types(groups),
        "scores": lambda: [scores(groups, by=options.by)],
        "open-loop": lambda: [details.open_loop_scores(groups)],
        "navsim": lambda: [details.navsim_scores(groups)],
        "planning-time": lambda: [details.planning_times(groups)],
        "data-statistics": lambda: [dataset.data_statistics(statistics())],
        "benchmark-comparison": lambda: (
            [dataset.benchmark_comparison(published, statistics(), edited)] if published else []
        ),
        "runs": lambda: [runs_table(runs)],
    }


class Comparison:
    """Tables of planners compared scenario by scenario, in pairs; printed as text."""

    def __init__(self, tables: Sequence[Table]) -> None:
        self.tables = tuple(tables)

    def table(self, format: str = "text") -> Any:
        """The tables as `text`, `md`, `latex`, `csv` or `html`, or a DataFrame of `pandas`."""
        return in_format(self.tables, format)

    def __str__(self) -> str:
        return str(self.table())

    def __repr__(self) -> str:
        count = sum(len(table.rows) for table in self.tables)
        return f"<Comparison of {plural(count, 'pair')} of planners>"

    def _repr_html_(self) -> str:
        return str(self.table("html"))


def in_format(tables: Sequence[Table], format: str) -> Any:
    """Tables as text in a format, or for `pandas` as one DataFrame with numbers in full."""
    one_of("format", format, (*FORMATS, "pandas"))
    if format != "pandas":
        return "\n\n".join(render(table, format) for table in tables)
    pandas: Any = import_extra("pandas", "plots")
    frames = {}
    for table in tables:
        whole = replace(table.full or table, notes=())
        texts = dict.fromkeys(whole.header[: whole.num_labels], str)
        rules = {"dtype": texts, "keep_default_na": False, "na_values": [""]}
        frames[table.name] = pandas.read_csv(io.StringIO(render(whole, "csv")), **rules)
    out = next(iter(frames.values()))
    if len(frames) > 1:
        out = pandas.concat(frames, names=["table"]).reset_index("table").reset_index(drop=True)
    out.attrs["notes"] = list(dict.fromkeys(note for table in tables for note in table.notes))
    return out


def write_report(
    folder: Path,
    title: str,
    runs: Sequence[Run],
    tables: Sequence[Table],
    drawn: Sequence[Figure],
    styles: Sequence[str],
) -> list[Path]:
    """Write tables and pictures, a file per style, of CSV per table; LaTeX has PDF pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {figure.save(folder): figure.title for figure in drawn}
    cite, subtitle = citation(runs), made_of(runs)
    out, texts = [*pictures], dict[str, str]()
    for style in styles:
        parts = [render(table, style) for table in tables]
        if style == "csv":
            texts |= {f"{t.name}.csv": part for t, part in zip(tables, parts, strict=True)}
            continue
        if style == "html":
            coded = {path: base64.b64encode(path.read_bytes()).decode() for path in pictures}
            images = {f"data:image/png;base64,{coded[p]}": t for p, t in pictures.items()}
            body = report_html(runs, tables, images)
            look = {"title": html.escape(title), "theme": _filled("theme.css")}
            parts = [_filled("page.html", body=body, **look)]
        elif style == "md":
            shown = [f"![{markdown_escape(t)}]({path.name})" for path, t in pictures.items()]
            head = [f"# {markdown_escape(title)}", markdown_escape(subtitle)]
            parts = [*head, *parts, *shown, f"```bibtex\n{cite}\n```"]
        elif style == "latex":
            files = {figure.save(folder, "pdf"): figure for figure in drawn}
            out += files
            texts[CITED] = cite
            shown = [
                latex_picture(path.name, one.caption, is_wide=one.is_wide)
                for path, one in files.items()
            ]
            parts = [f"% {title}\n% {subtitle}\n% cite from {CITED}", *parts, *shown]
        else:
            parts = [f"{title}\n{subtitle}", *parts, cite]
        texts[f"report.{ENDINGS[style]}"] = "\n\n".join(parts)
    for name, text in texts.items():
        path = folder / name.replace("/", "-")
        write_text(path, f"{text}\n")
        out.append(path)
    return out


def report_html(
    runs: Sequence[Run], tables: Sequence[Table], images: Mapping[str, str], *more: str
) -> str:
    """Sections for any page: ranking and first picture, contents (with `more` ids), the others."""
    sections = {table.name: (table.title, render(table, "html")) for table in tables}
    for number, (address, title) in enumerate(images.items()):
        words, name = html.escape(title), f"figure-{number + 1}"
        part = f'<h2>{words}</h2>\n<img alt="{words}" src="{address}">'
        sections[name] = (title, f'<section id="{name}">{part}</section>')
    cite = f"<h2>Cite (a click selects all)</h2>\n<pre>{html.escape(citation(runs))}</pre>"
    sections["cite"] = ("Cite", f'<section id="cite">{cite}</section>')
    named = [(name, title.partition(":")[0]) for name, (title, _) in sections.items()]
    named += [(name, name.capitalize()) for name in more]
    links = (f'<li><a href="#{html.escape(n)}">{html.escape(words)}</a></li>' for n, words in named)
    above = [sections.pop(name)[1] for name in ("ranking", "figure-1") if name in sections]
    parts = [
        f"<style>\n{_filled('tables.css')}\n</style>",
        f'<div class="report"><p>{html.escape(made_of(runs))}</p>',
        *([f'<div class="overview">{"".join(above)}</div>'] if above else []),
        f'<nav aria-label="Contents"><h2>Contents</h2><ul>{"".join(links)}</ul></nav>',
        *(part for _, part in sections.values()),
    ]
    return "\n".join([*parts, "</div>"])


def _filled(name: str, **parts: str) -> str:
    """A file of this folder with its `$names` filled in."""
    return Template((_HERE / name).read_text("utf-8").rstrip()).substitute(parts)


def citation(runs: Sequence[Run]) -> str:
    """BibTeX entries: shiftsim in the version of the runs, the benchmark's paper, nuPlan."""
    years = [_date(run)[:4] for run in runs]
    versions = dict.fromkeys(map(_version, runs))
    return _filled(CITED, year=max(years), version=", ".join(filter(None, versions)))


def made_of(runs: Sequence[Run]) -> str:
    """Runs, when they ended, and by which version of shiftsim, in one line."""
    dates = sorted(filter(None, map(_date, runs)))
    span = " to ".join(dict.fromkeys((*dates[:1], *dates[-1:])))
    versions = ", ".join(dict.fromkeys(filter(None, map(_version, runs))))
    names = ", ".join(run.path.name for run in runs)
    return " · ".join(filter(None, (f"runs: {names}", span, versions and f"shiftsim {versions}")))


def runs_table(runs: Sequence[Run]) -> Table:
    """A column per run: date, data with its hash, settings, weights, versions."""
    header, facts = ("run", *(run.path.name for run in runs)), [*map(_facts, runs)]
    rows = [(name, *(fact[name] for fact in facts)) for name in facts[0]]
    return Table("runs", "The runs", header, [row for row in rows if any(row[1:])], len(header))


def _facts(run: Run) -> dict[str, str]:
    """What a run was made of and with; empty where it is not known."""
    manifest, config, rules = run.manifest, run.manifest["config"], run.manifest["determining"]
    store = str(manifest["store"]).replace("\\", "/").rstrip("/").rpartition("/")[2]
    identities = planner_identities(run).items()
    weights = {
        name: one.get("weights") or _short(one.get("checkpoint", "")) or _files(one)
        for name, one in identities
    }
    return {
        "date": _date(run),
        "rollouts finished": "{ok} of {expected}".format(**manifest["counts"]),
        "scenarios": f"split {manifest['split']}",
        "store": f"{store}, {_short(rules['store'])}",
        "traffic": rules["traffic"],
        "controller": rules["controller"],
        "thresholds": rules["thresholds"]["name"],
        "metrics": f"v{rules['metric_version']}",
        "planners": ", ".join(config["planners"]),
        "weights": "; ".join(f"{name}: {words}" for name, words in weights.items() if words),
        "noise": ", ".join(config["noise"]),
        "seeds": ", ".join(map(str, config["seeds"])),
        "shiftsim": _version(run),
        **{name: str(manifest.get("versions", {}).get(name, "")) for name in _PACKAGES},
    }


def _files(identity: Mapping[str, Any]) -> str:
    """The files that a planner is made of, with the beginnings of their hashes."""
    given = identity["arguments"] | {"policy": str(identity["planner"]).partition(":")[2]}
    files = identity.get("files", {}).items()
    return ", ".join(f"{Path(given.get(name, name)).name} {_short(one)}" for name, one in files)


def _date(run: Run) -> str:
    """When a run ended, to the minute, in UTC."""
    ended = str(run.manifest.get("ended") or run.manifest.get("started", ""))
    return f"{ended[:16].replace('T', ' ')} UTC" if ended else ""


def _version(run: Run) -> str:
    version, commit = run.manifest.get("versions", {}).get("shiftsim", ""), run.manifest.get("git")
    return f"{version} ({commit})" if commit else str(version)


def _short(text: str) -> str:
    """The beginning of a hash; other text as it is."""
    return text if ":" in text else text[:_HASH]
