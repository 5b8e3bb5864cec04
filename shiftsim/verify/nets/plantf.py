"""PlanTF: network on synthetic inputs, and closed loops from the log to the trajectory."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.frames import wrap_angles
from shiftsim.planners.learned.plan_states import plan_of_poses
from shiftsim.planners.learned.plantf.planner import (
    MAX_AGENTS,
    RADIUS,
    Features,
    PlanTF,
    make_batch,
)
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nets.common import (
    DERIVED_HEADING,
    ERRORS,
    FEATURE,
    HEADING,
    OUTPUT,
    POSITION,
    Loop,
    Scenes,
    compare_driven,
    make_network,
    open_loop,
    verify_state_dict,
)
from shiftsim.verify.nets.features import (
    compare_agents,
    compare_origin,
    compare_relations,
    compare_road,
    feature_iterations,
)
from shiftsim.verify.report import Report
from shiftsim.world.state import NUM_STATE, Trajectory

MOTION = 1e-5  # m/s, m/s^2: derivatives of the recorded poses
UNSCALED = 2e-5  # of outputs that do not depend on the variant
_RAW = ("trajectory", "probability", "prediction")


def verify_plantf(folder: Path, report: Report, scenes: Scenes) -> None:
    """Compare every file of the folder.

    Args:
        folder: Folder with `state_dict.json`, `forward_*.npz` and `closed_loop_*.npz`.
        report: Receives the comparisons.
        scenes: The scenes of the closed loops.
    """
    for path in sorted(folder.iterdir()):
        try:
            _verify_file(path, report, scenes)
        except ERRORS as error:
            report.fail("plantf", path.name, f"cannot be compared: {type(error).__name__} {error}")


def _verify_file(path: Path, report: Report, scenes: Scenes) -> None:
    if path.name == "state_dict.json":
        verify_state_dict(path, report, "plantf", _manifest_fields())
    elif path.name.startswith("forward_") and path.suffix == ".npz":
        _verify_forward(ArrayFile(path, report), report)
    elif path.name.startswith("closed_loop_") and path.suffix == ".npz":
        loop = open_loop(path, report, scenes, "plantf")
        if loop is not None:
            _verify_loop(loop)
            loop.file.finish()
    elif path.suffix == ".md":
        report.note(f"{path.name}: description of the folder")
    else:
        report.skip(f"plantf: file {path.name}")


def _manifest_fields() -> dict[str, Any]:
    from shiftsim.planners.learned.plantf import network as plantf

    network = plantf.build_network()
    state = network.state_dict().values()
    return {
        "checkpoint": lambda given: {
            **given,  # the rest of it is prose
            "weights_under": "state_dict",
            "prefix": plantf.PREFIXES[0],
        },
        "hyper_parameters": lambda _: plantf.RELEASED,
        "feature_builder": lambda _: {
            "radius": RADIUS,
            "history_horizon": 2,
            "future_horizon": 8,
            "sample_interval": 0.1,
            "max_agents": MAX_AGENTS,
        },
        "total_elements": lambda _: sum(value.numel() for value in state),
        "trainable_parameters": lambda _: sum(p.numel() for p in network.parameters()),
        "drive_overrides": lambda given: plantf_overrides(given, plantf.DRIVE_HEADS),
    }


def plantf_overrides(given: dict[str, Any], heads: dict[str, Any]) -> dict[str, Any]:
    """Our overrides in the form of the manifest, with its own words."""
    made = {
        layer: {
            "C": len(head.gain),
            "gain": list(head.gain),
            "exponent": list(head.exponent),
            "const": list(head.const),
            "slope": list(head.slope),
        }
        for layer, head in heads.items()
    }
    return {"meaning": given.get("meaning"), "heads": made, "scale": {}}


@cache
def _planner(variant: str) -> PlanTF:
    return PlanTF(f"deterministic:{variant}")


@cache
def _network(variant: str) -> Any:
    return make_network("plantf", variant)


def _verify_forward(file: ArrayFile, report: Report) -> None:
    """The network alone, on inputs as the official code batched them."""
    import torch

    variant = str(file["meta/variant"])
    if variant not in OUTPUT:
        raise DataError(f"unknown variant {variant!r} of the weights")
    compare_relations(file, report, "plantf", RADIUS)
    with torch.inference_mode():
        out = _network(variant)(_inputs_of(file), predict=True)
    for name in _RAW:
        ours, theirs = getattr(out, name).numpy(), file[f"out/{name}"]
        report.compare(f"plantf {name} ({variant})", file.name, ours, theirs, atol=OUTPUT[variant])
    best = out.probability.argmax(-1)
    poses = _poses(out.trajectory[torch.arange(len(best)), best].numpy())
    _compare_best(report, file.name, poses, file["out/output_trajectory"], variant)
    file.note("the network does not read them", "in/origin", "in/angle")
    file.note("the network does not read the yaw rate, the last value of in/current_state")
    file.finish()


def _inputs_of(file: ArrayFile) -> Any:
    import torch

    from shiftsim.planners.learned.plantf.network import STATE_CHANNELS, Inputs

    def given(name: str, kind: Any = torch.float32) -> Any:
        array = file[f"in/{name}"]
        out = torch.from_numpy(array).to(kind)
        file.report.compare(f"plantf input {name} type", file.name, out.numpy(), array, atol=0.0)
        return out

    return Inputs(
        position=given("agent.position"),
        heading=given("agent.heading"),
        velocity=given("agent.velocity"),
        shape=given("agent.shape"),
        valid=given("agent.valid_mask", torch.bool),
        category=given("agent.category", torch.int64),
        current_state=given("current_state")[:, :STATE_CHANNELS],
        points=given("map.point_position")[:, :, 0],
        vectors=given("map.point_vector")[:, :, 0],
        orientations=given("map.point_orientation")[:, :, 0],
        centers=given("map.polygon_center"),
        kind=given("map.polygon_type", torch.int64),
        on_route=given("map.polygon_on_route", torch.int64),
        light=given("map.polygon_tl_status", torch.int64),
        has_limit=given("map.polygon_has_speed_limit", torch.bool),
        limit=given("map.polygon_speed_limit"),
        point_valid=given("map.valid_mask", torch.bool),
    )


def _poses(trajectory: np.ndarray) -> np.ndarray:
    """(..., 3) x, y, heading of (..., 4) x, y, cosine, sine."""
    heading = np.arctan2(trajectory[..., 3:], trajectory[..., 2:3])
    return np.concatenate([trajectory[..., :2], heading], axis=-1)


def _compare_best(
    report: Report, where: str, ours: np.ndarray, theirs: np.ndarray, variant: str
) -> None:
    """The likeliest trajectory in the ego frame; headings modulo 2 pi."""
    report.compare("plantf best shape", where, ours.shape, theirs.shape)
    if ours.shape != theirs.shape:
        return
    name = f"plantf best position ({variant})"
    report.compare(name, where, ours[..., :2], theirs[..., :2], atol=OUTPUT[variant])
    turned = wrap_angles((ours[..., 2] - theirs[..., 2]).astype(np.float64))
    report.compare("plantf best heading", where, turned, 0.0 * turned, atol=DERIVED_HEADING)


def _verify_loop(loop: Loop) -> None:
    """Every step from the log on: features, network, plan; and what the plan leads to."""
    file, planner = loop.file, _planner(loop.variant)
    plans, times = file["out/trajectory"], file["out/trajectory_time_us"]
    count = len(loop.ego) - (1 if loop.error else 0)  # the official planner failed at the last
    if not len(plans) == len(times) == count:
        raise DataError(f"{len(plans)} plans and {len(times)} times of {count} iterations")
    planner.reset(loop.info)
    stored = feature_iterations(file)
    for iteration in range(len(loop.ego)):
        seen = loop.observation(iteration)
        features = planner.features(seen)
        if iteration in stored:
            _compare_features(loop, iteration, features)
        (output,) = planner.infer([features])
        plan = planner.decode(output, seen)
        where = f"iteration {iteration}"
        failed = iteration == count
        loop.compare("plantf fails", where, bool(planner.degraded), failed)
        if not failed:
            _compare_plan(loop, where, plan, plans[iteration], times[iteration])
            again = plan_of_poses(plans[iteration, 1:, :3], seen.history)
            motion = plans[iteration][:, 3:]
            loop.compare("plantf plan motion", where, again.states[:, 3:7], motion, MOTION)
    for iteration in stored:
        if iteration >= len(loop.ego):
            file.report.fail("plantf features", file.name, f"no iteration {iteration}")
    compare_driven(loop, [_recorded(*pair) for pair in zip(plans, times, strict=True)], "plantf")


def _recorded(plan: np.ndarray, times: np.ndarray) -> Trajectory:
    states = np.zeros((len(plan), NUM_STATE))
    states[:, :7] = plan
    return Trajectory(times, states)


def _compare_plan(
    loop: Loop, where: str, plan: Trajectory, theirs: np.ndarray, times: np.ndarray
) -> None:
    loop.compare("plantf plan time [us]", where, plan.time_us, times)
    loop.compare("plantf plan [m]", where, plan.states[:, :2], theirs[:, :2], POSITION)
    loop.compare("plantf plan [rad]", where, plan.states[:, 2], theirs[:, 2], HEADING)


def _compare_features(loop: Loop, iteration: int, features: Features) -> None:
    """Features and raw outputs of an iteration for which they are stored."""
    import torch

    file, where, at = loop.file, f"iteration {iteration}", f"it{iteration:02d}"
    compare_origin(loop, iteration, "plantf")
    compare_agents(loop, iteration, features.agents, "plantf")
    # nuPlan: at inference every agent has the category of the ego (planner-plantf.md §2.2)
    category = np.zeros(len(features.agents.valid), np.int64)
    loop.compare("plantf agent.category", where, category, file[f"{at}/feature/agent.category"])
    compare_road(loop, iteration, features.road, "plantf")
    theirs = file[f"{at}/feature/current_state"]
    loop.compare("plantf current_state", where, features.current_state, theirs, FEATURE)
    ids = [loop.scenario.map.blocks.ids[block] for block in features.route]
    loop.compare("plantf route", where, ids, file[f"{at}/corrected_route_ids"].tolist())
    with torch.inference_mode():
        out = _network(loop.variant)(make_batch([features], "cpu"), predict=True)
    for name in _RAW:
        mine = getattr(out, name)[0].numpy()
        atol = OUTPUT[loop.variant] if name == "trajectory" else UNSCALED
        loop.compare(f"plantf {name} (closed loop)", where, mine, file[f"{at}/net/{name}"], atol)
    best = _poses(out.trajectory[0, int(out.probability[0].argmax())].numpy())
    theirs = file[f"{at}/net/output_trajectory"]
    _compare_best(file.report, f"{file.name} {where}", best, theirs, loop.variant)
