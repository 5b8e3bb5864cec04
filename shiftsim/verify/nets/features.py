"""Comparisons of the features which PlanTF and PLUTO share: agents and road objects."""

import re

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.geometry.frames import wrap_angles
from shiftsim.planners.learned.features import EGO_LENGTH, EGO_WIDTH, AgentFeatures
from shiftsim.planners.learned.map_features import RoadFeatures
from shiftsim.planners.learned.plan_states import STEP
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nets.common import FEATURE, Loop
from shiftsim.verify.report import Report
from shiftsim.world.map import VectorMap

LAYERS = np.array(["LANE", "LANE_CONNECTOR", "CROSSWALK"])
_ROUNDING = 2.0**-22  # twice the relative error of a 32 bit float
_FEW = 0.01  # part of the values


def feature_iterations(file: ArrayFile) -> list[int]:
    """Iterations whose features are stored, from the names `itNN/…`."""
    found = {match[1] for name in file.arrays if (match := re.match(r"it(\d+)/", name))}
    return sorted(int(number) for number in found)


def compare_origin(loop: Loop, iteration: int, planner: str) -> None:
    """Compare the frame of the features."""
    at, where = f"it{iteration:02d}/feature", f"iteration {iteration}"
    ego = loop.ego[iteration]
    loop.compare(f"{planner} origin", where, ego[:2], loop.file[f"{at}/origin"], FEATURE)
    loop.compare(f"{planner} angle", where, ego[2], loop.file[f"{at}/angle"], FEATURE)


def compare_agents(loop: Loop, iteration: int, agents: AgentFeatures, planner: str) -> None:
    """Compare the histories of the ego and the agents, and which agents they are."""
    file, where = loop.file, f"iteration {iteration}"
    at = f"it{iteration:02d}"
    tokens = ["ego", *(loop.scenario.tracks.tokens[i] for i in agents.tracks.tolist())]
    loop.compare(f"{planner} agent tokens", where, tokens, file[f"{at}/agent_tokens"].tolist())
    valid = file[f"{at}/feature/agent.valid_mask"]
    loop.compare(f"{planner} agent.valid_mask", where, agents.valid, valid)
    for name, ours, absent in (
        ("position", agents.position, _seen_from(loop.ego[iteration])),
        ("heading", agents.heading, -loop.ego[iteration, 2]),
        ("velocity", agents.velocity, 0.0),
        ("shape", agents.shape, 0.0),
    ):
        theirs = file[f"{at}/feature/agent.{name}"]
        if ours.shape != theirs.shape or valid.shape != agents.valid.shape:
            loop.compare(f"{planner} agent.{name}", where, ours, theirs)
            continue
        there = agents.valid
        loop.compare(f"{planner} agent.{name}", where, ours[there], theirs[there], FEATURE)
        # samples that are absent hold the transformed origin of the map
        rest = np.broadcast_to(absent, theirs.shape)[~there]
        atol = FEATURE + _ROUNDING * float(np.abs(rest).max(initial=0.0))
        loop.compare(f"{planner} agent.{name} where absent", where, rest, theirs[~there], atol)
    target = file[f"{at}/feature/agent.target"]
    loop.compare(f"{planner} agent.target", where, np.zeros((len(tokens), 0, 3)), target)


def _seen_from(ego: FloatArray) -> FloatArray:
    """The origin of the map in the ego frame."""
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    return np.array([-cos * ego[0] - sin * ego[1], sin * ego[0] - cos * ego[1]])


def compare_road(loop: Loop, iteration: int, road: RoadFeatures, planner: str) -> None:
    """Compare the road objects, and which ones they are."""
    file, where = loop.file, f"iteration {iteration}"
    at = f"it{iteration:02d}"
    ids = [object_id(loop.scenario.map, row) for row in road.objects.tolist()]
    loop.compare(f"{planner} map ids", where, ids, file[f"{at}/map_ids"].tolist())
    layers = LAYERS[road.kind].tolist()
    loop.compare(f"{planner} map layers", where, layers, file[f"{at}/map_layers"].tolist())
    ours = {
        "point_position": road.points,
        "point_vector": road.vectors,
        "point_orientation": road.orientations,
        "point_side": np.tile([0, 1, 2], (len(ids), 1)),
        "polygon_center": road.centers,
        "polygon_position": road.points[:, 0, 0],
        "polygon_orientation": road.orientations[:, 0, 0],
        "polygon_type": road.kind,
        "polygon_on_route": road.on_route,
        "polygon_tl_status": road.light,
        "polygon_has_speed_limit": road.has_limit,
        "polygon_speed_limit": road.limit,
        "valid_mask": road.valid,
    }
    for name, mine in ours.items():
        theirs = file[f"{at}/feature/map.{name}"]
        atol = FEATURE if mine.dtype.kind == "f" else 0.0
        loop.compare(f"{planner} map.{name}", where, mine, theirs, atol)


def object_id(road: VectorMap, row: int) -> str:
    """Id of a road object."""
    edges = len(road.edges)
    return road.edges.ids[row] if row < edges else road.crosswalks.ids[row - edges]


def compare_relations(file: ArrayFile, report: Report, planner: str, radius: float) -> None:
    """Check the arrays of a synthetic input against each other.

    The network reads one of two arrays that say the same, or neither.

    Args:
        file: The file.
        report: Receives the comparisons.
        planner: Name of the planner, for the report.
        radius: Beyond which points are not valid [m].
    """

    def check(name: str, ours: np.ndarray, theirs: np.ndarray, atol: float = 0.0) -> None:
        report.compare(f"{planner} input {name}", file.name, ours, theirs, atol=atol)

    def check_mostly(name: str, gaps: np.ndarray) -> None:
        """Check what follows from no rule, where nearly all of a synthetic world obeys it."""
        if np.count_nonzero(np.abs(gaps) > FEATURE) > _FEW * gaps.size:
            report.note(f"{file.name}: {name} (this input does not obey it)")
        else:
            check(name, gaps, np.zeros_like(gaps), FEATURE)

    def agent(name: str) -> np.ndarray:
        return file[f"in/agent.{name}"].astype(np.float64)

    def road(name: str) -> np.ndarray:
        return file[f"in/map.{name}"].astype(np.float64)

    valid = np.asarray(road("valid_mask").max(axis=-1, initial=0.0) > 0.0)
    present = np.asarray(agent("valid_mask") > 0.0)
    points, vectors = road("point_position"), road("point_vector")
    angles = road("point_orientation")
    turned = wrap_angles(angles - np.arctan2(vectors[..., 1], vectors[..., 0]))
    check("map.point_orientation", turned[valid], np.zeros_like(turned[valid]), FEATURE)
    check("map.point_vector", np.diff(points, axis=3), vectors[..., :-1, :], FEATURE)
    check("map.point_side", np.where(valid[..., None], [0, 1, 2], 0), road("point_side"))
    center = np.concatenate([points[:, :, 0, 10], angles[:, :, 0, 10:11]], axis=-1)
    check("map.polygon_center", center, road("polygon_center"), FEATURE)
    check("map.polygon_position", points[:, :, 0, 0], road("polygon_position"), FEATURE)
    start = wrap_angles(angles[:, :, 0, 0] - road("polygon_orientation"))
    check("map.polygon_orientation", start, np.zeros_like(start), FEATURE)
    unlimited = road("polygon_has_speed_limit") == 0
    check("map.polygon_speed_limit", road("polygon_speed_limit")[unlimited], 0.0 * start[unlimited])
    # padding is zero
    for name in ("position", "velocity", "shape", "heading"):
        rest = agent(name)[~present]
        check(f"agent.{name} where absent", np.zeros_like(rest), rest)
    rest = agent("category")[~present.any(axis=-1)]
    check("agent.category where absent", np.zeros_like(rest), rest)
    for path in sorted(file.arrays):
        if path.startswith("in/map."):
            rest = file[path][~valid]
            check(f"{path[3:]} where absent", np.zeros_like(rest), rest)
    size = agent("shape")[:, 0]
    check("ego shape", np.broadcast_to([EGO_WIDTH, EGO_LENGTH], size.shape), size, FEATURE)
    for name, now in (
        ("position", agent("position")[:, 0, -1]),
        ("heading", agent("heading")[:, 0, -1]),
        ("category", agent("category")[:, 0]),
        ("current_state", file["in/current_state"][:, :3]),
    ):
        check(f"ego {name}", np.zeros(now.shape), now)
    check("ego valid_mask", np.ones_like(present[:, 0]), present[:, 0])
    near = (np.abs(points[:, :, 0]) < radius).all(-1)
    check("map.valid_mask", near[valid], road("valid_mask")[valid] > 0.0)
    velocity = agent("velocity")
    check("ego speed", file["in/current_state"][:, 3], velocity[:, 0, -1, 0], FEATURE)
    both = present[..., 1:] & present[..., :-1]
    moved = np.diff(agent("position"), axis=2) - velocity[:, :, :-1] * STEP
    check_mostly("motion of agents", moved[both])
    heading = agent("heading")
    aside = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
    check_mostly("headings of agents", aside[present])
    check_mostly("shapes of agents", (agent("shape") - agent("shape")[:, :, -1:])[present])
    target = file["in/agent.target"]
    check("agent.target", np.zeros((*present.shape[:2], 0, 3)), target)
