"""Why a rollout has its score: every metric, its value, threshold and first violation."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pyarrow.compute as pc

from shiftsim.errors import ConfigError, beginning
from shiftsim.metrics import MULTIPLIERS, SHORT_NAMES, WEIGHTS
from shiftsim.metrics.interplan import LANES, SORTS, role_of
from shiftsim.metrics.score import closed_loop_score
from shiftsim.report.words import COLLISIONS, REASONS, UNITS, in_words, rows_by_task, task_of
from shiftsim.runs.edited import edit_words
from shiftsim.runs.results import Run

_HAS = ("planners", "noise", "seeds")


def select_tasks(
    run: Run,
    token: str,
    *,
    planner: str | None = None,
    noise: str | None = None,
    seed: int | None = None,
) -> list[dict[str, Any]]:
    """Rows of `tasks.parquet` of a scenario, or its beginning, with `cls`, `why`, `metrics`."""
    tokens = set(run.tasks["token"].to_pylist())
    full = beginning(f"run {run.path.name!r}", "scenario", token, tokens)
    wanted = {"planner": planner, "noise": noise, "seed": seed}
    given = {name: value for name, value in wanted.items() if value is not None}
    of_token = run.tasks.filter(pc.equal(run.tasks["token"], full)).to_pylist()
    rows = [row for row in of_token if given.items() <= row.items()]
    if not rows:
        config = run.manifest["config"]
        words = (f"{name} {value}" for name, value in {**given, "scenario": full}.items())
        raise ConfigError(
            f"run {run.path.name!r} has no task with {', '.join(words)}",
            hint="; ".join(f"{n}: {', '.join(map(str, config[n]))}" for n in _HAS),
        )
    scores, metrics = (
        rows_by_task(table.filter(pc.equal(table["token"], full)))
        for table in (run.scores, run.metrics)
    )
    out, told = [], {"remarks": run.remarks, "edits": edit_words(run.manifest, full)}
    for row in rows:
        task = task_of(row)
        cls = scores[task][0]["cls"] if task in scores else None
        listed = with_roles(metrics.get(task, []))
        out.append(row | {"cls": cls, "why": why(cls, listed), **told, "metrics": listed})
    return out


def losses(rows: Iterable[Mapping[str, Any]]) -> list[tuple[dict[str, Any], float]]:
    """What every metric below 1 takes from a score of 100 [points], in order of time.

    All metrics begin at 1 and take their scores in turn: at their first violation, multipliers
    first at equal times, and those without a moment last. The loss is the fall of the score at that
    turn: 100 less all losses is the score, and nothing is left to lose once it is 0.
    """
    scored = [row for row in with_roles(rows) if row["role"] and row["score"] is not None]
    weights = {row["metric"]: row["weight"] for row in scored}
    scores = dict.fromkeys(weights, 1.0)
    turns = sorted(
        (row for row in scored if row["score"] < 1.0),
        key=lambda row: (row["first_violation_s"] is None, row["first_violation_s"] or 0.0),
    )
    out, left = [], 100.0
    for row in turns:
        scores[row["metric"]] = row["score"]
        after = 100.0 * closed_loop_score(scores, weights.__getitem__)
        out.append((row, left - after))
        left = after
    return out


def with_roles(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The metrics of a task, nuPlan's or interPlan's, with role and weight, by role."""
    listed = [dict(row) for row in rows]
    names = {row["metric"] for row in listed}
    sorts = next((name.removeprefix(SORTS) for name in names if name.startswith(SORTS)), "")
    for row in listed:
        name = row["metric"]
        role = "multiplier" if name in MULTIPLIERS else "weighted" if name in WEIGHTS else ""
        weight = WEIGHTS.get(name)
        if LANES in names and row["score"] is not None:
            role, weight = role_of(name, sorts)
        row |= {"role": role, "weight": weight}
    roles = ("multiplier", "weighted", "")
    order = {name: place for place, name in enumerate(SHORT_NAMES)}
    return sorted(
        listed, key=lambda r: (roles.index(r["role"]), order.get(r["metric"], len(order)))
    )


def explain_tasks(
    runs: Sequence[Run], token: str, **wanted: Any
) -> dict[str, list[dict[str, Any]]]:
    """The tasks of one scenario by the name of their run, or a ConfigError: `select_tasks`."""
    found: dict[str, list[dict[str, Any]]] = {}
    for run in runs:
        try:
            found[run.path.name] = select_tasks(run, token, **wanted)
        except ConfigError as error:
            refused = error
    if not found:
        raise refused
    return found


def why(cls: float | None, metrics: list[dict[str, Any]]) -> str:
    """A score x 100 in one line: why it is 0 or undefined, or its parts; empty if it failed."""
    if cls is None:
        lost = {*MULTIPLIERS, *WEIGHTS} - {row["metric"] for row in metrics}
        names = [in_words(name) for name in SHORT_NAMES if name in lost]
        return f"no score: undefined without the others: {', '.join(names)}" if metrics else ""
    scored = [row for row in metrics if row["score"] is not None]
    factors = [row for row in scored if row["role"] == "multiplier"]
    parts = [row for row in scored if row["role"] == "weighted"]
    causes = []
    for row in (row for row in factors if row["score"] == 0.0):
        is_dated = row["first_violation_iteration"] is not None
        time = f" at {row['first_violation_s']:.1f} s{_partner(row)}" if is_dated else ""
        causes.append(f"{in_words(row['metric'], REASONS)}{time}")
    if causes:
        return f"score 0 because of {' and '.join(causes)}"
    if cls == 0.0:
        return "score 0 because every weighted metric is 0"
    product = " × ".join(f"{row['score']:g}" for row in factors)
    terms = " + ".join(f"{row['weight']:g}·{100.0 * row['score']:.4g}" for row in parts)
    total = sum(row["weight"] for row in parts)
    return f"{100.0 * cls:.2f} = {product} × ({terms}) / {total:g}"


def _partner(row: dict[str, Any]) -> str:
    return f", track {row['partner_token']}" if row["partner_token"] else ""


def explain_lines(task: dict[str, Any]) -> list[str]:
    """One task in words; `task` is a row of `select_tasks`."""
    seed = "" if task["noise"] == "none" else f"  seed {task['seed']}"
    head = f"{task['token']}  {task['scenario_type']}  {task['planner']} {task['noise']}{seed}"
    if task["status"] != "ok":
        hint = [f"hint: {task['hint']}"] if task["hint"] else []
        lines = [*task["edits"], task["error"], *hint, *(task["traceback"] or "").splitlines()]
        return [f"{head}  {task['status']}", *(f"  {line}" for line in lines)]
    rule = "the score is the product of the × rows and the weighted mean of the + rows, all x 100"
    lines = [*task["edits"], task["why"], rule, *map(_metric_line, task["metrics"])]
    total = "undefined" if task["cls"] is None else f"{100.0 * task['cls']:.2f}"
    return [f"{head}  CLS {total}", *(f"  {line}" for line in (*task["remarks"], *lines))]


def _metric_line(row: dict[str, Any]) -> str:
    metric, unit = row["metric"], UNITS.get(row["unit"], row["unit"])
    unit = f" {unit}" if unit else ""
    role = {"multiplier": "×", "weighted": "+"}.get(row["role"], " ")
    weight = "" if row["weight"] is None else f"weight {row['weight']:g}"
    score = "–" if row["score"] is None else f"{100.0 * row['score']:.2f}"
    parts = [f"{role} {in_words(metric):29} {score:>6}", f"{weight:8}"]
    known = (name for name in ("value", "threshold") if row[name] is not None)
    parts += [f"{name} {row[name]:.4g}{unit}" for name in known]
    if row["first_violation_iteration"] is not None:
        value = f"{row['first_violation_value']:.4g}{unit}"
        if metric == COLLISIONS:  # its value counts collisions, that of a violation is a speed
            value = f"delta-v {value} m/s"
        parts.append(f"first violated at {row['first_violation_s']:.1f} s: {value}{_partner(row)}")
    return "  ".join(parts).rstrip()
