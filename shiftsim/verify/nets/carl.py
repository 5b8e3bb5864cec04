"""CaRL against the official code: network, decoding, and closed loops from the scenes' own logs."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.planners.learned.carl.planner import Carl, CarlFeatures, command_of
from shiftsim.planners.learned.carl.view import CHANNELS, SIZE, in_picture, picture_frame
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle
from shiftsim.sim.planner import Observation
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nets.common import (
    ERRORS,
    FILE_COLUMNS,
    Loop,
    Scenes,
    compare_driven,
    make_network,
    open_loop,
    verify_state_dict,
)
from shiftsim.verify.report import Report
from shiftsim.world import state
from shiftsim.world.map import VectorMap
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind, Command

NETWORK = 2e-5  # network outputs
ACTION = 1e-5
MEASURED = 1e-6  # m/s, m/s^2, rad, …: stored as 32 bit floats
COMMAND = 1e-4  # m/s^2, rad/s, from our action: ten steering actions a second, in radians
DECODED = 1e-9  # m/s^2, rad/s, from their action
EDGE_ACTION = 1e-3  # where pixels differ
JITTER = 1e-7  # m: vertices closer to the border of a pixel than this may fall on either side
MAX_PIXELS = SIZE * SIZE // 1000  # of a channel that may differ for that reason

_DRIVE = {
    "dist_mu.0.weight, dist_sigma.0.weight": "base value, then row 0 times 4 and row 1 times 0.05",
    "dist_sigma.0.bias": "[0, 0]",
    "dist_mu.0.bias": "[2.5, 0]",
}
_VALUE_MEASUREMENTS = (1.0, 1.0, 1.0, 1.0)  # at inference (planner-carl.md §2.5)


def verify_carl(folder: Path, report: Report, scenes: Scenes) -> None:
    """Compare every file of the folder.

    Args:
        folder: Folder of the files.
        report: Receives the comparisons.
        scenes: The scenes of the closed loops.
    """
    for path in sorted(folder.iterdir()):
        try:
            if path.name == "state_dict.json":
                _verify_manifest(path, report)
            elif path.name == "action_decode.npz":
                _verify_decoding(path, report)
            elif path.name.startswith("forward_") and path.suffix == ".npz":
                _verify_forward(path, report)
            elif path.name.startswith("closed_loop_") and path.suffix == ".npz":
                _verify_loop(path, report, scenes)
            elif path.suffix == ".md":
                report.note(f"carl/{path.name}: description of the folder")
            else:
                report.skip(f"file carl/{path.name}")
        except ERRORS as error:
            report.fail("carl", path.name, f"cannot be compared: {error!r}")


def _verify_manifest(path: Path, report: Report) -> None:
    from torch import nn

    from shiftsim.planners.learned.carl.network import RELEASED, build_network

    network = build_network()
    parts = list(network.features_extractor.cnn)
    trained = _count(network.parameters())
    others = {
        "parameters": lambda _: _count(network.state_dict().values()),
        "parameters_trainable": lambda _: trained,
        "parameters_value_head": lambda _: _count(network.value_head.parameters()),
        "parameters_cnn_layernorm": lambda _: _count(nn.ModuleList(parts[1::3]).parameters()),
        "parameters_cnn_conv": lambda _: _count(nn.ModuleList(parts[:-1:3]).parameters()),
        "checkpoint": None,
        "hyper": lambda _: RELEASED,
        "drive_overrides": lambda _: _DRIVE,
    }
    verify_state_dict(path, report, "carl", others)


def _count(tensors: Any) -> int:
    return sum(int(tensor.numel()) for tensor in tensors)


def _verify_forward(path: Path, report: Report) -> None:
    import torch

    file = ArrayFile(path, report)
    meta = json.loads(str(file["meta"]))
    report.compare("carl case", path.name, path.stem.removeprefix("forward_"), meta["case"])
    for extra in sorted(set(meta) - {"case", "variants"}):
        report.skip(f"{path.name}: field {extra!r} of meta")
    pictures = torch.from_numpy(file.take("in.bev_semantics", len(CHANNELS), SIZE, SIZE))[None]
    measured = torch.from_numpy(file.take("in.measurements", 10))[None]
    critic = torch.from_numpy(file.take("in.value_measurements", 4))[None]
    for variant in meta["variants"]:
        network = make_network("carl", variant)
        with torch.inference_mode():
            inner = network.features_extractor
            ours = {"cnn_flat": inner.see(pictures), "state_latent": inner.feel(measured)}
            ours["features"] = inner(pictures, measured)
            heads = _heads(network, ours["features"], critic)
        ours |= {f"{variant}.{name}": value for name, value in heads.items()}
        for name, value in ours.items():
            atol = ACTION if name.endswith(".action") else NETWORK
            quantity = f"carl {name.rpartition('.')[2]}"
            where = f"{path.stem} {variant}"
            report.compare(quantity, where, value.numpy(), file[f"out.{name}"], atol=atol)
    file.finish()


def _heads(network: Any, features: Any, critic: Any) -> dict[str, Any]:
    """What policy and critic make of (B, 256) features."""
    from torch.distributions import Beta

    policy = network.policy(features)
    distribution: Any = Beta(policy.alpha, policy.beta)
    return {
        "action": policy.action,
        "alpha": policy.alpha,
        "beta": policy.beta,
        "value": network.value(features, critic),
        "log_prob": distribution.log_prob(distribution.mean).sum(dim=1),
        "entropy": distribution.entropy().sum(dim=1),
    }


def _verify_decoding(path: Path, report: Report) -> None:
    file = ArrayFile(path, report)
    meta = json.loads(str(file["meta"]))
    report.compare("carl columns", path.name, list(FILE_COLUMNS), meta["columns"])
    report.compare("carl step [s]", path.name, 0.1, meta["dt"])
    for extra in sorted(set(meta) - {"columns", "dt"}):
        report.skip(f"{path.name}: field {extra!r} of meta")
    states = file.take("in.state", -1, state.NUM_STATE)
    actions = file.take("in.action", len(states), 2)
    commands = file.take("out.command", len(states), 2)
    after = file.take("out.next_state", len(states), state.NUM_STATE)
    out = np.empty(state.NUM_STATE)
    for row, ego in enumerate(states):
        where = f"{path.stem} {row}"
        command = command_of(actions[row], ego)
        _compare_command(report, where, command, commands[row], DECODED)
        step_bicycle(ego, *_numbers(command), WHEEL_BASE, 0.1, out)
        report.compare("carl next state", where, out, after[row], atol=DECODED)
    file.finish()


def _numbers(command: Command) -> tuple[float, float]:
    return command.acceleration, command.steering_rate


def _compare_command(
    report: Report, where: str, command: Command, theirs: np.ndarray, atol: float
) -> None:
    kind = "of their action" if atol == DECODED else "of our action"
    report.compare(f"carl command {kind}", where, _numbers(command), theirs, atol=atol)


def _verify_loop(path: Path, report: Report, scenes: Scenes) -> None:
    loop = open_loop(path, report, scenes, "carl")
    if loop is None:
        return
    file = loop.file
    count = len(file["out/action"])
    if not (0 < count <= len(loop.ego)):
        raise DataError(f"{count} actions of {len(loop.ego)} ego states")
    shapes = {"measurements": 10, "action": 2, "alpha": 2, "beta": 2, "value": 1, "command": 2}
    theirs = {name: file.take(f"out/{name}", count, size) for name, size in shapes.items()}
    planner = Carl(f"deterministic:{loop.variant}")
    planner.reset(loop.info)
    for index in range(count):
        _verify_step(loop, planner, index, {name: rows[index] for name, rows in theirs.items()})
    if loop.error:
        # where the official code failed, ours says that its answer is a makeshift
        if count < len(loop.ego):
            planner.plan(loop.observation(count))
        loop.compare("carl fails", f"iteration {count}", bool(planner.degraded), True)
    commands = [Command(*row) for row in theirs["command"].tolist()]
    compare_driven(loop, list(commands), "carl")
    file.finish()


def _verify_step(loop: Loop, planner: Carl, index: int, theirs: dict[str, np.ndarray]) -> None:
    import torch

    seen, where, report = loop.observation(index), f"iteration {index}", loop.file.report
    features = planner.features(seen)
    features = CarlFeatures(features.pictures.copy(), features.measurements)
    equal = _compare_pictures(loop, planner, seen, features.pictures, index)
    _compare_cache(loop, planner, seen, index)
    loop.compare(
        "carl measurements", where, features.measurements, theirs["measurements"], MEASURED
    )
    (action,) = planner.infer([features])
    (network,) = planner.networks
    with torch.inference_mode():
        pictures = torch.from_numpy(features.pictures)[None]
        latent = network.features_extractor(pictures, torch.from_numpy(features.measurements)[None])
        heads = _heads(network, latent, torch.tensor([_VALUE_MEASUREMENTS]))
    loop.compare("carl action", where, action, theirs["action"], ACTION if equal else EDGE_ACTION)
    for name in ("alpha", "beta", "value"):
        atol = NETWORK if equal else EDGE_ACTION
        loop.compare(f"carl {name}", where, heads[name][0].numpy(), theirs[name], atol)
    command = planner.decode(action, seen)
    if not loop.error:
        loop.compare("carl makeshift", where, planner.degraded, "")
    at = f"{loop.file.name} {where}"
    atol = COMMAND if equal else EDGE_ACTION * 10.0
    _compare_command(report, at, command, theirs["command"], atol)
    # the next step goes on from their action: standing still, each step multiplies a difference
    decoded = planner.decode(theirs["action"], seen)
    _compare_command(report, at, decoded, theirs["command"], DECODED)


def _compare_pictures(
    loop: Loop, planner: Carl, seen: Observation, ours: np.ndarray, index: int
) -> bool:
    """Compare the nine channels; whether all pixels are equal."""
    name, report = f"it{index:02d}/bev_semantics", loop.file.report
    theirs = loop.file.take(name, len(CHANNELS), SIZE, SIZE)
    if theirs.dtype != np.uint8:
        raise DataError(f"array {name!r} is of {theirs.dtype}")
    differing = ours != theirs
    if differing.any():
        ours = np.where(differing & _near_border(planner, seen, theirs), theirs, ours)
    for channel, label in enumerate(CHANNELS):
        where = f"iteration {index}"
        rows = np.argwhere(differing[channel])
        explained = rows[(ours == theirs)[channel][differing[channel]]]
        if len(explained) > MAX_PIXELS:
            report.fail(f"carl picture {label}", where, f"{len(explained)} pixels differ")
            continue
        for row, column in explained.tolist():
            report.note(f"{loop.file.name} {where} {label}: pixel {row}, {column} (border)")
        loop.compare(f"carl picture {label}", where, ours[channel], theirs[channel])
    return not differing.any()


def _near_border(planner: Carl, seen: Observation, theirs: np.ndarray) -> np.ndarray:
    """(9, 256, 256) whether a move of the ego by next to nothing would give this pixel."""
    found = np.zeros(theirs.shape, np.bool_)
    for dx in (-JITTER, 0.0, JITTER):
        for dy in (-JITTER, 0.0, JITTER):
            ego = seen.history.ego.copy()
            ego[-1, : state.HEADING] += dx, dy
            moved = replace(seen, history=replace(seen.history, ego=ego))
            found |= planner.features(moved).pictures == theirs
    planner.features(seen)
    return found


def _compare_cache(loop: Loop, planner: Carl, seen: Observation, index: int) -> None:
    """Compare which objects were drawn, and in which order."""
    prefix = f"it{index:02d}/cache/"
    names = [n.removeprefix(prefix) for n in loop.file.arrays if n.startswith(prefix)]
    if not names:
        return
    ours = {**_drawn_roads(planner, loop.scenario.map), **_drawn_tracks(seen)}
    ours["traffic_lights"] = [f"{i}:{s.name}" for i, s in seen.traffic_lights.items()]
    for name in names:
        if name in ours:
            theirs = loop.file[prefix + name].tolist()
            loop.compare(f"carl {name}", f"iteration {index}", ours[name], theirs)


def _drawn_roads(planner: Carl, road: VectorMap) -> dict[str, list[str]]:
    found, blocks = planner.found.tolist(), len(road.blocks)
    first = [area for area in found if area < road.num_roadblocks]
    second = [area for area in found if road.num_roadblocks <= area < blocks]
    edges = [[e for b in part for e in road.block_edges.at(b).tolist()] for part in (first, second)]
    crossed = dict.fromkeys(road.intersection_of[edges[1]].tolist())
    return {
        "roadblocks": [road.blocks.ids[area] for area in first],
        "roadblock_connectors": [road.blocks.ids[area] for area in second],
        "lanes": [road.edges.ids[edge] for edge in edges[0]],
        "lane_connectors": [road.edges.ids[edge] for edge in edges[1]],
        "intersections": [road.intersections.ids[i] for i in crossed if i >= 0],
        "car_parks": [road.car_parks.ids[area - blocks] for area in found if area >= blocks],
        "route": [road.blocks.ids[block] for block in planner.route],
    }


def _drawn_tracks(seen: Observation) -> dict[str, list[str]]:
    tracks, frame = seen.tracks, picture_frame(seen.ego.center)
    out: dict[str, list[str]] = {"vehicles": [], "pedestrians": [], "static": []}
    for index in np.flatnonzero(tracks.valid[0]).tolist():
        x, y = tracks.poses[0, index, :2].tolist()
        if in_picture(frame, x, y):
            kind = tracks.kinds[index]
            walks = "pedestrians" if kind == AgentKind.PEDESTRIAN else "vehicles"
            out["static" if kind > LAST_AGENT_KIND else walks].append(tracks.tokens[index])
    return out
