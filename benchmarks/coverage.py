"""How much of a track some runs cover: its contract, counted rollout by rollout."""

from collections.abc import Sequence

import numpy as np

from shiftsim.benchmarks import INTERPLAN_THRESHOLDS, Track
from shiftsim.report.groups import TRAFFIC, Group, distinct_sets
from shiftsim.report.tables import Cell, Number, Table


def coverage(track: Track, groups: Sequence[Group]) -> Table:
    """Finished rollouts of the track's contract, by set of scenarios and planner.

    A score is the track's score only where all of them are there.
    """
    inside = [group for group in groups if _belongs(group, track)]
    sets = {data.name: (data.label, data.whole) for data in distinct_sets(inside)}
    if listed := track.reference:
        sets.setdefault(listed.name, (listed.label, listed.count))
    rows: list[tuple[Cell, ...]] = []
    for name, (label, whole) in sets.items():
        for planner in dict.fromkeys(group.planner for group in inside):
            mine = [g for g in inside if (g.data.name, g.planner) == (name, planner)]
            done = sum(_finished(group, track) for group in mine)
            expected = whole * track.rollouts_per_scenario
            if any(group.data.is_interplan for group in mine):  # for reactive traffic only
                expected //= len(track.traffic)
            verdict = "complete" if done == expected else f"partial ({done}/{expected})"
            counts = (Number(done, 0), Number(expected, 0))
            rows.append((label, planner, *counts, verdict if done else "not run"))
    missing = [name for name in track.planners if name not in {g.planner for g in inside}]
    rules = [f"own scenarios under thresholds {track.own_thresholds}"]
    rules += [f"{listed.label} under {listed.thresholds}"] if listed else []
    if drawn := track.drawn:
        rules.append(f"recorded, and with {drawn.count} edits of each of {', '.join(drawn.kinds)}")
    notes = [
        f"contract: traffic {', '.join(track.traffic)} × noise {', '.join(track.noise)} × seeds "
        f"{', '.join(map(str, track.seeds))} on all scenarios; {', '.join(rules)}",
        f"scores that are not complete are not the benchmark's; own scenarios: {track.own_note}",
    ]
    notes += [f"planners of the paper that are not here: {', '.join(missing)}"] if missing else []
    header = ("set", "planner", "rollouts", "of", "verdict")
    title = f"Coverage of the track {track.name}"
    return Table("coverage", title, header, tuple(rows), 2, tuple(notes))


def _belongs(group: Group, track: Track) -> bool:
    """Whether a group is part of the contract."""
    listed, rules = track.reference, track.own_thresholds
    if listed and group.data.known == listed.name:
        rules = listed.thresholds
    elif group.data.is_interplan:
        rules = INTERPLAN_THRESHOLDS
    modes = [TRAFFIC[name] for name in track.traffic]
    return (
        group.traffic in modes
        and group.noise in track.noise
        and group.data.thresholds == rules
        and group.data.controller == "lqr"
    )


def _finished(group: Group, track: Track) -> int:
    wanted = (0,) if group.noise == "none" else track.seeds
    rows = [i for i, seed in enumerate(group.seeds) if seed in wanted]
    return int(np.isfinite(group.values[rows, :, 0]).sum())
