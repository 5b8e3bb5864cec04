"""Tables beyond the paper's: planners compared, scenario types, planning times."""

from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np
import pyarrow.compute as pc

from shiftsim.report.groups import Group
from shiftsim.report.paper import distinct_sets, traffics
from shiftsim.report.statistics import FEW_CLUSTERS, Comparison, cluster_codes, compare, holm
from shiftsim.report.tables import Cell, Number, Table
from shiftsim.runs.results import Run


def planner_comparison(groups: Sequence[Group], *, noisy: bool = False) -> Table | None:
    """Every pair of planners on the same scenarios; None where there is no pair.

    Args:
        groups: The groups.
        noisy: Compare under noise instead of without.
    """
    rows: list[tuple[Cell, ...]] = []
    recordings: set[int] = set()
    smallest = 0.0
    for block in _blocks(group for group in groups if (group.noise != "none") == noisy):
        pairs = list(combinations(block, 2))
        data = block[0].data
        clusters = cluster_codes(data.recordings)
        results = [compare(100.0 * a.column(), 100.0 * b.column(), clusters) for a, b in pairs]
        corrected = holm([result.p_value for result in results])
        for (a, b), result, p_value in zip(pairs, results, corrected, strict=True):
            rows.append(_comparison_row(a, b, result, p_value))
            recordings.add(data.num_recordings)
            smallest = max(smallest, result.smallest_p)
    if not rows:
        return None
    return Table(
        "planner-comparison-noise" if noisy else "planner-comparison",
        f"Planners compared scenario by scenario{', under noise' if noisy else ', clean'}: "
        "difference of CLS x 100, first minus second",
        (
            "set",
            "traffic",
            "noise",
            "first",
            "second",
            "difference",
            "95 % CI",
            "better/same/worse",
            "p",
            "p (Holm)",
        ),
        tuple(rows),
        5,
        (
            *(data.rules for data in distinct_sets(groups)),
            *_comparison_notes(min(recordings), smallest),
        ),
    )


def _blocks(groups: Iterable[Group]) -> list[list[Group]]:
    """Complete groups that differ in nothing but the planner; two or more."""
    found: dict[tuple[object, ...], list[Group]] = {}
    for group in groups:
        if group.is_complete:
            key = (group.data.key, group.traffic, group.noise, group.seeds)
            found.setdefault(key, []).append(group)
    return [block for block in found.values() if len(block) > 1]


def _comparison_row(
    first: Group, second: Group, result: Comparison, p_value: float
) -> tuple[Cell, ...]:
    return (
        first.data.label,
        first.traffic,
        first.noise,
        first.planner,
        second.planner,
        Number(result.difference),
        result.interval,
        f"{result.wins}/{result.ties}/{result.losses}",
        Number(result.p_value, 4),
        Number(p_value, 4),
    )


def _comparison_notes(num_recordings: int, smallest: float) -> list[str]:
    notes = [
        "95 % CI: cluster bootstrap over recordings; p: the sign of each recording's difference "
        "flipped at random; Holm: corrected for all pairs of the same set, traffic and noise",
    ]
    if num_recordings < FEW_CLUSTERS:
        notes.append(
            f"few recordings ({num_recordings}): intervals are too narrow, and no p can be below "
            f"{smallest:.4f}"
        )
    return notes


def scenario_types(groups: Sequence[Group], *, allow_partial: bool = False) -> list[Table]:
    """Clean scores by scenario type, planners side by side; sets of one type are left out."""
    clean = [group for group in groups if group.noise == "none"]
    out = []
    for data in distinct_sets(clean):
        types = sorted(set(data.types))
        if len(types) < 2:
            continue
        mine = [group for group in clean if group.data.key == data.key]
        columns = [(t, g) for t in traffics(mine) for g in mine if g.traffic == t]
        kinds = np.array(data.types)
        rows = [
            (
                name or "unknown",
                Number(int(np.sum(kinds == name)), 0),
                *(
                    g.estimate("cls", kinds == name, allow_partial=allow_partial)
                    for _, g in columns
                ),
            )
            for name in types
        ]
        out.append(
            Table(
                f"scenario-types_{data.name}",
                f"Scores by scenario type: {data.label}, clean, CLS x 100",
                ("type", "scenarios", *(f"{g.planner} {t}" for t, g in columns)),
                tuple(rows),
                1,
                (data.rules,),
            )
        )
    return out


def planning_times(groups: Sequence[Group]) -> Table | None:
    """How long planners think, and how often a makeshift plan had to do."""
    rows = []
    runs: dict[object, Run] = {}
    for first in {(g.run.path, g.planner): g for g in groups}.values():
        runs[first.run.path] = first.run
        rows.append(_times_row(first, _own_name(first)))
    notes = [f"machine: {_machine(run)}" for run in runs.values()]
    return Table(
        "planning-time",
        "Planning time, and steps driven on a degraded (makeshift) plan",
        (
            "set",
            "traffic",
            "planner",
            "rollouts",
            "ms per step",
            "95 % ms",
            "worst 95 % ms",
            "s per rollout",
            "degraded steps",
            "in rollouts",
        ),
        tuple(rows),
        3,
        (
            "per step: mean and 95th percentile within a rollout, of both the median over the "
            "rollouts, which compilation at the start of a run does not touch; per rollout: the "
            "median of reading, driving and scoring",
            *dict.fromkeys(notes),
        ),
    )


def _own_name(group: Group) -> str:
    """The planner as it is called in its run."""
    return group.planner.removesuffix(f" @{group.run.path.name}")


def _times_row(group: Group, planner: str) -> tuple[Cell, ...]:
    tasks, scores = group.run.tasks, group.run.scores
    done = tasks.filter(
        pc.and_(pc.equal(tasks["planner"], planner), pc.equal(tasks["status"], "ok"))
    )
    degraded = scores.filter(pc.equal(scores["planner"], planner))["degraded_steps"].to_numpy()

    def numbers(name: str) -> np.ndarray:
        values = done[name].to_numpy() if name in done.column_names else np.zeros(0)
        return values[np.isfinite(values)]

    parts = [numbers(f"{name}_seconds") for name in ("read", "simulate", "metrics")]
    each = [float(np.median(values)) for values in parts if len(values)]
    mean, tail = numbers("planning_ms_mean"), numbers("planning_ms_p95")
    return (
        group.data.label,
        group.traffic,
        group.planner,
        Number(len(done), 0),
        Number(float(np.median(mean))) if len(mean) else None,
        Number(float(np.median(tail))) if len(tail) else None,
        Number(float(tail.max())) if len(tail) else None,
        Number(sum(each), 3) if each else None,
        Number(int(degraded.sum()), 0),
        Number(int(np.sum(degraded > 0)), 0),
    )


def _machine(run: Run) -> str:
    machine = run.manifest.get("machine", {})
    workers = run.manifest.get("workers", "?")
    return f"{machine.get('processor', '?')}, {machine.get('cores', '?')} cores, {workers} workers"
