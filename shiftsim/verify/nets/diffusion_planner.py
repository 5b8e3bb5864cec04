"""Diffusion Planner: settings, schedule, network, features and closed loops.

Everything is made from the scene's own log and map; stored features are only compared with.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.planners.learned.deterministic import keyed_normals
from shiftsim.planners.learned.diffusion import features as builder
from shiftsim.planners.learned.diffusion import kernels
from shiftsim.planners.learned.diffusion.planner import INPUTS, NOISE_SHAPE, DiffusionPlanner
from shiftsim.sim.planner import Observation
from shiftsim.verify.files import Source
from shiftsim.verify.nets import common
from shiftsim.verify.tables import read_tables
from shiftsim.verify.worlds import tracks_of
from shiftsim.world.layers import Polylines, make_polygons, make_polylines
from shiftsim.world.state import AgentKind, Tracks

NAME, TABLES = DiffusionPlanner.name, read_tables(__file__)
NORMALISED = 1e-6
FEATURE = 5e-5  # m, rad, …: features are stored as 32 bit floats
_TRACK_COLUMNS = ["track_token", "vx", "vy", "heading", "width", "length", "x", "y"]
_STATIC = ("CZONE_SIGN", "BARRIER", "TRAFFIC_CONE", "GENERIC_OBJECT")


def start_noise(key: str) -> np.ndarray:
    """(11, 80, 4) float32, of a case or of an iteration."""
    return keyed_normals(f"noise:{key}", (1, *NOISE_SHAPE)).astype(np.float32)[0]


class KeyedPlanner(DiffusionPlanner):
    """The planner with the start noise of the reference files."""

    def features(self, observation: Observation) -> builder.Features:
        """What the network reads."""
        noise = start_noise(f"{self._key[1]}:{observation.iteration}")
        return replace(super().features(observation), noise=noise)


def _verify_args(file: Source) -> None:
    """The bundled settings must be those of the file; both normalisers too."""
    from shiftsim.planners.learned.diffusion.network import DEFAULT_ARGS

    agents, normaliser = 1 + int(file["predicted_neighbor_num"]), DEFAULT_ARGS["state_normalizer"]
    rows = {name: [[row]] * agents for name, row in normaliser.items()}
    ours = {**DEFAULT_ARGS, **TABLES["args"].rows, "state_normalizer": rows}
    file.match(file.name, ours, quantity=f"{NAME} args")


def _verify_sampler(file: Source) -> None:
    from shiftsim.planners.learned.diffusion import network_sampler as sampler

    numbers = np.arange(sampler.STEPS) + 1
    names = {"sampler": sampler, "made": sampler.SCHEDULE, "numbers": numbers}
    names |= {"orders": np.minimum(numbers, 2), "r0": [np.nan, *sampler.SCHEDULE.r0.tolist()]}
    TABLES["sampler"].match(file, file.name, NAME, **names)
    steps = {name: [step[name] for step in file.each("steps")] for name in TABLES["steps"].rows}
    listed = Source(file.name, "field", steps, file.report)
    TABLES["steps"].match(listed, file.name, f"{NAME} sampler", **names)


def _verify_forward(file: Source) -> None:
    """The network on stored inputs, and all calls of the sampler by variant of the weights."""
    import torch

    case, given = file.name.removeprefix("forward_"), file.below("in.")
    limits = ("lanes_speed_limit", "route_lanes_speed_limit")  # that of the route is read by nobody
    known = {name.replace("speed", "has_speed"): given[name] != 0.0 for name in limits}
    given.match(file.name, {"noise": start_noise(case)[None], **known}, quantity=NAME)
    inputs = {name: torch.from_numpy(given[name]) for name in (*INPUTS, limits[1])}
    network = common.make_planner(KeyedPlanner, "base").network
    scene = network.normalise(inputs)
    normalised = {name: scene[name] for name in network.normalisers}
    file.below("norm.").match(file.name, normalised, NORMALISED, quantity=f"{NAME} normalised")
    encoded, route = network.encode(scene), network.dit.route_encoder(scene["route_lanes"])
    TABLES["encoded"].match(file.below("out."), file.name, NAME, encoding=encoded, route=route)
    for variant in common.match_case(file, NAME):
        says = _sampled(variant, scene, inputs, given["noise"])
        stored, where = file.below(f"out.{variant}."), f"{file.name} {variant}"
        for section in ("sampled", "guided"):
            TABLES[section].match(stored, where, NAME, variant=variant, **says)


def _sampled(variant: str, scene: Any, inputs: Any, start: Any) -> dict[str, Any]:
    """What the sampler comes to with one variant of the weights, and its calls of the network."""
    import torch

    from shiftsim.planners.learned.diffusion import network_sampler as sampler
    from shiftsim.planners.learned.diffusion.network_guidance import with_guidance

    network = common.make_planner(KeyedPlanner, variant).network
    current, absent = network.present(scene)
    context, noise = network.context(scene, absent), torch.from_numpy(start)
    seen, made = [], []

    def call(x: Any, number: int) -> Any:
        seen.append(x[0, 0].clone())
        made.append(network.dit(x, number, context))
        return made[-1]

    def sampled(function: Callable[[Any, int], Any]) -> Any:
        return network.denormalise(sampler.sample(function, current, noise)[:, :, 1:])

    plain, calls = sampled(call), {"seen": torch.stack(seen), "first": made[0], "last": made[-1]}
    guided = sampled(with_guidance(call, network, inputs["neighbor_agents_past"], absent))
    return {**calls, "plain": plain, "guided": guided, "times": sampler.SCHEDULE.call_times}


def compare(loop: common.Loop) -> None:
    """Compare one iteration; features, ids and all outputs are stored for some."""
    loop.match("iteration", loop.row)
    if list(loop.stored):
        loop.match("stored", loop.stored, route=loop.features.route or ())
    if "encoding" in loop.stored:
        network, (inputs, _) = loop.planner.network, loop.planner.batch([loop.features])
        encoding = network.encode(network.normalise(inputs))[0]
        loop.match("encoding", loop.stored, encoding=encoding)


def _verify_agents(file: Source) -> None:
    """Which agents and objects are kept where there are too many, and their histories."""
    common.match_meta(file, NAME, frame_columns=["track", *_TRACK_COLUMNS[1:]])
    if f"in.frame{kernels.SAMPLES:02d}" in file:
        file.note("older than what the network reads; says no more than the types", "in.frame00")
    made = builder.agent_features(_tracks(file), file.take("in.anchor", 3))
    ours = dict(zip(("agents", "static", "selected"), made, strict=True))
    file.below("out.").match(file.name, ours, FEATURE, quantity=f"{NAME} many")


def _tracks(file: Source) -> Tracks:
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
        (last, _STATIC[kind], f"static {number}", np.nan, np.nan, heading, width, length, x, y)
        for number, (kind, (x, y, heading, width, length)) in enumerate(static)
    ]
    titles = ("iteration", "type", *_TRACK_COLUMNS)
    columns = dict(zip(titles, map(np.array, zip(*rows, strict=True)), strict=True))
    return tracks_of(Source(file.name, "column", columns, file.report), last + 1)


def _verify_lanes(file: Source) -> None:
    """Which lanes and route lanes are kept where there are too many, and their rows."""
    common.match_meta(file, NAME, light="green, yellow, red, unknown")
    anchor, owner = file.take("in.anchor", 3), file["in.owner"].tolist()
    lines, left, right = (_lines(file, n) for n in ("lane", "left_boundary", "right_boundary"))
    index = {name: block for block, name in enumerate(dict.fromkeys(owner))}
    limits = np.where(file["in.has_limit"], file["in.limit"].astype(np.float64), np.nan)
    blocks = np.array([index[name] for name in owner], np.int64)
    resampled = kernels.resample_lanes(lines, left, right)
    lanes = kernels.LaneLines(resampled, kernels.line_bounds(lines), limits, blocks)
    # the lanes come in the order of the distance to their areas, which are not there
    point = make_polygons([[anchor[:2] + np.array([[0, 0], [1, 0], [0, 1.0]])]] * len(owner))
    rows = np.arange(len(owner))
    edges = kernels.nearest_lanes(rows, point, lines, anchor[0], anchor[1], builder.LANES)
    lights = file.take("in.light", len(owner), 4)
    once = np.ones(len(owner), np.int64)
    file.report.compare(f"{NAME} lights", file.name, lights.sum(axis=1), once)
    route = [index.get(name, -1) for name in file["in.route"].tolist()]
    ours = builder.lane_inputs(lanes, edges, lights.argmax(axis=1)[edges], anchor, route)
    file.below("out.").match(file.name, ours, FEATURE, quantity=f"{NAME} many")


def _lines(file: Source, name: str) -> Polylines:
    xy, lengths = file.take(f"in.{name}", -1, 2), file.take(f"in.{name}_len", -1)
    if lengths.sum() != len(xy):
        raise DataError(f"array 'in.{name}_len' does not divide 'in.{name}' into lines")
    return make_polylines(np.split(xy, np.cumsum(lengths)[:-1]))


PLANNER = KeyedPlanner
FILES = {
    "args.json": _verify_args,
    "sampler.json": _verify_sampler,
    "forward_*.npz": _verify_forward,
    "overflow_agents_*.npz": _verify_agents,
    "overflow_lanes_*.npz": _verify_lanes,
}
