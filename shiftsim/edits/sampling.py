"""Edits drawn at random: plausible, free of overlaps, in the way, and avoidable.

A draw is kept where the edit can be applied and driving it says that it is in the way of the
recorded driver, and how hard it is to avoid.
"""

import random
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from shiftsim.edits.apply import apply_edit
from shiftsim.edits.places import ego_path
from shiftsim.edits.spec import At, make_edit
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import center_poses

HARDEST = 4.0  # m/s^2, braking that must suffice where PDM-Closed does not avoid it
GRADES = {"easy": 1.0, "medium": 2.0, "hard": HARDEST}  # m/s^2, with which braking avoids it
_MOST_DRAWS = 400  # for one edit
_SIDE = (3.0, 6.0)  # m, from the path to where a pedestrian starts
_TURNING = 0.4  # rad, a pedestrian crosses where the path is straighter than this


def sample_edits(
    kind: str,  # one of `KINDS`
    count: int,
    seed: int,
    scenarios: Sequence[str],  # tokens that are drawn from
    read: Callable[[str], Scenario],
    grade: Callable[[Scenario], str],  # how hard one is, of `GRADES`; empty where it is not wanted
    *,
    even: bool = False,  # whether there are as many of every grade, the last ones perhaps fewer
) -> Iterator[dict[str, Any]]:
    """Tables of `[[edit]]`, named and graded, or a ConfigError; one seed gives the same edits."""
    draws, make = random.Random(f"{kind} {seed}"), KINDS[kind]
    found, most = Counter[str](), -(-count // len(GRADES)) if even else count
    for number in range(count):
        for _ in range(_MOST_DRAWS):
            token = draws.choice(scenarios)
            scenario = read(token)
            tables = make(scenario, draws)
            if tables is None:
                continue
            table = {"name": f"{kind}{number}", "tokens": [token], "type": kind, **tables}
            try:
                edited = apply_edit(scenario, make_edit(table, f"edit {table['name']}"))
            except ConfigError:
                continue
            hardness = grade(edited)
            if hardness and found[hardness] < most:
                found[hardness] += 1
                yield table | {"type": f"{kind}_{hardness}"}
                break
        else:
            what = f"no plausible {kind} was found in {_MOST_DRAWS} draws"
            raise ConfigError(what, "choose scenarios in which the ego drives, with --split")


def graded(scenario_type: str) -> tuple[str, str]:
    """Kind and grade of the type of a sampled edit; other types have no grade."""
    kind, _, grade = scenario_type.rpartition("_")
    return (kind, grade) if kind and grade in GRADES else (scenario_type, "")


Tables = dict[str, Any]


def _jaywalker(scenario: Scenario, draws: random.Random) -> Tables | None:
    """A pedestrian crosses before the ego; it sets off when the ego is near."""
    ahead, within = draws.uniform(15.0, 60.0), draws.uniform(10.0, 40.0)
    side, aside, pace = draws.choice((-1.0, 1.0)), draws.uniform(*_SIDE), draws.uniform(0.8, 2.5)
    if ahead > _driven(scenario) or not _is_straight(scenario, ahead):
        return None
    walk = {
        "from": {"ahead_m": round(ahead, 2), "left_m": round(side * aside, 2)},
        "to": {"ahead_m": round(ahead, 2), "left_m": round(-side * aside, 2)},
        "ego_within_m": round(within, 2),
        "speed_mps": round(pace, 2),
    }
    return {"walk": [walk]}


def _parked(scenario: Scenario, draws: random.Random) -> Tables | None:
    """A vehicle stands in the lane, more or less aside."""
    ahead, left = draws.uniform(15.0, 70.0), draws.uniform(-2.0, 1.0)
    if ahead > _driven(scenario):
        return None
    place = {"ahead_m": round(ahead, 2), "left_m": round(left, 2)}
    spawn = {"at": place | {"turn": round(draws.uniform(-0.1, 0.1), 2)}, "behavior": "stopped"}
    return {"spawn": [spawn]}


def _works(scenario: Scenario, draws: random.Random) -> Tables | None:
    """The lane is closed by cones."""
    ahead, length = draws.uniform(20.0, 70.0), draws.uniform(4.0, 16.0)
    if ahead > _driven(scenario):
        return None
    block = {"at": {"ahead_m": round(ahead, 2)}, "length_m": round(length, 2), "taper_m": 4.0}
    return {"block_lane": [block]}


KINDS: dict[str, Callable[[Scenario, random.Random], Tables | None]] = {
    "jaywalker": _jaywalker,
    "parked": _parked,
    "works": _works,
}


def _driven(scenario: Scenario) -> float:
    """How far the recorded ego gets [m]."""
    steps = np.diff(center_poses(scenario.expert[:, :3])[:, :2], axis=0)
    return float(np.hypot(*steps.T).sum())


def _is_straight(scenario: Scenario, ahead: float) -> bool:
    path = ego_path(scenario)
    turn = path.pose(At(ahead + 5.0))[2] - path.pose(At(ahead - 5.0))[2]
    return abs(float(wrap_angle(turn))) < _TURNING
