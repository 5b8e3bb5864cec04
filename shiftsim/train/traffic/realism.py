"""How much simulated agents are like recorded ones: distance, collisions, the road, speeds."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from shiftsim.errors import DataError, TrafficError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.rings import convex_intersect
from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.planner import rollout_rows
from shiftsim.sim.traffic import LogReplay, Traffic
from shiftsim.world.layers import in_any
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind

SECONDS = 5.0  # that agents are driven for, unless told otherwise
_PER_SECOND = 10  # iterations
_MOVING = 1.0  # m within the time: what recorded agents have moved by at least


@dataclass
class Realism:
    """Sums over agents of all scenarios."""

    distances: list[float] = field(default_factory=list)  # m in the end, of vehicles that move
    agents: int = 0  # that were simulated
    collided: int = 0  # of them with another agent, which they did not touch at first
    off_road: int = 0  # of vehicles, off the road in the end; those that were on it at first
    on_road: int = 0  # vehicles that were on the road at first
    speeds: list[float] = field(default_factory=list)  # m/s in the end, of vehicles that move
    recorded: list[float] = field(default_factory=list)  # m/s, the same as recorded
    taken_away: int = 0  # vehicles that the model took away
    failed: int = 0  # scenarios in which it failed

    def row(self, name: str) -> dict[str, Any]:
        """The figures of a table; NaN where there is nothing to measure."""
        return {
            "traffic": name,
            "distance_m": float(np.mean(self.distances or [np.nan])),
            "collided": self.collided / self.agents if self.agents else np.nan,
            "off_road": self.off_road / self.on_road if self.on_road else np.nan,
            "speed_mps": float(np.mean(self.speeds or [np.nan])),
            "recorded_speed_mps": float(np.mean(self.recorded or [np.nan])),
            "agents": self.agents,
            "vehicles_that_moved": len(self.distances),
            "taken_away": self.taken_away,
            "failed_scenarios": self.failed,
        }


def compare(
    scenarios: Iterable[Scenario],
    models: Mapping[str, Callable[[], Traffic]],
    seconds: float = SECONDS,
) -> list[dict[str, Any]]:
    """A row for each model and the recording; a DataError if no scenario is long enough.

    All agents are driven from the first iteration on, beside the recorded ego, for `seconds`.
    """
    found = {name: Realism() for name in ("recording", *models)}
    steps, longest = round(seconds * _PER_SECOND), 0
    for scenario in scenarios:
        longest = max(longest, scenario.num_iterations - 1)
        if scenario.num_iterations > steps:
            _measure(scenario, LogReplay(), found["recording"], steps)
            for name, make in models.items():
                _measure(scenario, make(), found[name], steps)
    if longest < steps:
        raise DataError(
            f"no scenario lasts {seconds:g} s; the longest lasts {longest / _PER_SECOND:g} s",
            hint="give fewer --seconds",
        )
    return [{**one.row(name), "seconds": seconds} for name, one in found.items()]


def _measure(scenario: Scenario, traffic: Traffic, out: Realism, steps: int) -> None:
    rows, start = rollout_rows(scenario)
    recorded = scenario.tracks.rows(rows)
    tracks, ego = recorded.copy(), scenario.ego[scenario.iteration_rows]
    try:
        traffic.start(scenario, tracks, start)
        for iteration in range(steps):
            traffic.step(iteration, ego[iteration], tracks, start + iteration + 1)
    except TrafficError:
        out.failed += 1
        return
    end = start + steps
    kinds = tracks.kinds
    is_agent = (kinds <= LAST_AGENT_KIND) & recorded.valid[start]
    is_vehicle = (kinds == AgentKind.VEHICLE) & is_agent
    way = recorded.poses[end, :, :2] - recorded.poses[start, :, :2]
    moves = is_vehicle & recorded.valid[end] & (np.hypot(*way.T) > _MOVING)
    out.taken_away += int((is_vehicle & ~tracks.valid[end]).sum())
    moves &= tracks.valid[end]
    apart = tracks.poses[end, moves, :2] - recorded.poses[end, moves, :2]
    out.distances += np.hypot(*apart.T).tolist()
    out.speeds += np.hypot(*tracks.velocities[end, moves].T).tolist()
    out.recorded += np.hypot(*recorded.velocities[end, moves].T).tolist()
    span = slice(start, end + 1)
    shown = tracks.valid[span] & is_agent
    corners = boxes_to_corners(tracks.poses[span], tracks.sizes[span])
    hit = np.zeros(len(kinds), np.bool_)
    _touching(shown, corners, hit)
    out.agents += int(is_agent.sum())
    out.collided += int(hit.sum())
    areas = scenario.map.drivable_areas.polygons
    for track in np.flatnonzero(is_vehicle & tracks.valid[end]).tolist():
        if in_any(areas, *recorded.poses[start, track, :2].tolist()):
            out.on_road += 1
            out.off_road += not in_any(areas, *tracks.poses[end, track, :2].tolist())


@kernel
def _touching(valid: np.ndarray, corners: FloatArray, hit: np.ndarray) -> None:
    """Mark the tracks (N,) whose boxes (T, N, 4, 2) overlap another's, though not in row 0."""
    count = valid.shape[1]
    for a in range(count):
        for b in range(a):
            if valid[0, a] and valid[0, b] and convex_intersect(corners[0, a], corners[0, b]):
                continue
            for row in range(1, len(valid)):
                if (
                    valid[row, a]
                    and valid[row, b]
                    and abs(corners[row, a, 0, 0] - corners[row, b, 0, 0]) < 30.0
                    and convex_intersect(corners[row, a], corners[row, b])
                ):
                    hit[a] = hit[b] = True
                    break
