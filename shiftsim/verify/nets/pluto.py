"""PLUTO: network, features, scores of the proposals, emergency brake and plans."""

from functools import partial
from typing import Any

import numpy as np

from shiftsim.planners.learned.map_features import CROSSWALK
from shiftsim.planners.learned.pluto import planner, scoring
from shiftsim.planners.learned.pluto.planner import headings_of
from shiftsim.verify.files import Source
from shiftsim.verify.nets import common, plantf
from shiftsim.verify.tables import read_tables, rows_of
from shiftsim.world.state import NUM_STATE, PACIFICA, VX, VY

PLANNER, TABLES = planner.Pluto, read_tables(plantf.__file__, __file__)
NEAR_TIE = 1e-4  # between the two best final scores; below it the choice may differ
LINE = 1e-9  # m, rad: reference lines are made by the same operations


def _verify_brake(file: Source) -> None:
    file.match("file", {"columns": list(common.FILE_COLUMNS)})
    for number, case in enumerate(rows_of(file)):
        ego, time = case.take("ego", NUM_STATE), float(case["fault_time"])
        speed = float(np.hypot(ego[VX], ego[VY]))
        braked, states = scoring.must_brake(speed, time), np.full((81, NUM_STATE), np.nan)
        if braked:
            states = scoring.brake(case["candidate"], ego, time, PACIFICA)
        ours = {"speed": speed, "braked": braked, "states": states}
        case.match(f"case {number}", ours, {"speed": LINE, "": common.STATE})


def _outputs(network: Any, batch: Any) -> dict[str, Any]:
    """What the network says of a batch, and poses that the official code makes of that."""
    # the official code masks the agents of a batch in the wrong order (nuPlan rule 307)
    network.planning_decoder.misordered_masks = True
    out = network(batch)
    made = {name: value.numpy() for name, value in out._asdict().items()}
    present = np.concatenate([batch.position[:, 1:, -1], batch.heading[:, 1:, -1:]], axis=-1)
    return {
        **made,
        "hidden": network.hidden_proj(out.ego),
        "poses": plantf.likeliest(made["trajectory"], made["probability"]),
        "candidates": headings_of(made["trajectory"]),
        "predicted": headings_of(made["prediction"]) + present[:, :, None],
        "free": headings_of(made["ref_free_trajectory"]),
    }


def compare(loop: common.Loop) -> None:
    """Compare everything stored of one iteration."""
    choice, stored = loop.planner.choice, loop.stored.below("post/")
    loop.match("choice", stored)
    parts = (stored[name] for name in ("multi", "weighted", "progress"))
    progress, rule = scoring.aggregate(*parts)
    loop.match("aggregated", stored, "aggregated", progress=progress, rule=rule)
    if "agent_tokens" in loop.stored:  # one of the iterations stored in full
        _compare_sight(loop)
        batch = planner.make_batch([loop.features], "cpu")
        plantf.compare_network(loop, _outputs, batch, "outputs")
        # what the scores of the stored proposals are, against the stored predictions
        agents, proposals = choice.agents, np.ascontiguousarray(stored["cand"])
        agents = agents._replace(poses=stored["agents_pred"], speeds=stored["agents_vel"])
        again = loop.planner.rate(loop.seen, proposals, stored["lscore"], agents)
        line = scoring.nearest_line(loop.planner.sight.lines, loop.seen.history.ego[-1])
        loop.match("from_sight", stored, line=line)
        loop.match("from_stored", stored, "stored proposals'", scores=again.scores)
    best, total = int(loop.row["best_index"]), stored["rule"] + 0.3 * stored["lscore"]
    first, second = np.sort(total)[-2:][::-1] if len(total) > 1 else (np.inf, 0.0)
    if choice.best != best and first - second <= NEAR_TIE:
        what = f"proposal {choice.best} instead of {best}, scores {first:.6f} and {second:.6f}"
        loop.file.report.note(f"{loop.name} {loop.where}: near-tie, {what}")
    else:
        loop.match("iteration", loop.row)


def _compare_sight(loop: common.Loop) -> None:
    """Compare what was made before the network."""
    sight, given, road = loop.planner.sight, loop.features, loop.road
    near, lines = sight.road, sight.lines
    blocks = [
        0 if kind == CROSSWALK else int(road.blocks.ids[road.block_of[row]])
        for row, kind in zip(near.objects.tolist(), near.kind.tolist(), strict=True)
    ]
    names = {"blocks": np.array(blocks, np.int64), "projection": np.zeros((len(lines), 8, 2))}
    names["inputs"] = given
    plantf.compare_features(loop, sight.agents, near, loop.planner.route.blocks, **names)
    stored = loop.stored.below("reference_line_")
    loop.compare("reference lines", len(lines), len(list(stored)))
    numbered = {str(number): line for number, line in enumerate(lines)}
    stored.match(loop.where, numbered, LINE, quantity=f"{loop.name} reference line")
    # the official code takes static objects out of a set: their order means nothing
    theirs = loop.stored.below("feature/static_objects.")
    names = {"inputs": given, "order": _by_place(given.object_pose[:, :2])}
    loop.match(
        "static_objects", theirs.at(_by_place(theirs["position"])), "static_objects", **names
    )


def _by_place(positions: Any) -> Any:
    """Order by place, to the centimetre."""
    return np.lexsort(np.rint(np.asarray(positions, np.float64) * 100.0).T[::-1])


_FORWARD = partial(plantf.verify_forward, planner.Pluto, TABLES, _outputs)
FILES = {"forward_*.npz": _FORWARD, "emergency_brake.npz": _verify_brake}
