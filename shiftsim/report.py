"""Score tables: what a run, or several, say about each planner and noise, as text.

A score is the plain mean over scenarios, as nuPlan's is: scenario types are not weighted, and a
metric without a score counts as 0 (nuplan-metrics.md §12). With several seeds it is the mean of
the seeds' means. Scores are printed times 100. Where tasks failed or are missing no score is
printed, or one that says so.
"""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from shiftsim.config import one_of
from shiftsim.metrics import MULTIPLIERS, SHORT_NAMES
from shiftsim.results import Run

COLUMNS = {"cls": "CLS"} | {n: short for n, short in SHORT_NAMES.items() if n != "score"}
GROUPINGS = ("scenario_type", "seed")
FORMATS = ("text", "md", "csv", "latex")
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
        by: Column of `tasks.parquet` that splits the rows further, such as `scenario_type`.
    """
    scores = {tuple(row[n] for n in _KEY): row for row in run.scores.to_pylist()}
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for task in run.tasks.to_pylist():
        labels = (task["planner"], task["noise"], *([str(task[by])] if by else []))
        groups.setdefault(labels, []).append(task)
    config = run.manifest["config"]

    def rank(labels: tuple[str, ...]) -> tuple[Any, ...]:
        return (_place(config["planners"], labels[0]), _place(config["noise"], labels[1]), labels)

    return [_score_row(labels, groups[labels], scores) for labels in sorted(groups, key=rank)]


_KEY = ("planner", "noise", "seed", "token")


def _place(names: Sequence[str], name: str) -> int:
    return names.index(name) if name in names else len(names)


def _score_row(
    labels: tuple[str, ...], tasks: list[dict[str, Any]], scores: dict[tuple[Any, ...], Any]
) -> ScoreRow:
    by_seed: dict[int, list[dict[str, Any]]] = {}
    for task in tasks:
        row = scores.get(tuple(task[name] for name in _KEY))
        by_seed.setdefault(task["seed"], []).extend([] if row is None else [row])
    filled = [rows for rows in by_seed.values() if rows]
    table = np.array([[_mean(rows, name) for name in COLUMNS] for rows in filled])
    table = table.reshape(len(filled), len(COLUMNS))
    spread = table.std(axis=0, ddof=1) if len(filled) > 1 else np.zeros(0)
    return ScoreRow(
        labels,
        num_done=sum(map(len, filled)),
        num_expected=len(tasks),
        num_scenarios=len({task["token"] for task in tasks}),
        num_seeds=len(by_seed),
        means=dict(zip(COLUMNS, table.mean(axis=0).tolist(), strict=True)) if filled else {},
        deviations=dict(zip(COLUMNS, spread.tolist(), strict=True)) if spread.size else {},
    )


def _mean(rows: Iterable[dict[str, Any]], name: str) -> float:
    return float(np.mean([0.0 if row[name] is None else row[name] for row in rows]))


def score_table(
    runs: Sequence[Run],
    *,
    style: str = "text",
    by: str | None = None,
    allow_partial: bool = False,
) -> str:
    """The scores of runs as a table.

    Args:
        runs: The runs.
        style: One of `FORMATS`.
        by: Splits the rows further, such as `scenario_type`.
        allow_partial: Print the mean over the finished tasks of an incomplete row, labelled so.

    Returns:
        The table; threshold profile, metric version and scenario count stand with it.
    """
    one_of("format", style, FORMATS)
    if by is not None:
        one_of("column", by, GROUPINGS)
    lines: list[list[str]] = []
    captions = []
    for run in runs:
        caption = describe_run(run)
        if len(runs) > 1:
            caption = f"{run.path.name}: {caption}"
        captions.append(caption)
        for row in score_rows(run, by=by):
            lines += _cells(row, caption, style, allow_partial)
    header = ["planner", "noise", *([by] if by else []), *COLUMNS.values()]
    if style == "csv":
        header = [*header, "statistic", "done", "expected", "label"]
    widths = len(header)
    padded = [line + [""] * (widths - len(line)) for line in lines]
    text = _RENDERERS[style](header, padded)
    if style == "csv":
        return text
    return f"{text}\n{_CAPTION[style]}{(chr(10) + _CAPTION[style]).join(captions)}"


_CAPTION = {"text": " ", "md": "\n", "latex": "% "}


def describe_run(run: Run) -> str:
    """What stands beside every printed score."""
    manifest = run.manifest
    determining = manifest["determining"]
    num_scenarios = len(set(run.tasks["token"].to_pylist()))
    return (
        f"split {manifest['split']} ({num_scenarios} scenarios) · "
        f"traffic {determining['traffic']} · controller {determining['controller']} · "
        f"thresholds {determining['thresholds']['name']} · "
        f"metrics v{determining['metric_version']} · scores x 100"
    )


def _cells(row: ScoreRow, caption: str, style: str, allow_partial: bool) -> list[list[str]]:
    """One or two lines: the means, and their deviation over the seeds."""
    labels = list(row.labels)
    count = f"({row.num_done}/{row.num_expected} done)"
    tail = ["mean", str(row.num_done), str(row.num_expected)]
    if not row.is_complete and not (allow_partial and row.means):
        cells = ["–"] * len(COLUMNS)
        if style == "csv":
            return [[*labels, *[""] * len(COLUMNS), *tail, f"withheld {count}; {caption}"]]
        return [[*labels, f"– {count}", *cells[1:]]]
    label = "" if row.is_complete else f"partial ({row.num_done}/{row.num_expected})"
    if style == "csv":
        note = "; ".join(filter(None, [label, caption]))
        out = [[*labels, *(repr(100.0 * v) for v in row.means.values()), *tail, note]]
        if row.deviations:
            spread = (repr(100.0 * v) for v in row.deviations.values())
            out.append([*labels, *spread, f"std over {row.num_seeds} seeds", *tail[1:], note])
        return out
    means = [f"{100.0 * value:.2f}" for value in row.means.values()]
    if label:
        means[0] = f"{means[0]} {label}"
    out = [[*labels, *means]]
    if row.deviations:
        spread = (f"{100.0 * value:.2f}" for value in row.deviations.values())
        out.append([f"± over {row.num_seeds} seeds", *[""] * (len(labels) - 1), *spread])
    return out


def worst_rollouts(run: Run, count: int = 10) -> list[dict[str, Any]]:
    """The rollouts with the lowest scores: key, `cls`, and the `reason` in words."""
    rows = sorted(run.scores.to_pylist(), key=lambda row: (row["cls"], *(row[n] for n in _KEY)))
    details: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}
    for row in run.metrics.to_pylist():
        details.setdefault(tuple(row[n] for n in _KEY), {})[row["metric"]] = row
    return [
        {
            **{name: row[name] for name in _KEY},
            "cls": row["cls"],
            "reason": _reason(row, details[tuple(row[n] for n in _KEY)]),
        }
        for row in rows[:count]
    ]


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
    names = (*_KEY, "status", "error", "hint")
    rows = run.tasks.select(list(names)).to_pylist()
    return [row for row in rows if row["status"] != "ok"]


def _text(header: list[str], lines: list[list[str]]) -> str:
    numbers = len(COLUMNS)
    widths = [max(len(line[i]) for line in [header, *lines]) for i in range(len(header))]
    labels = len(header) - numbers

    def render(line: list[str]) -> str:
        cells = [
            cell.ljust(width) if i < labels else cell.rjust(max(width, 6))
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        return " " + "  ".join(cells).rstrip()

    return "\n".join(map(render, [header, *lines]))


def _markdown(header: list[str], lines: list[list[str]]) -> str:
    rule = ["---"] * (len(header) - len(COLUMNS)) + ["---:"] * len(COLUMNS)
    return "\n".join(f"| {' | '.join(line)} |" for line in [header, rule, *lines])


def _csv(header: list[str], lines: list[list[str]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([header, *lines])
    return out.getvalue().rstrip("\n")


_LATEX_ESCAPES = str.maketrans({c: f"\\{c}" for c in "&%$#_{}"} | {"±": "$\\pm$", "–": "--"})


def _latex(header: list[str], lines: list[list[str]]) -> str:
    columns = "l" * (len(header) - len(COLUMNS)) + "r" * len(COLUMNS)
    rows = [" & ".join(cell.translate(_LATEX_ESCAPES) for cell in line) + r" \\" for line in lines]
    head = " & ".join(cell.translate(_LATEX_ESCAPES) for cell in header) + r" \\"
    body = "\n".join(rows)
    begin, end, rule = f"\\begin{{tabular}}{{{columns}}}", r"\end{tabular}", r"\hline"
    return "\n".join([begin, rule, head, rule, body, rule, end])


_RENDERERS: dict[str, Callable[[list[str], list[list[str]]], str]] = {
    "text": _text,
    "md": _markdown,
    "csv": _csv,
    "latex": _latex,
}
