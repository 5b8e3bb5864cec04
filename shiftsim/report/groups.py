"""What a report is made from: the scores of one or several runs as arrays.

A `Group` holds all rollouts of one planner under one noise. Whether two groups may stand in one
table is decided by their `DataSet`: the same scenarios under the same thresholds.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, compress, product
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shiftsim.errors import DataError, one_of
from shiftsim.kernels import BoolArray, FloatArray
from shiftsim.metrics import SHORT_NAMES
from shiftsim.report.tables import Number
from shiftsim.runs.config import named_checkpoint
from shiftsim.runs.results import Run
from shiftsim.sim.perception import drift_order
from shiftsim.world.scenario import FULL_DURATION

GROUPINGS = ("scenario_type", "city", "seed")
_OF_SCENARIOS = ("tokens", "cities", "recordings", "types", "durations")
COLUMNS = {"cls": "CLS"} | {n: short for n, short in SHORT_NAMES.items() if n != "score"}
TRAFFIC = {"nonreactive": "NR", "reactive": "R"}


@dataclass(frozen=True, slots=True)
class KnownSet:
    """A published list of scenarios, as far as it is known."""

    name: str  # as split
    label: str  # as in tables
    thresholds: str  # threshold profile of the benchmark
    count: int  # number of its scenarios
    sha256: str  # of its tokens, sorted and joined by newlines
    tokens: tuple[str, ...] = ()  # the tokens, where they may be shipped


@dataclass(frozen=True, slots=True)
class DataSet:
    """The scenarios of a run."""

    name: str  # of the split
    label: str  # what stands in tables; says so where it is a part only, as `demo-mini (4/16)`
    known: str  # name of the published list that this is, or is a part of; empty for an own list
    whole: int  # scenarios of the whole list; those of the run where no more is known
    thresholds: str  # threshold profile
    metric_version: str  # version of the metric definitions
    controller: str  # how plans moved the ego
    tokens: tuple[str, ...]  # (N,) the scenarios, sorted
    cities: tuple[str, ...]  # (N,) city of each, empty where no rollout finished
    recordings: tuple[str, ...]  # (N,) recording of each
    types: tuple[str, ...]  # (N,) type of each
    durations: tuple[str, ...]  # (N,) class of duration of each
    edits: str = ""  # profile of the edits that made the scenarios; empty where they are recorded

    @property
    def key(self) -> tuple[str, ...]:
        """Equal for sets whose scores may be compared."""
        return (self.name, self.edits, token_digest(self.tokens), *self.traits)

    @property
    def traits(self) -> tuple[str, ...]:
        """What tells sets of one name apart, in words."""
        listed = f"list {token_digest(self.tokens)[:8]}"
        return (self.thresholds, self.controller, f"metrics v{self.metric_version}", listed)

    @property
    def rules(self) -> str:
        """What stands beside every printed score."""
        thresholds, controller, version, listed = self.traits
        return (
            f"{self.label}: {len(self.tokens)} scenarios of {self.num_recordings} recordings"
            f"{self.windows} · thresholds {thresholds} · {version} · controller {controller} · "
            f"{listed}"
        )

    @property
    def classes(self) -> list[str]:
        """The known classes of duration, short ones first."""
        return sorted(set(self.durations) - {""}, key=lambda name: (len(name), name))

    @property
    def windows(self) -> str:
        """How long the scenarios are, in words; empty where it is not known."""
        return f" · windows of {', '.join(self.classes)}" if self.classes else ""

    @property
    def is_interplan(self) -> bool:
        """Whether codes of interPlan made the scenarios: their score is interPlan's."""
        return self.edits == "interplan"

    @property
    def num_recordings(self) -> int:
        """Recordings that the scenarios are from."""
        return len(set(self.recordings))

    def within(self, city: str) -> BoolArray:
        """(N,) scenarios of a city, and those that could be because nothing is known of them."""
        return np.isin(self.cities, (city, ""))

    def only(self, where: BoolArray) -> "DataSet":
        """Some (N,) of the scenarios."""
        columns: dict[str, Any] = {
            name: tuple(compress(getattr(self, name), where.tolist())) for name in _OF_SCENARIOS
        }
        return replace(self, **columns)


@dataclass(frozen=True, slots=True)
class Group:
    """All rollouts of one planner under one noise in one run, or those of some scenarios."""

    run: Run  # the run
    data: DataSet  # its scenarios
    traffic: str  # `NR`, `R`, or another mode's name
    name: str  # what the run calls the planner
    planner: str  # the same, made unique among the runs of a report
    noise: str  # name
    seeds: tuple[int, ...]  # the seeds
    # (S, N, C) seeds, scenarios, `COLUMNS`, in [0, 1]; NaN where nothing finished
    values: FloatArray
    allow_partial: bool = False  # whether estimates are labelled means of what finished

    @property
    def is_complete(self) -> bool:
        """Whether every rollout finished."""
        return bool(np.isfinite(self.values[:, :, 0]).all())

    @property
    def weights(self) -> str:
        """What weights of our own are called that the planner drove with; else empty."""
        return str(planner_identities(self.run).get(self.name, {}).get("weights") or "")

    @property
    def metrics(self) -> pa.Table:
        """The rows of the run's `metrics.parquet` that are of this planner and noise."""
        table = self.run.metrics
        return table.filter(_matching(table, self.name, self.noise))

    def only(self, where: BoolArray) -> "Group":
        """The rollouts of some (N,) of the scenarios."""
        return replace(self, data=self.data.only(where), values=self.values[:, where])

    def split(self, by: str | None) -> list[tuple[str, "Group"]]:
        """The rollouts by one of `GROUPINGS`, with the name of each part; None does not split."""
        if by is None:
            return [("", self)]
        one_of("column", by, GROUPINGS)
        if by == "seed":
            each = enumerate(self.seeds)
            return [(str(n), replace(self, seeds=(n,), values=self.values[[i]])) for i, n in each]
        names = np.array(self.data.types if by == "scenario_type" else self.data.cities)
        return [(name or "unknown", self.only(names == name)) for name in np.unique(names).tolist()]

    def column(self, name: str = "cls") -> FloatArray:
        """(S, N) values of one column by seed and scenario."""
        return self.values[:, :, list(COLUMNS).index(name)]

    def scenario_means(self, name: str = "cls") -> FloatArray:
        """(N,) mean over the seeds of one column; NaN where a seed is missing."""
        return self.column(name).mean(axis=0)

    def seed_means(self, name: str = "cls") -> FloatArray:
        """Mean of one column over what finished of each seed, in [0, 1]; seeds of nothing lack."""
        seeds = (row[np.isfinite(row)] for row in self.column(name))
        return np.array([row.mean() for row in seeds if len(row)])

    def estimate(self, name: str = "cls") -> Number:
        """The score of one column, times 100; empty of no scenarios, or where it is undefined."""
        if name in undefined_columns(self.run):
            return Number(None, done=0, expected=0)
        finished = np.isfinite(self.column(name))
        done, expected = int(finished.sum()), finished.size
        if not done or (done < expected and not self.allow_partial):
            return Number(None, done=done, expected=expected)
        means = 100.0 * self.seed_means(name)
        return Number(float(means.mean()), 2, seed_deviation(means), done, expected)


def undefined_columns(run: Run) -> set[str]:
    """Columns that nobody can know of rollouts that were driven elsewhere, without other tracks."""
    undefined = run.manifest.get("elsewhere", {}).get("undefined", ())
    return {"cls", *undefined} if undefined else set()


def seed_deviation(values: FloatArray) -> float | None:
    """Sample standard deviation (n - 1) over the seeds' means; None for a single seed."""
    return float(values.std(ddof=1)) if len(values) > 1 else None


def planner_identities(run: Run) -> dict[str, dict[str, Any]]:
    """What identifies each planner of a run, of those that have more than a name."""
    planners = run.manifest["determining"]["planners"].items()
    return {name: identity for name, identity in planners if isinstance(identity, dict)}


def token_digest(tokens: Iterable[str]) -> str:
    """SHA-256 of a set of tokens, as lists of nuPlan scenarios are identified."""
    return hashlib.sha256("\n".join(sorted(tokens)).encode()).hexdigest()


def by_set(groups: Iterable[Group]) -> list[tuple[DataSet, list[Group]]]:
    """The data sets of groups, each once, with its groups; traffic is NR, R, then others."""
    found: dict[tuple[str, ...], list[Group]] = {}
    for group in groups:
        found.setdefault(group.data.key, []).append(group)
    modes = [*TRAFFIC.values()]
    return [
        (mine[0].data, sorted(mine, key=lambda group: (group.traffic not in modes, group.traffic)))
        for mine in found.values()
    ]


def distinct_sets(groups: Iterable[Group]) -> list[DataSet]:
    """The data sets of groups, each once."""
    return [data for data, _ in by_set(groups)]


def read_groups(
    runs: Sequence[Run], known: Sequence[KnownSet] = (), *, allow_partial: bool = False
) -> list[Group]:
    """The groups of runs, named by what tells them apart; a DataError if they contradict."""
    found = [group for run in runs for group in _groups(run, known)]
    by_name: dict[str, list[Group]] = {}
    for group in found:
        by_name.setdefault(group.name, []).append(group)
    labels = {name: _planner_labels(mine) for name, mine in by_name.items()}
    seen: dict[tuple[object, ...], Group] = {}
    for group in found:
        label = labels[group.name][group.run.path]
        named = replace(group, planner=label, allow_partial=allow_partial)
        seen.setdefault((group.data.key, group.traffic, named.planner, group.noise), named)
    kinds: dict[str, list[tuple[str, ...]]] = {}
    for group in seen.values():
        kinds.setdefault(group.data.label, []).append(group.data.traits)
    out = []
    for group in seen.values():  # sets of one label say what tells them apart
        values = zip(group.data.traits, zip(*kinds[group.data.label], strict=True), strict=True)
        differing = [value for value, all_values in values if len(set(all_values)) > 1]
        label = ", ".join([group.data.label, *differing])
        out.append(replace(group, data=replace(group.data, label=label)))
    return out


def _planner_labels(groups: Sequence[Group]) -> dict[Path, str]:
    """What groups of one name are called, by run: what tells them apart stands behind the name."""
    facts = {group.run.path: _planner_facts(group) for group in groups}
    if _contradiction(groups, facts):  # then the way in which they were run tells them apart
        facts = {group.run.path: facts[group.run.path] | _run_facts(group.run) for group in groups}
    if pair := _contradiction(groups, facts):
        group, other = pair
        name = f"{group.run.path.name}/{group.name}"
        raise DataError(
            f"{group.run.path.name!r} and {other.run.path.name!r} both hold "
            f"{group.name} {group.noise} {group.traffic} on {group.data.name}, and differ",
            hint=f"name one of them, compare them with `shiftsim diff`, or --label {name}=other",
        )
    name, kinds = groups[0].name, {repr(of): path for path, of in reversed(facts.items())}
    if len(kinds) == 1:
        return dict.fromkeys(facts, name)
    differing = [
        key
        for key in dict.fromkeys(chain(*facts.values()))
        if key.strip() and len({repr(of.get(key)) for of in facts.values()}) > 1
    ]
    words = {p: ", ".join(f"{k} {of[k]}" for k in differing if k in of) for p, of in facts.items()}
    if len({*words.values()}) == len(kinds):
        return {path: f"{name} ({text})" if text else name for path, text in words.items()}
    alike = len({path.name for path in kinds.values()}) < len(kinds)
    first = {path: kinds[repr(of)] for path, of in facts.items()}
    return {path: f"{name} @{one if alike else one.name}" for path, one in first.items()}


def _planner_facts(group: Group) -> dict[str, Any]:
    """What identifies a planner; what people can read of it has a name."""
    determining, config = (group.run.manifest[part] for part in ("determining", "config"))
    identity = planner_identities(group.run).get(group.name, {})
    out: dict[str, Any] = {"": (determining["planners"].get(group.name), determining.get("code"))}
    out |= {k: PurePath(str(v)).name for k, v in identity.get("arguments", {}).items()}
    out |= {"batch size": identity["batch_size"]} if "batch_size" in identity else {}
    if "checkpoint" in identity:
        shipped = "shiftsim" if identity.get("weights") else "official"
        out["checkpoint"] = PurePath(named_checkpoint(config, group.name) or shipped).name
    return out


def _run_facts(run: Run) -> dict[str, Any]:
    """What scores of the same planner depend on as well."""
    rules = run.manifest["determining"]
    rest = tuple(rules.get(name) for name in ("noise", "traffic_made_of", "store"))
    out = {"batch size": rules.get("batch_size"), "strict": rules.get("strict"), " ": rest}
    return out | {"seeds": " ".join(map(str, run.manifest["config"]["seeds"]))}


def _contradiction(
    groups: Sequence[Group], facts: Mapping[Path, Mapping[str, Any]]
) -> tuple[Group, Group] | None:
    """Two groups of the same planner, set, traffic and noise that hold other values, if any."""
    seen: dict[tuple[object, ...], Group] = {}
    for group in groups:
        identity = repr(facts[group.run.path])
        key = (group.data.key, group.traffic, group.noise, identity)
        other = seen.setdefault(key, group)
        alike = np.array_equal(group.values, other.values, equal_nan=True)
        if group.seeds != other.seeds or not alike:
            return group, other
    return None


def _groups(run: Run, known: Sequence[KnownSet]) -> Iterator[Group]:
    tasks, scores = run.tasks, run.scores
    if not len(tasks):
        raise DataError(f"run {run.path.name!r} holds no tasks", hint="merge the shards of a run")
    data = _data_set(run, known)
    parts = _by_duration(data)
    traffic = str(run.manifest["determining"]["traffic"])
    # nuPlan rule 570: a metric without a score counts as 0
    table = np.stack([pc.fill_null(scores[name], 0.0).to_numpy() for name in COLUMNS], axis=1)
    table[:, [name in undefined_columns(run) for name in COLUMNS]] = np.nan
    places = pc.index_in(scores["token"], value_set=pa.array(data.tokens, pa.string())).to_numpy()
    noises = drift_order(pc.unique(tasks["noise"]).to_pylist())
    for planner, noise in product(run.manifest["config"]["planners"], noises):
        seeds = np.unique(tasks["seed"].to_numpy()[_matching(tasks, planner, noise)])
        values = np.full((len(seeds), len(data.tokens), len(COLUMNS)), np.nan)
        rows = np.flatnonzero(_matching(scores, planner, noise))
        row_seeds = np.searchsorted(seeds, scores["seed"].to_numpy()[rows])
        values[row_seeds, places[rows].astype(np.int64)] = table[rows]
        mode, names = TRAFFIC.get(traffic, traffic), (planner, planner)
        whole = Group(run, data, mode, *names, noise, tuple(seeds.tolist()), values)
        for part, chosen in parts if len(seeds) else ():
            yield replace(whole.only(chosen), data=part)


def _matching(table: pa.Table, planner: str, noise: str) -> BoolArray:
    mask = pc.and_(pc.equal(table["planner"], planner), pc.equal(table["noise"], noise))
    return mask.to_numpy().astype(np.bool_)


def _by_duration(data: DataSet) -> list[tuple[DataSet, BoolArray]]:
    """A set per class of duration, and (N,) its scenarios; each has those of unknown duration."""
    if not set(data.classes) - {FULL_DURATION}:
        return [(data, np.ones(len(data.tokens), np.bool_))]
    masks = {name: np.isin(data.durations, (name, "")) for name in data.classes}
    return [
        (replace(data.only(mask), label=f"{data.label}, {name}"), mask)
        for name, mask in masks.items()
    ]


def _data_set(run: Run, known: Sequence[KnownSet]) -> DataSet:
    manifest, determining = run.manifest, run.manifest["determining"]
    split, tokens = str(manifest["split"]), sorted(pc.unique(run.tasks["token"]).to_pylist())
    listed = _published_list(split, tokens, known)
    suffix = ""
    if manifest.get("shard"):
        suffix = f" (shard {manifest['shard']})"
    elif listed is not None and len(tokens) != listed.count:
        suffix = f" ({len(tokens)}/{listed.count})"
    elif listed is None and manifest["config"].get("limit"):
        of = f" of {manifest['split_size']}" if "split_size" in manifest else ""
        suffix = f" (first {len(tokens)}{of})"
    elif listed is None and split in {one.name for one in known}:
        suffix = " (not the published list)"
    return DataSet(
        name=listed.name if listed else split,
        label=f"{listed.label if listed else split}{suffix}",
        known=listed.name if listed else "",
        whole=listed.count if listed else len(tokens),
        thresholds=str(determining["thresholds"]["name"]),
        metric_version=str(determining["metric_version"]),
        controller=str(determining["controller"]),
        tokens=tuple(tokens),
        cities=_of_tokens(run.scores, "city", tokens),
        durations=_of_tokens(run.scores, "duration_class", tokens),
        recordings=_of_tokens(run.scores, "log_name", tokens),
        types=_of_tokens(run.tasks, "scenario_type", tokens),
        edits=str((manifest.get("edits") or {}).get("profile", "")),
    )


def _of_tokens(table: pa.Table, name: str, tokens: Sequence[str]) -> tuple[str, ...]:
    """A column that is the same for all rollouts of a scenario; empty where nothing is known."""
    rows = zip(table["token"].to_pylist(), table[name].to_pylist(), strict=True)
    known = {token: value for token, value in rows if value}
    return tuple(known.get(token, "") for token in tokens)


def _published_list(
    split: str, tokens: Sequence[str], known: Sequence[KnownSet]
) -> KnownSet | None:
    """The published list that the scenarios are, or are a part of."""
    digest = token_digest(tokens)
    whole = [one for one in known if one.sha256 == digest]
    partly = (
        one
        for one in known
        if (set(tokens) <= set(one.tokens) if one.tokens else split == one.name)
        and (one.tokens or len(tokens) < one.count)
    )
    return next(chain(whole, partly), None)
