"""Diffusion Planner against the official code: settings, schedule, network, features, loops.

Everything is made from the scene's own log and map; stored features are only compared with.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import places
import pytest
import shapely
from parity_cases import (
    Cases,
    File,
    Scenes,
    change_array,
    change_json,
    ids,
    name_unknown,
    noticed,
    open_scenes,
    read_file,
)
from parity_nets import (
    ANY,
    PLAN,
    compare_manifest,
    drive_bound,
    loop_steps,
    make_planner,
    match_case,
    match_meta,
    only,
)

torch = pytest.importorskip("torch")

from parity_guidance import with_guidance  # noqa: E402

from shiftsim.planners.learned.deterministic import keyed_normals  # noqa: E402
from shiftsim.planners.learned.diffusion import features as builder  # noqa: E402
from shiftsim.planners.learned.diffusion import network_sampler as sampler  # noqa: E402
from shiftsim.planners.learned.diffusion.network import DEFAULT_ARGS  # noqa: E402
from shiftsim.planners.learned.diffusion.planner import (  # noqa: E402
    INPUTS,
    NOISE_SHAPE,
    DiffusionPlanner,
    make_inputs,
)
from shiftsim.sim.planner import Observation  # noqa: E402
from shiftsim.verify.rollouts import tracks_of  # noqa: E402
from shiftsim.world.layers import Polylines, make_polygons, make_polylines  # noqa: E402
from shiftsim.world.state import AgentKind, Tracks  # noqa: E402

pytestmark = [
    *(pytest.mark.golden, pytest.mark.learned, pytest.mark.slow),
    pytest.mark.reference("diffusion_planner"),
]
GOLDEN = places.GOLDEN / "nets" / "diffusion_planner"

NAME = DiffusionPlanner.name
SINGLE = 2e-6  # of the schedule: single precision, about 1
NORMALISED = 1e-6
FEATURE = 5e-5  # m, rad, …: features are stored as 32 bit floats
ENCODED = 2e-5
TRACK_COLUMNS = ["track_token", "vx", "vy", "heading", "width", "length", "x", "y"]
STATIC = ("CZONE_SIGN", "BARRIER", "TRAFFIC_CONE", "GENERIC_OBJECT")


def start_noise(key: str) -> np.ndarray:
    """(11, 80, 4) float32, of a case or of an iteration."""
    return keyed_normals(f"noise:{key}", (1, *NOISE_SHAPE)).astype(np.float32)[0]


class KeyedPlanner(DiffusionPlanner):
    """The planner with the start noise of the reference files."""

    def features(self, observation: Observation) -> builder.Features:
        """What the network reads."""
        noise = start_noise(f"{self._key[1]}:{observation.iteration}")
        return replace(super().features(observation), noise=noise)


@pytest.mark.files("args.json")
def test_args(path: Path, cases: Cases) -> None:
    """The bundled settings must be those of the file; both normalisers too."""
    file = read_file(path, cases)
    agents, normaliser = 1 + int(file["predicted_neighbor_num"]), DEFAULT_ARGS["state_normalizer"]
    ours = {
        **DEFAULT_ARGS,
        # of training, or fixed by the features
        **{"agent_state_dim": 11, "static_objects_state_dim": 10},
        **{"lane_state_dim": 12, "route_state_dim": 12},
        **{"encoder_drop_path_rate": 0.1, "decoder_drop_path_rate": 0.1},
        **{"diffusion_model_type": "x_start", "device": "cpu"},
        "state_normalizer": {name: [[row]] * agents for name, row in normaliser.items()},
    }
    file.match(file.name, ours, quantity=f"{NAME} args")
    file.finish()


@pytest.mark.files("sampler.json")
def test_sampler(path: Path, cases: Cases) -> None:
    file, schedule = read_file(path, cases), sampler.SCHEDULE
    ours = {
        "timesteps": schedule.times,
        "lambda": schedule.half_snr,
        "log_alpha": schedule.log_alpha,
        "alpha": schedule.alpha,
        "sigma": schedule.sigma,
        "final_denoise_t": sampler.LAST_TIME,
    }
    file.match(file.name, ours, SINGLE, quantity=NAME)
    numbers = np.arange(sampler.STEPS) + 1
    steps = {
        "step": numbers,
        "order": np.minimum(numbers, 2),
        "t": schedule.times[1:],
        **{"h": schedule.h, "c_x": schedule.c_x, "c_x0": schedule.c_x0},
        "r0": [np.nan, *schedule.r0.tolist()],
    }
    columns = {name: [step[name] for step in file.each("steps")] for name in steps}
    listed = File(file.name, "field", columns, cases)
    listed.match(file.name, steps, SINGLE, quantity=f"{NAME} sampler")
    file.finish()


@pytest.mark.files("forward_*.npz")
def test_forward(path: Path, cases: Cases) -> None:
    """The network on stored inputs, and all calls of the sampler by variant of the weights."""
    file = read_file(path, cases, path.stem)
    case, given = file.name.removeprefix("forward_"), file.below("in.")
    limits = ("lanes_speed_limit", "route_lanes_speed_limit")  # that of the route is read by nobody
    known = {name.replace("speed", "has_speed"): given[name] != 0.0 for name in limits}
    given.match(file.name, {"noise": start_noise(case)[None], **known}, quantity=NAME)
    inputs = {name: torch.from_numpy(given[name]) for name in (*INPUTS, limits[1])}
    network = make_planner(KeyedPlanner, "base").network
    with torch.no_grad():
        scene = network.normalise(inputs)
        route = network.dit.route_encoder(scene["route_lanes"])
        encoded = {"encoding": network.encode(scene), "route_encoding": route}
    normalised = {name: scene[name] for name in network.normalisers}
    file.below("norm.").match(file.name, normalised, NORMALISED, quantity=f"{NAME} normalised")
    file.below("out.").match(file.name, encoded, ENCODED, quantity=NAME)
    for variant in match_case(file, NAME):
        stored, where = file.below(f"out.{variant}."), f"{file.name} {variant}"
        with torch.no_grad():
            sampled, guided = sample(variant, scene, inputs, given["noise"])
        near, bound = drive_bound(variant, 5e-5, 1e-5), drive_bound(variant, 1e-3, 2e-4)  # 1, m
        atol = {"prediction": bound, "step_t": 2e-6, "step_ego_x": near}
        atol |= {"dit_first": 2e-5, "dit_last": near}
        stored.match(where, sampled, atol, quantity=NAME)
        stored.match(where, only(stored, guided), bound, quantity=NAME)
    file.finish()


def sample(
    variant: str, scene: Any, inputs: Any, start: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the sampler comes to with one variant of the weights, plain and guided.

    Of the calls of the network there are the inputs of the ego, and the first and last output.
    """
    network = make_planner(KeyedPlanner, variant).network
    current, absent = network.present(scene)
    context, noise = network.context(scene, absent), torch.from_numpy(start)
    egos, outputs = [], []

    def call(x: Any, number: int) -> Any:
        egos.append(x[0, 0].clone())
        outputs.append(network.dit(x, number, context))
        return outputs[-1]

    def sampled(function: Callable[[Any, int], Any]) -> Any:
        return network.denormalise(sampler.sample(function, current, noise)[:, :, 1:])

    plain = sampled(call)
    found = {
        "prediction": plain,
        "step_t": sampler.SCHEDULE.call_times,
        "step_ego_x": torch.stack(egos),
        "dit_first": outputs[0],
        "dit_last": outputs[-1],
    }
    guided = sampled(with_guidance(call, network, inputs["neighbor_agents_past"], absent))
    return found, {"guided_prediction": guided}


@pytest.mark.files("closed_loop_*.npz")
def test_closed_loop(path: Path, scenes: Scenes, cases: Cases) -> None:
    """Features, ids and all outputs are stored for some iterations, the encoding for fewer."""
    plans = ("trajectory_time_us", "trajectory", "ego_prediction")
    names = ["lanes", "lanes_speed_limit", "lanes_has_speed_limit", "route_lanes"]
    names += ["neighbor_agents_past", "ego_current_state", "static_objects"]
    for loop in loop_steps(path, KeyedPlanner, scenes, cases, plans):
        bound = drive_bound(loop.variant, 1e-3, 2e-4)  # m
        plan = {"trajectory_time_us": loop.answer.time_us, "trajectory": loop.answer.states[:, :7]}
        atol = {"trajectory": PLAN, "ego_prediction": bound}
        loop.match(loop.row, {**plan, "ego_prediction": loop.output[0]}, atol)
        if list(loop.stored):
            features, road = loop.features, loop.road
            ours = {
                "lane_ids": ids(road.edges, features.edges),
                "agent_tokens": [loop.tracks.tokens[i] for i in features.agents],
                "corrected_route_ids": ids(road.blocks, features.route or ()),
                "prediction": loop.output,
                **{f"feature/{name}": getattr(features, name) for name in names},
            }
            given = {name: getattr(features, name) for name in names}
            limits = route_limits(given, road.block_of[features.edges], features.route or ())
            ours |= {f"feature/{name}": value for name, value in limits.items()}
            loop.match(loop.stored, ours, {"": FEATURE, "prediction": bound})
        if "encoding" in loop.stored:
            network, inputs = loop.planner.network, make_inputs([loop.features], "cpu")
            with torch.no_grad():
                encoding = network.encode(network.normalise(inputs))[0]
            loop.match(loop.stored, {"encoding": encoding}, ENCODED)


@pytest.mark.files("overflow_agents_*.npz")
def test_many_agents(path: Path, cases: Cases) -> None:
    """Which agents and objects are kept where there are too many, and their histories."""
    file = read_file(path, cases, path.stem)
    match_meta(file, NAME, frame_columns=["track", *TRACK_COLUMNS[1:]])
    if f"in.frame{builder.SAMPLES:02d}" in file:
        file.note("older than what the network reads; says no more than the types", "in.frame00")
    found = builder.agent_features(recorded_tracks(file), file.take("in.anchor", 3))
    ours = dict(zip(("agents", "static", "selected"), found, strict=True))
    file.below("out.").match(file.name, ours, FEATURE, quantity=f"{NAME} many")
    file.finish()


def recorded_tracks(file: File) -> Tracks:
    """The frames as tracks, in the order of the last frame; static objects after them."""
    names = sorted(n for n in file if n.startswith("in.frame") and not n.endswith("_type"))
    last = len(names) - 1
    rows = [
        (row, AgentKind(kind).name, *values)
        for row in range(last, -1, -1)
        for kind, values in zip(file[f"{names[row]}_type"], file[names[row]].tolist(), strict=True)
    ]
    static = zip(file["in.static_type"], file["in.static"].tolist(), strict=True)
    rows += [
        (last, STATIC[kind], f"static {number}", np.nan, np.nan, heading, width, length, x, y)
        for number, (kind, (x, y, heading, width, length)) in enumerate(static)
    ]
    titles = ("iteration", "type", *TRACK_COLUMNS)
    columns = dict(zip(titles, map(np.array, zip(*rows, strict=True)), strict=True))
    return tracks_of(File(file.name, "column", columns, file.report), last + 1)


@pytest.mark.files("overflow_lanes_*.npz")
def test_many_lanes(path: Path, cases: Cases) -> None:
    """Which lanes and route lanes are kept where there are too many, and their rows."""
    file = read_file(path, cases, path.stem)
    match_meta(file, NAME, light="green, yellow, red, unknown")
    anchor, owner = file.take("in.anchor", 3), file["in.owner"].tolist()
    lines, left, right = (read_lines(file, n) for n in ("lane", "left_boundary", "right_boundary"))
    index = {name: block for block, name in enumerate(dict.fromkeys(owner))}
    limits = np.where(file["in.has_limit"], file["in.limit"].astype(np.float64), np.nan)
    blocks = np.array([index[name] for name in owner], np.int64)
    resampled = builder.resample_lanes(lines, left, right)
    lanes = builder.LaneLines(resampled, limits, blocks, shapely.STRtree([]))
    # the lanes come in the order of the distance to their areas, which are not there
    point = make_polygons([[anchor[:2] + np.array([[0, 0], [1, 0], [0, 1.0]])]] * len(owner))
    rows = np.arange(len(owner))
    edges = builder.nearest_lanes(rows, point, lines, anchor[0], anchor[1], builder.LANES)
    lights = file.take("in.light", len(owner), 4)
    once = np.ones(len(owner), np.int64)
    cases.compare(f"{NAME} lights", file.name, lights.sum(axis=1), once)
    route = [index.get(name, -1) for name in file["in.route"].tolist()]
    ours = builder.lane_inputs(lanes, edges, lights.argmax(axis=1)[edges], anchor, route)
    ours |= route_limits(ours, blocks[edges], route)
    file.below("out.").match(file.name, ours, FEATURE, quantity=f"{NAME} many")
    file.finish()


def route_limits(lanes: Mapping[str, Any], blocks: Any, route: Any) -> dict[str, Any]:
    """Speed limits of the lanes on a route, which the network does not read."""
    on_route, out = builder.lanes_on_route(blocks, route), {}
    for name in ("lanes_speed_limit", "lanes_has_speed_limit"):
        out[f"route_{name}"] = np.zeros_like(lanes[name][: builder.ROUTE_LANES])
        out[f"route_{name}"][: len(on_route)] = lanes[name][on_route]
    return out


def read_lines(file: File, name: str) -> Polylines:
    xy, lengths = file.take(f"in.{name}", -1, 2), file.take(f"in.{name}_len", -1)
    assert lengths.sum() == len(xy), f"array 'in.{name}_len' does not divide 'in.{name}'"
    return make_polylines(np.split(xy, np.cumsum(lengths)[:-1]))


def manifest(network: Any) -> dict[str, Any]:
    layer = "decoder.decoder.dit.final_layer.proj.4"
    return {
        "noise": "start noise of a case or of an iteration: standard_normal((1,11,80,4)) of "
        "PCG64(crc32('noise:'+key)), cast to float32; key = case name for forward_*.npz, "
        "'<scenario token>:<iteration>' in closed loop",
        "checkpoint": {
            **{"file": ANY, "container": ANY},
            "prefix": f"module.{ANY}",
            "used_key": f"ema_state_dict {ANY}",
        },
        "drive_overrides": {
            f"{layer}.weight": (
                "shape (324,768), row 4*t+c (t=0..80, c=0..3): amp[c]*(t/80)*u[c], "
                "amp=[0.3,0.05,0,0.05], u = standard_normal((4,768)) of "
                f"PCG64(crc32('{layer}.weight#drive')) / sqrt(768)"
            ),
            f"{layer}.bias": "element 4*t+c: [(0.6*t-10)/20, 0, 1, 0][c]",
        },
    }


@pytest.mark.files("state_dict.json")
def test_manifest(path: Path, cases: Cases) -> None:
    weights = {"parameters": "", "parameters_encoder": "encoder"}
    compare_manifest(path, cases, KeyedPlanner, manifest, weights)


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    known = [f"{name}_*.npz" for name in ("forward", "closed_loop", "overflow_agents")]
    known += ["overflow_lanes_*.npz", "args.json", "sampler.json", "state_dict.json"]
    name_unknown(folder, cases, *known)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("test", "file", "name", "index"),
    [
        *(
            (test_forward, "forward_empty", name, 0)
            for name in ("in.noise", "norm.lanes", "out.encoding", "out.base.prediction")
        ),
        *((test_many_agents, "overflow_agents_b", name, 0) for name in ("out.agents", "in.anchor")),
        *((test_many_lanes, "overflow_lanes_b", name, 0) for name in ("out.lanes", "in.light")),
        *(
            (test_closed_loop, "closed_loop_s01_lead_brakes", name, 0)
            for name in ("out/trajectory", "it00/lane_ids", "it00/feature/lanes", "it00/prediction")
        ),
    ],
)
def test_a_changed_value_is_noticed(
    test: Any, file: str, name: str, index: int, tmp_path: Path, nuplan_reference: Path
) -> None:
    path, cases = tmp_path / f"{file}.npz", Cases()
    change_array(GOLDEN / path.name, path, name, index, amount=0.05)
    scenes = (open_scenes(nuplan_reference),) if test is test_closed_loop else ()
    assert noticed(test, path, *scenes, cases)


@pytest.mark.parametrize(
    ("test", "file", "keys"),
    [
        (test_args, "args.json", ("diffusion_model_type",)),
        (test_sampler, "sampler.json", ("steps", 4, "c_x0")),
        (test_sampler, "sampler.json", ("lambda", 0)),
        (test_manifest, "state_dict.json", ("entries", 5, "rule")),
        (test_manifest, "state_dict.json", ("noise",)),
        (test_manifest, "state_dict.json", ("selfcheck", "first3_raw_z", 0)),
    ],
)
def test_a_changed_setting_is_noticed(test: Any, file: str, keys: Any, tmp_path: Path) -> None:
    cases = Cases()
    change_json(GOLDEN / file, tmp_path / file, *keys)
    assert noticed(test, tmp_path / file, cases)
