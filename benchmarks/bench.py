"""A track as one command: its runs, one after the other, and one report about all of them.

The folder holds a run per set of scenarios and traffic mode, `bench.json`, which says what belongs
to it, and `report/`.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from shiftsim.benchmarks import INTERPLAN_THRESHOLDS, Drawn, Track, known_sets, load_track
from shiftsim.benchmarks import published as published_figures
from shiftsim.benchmarks.inventory import coverage
from shiftsim.data import open_store
from shiftsim.data.synthetic.store import write_towns
from shiftsim.edits.sampling import sample_edits
from shiftsim.errors import ConfigError, DataError, one_of
from shiftsim.files import DEFAULT_STORE, store_path, write_text
from shiftsim.report import build
from shiftsim.report.figures import figures
from shiftsim.report.groups import Group, KnownSet, read_groups, token_digest
from shiftsim.report.palette import DEFAULT_FORM, FigureFormat
from shiftsim.report.tables import FORMATS, Table
from shiftsim.runs.avoidable import grade
from shiftsim.runs.config import DRIFT, make_config
from shiftsim.runs.edited import EditSet, edits_text, make_edits
from shiftsim.runs.execute import Progress, execute
from shiftsim.runs.filter import filter_store
from shiftsim.runs.prepare import RUNS, RunPlan, prepare
from shiftsim.runs.results import Run, label_runs, open_run
from shiftsim.runs.scenarios import default_split, open_edits, open_run_store
from shiftsim.runs.tables import stored_results
from shiftsim.runs.workers import map_unordered
from shiftsim.sim.traffic import traffic_name
from shiftsim.view.build import Choice, galleries, write_site

MANIFEST = "bench.json"
EDITS = "edits.toml"  # what was edited, in the folder of the benchmark
OWN, EDITED = "own", "edited"  # beginnings of names of runs
_FORMAT = 1


@dataclass(frozen=True)
class Plan:
    """A benchmark that has been checked and can start."""

    track: Track  # the track
    folder: Path  # where everything goes
    runs: Mapping[str, RunPlan]  # the runs, by the name of their folder
    own: tuple[KnownSet, ...]  # one's own lists of scenarios as a whole: recorded, then edited
    edits: str = ""  # what was drawn for it, as a file

    @property
    def num_tasks(self) -> int:
        """Rollouts of all runs."""
        return sum(len(run.tasks) for run in self.runs.values())


def plan_bench(
    track: Track, settings: Mapping[str, Any], *, reference: str = "", out: str = ""
) -> Plan:
    """Check all runs of a track, whose settings others replace; `reference` is STORE[:SPLIT]."""
    values = dict(settings)
    resumes = values.pop("resume", False)
    given = values.pop("traffic", None) or list(track.traffic)
    modes = [given] if isinstance(given, str) else [*given]
    edits_of = str(values.pop("edits", ""))
    values = {
        # where others are given there is no noise but what is given
        "noise": ["none"] if {*DRIFT} & {*values} else list(track.noise),
        "seeds": list(track.seeds),
        "store": DEFAULT_STORE,
    } | values
    if track.towns:
        if settings.get("store") or settings.get("split"):
            raise ConfigError(
                f"the track {track.name} drives in towns of its own",
                hint="leave --store and --split out, or choose the track state-drift",
            )
        return _plan_towns(track, values, modes, out)
    if not values.get("split"):  # the same for recorded and for edited scenarios
        opened = open_store(str(values["store"]))
        edits = open_edits(edits_of, opened) if edits_of and track.drawn else None
        values["split"] = default_split(opened, edits) or opened.path.name
    sets = {OWN: {"thresholds": track.own_thresholds} | values}
    if reference and track.reference is None:
        raise ConfigError(f"the track {track.name} has no published list", hint="leave --val14 out")
    if reference and track.reference is not None:
        store, _, split = reference.partition(":")
        rules = {"store": store, "split": split, "thresholds": track.reference.thresholds}
        sets[track.reference.name] = values | rules
    folder = Path(out) if out else RUNS / _name(track, sets, edits_of)
    if resumes and not (folder / MANIFEST).is_file():
        what = f"there is no benchmark to go on with at {str(folder)!r}"
        raise ConfigError(what, hint="name its folder with --out, or begin without --resume")
    _check_folder(folder, track)
    if edits_of and track.drawn is None:
        what = f"the track {track.name} drives recorded scenarios"
        raise ConfigError(what, hint="`shiftsim bench edits --edits FILE` drives edited ones")
    runs = _prepared(track, sets, modes, folder)
    unlimited = _without_limit(next(iter(runs.values())))
    if track.drawn is None:
        return Plan(track, folder, runs, (_list_of(unlimited),))
    edits, text = _edits(track.drawn, unlimited, edits_of, folder)
    rules = {"thresholds": INTERPLAN_THRESHOLDS} if edits.profile == "interplan" else {}
    changed = {EDITED: sets[OWN] | {"edits": edits_of or str(folder / EDITS)} | rules}
    # where no mode can drive them, the reason is said when the first one is checked
    drivable = [mode for mode in modes if _drives(edits, mode)] or modes[:1]
    edited = _prepared(track, changed, drivable, folder, edits)
    lists = (_list_of(unlimited), _list_of(_without_limit(next(iter(edited.values())))))
    return Plan(track, folder, runs | edited, lists, text)


def _plan_towns(track: Track, values: Mapping[str, Any], modes: Sequence[str], out: str) -> Plan:
    """The plan of a track in generated towns, which are made here where they are not there."""
    workers = int(values.get("workers") or 0)
    spread = partial(map_unordered, workers=workers, alone=1)
    sets = {}
    for asked in track.towns:
        place = store_path(f"{track.name}-{asked.domain}")
        store = write_towns(place, **asdict(asked), spread=spread)
        filter_store(store.path, workers=workers)
        rules = {"thresholds": track.own_thresholds, "split": store.path.name}
        sets[asked.domain] = {**rules, **values, "store": str(store.path)}
    folder = Path(out) if out else RUNS / _name(track, sets, "")
    _check_folder(folder, track)
    runs = _prepared(track, sets, modes, folder)
    whole = [_without_limit(run) for name, run in runs.items() if name.endswith(f"-{modes[0]}")]
    return Plan(track, folder, runs, tuple(map(_list_of, whole)))


def _prepared(
    track: Track,
    sets: Mapping[str, Mapping[str, Any]],
    modes: Sequence[str],
    folder: Path,
    edits: EditSet | None = None,
) -> dict[str, RunPlan]:
    """The runs of some sets of scenarios, by the name of their folder."""
    runs = {}
    for name, traffic in product(sets, modes):
        out = folder / f"{name}-{traffic}"  # the run goes on with what its folder holds
        given = {"traffic": traffic, "out": str(out), "resume": out.exists()}
        config = make_config({**sets[name], **given}, where=f"bench {track.name}")
        runs[out.name] = prepare(config, edits=edits)
    return runs


def _edits(drawn: Drawn, own: RunPlan, given: str, folder: Path) -> tuple[EditSet, str]:
    """The edits that are given, the folder's, or those drawn, and these as the text of a file."""
    store = open_store(own.store)
    if given or (folder / EDITS).is_file():
        return open_edits(given or str(folder / EDITS), store), ""
    read = lru_cache(maxsize=256)(store.read)
    found = [
        sample_edits(kind, drawn.count, drawn.seed, own.selection.tokens, read, grade, even=True)
        for kind in drawn.kinds
    ]
    # all kinds in turn, so that a part of the list has all of them
    table = {"format": 1, "edit": [edit for edits in zip(*found, strict=True) for edit in edits]}
    return make_edits(table, Path(EDITS).stem), edits_text(table)


def _drives(edits: EditSet, traffic: str) -> bool:
    """Whether a traffic mode can drive edits."""
    try:
        edits.require_traffic(traffic_name(traffic))
    except ConfigError:
        return False
    return True


def _name(track: Track, sets: Mapping[str, Mapping[str, Any]], edits: str) -> str:
    text = json.dumps([track.name, sets, *([edits] if edits else [])], sort_keys=True, default=str)
    digest = hashlib.blake2b(text.encode(), digest_size=2).hexdigest()
    own = next(iter(sets.values()))
    split = Path(str(own.get("split") or own.get("store") or DEFAULT_STORE)).stem
    return f"{track.name}_{split}_{digest}"


def _check_folder(folder: Path, track: Track) -> None:
    if not folder.exists() or not any(folder.iterdir()):
        return
    found = _read_manifest(folder)
    if found is None or found["track"] != track.name:
        what = f"{str(folder)!r} holds something else than a {track.name} benchmark"
        raise ConfigError(what, hint="choose another --out")


def _without_limit(run: RunPlan) -> RunPlan:
    """The run on the whole list, where it is limited to its first scenarios."""
    if not run.config.limit:
        return run
    config = replace(run.config, limit=0, out=str(run.folder / "whole"), resume=False)
    planners = [run.planners[name].source for name in config.planners]
    return prepare(config, planners=planners, edits=run.selection.edits)


def _list_of(run: RunPlan) -> KnownSet:
    """The scenarios of a run as a list."""
    tokens = {task.token for task in (*run.tasks, *run.missing)}
    split, rules = run.selection.split, run.config.thresholds
    return KnownSet(split, split, rules, len(tokens), token_digest(tokens))


def run_bench(
    plan: Plan,
    *,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    argv: Sequence[str] = (),
) -> list[Run]:
    """Do all runs but those that are complete; `on_progress` gets counts over all of them."""
    plan.folder.mkdir(parents=True, exist_ok=True)
    columns = ("name", "count", "sha256")
    own, *edited = ({name: getattr(one, name) for name in columns} for one in plan.own)
    manifest = {
        "format": _FORMAT,
        "track": plan.track.name,
        "runs": list(plan.runs),
        "own": own,
        "edited": edited,
        "argv": list(argv),
    }
    if plan.edits:
        write_text(plan.folder / EDITS, plan.edits)
    text = json.dumps(manifest, indent=1, ensure_ascii=False)
    write_text(plan.folder / MANIFEST, f"{text}\n")
    before = now = Progress(0, plan.num_tasks, 0)

    def show(progress: Progress) -> None:  # that of one run is added to that of those before it
        nonlocal now
        now = before + replace(progress, total=0)
        on_progress(now)

    out = []
    for run in plan.runs.values():
        if run.before == "complete":
            out.append(open_run(run.folder))
            show(Progress(len(run.tasks), 0, 0, news=stored_results(run.folder)))
        else:
            out.append(execute(run, on_progress=show, argv=argv))
        before = now
    return out


class OpenedRuns(NamedTuple):
    """The runs of folders."""

    runs: list[Run]
    own: list[KnownSet]  # lists of scenarios that benchmarks name
    tracks: list[Track]  # of the benchmarks

    def groups(self, *, allow_partial: bool = False) -> list[Group]:
        """The scores by planner and noise."""
        known = (*known_sets(), *self.own)
        return read_groups(self.runs, known, allow_partial=allow_partial)

    def tables(
        self, options: build.Options, *, with_coverage: bool = False, allow_partial: bool = False
    ) -> list[Table]:
        """The tables that are asked for, also those that only a benchmark has if wanted."""
        groups, tracks = self.groups(allow_partial=allow_partial), dict.fromkeys(self.tracks)
        own = [coverage(track, groups) for track in tracks if with_coverage]
        return [*own, *build.make_tables(groups, published_figures(), options)]

    def report(
        self,
        folder: Path,
        options: build.Options,
        formats: Sequence[str] = (),
        *,
        pictures: bool = True,
        pages: bool = False,
        allow_partial: bool = False,
        title: str = "",
        form: FigureFormat = DEFAULT_FORM,
        on_progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> list[Path]:
        """Write tables and pictures, a file per format or HTML `pages` with replays; the files."""
        for name in formats:
            one_of("format", name, FORMATS)
        is_whole = options.tables == tuple(build.TABLES)
        tables = self.tables(options, with_coverage=is_whole, allow_partial=allow_partial)
        groups = self.groups(allow_partial=allow_partial)
        drawn = figures(groups, form=form) if pictures or pages else []
        title = title or f"Report on {', '.join(run.path.name for run in self.runs)}"
        if not pages:
            return build.write_report(folder, title, self.runs, tables, drawn, formats or FORMATS)
        folder.mkdir(parents=True, exist_ok=True)
        images = {figure.save(folder).name: figure.title for figure in drawn}
        shown = galleries(self.runs, [_store_of(run) for run in self.runs], Choice())
        above = build.report_html(self.runs, tables, images, "scenarios")
        write_site(folder, shown, title=title, above=above, on_progress=on_progress)
        return [folder / "index.html"]


def _store_of(run: Run) -> Any:
    """The store of a run; None where it is away and there is nothing to draw."""
    try:
        return open_run_store(run)
    except DataError:
        if any(run.rollout_places.values()):
            raise
        return None


def open_runs(folders: Iterable[Path], labels: Iterable[str] = ()) -> OpenedRuns:
    """The runs of folders, a benchmark's being all of its runs, by `labels` as in `label_runs`."""
    out = OpenedRuns([], [], [])
    for folder in folders:
        found = _read_manifest(folder)
        if found is None:
            out.runs.append(open_run(folder))
            continue
        out.runs.extend(open_run(folder / name) for name in found["runs"])
        for one in (found["own"], *found.get("edited", ())):
            out.own.append(KnownSet(label=one["name"], thresholds="", **one))
        out.tracks.append(load_track(found["track"]))
    return out._replace(runs=label_runs(out.runs, labels))


def paired_runs(first: Path, second: Path, labels: Iterable[str] = ()) -> list[tuple[Run, Run]]:
    """Two run folders, or runs of one name of two benchmarks, by `labels` as in `label_runs`."""
    ours, theirs = (open_runs([folder]).runs for folder in (first, second))
    runs = label_runs([*ours, *theirs], labels)
    ours, theirs = runs[: len(ours)], runs[len(ours) :]
    if len(ours) == len(theirs) == 1:
        return [(ours[0], theirs[0])]
    named = {run.path.name: run for run in theirs}
    pairs = [(run, named[run.path.name]) for run in ours if run.path.name in named]
    if not pairs:
        raise ConfigError(
            f"{str(first)!r} and {str(second)!r} have no run of the same name",
            hint=f"there are {', '.join(run.path.name for run in ours)}; {', '.join(named)}",
        )
    return pairs


def _read_manifest(folder: Path) -> dict[str, Any] | None:
    """What `bench.json` says, None where there is none; a DataError if it is damaged."""
    path = folder / MANIFEST
    if not path.is_file():
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text("utf-8"))
        version, _, _ = found["format"], found["runs"], found["own"]["sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        what = f"{str(path)!r} is damaged: {error}"
        raise DataError(what, hint="run the benchmark again") from error
    if version != _FORMAT:
        what = f"{str(path)!r} has format {version!r}, this version reads {_FORMAT}"
        raise DataError(what, hint="run the benchmark again with this version of shiftsim")
    return found
