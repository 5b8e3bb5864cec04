"""Replays of runs: which rollouts belong on one page, and a folder of pages with a list of them."""

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shiftsim.errors import ConfigError, DataError, beginning
from shiftsim.files import safe_join, write_text
from shiftsim.metrics import SHORT_NAMES
from shiftsim.report.words import REASONS, rows_by_task, violations, worst_violation
from shiftsim.runs.results import Run
from shiftsim.runs.rollouts import Task
from shiftsim.view.page import MAX_ROLLOUTS, POLICY, Page, data_element, framed, replay_page
from shiftsim.view.scene import ShownRollout

_WRONG = {SHORT_NAMES[name]: reason for name, reason in REASONS.items()}  # in words, in their order


@dataclass(frozen=True)
class Choice:
    """Which rollouts to show."""

    planners: tuple[str, ...] = ()  # only these; empty for all
    noises: tuple[str, ...] = ()  # only these; empty for all
    seeds: tuple[int, ...] = ()  # only these; empty for the first one of each planner and noise

    def __str__(self) -> str:
        parts = zip(("planner", "noise", "seed"), vars(self).values(), strict=True)
        return ", ".join(f"{n} {' or '.join(map(str, v))}" for n, v in parts if v) or "any planner"

    def of(self, tasks: Sequence[Task]) -> list[Task]:
        """The tasks chosen among those of one scenario, by planner, noise and seed."""
        wanted = [
            task
            for task in sorted(tasks)
            # a planner's name may end in the remark that tells runs apart
            if (not self.planners or task.planner.partition(" (")[0] in self.planners)
            and (not self.noises or task.noise in self.noises)
            and (not self.seeds or task.seed in self.seeds or task.noise == "none")
        ]
        if self.seeds:
            return wanted
        first = {(task.planner, task.noise): task for task in reversed(wanted)}
        return [task for task in wanted if first[task.planner, task.noise] == task]


class Gallery:
    """The stored rollouts of one or several runs on the same store, scenario by scenario."""

    def __init__(self, runs: Sequence[Run], store: Any, choice: Choice | None = None) -> None:
        """Index the runs, which were made with this open store.

        Raises:
            DataError: A run was made with another store.
        """
        self.store = store
        self.choice = choice or Choice()
        self._runs: dict[Task, tuple[Run, Task]] = {}
        for run, name in zip(runs, _names(runs), strict=True):
            if run.manifest["determining"]["store"] != store.hash:
                raise DataError(
                    f"run {run.path.name!r} was made with another store than {str(store.path)!r}",
                    hint="name the store that its manifest.json names",
                )
            for task, place in run.rollout_places.items():
                if place is not None:
                    planner = f"{task.planner} ({name})" if name else task.planner
                    self._runs[task._replace(planner=planner)] = (run, task)
        self._scores = {run.path: rows_by_task(run.scores) for run in runs}
        self._metrics = {run.path: rows_by_task(run.metrics) for run in runs}
        self._tokens: dict[str, list[Task]] = {}
        for task in self._runs:
            self._tokens.setdefault(task.token, []).append(task)

    @property
    def tokens(self) -> list[str]:
        """Scenarios with rollouts to show, the lowest score first."""
        lowest = {
            token: min(float(self._results(task)[0].get("cls", 1.0)) for task in chosen)
            for token, tasks in self._tokens.items()
            if (chosen := self.choice.of(tasks))
        }
        return sorted(lowest, key=lambda token: (lowest[token], token))

    def _results(self, task: Task) -> tuple[Mapping[str, Any], list[dict[str, Any]]]:
        """The rows of a rollout in `scores.parquet` and `metrics.parquet`; empty where none."""
        run, key = self._runs[task]
        (score,) = self._scores[run.path].get(key, [{}])
        return score, self._metrics[run.path].get(key, [])

    def find(self, text: str) -> str:
        """A scenario by its token or an unambiguous beginning of it.

        Raises:
            ConfigError: There is none, or there are several.
        """
        return beginning("what is stored", "scenario", text, self._tokens)

    def tasks(self, token: str) -> list[Task]:
        """The rollouts that the page of a scenario shows.

        Raises:
            ConfigError: There are none.
        """
        found = self.choice.of(self._tokens.get(token, []))
        if not found:
            there = zip(*self._tokens.get(token, []), strict=True)
            names = zip(("planners", "noise", "seeds"), there, strict=False)
            available = (f"{n}: {', '.join(map(str, dict.fromkeys(v)))}" for n, v in names)
            raise ConfigError(
                f"scenario {token!r} has no stored rollout with {self.choice}",
                hint="; ".join(available) or "--save-rollouts all keeps them",
            )
        return found[:MAX_ROLLOUTS]

    def shown(self, token: str, scenario: Any) -> list[ShownRollout]:
        """The rollouts of a page with what is known of them."""
        out = []
        for task in self.tasks(token):
            run, key = self._runs[task]
            score, metrics = self._results(task)
            log = run.rollout(key, scenario)
            out.append(
                ShownRollout(task.planner, task.noise, task.seed, log, score.get("cls"), metrics)
            )
        return out

    def page(self, token: str, *, back: str = "") -> Page:
        """The replay of one scenario as HTML."""
        scenario = self.store.read(token)
        return replay_page(scenario, self.shown(token, scenario), back=back)

    def rows(self, token: str) -> list[dict[str, Any]]:
        """Rows of the scenario list: labels, scores and violated metrics of every rollout."""
        return [self._row(task, index) for index, task in enumerate(self.tasks(token))]

    def _row(self, task: Task, index: int) -> dict[str, Any]:
        score, metrics = self._results(task)
        found = violations(metrics)
        worst = worst_violation(found)
        return {
            "token": task.token,
            "type": score.get("scenario_type", ""),
            "city": score.get("city", ""),
            "planner": task.planner,
            "noise": task.noise,
            "seed": task.seed,
            "cls": score.get("cls"),
            "violated": {one.short: one.time for one in found},
            "at": worst and worst.time,
            "index": index,
            "page": f"replay/{page_name(task.token)}",
        }


def page_name(token: str) -> str:
    """File name of a scenario's page: its token, other characters than letters and digits coded."""
    safe = "".join(
        c if c.isascii() and (c.isalnum() or c in "-_") else f"~{ord(c):x}" for c in token
    )
    return f"{safe}.html"


def list_page(title: str, rows: Sequence[Mapping[str, Any]], *, above: str = "") -> str:
    """The page that lists rows of `Gallery.rows`, sortable and filterable.

    `above` is HTML between heading and list; the caller escapes what comes from data.
    """
    return framed(
        "list.html",
        title=title,
        meta=POLICY.format(images="'self' data:"),
        styles=["list.css"],
        scripts=["list.js"],
        above=above,
        data=data_element("rows", list(rows)) + data_element("metrics", _WRONG),
    )


def write_site(
    folder: Path,
    galleries: Sequence[Gallery],
    *,
    title: str,
    limit: int = 0,
    above: str = "",
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write one page per scenario and `index.html`, which lists them; returns how many pages.

    The list goes to the folder, at most `limit` pages (0 for all), the lowest scores first, to its
    subfolder `replay`. `above` is as in `list_page`; `on_progress` gets how many of how many pages.
    """
    pages = safe_join(folder, "replay")
    pages.mkdir(parents=True, exist_ok=True)
    found = [(gallery, token) for gallery in galleries for token in gallery.tokens]
    found = found[:limit] if limit else found
    rows: list[dict[str, Any]] = []
    for done, (gallery, token) in enumerate(found):
        gallery.page(token, back="../index.html").save(pages / page_name(token))
        rows += gallery.rows(token)
        on_progress(done + 1, len(found))
    page = list_page(title, rows, above="\n".join([above, worst_table(rows)]))
    write_text(folder / "index.html", page)
    return len(found)


def worst_table(rows: Sequence[Mapping[str, Any]], count: int = 10) -> str:
    """HTML: the scenarios with the lowest scores, each by its worst rollout, and what went wrong.

    In words, with links to that moment.
    """

    def key(row: Mapping[str, Any]) -> tuple[Any, ...]:
        names = (row["noise"] != "none", row["planner"], row["noise"], row["seed"])
        return (row["cls"] or 0.0, row["token"], *names)

    by_page: dict[str, Mapping[str, Any]] = {}
    for row in sorted((row for row in rows if (row["cls"] or 0.0) < 1.0), key=key):
        by_page.setdefault(row["page"], row)
    if not by_page:
        return ""
    lines = []
    for row in list(by_page.values())[:count]:
        at = "" if row["at"] is None else f"t={row['at']:.2f}&amp;"
        link = (
            f'<a href="{row["page"]}#{at}focus={row["index"] + 1}">{html.escape(row["token"])}</a>'
        )
        score = "–" if row["cls"] is None else f"{100.0 * row['cls']:.2f}"
        noise = row["noise"] if row["noise"] == "none" else f"{row['noise']}, seed {row['seed']}"
        times = [
            (_WRONG[short], row["violated"][short]) for short in _WRONG if short in row["violated"]
        ]
        wrong = ", ".join(w if time is None else f"{w} {time:.1f}\u00a0s" for w, time in times)
        texts = map(html.escape, (row["type"], row["planner"], noise))
        inner = "".join(f"<td>{cell}</td>" for cell in (link, *texts, wrong))
        lines.append(f'<tr><td class="number">{score}</td>{inner}</tr>')
    names = ("scenario", "type", "planner", "noise", "what went wrong, first time")
    heads = "".join(f"<th>{name}</th>" for name in names)
    title = f"The worst {len(lines)} of {len({row['page'] for row in rows})} scenarios"
    return f"""<section id="worst"><h2>{title}</h2>
<div class="wide" tabindex="0" role="region" aria-label="{title}"><table>
<thead><tr><th class="number" title="closed-loop score (CLS)">score</th>{heads}</tr></thead>
<tbody>{"".join(lines)}</tbody></table></div></section>"""


def galleries(runs: Sequence[Run], stores: Sequence[Any], choice: Choice) -> list[Gallery]:
    """One gallery per store; `stores` are the open ones of each run."""
    by_store: dict[str, tuple[Any, list[Run]]] = {}
    for run, store in zip(runs, stores, strict=True):
        by_store.setdefault(store.hash, (store, []))[1].append(run)
    return [Gallery(members, store, choice) for store, members in by_store.values()]


def _names(runs: Sequence[Run]) -> list[str]:
    """What tells the rollouts of each run from those of the others: traffic, or the run's name."""
    if len(runs) == 1:
        return [""]
    traffic = [str(run.manifest["determining"]["traffic"]) for run in runs]
    return traffic if len(set(traffic)) == len(runs) else [run.path.name for run in runs]
