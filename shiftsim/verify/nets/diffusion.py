"""Diffusion Planner: settings, schedule, network, features and closed loops.

Everything is made from the scene's own log and map; stored features are only compared with.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.planners.learned.deterministic import keyed_normals
from shiftsim.planners.learned.diffusion import features as builder
from shiftsim.planners.learned.diffusion import kernels
from shiftsim.planners.learned.diffusion.planner import INPUTS, NOISE_SHAPE, DiffusionPlanner
from shiftsim.sim.planner import Observation
from shiftsim.verify.files import Source
from shiftsim.verify.nets import networks
from shiftsim.verify.nets.loops import PLANS, POSITION, Loop, verify_loop
from shiftsim.verify.nets.networks import FEATURE, make_network, match_meta
from shiftsim.verify.scenes import Scenes
from shiftsim.verify.worlds import make_tracks
from shiftsim.world.layers import Polylines, make_polygons, make_polylines
from shiftsim.world.state import AgentKind, Tracks

NAME = DiffusionPlanner.name
NETWORK = 2e-5  # one call of encoder or decoder
SAMPLED = {"base": 1e-3, "drive": 2e-4}  # m, after all calls
SCALE = 20.0  # m, of what the network calls 1
SCHEDULE = 2e-6  # single precision, about 1
NORMALISED = 1e-6

_DRIVE = (
    "shape (324,768), row 4*t+c (t=0..80, c=0..3): amp[c]*(t/80)*u[c], amp=[0.3,0.05,0,0.05], "
    "u = standard_normal((4,768)) of PCG64(crc32('{0}.weight#drive')) / sqrt(768)",
    "element 4*t+c: [(0.6*t-10)/20, 0, 1, 0][c]",
)
_NOISE = (
    "start noise of a case or of an iteration: standard_normal((1,11,80,4)) of "
    "PCG64(crc32('noise:'+key)), cast to float32; key = case name for forward_*.npz, "
    "'<scenario token>:<iteration>' in closed loop"
)
_OTHER_ARGS = {  # of training, or fixed by the features
    "agent_state_dim": 11,
    "static_objects_state_dim": 10,
    "lane_state_dim": 12,
    "route_state_dim": 12,
    "encoder_drop_path_rate": 0.1,
    "decoder_drop_path_rate": 0.1,
    "diffusion_model_type": "x_start",
    "device": "cpu",
}
_TRACK_COLUMNS = ["track", "vx", "vy", "heading", "width", "length", "x", "y"]
_STATIC = ("CZONE_SIGN", "BARRIER", "TRAFFIC_CONE", "GENERIC_OBJECT")


def start_noise(key: str) -> np.ndarray:
    """(11, 80, 4) float32, of a case or of an iteration."""
    return keyed_normals(f"noise:{key}", (1, *NOISE_SHAPE)).astype(np.float32)[0]


class KeyedPlanner(DiffusionPlanner):
    """The planner with the start noise of the reference files."""

    def features(self, observation: Observation) -> builder.Features:
        """What the network reads."""
        _, token = self._key
        noise = start_noise(f"{token}:{observation.iteration}")
        return replace(super().features(observation), noise=noise)


def _manifest(network: Any) -> dict[str, Any]:
    last, prefix = "decoder.decoder.dit.final_layer.proj.4", re.escape(network.PREFIXES[0])
    starts = {"prefix": re.compile(prefix), "used_key": re.compile(r"ema_state_dict\b")}
    return {
        "checkpoint": {"file": networks.PROSE, "container": networks.PROSE, **starts},
        "drive_overrides": {f"{last}.weight": _DRIVE[0].format(last), f"{last}.bias": _DRIVE[1]},
        "noise": _NOISE,
    }


def _verify_args(file: Source, scenes: Scenes) -> None:
    """The bundled settings must be those of the file; both normalisers too."""
    from shiftsim.planners.learned.diffusion.network import DEFAULT_ARGS

    agents, normaliser = 1 + int(file["predicted_neighbor_num"]), DEFAULT_ARGS["state_normalizer"]
    rows = {name: [[row]] * agents for name, row in normaliser.items()}
    ours = {**DEFAULT_ARGS, **_OTHER_ARGS, "state_normalizer": rows}
    file.match(file.name, ours, quantity=f"{NAME} args")


def _verify_sampler(file: Source, scenes: Scenes) -> None:
    from shiftsim.planners.learned.diffusion.network import sampler

    made, numbers = sampler.SCHEDULE, np.arange(sampler.STEPS) + 1
    ours = {
        "timesteps": made.times,
        "lambda": made.half_snr,
        "log_alpha": made.log_alpha,
        "alpha": made.alpha,
        "sigma": made.sigma,
        "final_denoise_t": sampler.LAST_TIME,
    }
    file.match(file.name, ours, SCHEDULE, quantity=NAME)
    steps = {
        "step": numbers,
        "order": np.minimum(numbers, 2),
        "t": made.times[1:],
        "h": made.h,
        "c_x": made.c_x,
        "c_x0": made.c_x0,
        "r0": np.array([np.nan, *made.r0.tolist()]),
    }
    listed = file.each("steps")
    for name, values in steps.items():
        theirs = [step[name] for step in listed]
        file.report.compare(f"{NAME} sampler {name}", file.name, values, theirs, atol=SCHEDULE)


def _verify_forward(file: Source, scenes: Scenes) -> None:
    """The network on stored inputs."""
    import torch

    case, given = file.name.removeprefix("forward_"), file.below("in.")
    limits = ("lanes_speed_limit", "route_lanes_speed_limit")  # that of the route is read by nobody
    known = {name.replace("speed", "has_speed"): given[name] != 0.0 for name in limits}
    given.match(file.name, {"noise": start_noise(case)[None], **known}, quantity=NAME)
    with torch.inference_mode():
        inputs = {name: torch.from_numpy(given[name]) for name in (*INPUTS, limits[1])}
        network = make_network(NAME, "base")
        scene = network.normalise(inputs)
        normalised = {name: scene[name] for name in network.normalisers}
        file.below("norm.").match(file.name, normalised, NORMALISED, quantity=f"{NAME} normalised")
        encoded = {
            "encoding": network.encode(scene),
            "route_encoding": network.dit[0].route_encoder(scene["route_lanes"]),
        }
        file.below("out.").match(file.name, encoded, NETWORK, quantity=NAME)
        for variant in networks.match_case(file, NAME):
            _verify_sampling(file, variant, scene, inputs)


def _verify_sampling(
    file: Source, variant: str, scene: dict[str, Any], inputs: dict[str, Any]
) -> None:
    """All calls of the sampler with one variant of the weights."""
    import torch

    from shiftsim.planners.learned.diffusion.network import sampler
    from shiftsim.planners.learned.diffusion.network.guidance import with_guidance

    network, stored = make_network(NAME, variant), file.below(f"out.{variant}.")
    current, absent = network.present(scene)
    prepared, noise = network.prepare(scene, absent), torch.from_numpy(file["in.noise"])
    seen, made = [], []

    def call(x: Any, number: int) -> Any:
        seen.append(x[0, 0].clone())
        made.append(prepared(x, number))
        return made[-1]

    def sampled(function: Callable[[Any, int], Any]) -> Any:
        return network.denormalise(sampler.sample(function, current, noise)[:, :, 1:])

    ours = {"prediction": sampled(call), "step_t": sampler.SCHEDULE.call_times}
    # of the calls behind the first the ego's input and the last output are stored
    ours |= {"dit_first": made[0], "step_ego_x": torch.stack(seen), "dit_last": made[-1]}
    if "guided_prediction" in stored:
        guided = with_guidance(call, network, inputs["neighbor_agents_past"], absent)
        ours["guided_prediction"] = sampled(guided)
    metres = dict.fromkeys(("prediction", "guided_prediction"), SAMPLED[variant])
    bounds = {**metres, "step_t": SCHEDULE, "dit_first": NETWORK, "": SAMPLED[variant] / SCALE}
    stored.match(f"{file.name} {variant}", ours, bounds, quantity=NAME)


def _compare(loop: Loop) -> None:
    """Compare one iteration; features, ids and all outputs are stored for some."""
    import torch

    bound = SAMPLED[loop.variant]
    loop.compare("ego_prediction", loop.output[0], loop.row["ego_prediction"], bound)
    loop.compare_plan(POSITION)
    if not list(loop.stored):
        return
    features, road, tokens = loop.features, loop.scenario.map, loop.scenario.tracks.tokens
    names = (*INPUTS, "route_lanes_speed_limit", "route_lanes_has_speed_limit")
    ours = {
        "lane_ids": [road.edges.ids[edge] for edge in features.edges.tolist()],
        "agent_tokens": [tokens[track] for track in features.agents.tolist()],
        "corrected_route_ids": [road.blocks.ids[block] for block in features.route or ()],
        "prediction": loop.output,
        **{f"feature/{name}": getattr(features, name) for name in names},
    }
    if "encoding" in loop.stored:
        with torch.inference_mode():
            network, (inputs, _) = loop.planner.network, loop.planner.batch([features])
            ours["encoding"] = network.encode(network.normalise(inputs))[0]
    loop.match(ours, {"prediction": bound, "encoding": NETWORK, "": FEATURE})


def _verify_agents(file: Source, scenes: Scenes) -> None:
    """Which agents and objects are kept where there are too many, and their histories."""
    match_meta(file, NAME, {"frame_columns": _TRACK_COLUMNS})
    if f"in.frame{kernels.SAMPLES:02d}" in file:
        file.note("older than what the network reads; says no more than the types", "in.frame00")
    made = builder.agent_features(_tracks(file), file.take("in.anchor", 3))
    ours = dict(zip(("agents", "static", "selected"), made, strict=True))
    file.below("out.").match(file.name, ours, FEATURE, quantity=f"{NAME} many")


def _tracks(file: Source) -> Tracks:
    """The frames as tracks, in the order of the last frame; static objects after them."""
    names = sorted(n for n in file if n.startswith("in.frame") and not n.endswith("_type"))
    frames = [file.take(name, -1, len(_TRACK_COLUMNS)) for name in names]
    typed = [
        pair
        for name, frame in zip(names[::-1], frames[::-1], strict=True)
        for pair in zip(frame[:, 0].tolist(), file[f"{name}_type"].tolist(), strict=True)
    ]
    kinds = dict(typed)
    if len(set(typed)) != len(kinds):
        raise DataError("a track changes its type")
    static = file.take("in.static", -1, 5)
    types = file.take("in.static_type", len(static)).tolist()
    column = {track: index for index, track in enumerate(kinds)}
    moving = np.concatenate(frames)
    samples = [*np.repeat(np.arange(len(frames)), [len(f) for f in frames]), *[-1] * len(static)]
    columns = [column[track] for track in moving[:, 0].tolist()]
    columns += range(len(column), len(column) + len(static))
    values = np.full((len(columns), 7), np.nan)
    values[: len(moving)] = moving[:, [6, 7, 3, 1, 2, 5, 4]]
    values[len(moving) :, [0, 1, 2, 6, 5]] = static
    words = [*(AgentKind(kind).name for kind in kinds.values()), *(_STATIC[t] for t in types)]
    shape = (len(frames), len(words))
    return make_tracks(shape, (samples, columns), values, words, tuple(map(str, range(shape[1]))))


def _verify_lanes(file: Source, scenes: Scenes) -> None:
    """Which lanes and route lanes are kept where there are too many, and their rows."""
    match_meta(file, NAME, {"light": "green, yellow, red, unknown"})
    anchor, owner = file.take("in.anchor", 3), file["in.owner"].tolist()
    lines, left, right = (_lines(file, n) for n in ("lane", "left_boundary", "right_boundary"))
    index = {name: block for block, name in enumerate(dict.fromkeys(owner))}
    limits = np.where(file["in.has_limit"], file["in.limit"].astype(np.float64), np.nan)
    blocks = np.array([index[name] for name in owner], np.int64)
    resampled = kernels.resample_lanes(lines, left, right)
    lanes = kernels.LaneLines(resampled, kernels.line_bounds(lines), limits, blocks)
    # the lanes come in the order of the distance to their areas, which are not there
    point = make_polygons([[anchor[:2] + np.array([[0, 0], [1, 0], [0, 1.0]])]] * len(owner))
    edges = kernels.nearest_lanes(
        np.arange(len(owner)), point, lines, anchor[0], anchor[1], builder.LANES
    )
    lights = file.take("in.light", len(owner), 4)
    once = np.ones(len(owner), np.int64)
    file.report.compare(f"{NAME} lights", file.name, lights.sum(axis=1), once)
    rows = builder.lane_features(lanes, edges, lights.argmax(axis=1)[edges], anchor, builder.LANES)
    route = [index.get(name, -1) for name in file["in.route"].tolist()]
    on_route = builder.lanes_on_route(lanes.blocks[edges], route)
    ours = dict(zip(("lanes", "lanes_speed_limit", "lanes_has_speed_limit"), rows, strict=True))
    for name, array in list(ours.items()):
        ours[f"route_{name}"] = np.zeros((builder.ROUTE_LANES, *array.shape[1:]), array.dtype)
        ours[f"route_{name}"][: len(on_route)] = array[on_route]
    file.below("out.").match(file.name, ours, FEATURE, quantity=f"{NAME} many")


def _lines(file: Source, name: str) -> Polylines:
    xy, lengths = file.take(f"in.{name}", -1, 2), file.take(f"in.{name}_len", -1)
    if lengths.sum() != len(xy):
        raise DataError(f"array 'in.{name}_len' does not divide 'in.{name}' into lines")
    return make_polylines(np.split(xy, np.cumsum(lengths)[:-1]))


_SIZES = {"parameters": "", "parameters_encoder": "encoder"}
FILES = {
    "args.json": _verify_args,
    "sampler.json": _verify_sampler,
    "state_dict.json": partial(networks.verify_manifest, NAME, _SIZES, _manifest),
    "forward_*.npz": _verify_forward,
    "closed_loop_*.npz": partial(verify_loop, KeyedPlanner, _compare, (*PLANS, "ego_prediction")),
    "overflow_agents_*.npz": _verify_agents,
    "overflow_lanes_*.npz": _verify_lanes,
}
