"""nuPlan logs and maps -> a scenario store."""

import logging
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from shiftsim.data.nuplan import scenarios
from shiftsim.data.nuplan.filter import (
    KEY_OF,
    LISTED,
    THINNED,
    ScenarioFilter,
    is_taken,
    judgements,
    read_filter,
    thin_out,
)
from shiftsim.data.nuplan.log import Log, open_log
from shiftsim.data.recording import Window
from shiftsim.data.store.tables import MANIFEST, SCENARIOS
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import ConversionError, DataError, listed
from shiftsim.world.map import VectorMap
from shiftsim.world.ranges import STORE

_LOG = logging.getLogger(__name__)
_MAX_ROWS = 1800  # of one stored part of a log, 90 s: dense tracks of an hour would not fit
Progress = Callable[[int, int, str], None]


@dataclass
class ConversionReport:
    """What a conversion did."""

    converted: list[str] = field(default_factory=list)  # tokens of the scenarios written
    # tokens that were in the store already, cut in the same way
    unchanged: list[str] = field(default_factory=list)
    # reason by token, or by log where the whole log failed
    failed: dict[str, str] = field(default_factory=dict)
    # counts of what the source got wrong and nuPlan tolerates, by `where: what`
    flaws: Counter[str] = field(default_factory=Counter)
    # where the filter takes nothing: how many scenarios each of its keys left, and which types,
    # maps and logs there are
    left: dict[str, int] = field(default_factory=dict)
    offers: dict[str, Counter[str]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return (
            f"<ConversionReport nuplan: {len(self.converted)} scenarios converted, "
            f"{len(self.unchanged)} unchanged, {len(self.failed)} failed>"
        )


def convert_nuplan(
    logs: Path,  # folder that holds the logs (.db) at any depth, or one log
    maps: Path,  # folder with `nuplan-maps-v1.0.json` and the maps
    store: Path,
    *,
    tokens: Iterable[str] | None = None,  # only these scenarios
    types: Iterable[str] | None = None,  # only these scenario types
    filter_file: Path | None = None,  # nuPlan's YAML, or a text file with one token per line
    mapping: scenarios.Mapping | None = None,  # of all scenarios; nuPlan's by type where None
    progress: Progress | None = None,
) -> ConversionReport:
    """Convert scenarios of nuPlan logs into a store, as `shiftsim.convert_nuplan`.

    One broken scenario stops no other. Where nothing was converted, no new store is left.
    """
    chosen = _choice(tokens, types, filter_file)
    every = _log_files(Path(logs))
    files = [path for path in every if chosen.logs is None or path.stem in chosen.logs]
    is_new, was_there = not (Path(store) / MANIFEST).exists(), Path(store).exists()
    with StoreWriter(store) as writer:
        conversion = _Conversion(chosen, mapping, scenarios.find_maps(Path(maps)), writer)
        report = conversion.report
        show = progress or (lambda done, total, name: None)
        is_all = chosen == ScenarioFilter()
        thins_out = (chosen.per_type, chosen.limit, chosen.min_gap_s) != (None, None, None)
        taken = _thinned(files, conversion, show) if thins_out or is_all else None
        if is_all:
            text = "%d scenarios of %d logs will be made, one of every sweep as in nuPlan; %s"
            fewer = "--types, --tokens or --filter takes fewer"
            _LOG.warning(text, len(taken or ()), len(files) - len(report.failed), fewer)
        readable = [path for path in files if path.stem not in report.failed]
        for done, path in enumerate(readable):
            show(done, len(readable), path.stem)
            try:
                with open_log(path) as log:
                    conversion.convert_log(log, taken)
            except DataError as error:
                report.failed[path.stem] = _reason(error)
    unread = [path.name for path in files if path.stem in report.failed]
    for token in sorted((chosen.tokens or frozenset()) - conversion.found):
        report.failed[token] = _missing([path.name for path in files], unread)
    if not (report.converted or report.unchanged):
        if not report.failed:
            _explain(every, conversion)
        if is_new:
            for name in (MANIFEST, SCENARIOS):
                (Path(store) / name).unlink()
            if not was_there:
                shutil.rmtree(store)
    for flaw, count in report.flaws.items():
        _LOG.warning("%s (%d)", flaw, count)
    return report


def _thinned(
    files: Sequence[Path], conversion: "_Conversion", show: Progress
) -> set[tuple[str, str]]:
    """Log and token of what is left of the scenarios of all logs; logs that fail are noted."""
    entries: list[scenarios.ScenarioEntry] = []
    for done, path in enumerate(files):
        show(done, len(files), f"{path.stem}: scenarios")
        try:
            with open_log(path) as log:
                entries += conversion.offered(log)
        except DataError as error:
            conversion.report.failed[path.stem] = _reason(error)
    return {(e.log_name, e.token) for e in thin_out(entries, conversion.chosen)}


def _explain(files: Sequence[Path], conversion: "_Conversion") -> None:
    """Note what logs offer, and how many scenarios are left by one key after the other."""
    chosen, report, empty = conversion.chosen, conversion.report, ScenarioFilter()
    fields = [name for name in KEY_OF if getattr(chosen, name) != getattr(empty, name)]
    counts = Counter({"offered": 0, **{name: 0 for name in fields}})
    offers = {what: Counter[str]() for what in ("types", "maps", "logs")}
    entries: list[scenarios.ScenarioEntry] = []
    for path in files:
        with open_log(path) as log:
            found, so_far = _asked_for(log, empty), empty
            counts["offered"] += len(found)
            offers["types"].update(entry.scenario_type for entry in found)
            offers["maps"][log.map_name] += len(found)
            offers["logs"][log.name] += len(found)
            for name in (name for name in LISTED if name in fields):
                so_far = replace(so_far, **{name: getattr(chosen, name)})
                found = _asked_for(log, so_far)
                counts[name] += len(found)
            entries += found
    so_far = replace(empty, shuffle=chosen.shuffle)
    taken = entries
    for name in (name for name in THINNED if name in fields):
        so_far = replace(so_far, **{name: getattr(chosen, name)})
        taken = thin_out(entries, so_far)
        counts[name] = len(taken)
    tokens = {(entry.log_name, entry.token) for entry in taken}
    for path in files if tokens else ():
        with open_log(path) as log:
            for entry in _asked_for(log, chosen):
                if (log.name, entry.token) in tokens:
                    window = scenarios.cut_window(
                        log, entry.token, conversion.mapping, entry.scenario_type
                    )
                    conversion.judge(log, window, counts)
    unused = {"shuffle", "speed_noise"}
    report.left = {KEY_OF.get(name, name): n for name, n in counts.items() if name not in unused}
    report.offers = offers


def _asked_for(log: Log, chosen: ScenarioFilter) -> list[scenarios.ScenarioEntry]:
    """The scenarios of a log that the lists of a filter name."""
    for wanted, name in ((chosen.logs, log.name), (chosen.maps, log.map_name)):
        if wanted is not None and name not in wanted:
            return []
    with_goals = chosen.remove_invalid_goals
    return scenarios.offered(log, chosen.tokens, chosen.types, remove_invalid_goals=with_goals)


def _missing(names: Sequence[str], unread: Sequence[str]) -> str:
    """Why there is no such scenario in logs, some of which could not be read."""
    few = listed(unread or names, 5)
    if not unread:
        return f"not offered by any of {len(names)} logs searched ({few})"
    if len(unread) == len(names):
        return f"none of {len(names)} logs could be read ({few})"
    rest = len(names) - len(unread)
    return f"not offered by the {rest} of {len(names)} logs that could be read; not read: {few}"


def _choice(
    tokens: Iterable[str] | None, types: Iterable[str] | None, filter_file: Path | None
) -> ScenarioFilter:
    chosen = ScenarioFilter() if filter_file is None else read_filter(Path(filter_file))
    both = _common(tokens, chosen.tokens), _common(types, chosen.types)
    return replace(chosen, tokens=both[0], types=both[1])


def _common(given: Iterable[str] | None, listed: frozenset[str] | None) -> frozenset[str] | None:
    if given is None or listed is None:
        return listed if given is None else frozenset(given)
    return listed & frozenset(given)


def _log_files(logs: Path) -> list[Path]:
    files = [logs] if logs.is_file() else sorted(logs.rglob("*.db"))
    if not files:
        raise DataError(f"{logs}: there is no log (.db)", hint="give the folder with the logs")
    return files


def _reason(error: DataError) -> str:
    return f"{error.message} ({error.hint})" if error.hint else error.message


def _parts(windows: Sequence[Window]) -> list[list[Window]]:
    """Windows that overlap in time share a part of the log, up to a length."""
    parts: list[list[Window]] = []
    for window in sorted(windows, key=lambda w: (w.first_row, w.token)):
        last = parts[-1] if parts else []
        overlaps = any(window.first_row < other.last_row for other in last)
        if overlaps and window.last_row - last[0].first_row <= _MAX_ROWS:
            last.append(window)
        else:
            parts.append([window])
    return parts


@dataclass
class _Conversion:
    """Scenarios on their way into a store, and what became of them so far."""

    chosen: ScenarioFilter
    mapping: scenarios.Mapping | None
    known_maps: dict[str, Path]
    writer: StoreWriter
    report: ConversionReport = field(default_factory=ConversionReport)
    maps: dict[str, VectorMap] = field(default_factory=dict)
    found: set[str] = field(default_factory=set)  # tokens

    def offered(self, log: Log) -> list[scenarios.ScenarioEntry]:
        """The scenarios of a log that are asked for."""
        found = _asked_for(log, self.chosen)
        self.found.update(entry.token for entry in found)
        return found

    def convert_log(self, log: Log, taken: set[tuple[str, str]] | None) -> None:
        """Convert the chosen scenarios of one log, or of these the ones `taken` (log and token)."""
        report = self.report
        windows: list[Window] = []
        for entry in self.offered(log):
            if taken is not None and (log.name, entry.token) not in taken:
                continue
            try:
                window = scenarios.cut_window(log, entry.token, self.mapping, entry.scenario_type)
                if not is_taken(log, window, partial(self._map, log.map_name), self.chosen):
                    continue
            except ConversionError as error:
                report.failed[entry.token] = _reason(error)
                continue
            if self._is_stored(window):
                report.unchanged.append(window.token)
            else:
                windows.append(window)
        for group in _parts(windows):
            self._write_part(log, group)

    def judge(self, log: Log, window: Window, counts: Counter[str]) -> None:
        """Count a scenario for every key that judges scenarios one by one and takes it."""
        road = partial(self._map, log.map_name)
        for name, is_good in judgements(log, window, road, self.chosen):
            if not is_good:
                return
            counts[name] += 1

    def _is_stored(self, window: Window) -> bool:
        if window.token not in self.writer.tokens:
            return False
        stored = self.writer.window(window.token)
        return stored.mapping == window.mapping and stored.scenario_type == window.scenario_type

    def _map(self, name: str) -> VectorMap:
        if name not in self.maps:
            self.maps[name] = scenarios.load_map(self.known_maps, name)
            self.writer.add_map(self.maps[name])
            flaws = self.maps[name].flaws
            self.report.flaws.update({f"map {name}: {what}": n for what, n in flaws.items()})
        return self.maps[name]

    def _write_part(self, log: Log, windows: list[Window]) -> None:
        report, blocks = self.report, self._map(log.map_name).blocks.index
        first, last = windows[0].first_row, max(window.last_row for window in windows)
        name = f"{log.name}@{log.time_us[first]}-{log.time_us[last - 1]}"
        flaws: Counter[str] = Counter()
        try:
            recording, ego = scenarios.read_span(log, name, first, last, flaws)
        except ConversionError as error:
            if len(windows) == 1:
                report.failed[windows[0].token] = _reason(error)
            else:  # only the scenarios that hold the broken rows fail
                for window in windows:
                    self._write_part(log, [window])
            return
        self.writer.add_recording(recording)
        self.writer.add_ego(ego)
        for window in windows:
            flaws["unknown route ids"] += sum(block not in blocks for block in window.route)
            goal = window.mission_goal
            if goal is not None and not STORE["goal_pose"].holds(goal).all():
                flaws["scene: goals off the earth are left out"] += 1
                window = replace(window, mission_goal=None)
            names = ("first_row", "last_row", "iteration_rows")
            rows = {name: getattr(window, name) - first for name in names}
            self.writer.add_window(replace(window, log_name=name, ego=scenarios.EGO, **rows))
            report.converted.append(window.token)
        report.flaws.update({f"log {log.name}: {what}": n for what, n in (+flaws).items()})
