"""PlanTF, and what its comparisons share with PLUTO's: features, inputs and outputs of networks."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from shiftsim.arrays import BoolArray
from shiftsim.planners.learned.features import EGO_LENGTH, EGO_WIDTH, SAMPLES, AgentFeatures
from shiftsim.planners.learned.map_features import RoadFeatures
from shiftsim.planners.learned.match import network_module
from shiftsim.planners.learned.plan_states import STEP, plan_of_poses
from shiftsim.planners.learned.plantf.planner import MAX_AGENTS, RADIUS, PlanTF, make_batch
from shiftsim.planners.learned.pluto.proposals import headings_of
from shiftsim.planners.proposals.tracker import STEPS
from shiftsim.verify.files import Source
from shiftsim.verify.nets.loops import PLAN_COLUMNS, PLANS, POSITION, Loop, verify_loop
from shiftsim.verify.nets.networks import FEATURE, OUTPUT, PROSE, make_network, verify_manifest
from shiftsim.verify.scenes import Scenes

Arrays: TypeAlias = dict[str, np.ndarray]

MOTION = 1e-5  # m/s, m/s^2: derivatives of the recorded poses
DERIVED_HEADING = 5e-4  # rad, arctangent of small vectors
RAW = ("trajectory", "probability", "prediction", "ref_free_trajectory")
UNSCALED = {"plantf": ("probability", "prediction")}  # the drive weights do not change these
SIZES = {"total_elements": "", "trainable_parameters": ""}  # fields of the manifests
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
OF_MAP = tuple(n for n in RoadFeatures._fields if INPUTS.get(n, "").startswith("map."))
CODES = {  # integers, stored as floats
    *(INPUTS[name] for name in ("category", "kind", "on_route", "light", "object_category")),
    "map.polygon_road_block_id",
}
HISTORIES = ("position", "heading", "velocity", "shape")  # of agents
ZEROS = {"agent.target", "reference_line.future_projection"}
_ROUNDING = 2.0**-22  # twice the relative error of a 32 bit float
_FEW = 0.01  # part of the values


def compare_features(
    loop: Loop,
    agents: AgentFeatures,
    road: RoadFeatures,
    route: tuple[int, ...],  # blocks of the corrected route
    others: Mapping[str, object],  # further features by name
) -> None:
    """Compare what is stored of one iteration that is made before the network."""
    scenario, ego = loop.scenario, loop.seen.history.ego[-1]
    ids = [*scenario.map.edges.ids, *scenario.map.crosswalks.ids]
    features = {
        "origin": ego[:2],
        "angle": ego[2],
        "agent.valid_mask": agents.valid,
        "agent.target": np.zeros((len(agents.valid), 0, 3)),
        "map.point_side": np.tile(np.arange(3), (len(road.kind), 1)),
        "map.polygon_position": road.points[:, 0, 0],
        "map.polygon_orientation": road.orientations[:, 0, 0],
        "map.valid_mask": road.valid,
        **{INPUTS[name]: getattr(road, name) for name in OF_MAP},
        **others,
    }
    loop.match(features, FEATURE, "feature/")
    names = {
        "agent_tokens": ["ego", *(scenario.tracks.tokens[i] for i in agents.tracks.tolist())],
        "map_ids": [ids[row] for row in road.objects.tolist()],
        "map_layers": LAYERS[road.kind],
        "corrected_route_ids": [scenario.map.blocks.ids[block] for block in route],
    }
    loop.match(names)
    # samples that are absent hold the origin of the map, seen from the ego
    cos, sin, there = np.cos(ego[2]), np.sin(ego[2]), agents.valid
    origin = np.array([-cos * ego[0] - sin * ego[1], sin * ego[0] - cos * ego[1]])
    absent = {"position": origin, "heading": -ego[2]}
    for name in HISTORIES:
        ours, theirs = getattr(agents, name), loop.stored[f"feature/agent.{name}"]
        loop.compare(f"agent.{name}", ours[there], theirs[there], FEATURE)
        rest = np.broadcast_to(absent.get(name, 0.0), theirs.shape)[~there]
        atol = FEATURE + _ROUNDING * float(np.abs(rest).max(initial=0.0))
        loop.compare(f"agent.{name} where absent", rest, theirs[~there], atol)


def network_outputs(planner: str, network: Any, inputs: Any) -> Arrays:
    """What the official network says of a batch, by the names of the files, and makes of that."""
    import torch

    with torch.inference_mode():
        out = network(inputs, predict=True) if planner == "plantf" else network(inputs)
        made = {name: getattr(out, name).numpy() for name in RAW if hasattr(out, name)}
        if planner == "pluto":
            made["hidden"] = network.hidden_proj(out.ego).numpy()
    poses, count = headings_of(made["trajectory"]), len(made["trajectory"])
    best = made["probability"].reshape(count, -1).argmax(axis=1)
    flat = poses.reshape(count, -1, *poses.shape[-2:])
    made["output_trajectory"] = flat[np.arange(count), best]
    if planner == "pluto":
        present = np.concatenate([inputs.position[:, 1:, -1], inputs.heading[:, 1:, -1:]], -1)
        motion = made["prediction"]
        predicted = headings_of(motion) + present[:, :, None]
        made["output_prediction"] = np.concatenate([predicted, motion[..., 4:]], -1)
        made["output_ref_free_trajectory"] = headings_of(made["ref_free_trajectory"])
        made["candidate_trajectories"] = poses
    return made


def compare_outputs(stored: Source, where: str, planner: str, variant: str, ours: Arrays) -> None:
    """Compare outputs, raw and derived, by name; headings of poses agree up to whole turns."""
    for name, value in ours.items():
        atol = OUTPUT["base" if name in UNSCALED.get(planner, ()) else variant]
        theirs, compare = stored[name], stored.report.compare
        if name.startswith(("output_", "candidate_")):
            headings, label = (value[..., 2], theirs[..., 2]), f"{planner} {name} heading"
            compare(label, where, *headings, atol=DERIVED_HEADING, angle=True)
            value, theirs = (np.delete(poses, 2, axis=-1) for poses in (value, theirs))
        compare(f"{planner} {name} ({variant})", where, value, theirs, atol=atol)


def compare_network(loop: Loop, batch: Any, *left_out: str) -> None:
    """Compare outputs for one iteration, but those which are too large and not stored."""
    made = network_outputs(loop.name, loop.planner.network, batch)
    ours = {name: value[0] for name, value in made.items() if name not in left_out}
    compare_outputs(loop.stored.below("net/"), loop.where, loop.name, loop.variant, ours)


def verify_forward(planner: str, radius: float, file: Source, scenes: Scenes, **args: Any) -> None:
    """Compare the network alone, on synthetic inputs as the official code batched them.

    `radius` [m] is that of the features, `args` differ from the network's released ones.
    """
    variant = str(file["meta/variant"])
    network, inputs = make_network(planner, variant, **args), _network_inputs(planner, file)
    ours = network_outputs(planner, network, inputs)
    compare_outputs(file.below("out/"), file.name, planner, variant, ours)
    _compare_inputs(file, planner, radius)
    file.note("the network does not read them", "in/origin", "in/angle")
    file.note("the network does not read the yaw rate, the last value of in/current_state")


def _network_inputs(planner: str, file: Source) -> Any:
    """A batch for the network, from arrays by the names of the official features."""
    import torch

    kind, arrays, values = network_module(planner).Inputs, file.below("in/"), {}
    for field in set(INPUTS) & {item.name for item in fields(kind)}:
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
        if INPUTS[field] in CODES:
            values[field] = values[field].long()
    return kind(**values)


def _compare_inputs(file: Source, planner: str, radius: float) -> None:
    """Check the arrays of a synthetic input against each other.

    The network reads one of two arrays that say the same, or neither. Points beyond `radius` [m]
    are not valid.
    """
    inputs = file.below("in/")
    given = {name: np.asarray(inputs[name], np.float64) for name in inputs}
    masks = {name: value > 0.0 for name, value in given.items() if name.endswith(".valid_mask")}
    gaps = _gaps(given, masks["agent.valid_mask"], masks["map.valid_mask"], radius)
    for name, value in given.items():  # padding is zero
        mask = masks.get(f"{name.partition('.')[0]}.valid_mask")
        if mask is not None:
            there = mask if value.shape[: mask.ndim] == mask.shape else mask.any(axis=-1)
            gaps[f"{name} where absent"] = value[~there]
    for name, gap in gaps.items():
        away = np.count_nonzero(np.abs(gap) > FEATURE) / max(gap.size, 1)
        if name.endswith("of agents") and away > _FEW:
            file.report.note(f"{file.name}: {name} (this input does not obey it)")
            continue
        label, where, angle = f"{planner} inputs", f"{file.name} {name}", "orientation" in name
        file.report.compare(label, where, gap, 0.0 * gap, atol=FEATURE, angle=angle)


def _gaps(given: Arrays, present: BoolArray, near: BoolArray, radius: float) -> Arrays:
    """What is 0 in every input: differences of what says the same, and what is always 0."""
    position, heading, velocity, shape = (given[f"agent.{name}"] for name in HISTORIES)
    points, center = given["map.point_position"], given["map.polygon_center"]
    exists, state = near.any(axis=-1), given["current_state"]
    limit, is_known = given["map.polygon_speed_limit"], given["map.polygon_has_speed_limit"]
    angles = given["map.point_orientation"]
    is_inside = (np.abs(points[:, :, 0]) < radius).all(axis=-1)
    # no rule, but nearly everywhere in a synthetic world
    moved = np.diff(position, axis=2) - velocity[:, :, :-1] * STEP
    aside = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
    gaps = {
        "map.point_side": (given["map.point_side"] - np.arange(3))[exists],
        "map.polygon_center": points[:, :, 0, 10] - center[..., :2],
        "map.polygon_center orientation": angles[:, :, 0, 10] - center[..., 2],
        "map.polygon_position": points[:, :, 0, 0] - given["map.polygon_position"],
        "map.polygon_orientation": angles[:, :, 0, 0] - given["map.polygon_orientation"],
        "map.polygon_speed_limit": limit * (1.0 - is_known),
        "map.valid_mask": 1.0 * (is_inside ^ near)[exists],
        "ego shape": shape[:, 0] - [EGO_WIDTH, EGO_LENGTH],
        "ego speed": state[:, 3] - velocity[:, 0, -1, 0],
        "ego position": position[:, 0, -1],
        "ego heading": heading[:, 0, -1],
        "ego category": given["agent.category"][:, 0],
        "ego current_state": state[:, :3],
        "ego valid_mask": 1.0 - present[:, 0],
        "motion of agents": moved[present[..., 1:] & present[..., :-1]],
        "headings of agents": aside[present],
        "shapes of agents": (shape - shape[:, :, -1:])[present],
        **{f"{name} code": given[name] - np.rint(given[name]) for name in CODES & set(given)},
        **{name: given[name] for name in ZEROS & set(given)},
    }
    for start, mask in (("map.point_", ""), ("reference_line.", "reference_line.valid_mask")):
        if f"{start}vector" in given:
            steps, angles = given[f"{start}vector"], given[f"{start}orientation"]
            gap = np.diff(given[f"{start}position"], axis=-2) - steps[..., :-1, :]
            gaps[f"{start}vector"] = gap * given[mask][..., 1:, None] if mask else gap
            gaps[f"{start}orientation"] = np.arctan2(steps[..., 1], steps[..., 0]) - angles
    return gaps


def manifest_of(network: Any, **builder: object) -> dict[str, Any]:
    """Fields of `state_dict.json`; `builder` are the planner's settings of the features."""
    heads = {
        layer: {"C": len(head.gain), **{name: list(v) for name, v in asdict(head).items()}}
        for layer, head in network.DRIVE_HEADS.items()
    }
    scale = getattr(network, "DRIVE_SCALES", {})
    prose = dict.fromkeys(("container", "loading", "other_entries"), PROSE)
    history, future = (SAMPLES - 1) * STEP, STEPS * STEP
    times = {"history_horizon": history, "future_horizon": future, "sample_interval": STEP}
    return {
        "checkpoint": {"weights_under": "state_dict", "prefix": network.PREFIXES[0], **prose},
        "hyper_parameters": network.RELEASED,
        "feature_builder": times | builder,
        "drive_overrides": {"meaning": PROSE, "heads": heads, "scale": scale},
    }


def _compare(loop: Loop) -> None:
    """Compare features, raw outputs and plan of one iteration."""
    loop.compare_plan(POSITION)
    theirs = loop.row["trajectory"]
    again = plan_of_poses(theirs[1:, :3], loop.seen.history).states[:, 3:PLAN_COLUMNS]
    loop.compare("motion of the recorded plan", again, theirs[:, 3:], MOTION)
    if not list(loop.stored):
        return
    features = loop.features
    # the official code gives every agent the category of the ego at inference
    categories = np.zeros(len(features.agents.valid), np.int64)
    others = {"current_state": features.current_state, "agent.category": categories}
    compare_features(loop, features.agents, features.road, features.route, others)
    compare_network(loop, make_batch([features], "cpu"))


_BUILDER = {"radius": RADIUS, "max_agents": MAX_AGENTS}
FILES = {
    "state_dict.json": partial(
        verify_manifest, PlanTF.name, SIZES, partial(manifest_of, **_BUILDER)
    ),
    "forward_*.npz": partial(verify_forward, PlanTF.name, RADIUS),
    "closed_loop_*.npz": partial(verify_loop, PlanTF, _compare, PLANS),
}
