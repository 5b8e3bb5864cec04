"""Edits drawn at random: plausible, free of overlaps, and avoidable by braking.

A draw is kept where the edit can be applied and an ego at its recorded speed can still stop before
the conflict at 4 m/s^2. How hard it must brake is the difficulty of the edit.
"""

import random
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.world.edits.apply import apply_edit
from shiftsim.world.edits.places import ego_path
from shiftsim.world.edits.spec import At, make_edit
from shiftsim.world.state import PACIFICA, center_poses, speeds

if TYPE_CHECKING:
    from shiftsim.world.scenario import Scenario

HARDEST = 4.0  # m/s^2, braking that must suffice
GRADES = {"easy": 1.0, "medium": 2.0, "hard": HARDEST}  # m/s^2, up to which braking suffices
_REACTION = 0.5  # s, before the ego brakes
_CLEARANCE = 1.0  # m, left before the obstacle
_MOST_DRAWS = 200  # for one edit
_SIDE = (3.0, 6.0)  # m, from the path to where a pedestrian starts
_TURNING = 0.4  # rad, a pedestrian crosses where the path is straighter than this


def sample_edits(
    kind: str, count: int, seed: int, scenarios: Sequence[str], read: "Callable[[str], Scenario]"
) -> Iterator[dict[str, Any]]:
    """Tables of `[[edit]]`, named and graded; the same seed gives the same edits.

    Args:
        kind: One of `KINDS`.
        count: How many.
        seed: Of all draws.
        scenarios: Tokens that are drawn from.
        read: Reads one of them.

    Raises:
        ConfigError: No plausible edit is found.
    """
    draws, make = random.Random(f"{kind} {seed}"), KINDS[kind]
    for number in range(count):
        for _ in range(_MOST_DRAWS):
            token = draws.choice(scenarios)
            scenario = read(token)
            found = make(scenario, draws)
            if found is None:
                continue
            tables, distance, speed = found
            needed = braking(speed, distance)
            grade = next((name for name, most in GRADES.items() if needed <= most), "")
            if not grade:
                continue
            name = f"{kind}{number}"
            table = {"name": name, "tokens": [token], "type": f"{kind}_{grade}", **tables}
            try:
                apply_edit(scenario, make_edit(table, f"edit {name}"))
            except ConfigError:
                continue
            yield table
            break
        else:
            raise ConfigError(
                f"no plausible {kind} was found in {_MOST_DRAWS} draws",
                hint="choose scenarios in which the ego drives, with --split",
            )


def braking(speed: float, distance: float) -> float:
    """Deceleration at which an ego stops in time, after a moment of reaction [m/s^2]."""
    left = distance - _CLEARANCE - _REACTION * speed
    if speed < 0.1:
        return 0.0
    return float("inf") if left <= 0.0 else speed**2 / (2.0 * left)


Found = tuple[dict[str, Any], float, float]


def _jaywalker(scenario: "Scenario", draws: random.Random) -> Found | None:
    """A pedestrian crosses before the ego; it sets off when the ego is near."""
    reach = _driven(scenario)
    ahead, within = draws.uniform(15.0, 60.0), draws.uniform(10.0, 40.0)
    side, aside, pace = draws.choice((-1.0, 1.0)), draws.uniform(*_SIDE), draws.uniform(0.8, 2.5)
    if ahead > reach or not _is_straight(scenario, ahead):
        return None
    # it sets off at the latest when it is this far ahead of the front
    along = min(ahead, float(np.sqrt(max(within**2 - aside**2, 0.0))))
    walk = {
        "from": {"ahead_m": _rounded(ahead), "left_m": _rounded(side * aside)},
        "to": {"ahead_m": _rounded(ahead), "left_m": _rounded(-side * aside)},
        "ego_within_m": _rounded(within),
        "speed_mps": _rounded(pace),
    }
    speed = _speed_at(scenario, max(ahead - along, 0.0))
    return {"walk": [walk]}, along - PACIFICA.length / 2.0, speed


def _parked(scenario: "Scenario", draws: random.Random) -> Found | None:
    """A vehicle stands in the lane, more or less aside."""
    ahead, left = draws.uniform(15.0, 70.0), draws.uniform(-2.0, 1.0)
    if ahead > _driven(scenario):
        return None
    place = {"ahead_m": _rounded(ahead), "left_m": _rounded(left)}
    spawn = {"at": place | {"turn": _rounded(draws.uniform(-0.1, 0.1))}, "behavior": "stopped"}
    gap = ahead - 2.3 - PACIFICA.length / 2.0
    return {"spawn": [spawn]}, gap, _speed_at(scenario, 0.0)


def _works(scenario: "Scenario", draws: random.Random) -> Found | None:
    """The lane is closed by cones."""
    ahead, length = draws.uniform(20.0, 70.0), draws.uniform(4.0, 16.0)
    if ahead > _driven(scenario):
        return None
    block = {"at": {"ahead_m": _rounded(ahead)}, "length_m": _rounded(length), "taper_m": 4.0}
    gap = ahead - 4.25 - PACIFICA.length / 2.0
    return {"block_lane": [block]}, gap, _speed_at(scenario, 0.0)


KINDS: dict[str, Callable[["Scenario", random.Random], Found | None]] = {
    "jaywalker": _jaywalker,
    "parked": _parked,
    "works": _works,
}


def _rounded(value: float) -> float:
    return round(value, 2)


def _driven(scenario: "Scenario") -> float:
    """How far the recorded ego gets [m]."""
    steps = np.diff(center_poses(scenario.expert[:, :3])[:, :2], axis=0)
    return float(np.hypot(*steps.T).sum())


def _speed_at(scenario: "Scenario", along: float) -> float:
    """Largest recorded speed from the start to a place on the path [m/s]."""
    steps = np.diff(center_poses(scenario.expert[:, :3])[:, :2], axis=0)
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    return float(speeds(scenario.expert[gone <= along + 1e-9]).max())


def _is_straight(scenario: "Scenario", ahead: float) -> bool:
    path = ego_path(scenario)
    turn = path.pose(At(ahead + 5.0))[2] - path.pose(At(ahead - 5.0))[2]
    return abs(float(wrap_angle(turn))) < _TURNING
