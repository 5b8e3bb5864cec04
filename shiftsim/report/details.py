"""Tables beyond the paper's: planners compared, scenario types, edits, planning times."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pyarrow.compute as pc

from shiftsim.edits.sampling import GRADES, graded
from shiftsim.kernels import BoolArray, FloatArray
from shiftsim.report.groups import Group, distinct_sets
from shiftsim.report.paper import traffics
from shiftsim.report.statistics import (
    FEW_CLUSTERS,
    bootstrap_interval,
    cluster_codes,
    compare,
    holm,
)
from shiftsim.report.tables import Cell, Estimate, Interval, Number, Table
from shiftsim.runs.results import Run

ALL_KINDS = "all"


def planner_comparison(groups: Sequence[Group], *, noisy: bool = False) -> Table | None:
    """Every pair of planners on the same scenarios, clean or noisy; None where there is no pair."""
    blocks: dict[tuple[object, ...], list[Group]] = {}  # they differ in nothing but the planner
    mine = [group for group in groups if (group.noise != "none") == noisy]
    for group in mine:
        if group.is_complete:
            key = (group.data.key, group.traffic, group.noise, group.seeds)
            blocks.setdefault(key, []).append(group)
    alone = [
        f"{group.planner} {group.noise} {group.traffic}"
        for group in mine
        if not group.is_complete
        or len(blocks[group.data.key, group.traffic, group.noise, group.seeds]) < 2
    ]
    rows: list[tuple[Cell, ...]] = []
    num_recordings: set[int] = set()
    smallest = 0.0
    for block in blocks.values():
        pairs = list(combinations(block, 2))
        clusters = cluster_codes(block[0].data.recordings)
        results = [compare(100.0 * a.column(), 100.0 * b.column(), clusters) for a, b in pairs]
        corrected = holm([result.p_value for result in results])
        for (first, second), result, p_value in zip(pairs, results, corrected, strict=True):
            num_recordings.add(first.data.num_recordings)
            smallest = max(smallest, result.smallest_p)
            where = (first.data.label, first.traffic, first.noise, first.planner, second.planner)
            count = f"{result.wins}/{result.ties}/{result.losses}"
            tests = (Number(result.p_value, 4), Number(p_value, 4))
            rows.append((*where, Number(result.difference), result.interval, count, *tests))
    if not rows:
        return None
    notes = [
        *(data.rules for data in distinct_sets(groups)),
        "95 % CI: cluster bootstrap over recordings; p: the sign of each recording's difference "
        "flipped at random; Holm: corrected for all pairs of the same set, traffic and noise",
    ]
    if min(num_recordings) < FEW_CLUSTERS:
        notes.append(
            f"few recordings ({min(num_recordings)}): intervals are too narrow, and no p can be "
            f"below {smallest:.4f}"
        )
    if alone:
        words = "not compared, as rollouts are missing or no other planner has the same seeds"
        notes.append(f"{words}: {', '.join(alone)}")
    labels = ("set", "traffic", "noise", "first", "second")
    return Table(
        "planner-comparison-noise" if noisy else "planner-comparison",
        f"Planners compared scenario by scenario{', under noise' if noisy else ', clean'}: "
        "difference of closed-loop scores x 100, first minus second",
        (*labels, "difference", "95 % CI", "better/same/worse", "p", "p (Holm)"),
        tuple(rows),
        len(labels),
        tuple(notes),
    )


def scenario_types(groups: Sequence[Group], *, allow_partial: bool = False) -> list[Table]:
    """Clean scores by scenario type, planners side by side; sets of one type are left out."""
    clean = [group for group in groups if group.noise == "none"]
    out = []
    for data in distinct_sets(clean):
        types = sorted(set(data.types))
        if len(types) < 2:
            continue
        mine = [group for group in clean if group.data.key == data.key]
        columns = [g for traffic in traffics(mine) for g in mine if g.traffic == traffic]
        rows: list[tuple[Cell, ...]] = []
        for name in types:
            where = np.array(data.types) == name
            scores = (g.estimate("cls", where, allow_partial=allow_partial) for g in columns)
            rows.append((name or "unknown", Number(int(where.sum()), 0), *scores))
        header = ("type", "scenarios", *(f"{g.planner} {g.traffic}" for g in columns))
        title = f"Scores by scenario type: {data.label}, clean, closed-loop score x 100"
        name = f"scenario-types_{data.name}"
        out.append(Table(name, title, header, tuple(rows), 1, (data.rules,)))
    return out


def edited_scores(groups: Sequence[Group], *, allow_partial: bool = False) -> list[Table]:
    """Clean scores of edited scenarios by kind and difficulty; one table per set that was edited.

    Beside them stand those of the same recorded scenarios without the edit, each as often as it was
    edited. Scenarios of interPlan's codes have interPlan's score, and no such column.
    """
    clean = [group for group in groups if group.noise == "none"]
    out = []
    for data in distinct_sets(group for group in clean if group.data.edits):
        mine = [group for group in clean if group.data.key == data.key]
        kinds = [graded(name) for name in data.types]
        is_graded = any(grade for _, grade in kinds)
        grades = [*GRADES] if is_graded else []
        rows: list[tuple[Cell, ...]] = []
        names = sorted({kind for kind, _ in kinds})
        for group in (g for mode in traffics(mine) for g in mine if g.traffic == mode):
            for name in [*names, ALL_KINDS] if len(names) > 1 else names:
                of_kind = [name in (kind, ALL_KINDS) for kind, _ in kinds]
                cells = [recorded_score(group, np.array(of_kind), clean)]
                for grade in [*grades, ""]:
                    pairs = zip(of_kind, kinds, strict=True)
                    where = np.array([own and g in (grade or g,) for own, (_, g) in pairs])
                    cells.append(group.estimate("cls", where, allow_partial=allow_partial))
                count = Number(sum(of_kind), 0)
                labels = (group.traffic, group.planner, name or "unknown", count)
                rows.append((*labels, *cells[data.is_interplan :]))
        last = "interPlan score" if data.is_interplan else "all"
        header = ["traffic", "planner", "kind", "scenarios", "recorded", *grades, last]
        notes = [data.rules]
        if data.is_interplan:
            header.remove("recorded")
            notes.append("interPlan score: its metrics and weights, mean over the scenarios")
        else:
            notes.append("recorded: the same scenarios without the edit")
        if is_graded:
            each = ", ".join(f"{name} {most:g}" for name, most in GRADES.items())
            notes.append(
                f"difficulty: braking that avoids it [m/s²], up to {each}; hard also where only "
                "PDM-Closed avoids it"
            )
        title = f"Edited scenarios: {data.label}, closed-loop score x 100"
        name = f"edits_{data.name}"
        out.append(Table(name, title, tuple(header), tuple(rows), 3, tuple(notes)))
    return out


def recorded_score(group: Group, where: BoolArray, others: Sequence[Group]) -> Estimate | None:
    """The score of recorded scenarios that some (N,) scenarios of a group were made of."""
    values = recorded_values(group, where, others)
    if values is None:
        return None
    return Estimate(100.0 * float(values.mean()), None, len(values), len(values))


def recorded_interval(group: Group, where: BoolArray, others: Sequence[Group]) -> Interval | None:
    """The bootstrap interval of `recorded_score` over recordings."""
    values = recorded_values(group, where, others)
    if values is None:
        return None
    recordings = np.array(group.data.recordings)[where].tolist()
    return bootstrap_interval(100.0 * values, cluster_codes(recordings))


def recorded_values(group: Group, where: BoolArray, others: Sequence[Group]) -> FloatArray | None:
    """Scores of the recorded scenarios that some (N,) scenarios of a group were made of, in [0, 1].

    None where no other group has all of them under the same rules.
    """
    edited = group.run.manifest["edits"]["made"]
    chosen = np.flatnonzero(where).tolist()
    bases = [str(edited[group.data.tokens[i]]["base"]) for i in chosen]
    wanted = _driven_as(group)
    for other in others:
        place = {token: i for i, token in enumerate(other.data.tokens)}
        if not other.data.edits and _driven_as(other) == wanted and set(bases) <= set(place):
            values: FloatArray = other.column()[[place[token] for token in bases]]
            if len(values) and np.isfinite(values).all():
                return values
    return None


def _driven_as(group: Group) -> tuple[str, ...]:
    data = group.data
    return (group.traffic, group.planner, group.noise, data.windows, *data.traits[:3])


def planning_times(groups: Sequence[Group]) -> Table:
    """How long planners think, and how often the simulator's fallback plan had to do."""
    each = {(group.run.path, group.planner): group for group in groups}
    runs = {group.run.path: group.run for group in groups}
    times = ("ms per step", "95 % ms", "worst 95 % ms", "s per rollout")
    header = ("set", "traffic", "planner", "rollouts", *times, "degraded steps", "in rollouts")
    notes = (
        "per step: mean and 95th percentile within a rollout, of both the median over the "
        "rollouts, which compilation at the start of a run does not touch; per rollout: the "
        "median of reading, driving and scoring",
        *dict.fromkeys(f"machine: {_machine(run)}" for run in runs.values()),
    )
    title = "Planning time, and steps driven on a degraded (fallback) plan"
    return Table("planning-time", title, header, tuple(map(_times_row, each.values())), 3, notes)


def _times_row(group: Group) -> tuple[Cell, ...]:
    planner = group.planner.removesuffix(f" @{group.run.path.name}")  # as its run calls it
    tasks, scores = group.run.tasks, group.run.scores
    finished = pc.equal(tasks["status"], "ok")
    done = tasks.filter(pc.and_(pc.equal(tasks["planner"], planner), finished))
    degraded = scores.filter(pc.equal(scores["planner"], planner))["degraded_steps"].to_numpy()

    def known(name: str) -> FloatArray:
        values = done[name].to_numpy() if name in done.column_names else np.zeros(0)
        return values[np.isfinite(values)]

    parts = [known(f"{name}_seconds") for name in ("read", "simulate", "metrics")]
    each = [float(np.median(values)) for values in parts if len(values)]
    mean, tail = known("planning_ms_mean"), known("planning_ms_p95")
    return (
        *(group.data.label, group.traffic, group.planner),
        Number(len(done), 0),
        *(Number(float(np.median(one))) if len(one) else None for one in (mean, tail)),
        Number(float(tail.max())) if len(tail) else None,
        Number(sum(each), 3) if each else None,
        Number(int(degraded.sum()), 0),
        Number(int(np.sum(degraded > 0)), 0),
    )


def _machine(run: Run) -> str:
    machine = run.manifest.get("machine", {})
    workers = run.manifest.get("workers", "?")
    return f"{machine.get('processor', '?')}, {machine.get('cores', '?')} cores, {workers} workers"
