"""The score table of a run: every planner and noise, every metric.

A score is the plain mean over scenarios, as nuPlan's is: scenario types are not weighted, and a
metric without a score counts as 0. With several seeds it is the mean of the seeds' means. Scores
are printed times 100. Where tasks failed or are missing no score is printed, or one that says so.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow.compute as pc

from shiftsim.errors import plural
from shiftsim.report import words
from shiftsim.report.groups import COLUMNS, Group, planner_identities, read_groups, seed_deviation
from shiftsim.report.tables import Cell, Number, Row, Table, text
from shiftsim.runs.results import Run
from shiftsim.runs.rollouts import Task


def score_table(runs: Sequence[Run], *, allow_partial: bool = False, **look: Any) -> str:
    """The scores of runs as text; `allow_partial` labels means, `look` is that of `tables.text`."""
    table = scores(read_groups(runs, allow_partial=allow_partial))
    return text(replace(table, title=""), **look)


def scores(groups: Sequence[Group], *, by: str | None = None) -> Table:
    """All columns of all groups: means, and below them their deviations over the seeds."""
    several = len({(group.data.key, group.traffic) for group in groups}) > 1
    heading = [*(["set", "traffic"] if several else []), "planner", "noise", *([by] if by else [])]
    rows: list[Row] = []
    full: list[Row] = []
    paper: list[Row] = []
    for group in groups:
        where = (group.data.label, group.traffic) if several else ()
        for name, part in group.split(by):
            labels = (*where, group.planner, group.noise, *([name] if by else []))
            shown, complete = _lines(labels, part, _describe(group))
            rows += shown
            full += complete
            paper.append((*labels, *map(part.estimate, COLUMNS)))
    header = (*heading, *COLUMNS.values())
    in_full = (*header, "statistic", "done", "expected", "label")
    machine = Table("scores", "", in_full, full, len(heading))
    notes = tuple(dict.fromkeys(map(_describe, groups)))
    sets = dict.fromkeys(f"{group.data.label}, traffic {group.traffic}" for group in groups)
    title = f"Scores × 100 of all planners and noises: {'; '.join(sets)}"
    best = dict.fromkeys(COLUMNS.values(), max)
    counts = sorted({len(group.seeds) for group in groups} - {0, 1})
    seeds = f"± sample standard deviation (n − 1) over {' or '.join(map(str, counts))} seeds"
    words = (*notes, seeds) if counts else notes
    in_paper = Table("scores", title, header, paper, len(heading), words, best=best)
    more: dict[str, Any] = {"full": machine, "paper": in_paper, "best": best}
    return Table("scores", title, header, rows, len(heading), notes, **more)


def planner_notes(runs: Sequence[Run]) -> list[str]:
    """What a reader must know of planners: their weights, who saw the recording, who drove."""
    found = [pair for run in runs for pair in planner_identities(run).items()]
    made_up = {n for n, one in found if str(one.get("checkpoint")).startswith("deterministic:")}
    own = {f"{n}, {one['weights']}" for n, one in found if one.get("weights")}
    informed = {n for n, one in found if one.get("sees_recording")}
    notes = {
        f"MEANINGLESS: made-up weights of {', '.join(sorted(made_up))}": made_up,
        "; ".join(sorted(own)): own,
        f"given the recorded future: {', '.join(sorted(informed))}": informed,
    }
    elsewhere = dict.fromkeys(line for run in runs for line in run.remarks)
    return [*(note for note, names in notes.items() if names), *elsewhere]


def _describe(group: Group) -> str:
    """What stands beside every printed score."""
    data = group.data
    return " · ".join(
        [
            f"split {data.label} ({plural(len(data.tokens), 'scenario')})",
            f"traffic {group.run.manifest['determining']['traffic']}",
            f"controller {data.controller}",
            f"thresholds {data.thresholds}",
            f"metrics v{data.metric_version}",
            "scores × 100",
            *planner_notes([group.run]),
        ]
    )


def _lines(labels: tuple[str, ...], part: Group, caption: str) -> tuple[list[Row], list[Row]]:
    """The lines of a row for people and for machines: the means, and their deviation over seeds."""
    found = [part.estimate(name) for name in COLUMNS]
    means = [None if one.value is None else Number(one.value) for one in found]
    spread = [Number(one.std) for one in found if one.std is not None]
    known = next((one for one in found if one.expected), found[0])
    count, label = f"{known.done}/{known.expected}", known.label
    about = (*count.split("/"), f"{label}; {caption}" if label else caption)
    first: Cell = means[0] if not label else f"{means[0]} {label}"
    if means[0] is None:
        first = f"– ({count} done)"
    if known is not found[0]:
        first = "undefined"
    shown: list[Row] = [(*labels, first, *(number or "–" for number in means[1:]))]
    full: list[Row] = [(*labels, *means, "mean", *about)]
    if spread:
        seeds = f"{len(part.seeds)} seeds"
        shown.append((*[""] * (len(labels) - 1), f"± {seeds}", *spread))
        full.append((*labels, *spread, f"std over {seeds}", *about))
    return shown, full


def worst_rollouts(run: Run, count: int = 10) -> list[dict[str, Any]]:
    """The worst scenarios by their worst rollout: key, `cls`, `reason`, number of like `others`."""
    keys = [*Task._fields]
    lowest = run.scores.group_by("token").aggregate([("cls", "min")])
    scores = run.scores.select([*keys, "cls", "log_name"]).join(lowest, "token")
    scores = scores.filter(pc.equal(scores["cls"], scores["cls_min"]))
    below = run.metrics.filter(pc.less(run.metrics["score"], 1.0))
    metrics = words.rows_by_task(below.join(scores.select(keys), keys, join_type="left semi"))
    rows = []
    for row in scores.to_pylist():
        cause = words.worst_violation(words.violations(metrics.get(words.task_of(row), [])))
        known = {"cause": "", "severity": (), "reason": "", "log": row["log_name"]}
        if cause is not None:
            # one that does not multiply the score stands with its own, times 100
            score = "" if cause.is_multiplier else f" {100.0 * cause.row['score']:.2f}"
            time = "" if cause.time is None else f" {cause.time:.1f} s"
            known |= {"cause": cause.reason, "severity": words.severity(cause)}
            known |= {"reason": f"{cause.reason}{score}{time}"}
        rows.append(row | known)
    return [
        words.task_of(row)._asdict()
        | {"cls": row["cls"], "reason": row["reason"], "others": others}
        for row, others in words.worst_of(rows, count)
    ]


def summary(run: Run) -> dict[str, Any]:
    """A run in JSON values: what it is, its counts, and its scores; null where withheld."""
    manifest, determining = run.manifest, run.manifest["determining"]
    return {
        "run": str(run.path),
        "state": manifest["state"],
        "split": manifest["split"],
        "traffic": determining["traffic"],
        "thresholds": determining["thresholds"]["name"],
        "metric_version": determining["metric_version"],
        "counts": manifest["counts"],
        "scores": [_summary(group) for group in read_groups([run])],
        "failures": failures(run),
    }


def _summary(group: Group) -> dict[str, Any]:
    seeds = {name: group.seed_means(name) for name in COLUMNS}
    means = {name: float(values.mean()) for name, values in seeds.items() if len(values)}
    spread = {name: seed_deviation(values) for name, values in seeds.items() if len(values) > 1}
    finished = np.isfinite(group.values).any(axis=2)
    return {
        "set": group.data.label,
        "planner": group.planner,
        "noise": group.noise,
        "scenarios": len(group.data.tokens),
        "seeds": len(group.seeds),
        "done": int(finished.sum()),
        "expected": finished.size,
        "mean": means if group.is_complete else None,
        "std_over_seeds": spread if group.is_complete else None,
        "partial_mean": None if group.is_complete else means,
    }


def failures(run: Run) -> list[dict[str, Any]]:
    """Tasks that failed or are missing: key, status, error and hint."""
    names = [*Task._fields, "status", "error", "hint"]
    failed = run.tasks.filter(pc.not_equal(run.tasks["status"], "ok"))
    return list(failed.select(names).to_pylist())
