"""The score table of a run: every planner and noise, every metric.

A score is the plain mean over scenarios, as nuPlan's is: scenario types are not weighted, and a
metric without a score counts as 0 (nuplan-metrics.md §12). With several seeds it is the mean of
the seeds' means. Scores are printed times 100. Where tasks failed or are missing no score is
printed, or one that says so.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.errors import one_of
from shiftsim.metrics import MULTIPLIERS
from shiftsim.report.groups import COLUMNS, Group, KnownSet, made_up_note, read_groups
from shiftsim.report.tables import Cell, Number, Table
from shiftsim.report.writers import FORMATS, render
from shiftsim.runs.results import Run

GROUPINGS = ("scenario_type", "city", "seed")
_KEY = ("planner", "noise", "seed", "token")
_REASONS = {
    "no_ego_at_fault_collisions": "at-fault collision",
    "drivable_area_compliance": "drivable area",
    "driving_direction_compliance": "driving direction",
    "ego_is_making_progress": "no progress",
    "ego_progress_along_expert_route": "progress",
    "time_to_collision_within_bound": "time to collision",
    "speed_limit_compliance": "speed limit",
    "ego_is_comfortable": "comfort",
}


@dataclass(frozen=True, slots=True)
class ScoreRow:
    """One line of a score table.

    Attributes:
        labels: Planner, noise, and what else tells the lines apart.
        num_done: Finished tasks.
        num_expected: Tasks of a complete run.
        num_scenarios: Scenarios of a complete run.
        num_seeds: Seeds.
        means: Mean of each column of `COLUMNS` in [0, 1]; empty when nothing finished.
        deviations: Standard deviation over the seeds' means; empty for a single seed.
    """

    labels: tuple[str, ...]
    num_done: int
    num_expected: int
    num_scenarios: int
    num_seeds: int
    means: dict[str, float]
    deviations: dict[str, float]

    @property
    def is_complete(self) -> bool:
        """Whether the means are those of the whole benchmark."""
        return self.num_done == self.num_expected


def score_rows(run: Run, *, by: str | None = None) -> list[ScoreRow]:
    """One row per planner and noise, in the order of the settings.

    Args:
        run: The run.
        by: One of `GROUPINGS` that splits the rows further.
    """
    return [row for group in read_groups([run]) for row in _score_rows(group, by)]


def _score_rows(group: Group, by: str | None) -> list[ScoreRow]:
    labels = (group.planner, group.noise)
    if by == "seed":
        return [
            _score_row((*labels, str(seed)), group.values[i : i + 1])
            for i, seed in enumerate(group.seeds)
        ]
    if by is None:
        return [_score_row(labels, group.values)]
    kinds = np.array(group.data.types if by == "scenario_type" else group.data.cities)
    return [
        _score_row((*labels, name or "unknown"), group.values[:, kinds == name])
        for name in sorted(set(kinds.tolist()))
    ]


def _score_row(labels: tuple[str, ...], values: FloatArray) -> ScoreRow:
    finished = np.isfinite(values[:, :, 0])
    means = [
        seed[done].mean(axis=0) for seed, done in zip(values, finished, strict=True) if any(done)
    ]
    table = np.array(means).reshape(len(means), len(COLUMNS))
    spread = table.std(axis=0, ddof=1) if len(table) > 1 else np.zeros(0)
    return ScoreRow(
        labels,
        num_done=int(finished.sum()),
        num_expected=finished.size,
        num_scenarios=values.shape[1],
        num_seeds=len(values),
        means=dict(zip(COLUMNS, table.mean(axis=0).tolist(), strict=True)) if means else {},
        deviations=dict(zip(COLUMNS, spread.tolist(), strict=True)) if spread.size else {},
    )


def score_table(
    runs: Sequence[Run],
    *,
    style: str = "text",
    by: str | None = None,
    allow_partial: bool = False,
    width: int = 0,
) -> str:
    """The scores of runs as a table.

    Args:
        runs: The runs.
        style: One of `FORMATS`.
        by: One of `GROUPINGS` that splits the rows further.
        allow_partial: Print the mean over the finished tasks of an incomplete row, labelled so.
        width: Longest line of text; 0 for any.

    Returns:
        The table; threshold profile, metric version and scenario count stand with it.
    """
    one_of("format", style, FORMATS)
    table = scores(read_groups(runs), by=by, allow_partial=allow_partial)
    return render(replace(table, title=""), style, width=width)


def scores(groups: Sequence[Group], *, by: str | None = None, allow_partial: bool = False) -> Table:
    """All columns of all groups: means, and below them their deviations over the seeds."""
    heading = _heading(groups, by)
    rows: list[tuple[Cell, ...]] = []
    for group in groups:
        for row in _score_rows(group, by):
            first = [*([group.data.label, group.traffic] if _several(groups) else []), *row.labels]
            rows += _cells(first, row, allow_partial)
    return Table(
        "scores",
        "All planners and noises, scores x 100",
        (*heading, *COLUMNS.values()),
        tuple(rows),
        len(heading),
        tuple(dict.fromkeys(describe_run(group.run, group) for group in groups)),
        _in_full(groups, by, allow_partial),
    )


def _in_full(groups: Sequence[Group], by: str | None, allow_partial: bool) -> Table:
    """The same for machines: unrounded, and every row says by itself what it is."""
    heading = _heading(groups, by)
    tail = ("statistic", "done", "expected", "label")
    rows: list[tuple[Cell, ...]] = []
    for group in groups:
        caption = describe_run(group.run, group)
        for row in _score_rows(group, by):
            first = [*([group.data.label, group.traffic] if _several(groups) else []), *row.labels]
            rows += _cells_in_full(first, row, caption, allow_partial)
    return Table("scores", "", (*heading, *COLUMNS.values(), *tail), tuple(rows), len(heading))


def _several(groups: Sequence[Group]) -> bool:
    return len({(group.data.key, group.traffic) for group in groups}) > 1


def _heading(groups: Sequence[Group], by: str | None) -> list[str]:
    if by is not None:
        one_of("column", by, GROUPINGS)
    where = ["set", "traffic"] if _several(groups) else []
    return [*where, "planner", "noise", *([by] if by else [])]


def describe_run(run: Run, group: Group | None = None, known: Sequence[KnownSet] = ()) -> str:
    """What stands beside every printed score."""
    data = (group or read_groups([run], known)[0]).data
    determining = run.manifest["determining"]
    split = run.manifest["split"] if data.label == run.manifest["split"] else data.label
    made_up = made_up_note([run])
    return (
        f"split {split} ({len(data.tokens)} scenarios) · "
        f"traffic {determining['traffic']} · controller {data.controller} · "
        f"thresholds {data.thresholds} · metrics v{data.metric_version} · scores x 100"
        f"{' · ' * bool(made_up)}{made_up}"
    )


def _cells(labels: list[str], row: ScoreRow, allow_partial: bool) -> list[tuple[Cell, ...]]:
    """One or two lines: the means, and their deviation over the seeds."""
    count = f"({row.num_done}/{row.num_expected} done)"
    if not row.is_complete and not (allow_partial and row.means):
        return [(*labels, f"– {count}", *["–"] * (len(COLUMNS) - 1))]
    means: list[Cell] = [Number(100.0 * value) for value in row.means.values()]
    if not row.is_complete:
        means[0] = f"{100.0 * row.means['cls']:.2f} partial ({row.num_done}/{row.num_expected})"
    out: list[tuple[Cell, ...]] = [(*labels, *means)]
    if row.deviations:
        spread = (Number(100.0 * value) for value in row.deviations.values())
        out.append((*[""] * (len(labels) - 1), f"± {row.num_seeds} seeds", *spread))
    return out


def _cells_in_full(
    labels: list[str], row: ScoreRow, caption: str, allow_partial: bool
) -> list[tuple[Cell, ...]]:
    tail = (str(row.num_done), str(row.num_expected))
    if not row.is_complete and not (allow_partial and row.means):
        note = f"withheld ({row.num_done}/{row.num_expected} done); {caption}"
        return [(*labels, *[None] * len(COLUMNS), "mean", *tail, note)]
    label = "" if row.is_complete else f"partial ({row.num_done}/{row.num_expected}); "
    means = (Number(100.0 * value) for value in row.means.values())
    out: list[tuple[Cell, ...]] = [(*labels, *means, "mean", *tail, f"{label}{caption}")]
    if row.deviations:
        spread = (Number(100.0 * value) for value in row.deviations.values())
        statistic = f"std over {row.num_seeds} seeds"
        out.append((*labels, *spread, statistic, *tail, f"{label}{caption}"))
    return out


def worst_rollouts(run: Run, count: int = 10) -> list[dict[str, Any]]:
    """The rollouts with the lowest scores: key, `cls`, and the `reason` in words."""
    keys = [("cls", "ascending"), *((name, "ascending") for name in _KEY)]
    rows = run.scores.sort_by(keys).slice(0, count).to_pylist()
    details = _details(run, {row["token"] for row in rows})
    return [
        {
            **{name: row[name] for name in _KEY},
            "cls": row["cls"],
            "reason": _reason(row, details[tuple(row[n] for n in _KEY)]),
        }
        for row in rows
    ]


def _details(run: Run, tokens: Iterable[str]) -> dict[tuple[Any, ...], dict[str, dict[str, Any]]]:
    """Rows of `metrics.parquet` by task and metric, for some scenarios."""
    import pyarrow as pa
    import pyarrow.compute as pc

    wanted = pc.is_in(run.metrics["token"], value_set=pa.array(sorted(tokens), pa.string()))
    out: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}
    for row in run.metrics.filter(wanted).to_pylist():
        out.setdefault(tuple(row[n] for n in _KEY), {})[row["metric"]] = row
    return out


def _reason(row: dict[str, Any], details: dict[str, dict[str, Any]]) -> str:
    """What cost most: the first multiplier below 1, else the lowest of the other metrics."""
    below = [name for name in MULTIPLIERS if (row[name] if row[name] is not None else 1.0) < 1.0]
    others = [name for name in _REASONS if name not in MULTIPLIERS and row[name] is not None]
    name = below[0] if below else min(others, key=lambda other: row[other], default="")
    if not name or row[name] == 1.0:
        return ""
    detail = details[name]
    text = _REASONS[name] if below else f"{_REASONS[name]} {row[name]:.2f}"
    return f"{text}{_when(detail)}"


def _when(detail: dict[str, Any]) -> str:
    seconds = detail["first_violation_s"]
    return "" if seconds is None else f" {seconds:.1f} s"


def summary(run: Run) -> dict[str, Any]:
    """A run in JSON values: what it is, its counts, and its scores; null where withheld."""
    manifest = run.manifest
    return {
        "run": str(run.path),
        "state": manifest["state"],
        "split": manifest["split"],
        "traffic": manifest["determining"]["traffic"],
        "thresholds": manifest["determining"]["thresholds"]["name"],
        "metric_version": manifest["determining"]["metric_version"],
        "counts": manifest["counts"],
        "scores": [_summary_row(row) for row in score_rows(run)],
        "failures": failures(run),
    }


def _summary_row(row: ScoreRow) -> dict[str, Any]:
    return {
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


def failures(run: Run) -> list[dict[str, Any]]:
    """Tasks that failed or are missing: key, status, error and hint."""
    import pyarrow.compute as pc

    names = (*_KEY, "status", "error", "hint")
    rows: list[dict[str, Any]] = (
        run.tasks.filter(pc.not_equal(run.tasks["status"], "ok")).select(list(names)).to_pylist()
    )
    return rows
