"""PlanTF, and what its comparisons share with PLUTO's: features, inputs and outputs of networks."""

from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np

from shiftsim.planners.learned import features as builder
from shiftsim.planners.learned.match import network_module
from shiftsim.planners.learned.plan_states import STEP, plan_of_poses
from shiftsim.planners.learned.plantf import planner as plantf
from shiftsim.planners.learned.pluto.proposals import headings_of
from shiftsim.verify.files import Source
from shiftsim.verify.nets.loops import FEATURE, PLAN_COLUMNS, PLANS, POSITION, Loop, verify_loop
from shiftsim.verify.nets.networks import make_network, verify_manifest
from shiftsim.verify.scenes import Scenes
from shiftsim.verify.tables import read_tables

TABLES = read_tables(__file__)
MOTION = 1e-5  # m/s, m/s^2: derivatives of the recorded poses
OUTPUT = {"base": 2e-5, "drive": 5e-4}  # the drive weights scale up what they say
DERIVED_HEADING = 5e-4  # rad, arctangent of small vectors
UNSCALED = {"plantf": ("probability", "prediction")}  # the drive weights do not change these
LAYERS = np.array(["LANE", "LANE_CONNECTOR", "CROSSWALK"])
ARRAY = TABLES["inputs"].rows  # of the files, by the field of the networks' inputs
CODES = {  # integers, stored as floats
    *(ARRAY[field] for field in ("category", "kind", "on_route", "light", "object_category")),
    "map.polygon_road_block_id",
}
HISTORIES = ("position", "heading", "velocity", "shape")  # of agents
STATE_CHANNELS = 6  # of the current state; the yaw rate behind them is not read
_ROUNDING = 2.0**-22  # twice the relative error of a 32 bit float
_FEW = 0.01  # part of the values


def compare_features(loop: Loop, agents: Any, road: Any, route: Any, **names: Any) -> None:
    """Compare what is stored of one iteration that is made before the network.

    `route` are blocks of the corrected route; `names` are further ones of the table.
    """
    ego, there = loop.seen.history.ego[-1], agents.valid
    ids = [*loop.road.edges.ids, *loop.road.crosswalks.ids]
    ours = {
        **{"agents": agents, "near": road, "ego": ego, "route": route, "layers": LAYERS[road.kind]},
        "agent_tokens": ["ego", *(loop.tracks.tokens[i] for i in agents.tracks.tolist())],
        "map_ids": [ids[row] for row in road.objects.tolist()],
        "targets": np.zeros((len(there), 0, 3)),
        "sides": np.tile(np.arange(3), (len(road.kind), 1)),
    }
    loop.match(TABLES["ids"], loop.stored, **ours)
    loop.match(TABLES["features"], loop.stored.below("feature/"), **ours, **names)
    # samples that are absent hold the origin of the map, seen from the ego
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    origin = np.array([-cos * ego[0] - sin * ego[1], sin * ego[0] - cos * ego[1]])
    absent = {"position": origin, "heading": -ego[2], "velocity": 0.0, "shape": 0.0}
    for name, value in absent.items():
        made, theirs = getattr(agents, name), loop.stored[f"feature/agent.{name}"]
        loop.compare(f"agent.{name}", made[there], theirs[there], FEATURE)
        rest = np.broadcast_to(value, theirs.shape)[~there]
        atol = FEATURE + _ROUNDING * float(np.abs(rest).max(initial=0.0))
        loop.compare(f"agent.{name} where absent", rest, theirs[~there], atol)


def network_outputs(planner: str, network: Any, inputs: Any) -> dict[str, np.ndarray]:
    """What the official network says of a batch, by the names of the files, and makes of that."""
    import torch

    with torch.inference_mode():
        out = network(inputs, predict=True) if planner == "plantf" else network(inputs)
        made = {name: value.numpy() for name, value in out._asdict().items() if name != "ego"}
        if planner == "pluto":
            made["hidden"] = network.hidden_proj(out.ego).numpy()
    poses, count = headings_of(made["trajectory"]), len(made["trajectory"])
    best = made["probability"].reshape(count, -1).argmax(axis=1)
    flat = poses.reshape(count, -1, *poses.shape[-2:])
    made["output_trajectory"] = flat[np.arange(count), best]
    if planner == "pluto":
        present = np.concatenate([inputs.position[:, 1:, -1], inputs.heading[:, 1:, -1:]], -1)
        predicted = headings_of(made["prediction"]) + present[:, :, None]
        made["output_prediction"] = np.concatenate([predicted, made["prediction"][..., 4:]], -1)
        made["output_ref_free_trajectory"] = headings_of(made["ref_free_trajectory"])
        made["candidate_trajectories"] = poses
    return made


def compare_outputs(
    stored: Source, where: str, planner: str, variant: str, ours: dict[str, np.ndarray]
) -> None:
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
    import torch

    kind, variant = network_module(planner).Inputs, str(file["meta/variant"])
    stored = file.below("in/")
    given = {name: np.asarray(stored[name]) for name in stored}
    read = {**given, "current_state": given["current_state"][:, :STATE_CHANNELS]}
    for name in ("vector", "orientation", *(["position"] if planner == "plantf" else [])):
        read[f"map.point_{name}"] = given[f"map.point_{name}"][:, :, 0]  # of the centre line
    if planner == "pluto":
        pose = [given[f"static_objects.{name}"] for name in ("position", "heading")]
        read["static_objects.pose"] = np.dstack(pose)
    tensors = {}
    for field in {field.name for field in fields(kind)} & set(ARRAY):
        tensor = torch.from_numpy(np.ascontiguousarray(read[ARRAY[field]]))
        tensors[field] = tensor.long() if ARRAY[field] in CODES else tensor
    ours = network_outputs(planner, make_network(planner, variant, **args), kind(**tensors))
    compare_outputs(file.below("out/"), file.name, planner, variant, ours)
    _compare_inputs(file, planner, given, radius)
    file.note("the network does not read them", "in/origin", "in/angle")
    file.note("the network does not read the yaw rate, the last value of in/current_state")


def _compare_inputs(file: Source, planner: str, stored: dict[str, Any], radius: float) -> None:
    """Check the arrays of a synthetic input against each other.

    The network reads one of two arrays that say the same, or neither. Points beyond `radius` [m]
    are not valid.
    """
    given = {name: array.astype(np.float64) for name, array in stored.items()}
    ours = {name: np.rint(a) if name in CODES else a.copy() for name, a in given.items()}
    for name, array in ours.items():  # padding is zero
        mask = given.get(f"{name.partition('.')[0]}.valid_mask")
        if mask is not None:
            there = mask if array.shape[: mask.ndim] == mask.shape else mask.any(axis=-1)
            array *= there.reshape(*there.shape, *[1] * (array.ndim - there.ndim))
    points, angles = (given[f"map.point_{name}"][:, :, 0] for name in ("position", "orientation"))
    exists = given["map.valid_mask"].any(axis=-1)[..., None]
    ours["map.point_side"] = exists * np.arange(3.0)
    ours["map.polygon_position"], ours["map.polygon_orientation"] = points[:, :, 0], angles[..., 0]
    ours["map.polygon_center"] = np.dstack([points[:, :, 10], angles[..., 10]])
    ours["map.polygon_speed_limit"] *= given["map.polygon_has_speed_limit"]
    ours["map.valid_mask"] = exists * (np.abs(points) < radius).all(axis=-1)
    for part in ("map.point_", "reference_line."):
        if f"{part}vector" in given:
            vectors, steps = given[f"{part}vector"], np.diff(given[f"{part}position"], axis=-2)
            there = given.get(f"{part}valid_mask", np.ones(vectors.shape[:-1]))[..., 1:] > 0.0
            ours[f"{part}vector"][..., :-1, :][there] = steps[there]
            ours[f"{part}orientation"] = np.arctan2(vectors[..., 1], vectors[..., 0])
    position, heading, velocity, shape = (given[f"agent.{name}"] for name in HISTORIES)
    ours["agent.position"][:, 0, -1] = ours["agent.heading"][:, 0, -1] = 0.0
    ours["agent.shape"][:, 0] = builder.EGO_WIDTH, builder.EGO_LENGTH
    ours["agent.category"][:, 0], ours["agent.valid_mask"][:, 0] = 0.0, 1.0
    ours["current_state"][:, :3], ours["current_state"][:, 3] = 0.0, velocity[:, 0, -1, 0]
    for name in {"agent.target", "reference_line.future_projection"} & set(ours):
        ours[name] = 0.0 * ours[name]
    # no rule, but nearly everywhere in a synthetic world
    present = given["agent.valid_mask"] > 0.0
    moved = np.diff(position, axis=2) - velocity[:, :, :-1] * STEP
    aside = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
    given["motion of agents"] = moved[present[..., 1:] & present[..., :-1]]
    given["headings of agents"] = aside[present]
    given["shapes of agents"] = (shape - shape[:, :, -1:])[present]
    for name, theirs in given.items():
        gap = theirs - ours.get(name, 0.0)
        if name not in ours and np.count_nonzero(np.abs(gap) > FEATURE) > _FEW * gap.size:
            file.report.note(f"{file.name}: {name} (this input does not obey it)")
            continue
        label, where, angle = f"{planner} inputs", f"{file.name} {name}", "orientation" in name
        file.report.compare(label, where, gap, 0.0 * gap, atol=FEATURE, angle=angle)


def _compare(loop: Loop) -> None:
    """Compare features, raw outputs and plan of one iteration."""
    loop.compare_plan(POSITION)
    theirs = loop.row["trajectory"]
    again = plan_of_poses(theirs[1:, :3], loop.seen.history).states[:, 3:PLAN_COLUMNS]
    loop.compare("motion of the recorded plan", again, theirs[:, 3:], MOTION)
    if list(loop.stored):
        agents, road, state, route = loop.features
        # the official code gives every agent the category of the ego at inference
        others = {"state": state, "category": np.zeros(len(agents.valid), np.int64)}
        compare_features(loop, agents, road, route, **others)
        compare_network(loop, plantf.make_batch([loop.features], "cpu"))


MANIFEST = partial(verify_manifest, builder=builder, history=2.0, future=builder.PLAN_POSES * STEP)
FILES = {
    "state_dict.json": partial(MANIFEST, plantf.PlanTF.name, TABLES, planner=plantf),
    "forward_*.npz": partial(verify_forward, plantf.PlanTF.name, plantf.RADIUS),
    "closed_loop_*.npz": partial(verify_loop, plantf.PlanTF, _compare, PLANS),
}
