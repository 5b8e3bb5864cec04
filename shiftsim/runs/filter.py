"""The automatic filter: which scenarios of a store are used.

It drives scenarios as recorded, and drops those that cannot be driven so. The results lie beside
the scenarios, in `filter/verdicts.parquet` of the store; the scenarios themselves stay as they are.
Runs over a whole store use the accepted ones.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.data.store.reading import open_store
from shiftsim.data.store.tables import Table, digest, write_blocks
from shiftsim.errors import ConfigError, DataError
from shiftsim.files import safe_join
from shiftsim.metrics import METRIC_VERSION, compute_metrics, thresholds_of
from shiftsim.runs.journal import Journal
from shiftsim.runs.rollouts import Task
from shiftsim.runs.tables import TaskResult
from shiftsim.runs.task import ScenarioReader, attempt
from shiftsim.runs.workers import map_unordered
from shiftsim.sim.loop import simulate
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import center_poses

RESULTS = "filter/verdicts.parquet"
ACCEPTED, DROPPED, FAILED = "accepted", "dropped", "failed"
COLLISION, AREA = "at-fault collision", "drivable area"
STANDING, OFF_ROUTE = "path too short", "progress along the route"

SCHEMA = pa.schema(
    [
        pa.field("token", pa.string(), nullable=False),
        pa.field("verdict", pa.string(), nullable=False),  # accepted, dropped or failed
        pa.field("reason", pa.string(), nullable=False),  # rules broken, or the error
        pa.field("no_at_fault_collisions", pa.float64()),  # score
        pa.field("drivable_area_compliance", pa.float64()),  # score
        pa.field("max_outside_m", pa.float64()),  # furthest corner outside the drivable area
        pa.field("path_m", pa.float64()),  # travelled from iteration 0 to the last one
        pa.field("progress_m", pa.float64()),  # of it along the route driven
        pa.field("partner_token", pa.string()),  # of the first at-fault collision
        pa.field("first_violation_s", pa.float64()),  # since iteration 0, of the first rule broken
    ]
)
_UNFINISHED = "filter/unfinished.sqlite"
_COLLISIONS, _DRIVABLE = "no_ego_at_fault_collisions", "drivable_area_compliance"
_PROGRESS = "expert_total_progress_along_route"


@dataclass(frozen=True, slots=True)
class FilterConfig:
    """What a scenario must satisfy."""

    thresholds: str = "deepplan"  # threshold profile of collisions and drivable area
    min_path_m: float = 5.0  # shortest path from iteration 0 to the end [m]
    min_progress_share: float = 0.5  # smallest share of that path that is progress along the route

    def __post_init__(self) -> None:
        thresholds_of(self.thresholds)
        if not (0.0 <= self.min_path_m < np.inf and 0.0 <= self.min_progress_share <= 1.0):
            raise ConfigError(
                f"filter: min_path_m {self.min_path_m!r} or min_progress_share "
                f"{self.min_progress_share!r} is out of range",
                hint="min_path_m from 0 on, min_progress_share within 0 and 1",
            )


@dataclass(frozen=True)
class FilterResults:
    """Which scenarios of a store may be used, and why others may not."""

    path: Path  # the file
    # one row per scenario, sorted by token; the columns of the file
    rows: tuple[Mapping[str, Any], ...]
    hash: str  # digest of the file
    conditions: Mapping[str, Any]  # everything that the verdicts depend on

    def __repr__(self) -> str:
        counts = self.counts()
        return f"<FilterResults: {counts[ACCEPTED]} of {len(self.rows)} scenarios accepted>"

    @property
    def config(self) -> Mapping[str, Any]:
        """What a scenario had to satisfy."""
        return self.conditions["config"]

    @property
    def accepted(self) -> tuple[str, ...]:
        """Tokens of the accepted scenarios, sorted."""
        return tuple(row["token"] for row in self.rows if row["verdict"] == ACCEPTED)

    @property
    def rejected(self) -> tuple[Mapping[str, Any], ...]:
        """Rows of the scenarios that were dropped or could not be driven."""
        return tuple(row for row in self.rows if row["verdict"] != ACCEPTED)

    def counts(self) -> dict[str, int]:
        """How many scenarios there are by verdict, and how many break each rule."""
        names = (ACCEPTED, DROPPED, FAILED, COLLISION, AREA, STANDING, OFF_ROUTE)
        out = dict.fromkeys(names, 0)
        for row in self.rows:
            out[row["verdict"]] += 1
            for reason in row["reason"].split(", ") if row["verdict"] == DROPPED else ():
                out[reason] += 1
        return out


def _read(store: Path) -> FilterResults:
    """The results that a store holds, or a DataError."""
    path = store / RESULTS
    table = Table(path, SCHEMA)
    if not isinstance(table.footer.get("config"), dict):
        raise DataError(f"{path}: the footer has no 'config'", hint=f"shiftsim filter {store}")
    return FilterResults(path, tuple(table.read().to_pylist()), digest(path), table.footer)


def read_filter_results(store: str | Path, store_hash: str) -> FilterResults | None:
    """The results for a store of a hash, or a DataError; None where it was not filtered."""
    path = Path(store)
    if not (path / RESULTS).is_file():
        return None
    found = _read(path)
    if found.conditions.get("store") != store_hash:
        what = f"{found.path}: the verdicts are of another content of the store"
        raise DataError(what, hint=f"shiftsim filter {path}, or --all to use every scenario")
    return found


def _judge(store: Path, config: FilterConfig) -> Callable[[str], dict[str, Any]]:
    """What finds the verdict on one scenario after the other, also where it cannot be driven."""
    scenarios = ScenarioReader(str(store))

    def row(token: str) -> dict[str, Any]:
        task = Task("log-playback", "none", 0, token)
        found = attempt(task, lambda: judge_scenario(scenarios.read(token), config))
        return _failed(token, found.error) if isinstance(found, TaskResult) else found

    return row


def judge_scenario(scenario: Scenario, config: FilterConfig) -> dict[str, Any]:
    """Drive a scenario as it was recorded; the row of the verdict whether it is fit for use."""
    # nuPlan rule 550: the recording itself, under thresholds of the filter's own
    log = simulate(scenario, None, controller="log-playback")
    result = compute_metrics(log, scenario.map, thresholds=config.thresholds)
    centers = center_poses(log.expert_ego[:, :3])
    path = float(np.hypot(*np.diff(centers[:, :2], axis=0).T).sum())
    progress = next(s.value for s in result.statistics if s.name == _PROGRESS)
    rows = {row.metric: row for row in result.rows}
    rules = {_COLLISIONS: COLLISION, _DRIVABLE: AREA}
    failed = [name for name in rules if rows[name].score != 1.0]
    broken = [rules[name] for name in failed]
    violated = [first for name in failed if (first := rows[name].violation) is not None]
    start_us = int(log.time_us[0])
    # nuPlan rule 551: too little progress is a short path, or a path beside the route
    if path < config.min_path_m:
        broken.append(STANDING)
    elif progress < config.min_progress_share * path:
        broken.append(OFF_ROUTE)
    return {
        "token": scenario.token,
        "verdict": DROPPED if broken else ACCEPTED,
        "reason": ", ".join(broken),
        "no_at_fault_collisions": rows[_COLLISIONS].score,
        "drivable_area_compliance": rows[_DRIVABLE].score,
        "max_outside_m": rows[_DRIVABLE].value,
        "path_m": path,
        "progress_m": progress,
        "partner_token": next((v.partner for v in violated if v.partner is not None), None),
        "first_violation_s": (violated[0].time_us - start_us) * 1e-6 if violated else None,
    }


def filter_store(
    store: str | Path,
    config: FilterConfig | None = None,
    *,
    workers: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> FilterResults:
    """Find the verdicts on all scenarios, but those found before, and write them into the store."""
    path, config = Path(store), config or FilterConfig()
    opened = open_store(path)
    conditions = _conditions(config, opened.hash, opened.reviews.route_hash)
    unfinished = safe_join(path, _UNFINISHED)
    unfinished.parent.mkdir(exist_ok=True)
    journal = Journal(unfinished, keep=True)
    try:
        rows: list[Mapping[str, Any]] = [
            row for _, key, row, _ in journal.items() if key.startswith(conditions["hash"])
        ]
        with suppress(DataError):  # it is written anew
            earlier = _read(path)
            if earlier.conditions.get("hash") == conditions["hash"]:
                rows = [*earlier.rows, *rows]
        done = {row["token"]: row for row in rows if row["verdict"] != FAILED}
        waiting = [token for token in opened.tokens if token not in done]
        on_progress(len(done), len(opened))
        make = partial(_judge, path.resolve(), config)
        with closing(map_unordered(make, waiting, workers=workers, alone=1)) as outcomes:
            for outcome in outcomes:
                row = outcome.result or _failed(outcome.task, outcome.death)
                journal.put(f"{conditions['hash']} {outcome.task}", row)
                done[outcome.task] = row
                on_progress(len(done), len(opened))
        table = pa.Table.from_pylist([done[token] for token in opened.tokens], schema=SCHEMA)
        write_blocks(path / RESULTS, [table], conditions)
        journal.remove()
    finally:
        journal.close()
    return _read(path)


def _conditions(config: FilterConfig, store_hash: str, route_hash: str) -> dict[str, Any]:
    """Everything that verdicts depend on, and a digest of it."""
    out = {
        "config": asdict(config),
        "thresholds": asdict(thresholds_of(config.thresholds)),
        "metric_version": METRIC_VERSION,
        "store": store_hash,
    }
    if route_hash:  # corrected in the review
        out["routes"] = route_hash
    text = json.dumps(out, sort_keys=True)
    return out | {"hash": hashlib.blake2b(text.encode(), digest_size=16).hexdigest()}


def _failed(token: str, reason: str) -> dict[str, Any]:
    row = {"token": token, "verdict": FAILED, "reason": reason}
    return dict.fromkeys(SCHEMA.names) | row
