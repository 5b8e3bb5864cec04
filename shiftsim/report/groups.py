"""What a report is made from: the scores of one or several runs as arrays.

A `Group` holds all rollouts of one planner under one noise. Whether two groups may stand in one
table is decided by their `DataSet`: the same scenarios under the same thresholds.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.errors import DataError
from shiftsim.metrics import SHORT_NAMES
from shiftsim.report.statistics import Interval, bootstrap_interval, cluster_codes, seed_deviation
from shiftsim.runs.results import Run
from shiftsim.sim.noise import NOISE_NAMES

COLUMNS = {"cls": "CLS"} | {n: short for n, short in SHORT_NAMES.items() if n != "score"}
TRAFFIC = {"nonreactive": "NR", "reactive": "R"}


@dataclass(frozen=True, slots=True)
class KnownSet:
    """A published list of scenarios, as far as it is known.

    Attributes:
        name: As split.
        label: As in tables.
        thresholds: Threshold profile of the benchmark.
        count: Number of its scenarios.
        sha256: Of its tokens, sorted and joined by newlines.
        tokens: The tokens, where they may be shipped.
    """

    name: str
    label: str
    thresholds: str
    count: int
    sha256: str
    tokens: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class DataSet:
    """The scenarios of a run.

    Attributes:
        name: Of the split.
        label: What stands in tables; says so where it is a part only, as `demo-mini (4/16)`.
        known: Name of the published list that this is, or is a part of; empty for an own list.
        whole: Scenarios of the whole list; those of the run where no more is known.
        thresholds: Threshold profile.
        metric_version: Version of the metric definitions.
        controller: How plans moved the ego.
        tokens: (N,) the scenarios, sorted.
        cities: (N,) city of each, empty where no rollout finished.
        recordings: (N,) recording of each.
        types: (N,) type of each.
    """

    name: str
    label: str
    known: str
    whole: int
    thresholds: str
    metric_version: str
    controller: str
    tokens: tuple[str, ...]
    cities: tuple[str, ...]
    recordings: tuple[str, ...]
    types: tuple[str, ...]

    @property
    def key(self) -> tuple[str, ...]:
        """Equal for sets whose scores may be compared."""
        rules = (self.thresholds, self.metric_version, self.controller)
        return (self.name, token_digest(self.tokens), *rules)

    @property
    def is_whole(self) -> bool:
        """Whether the run holds every scenario of the list."""
        return len(self.tokens) == self.whole

    @property
    def rules(self) -> str:
        """What stands beside every printed score."""
        return (
            f"{self.label}: {len(self.tokens)} scenarios of {self.num_recordings} recordings · "
            f"thresholds {self.thresholds} · metrics v{self.metric_version} · "
            f"controller {self.controller} · list {token_digest(self.tokens)[:8]}"
        )

    @property
    def num_recordings(self) -> int:
        """Recordings that the scenarios are from."""
        return len(set(self.recordings))

    def within(self, city: str) -> BoolArray:
        """(N,) scenarios of a city, and those that could be because nothing is known of them."""
        return np.array([name in (city, "") for name in self.cities], np.bool_)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A score times 100, or the reason why there is none.

    Attributes:
        mean: Mean over scenarios, then over seeds; None when withheld.
        std: Standard deviation over the seeds' means; None for one seed or when withheld.
        done: Finished rollouts.
        expected: Rollouts of a complete group.
    """

    mean: float | None
    std: float | None
    done: int
    expected: int

    @property
    def label(self) -> str:
        """Empty for a complete score."""
        if self.done == self.expected:
            return ""
        count = f"({self.done}/{self.expected})"
        return f"{'withheld' if self.mean is None else 'partial'} {count}"


@dataclass(frozen=True, slots=True)
class Group:
    """All rollouts of one planner under one noise in one run.

    Attributes:
        run: The run.
        data: Its scenarios.
        traffic: `NR`, `R`, or another mode's name.
        planner: Name, made unique among the runs of a report.
        noise: Name.
        seeds: The seeds.
        values: (S, N, C) seeds, scenarios, `COLUMNS`, in [0, 1]; NaN where nothing finished.
    """

    run: Run
    data: DataSet
    traffic: str
    planner: str
    noise: str
    seeds: tuple[int, ...]
    values: FloatArray

    @property
    def is_complete(self) -> bool:
        """Whether every rollout finished."""
        return bool(np.isfinite(self.values[:, :, 0]).all())

    def column(self, name: str = "cls") -> FloatArray:
        """(N,) mean over the seeds of one column, for complete groups."""
        return self.values[:, :, list(COLUMNS).index(name)].mean(axis=0)

    def estimate(
        self, name: str = "cls", where: BoolArray | None = None, *, allow_partial: bool = False
    ) -> Estimate | None:
        """The score of one column over some scenarios; None where there are none."""
        values = self.values[:, :, list(COLUMNS).index(name)]
        chosen = values if where is None else values[:, where]
        if not chosen.size:
            return None
        finished = np.isfinite(chosen)
        done, expected = int(finished.sum()), chosen.size
        seeds = [row[np.isfinite(row)] for row in chosen]
        if not done or (done < expected and not allow_partial):
            return Estimate(None, None, done, expected)
        means = 100.0 * np.array([row.mean() for row in seeds if len(row)])
        return Estimate(float(means.mean()), seed_deviation(means), done, expected)

    def interval(self, name: str = "cls", where: BoolArray | None = None) -> Interval | None:
        """Bootstrap interval of the same score; None unless complete and of several recordings."""
        mask = np.ones(len(self.data.tokens), np.bool_) if where is None else where
        values = self.column(name)[mask]
        if not len(values) or not np.isfinite(values).all():
            return None
        return bootstrap_interval(
            100.0 * values, cluster_codes(np.array(self.data.recordings)[mask].tolist())
        )


def made_up_note(runs: Iterable[Run]) -> str:
    """Which planners drove with deterministic weights, so that no score of theirs is believed."""
    names = {
        name
        for run in runs
        for name, identity in run.manifest["determining"]["planners"].items()
        if isinstance(identity, dict)
        and str(identity.get("checkpoint", "")).startswith("deterministic:")
    }
    return f"MEANINGLESS: made-up weights of {', '.join(sorted(names))}" if names else ""


def token_digest(tokens: Iterable[str]) -> str:
    """SHA-256 of a set of tokens, as lists of nuPlan scenarios are identified."""
    return hashlib.sha256("\n".join(sorted(tokens)).encode()).hexdigest()


def read_groups(runs: Sequence[Run], known: Sequence[KnownSet] = ()) -> list[Group]:
    """The groups of runs, in the order of runs, planners and noises.

    Args:
        runs: The runs.
        known: Published lists, by which sets are recognised.

    Raises:
        DataError: Runs contradict each other, or hold no tasks.
    """
    labels = _planner_labels(runs)
    seen: dict[tuple[Any, ...], Group] = {}
    for group in (group for run in runs for group in _groups(run, known, labels[run.path])):
        key = (group.data.key, group.traffic, group.planner, group.noise)
        other = seen.setdefault(key, group)
        if other is not group and not _is_equal(group, other):
            raise DataError(
                f"{group.run.path.name!r} and {other.run.path.name!r} both hold "
                f"{group.planner} {group.noise} {group.traffic} on {group.data.name}, and differ",
                hint="name one of them, or compare them with `shiftsim diff`",
            )
    return _labelled_apart(list(seen.values()))


def _labelled_apart(groups: list[Group]) -> list[Group]:
    """The same groups; sets of one label say what tells them apart, such as their thresholds."""
    kinds: dict[str, dict[tuple[str, ...], None]] = {}
    for group in groups:
        kinds.setdefault(group.data.label, {})[_traits(group.data)] = None
    out = []
    for group in groups:
        traits = list(zip(*kinds[group.data.label], strict=True))
        own = zip(_traits(group.data), traits, strict=True)
        telling = [value for value, values in own if len(set(values)) > 1]
        label = ", ".join([group.data.label, *telling])
        out.append(replace(group, data=replace(group.data, label=label)) if telling else group)
    return out


def _traits(data: DataSet) -> tuple[str, ...]:
    listed = f"list {token_digest(data.tokens)[:8]}"
    return (data.thresholds, data.controller, f"metrics v{data.metric_version}", listed)


def _is_equal(one: Group, other: Group) -> bool:
    return one.seeds == other.seeds and np.array_equal(one.values, other.values, equal_nan=True)


def _planner_labels(runs: Sequence[Run]) -> dict[Any, dict[str, str]]:
    """Names of planners by run; a name that means different planners gets its run's name added."""
    prints: dict[str, set[str]] = {}
    for run in runs:
        for name in run.manifest["config"]["planners"]:
            prints.setdefault(name, set()).add(_fingerprint(run, name))
    return {
        run.path: {
            name: name if len(prints[name]) == 1 else f"{name} @{run.path.name}"
            for name in run.manifest["config"]["planners"]
        }
        for run in runs
    }


def _fingerprint(run: Run, planner: str) -> str:
    determining = run.manifest["determining"]
    return repr((determining["planners"].get(planner), determining.get("code")))


def _groups(run: Run, known: Sequence[KnownSet], labels: dict[str, str]) -> Iterable[Group]:
    tasks, scores = run.tasks, run.scores
    if not len(tasks):
        raise DataError(f"run {run.path.name!r} holds no tasks", hint="make the run again")
    data = _data_set(run, known)
    config = run.manifest["config"]
    traffic = str(run.manifest["determining"]["traffic"])
    order = {name: i for i, name in enumerate(NOISE_NAMES)}
    noises = sorted(_distinct(tasks["noise"]), key=lambda n: order.get(n, len(order)))
    planners = sorted(_distinct(tasks["planner"]), key=lambda n: _place(config["planners"], n))
    table = _values(scores)
    row_tokens = _indices(scores["token"], data.tokens)
    for planner in planners:
        for noise in noises:
            mine = _matching(tasks, planner, noise)
            if not mine.any():
                continue
            seeds = sorted(set(tasks["seed"].to_numpy()[mine].tolist()))
            values = np.full((len(seeds), len(data.tokens), len(COLUMNS)), np.nan)
            rows = np.flatnonzero(_matching(scores, planner, noise))
            places = np.searchsorted(seeds, scores["seed"].to_numpy()[rows])
            values[places, row_tokens[rows]] = table[rows]
            label = labels.get(planner, planner)
            yield Group(
                run, data, TRAFFIC.get(traffic, traffic), label, noise, tuple(seeds), values
            )


def _place(names: Sequence[str], name: str) -> int:
    return names.index(name) if name in names else len(names)


def _distinct(column: pa.ChunkedArray) -> list[str]:
    return list(pc.unique(column).to_pylist())


def _indices(column: pa.ChunkedArray, values: Sequence[str]) -> IntArray:
    found = pc.index_in(column, value_set=pa.array(values, pa.string()))
    return found.to_numpy().astype(np.int64)


def _matching(table: pa.Table, planner: str, noise: str) -> BoolArray:
    mask = pc.and_(pc.equal(table["planner"], planner), pc.equal(table["noise"], noise))
    return mask.to_numpy().astype(np.bool_)


def _values(scores: pa.Table) -> FloatArray:
    """(rows, C); a metric without a score counts as 0 (nuplan-metrics.md §12)."""
    return np.stack(
        [pc.fill_null(scores[name], 0.0).to_numpy() for name in COLUMNS], axis=1
    ).reshape(len(scores), len(COLUMNS))


def _data_set(run: Run, known: Sequence[KnownSet]) -> DataSet:
    tokens = tuple(sorted(_distinct(run.tasks["token"])))
    described = _labels(run.scores, ("city", "log_name"))
    types = _labels(run.tasks, ("scenario_type",))

    def label(name: str, known: dict[str, dict[str, Any]] = described) -> tuple[str, ...]:
        return tuple(known.get(token, {}).get(f"{name}_max") or "" for token in tokens)

    manifest = run.manifest
    split = str(manifest["split"])
    name, whole = _known(split, tokens, known)
    expected = whole.count if whole is not None else 0
    limit = int(manifest["config"].get("limit") or 0)
    suffix = ""
    if manifest.get("shard"):
        suffix = f" (shard {manifest['shard']})"
    elif expected and len(tokens) != expected:
        suffix = f" ({len(tokens)}/{expected})"
    elif not expected and limit:
        suffix = f" (first {len(tokens)})"
    elif whole is None and split in {one.name for one in known}:
        suffix = " (not the published list)"
    return DataSet(
        name=name,
        label=f"{whole.label if whole is not None else split}{suffix}",
        known=whole.name if whole is not None else "",
        whole=expected or len(tokens),
        thresholds=str(manifest["determining"]["thresholds"]["name"]),
        metric_version=str(manifest["determining"]["metric_version"]),
        controller=str(manifest["determining"]["controller"]),
        tokens=tokens,
        cities=label("city"),
        recordings=label("log_name"),
        types=label("scenario_type", types),
    )


def _labels(table: pa.Table, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Rows by token of what is the same for all rollouts of a scenario, where it is known."""
    rows = table.select(["token", *names]).group_by("token")
    found = rows.aggregate([(name, "max") for name in names]).to_pylist()
    return {row["token"]: row for row in found}


def _known(
    split: str, tokens: Sequence[str], known: Sequence[KnownSet]
) -> tuple[str, KnownSet | None]:
    """Name of a set, and the published list that it is or is a part of."""
    digest = token_digest(tokens)
    for one in known:
        if one.sha256 == digest:
            return one.name, one
    for one in known:
        if one.tokens and set(tokens) <= set(one.tokens):
            return one.name, one
        if not one.tokens and split == one.name and len(tokens) < one.count:
            return one.name, one
    return split, None
