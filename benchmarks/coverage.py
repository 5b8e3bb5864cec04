"""How much of a track some runs cover: its contract, counted rollout by rollout."""

from collections.abc import Sequence

import numpy as np

from shiftsim.benchmarks import Track
from shiftsim.report.groups import TRAFFIC, Group, distinct_sets
from shiftsim.report.tables import Cell, Number, Table


def coverage(track: Track, groups: Sequence[Group]) -> Table:
    """Finished rollouts of the track's contract, by set of scenarios and planner.

    A score is the track's score only where all of them are there.
    """
    inside = [group for group in groups if _belongs(group, track)]
    sets = {data.name: (data.label, data.whole) for data in distinct_sets(inside)}
    sets.setdefault(track.reference.name, (track.reference.label, track.reference.count))
    rows: list[tuple[Cell, ...]] = []
    for name, (label, whole) in sets.items():
        for planner in dict.fromkeys(group.planner for group in inside):
            mine = [g for g in inside if (g.data.name, g.planner) == (name, planner)]
            done = sum(_finished(group, track) for group in mine)
            expected = whole * track.rollouts_per_scenario
            verdict = "complete" if done == expected else f"partial ({done}/{expected})"
            counts = (Number(done, 0), Number(expected, 0))
            rows.append((label, planner, *counts, verdict if done else "not run"))
    missing = [name for name in track.planners if name not in {g.planner for g in inside}]
    notes = [
        f"contract: traffic {', '.join(track.traffic)} × noise {', '.join(track.noise)} × seeds "
        f"{', '.join(map(str, track.seeds))} on all scenarios; own scenarios under thresholds "
        f"{track.own_thresholds}, {track.reference.label} under {track.reference.thresholds}",
        f"scores that are not complete are not the benchmark's; own scenarios: {track.own_note}",
    ]
    notes += [f"planners of the paper that are not here: {', '.join(missing)}"] if missing else []
    header = ("set", "planner", "rollouts", "of", "verdict")
    title = f"Coverage of the track {track.name}"
    return Table("coverage", title, header, tuple(rows), 2, tuple(notes))


def _belongs(group: Group, track: Track) -> bool:
    """Whether a group is part of the contract."""
    reference = group.data.known == track.reference.name
    rules = track.reference.thresholds if reference else track.own_thresholds
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
