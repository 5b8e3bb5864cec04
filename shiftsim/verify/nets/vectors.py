"""What the comparisons of PlanTF and PLUTO share: features, inputs and outputs of their networks."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from shiftsim.geometry.frames import wrap_angles
from shiftsim.planners.learned.features import EGO_LENGTH, EGO_WIDTH, SAMPLES, AgentFeatures
from shiftsim.planners.learned.map_features import RoadFeatures
from shiftsim.planners.learned.match import network_module
from shiftsim.planners.learned.plan_states import STEP
from shiftsim.planners.learned.pluto.proposals import STEPS, headings_of
from shiftsim.verify.files import Source, read_arrays
from shiftsim.verify.nets.loops import Step
from shiftsim.verify.nets.networks import (
    FEATURE,
    OUTPUT,
    make_network,
    num_elements,
    verify_manifest,
)
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes

Arrays: TypeAlias = Mapping[str, np.ndarray]

DERIVED_HEADING = 5e-4  # rad, arctangent of small vectors
RAW = ("trajectory", "probability", "prediction", "ref_free_trajectory")
UNSCALED = {"plantf": ("probability", "prediction")}  # the drive weights do not change these
LAYERS = np.array(["LANE", "LANE_CONNECTOR", "CROSSWALK"])
STATE_CHANNELS = 6  # of the current state; the yaw rate behind them is not read
INPUTS = {  # field of the networks' inputs → array of the files
    "position": "agent.position",
    "heading": "agent.heading",
    "velocity": "agent.velocity",
    "shape": "agent.shape",
    "valid": "agent.valid_mask",
    "category": "agent.category",
    "current_state": "current_state",
    "points": "map.point_position",
    "vectors": "map.point_vector",
    "orientations": "map.point_orientation",
    "centers": "map.polygon_center",
    "kind": "map.polygon_type",
    "on_route": "map.polygon_on_route",
    "light": "map.polygon_tl_status",
    "has_limit": "map.polygon_has_speed_limit",
    "limit": "map.polygon_speed_limit",
    "point_valid": "map.valid_mask",
    "object_pose": "static_objects.pose",
    "object_shape": "static_objects.shape",
    "object_category": "static_objects.category",
    "object_valid": "static_objects.valid_mask",
    "line_points": "reference_line.position",
    "line_vectors": "reference_line.vector",
    "line_orientations": "reference_line.orientation",
    "line_valid": "reference_line.valid_mask",
}
CODES = ("category", "kind", "on_route", "light", "object_category")  # integers, stored as floats
_ROUNDING = 2.0**-22  # twice the relative error of a 32 bit float
_FEW = 0.01  # part of the values


def compare_features(
    step: Step,
    agents: AgentFeatures,
    road: RoadFeatures,
    route: tuple[int, ...],
    others: Mapping[str, object],
) -> None:
    """Compare what is stored of one iteration that is made before the network.

    Args:
        step: The iteration.
        agents: The ego and the agents.
        road: Lanes, connectors and crosswalks.
        route: Blocks of the corrected route.
        others: Further features by name.
    """
    scenario, ego = step.loop.scenario, step.seen.history.ego[-1]
    ids = [*scenario.map.edges.ids, *scenario.map.crosswalks.ids]
    features = {
        "origin": ego[:2],
        "angle": ego[2],
        "agent.valid_mask": agents.valid,
        "agent.target": np.zeros((len(agents.valid), 0, 3)),
        "map.point_position": road.points,
        "map.point_vector": road.vectors,
        "map.point_orientation": road.orientations,
        "map.point_side": np.tile(np.arange(3), (len(road.kind), 1)),
        "map.polygon_center": road.centers,
        "map.polygon_position": road.points[:, 0, 0],
        "map.polygon_orientation": road.orientations[:, 0, 0],
        "map.polygon_type": road.kind,
        "map.polygon_on_route": road.on_route,
        "map.polygon_tl_status": road.light,
        "map.polygon_has_speed_limit": road.has_limit,
        "map.polygon_speed_limit": road.limit,
        "map.valid_mask": road.valid,
        **others,
    }
    step.match({f"feature/{name}": value for name, value in features.items()}, FEATURE)
    step.match(
        {
            "agent_tokens": ["ego", *(scenario.tracks.tokens[i] for i in agents.tracks.tolist())],
            "map_ids": [ids[row] for row in road.objects.tolist()],
            "map_layers": LAYERS[road.kind],
            "corrected_route_ids": [scenario.map.blocks.ids[block] for block in route],
        }
    )
    # samples that are absent hold the origin of the map, seen from the ego
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    origin = np.array([-cos * ego[0] - sin * ego[1], sin * ego[0] - cos * ego[1]])
    there, absent = agents.valid, {"position": origin, "heading": -ego[2]}
    for name in ("position", "heading", "velocity", "shape"):
        ours, theirs = getattr(agents, name), step.stored[f"feature/agent.{name}"]
        step.compare(f"agent.{name}", ours[there], theirs[there], FEATURE)
        rest = np.broadcast_to(absent.get(name, 0.0), theirs.shape)[~there]
        atol = FEATURE + _ROUNDING * float(np.abs(rest).max(initial=0.0))
        step.compare(f"agent.{name} where absent", rest, theirs[~there], atol)


def network_inputs(planner: str, arrays: Source) -> Any:
    """A batch for the network, from arrays by the names of the official features."""
    import torch

    kind = network_module(planner).Inputs
    values = {}
    for field in set(INPUTS) & set(kind._fields):
        if field == "object_pose":
            pose = (arrays["static_objects.position"], arrays["static_objects.heading"][..., None])
            array = np.concatenate(pose, axis=-1)
        else:
            array = arrays[INPUTS[field]]
        if field in ("vectors", "orientations") or (field == "points" and planner == "plantf"):
            array = array[:, :, 0]  # of the centre line
        elif field == "current_state":
            array = array[:, :STATE_CHANNELS]
        values[field] = torch.from_numpy(np.ascontiguousarray(array))
        if field in CODES:
            values[field] = values[field].long()
    return kind(**values)


def run_network(planner: str, network: Any, inputs: Any) -> dict[str, Any]:
    """Raw outputs for a batch by their names in the files."""
    import torch

    with torch.inference_mode():
        out = network(inputs, predict=True) if planner == "plantf" else network(inputs)
        raw = {name: getattr(out, name).numpy() for name in RAW if hasattr(out, name)}
        if planner == "pluto":
            raw["hidden"] = network.hidden_proj(out.ego).numpy()
    return raw


def derived_outputs(raw: Mapping[str, Any], present: Any) -> dict[str, Any]:
    """What the official network makes of its raw outputs for one scene.

    Args:
        raw: Arrays by their names in the files, without the axis of the batch.
        present: (A, 3) poses of the agents now.
    """
    poses, best = headings_of(raw["trajectory"]), int(raw["probability"].argmax())
    derived = {"output_trajectory": poses.reshape(-1, *poses.shape[-2:])[best]}
    if "ref_free_trajectory" in raw:  # PLUTO
        motion = raw["prediction"]
        predicted = headings_of(motion) + present[:, None]
        derived["output_prediction"] = np.concatenate([predicted, motion[..., 4:]], -1)
        derived["output_ref_free_trajectory"] = headings_of(raw["ref_free_trajectory"])
        derived["candidate_trajectories"] = poses
    return derived


def compare_outputs(
    stored: Source, where: str, planner: str, variant: str, ours: Mapping[str, Any]
) -> None:
    """Compare outputs, raw and derived, by name; headings of poses agree up to whole turns."""
    for name, value in ours.items():
        label = f"{planner} {name} ({variant})"
        atol = OUTPUT["base" if name in UNSCALED.get(planner, ()) else variant]
        theirs, others = stored[name], [i for i in range(value.shape[-1]) if i != 2]
        if not name.startswith(("output_", "candidate_")):
            stored.report.compare(label, where, value, theirs, atol=atol)
            continue
        stored.report.compare(label, where, value[..., others], theirs[..., others], atol=atol)
        turn = wrap_angles((value[..., 2] - theirs[..., 2]).astype(np.float64))
        label = f"{planner} {name} heading"
        stored.report.compare(label, where, turn, np.zeros(turn.shape), atol=DERIVED_HEADING)


def verify_forward(
    path: Path, report: Report, scenes: Scenes, planner: str, radius: float, **args: Any
) -> None:
    """Compare the network alone, on synthetic inputs as the official code batched them.

    Args:
        path: The file.
        report: Receives the comparisons.
        planner: Name of the planner.
        radius: Beyond which points are not valid [m].
        args: Hyper-parameters of the network that differ from the released ones.
    """
    file = read_arrays(path, report)
    variant = str(file["meta/variant"])
    inputs = network_inputs(planner, file.below("in/"))
    ours = run_network(planner, make_network(planner, variant, **args), inputs)
    position, heading = file["in/agent.position"], file["in/agent.heading"]
    present = np.concatenate([position[:, 1:, -1], heading[:, 1:, -1:]], -1)
    derived = [
        derived_outputs({name: value[row] for name, value in ours.items()}, here)
        for row, here in enumerate(present)
    ]
    ours |= {name: np.stack([scene[name] for scene in derived]) for name in derived[0]}
    compare_outputs(file.below("out/"), file.name, planner, variant, ours)
    compare_inputs(file, planner, radius)
    file.note("the network does not read them", "in/origin", "in/angle")
    file.note("the network does not read the yaw rate, the last value of in/current_state")
    file.finish()


def verify_vector_manifest(
    path: Path, report: Report, scenes: Scenes, planner: str, **builder: object
) -> None:
    """Compare `state_dict.json`; `builder` are settings of the features that the planners differ in."""
    module = network_module(planner)
    network = module.build_network()
    heads = {
        layer: {"C": len(head.gain), **{name: list(v) for name, v in asdict(head).items()}}
        for layer, head in module.DRIVE_HEADS.items()
    }
    features = {
        "history_horizon": (SAMPLES - 1) * STEP,
        "future_horizon": STEPS * STEP,
        "sample_interval": STEP,
        **builder,
    }
    others = {  # the rest of the checkpoint's description is prose, and so is the meaning of heads
        "checkpoint": lambda given: {
            **given,
            "weights_under": "state_dict",
            "prefix": module.PREFIXES[0],
        },
        "hyper_parameters": module.RELEASED,
        "feature_builder": features,
        "total_elements": num_elements(network.state_dict().values()),
        "trainable_parameters": num_elements(network.parameters()),
        "drive_overrides": lambda given: {
            "meaning": given["meaning"],
            "heads": heads,
            "scale": getattr(module, "DRIVE_SCALES", {}),
        },
    }
    verify_manifest(path, report, planner, others)


def compare_inputs(file: Source, planner: str, radius: float) -> None:
    """Check the arrays of a synthetic input against each other.

    The network reads one of two arrays that say the same, or neither.

    Args:
        file: The file.
        planner: Name of the planner.
        radius: Beyond which points are not valid [m].
    """
    names = list(file.below("in/"))
    given = {name: np.asarray(file[f"in/{name}"], np.float64) for name in names}
    masks = {
        name.partition(".")[0]: value > 0.0
        for name, value in given.items()
        if name.endswith(".valid_mask")
    }
    for name, value in given.items():  # padding is zero
        mask = masks.get(name.partition(".")[0])
        if mask is not None:
            there = mask if value.shape[: mask.ndim] == mask.shape else mask.any(axis=-1)
            _check(file, planner, f"{name} where absent", value[~there], 0.0)
    _check_equal(file, planner, given, masks, radius)
    for name, gaps in _angle_gaps(given).items():
        _check(file, planner, name, wrap_angles(gaps), 0.0)
    for name, gaps in _motion_gaps(given, masks["agent"]).items():
        if np.count_nonzero(np.abs(gaps) > FEATURE) > _FEW * gaps.size:
            file.report.note(f"{file.name}: {name} (this input does not obey it)")
        else:
            _check(file, planner, name, gaps, 0.0)


def _check(file: Source, planner: str, name: str, ours: Any, theirs: Any) -> None:
    theirs = np.broadcast_to(theirs, np.shape(ours)) if np.ndim(theirs) == 0 else theirs
    label = f"{planner} inputs"
    file.report.compare(label, f"{file.name} {name}", ours, theirs, atol=FEATURE)


def _check_equal(file: Source, planner: str, given: Arrays, masks: Arrays, radius: float) -> None:
    """What follows from other inputs, or is always the same."""
    points, center = given["map.point_position"], given["map.polygon_center"]
    exists, limit = masks["map"].any(axis=-1), given["map.polygon_speed_limit"]
    near = (np.abs(points[:, :, 0]) < radius).all(axis=-1)
    state, count = given["current_state"], given["agent.category"].shape
    made = {
        "map.point_vector": (np.diff(points, axis=3), given["map.point_vector"][..., :-1, :]),
        "map.point_side": (np.where(exists[..., None], np.arange(3), 0), given["map.point_side"]),
        "map.polygon_center": (points[:, :, 0, 10], center[..., :2]),
        "map.polygon_position": (points[:, :, 0, 0], given["map.polygon_position"]),
        "map.valid_mask": (near[exists], masks["map"][exists]),
        "map.polygon_speed_limit": (limit * given["map.polygon_has_speed_limit"], limit),
        "agent.target": (np.zeros((*count, 0, 3)), given["agent.target"]),
        "ego shape": (
            given["agent.shape"][:, 0] * 0.0 + np.array([EGO_WIDTH, EGO_LENGTH]),
            given["agent.shape"][:, 0],
        ),
        "ego speed": (state[:, 3], given["agent.velocity"][:, 0, -1, 0]),
        "ego position": (given["agent.position"][:, 0, -1], 0.0),
        "ego heading": (given["agent.heading"][:, 0, -1], 0.0),
        "ego category": (given["agent.category"][:, 0], 0.0),
        "ego current_state": (state[:, :3], 0.0),
        "ego valid_mask": (given["agent.valid_mask"][:, 0], 1.0),
    }
    for field in CODES:
        if INPUTS[field] in given:
            codes = given[INPUTS[field]]
            made[f"{INPUTS[field]} code"] = (np.rint(codes), codes)
    if "reference_line.vector" in given:
        pairs = given["reference_line.valid_mask"][..., 1:, None]
        steps = given["reference_line.vector"][..., :-1, :]
        lines = np.diff(given["reference_line.position"], axis=-2)
        blocks = given["map.polygon_road_block_id"]
        made["reference_line.vector"] = (lines * pairs, steps * pairs)
        made["reference_line.future_projection"] = (given["reference_line.future_projection"], 0.0)
        made["map.polygon_road_block_id"] = (np.rint(blocks), blocks)
    for name, (ours, theirs) in made.items():
        _check(file, planner, name, ours, theirs)


def _angle_gaps(given: Arrays) -> Arrays:
    """Differences of angles that are 0 up to whole turns [rad]."""
    angles = given["map.point_orientation"]
    made = {
        "map.point_orientation": _angles(given["map.point_vector"]) - angles,
        "map.polygon_center orientation": angles[:, :, 0, 10] - given["map.polygon_center"][..., 2],
        "map.polygon_orientation": angles[:, :, 0, 0] - given["map.polygon_orientation"],
    }
    if "reference_line.vector" in given:
        vectors, lines = given["reference_line.vector"], given["reference_line.orientation"]
        made["reference_line.orientation"] = _angles(vectors) - lines
    return made


def _motion_gaps(given: Arrays, present: np.ndarray) -> Arrays:
    """What is 0 by no rule, but nearly everywhere in a synthetic world."""
    velocity, heading = given["agent.velocity"], given["agent.heading"]
    both = present[..., 1:] & present[..., :-1]
    moved = np.diff(given["agent.position"], axis=2) - velocity[:, :, :-1] * STEP
    aside = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
    shape = given["agent.shape"]
    return {
        "motion of agents": moved[both],
        "headings of agents": aside[present],
        "shapes of agents": (shape - shape[:, :, -1:])[present],
    }


def _angles(vectors: np.ndarray) -> np.ndarray:
    angles: np.ndarray = np.arctan2(vectors[..., 1], vectors[..., 0])
    return angles
