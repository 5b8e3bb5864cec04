"""CaRL against the official code: network, decoding, and closed loops from the scenes' own logs."""

from typing import Any

import numpy as np

from shiftsim.planners.learned.carl.planner import Carl, command_of
from shiftsim.planners.learned.carl.view import CHANNELS, in_picture, picture_frame
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle
from shiftsim.verify.files import TOLERANCE, Source
from shiftsim.verify.nets import common
from shiftsim.verify.tables import read_tables, rows_of
from shiftsim.world.map import NONE
from shiftsim.world.state import LAST_AGENT_KIND, NUM_STATE, AgentKind

PLANNER, NAME, TABLES = Carl, Carl.name, read_tables(__file__)
_INPUTS = ("bev_semantics", "measurements", "value_measurements")
_TOLD = np.ones((1, 4), np.float32)  # what the critic is told at inference


def _verify_forward(file: Source) -> None:
    """The network on stored inputs, with each variant of the weights."""
    inputs = [file[f"in.{name}"][None] for name in _INPUTS]
    for variant in common.match_case(file, NAME):
        says = _outputs(common.make_planner(Carl, variant).networks[0], *inputs)
        where = f"{file.name} {variant}"
        TABLES["encoder"].match(file.below("out."), where, NAME, **says)
        TABLES["heads"].match(file.below(f"out.{variant}."), where, NAME, **says)


def _outputs(network: Any, pictures: Any, measured: Any, told: Any) -> dict[str, Any]:
    import torch
    from torch.distributions import Beta

    see, feel, tell = (torch.from_numpy(array) for array in (pictures, measured, told))
    encoder = network.features_extractor
    features = encoder(see, feel)
    policy = network.policy(features)
    beta: Any = Beta(policy.alpha, policy.beta)
    return {
        **{"seen": encoder.encode_raster(see), "felt": encoder.state_linear(feel)},
        "features": features,
        **{"policy": policy, "value": network.value(features, tell)},
        "log_prob": beta.log_prob(beta.mean).sum(dim=1),
        "entropy": beta.entropy().sum(dim=1),
    }


def _verify_decoding(file: Source) -> None:
    """The command of an action, and the next state."""
    common.match_meta(file, NAME, columns=list(common.FILE_COLUMNS), dt=0.1)
    for number, case in enumerate(rows_of(file)):
        ego, after = case.take("in.state", NUM_STATE), np.empty(NUM_STATE)
        command = command_of(case["in.action"], ego)
        numbers = command.acceleration, command.steering_rate
        step_bicycle(ego, *numbers, WHEEL_BASE, 0.1, after)
        ours = {"command": numbers, "next_state": after}
        case.below("out.").match(f"{file.name} {number}", ours, TOLERANCE)


def compare(loop: common.Loop) -> None:
    """Compare picture, outputs and command of one iteration."""
    pictures, measured = loop.features
    theirs = loop.stored.take("bev_semantics", *pictures.shape)
    loop.compare("picture type", str(pictures.dtype), str(theirs.dtype))
    for label, drawn, channel in zip(CHANNELS, pictures, theirs, strict=True):
        loop.compare(f"picture {label}", drawn, channel)
    says = _outputs(loop.planner.networks[0], pictures[None], measured[None], _TOLD)
    loop.match("iteration", loop.row, measured=measured, **says)
    # the next step goes on from their action: standing still, each step multiplies a difference
    decoded = loop.planner.decode(loop.row["action"], loop.seen)
    loop.match("decoded", loop.row, "decoded", decoded=decoded)
    if list(cache := loop.stored.below("cache/")):
        loop.match("drawn", cache, **_drawn(loop))


def _drawn(loop: common.Loop) -> dict[str, Any]:
    """What was drawn, in this order: rows of the layers of the map, and of the tracks."""
    road, tracks, found = loop.road, loop.seen.tracks, loop.planner.found
    layer = np.searchsorted([road.num_roadblocks, len(road.blocks)], found, "right")
    plain, joining, parks = (found[layer == number] for number in range(3))
    lanes, connectors = (
        [edge for block in part for edge in road.block_edges.at(block)] for part in (plain, joining)
    )
    crossed = [index for index in road.intersection_of[connectors].tolist() if index != NONE]
    frame = picture_frame(loop.seen.ego.center)
    inside = np.array([in_picture(frame, *pose[:2]) for pose in tracks.poses[0].tolist()], np.bool_)
    is_static, walks = tracks.kinds > LAST_AGENT_KIND, tracks.kinds == AgentKind.PEDESTRIAN
    boxes = {"static": is_static, "walkers": walks, "vehicles": ~is_static & ~walks}
    return {
        **{name: np.flatnonzero(tracks.valid[0] & inside & kind) for name, kind in boxes.items()},
        **{"plain": plain, "joining": joining, "lanes": lanes, "connectors": connectors},
        "crossings": list(dict.fromkeys(crossed)),
        "parks": parks - len(road.blocks),
        "lights": [f"{id_}:{light.name}" for id_, light in loop.seen.traffic_lights.items()],
    }


FILES = {"forward_*.npz": _verify_forward, "action_decode.npz": _verify_decoding}
