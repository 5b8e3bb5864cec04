"""CaRL against the official code: network, decoding, and closed loops from the scenes' own logs."""

from functools import partial
from typing import Any

import numpy as np

from shiftsim.planners.learned.carl.planner import Carl, command_of
from shiftsim.planners.learned.carl.view import CHANNELS, in_picture, picture_frame
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle
from shiftsim.sim.planner import Observation
from shiftsim.verify.files import Source
from shiftsim.verify.nets import networks
from shiftsim.verify.nets.loops import FILE_COLUMNS, Loop, verify_loop
from shiftsim.verify.scenes import Scenes
from shiftsim.world.map import VectorMap
from shiftsim.world.state import LAST_AGENT_KIND, NUM_STATE, AgentKind

NAME = Carl.name
# network outputs; what it reads: m/s, m/s^2, rad, …, stored as 32 bit floats
BOUNDS = {"action": 1e-5, "measurements": 1e-6, "": 2e-5}
COMMAND = 1e-4  # m/s^2, rad/s, from our action: ten steering actions a second, in radians
DECODED = 1e-9  # m/s^2, rad/s, from their action

COUNTS = {
    "parameters": "",
    "parameters_trainable": "",
    "parameters_value_head": "value_head",
    "parameters_cnn_layernorm": r"features_extractor\.cnn\.(1|4|7|10|13|16|19)\.",
    "parameters_cnn_conv": r"features_extractor\.cnn\.(0|3|6|9|12|15|18)\.",
}
_DRIVE = {
    "dist_mu.0.weight, dist_sigma.0.weight": "base value, then row 0 times 4 and row 1 times 0.05",
    "dist_sigma.0.bias": "[0, 0]",
    "dist_mu.0.bias": "[2.5, 0]",
}
_VALUE_MEASUREMENTS = np.ones((1, 4), np.float32)  # what the critic is told at inference
_RECORDED = ("measurements", "action", "alpha", "beta", "value")


def _manifest(network: Any) -> dict[str, Any]:
    prose = dict.fromkeys(("file", "container", "prefix", "loading", "config"), networks.PROSE)
    return {"checkpoint": prose, "hyper": network.RELEASED, "drive_overrides": _DRIVE}


def _verify_forward(file: Source, scenes: Scenes) -> None:
    """The network on stored inputs, with each variant of the weights."""
    names = ("bev_semantics", "measurements", "value_measurements")
    inputs = [file[f"in.{name}"][None] for name in names]
    for variant in networks.match_case(file, NAME):
        parts, heads = _outputs(variant, *inputs)
        for start, ours in (("out.", parts), (f"out.{variant}.", heads)):
            file.below(start).match(f"{file.name} {variant}", ours, BOUNDS, quantity=NAME)


def _outputs(
    variant: str, pictures: np.ndarray, measured: np.ndarray, critic: np.ndarray
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the network says of a batch: of the encoder, and of policy and critic."""
    import torch
    from torch.distributions import Beta

    network = networks.make_network(NAME, variant)
    see, feel, tell = (torch.from_numpy(array) for array in (pictures, measured, critic))
    with torch.inference_mode():
        encoder = network.features_extractor
        features = encoder(see, feel)
        policy, value = network.policy(features), network.value(features, tell)
        beta: Any = Beta(policy.alpha, policy.beta)
        sums = {"log_prob": beta.log_prob(beta.mean), "entropy": beta.entropy()}
        seen = {"cnn_flat": encoder.see(see), "state_latent": encoder.feel(feel)}
    summed = {name: numbers.sum(dim=1) for name, numbers in sums.items()}
    heads = {"action": policy.action, **policy._asdict(), "value": value, **summed}
    return {**seen, "features": features}, heads


def _verify_decoding(file: Source, scenes: Scenes) -> None:
    networks.match_meta(file, NAME, {"columns": list(FILE_COLUMNS), "dt": 0.1})
    states = file.take("in.state", -1, NUM_STATE)
    after, commands = np.empty(states.shape), np.empty((len(states), 2))
    for row, (ego, action) in enumerate(zip(states, file["in.action"], strict=True)):
        command = command_of(action, ego)
        commands[row] = command.acceleration, command.steering_rate
        step_bicycle(ego, *commands[row], WHEEL_BASE, 0.1, after[row])
    ours = {"command": commands, "next_state": after}
    file.below("out.").match_rows(ours, DECODED, where=file.name)


def _compare(loop: Loop) -> None:
    """Compare picture, outputs and command of one iteration."""
    pictures, measured = loop.features.pictures, loop.features.measurements
    theirs = loop.stored.take("bev_semantics", *pictures.shape)
    loop.compare("picture type", str(pictures.dtype), str(theirs.dtype))
    for label, drawn, channel in zip(CHANNELS, pictures, theirs, strict=True):
        loop.compare(f"picture {label}", drawn, channel)
    if any(name.startswith("cache/") for name in loop.stored):
        loop.match(_drawn(loop.planner, loop.scenario.map, loop.seen), part="cache/")
    _, heads = _outputs(loop.variant, pictures[None], measured[None], _VALUE_MEASUREMENTS)
    ours = {name: value[0] for name, value in heads.items()}
    ours |= {"measurements": measured, "action": loop.output}
    ours = {name: ours[name] for name in _RECORDED}
    loop.row.match(loop.where, ours, BOUNDS, quantity=NAME)
    # the next step goes on from their action: standing still, each step multiplies a difference
    theirs = loop.planner.decode(loop.row["action"], loop.seen)
    for whose, command, atol in (("our", loop.plan, COMMAND), ("their", theirs, DECODED)):
        numbers = (command.acceleration, command.steering_rate)
        loop.compare(f"command of {whose} action", numbers, loop.row["command"], atol)


def _drawn(planner: Carl, road: VectorMap, seen: Observation) -> dict[str, list[str]]:
    """Ids of what was drawn, in this order."""
    found, blocks = planner.found.tolist(), len(road.blocks)
    first = [area for area in found if area < road.num_roadblocks]
    second = [area for area in found if road.num_roadblocks <= area < blocks]
    lanes, connectors = (
        [edge for block in part for edge in road.block_edges.at(block).tolist()]
        for part in (first, second)
    )
    crossed = dict.fromkeys(road.intersection_of[connectors].tolist())
    tracks, frame = seen.tracks, picture_frame(seen.ego.center)
    boxes: dict[str, list[str]] = {"vehicles": [], "pedestrians": [], "static": []}
    for index in np.flatnonzero(tracks.valid[0]).tolist():
        if in_picture(frame, *tracks.poses[0, index, :2].tolist()):
            kind = tracks.kinds[index]
            walks = "pedestrians" if kind == AgentKind.PEDESTRIAN else "vehicles"
            boxes["static" if kind > LAST_AGENT_KIND else walks].append(tracks.tokens[index])
    return {
        "roadblocks": [road.blocks.ids[area] for area in first],
        "roadblock_connectors": [road.blocks.ids[area] for area in second],
        "lanes": [road.edges.ids[edge] for edge in lanes],
        "lane_connectors": [road.edges.ids[edge] for edge in connectors],
        "intersections": [road.intersections.ids[i] for i in crossed if i >= 0],
        "car_parks": [road.car_parks.ids[area - blocks] for area in found if area >= blocks],
        "route": [road.blocks.ids[block] for block in planner.route],
        "traffic_lights": [f"{id_}:{light.name}" for id_, light in seen.traffic_lights.items()],
        **boxes,
    }


FILES = {
    "state_dict.json": partial(networks.verify_manifest, NAME, COUNTS, _manifest),
    "forward_*.npz": _verify_forward,
    "action_decode.npz": _verify_decoding,
    "closed_loop_*.npz": partial(verify_loop, Carl, _compare, ("command", *_RECORDED)),
}
