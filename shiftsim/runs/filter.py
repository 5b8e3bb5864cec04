"""Which scenarios of a store are used: the automatic filter, and splits made of what passes.

The filter drives scenarios as recorded, and drops those that cannot be driven so.

The verdicts lie beside the scenarios, in `filter/verdicts.parquet` of the store; the scenarios
themselves stay as they are. Runs over a whole store use the accepted ones.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.data.store.reading import open_store
from shiftsim.data.store.tables import Table, write_blocks
from shiftsim.errors import ConfigError, DataError, one_of
from shiftsim.files import safe_join
from shiftsim.metrics import METRIC_VERSION, MetricResult, compute_metrics, thresholds_of
from shiftsim.runs import verdicts
from shiftsim.runs.config import default_workers
from shiftsim.runs.journal import Journal
from shiftsim.runs.results import TaskResult
from shiftsim.runs.rollouts import Task
from shiftsim.runs.scenarios import Split
from shiftsim.runs.task import Scenarios, attempt
from shiftsim.runs.verdicts import (
    ACCEPTED,
    AREA,
    COLLISION,
    DROPPED,
    FAILED,
    OFF_ROUTE,
    STANDING,
    VERDICTS,
    Verdicts,
)
from shiftsim.runs.workers import map_unordered
from shiftsim.sim.loop import simulate
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import center_poses

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


class Playback:
    """Finds the verdict on one scenario after the other."""

    def __init__(self, store: Path, config: FilterConfig) -> None:
        self.config = config
        self._scenarios = Scenarios(str(store))

    def __call__(self, token: str) -> dict[str, Any]:
        """The row of the verdict, also where the scenario cannot be driven."""
        found = attempt(Task("log-playback", "none", 0, token), partial(self._verdict, token))
        return _failed(token, found.error) if isinstance(found, TaskResult) else found

    def _verdict(self, token: str) -> dict[str, Any]:
        return judge_scenario(self._scenarios.read(token), self.config)


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
    broken = [rule for name, rule in rules.items() if rows[name].score != 1.0]
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
        **_first_violation(result, int(log.time_us[0])),
    }


def _first_violation(result: MetricResult, start_us: int) -> dict[str, Any]:
    by_metric = {row.metric: row.violation for row in result.rows if row.score != 1.0}
    found = [v for name in (_COLLISIONS, _DRIVABLE) if (v := by_metric.get(name)) is not None]
    return {
        "partner_token": next((v.partner for v in found if v.partner is not None), None),
        "first_violation_s": (found[0].time_us - start_us) * 1e-6 if found else None,
    }


def filter_store(
    store: str | Path,
    config: FilterConfig | None = None,
    *,
    workers: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Verdicts:
    """Find the verdict on every scenario of a store, and write them into it.

    A filter that was interrupted goes on where it stopped. Verdicts that were found with the same
    settings on the same scenarios are kept. The file has the same bytes for any number of workers,
    of which 0 chooses from the cores. `on_progress` is told scenarios done and in all.

    Raises:
        DataError: There is no store, or it is damaged.
    """
    path, config = Path(store), config or FilterConfig()
    opened = open_store(path)
    conditions = _conditions(config, opened.hash, opened.reviews.route_hash)
    number = max(1, min(workers or default_workers(), len(opened)))
    unfinished = safe_join(path, _UNFINISHED)
    unfinished.parent.mkdir(exist_ok=True)
    journal = Journal(unfinished, keep=True)
    try:
        kept = [row for _, key, row, _ in journal.items() if key.startswith(conditions["hash"])]
        rows = (*_finished(path, conditions), *kept)
        done = {row["token"]: row for row in rows if row["verdict"] != FAILED}
        waiting = [token for token in opened.tokens if token not in done]
        on_progress(len(done), len(opened))
        make = partial(Playback, path.resolve(), config)
        with closing(map_unordered(make, waiting, workers=number, alone=1)) as outcomes:
            for outcome in outcomes:
                row = outcome.result or _failed(outcome.task, outcome.death)
                journal.put(f"{conditions['hash']} {outcome.task}", row)
                done[outcome.task] = row
                on_progress(len(done), len(opened))
        found = [dict(done[token]) for token in opened.tokens]
        table = pa.Table.from_pylist(found, schema=verdicts.SCHEMA)
        write_blocks(path / VERDICTS, [table], conditions)
        journal.remove()
    finally:
        journal.close()
    return verdicts.read(path)


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
    return dict.fromkeys(verdicts.SCHEMA.names) | row


def _finished(store: Path, conditions: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
    if not (store / VERDICTS).is_file():
        return ()
    try:
        found = verdicts.read(store)
    except DataError:
        return ()  # it is written anew
    same = Table(found.path, verdicts.SCHEMA).footer.get("hash") == conditions["hash"]
    return found.rows if same else ()


def choose_scenarios(
    rows: Iterable[Mapping[str, str]],
    usable: Collection[str],
    *,
    wanted: Mapping[str, Collection[str]],
    per_type: int | None = None,
    limit: int | None = None,
) -> tuple[str, ...]:
    """Tokens of some scenarios of a store, sorted: the first ones up to the limits.

    The rows hold `token`, `type` and `city` of every scenario, `usable` the tokens to choose from,
    and `wanted` values by column, none for any.

    Raises:
        ConfigError: No scenario has one of the values wanted.
    """
    table = sorted(rows, key=itemgetter("token"))
    for column, values in wanted.items():
        known = sorted({row[column] for row in table})
        for value in values:
            one_of(column, value, known)
    counts: Counter[str] = Counter()
    chosen = []
    for row in table:
        fits = all(not values or row[column] in values for column, values in wanted.items())
        if not fits or row["token"] not in usable:
            continue
        counts[row["type"]] += 1
        if per_type is None or counts[row["type"]] <= per_type:
            chosen.append(row["token"])
    return tuple(chosen[:limit])


def write_split(path: Path, tokens: tuple[str, ...]) -> Split:
    """Write a split that `read_split` reads: TOML with count and hash, or text for `.txt`.

    It is named after the file.

    Raises:
        ConfigError: There are no tokens, the file ends otherwise, or it cannot be written.
    """
    split = Split(path.stem, tokens)
    if not tokens:
        raise ConfigError(f"split {split.name!r} would be empty", hint="ask for less")
    if path.suffix == ".txt":
        lines = list(tokens)
    elif path.suffix == ".toml":
        head = f'name = {json.dumps(split.name)}\ncount = {len(tokens)}\nhash = "{split.hash}"'
        lines = [head, "tokens = [", *(f'    "{token}",' for token in tokens), "]"]
    else:
        raise ConfigError(f"split {str(path)!r} is no .toml or .txt file", hint="name it so")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write {str(path)!r}: {error}", hint="choose another") from error
    return split
