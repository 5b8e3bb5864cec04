"""Statistics of a store: how many scenarios, how busy, how fast, how far.

Interaction density is the mean number of agents per moment that come close to the ego's path: at
every full second after iteration 0, each agent is predicted with constant velocity for `HORIZON`
seconds, and counts when its box then comes within `REACH` metres of the line that the middle of the
ego drives in the same time. Parked vehicles at the line count as well: they narrow it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np
import shapely

from shiftsim.data.store.reading import ScenarioStore
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.kernels import FloatArray
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind, center_poses, speeds

HORIZON, HORIZON_STEP = 3.0, 0.5  # s
REACH = 3.0  # m, from the middle of the ego: about half its width and as much again
_EVERY = 10  # iterations between the moments
_FAR = 120.0  # m; nothing further away can come close within the horizon
_INTERSECTION_STEP = 5  # iterations between the points tested
ALL = "all"

# Scenarios of the published benchmark (Canevaro et al., Shift & Drift) by site.
PUBLISHED_SETS = {"nuPlan Val14": 1118, "interPlan": 80, "DeepPlan": 1182}


@dataclass(frozen=True, slots=True)
class ScenarioStats:
    """Numbers of one scenario, over its iterations."""

    vehicles: float  # vehicles besides the ego that are ever present
    pedestrians: float  # the same of pedestrians
    bicycles: float  # the same of bicycles
    vehicles_t0: float  # vehicles at iteration 0
    pedestrians_t0: float  # the same of pedestrians
    bicycles_t0: float  # the same of bicycles
    static_objects: float  # static objects that are ever present
    mean_speed_mps: float  # of the ego
    max_speed_mps: float  # of the ego
    path_m: float  # length of the ego's path
    route_m: float  # length of the route: of one lane per block
    interactions: float  # mean number of agents that come close to the ego's path
    intersection: float  # 1 when the ego passes an intersection, else 0


COLUMNS = tuple(field.name for field in fields(ScenarioStats))
_KINDS = {
    "vehicles": AgentKind.VEHICLE,
    "pedestrians": AgentKind.PEDESTRIAN,
    "bicycles": AgentKind.BICYCLE,
}


@dataclass(frozen=True)
class StoreStats:
    """Statistics of some scenarios of a store."""

    rows: Mapping[str, ScenarioStats]  # numbers by scenario
    cities: Mapping[str, str]  # city by scenario
    types: Mapping[str, str]  # scenario type by scenario

    def __repr__(self) -> str:
        return f"<StoreStats: {len(self.rows)} scenarios in {len(set(self.cities.values()))} maps>"

    def groups(self, by: str = "city") -> dict[str, dict[str, float]]:
        """Number of scenarios and mean of every column, of each group (city or type) and of all."""
        labels = self.cities if by == "city" else self.types
        out = {}
        for name in sorted(set(labels.values())):
            out[name] = self._means(token for token in self.rows if labels[token] == name)
        return out | {ALL: self._means(self.rows)}

    def _means(self, tokens: Iterable[str]) -> dict[str, float]:
        chosen = [asdict(self.rows[token]) for token in tokens]
        means = {name: float(np.mean([row[name] for row in chosen])) for name in COLUMNS if chosen}
        return {"scenarios": float(len(chosen)), **means}


def store_stats(
    store: ScenarioStore,
    tokens: Sequence[str] | None = None,
    *,
    progress: Callable[[int, int, str], None] = lambda done, total, token: None,
) -> StoreStats:
    """Statistics of some scenarios of a store, or of all; `progress` gets done, all, token."""
    chosen = store.tokens if tokens is None else tuple(tokens)
    rows, cities, types = dict[str, ScenarioStats](), dict[str, str](), dict[str, str]()
    for done, token in enumerate(chosen, 1):
        scenario = store.read(token)
        rows[token] = scenario_stats(scenario)
        cities[token], types[token] = scenario.city, scenario.scenario_type
        progress(done, len(chosen), token)
    return StoreStats(rows, cities, types)


def scenario_stats(scenario: Scenario) -> ScenarioStats:
    """Numbers of one scenario."""
    tracks = scenario.tracks.rows(scenario.iteration_rows)
    seen = tracks.valid.any(axis=0)
    speed = speeds(scenario.expert)
    centers = center_poses(scenario.expert[:, :3])
    numbers = {}
    for name, kind in _KINDS.items():
        of_kind = tracks.kinds == kind
        numbers[name] = float(np.sum(seen & of_kind))
        numbers[f"{name}_t0"] = float(np.sum(tracks.valid[0] & of_kind))
    return ScenarioStats(
        **numbers,
        static_objects=float(np.sum(seen & (tracks.kinds > LAST_AGENT_KIND))),
        mean_speed_mps=float(speed.mean()),
        max_speed_mps=float(speed.max()),
        path_m=float(np.hypot(*np.diff(centers[:, :2], axis=0).T).sum()),
        route_m=_route_length(scenario.map, scenario.route),
        interactions=_interactions(scenario, centers),
        intersection=float(_passes_intersection(scenario.map, centers)),
    )


def _route_length(road: VectorMap, route: Sequence[str]) -> float:
    """Length of a route: of every block, the mean over its edges [m]."""
    total = 0.0
    for name in route:
        edges = road.block_edges.at(road.blocks.index[name]) if name in road.blocks.index else ()
        if len(edges):
            lengths = [road.baselines.arc[road.baselines.ptr[e + 1] - 1] for e in edges]
            total += float(np.mean(lengths))
    return total


def _passes_intersection(road: VectorMap, centers: FloatArray) -> bool:
    points = centers[::_INTERSECTION_STEP, :2].tolist()
    return any(len(road.intersections.containing(x, y)) > 0 for x, y in points)


def _interactions(scenario: Scenario, centers: FloatArray) -> float:
    """Mean over the moments of the number of agents that come close to the ego's path."""
    times = (scenario.iteration_times - scenario.iteration_times[0]) * 1e-6
    moments = [
        i for i in range(0, len(times), _EVERY) if i == 0 or times[i] + HORIZON <= times[-1] + 0.2
    ]
    return float(np.mean([_close_agents(scenario, centers, times, i) for i in moments]))


def _close_agents(scenario: Scenario, centers: FloatArray, times: FloatArray, at: int) -> int:
    tracks, row = scenario.tracks, int(scenario.iteration_rows[at])
    near = tracks.valid[row] & (tracks.kinds <= LAST_AGENT_KIND)
    near &= np.hypot(*(tracks.poses[row, :, :2] - centers[at, :2]).T) < _FAR
    poses, sizes = tracks.poses[row, near], tracks.sizes[row, near]
    if not len(poses):
        return 0
    velocity = np.nan_to_num(tracks.velocities[row, near])
    ahead = np.arange(0.0, HORIZON + 1e-9, HORIZON_STEP)
    predicted = np.repeat(poses[None], len(ahead), axis=0)
    predicted[..., :2] += ahead[:, None, None] * velocity
    boxes = np.broadcast_to(sizes, (len(ahead), *sizes.shape))
    corners = boxes_to_corners(
        np.ascontiguousarray(predicted.reshape(-1, 3)), np.ascontiguousarray(boxes.reshape(-1, 2))
    )
    end = int(np.searchsorted(times, times[at] + HORIZON + 1e-3, side="right"))
    driven = centers[at : max(end, at + 2), :2]
    if len(driven) < 2:
        driven = centers[-2:, :2]
    line = shapely.LineString(driven)
    distance = shapely.distance(shapely.polygons(corners), line).reshape(len(ahead), len(poses))
    return int(np.sum(distance.min(axis=0) <= REACH))
