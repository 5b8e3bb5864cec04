"""CaRL against the official code: network, decoding, and closed loops from the scenes' own logs."""

from pathlib import Path
from typing import Any

import numpy as np
import places
import pytest
from parity_cases import (
    Cases,
    Scenes,
    change_array,
    change_json,
    ids,
    name_unknown,
    noticed,
    read_file,
)
from parity_nets import (
    ANY,
    FILE_COLUMNS,
    HYPER_PARAMETERS,
    Loop,
    compare_manifest,
    loop_steps,
    make_planner,
    match_case,
    match_meta,
)

torch = pytest.importorskip("torch")

from shiftsim.planners.learned.carl.planner import Carl, command_of  # noqa: E402
from shiftsim.planners.learned.carl.view import CHANNELS, in_picture, picture_frame  # noqa: E402
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle  # noqa: E402
from shiftsim.world.map import NONE  # noqa: E402
from shiftsim.world.state import LAST_AGENT_KIND, NUM_STATE, AgentKind  # noqa: E402

pytestmark = [pytest.mark.golden, pytest.mark.learned, pytest.mark.reference("carl")]
GOLDEN = places.GOLDEN / "nets" / "carl"

OUTPUT = {"": 2e-5, "action": 1e-5}
INPUTS = ("bev_semantics", "measurements", "value_measurements")
VALUE_INPUTS = np.ones((1, 4), np.float32)  # of the critic at inference
COMMANDS = ("command[0]", "command[1]")  # m/s^2; rad/s: ten steering actions a second


def outputs(network: Any, *inputs: np.ndarray) -> tuple[dict[str, Any], dict[str, Any]]:
    """What encoder and heads say of a batch, by the names of the reference."""
    from torch.distributions import Beta

    pictures, measured, told = (torch.from_numpy(array) for array in inputs)
    encoder = network.features_extractor
    with torch.no_grad():
        features = encoder(pictures, measured)
        policy = network.policy(features)
        beta: Any = Beta(policy.alpha, policy.beta)
        encoded = {
            "cnn_flat": encoder.encode_raster(pictures),
            "state_latent": encoder.state_linear(measured),
        }
        heads = {
            "action": policy.action,
            "alpha": policy.alpha,
            "beta": policy.beta,
            "value": network.value(features, told),
            "log_prob": beta.log_prob(beta.mean).sum(dim=1),
            "entropy": beta.entropy().sum(dim=1),
        }
    return {**encoded, "features": features}, heads


@pytest.mark.files("forward_*.npz")
def test_forward(path: Path, cases: Cases) -> None:
    """The network on stored inputs, with each variant of the weights."""
    file = read_file(path, cases, path.stem)
    inputs = [file[f"in.{name}"][None] for name in INPUTS]
    for variant in match_case(file, Carl.name):
        encoded, heads = outputs(make_planner(Carl, variant).networks[0], *inputs)
        where = f"{file.name} {variant}"
        file.below("out.").match(where, encoded, OUTPUT, quantity=Carl.name)
        file.below(f"out.{variant}.").match(where, heads, OUTPUT, quantity=Carl.name)
    file.finish()


@pytest.mark.files("action_decode.npz")
def test_decoding(path: Path, cases: Cases) -> None:
    """The command of an action, and the next state."""
    file = read_file(path, cases, path.stem)
    match_meta(file, Carl.name, columns=list(FILE_COLUMNS), dt=0.1)
    for number, case in enumerate(rows := file.array_rows()):
        ego, after = case.take("in.state", NUM_STATE), np.empty(NUM_STATE)
        command = command_of(case["in.action"], ego)
        numbers = command.acceleration, command.steering_rate
        step_bicycle(ego, *numbers, WHEEL_BASE, 0.1, after)
        ours = {"command": numbers, "next_state": after}
        case.below("out.").match(f"{file.name} {number}", ours, 1e-9)
    rows[-1].finish()


@pytest.mark.files("closed_loop_*.npz")
def test_closed_loop(path: Path, scenes: Scenes, cases: Cases) -> None:
    plans = ("measurements", "action", "alpha", "beta", "value", "command", "command")
    for loop in loop_steps(path, Carl, scenes, cases, plans):
        pictures, measured = loop.features
        theirs = loop.stored.take("bev_semantics", *pictures.shape)
        loop.compare("picture type", str(pictures.dtype), str(theirs.dtype))
        for label, drawn, channel in zip(CHANNELS, pictures, theirs, strict=True):
            loop.compare(f"picture {label}", drawn, channel)
        network = loop.planner.networks[0]
        _, heads = outputs(network, pictures[None], measured[None], VALUE_INPUTS)
        said = {name: heads[name][0] for name in ("alpha", "beta", "value")}
        said |= {"measurements": measured, "action": loop.output}
        commands = loop.answer.acceleration, loop.answer.steering_rate
        # measurements: m/s, m/s^2, rad, …, stored as 32 bit floats
        atol = {**OUTPUT, "measurements": 1e-6, **dict.fromkeys(COMMANDS, 1e-4)}
        loop.match(loop.row, {**said, **dict(zip(COMMANDS, commands, strict=True))}, atol)
        # the next step goes on from their action: standing still, each step multiplies a difference
        decoded = loop.planner.decode(loop.row["action"], loop.seen)
        commands = decoded.acceleration, decoded.steering_rate
        loop.match(loop.row, dict(zip(COMMANDS, commands, strict=True)), 1e-9, "decoded")
        if list(cache := loop.stored.below("cache/")):
            loop.match(cache, drawn_ids(loop))


def drawn_ids(loop: Loop) -> dict[str, Any]:
    """Ids of what was drawn, in this order."""
    road, tracks, found = loop.road, loop.seen.tracks, loop.planner.found
    layer = np.searchsorted([road.num_roadblocks, len(road.blocks)], found, "right")
    blocks, joining, parks = (found[layer == number] for number in range(3))
    lanes, connectors = (
        [edge for block in part for edge in road.block_edges.at(block)]
        for part in (blocks, joining)
    )
    crossed = [index for index in road.intersection_of[connectors].tolist() if index != NONE]
    frame = picture_frame(loop.seen.ego.center)
    inside = np.array([in_picture(frame, *pose[:2]) for pose in tracks.poses[0].tolist()], np.bool_)
    is_static, walks = tracks.kinds > LAST_AGENT_KIND, tracks.kinds == AgentKind.PEDESTRIAN
    boxes = {"static": is_static, "pedestrians": walks, "vehicles": ~is_static & ~walks}
    lights = loop.seen.traffic_lights.items()
    return {
        "roadblocks": ids(road.blocks, blocks),
        "roadblock_connectors": ids(road.blocks, joining),
        "lanes": ids(road.edges, lanes),
        "lane_connectors": ids(road.edges, connectors),
        "intersections": ids(road.intersections, list(dict.fromkeys(crossed))),
        "car_parks": ids(road.car_parks, parks - len(road.blocks)),
        "route": ids(road.blocks, loop.planner.route),
        "traffic_lights": [f"{name}:{light.name}" for name, light in lights],
        **{
            name: [loop.tracks.tokens[i] for i in np.flatnonzero(tracks.valid[0] & inside & kind)]
            for name, kind in boxes.items()
        },
    }


WEIGHTS = {
    "parameters": "",
    "parameters_trainable": "",
    "parameters_value_head": "value_head",
    "parameters_cnn_layernorm": r"features_extractor\.cnn\.(1|4|7|10|13|16|19)\.",
    "parameters_cnn_conv": r"features_extractor\.cnn\.(0|3|6|9|12|15|18)\.",
}


def manifest(network: Any) -> dict[str, Any]:
    return {
        "checkpoint": dict.fromkeys(("file", "container", "prefix", "loading", "config"), ANY),
        "hyper": HYPER_PARAMETERS["carl"],
        "drive_overrides": {
            "dist_mu.0.weight, dist_sigma.0.weight": (
                "base value, then row 0 times 4 and row 1 times 0.05"
            ),
            "dist_sigma.0.bias": "[0, 0]",
            "dist_mu.0.bias": "[2.5, 0]",
        },
    }


@pytest.mark.files("state_dict.json")
def test_manifest(path: Path, cases: Cases) -> None:
    compare_manifest(path, cases, Carl, manifest, WEIGHTS)


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    known = ("forward_*.npz", "action_decode.npz", "closed_loop_*.npz", "state_dict.json")
    name_unknown(folder, cases, *known)


@pytest.mark.parametrize(
    ("test", "file", "name", "index"),
    [
        *((test_forward, "forward_dense", name, 0) for name in ("out.features", "in.measurements")),
        (test_forward, "forward_dense", "out.base.alpha", 0),
        *((test_decoding, "action_decode", name, 0) for name in ("out.command", "in.state")),
        *(
            (test_closed_loop, "closed_loop_s04_left_turn", name, 0)
            for name in ("it00/bev_semantics", "it00/cache/lanes", "out/action", "ego/current")
        ),
    ],
)
@pytest.mark.thorough
def test_a_changed_value_is_noticed(
    test: Any, file: str, name: str, index: int, tmp_path: Path, nuplan_reference: Path
) -> None:
    path, cases = tmp_path / f"{file}.npz", Cases()
    change_array(GOLDEN / path.name, path, name, index, amount=0.01)
    scenes = (Scenes(nuplan_reference),) if test is test_closed_loop else ()
    assert noticed(test, path, *scenes, cases)


@pytest.mark.parametrize(
    "keys", [("entries", 3, "shape"), ("parameters",), ("hyper",), ("selfcheck", "first3_raw_z", 0)]
)
def test_a_changed_manifest_is_noticed(keys: tuple[Any, ...], tmp_path: Path) -> None:
    cases = Cases()
    change_json(GOLDEN / "state_dict.json", tmp_path / "state_dict.json", *keys)
    assert noticed(test_manifest, tmp_path / "state_dict.json", cases)
