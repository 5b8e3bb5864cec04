"""The score table of a run: every planner and noise, every metric.

A score is the plain mean over scenarios, as nuPlan's is: scenario types are not weighted, and a
metric without a score counts as 0. With several seeds it is the mean of the seeds' means. Scores
are printed times 100. Where tasks failed or are missing no score is printed, or one that says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow.compute as pc

from shiftsim.errors import one_of
from shiftsim.kernels import FloatArray
from shiftsim.report.groups import (
    COLUMNS,
    Group,
    read_groups,
    recording_note,
    synthetic_weights_note,
    weights_note,
)
from shiftsim.report.tables import Cell, Number, Table, text
from shiftsim.report.words import (
    Violation,
    rows_by_task,
    severity,
    task_of,
    violations,
    worst_of,
    worst_violation,
)
from shiftsim.runs.results import Run
from shiftsim.runs.rollouts import Task

GROUPINGS = ("scenario_type", "city", "seed")
_NO_CAUSE: dict[str, Any] = {"cause": "", "severity": ()}


@dataclass(frozen=True, slots=True)
class ScoreRow:
    """One line of a score table."""

    labels: tuple[str, ...]  # planner, noise, and what else tells the lines apart
    num_done: int  # finished tasks
    num_expected: int  # tasks of a complete run
    num_scenarios: int  # scenarios of a complete run
    num_seeds: int  # seeds
    # mean of each column of `COLUMNS` in [0, 1]; empty when nothing finished
    means: dict[str, float]
    # standard deviation over the seeds' means; empty for a single seed
    deviations: dict[str, float]

    @property
    def is_complete(self) -> bool:
        """Whether the means are those of the whole benchmark."""
        return self.num_done == self.num_expected


def score_rows(run: Run, *, by: str | None = None) -> list[ScoreRow]:
    """One row per planner and noise, in the order of the settings; `by` splits them further."""
    return [row for group in read_groups([run]) for row in _score_rows(group, by)]


def _score_rows(group: Group, by: str | None) -> list[ScoreRow]:
    labels = (group.planner, group.noise)
    if by is None:
        return [_score_row(labels, group.values)]
    if by == "seed":
        each = zip(group.seeds, group.values, strict=True)
        return [_score_row((*labels, str(seed)), values[None]) for seed, values in each]
    kinds = np.array(group.data.types if by == "scenario_type" else group.data.cities)
    return [
        _score_row((*labels, name or "unknown"), group.values[:, kinds == name])
        for name in sorted(set(kinds.tolist()))
    ]


def _score_row(labels: tuple[str, ...], values: FloatArray) -> ScoreRow:
    finished = np.isfinite(values[:, :, 0])
    seeds = zip(values, finished, strict=True)
    means = np.array([seed[done].mean(axis=0) for seed, done in seeds if any(done)])
    spread = means.std(axis=0, ddof=1) if len(means) > 1 else None
    mean = means.mean(axis=0) if len(means) else None
    counts = (int(finished.sum()), finished.size, values.shape[1], len(values))
    return ScoreRow(labels, *counts, _by_column(mean), _by_column(spread))


def _by_column(values: FloatArray | None) -> dict[str, float]:
    return {} if values is None else dict(zip(COLUMNS, values.tolist(), strict=True))


def score_table(runs: Sequence[Run], *, allow_partial: bool = False) -> str:
    """The scores of runs as text; threshold profile, metric version and count stand with it.

    `allow_partial` prints the mean over the finished tasks of an incomplete row, labelled so.
    """
    return text(replace(scores(read_groups(runs), allow_partial=allow_partial), title=""))


def scores(groups: Sequence[Group], *, by: str | None = None, allow_partial: bool = False) -> Table:
    """All columns of all groups: means, and below them their deviations over the seeds.

    For machines every row says by itself what it is.
    """
    if by is not None:
        one_of("column", by, GROUPINGS)
    several = len({(group.data.key, group.traffic) for group in groups}) > 1
    heading = [*(["set", "traffic"] if several else []), "planner", "noise", *([by] if by else [])]
    rows: list[tuple[Cell, ...]] = []
    full: list[tuple[Cell, ...]] = []
    captions = [_describe(group) for group in groups]
    for group, caption in zip(groups, captions, strict=True):
        where = (group.data.label, group.traffic) if several else ()
        for row in _score_rows(group, by):
            lines = _lines((*where, *row.labels), row, caption, allow_partial=allow_partial)
            rows += lines[0]
            full += lines[1]
    header, count = (*heading, *COLUMNS.values()), len(heading)
    header_in_full = (*header, "statistic", "done", "expected", "label")
    machine = Table("scores", "", header_in_full, tuple(full), count)
    title, notes = "All planners and noises, scores x 100", tuple(dict.fromkeys(captions))
    return Table("scores", title, header, tuple(rows), count, notes, machine)


def _describe(group: Group) -> str:
    """What stands beside every printed score."""
    data = group.data
    run = group.run
    notes = filter(None, (synthetic_weights_note([run]), weights_note([run]), recording_note(run)))
    return (
        f"split {data.label} ({len(data.tokens)} scenarios) · "
        f"traffic {run.manifest['determining']['traffic']} · controller {data.controller} · "
        f"thresholds {data.thresholds} · metrics v{data.metric_version} · scores x 100"
        f"{''.join(f' · {note}' for note in notes)}"
    )


def _lines(
    labels: tuple[str, ...], row: ScoreRow, caption: str, *, allow_partial: bool
) -> tuple[list[tuple[Cell, ...]], list[tuple[Cell, ...]]]:
    """The lines of a row for people and for machines: the means, and their deviation over seeds."""
    count = f"({row.num_done}/{row.num_expected}"
    done = (str(row.num_done), str(row.num_expected))
    if not row.is_complete and not (allow_partial and row.means):
        dashes, empty = ["–"] * (len(COLUMNS) - 1), [None] * len(COLUMNS)
        note = f"withheld {count} done); {caption}"
        return [(*labels, f"– {count} done)", *dashes)], [(*labels, *empty, "mean", *done, note)]
    means: list[Cell] = [Number(100.0 * value) for value in row.means.values()]
    tail = (*done, caption if row.is_complete else f"partial {count}); {caption}")
    full = [(*labels, *means, "mean", *tail)]
    if not row.is_complete:
        means[0] = f"{means[0]} partial {count})"
    shown = [(*labels, *means)]
    if row.deviations:
        spread = [Number(100.0 * value) for value in row.deviations.values()]
        shown.append((*[""] * (len(labels) - 1), f"± {row.num_seeds} seeds", *spread))
        full.append((*labels, *spread, f"std over {row.num_seeds} seeds", *tail))
    return shown, full


def worst_rollouts(run: Run, count: int = 10) -> list[dict[str, Any]]:
    """The worst scenarios, each by its worst rollout, in the order of `words.worst_of`.

    Each with the key of that rollout, its `cls`, the `reason` in words, and how many `others` of
    the same recording have the same cause.
    """
    lowest = run.scores.group_by("token").aggregate([("cls", "min")])
    scores = run.scores.select([*Task._fields, "cls", "log_name"]).join(lowest, "token")
    scores = scores.filter(pc.equal(scores["cls"], scores["cls_min"]))
    keys = [*Task._fields]
    below = run.metrics.filter(pc.less(run.metrics["score"], 1.0))
    metrics = rows_by_task(below.join(scores.select(keys), keys, join_type="left semi"))
    rows = []
    for row in scores.to_pylist():
        task = task_of(row)
        cause = worst_violation(violations(metrics.get(task, [])))
        known = {"cause": cause.reason, "severity": severity(cause)} if cause else _NO_CAUSE
        reason = "" if cause is None else _in_words(cause)
        rows.append(row | known | {"log": row["log_name"], "reason": reason})
    return [
        {**task_of(row)._asdict(), "cls": row["cls"], "reason": row["reason"], "others": others}
        for row, others in worst_of(rows, count)
    ]


def _in_words(cause: Violation) -> str:
    """A violation with its time; one that does not multiply the score with its own, times 100."""
    score = "" if cause.is_multiplier else f" {100.0 * cause.row['score']:.2f}"
    time = "" if cause.time is None else f" {cause.time:.1f} s"
    return f"{cause.reason}{score}{time}"


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
        "scores": [
            {
                "set": group.data.label,
                "planner": row.labels[0],
                "noise": row.labels[1],
                "scenarios": row.num_scenarios,
                "seeds": row.num_seeds,
                "done": row.num_done,
                "expected": row.num_expected,
                "mean": row.means if row.is_complete else None,
                "std_over_seeds": row.deviations if row.is_complete else None,
                "partial_mean": None if row.is_complete else row.means,
            }
            for group in read_groups([run])
            for row in _score_rows(group, None)
        ],
        "failures": failures(run),
    }


def failures(run: Run) -> list[dict[str, Any]]:
    """Tasks that failed or are missing: key, status, error and hint."""
    names = [*Task._fields, "status", "error", "hint"]
    failed = run.tasks.filter(pc.not_equal(run.tasks["status"], "ok"))
    rows: list[dict[str, Any]] = failed.select(names).to_pylist()
    return rows
