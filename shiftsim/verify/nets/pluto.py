"""PLUTO: network, features, scores of the proposals, emergency brake and plans."""

from functools import partial
from typing import Any

import numpy as np

from shiftsim.planners.learned.map_features import CROSSWALK
from shiftsim.planners.learned.pluto import scoring
from shiftsim.planners.learned.pluto.brake import brake, must_brake
from shiftsim.planners.learned.pluto.inputs import stack
from shiftsim.planners.learned.pluto.planner import MAX_AGENTS, RADIUS, Choice, Pluto, Sight
from shiftsim.verify.files import Source
from shiftsim.verify.nets import loops, plantf
from shiftsim.verify.nets.loops import POSITION, Loop, verify_loop
from shiftsim.verify.nets.networks import FEATURE, OUTPUT, verify_manifest
from shiftsim.verify.scenes import Scenes
from shiftsim.world.state import NUM_STATE, PACIFICA, VX, VY

NEAR_TIE = 1e-4  # between the two best final scores; below it the choice may differ
EXACT = 1e-8  # what follows from stored candidates and predictions alone
MOTION = 1e-2  # m/s, m/s^2: derivatives of poses 0.1 s apart
LINE = 1e-9  # m, rad: reference lines are made by the same operations
SCORES = (  # stored arrays, in the order of the fields of `Scores` behind the total
    *("rule", "multi", "weighted", "progress", "fault_t", "rollout", "footprints", "speed_limit"),
)
POSES = np.array([POSITION, POSITION, loops.HEADING])
BOUNDS: dict[str, Any] = {  # where proposals are made from the log on
    **{"cand": POSES, "agents_pred": POSES, "progress": POSITION},
    "rollout": np.append(POSES, [POSITION] * (NUM_STATE - len(POSES))),
    **dict.fromkeys(("lscore", "rule", "weighted"), 1e-4),
    "fault_t": EXACT,
}


def _verify_brake(file: Source, scenes: Scenes) -> None:
    """Unit cases of the emergency brake."""
    egos, poses, times = file.take("ego", -1, NUM_STATE), file["candidate"], file["fault_time"]
    speeds = np.hypot(egos[:, VX], egos[:, VY])
    must = [must_brake(*pair) for pair in zip(speeds.tolist(), times.tolist(), strict=True)]
    states = np.full((len(egos), 81, NUM_STATE), np.nan)
    for case in np.flatnonzero(must).tolist():
        states[case] = brake(poses[case], egos[case], float(times[case]), PACIFICA)
    file.match("file", {"columns": list(loops.FILE_COLUMNS)})
    ours = {"speed": speeds, "braked": must, "states": states}
    file.match_rows(ours, {"speed": LINE, "": loops.STATE})


def _compare(loop: Loop) -> None:
    """Compare everything stored of one iteration."""
    from shiftsim.planners.learned.pluto.network import Inputs

    sight, choice, report = loop.planner.sight, loop.planner.choice, loop.file.report
    is_full = "agent_tokens" in loop.stored  # one of the iterations stored in full
    if is_full:
        _compare_sight(loop, sight)
        batch = Inputs(*stack([loop.features], "cpu"))
        plantf.compare_network(loop, batch, "trajectory", "candidate_trajectories")
    if choice is None:
        report.fail(f"{loop.name} reference lines", loop.where, "none found")
        return
    _compare_choice(loop, choice)
    if is_full:
        _compare_from_stored(loop, sight)
    stored, best = loop.stored.below("post/"), int(loop.row["best_index"])
    total = stored["rule"] + 0.3 * stored["lscore"]
    first, second = np.sort(total)[-2:][::-1] if len(total) > 1 else (np.inf, 0.0)
    if choice.best != best and first - second <= NEAR_TIE:
        what = f"proposal {choice.best} instead of {best}, scores {first:.6f} and {second:.6f}"
        report.note(f"{loop.name} {loop.where}: near-tie, {what}")
        return
    loop.compare("best proposal", choice.best, best)
    loop.compare("emergency brake", choice.braked, bool(loop.row["emergency_brake"]))
    loop.compare_plan(MOTION)


def _compare_sight(loop: Loop, sight: Sight) -> None:
    inputs, road, near = loop.features._asdict(), loop.scenario.map, sight.road
    blocks = [
        0 if kind == CROSSWALK else int(road.blocks.ids[road.block_of[row]])
        for row, kind in zip(near.objects.tolist(), near.kind.tolist(), strict=True)
    ]
    given = ("current_state", "category", *(name for name in inputs if name.startswith("line_")))
    others = {
        "map.polygon_road_block_id": np.array(blocks, np.int64),
        "reference_line.future_projection": np.zeros((len(sight.lines), 8, 2)),
        **{plantf.INPUTS[name]: inputs[name] for name in given},
    }
    plantf.compare_features(loop, sight.agents, near, loop.planner.route.blocks, others)
    stored = [name for name in loop.stored if name.startswith("reference_line_")]
    loop.compare("reference lines", len(sight.lines), len(stored))
    loop.match({f"reference_line_{i}": line for i, line in enumerate(sight.lines)}, LINE)
    # the official code takes static objects out of a set: their order means nothing
    theirs, pose = loop.stored.below("feature/static_objects."), inputs["object_pose"]
    ours = {
        "position": pose[:, :2],
        "heading": pose[:, 2],
        "shape": inputs["object_shape"],
        "category": inputs["object_category"],
        "valid_mask": inputs["object_valid"],
    }
    order, their_order = _by_place(pose[:, :2]), _by_place(theirs["position"])
    for name, value in ours.items():
        loop.compare(f"static_objects.{name}", value[order], theirs[name][their_order], FEATURE)


def _by_place(positions: Any) -> Any:
    """Order by place, to the centimetre."""
    return np.lexsort(np.rint(np.asarray(positions, np.float64) * 100.0).T[::-1])


def _compare_choice(loop: Loop, choice: Choice) -> None:
    """Compare proposals and scores that were made from the log on."""
    stored = loop.stored.below("post/")
    ours = {
        "cand": choice.poses,
        "lscore": choice.learned,
        "agents_pred": choice.agents.poses,
        "agents_vel": choice.agents.speeds,
        **dict(zip(SCORES, choice.scores[1:], strict=True)),
    }
    ours = {name: value for name, value in ours.items() if name in stored}
    loop.match(ours, {**BOUNDS, "agents_vel": OUTPUT[loop.variant]}, "post/")
    # what follows from the other stored scores
    parts = (stored["multi"], stored["weighted"], stored["progress"])
    progress, rule = scoring.aggregate(*parts)
    loop.compare("aggregated progress", progress, stored["weighted"][0], EXACT)
    loop.compare("aggregated rule", rule, stored["rule"], EXACT)


def _compare_from_stored(loop: Loop, sight: Sight) -> None:
    """Compare what the scores of the stored proposals are, against the stored predictions."""
    stored, scenario, ego = loop.stored.below("post/"), loop.scenario, loop.seen.history.ego[-1]
    tokens = [scenario.tracks.tokens[track] for track in sight.agents.tracks.tolist()]
    line = scoring.nearest_line(sight.lines, ego)
    loop.match({"agents_tok": tokens, "baseline": line}, EXACT, "post/")
    motion = {"poses": stored["agents_pred"], "speeds": stored["agents_vel"]}
    world = loop.planner.world_of(loop.seen, loop.planner.choice.agents._replace(**motion))
    place = scoring.Place(sight.drivable, scenario.map.edges.polygons, line)
    proposals = np.ascontiguousarray(stored["cand"])
    scores = scoring.score(proposals, stored["lscore"], ego, world, place, PACIFICA)
    ours = dict(zip(SCORES, scores[1:], strict=True))
    stored.match(loop.where, ours, EXACT, quantity=f"{loop.name} stored proposals'")


_BUILDER = {"radius": RADIUS, "max_agents": MAX_AGENTS, "build_reference_line": True}
_MANIFEST = partial(plantf.manifest_of, **_BUILDER)
_RECORDED = (*loops.PLANS, "best_index", "emergency_brake")
FILES = {
    "state_dict.json": partial(verify_manifest, Pluto.name, plantf.SIZES, _MANIFEST),
    # the official code masks the agents of a batch in the wrong order
    "forward_*.npz": partial(plantf.verify_forward, Pluto.name, RADIUS, misordered_masks=True),
    "closed_loop_*.npz": partial(verify_loop, Pluto, _compare, _RECORDED),
    "emergency_brake.npz": _verify_brake,
}
