"""Tables beyond the paper's: planners compared, scenario types, edits, planning times."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pyarrow.compute as pc

from shiftsim.edits.sampling import GRADES, graded
from shiftsim.kernels import FloatArray
from shiftsim.metrics import open_loop
from shiftsim.report.groups import Group, by_set, distinct_sets
from shiftsim.report.statistics import (
    FEW_CLUSTERS,
    bootstrap_interval,
    cluster_codes,
    compare,
    holm,
)
from shiftsim.report.tables import Cell, Interval, Number, Record, Row, Table
from shiftsim.runs.results import Run

ALL_KINDS = "all"


def planner_comparison(groups: Sequence[Group], *, noisy: bool = False) -> Table | None:
    """Every pair of planners on the same scenarios, clean or noisy; None where there is no pair."""
    blocks: dict[tuple[object, ...], list[Group]] = {}  # they differ in nothing but the planner
    for group in (group for group in groups if (group.noise != "none") == noisy):
        without_pair = "" if group.is_complete else group.planner
        key = (group.data.key, group.traffic, group.noise, group.seeds, without_pair)
        blocks.setdefault(key, []).append(group)
    pairs = [block for block in blocks.values() if len(block) > 1]
    alone = [block[0] for block in blocks.values() if len(block) == 1]
    if not pairs:
        return None
    notes = [
        *(data.rules for data in distinct_sets(groups)),
        "95 % CI: cluster bootstrap over recordings; p: the sign of each recording's difference "
        "flipped at random; Holm: corrected for all pairs of the same set, traffic and noise",
    ]
    records, smallest = list[Record](), 0.0
    for block in pairs:
        found, least = _compared(block)
        records += found
        smallest = max(smallest, least)
    few = min(block[0].data.num_recordings for block in pairs)
    if few < FEW_CLUSTERS:
        notes.append(
            f"few recordings ({few}): intervals are too narrow, and no p can be below "
            f"{smallest:.4f}"
        )
    if alone:
        words = "not compared, as rollouts are missing or no other planner has the same seeds"
        names = (f"{group.planner} {group.noise} {group.traffic}" for group in alone)
        notes.append(f"{words}: {', '.join(names)}")
    return Table.of(
        "planner-comparison-noise" if noisy else "planner-comparison",
        f"Planners compared scenario by scenario{', under noise' if noisy else ', clean'}: "
        "difference of closed-loop scores × 100, first minus second",
        records,
        5,
        notes=notes,
    )


def _compared(block: Sequence[Group]) -> tuple[list[Record], float]:
    """A record per pair of groups, and the smallest p-value that their recordings allow."""
    clusters = cluster_codes(block[0].data.recordings)
    pairs = [*combinations(block, 2)]
    results = [
        compare(100.0 * a.scenario_means(), 100.0 * b.scenario_means(), clusters) for a, b in pairs
    ]
    corrected = holm([result.p_value for result in results])
    records: list[Record] = [
        {
            **{"set": first.data.label, "traffic": first.traffic, "noise": first.noise},
            **{"first": first.planner, "second": second.planner},
            "difference": Number(result.difference),
            "95 % CI": result.interval,
            "better/same/worse": f"{result.wins}/{result.ties}/{result.losses}",
            "p": Number(result.p_value, 4),
            "p (Holm)": Number(p_value, 4),
        }
        for (first, second), result, p_value in zip(pairs, results, corrected, strict=True)
    ]
    return records, max(result.smallest_p for result in results)


def scenario_types(groups: Sequence[Group]) -> list[Table]:
    """Clean scores by scenario type, planners side by side; sets of one type are left out."""
    out = []
    for data, mine in by_set(group for group in groups if group.noise == "none"):
        parts = [dict(group.split("scenario_type")) for group in mine]
        rows: list[Row] = [
            (name, Number(len(part.data.tokens), 0), *(each[name].estimate() for each in parts))
            for name, part in parts[0].items()
        ]
        header = ("type", "scenarios", *(f"{g.planner} {g.traffic}" for g in mine))
        title = f"Scores by scenario type: {data.label}, clean, closed-loop score × 100"
        if len(rows) > 1:
            out.append(Table(f"scenario-types_{data.name}", title, header, rows, 1, (data.rules,)))
    return out


def edited_scores(groups: Sequence[Group]) -> list[Table]:
    """Scores of edited scenarios by kind and difficulty; one table per set that was edited.

    Beside them stand those of the same recorded scenarios without the edit, each as often as it was
    edited. Scenarios of interPlan's codes have interPlan's score, and no such column.
    """
    out = []
    for data, mine in by_set(group for group in groups if group.data.edits):
        kinds, difficulties = np.array([graded(name) for name in data.types], str).T
        names = np.unique(kinds).tolist()
        grades = [*GRADES] if any(difficulties) else []
        is_noisy = any(group.noise != "none" for group in mine)
        total = "interPlan score" if data.is_interplan else "all"
        records: list[Record] = []
        for group in mine:
            for name in [*names, ALL_KINDS] if len(names) > 1 else names:
                where = (kinds == name) | (name == ALL_KINDS)
                part = group.only(where)
                record: Record = {"traffic": group.traffic, "planner": group.planner}
                record |= {"noise": group.noise} if is_noisy else {}
                record |= {"kind": name or "unknown", "scenarios": Number(len(part.data.tokens), 0)}
                if not data.is_interplan:
                    record["recorded"] = recorded_score(part, groups)[0]
                record |= {one: part.only(difficulties[where] == one).estimate() for one in grades}
                records.append(record | {total: part.estimate()})
        of_total = "interPlan score: its metrics and weights, mean over the scenarios"
        without = "recorded: the same scenarios without the edit"
        notes = [data.rules, of_total if data.is_interplan else without]
        if grades:
            each = ", ".join(f"{name} {most:g}" for name, most in GRADES.items())
            notes.append(
                f"difficulty: braking that avoids it [m/s²], up to {each}; hard also where only "
                "PDM-Closed avoids it"
            )
        title = f"Edited scenarios: {data.label}, closed-loop score × 100"
        num_labels, name = 3 + is_noisy, f"edits_{data.name}"
        best = dict.fromkeys([*records[0]][num_labels + 1 :], max)
        out.append(Table.of(name, title, records, num_labels, notes=notes, best=best))
    return out


def recorded_score(group: Group, others: Sequence[Group]) -> tuple[Number | None, Interval | None]:
    """Score and interval of the recorded scenarios that those of a group were made of.

    None where no other group has all of them under the same rules.
    """
    edited = group.run.manifest["edits"]["made"]
    bases = [str(edited[token]["base"]) for token in group.data.tokens]
    for other in others:
        place = {token: i for i, token in enumerate(other.data.tokens)}
        is_alike = not other.data.edits and _driven_as(other) == _driven_as(group)
        if bases and is_alike and set(bases) <= set(place):
            values = 100.0 * other.scenario_means()[[place[token] for token in bases]]
            if np.isfinite(values).all():
                interval = bootstrap_interval(values, cluster_codes(group.data.recordings))
                return Number(float(values.mean())), interval
    return None, None


def _driven_as(group: Group) -> tuple[object, ...]:
    data = group.data
    labels = (group.traffic, group.planner, group.noise, group.seeds)
    return (*labels, data.windows, *data.traits[:3])


def has_open_loop(group: Group) -> bool:
    """Whether the run was asked for open-loop scores."""
    return bool(group.run.manifest["config"].get("open_loop"))


def open_loop_scores(groups: Sequence[Group]) -> Table | None:
    """Open loop beside closed loop, of the runs that asked for it."""
    asked = [group for group in groups if has_open_loop(group)]
    each = {(group.run.path, group.planner): group for group in reversed(asked)}
    if not each:
        return None
    records = [_open_loop_record(group) for group in reversed(each.values())]
    counts = dict.fromkeys(str(record["plans"]) for record in records if record["plans"])
    notes = (
        "CLS: closed loop under that noise; open loop: nuPlan's score of the plans along the "
        "recording; errors: means over plans and horizons of 3, 5 and 8 s; missed: largest share "
        "of plans that are too far away; where plans were not compared, as the recording ends, "
        "the score is not nuPlan's",
        f"plans compared: {', '.join(counts)}",
    )
    title = "Open loop beside closed loop, scores × 100"
    scores, errors = [*records[0]][4:6], [*records[0]][6:-2]
    best = dict.fromkeys(scores, max) | dict.fromkeys(errors, min)
    return Table.of("open-loop", title, records, 4, notes=notes, best=best)


def open_loop_values(group: Group, metric: str) -> FloatArray:
    """(N,) an open-loop metric's mean over the seeds of every scenario; NaN where there is none."""
    table = group.run.metrics
    chosen = {"planner": group.name, "noise": group.noise, "metric": metric}
    for name, value in chosen.items():
        table = table.filter(pc.equal(table[name], value))
    means = table.group_by("token").aggregate([("value", "mean")])
    found = dict(zip(means["token"].to_pylist(), means["value_mean"].to_pylist(), strict=True))
    values = (found.get(token) for token in group.data.tokens)
    return np.array([np.nan if value is None else value for value in values])


def _open_loop_record(group: Group) -> Record:
    metrics = group.run.metrics
    mine = pc.and_(
        pc.equal(metrics["planner"], group.name), pc.equal(metrics["noise"], group.noise)
    )
    found = metrics.filter(mine).group_by("metric").aggregate([("value", "sum"), ("value", "mean")])
    sums, means = (
        dict(zip(found["metric"].to_pylist(), found[f"value_{of}"].to_pylist(), strict=True))
        for of in ("sum", "mean")
    )
    plans = metrics.filter(pc.and_(mine, pc.equal(metrics["metric"], open_loop.COUNT)))
    counted, there = sums.get(open_loop.COUNT), pc.sum(plans["threshold"]).as_py()

    def mean(name: str, scale: float = 1.0) -> Number | None:
        return None if (value := means.get(name)) is None else Number(scale * value)

    return {
        **{"set": group.data.label, "traffic": group.traffic, "planner": group.planner},
        "noise": group.noise,
        "CLS": group.estimate(),
        "open loop": mean(open_loop.TOTAL, 100.0),
        **{f"{error} {unit}": mean(m) for m, (error, unit, *_) in open_loop.METRICS.items()},
        "missed": mean(open_loop.MISS),
        "rollouts": Number(len(plans), 0),
        "plans": f"{counted:.0f} of {there:.0f}" if counted else None,
    }


def planning_times(groups: Sequence[Group]) -> Table:
    """How long planners think, and how often the simulator's fallback plan had to do."""
    each = {(group.run.path, group.planner): group for group in groups}
    runs = {group.run.path: group.run for group in groups}
    notes = (
        "per step: mean and 95th percentile within a rollout, of both the median over the "
        "rollouts, which compilation at the start of a run does not touch; per rollout: the "
        "median of reading, driving and scoring",
        *dict.fromkeys(f"machine: {_machine(run)}" for run in runs.values()),
    )
    title = "Planning time, and steps driven on a degraded (fallback) plan"
    records = [*map(_times_record, each.values())]
    best = dict.fromkeys([*records[0]][4:], min)
    return Table.of("planning-time", title, records, 3, notes=notes, best=best)


def _times_record(group: Group) -> Record:
    tasks, scores = group.run.tasks, group.run.scores
    finished = pc.equal(tasks["status"], "ok")
    done = tasks.filter(pc.and_(pc.equal(tasks["planner"], group.name), finished))
    degraded = scores.filter(pc.equal(scores["planner"], group.name))["degraded_steps"].to_numpy()

    def known(name: str) -> FloatArray:
        values = done[name].to_numpy() if name in done.column_names else np.zeros(0)
        return values[np.isfinite(values)]

    def medians(*names: str, digits: int = 2) -> Cell:
        found = [float(np.median(values)) for name in names if len(values := known(name))]
        return Number(sum(found), digits) if found else None

    tail = known("planning_ms_p95")
    return {
        **{"set": group.data.label, "traffic": group.traffic, "planner": group.planner},
        "rollouts": Number(len(done), 0),
        "ms per step": medians("planning_ms_mean"),
        "95 % ms": medians("planning_ms_p95"),
        "worst 95 % ms": Number(float(tail.max())) if len(tail) else None,
        "s per rollout": medians("read_seconds", "simulate_seconds", "metrics_seconds", digits=3),
        "degraded steps": Number(int(degraded.sum()), 0),
        "in rollouts": Number(int(np.sum(degraded > 0)), 0),
    }


def _machine(run: Run) -> str:
    machine = run.manifest.get("machine", {})
    workers = run.manifest.get("workers", "?")
    return f"{machine.get('processor', '?')}, {machine.get('cores', '?')} cores, {workers} workers"
