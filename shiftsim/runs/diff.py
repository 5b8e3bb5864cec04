"""Two runs scenario by scenario: where scores differ, and the first step at which rollouts part.

Rollouts are compared as they were stored; they part where a quantity differs by more than a
tolerance, in its unit, so that rounding is not taken for a cause. Within one step the order is that
of cause and effect: the world as the planner saw it, its plan, the command, the noise.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.errors import ConfigError, DataError
from shiftsim.metrics import SHORT_NAMES
from shiftsim.runs.results import Run
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.files import stack, stored_plans, stored_tracks
from shiftsim.runs.tables import task_of
from shiftsim.world.scenario import FULL_DURATION

# columns of a stored rollout in the order of cause and effect within one step
_NOT_COMPARED = {*Task._fields, "iteration", "time_us", "planning_seconds"}
_LATER = ("degraded", "plan", "command_", "noise_")
_UNITS = {"mps": "m/s", "mps2": "m/s²", "radps": "rad/s", "radps2": "rad/s²"}
_UNITS |= {"m": "m", "rad": "rad"}
TOLERANCE = 1e-6  # m, and the other units alike
_AXES = ("x [m]", "y [m]", "heading [rad]")


@dataclass(frozen=True, slots=True)
class Departure:
    """The first step at which two rollouts differ."""

    iteration: int  # the step
    seconds: float  # its time since the start [s]
    quantity: str  # what differs first, with its unit
    first: float  # its value in the first run
    second: float  # its value in the second run

    def __str__(self) -> str:
        name, _, unit = self.quantity.partition(" [")
        values = f"{self.first:.6g} vs {self.second:.6g}"
        if f"{self.first:.6g}" == f"{self.second:.6g}":
            values = f"{self.first!r} vs {self.second!r}"
        when = f"iteration {self.iteration} ({self.seconds:.1f} s)"
        return f"{when}: {name} {values} {unit.removesuffix(']')}".rstrip()


@dataclass(frozen=True, slots=True)
class Change:
    """A rollout whose score is another one."""

    task: Task  # key in the first run
    planner: str  # planner of the second run
    first: float  # score in the first run
    second: float  # score in the second run
    # scores of the metrics that differ, in both runs
    metrics: dict[str, tuple[float | None, float | None]]
    # where the rollouts part; None where they do not, or are not stored
    departure: Departure | None
    note: str  # why there is no departure
    # largest distance between the egos: metres, and its time [s from the start]; None as above
    largest: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Difference:
    """Two runs compared."""

    settings: tuple[str, ...]  # names of the settings that results depend on and that differ
    same: int  # rollouts with the same score
    better: int  # rollouts that are better in the second run
    worse: int  # rollouts that are worse in it
    only_first: int  # rollouts that finished in the first run alone
    only_second: int  # rollouts that finished in the second run alone
    # mean score of the common rollouts in both runs; None where their durations differ
    means: tuple[float, float] | None
    changes: tuple[Change, ...]  # the rollouts that changed most
    remarks: tuple[str, ...] = ()  # runs that were driven elsewhere

    def __repr__(self) -> str:
        return f"<Difference: same {self.same}, better {self.better}, worse {self.worse}>"

    def __str__(self) -> str:
        return "\n".join(diff_lines(self))

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        out = asdict(self)
        for change, row in zip(self.changes, out["changes"], strict=True):
            row["task"] = change.task._asdict()
        return out


def diff_runs(
    first: Run, second: Run, *, limit: int = 10, tolerance: float = TOLERANCE
) -> Difference:
    """Compare two runs by planner, or two of one each; look into the `limit` largest changes."""
    planners = [run.manifest["config"]["planners"] for run in (first, second)]
    single = len(planners[0]) == len(planners[1]) == 1
    names = dict(zip(*planners, strict=True)) if single else {n: n for n in planners[0]}
    ours, theirs = (
        {task_of(row): row for row in run.scores.to_pylist() if row["cls"] is not None}
        for run in (first, second)
    )
    pairs = {task: task._replace(planner=names[task.planner]) for task in sorted(ours)}
    pairs = {task: other for task, other in pairs.items() if other in theirs}
    if not pairs:
        raise ConfigError(
            f"runs {first.path.name!r} and {second.path.name!r} have no rollout in common",
            hint="compare runs of the same planners, noises, seeds and scenarios; where the others "
            "are not given there is no score",
        )
    before = np.array([ours[task]["cls"] for task in pairs])
    after = np.array([theirs[other]["cls"] for other in pairs.values()])
    common, largest_first = list(pairs), np.argsort(-np.abs(after - before), kind="stable")
    changed = [common[i] for i in largest_first if before[i] != after[i]]
    durations = {ours[task]["duration_class"] or FULL_DURATION for task in pairs}
    before_by, after_by = (run.manifest["determining"] for run in (first, second))
    settings = sorted({*before_by, *after_by})
    return Difference(
        settings=tuple(n for n in settings if before_by.get(n) != after_by.get(n)),
        same=int(np.sum(before == after)),
        better=int(np.sum(after > before)),
        worse=int(np.sum(after < before)),
        only_first=len(ours) - len(pairs),
        only_second=len(theirs) - len(pairs),
        means=(float(before.mean()), float(after.mean())) if len(durations) == 1 else None,
        changes=tuple(
            _change(first, second, task, pairs[task], ours[task], theirs[pairs[task]], tolerance)
            for task in changed[:limit]
        ),
        remarks=tuple(f"{r.path.name}: {line}" for r in (first, second) for line in r.remarks),
    )


def diff_lines(found: Difference) -> list[str]:
    """Two runs compared, in words."""
    means = "– (scenarios of different durations)"
    if found.means is not None:
        means = _in_words(*found.means)
    lone = f" · only in one run {found.only_first} and {found.only_second}"
    counts = f" same {found.same} · better {found.better} · worse {found.worse}"
    counts += lone if found.only_first or found.only_second else ""
    lines = [f"{counts}      CLS of the common ones {means}"]
    lines += [f" {line}" for line in found.remarks]
    if found.settings:
        lines.append(f" settings that differ: {', '.join(found.settings)}")
    for change in found.changes:
        task = change.task
        both = task._replace(planner="/".join(dict.fromkeys((task.planner, change.planner))))
        metrics = ", ".join(f"{name} {_in_words(*pair)}" for name, pair in change.metrics.items())
        total = _in_words(change.first, change.second)
        lines.append(f" {task.token}  {both.words}  {total}  {metrics}")
        parts = [f"first difference {change.departure}" if change.departure else change.note]
        if change.largest and change.largest[0]:
            gap, seconds = change.largest
            parts.append(f"largest distance of the egos {gap:.3g} m at {seconds:.1f} s")
        lines.append(f"   {'; '.join(parts)}")
    left = found.better + found.worse - len(found.changes)
    return lines + ([f" and {left} more (--limit)"] if left else [])


def _in_words(*scores: float | None) -> str:
    return " → ".join("–" if score is None else f"{100.0 * score:.2f}" for score in scores)


def _change(
    first: Run,
    second: Run,
    task: Task,
    other: Task,
    before: dict[str, Any],
    after: dict[str, Any],
    tolerance: float,
) -> Change:
    """A change of the score between two rows, and where it comes from."""
    metrics = {
        short: (before[name], after[name])
        for name, short in SHORT_NAMES.items()
        if name != "score" and before[name] != after[name]
    }
    departure, largest, note = None, None, ""
    if first.rollout_places.get(task) is None or second.rollout_places.get(other) is None:
        note = "rollouts are not stored"
    else:
        tables = first.rollout_rows(task), second.rollout_rows(other)
        try:
            departure = find_departure(*tables, tolerance=tolerance)
            largest = _largest_distance(*tables)
        except ValueError as error:
            where = f"a rollout of scenario {task.token!r} in {first.path} or {second.path}"
            raise DataError(f"{where} is damaged: {error}", hint="make the run again") from error
        if departure is None:  # why scores differ where the ego drove the same
            traffic = [run.manifest["determining"]["traffic"] for run in (first, second)]
            exact = find_departure(*tables) is None
            same = "the same" if exact else f"the same to {tolerance:g} m"
            note = f"the rollouts are {same}: they were scored differently"
            if traffic[0] != traffic[1]:
                note = f"the ego drove the same, but in other traffic ({', '.join(traffic)})"
    scores = before["cls"], after["cls"]
    return Change(task, other.planner, *scores, metrics, departure, note, largest)


def _largest_distance(first: pa.RecordBatch, second: pa.RecordBatch) -> tuple[float, float]:
    """The largest distance between two egos [m] and its time since the start [s]."""
    rows = min(len(first), len(second))
    ours, theirs = (stack(run.slice(0, rows), ("x_m", "y_m")) for run in (first, second))
    apart, times = np.hypot(*(ours - theirs).T), first["time_us"].to_numpy()
    at = int(np.argmax(apart))
    return float(apart[at]), float((times[at] - times[0]) * 1e-6)


def find_departure(
    first: pa.RecordBatch, second: pa.RecordBatch, *, tolerance: float = 0.0
) -> Departure | None:
    """The first step at which two rollouts differ by more than a tolerance, or a ValueError."""
    rows = min(len(first), len(second))
    tokens = sorted({*_track_tokens(first), *_track_tokens(second)})
    ours, theirs = (_quantities(table, rows, tokens) for table in (first, second))
    best: tuple[int, str] | None = None
    for _, name in sorted(map(_ranked, ours.keys() & theirs.keys())):
        parted = (_gaps(name, ours[name], theirs[name]) > tolerance).any(axis=1)
        row = int(np.argmax(parted)) if parted.any() else rows
        if row < (best[0] if best else rows):
            best = (row, name)
    if best is None and len(first) == len(second):
        return None
    row, name = best or (rows, "")
    times = (first if len(first) > row else second)["time_us"]
    seconds = float((times[row].as_py() - times[0].as_py()) * 1e-6)
    if not name:
        return Departure(row, seconds, "length of the rollout", len(first), len(second))
    one, other = ours[name][row], theirs[name][row]
    index = int(np.argmax(_gaps(name, one[None], other[None])[0] > tolerance))
    return Departure(row, seconds, _quantity(name, index), float(one[index]), float(other[index]))


def _ranked(name: str) -> tuple[int, str]:
    """A quantity behind its place in the order of cause and effect."""
    return next((i for i, start in enumerate(_LATER, 1) if name.startswith(start)), 0), name


def _track_tokens(table: pa.RecordBatch) -> list[str]:
    has_tracks = "track_tokens" in table.schema.names
    return table["track_tokens"].flatten().unique().to_pylist() if has_tracks else []


def _quantities(table: pa.RecordBatch, rows: int, tokens: list[str]) -> dict[str, np.ndarray]:
    """(rows, n) numbers of each quantity that a rollout stores, but of noise that its key makes."""
    found = {
        name: column.to_numpy(zero_copy_only=False)
        for name, column in zip(table.schema.names, table.columns, strict=True)
        if name not in _NOT_COMPARED and not pa.types.is_list(column.type) and not column.null_count
    }
    found["plan"] = stored_plans(table)
    if "track_tokens" in table.schema.names:
        found |= {f"track_{name}": values for name, values in stored_tracks(table, tokens).items()}
    return {
        name: values[:rows].reshape(rows, math.prod(values.shape[1:])).astype(np.float64)
        for name, values in found.items()
    }


def _gaps(name: str, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(rows, n) by how much numbers differ, headings across ±pi; infinite where one is missing."""
    if first.shape != second.shape:
        return np.full((len(first), 1), np.inf)
    gaps = first - second
    if name.endswith(("heading_rad", "plan", "poses")):
        turns = slice(None) if name.endswith("heading_rad") else slice(2, None, 3)
        gaps[:, turns] -= 2.0 * np.pi * np.round(gaps[:, turns] / (2.0 * np.pi))
    missing = np.isnan(first) != np.isnan(second)
    return np.where(missing, np.inf, np.nan_to_num(np.abs(gaps)))


def _quantity(name: str, index: int) -> str:
    if name == "plan":
        pose, axis = divmod(index, 3)
        return f"plan, pose {pose} {_AXES[axis]}"
    if name.startswith("track_"):
        return f"{name.replace('_', ' ')}, number {index}"
    words = name.split("_")
    unit = _UNITS.get(words[-1])
    text = " ".join(words[:-1] if unit else words)
    owner = "" if name.startswith(("command", "noise", "degraded")) else "ego "
    return f"{owner}{text} [{unit}]" if unit else f"{owner}{text}"
