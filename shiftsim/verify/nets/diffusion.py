"""Diffusion Planner: settings, schedule, network, features and closed loops (planner-diffusion.md).

Everything is made from the scene's own log and map; stored features are only compared with.
"""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.geometry.frames import wrap_angles
from shiftsim.planners.learned.deterministic import keyed_normals
from shiftsim.planners.learned.diffusion.features import FeatureBuilder, Features, lane_lines
from shiftsim.planners.learned.diffusion.planner import (
    INPUTS,
    NOISE_SHAPE,
    decode_ego,
    why_makeshift,
)
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nets.common import (
    ERRORS,
    FEATURE,
    HEADING,
    POSITION,
    Loop,
    Scenes,
    compare_driven,
    make_network,
    open_loop,
    verify_state_dict,
)
from shiftsim.verify.nets.diffusion_selection import verify_agents, verify_lanes
from shiftsim.verify.nuplan.reading import read_json
from shiftsim.verify.report import Report
from shiftsim.world.state import NUM_STATE, Command, Trajectory

NAME = "diffusion_planner"
NETWORK = 2e-5  # one call of encoder or decoder
SAMPLED = {"base": 1e-3, "drive": 2e-4}  # m, after all calls
SCALE = 20.0  # m, of what the network calls 1
SCHEDULE = 2e-6  # single precision, about 1
_PLAN = ("x", "y", "heading", "vx", "vy", "ax", "ay")  # columns of stored plans

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


def verify_diffusion(folder: Path, report: Report, scenes: Scenes) -> None:
    """Compare every file of the folder.

    Args:
        folder: The folder `diffusion_planner`.
        report: Receives the comparisons.
        scenes: The scenes of the closed loops.
    """
    networks = _Networks(folder)
    by_name: dict[str, Callable[[Path], None]] = {
        "args.json": lambda path: _verify_args(path, report),
        "sampler.json": lambda path: _verify_sampler(path, report),
        "state_dict.json": lambda path: verify_state_dict(path, report, NAME, _manifest()),
    }
    by_start: dict[str, Callable[[Path], None]] = {
        "forward_": lambda path: _verify_forward(path, report, networks),
        "closed_loop_": lambda path: _verify_loop(path, report, scenes, networks),
        "overflow_agents_": lambda path: verify_agents(path, report),
        "overflow_lanes_": lambda path: verify_lanes(path, report),
    }
    for path in sorted(folder.iterdir()):
        start = next((s for s in by_start if path.name.startswith(s)), "")
        verify = by_name.get(path.name) or (by_start.get(start) if path.suffix == ".npz" else None)
        if verify is None:
            report.skip(f"{NAME}: file {path.name}")
            continue
        try:
            verify(path)
        except ERRORS as error:
            why = f"cannot be compared: {type(error).__name__} {error}"
            report.fail(f"{NAME} file", path.name, why)
    for name in (*by_name, *(f"{start}*.npz" for start in by_start)):
        if not any(folder.glob(name)):
            report.note(f"{NAME}: the folder has no {name}")


class _Networks:
    """Networks by variant of their weights, made when first asked for."""

    def __init__(self, folder: Path) -> None:
        path = folder / "args.json"
        self._args = read_json(path) if path.is_file() else None
        self._made: dict[str, Any] = {}

    def __call__(self, variant: str) -> Any:
        if variant not in self._made:
            self._made[variant] = make_network(NAME, variant, self._args)
        return self._made[variant]


def _verify_args(path: Path, report: Report) -> None:
    """The bundled settings must be those of the file; both normalisers too."""
    from shiftsim.planners.learned.diffusion.network import DEFAULT_ARGS

    given = read_json(path)
    ours = {**DEFAULT_ARGS, **_OTHER_ARGS}
    row = {name: np.array(ours["state_normalizer"][name]) for name in ("mean", "std")}
    agents = 1 + int(given["predicted_neighbor_num"])
    ours["state_normalizer"] = {
        name: np.broadcast_to(value, (agents, 1, len(value))) for name, value in row.items()
    }
    _compare_tree(report, path.name, ours, given)


def _compare_tree(report: Report, where: str, ours: Any, given: Any) -> None:
    if not isinstance(given, Mapping) or not isinstance(ours, Mapping):
        report.compare(f"{NAME} args", where, ours, given)
        return
    for name in sorted({*given, *ours}):
        if name not in ours:
            report.skip(f"{NAME} {where}: field {name!r}")
        elif name not in given:
            report.fail(f"{NAME} args", where, f"no field {name!r}")
        else:
            _compare_tree(report, f"{where} {name}", ours[name], given[name])


def _verify_sampler(path: Path, report: Report) -> None:
    from shiftsim.planners.learned.diffusion.network import sampler

    made, given = sampler.SCHEDULE, read_json(path)
    ours: dict[str, Any] = {
        "timesteps": made.times.numpy(),
        "lambda": made.half_snr.numpy(),
        "log_alpha": made.log_alpha.numpy(),
        "alpha": made.alpha.numpy(),
        "sigma": made.sigma.numpy(),
        "final_denoise_t": sampler.LAST_TIME,
    }
    steps = [
        {
            "step": i + 1,
            "order": 1 if i == 0 else 2,
            "t": float(made.times[i + 1]),
            "h": float(made.h[i]),
            "c_x": float(made.c_x[i]),
            "c_x0": float(made.c_x0[i]),
            "r0": np.nan if i == 0 else float(made.r0[i - 1]),
        }
        for i in range(sampler.STEPS)
    ]
    report.compare(f"{NAME} sampler steps", path.name, len(steps), len(given["steps"]))
    pairs = [("", ours, {n: v for n, v in given.items() if n != "steps"})]
    pairs += [(f"step {i + 1}", *pair) for i, pair in enumerate(zip(steps, given["steps"]))]  # noqa: B905  # lengths are compared above
    for where, mine, theirs in pairs:
        report.compare(f"{NAME} sampler fields", where, sorted(mine), sorted(theirs))
        for name in sorted(set(mine) & set(theirs)):
            value = np.nan if theirs[name] is None else theirs[name]
            report.compare(f"{NAME} sampler {name}", where, mine[name], value, atol=SCHEDULE)


def _manifest() -> dict[str, Callable[[Any], object] | None]:
    """Fields of state_dict.json beside the entries."""
    from shiftsim.planners.learned.diffusion.network import PREFIXES, build_network

    network = build_network()
    last = "decoder.decoder.dit.final_layer.proj.4"
    drive = {f"{last}.weight": _DRIVE[0].format(last), f"{last}.bias": _DRIVE[1]}
    return {
        "parameters": lambda _: sum(value.numel() for value in network.parameters()),
        "parameters_encoder": lambda _: sum(v.numel() for v in network.encoder.parameters()),
        "checkpoint": lambda given: {
            **given,
            "prefix": PREFIXES[0] + given["prefix"][len(PREFIXES[0]) :],
            "used_key": re.sub(r"^\w+", "ema_state_dict", given["used_key"]),
        },
        "drive_overrides": lambda _: drive,
        "noise": lambda _: _NOISE,
    }


def _verify_forward(path: Path, report: Report, networks: _Networks) -> None:
    """The network on stored inputs."""
    import torch

    file = ArrayFile(path, report)
    meta = json.loads(str(file["meta"]))
    case = path.stem.removeprefix("forward_")
    variants = sorted({n.split(".")[1] for n in file.arrays if n.count(".") > 1})
    expected = {"case": case, "variants": variants}
    report.compare(
        f"{NAME} meta", path.name, [*map(str, expected.items())], [*map(str, meta.items())]
    )
    given = {name: file[f"in.{name}"] for name in INPUTS}
    noise = keyed_normals(f"noise:{case}", (1, *NOISE_SHAPE)).astype(np.float32)
    report.compare(f"{NAME} start noise", path.name, noise, file["in.noise"])
    given["route_lanes_speed_limit"] = file["in.route_lanes_speed_limit"]
    for name in ("lanes", "route_lanes"):  # those of the route are read by nobody
        limits, known = given[f"{name}_speed_limit"], file[f"in.{name}_has_speed_limit"]
        report.compare(f"{NAME} has limit", f"{path.name} {name}", limits != 0.0, known)
    with torch.inference_mode():
        inputs = {name: torch.from_numpy(value) for name, value in given.items()}
        scene = networks("base").normalise(inputs)
        for name, value in scene.items():
            if name in networks("base").normalisers:
                _compare(file, "normalised", f"norm.{name}", value, 1e-6)
        _compare(file, "encoding", "out.encoding", networks("base").encode(scene), NETWORK)
        route = networks("base").dit[0].route_encoder(scene["route_lanes"])
        _compare(file, "route encoding", "out.route_encoding", route, NETWORK)
        for variant in variants:
            _verify_sampling(file, variant, networks(variant), scene, inputs)
    file.finish()


def _verify_sampling(
    file: ArrayFile, variant: str, network: Any, scene: dict[str, Any], inputs: dict[str, Any]
) -> None:
    """All calls of the sampler with one variant of the weights."""
    import torch

    from shiftsim.planners.learned.diffusion.network.guidance import with_guidance
    from shiftsim.planners.learned.diffusion.network.sampler import SCHEDULE as TIMES
    from shiftsim.planners.learned.diffusion.network.sampler import sample

    current, absent = network.present(scene)
    prepared = network.prepare(scene, absent)
    noise = torch.from_numpy(file["in.noise"])
    seen, made = [], []

    def call(x: Any, number: int) -> Any:
        seen.append(x[0, 0].clone())
        made.append(prepared(x, number))
        return made[-1]

    def sampled(function: Callable[[Any, int], Any]) -> Any:
        return network.denormalise(sample(function, current, noise)[:, :, 1:])

    start, bound = f"out.{variant}.", SAMPLED[variant]
    _compare(file, f"prediction {variant}", f"{start}prediction", sampled(call), bound)
    _compare(file, "call times", f"{start}step_t", TIMES.call_times, SCHEDULE)
    _compare(file, "first call", f"{start}dit_first", made[0], NETWORK)
    # of the other calls the ego's input and the last output are stored
    _compare(file, "ego in calls", f"{start}step_ego_x", torch.stack(seen), bound / SCALE)
    _compare(file, "last call", f"{start}dit_last", made[-1], bound / SCALE)
    if f"{start}guided_prediction" in file.arrays:
        guided = with_guidance(call, network, inputs["neighbor_agents_past"], absent)
        _compare(file, "guided prediction", f"{start}guided_prediction", sampled(guided), bound)


def _compare(file: ArrayFile, quantity: str, name: str, ours: Any, atol: float) -> None:
    file.report.compare(
        f"{NAME} {quantity}", f"{file.name} {name}", ours.numpy(), file[name], atol=atol
    )


def _verify_loop(path: Path, report: Report, scenes: Scenes, networks: _Networks) -> None:
    """Plan again at every recorded iteration."""
    loop = open_loop(path, report, scenes, NAME)
    if loop is None:
        return
    file, network = loop.file, networks(loop.variant)
    stored = file.take("out/trajectory", -1, NOISE_SHAPE[1] + 1, len(_PLAN))
    count = len(stored)  # the official planner may have failed at the next iteration
    times = file.take("out/trajectory_time_us", count, NOISE_SHAPE[1] + 1)
    egos = file.take("out/ego_prediction", count, *NOISE_SHAPE[1:])
    failed = min(count, len(loop.ego) - 1) if loop.error else -1
    build = FeatureBuilder(loop.info, lane_lines(loop.scenario.map))
    plans: list[Trajectory | Command] = []
    for iteration in range(len(loop.ego)):
        where, seen = f"iteration {iteration}", loop.observation(iteration)
        key = f"noise:{loop.scenario.token}:{iteration}"
        noise = keyed_normals(key, (1, *NOISE_SHAPE)).astype(np.float32)[0]
        features = build(seen, noise)
        makeshift = bool(why_makeshift(features, len(seen.history.ego)))
        loop.compare(f"{NAME} makeshift", where, makeshift, iteration == failed)
        made = _infer(network, features)
        _compare_iteration(loop, iteration, features, made)
        if iteration >= count:
            continue
        ego, atol = made["prediction"][0], SAMPLED[loop.variant]
        loop.compare(f"{NAME} ego [m]", where, ego, egos[iteration], atol)
        plan = decode_ego(made["prediction"], seen)
        _compare_plan(loop, where, plan, stored[iteration], times[iteration])
        states = np.zeros((len(plan.time_us), NUM_STATE))
        states[:, : len(_PLAN)] = stored[iteration]
        plans.append(Trajectory(times[iteration], states))
    report.compare(f"{NAME} plans", path.name, len(loop.ego) - len(plans), int(bool(loop.error)))
    compare_driven(loop, plans, NAME)
    file.finish()


def _infer(network: Any, features: Features) -> dict[str, Any]:
    """Tokens of the scene (107, 192) and trajectories (11, 80, 4)."""
    import torch

    with torch.inference_mode():
        inputs = {name: torch.from_numpy(getattr(features, name)[None]) for name in INPUTS}
        noise = torch.from_numpy(features.noise[None])
        encoding = network.encode(network.normalise(inputs))
        return {
            "encoding": encoding[0].numpy(),
            "prediction": network(inputs, noise)[0].numpy(),
        }


def _compare_iteration(
    loop: Loop, iteration: int, features: Features, made: dict[str, Any]
) -> None:
    """Compare what is stored for some iterations: features, ids and outputs."""
    start, road = f"it{iteration:02d}/", loop.scenario.map
    tokens = loop.scenario.tracks.tokens
    ours: dict[str, tuple[object, float]] = {
        "lane_ids": ([road.edges.ids[edge] for edge in features.edges.tolist()], 0.0),
        "agent_tokens": ([tokens[track] for track in features.agents.tolist()], 0.0),
        "corrected_route_ids": ([road.blocks.ids[b] for b in features.route or ()], 0.0),
        "encoding": (made["encoding"], NETWORK),
        "prediction": (made["prediction"], SAMPLED[loop.variant]),
    }
    for name in (n.removeprefix(start) for n in loop.file.arrays if n.startswith(start)):
        if name in ours:
            value, atol = ours[name]
        elif name.startswith("feature/") and hasattr(features, name.removeprefix("feature/")):
            value, atol = getattr(features, name.removeprefix("feature/")), FEATURE
        else:
            continue
        given = loop.file[start + name]
        theirs = given.tolist() if given.dtype.kind in "US" else given
        loop.compare(f"{NAME} {name}", start[:-1], value, theirs, atol)


def _compare_plan(loop: Loop, where: str, plan: Trajectory, stored: Any, times: Any) -> None:
    loop.compare(f"{NAME} plan time [us]", where, plan.time_us, times)
    gap = plan.states[:, : len(_PLAN)] - stored
    gap[:, 2] = wrap_angles(gap[:, 2])
    for column, name in enumerate(_PLAN):
        atol = HEADING if name == "heading" else POSITION
        loop.compare(f"{NAME} plan {name}", where, gap[:, column], np.zeros(len(gap)), atol)
