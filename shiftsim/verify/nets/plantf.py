"""PlanTF, and what its comparisons share with PLUTO's: features, inputs and outputs of networks."""

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any, TypeAlias

import numpy as np

from shiftsim.planners.learned import features as builder
from shiftsim.planners.learned.checkpoint import network_module
from shiftsim.planners.learned.features import STEP, plan_of_poses
from shiftsim.planners.learned.plantf.planner import PlanTF, make_batch
from shiftsim.planners.learned.pluto.planner import headings_of
from shiftsim.verify.files import Source
from shiftsim.verify.nets.common import Loop, make_planner
from shiftsim.verify.tables import Table, read_tables

Tables: TypeAlias = Mapping[str, Table]  # by section
Outputs: TypeAlias = Callable[[Any, Any], dict[str, Any]]  # of a network, from its inputs

PLANNER, TABLES = PlanTF, read_tables(__file__)
FEATURE = 5e-5  # m, rad, …: features are stored as 32 bit floats
LAYERS = np.array(["LANE", "LANE_CONNECTOR", "CROSSWALK"])
CODES = ("category", "kind", "on_route", "light", "object_category")  # integers, stored as floats


def compare_features(loop: Loop, agents: Any, road: Any, route: Any, **names: Any) -> None:
    """Compare what is stored of one iteration that is made before the network.

    `route` are blocks of the corrected route; `names` are further ones of the tables.
    """
    ids = [*loop.road.edges.ids, *loop.road.crosswalks.ids]
    ours = {
        **{"agents": agents, "near": road, "route": route, "layers": LAYERS[road.kind]},
        "agent_tokens": ["ego", *(loop.tracks.tokens[i] for i in agents.tracks)],
        "map_ids": [ids[row] for row in road.objects],
        "targets": np.zeros((len(agents.valid), 0, 3)),
        "sides": np.tile(np.arange(3), (len(road.kind), 1)),
    }
    loop.match("ids", loop.stored, **ours)
    loop.match("features", loop.stored.below("feature/"), **ours, **names)


def compare_network(loop: Loop, outputs: Outputs, batch: Any, *sections: str) -> None:
    """Compare what is stored of the network's outputs for one iteration."""
    ours = {name: value[0] for name, value in outputs(loop.planner.network, batch).items()}
    for section in sections:
        loop.match(section, loop.stored.below("net/"), f"({loop.variant})", **ours)


def verify_forward(planner: Any, tables: Tables, outputs: Outputs, file: Source) -> None:
    """Compare the network alone, on synthetic inputs as the official code batched them."""
    import torch

    variant, stored, tensors = str(file["meta/variant"]), file.below("in/"), {}
    for field, where in tables["inputs"].rows.items():
        array = np.dstack([stored[n] for n in where]) if isinstance(where, list) else stored[where]
        tensor = torch.from_numpy(np.ascontiguousarray(array))
        tensors[field] = tensor.long() if field in CODES else tensor
    inputs = network_module(planner.name).Inputs(**tensors)
    ours = outputs(make_planner(planner, variant).network, inputs)
    for table in (tables["outputs"], tables["large"]):
        called = f"{planner.name} ({variant})"
        table.match(file.below("out/"), file.name, called, variant=variant, **ours)
    codes = {tables["inputs"].rows[field] for field in CODES if field in tensors}
    radius = import_module(planner.__module__).RADIUS  # m, of the features
    _compare_inputs(stored, planner.name, radius, {*codes, "map.polygon_road_block_id"})
    file.note("the network does not read them", "in/origin", "in/angle")
    file.note("the network does not read the yaw rate, the last value of in/current_state")


def _compare_inputs(stored: Source, planner: str, radius: float, codes: set[str]) -> None:
    """Check the arrays of a synthetic input against each other; `codes` are integers.

    The network reads one of two arrays that say the same, or neither. Points beyond `radius` [m]
    are not valid.
    """
    given = {name: stored[name].astype(np.float64) for name in stored}
    ours = {name: np.rint(a) if name in codes else a.copy() for name, a in given.items()}
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
    names = ("position", "heading", "velocity", "shape")
    position, heading, velocity, shape = (given[f"agent.{name}"] for name in names)
    ours["agent.position"][:, 0, -1] = ours["agent.heading"][:, 0, -1] = 0.0
    ours["agent.shape"][:, 0] = builder.EGO_WIDTH, builder.EGO_LENGTH
    ours["agent.category"][:, 0], ours["agent.valid_mask"][:, 0] = 0.0, 1.0
    ours["current_state"][:, :3], ours["current_state"][:, 3] = 0.0, velocity[:, 0, -1, 0]
    for name in {"agent.target", "reference_line.future_projection"} & set(ours):
        ours[name] = np.zeros(ours[name].shape)
    # in a synthetic world everything moves as it says
    present = given["agent.valid_mask"] > 0.0
    moved = np.diff(position, axis=2) - velocity[:, :, :-1] * STEP
    aside = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
    gaps = {
        "motion": moved[present[..., 1:] & present[..., :-1]],
        "direction": aside[present],
        "shape": (shape - shape[:, :, -1:])[present],
    }
    called, angles = f"{planner} input", [name for name in ours if "orientation" in name]
    stored.match(stored.name, ours, FEATURE, quantity=called, angles=angles)
    for name, gap in gaps.items():
        stored.report.compare(f"{called} {name}", stored.name, gap, 0.0 * gap, atol=FEATURE)


def likeliest(trajectory: Any, probability: Any) -> Any:
    """(B, 80, 3) poses of the best of trajectories (B, …, 80, C), by logits (B, …)."""
    poses, count = headings_of(trajectory), len(trajectory)
    best = probability.reshape(count, -1).argmax(axis=1)
    return poses.reshape(count, -1, *poses.shape[-2:])[np.arange(count), best]


def _outputs(network: Any, inputs: Any) -> dict[str, Any]:
    made = {name: out.numpy() for name, out in network(inputs)._asdict().items()}
    return {**made, "poses": likeliest(made["trajectory"], made["probability"])}


def compare(loop: Loop) -> None:
    """Compare features, raw outputs and plan of one iteration."""
    again = plan_of_poses(loop.row["trajectory"][1:, :3], loop.seen.history)
    loop.match("iteration", loop.row)
    loop.match("motion", loop.row, "recorded", again=again)
    if list(loop.stored):
        agents, road, state, route = loop.features
        # the official code gives every agent the category of the ego at inference
        category = np.zeros(len(agents.valid), np.int64)
        compare_features(loop, agents, road, route, state=state, category=category)
        compare_network(loop, _outputs, make_batch([loop.features], "cpu"), "outputs", "large")


FILES = {"forward_*.npz": partial(verify_forward, PlanTF, TABLES, _outputs)}
