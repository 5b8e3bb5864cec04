"""CaRL against the official code: network, decoding, and closed loops from the scenes' own logs."""

from functools import partial
from typing import Any

import numpy as np

from shiftsim.planners.learned.carl.planner import Carl, command_of
from shiftsim.planners.learned.carl.view import CHANNELS, in_picture, picture_frame
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle
from shiftsim.verify.files import TOLERANCE, Source
from shiftsim.verify.nets import networks
from shiftsim.verify.nets.loops import FILE_COLUMNS, Loop, verify_loop
from shiftsim.verify.scenes import Scenes
from shiftsim.verify.tables import read_tables
from shiftsim.world.state import LAST_AGENT_KIND, NUM_STATE, AgentKind

NAME, TABLES = Carl.name, read_tables(__file__)
COMMAND = 1e-4  # m/s^2, rad/s, from our action: ten steering actions a second, in radians
_TOLD = np.ones((1, 4), np.float32)  # what the critic is told at inference


def _verify_forward(file: Source, scenes: Scenes) -> None:
    """The network on stored inputs, with each variant of the weights."""
    names = ("bev_semantics", "measurements", "value_measurements")
    inputs = [file[f"in.{name}"][None] for name in names]
    for variant in networks.match_case(file, NAME):
        says, where = _outputs(variant, *inputs), f"{file.name} {variant}"
        TABLES["encoder"].match(file.below("out."), where, NAME, **says)
        TABLES["heads"].match(file.below(f"out.{variant}."), where, NAME, **says)


def _outputs(variant: str, pictures: Any, measured: Any, told: Any) -> dict[str, Any]:
    """What the network says of a batch."""
    import torch
    from torch.distributions import Beta

    network = networks.make_network(NAME, variant)
    see, feel, tell = (torch.from_numpy(array) for array in (pictures, measured, told))
    with torch.inference_mode():
        encoder = network.features_extractor
        features = encoder(see, feel)
        policy, value = network.policy(features), network.value(features, tell)
        beta: Any = Beta(policy.alpha, policy.beta)
        log_prob, entropy = (x.sum(dim=1) for x in (beta.log_prob(beta.mean), beta.entropy()))
        seen, felt = encoder.see(see), encoder.feel(feel)
    named = {"seen": seen, "felt": felt, "features": features, "policy": policy, "value": value}
    return {**named, "log_prob": log_prob, "entropy": entropy}


def _verify_decoding(file: Source, scenes: Scenes) -> None:
    """The command of an action, and the next state."""
    networks.match_meta(file, NAME, {"columns": list(FILE_COLUMNS), "dt": 0.1})
    states = file.take("in.state", -1, NUM_STATE)
    after, commands = np.empty(states.shape), np.empty((len(states), 2))
    for row, (ego, action) in enumerate(zip(states, file["in.action"], strict=True)):
        command = command_of(action, ego)
        commands[row] = command.acceleration, command.steering_rate
        step_bicycle(ego, *commands[row], WHEEL_BASE, 0.1, after[row])
    ours = {"command": commands, "next_state": after}
    file.below("out.").match_rows(ours, TOLERANCE, where=file.name)


def _compare(loop: Loop) -> None:
    """Compare picture, outputs and command of one iteration."""
    pictures, measured = loop.features
    theirs = loop.stored.take("bev_semantics", *pictures.shape)
    loop.compare("picture type", str(pictures.dtype), str(theirs.dtype))
    for label, drawn, channel in zip(CHANNELS, pictures, theirs, strict=True):
        loop.compare(f"picture {label}", drawn, channel)
    drawn = loop.stored.below("cache/")
    if list(drawn):
        loop.match(TABLES["drawn"], drawn, **_drawn(loop))
    says = _outputs(loop.variant, pictures[None], measured[None], _TOLD)
    loop.match(TABLES["loop"], loop.row, measured=measured, **says)
    # the next step goes on from their action: standing still, each step multiplies a difference
    decoded = loop.planner.decode(loop.row["action"], loop.seen)
    for whose, command, atol in (("our", loop.answer, COMMAND), ("their", decoded, TOLERANCE)):
        numbers = (command.acceleration, command.steering_rate)
        loop.compare(f"command of {whose} action", numbers, loop.row["command"], atol)


def _drawn(loop: Loop) -> dict[str, Any]:
    """What was drawn, in this order, as rows of the layers of the map and of the tracks."""
    road, found, blocks = loop.road, loop.planner.found.tolist(), len(loop.road.blocks)
    plain = [area for area in found if area < road.num_roadblocks]
    joining = [area for area in found if road.num_roadblocks <= area < blocks]
    lanes, connectors = (
        [edge for block in part for edge in road.block_edges.at(block).tolist()]
        for part in (plain, joining)
    )
    crossed = dict.fromkeys(road.intersection_of[connectors].tolist())
    tracks, frame = loop.seen.tracks, picture_frame(loop.seen.ego.center)
    boxes: dict[str, list[int]] = {"vehicles": [], "walkers": [], "static": []}
    for index in np.flatnonzero(tracks.valid[0]).tolist():
        if in_picture(frame, *tracks.poses[0, index, :2].tolist()):
            kind = tracks.kinds[index]
            agent = "walkers" if kind == AgentKind.PEDESTRIAN else "vehicles"
            boxes["static" if kind > LAST_AGENT_KIND else agent].append(index)
    parks = [area - blocks for area in found if area >= blocks]
    areas = {"plain": plain, "joining": joining, "lanes": lanes, "connectors": connectors}
    lights = [f"{id_}:{light.name}" for id_, light in loop.seen.traffic_lights.items()]
    crossings = [i for i in crossed if i >= 0]
    return {**areas, **boxes, "crossings": crossings, "parks": parks, "lights": lights}


_RECORDED = ("command", *TABLES["loop"].rows)
FILES = {
    "state_dict.json": partial(networks.verify_manifest, NAME, TABLES),
    "forward_*.npz": _verify_forward,
    "action_decode.npz": _verify_decoding,
    "closed_loop_*.npz": partial(verify_loop, Carl, _compare, _RECORDED),
}
