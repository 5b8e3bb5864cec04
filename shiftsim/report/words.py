"""What metrics, units and violations are called where people read them; which one is the worst."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from shiftsim.metrics import MULTIPLIERS, SHORT_NAMES
from shiftsim.runs.rollouts import Task
from shiftsim.runs.tables import task_of as task_of
from shiftsim.world.state import AgentKind, Tracks

COLLISIONS = "no_ego_at_fault_collisions"
NAMES = {  # in the one order of metrics, that of `SHORT_NAMES`
    "no_ego_at_fault_collisions": "no at-fault collision",
    "drivable_area_compliance": "drivable area",
    "ego_is_making_progress": "making progress",
    "driving_direction_compliance": "driving direction",
    "ego_progress_along_expert_route": "progress",
    "time_to_collision_within_bound": "time to collision",
    "speed_limit_compliance": "speed limit",
    "ego_is_comfortable": "comfort",
}
REASONS = NAMES | {  # what went wrong
    "no_ego_at_fault_collisions": "at-fault collision",
    "ego_is_making_progress": "no progress",
    "ego_progress_along_expert_route": "little progress",
}
# what the headings of columns are short for, in the order of the columns
LONG = {"CLS": "closed-loop score"} | {SHORT_NAMES[name]: words for name, words in NAMES.items()}
_HOW_FAR = {  # what the first value of a violation measures
    "drivable_area_compliance": ("outside",),
    "driving_direction_compliance": ("against traffic",),
    "speed_limit_compliance": ("over the limit",),
}
UNITS = {  # nuPlan's names, shortened
    "meters": "m",
    "meter": "m",
    "radian": "rad",
    "seconds": "s",
    "meters_per_second": "m/s",
    "meters_per_second_squared": "m/s²",
    "meters_per_second_cubed": "m/s³",
    "radians_per_second": "rad/s",
    "radians_per_second_squared": "rad/s²",
    **dict.fromkeys(("count", "ratio", "boolean"), ""),
}


def in_words(metric: str, names: Mapping[str, str] = NAMES) -> str:
    """A metric as "no at-fault collision (NCR)"; one that is not scored by its name."""
    return f"{names[metric]} ({SHORT_NAMES[metric]})" if metric in names else metric


def legend(shorts: Iterable[str], words: Mapping[str, str] = LONG) -> str:
    """What those of some headings mean that are short: "no at-fault collision (NCR), …"."""
    return ", ".join(f"{words[name]} ({name})" for name in shorts if name in words)


def rows_by_task(table: pa.Table) -> dict[Task, list[dict[str, Any]]]:
    """The rows of each task in a run's table."""
    out: dict[Task, list[dict[str, Any]]] = {}
    for row in table.to_pylist():
        out.setdefault(task_of(row), []).append(row)
    return out


def violation_words(row: Mapping[str, Any], tracks: Tracks) -> str:
    """A row of `metrics.parquet` with a violation, as "at-fault collision, pedestrian 17, …"."""
    words, partner = [REASONS.get(row["metric"], row["metric"])], row["partner_token"]
    if partner in tracks.tokens:
        kind = AgentKind(int(tracks.kinds[tracks.tokens.index(partner)]))
        words.append(f"{kind.name.lower().replace('_', ' ')} {partner}")
    value, unit = row["first_violation_value"], UNITS.get(row["unit"], row["unit"])
    if value is not None and np.isfinite(value):
        if row["metric"] == COLLISIONS:  # the speed by which it changes is kept here
            words.append(f"Δv {value:.1f} m/s")
        elif unit:
            number = f"{value:.2f}" if abs(value) < 1.0 else f"{float(f'{value:.2g}'):g}"
            number = number if abs(value) >= 0.01 else "under 0.01"
            words.append(" ".join([number, unit, *_HOW_FAR.get(row["metric"], ())]))
    return ", ".join(words)


class Violation(NamedTuple):
    """A scored metric below 1."""

    short: str  # the metric's abbreviation
    reason: str  # what went wrong
    time: float | None  # when it began [s from the start]; None where it has no moment
    is_multiplier: bool  # whether the metric multiplies the score
    row: Mapping[str, Any]  # of `metrics.parquet`

    def __str__(self) -> str:
        return self.reason if self.time is None else f"{self.reason} {self.time:.1f} s"


def violations(rows: Iterable[Mapping[str, Any]]) -> list[Violation]:
    """The scored metrics below 1 among rows of `metrics.parquet`, the earliest first."""
    found = [
        Violation(
            SHORT_NAMES[name], REASONS[name], row["first_violation_s"], name in MULTIPLIERS, row
        )
        for row in rows
        if (name := row["metric"]) in REASONS and row["score"] is not None and row["score"] < 1.0
    ]
    return sorted(found, key=lambda one: (one.time is None, one.time or 0.0))


def severity(one: Violation) -> tuple[float, float, float]:
    """What violations are ordered by, the worst first: kind, then Δv, distance or other value."""
    value, kind = one.row["first_violation_value"], float(list(REASONS).index(one.row["metric"]))
    amount = abs(value) if value is not None and np.isfinite(value) else 0.0
    if one.row["metric"] == "time_to_collision_within_bound":
        amount = -amount
    return (0.0, kind, -amount) if one.is_multiplier else (1.0, one.row["score"], -amount)


def worst_violation(found: Iterable[Violation]) -> Violation | None:
    """The worst: the first multiplier in the order of metrics, else the lowest score."""
    return min(found, key=severity, default=None)


def worst_moment(found: Iterable[Violation]) -> Violation | None:
    """The worst of those that have a moment."""
    return worst_violation(one for one in found if one.time is not None)


def worst_of(rows: Iterable[Mapping[str, Any]], count: int) -> list[tuple[Mapping[str, Any], int]]:
    """The worst scenarios, one per recording and cause, and how many others are like each."""
    by_token: dict[str, Mapping[str, Any]] = {}
    for row in sorted(
        rows, key=lambda r: (r["cls"], r["severity"], r["noise"] != "none", task_of(r))
    ):
        by_token.setdefault(row["token"], row)
    alike: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for row in by_token.values():
        is_same = row["log"] and row["cause"]
        key = (row["log"], row["cause"]) if is_same else (row["token"],)
        alike.setdefault(key, []).append(row)
    return [(same[0], len(same) - 1) for same in list(alike.values())[:count]]
