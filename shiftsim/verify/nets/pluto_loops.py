"""Closed loops of PLUTO: every recorded step made again, from the scene's own log and map."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.planners.learned.pluto.inputs import Inputs, stack
from shiftsim.planners.learned.pluto.planner import Choice, Pluto
from shiftsim.planners.learned.pluto.proposals import Output
from shiftsim.planners.learned.pluto.scoring import Place, Scores, aggregate, nearest_line, score
from shiftsim.sim.planner import Observation
from shiftsim.verify.nets import common as nets_common
from shiftsim.verify.nets.common import OUTPUT, POSITION, Loop, Scenes, make_network, open_loop
from shiftsim.verify.nets.pluto_features import compare_features
from shiftsim.verify.nets.pluto_network import NAME, RAW, compare_outputs, derived_outputs
from shiftsim.verify.report import Report
from shiftsim.world.state import AX, AY, HEADING, NUM_STATE, VX, VY, Command, Trajectory, X, Y

NEAR_TIE = 1e-4  # between the two best final scores; below it the choice may differ
EXACT = 1e-8  # what follows from stored candidates and predictions alone
MOTION = 1e-2  # m/s, m/s^2: derivatives of poses 0.1 s apart
SCORE = 1e-4
NO_LINE_ERROR = "ValueError: zero-size array to reduction operation maximum which has no identity"
PLAN_COLUMNS = [X, Y, HEADING, VX, VY, AX, AY]


def verify_loop(path: Path, report: Report, scenes: Scenes) -> None:
    """Compare one closed-loop file."""
    loop = open_loop(path, report, scenes, NAME)
    if loop is None:
        return
    planner = Pluto(f"deterministic:{loop.variant}")
    planner.reset(loop.info)
    network = make_network(NAME, loop.variant)
    file = loop.file
    plans = file["out/trajectory"]
    times, braked, best = (
        file[f"out/{name}"] for name in ("trajectory_time_us", "emergency_brake", "best_index")
    )
    loop.compare("pluto plans", "", len(loop.ego), len(plans) + bool(loop.error))
    loop.compare("pluto plans", "", [len(plans)] * 3, [len(times), len(braked), len(best)])
    for iteration in range(len(loop.ego)):
        seen = loop.observation(iteration)
        inputs = planner.features(seen)
        (output,) = planner.infer([inputs])
        plan = planner.decode(output, seen)
        if iteration == len(plans):
            _compare_failure(loop, planner, iteration)
            break
        at = f"it{iteration:02d}"
        compare_features(loop, at, planner, inputs, seen)
        _compare_network(loop, at, inputs, output, network)
        choice = planner.choice
        if choice is None:
            report.fail("pluto reference lines", f"{file.name} {at}", "none found")
            continue
        _compare_scores(loop, f"{at}/post", choice)
        if f"{at}/agent_tokens" in file.arrays:  # one of the iterations stored in full
            _compare_from_stored(loop, f"{at}/post", planner, seen)
        if _may_differ(loop, f"{at}/post", choice.best, int(best[iteration])):
            continue
        loop.compare("pluto best candidate", at, choice.best, int(best[iteration]))
        loop.compare("pluto emergency brake", at, choice.braked, bool(braked[iteration]))
        _compare_plan(loop, at, plan, plans[iteration], times[iteration])
    nets_common.compare_driven(loop, _recorded_plans(plans, times), NAME)
    file.finish()


def _compare_failure(loop: Loop, planner: Pluto, iteration: int) -> None:
    """The official planner failed here; ours must say that its plan is a makeshift."""
    where, _, what = loop.error.partition(": ")
    if what != NO_LINE_ERROR:
        loop.file.report.skip(f"{NAME} {loop.file.name}: the official failure {loop.error!r}")
        return
    loop.compare("pluto failure", "iteration", f"iteration {iteration}", where)
    loop.compare("pluto failure", "makeshift", bool(planner.degraded), True)


def _compare_network(loop: Loop, at: str, inputs: Inputs, output: Output, network: Any) -> None:
    """Compare what the planner's network said, where it is stored."""
    import torch

    prefix = f"{at}/net/"
    stored = [name for name in loop.file.arrays if name.startswith(prefix)]
    if not stored:
        return
    with torch.inference_mode():
        made = network(stack([inputs], "cpu"))
        hidden = network.hidden_proj(made.ego)[0].numpy()
    ours = {name: getattr(output, name) for name in RAW} | {"hidden": hidden}
    present = np.concatenate([inputs.position[1:, -1], inputs.heading[1:, -1:]], axis=1)
    compare_outputs(loop.file, prefix, ours | derived_outputs(ours, present), loop.variant)


def _compare_scores(loop: Loop, at: str, choice: Choice) -> None:
    """Compare candidates and scores that were made from the log on."""
    scores = choice.scores
    limit = OUTPUT[loop.variant]
    ours: dict[str, tuple[Any, float]] = {
        "cand": (choice.poses, POSITION),
        "lscore": (choice.learned, SCORE),
        "rollout": (scores.driven, POSITION),
        "agents_pred": (choice.agents[0], POSITION),
        "agents_vel": (choice.agents[1], limit),
        "progress": (scores.progress, POSITION),
        "rule": (scores.rule, SCORE),
        "weighted": (scores.terms, SCORE),
        "multi": (scores.factors, 0.0),
        "fault_t": (scores.fault_times, EXACT),
        "footprints": (scores.flags, 0.0),
        "speed_limit": (scores.speed_limits, 0.0),
    }
    for name, (value, tolerance) in ours.items():
        if f"{at}/{name}" in loop.file.arrays:
            given = loop.file[f"{at}/{name}"]
            loop.compare(f"pluto {name}", at, value, given, tolerance)
            if name in ("cand", "rollout", "agents_pred") and value.shape == given.shape:
                headings = (value[..., HEADING], given[..., HEADING])
                loop.compare(f"pluto {name} heading", at, *headings, nets_common.HEADING)
    _compare_aggregate(loop, at)


def _compare_aggregate(loop: Loop, at: str) -> None:
    """Compare stored scores with what follows from the other stored scores."""
    names = ("multi", "weighted", "progress", "rule")
    factors, terms, progress, rule = (loop.file[f"{at}/{name}"] for name in names)
    made, total = aggregate(factors, terms, progress)
    loop.compare("pluto aggregation", f"{at} progress", made, terms[0], EXACT)
    loop.compare("pluto aggregation", f"{at} rule", total, rule, EXACT)


def _compare_from_stored(loop: Loop, at: str, planner: Pluto, seen: Observation) -> None:
    """Score the stored candidates among the stored predictions; nearly no tolerance is needed."""
    file, sight, choice = loop.file, planner.sight, planner.choice
    assert sight is not None
    assert choice is not None
    ego = seen.history.ego[-1]
    tracks = seen.history.tracks
    tokens = [tracks.tokens[track] for track in sight.agents.tracks]
    loop.compare("pluto agents_tok", at, tokens, file[f"{at}/agents_tok"].tolist())
    line = nearest_line(sight.lines, ego)
    loop.compare("pluto baseline", at, line, file[f"{at}/baseline"], EXACT)
    poses, speeds = file[f"{at}/agents_pred"], file[f"{at}/agents_vel"]
    if poses.shape != choice.agents[0].shape or speeds.shape != choice.agents[1].shape:
        return  # named as a mismatch before
    world = planner.world_of(seen, choice.agents._replace(poses=poses, speeds=speeds))
    place = Place(sight.drivable, loop.scenario.map.edges.polygons, line)
    candidates = np.ascontiguousarray(file[f"{at}/cand"])
    scores = score(candidates, file[f"{at}/lscore"], ego, world, place, loop.info.vehicle)
    for name, value in _stored_names(scores).items():
        given = file[f"{at}/{name}"]
        loop.compare(f"pluto {name} of stored candidates", at, value, given, EXACT)


def _stored_names(scores: Scores) -> dict[str, Any]:
    return {
        "rollout": scores.driven,
        "progress": scores.progress,
        "rule": scores.rule,
        "weighted": scores.terms,
        "multi": scores.factors,
        "fault_t": scores.fault_times,
        "footprints": scores.flags,
        "speed_limit": scores.speed_limits,
    }


def _may_differ(loop: Loop, at: str, ours: int, theirs: int) -> bool:
    """Whether another candidate was chosen in a near-tie, which is listed."""
    total = loop.file[f"{at}/rule"] + 0.3 * loop.file[f"{at}/lscore"]
    first, second = np.sort(total)[-2:][::-1] if len(total) > 1 else (np.inf, 0.0)
    if ours == theirs or first - second > NEAR_TIE:
        return False
    what = f"candidate {ours} instead of {theirs}, scores {first:.6f} and {second:.6f}"
    loop.file.report.note(f"{NAME} {loop.file.name} {at}: near-tie, {what}")
    return True


def _compare_plan(loop: Loop, at: str, plan: Trajectory, theirs: Any, time_us: Any) -> None:
    ours = plan.states[:, PLAN_COLUMNS]
    loop.compare("pluto plan time [us]", at, plan.time_us, time_us)
    loop.compare("pluto plan [m]", at, ours[:, :2], theirs[:, :2], POSITION)
    loop.compare("pluto plan [rad]", at, ours[:, 2], theirs[:, 2], nets_common.HEADING)
    loop.compare("pluto plan motion", at, ours[:, 3:], theirs[:, 3:], MOTION)


def _recorded_plans(plans: Any, times: Any) -> list[Trajectory | Command]:
    out: list[Trajectory | Command] = []
    for plan, time_us in zip(plans, times, strict=True):
        states = np.zeros((len(plan), NUM_STATE))
        states[:, PLAN_COLUMNS] = plan
        out.append(Trajectory(time_us.astype(np.int64), states))
    return out
