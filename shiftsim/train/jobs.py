"""Which scenarios are driven, under which noise, and the workers that do it."""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConfigError, DataError
from shiftsim.runs.workers import map_unordered
from shiftsim.train.driving import Driven, Driver, Job, Start
from shiftsim.train.folder import OnMessage, Settings
from shiftsim.train.states import State

NOISES = {  # how often states are collected under each
    "none": 0.4,
    "ou-high": 0.3,
    "ou-mid": 0.1,
    "ou-low": 0.05,
    "awgn-high": 0.05,
    "awgn-mid": 0.1,
}
TESTED = ("none", "ou-high")
LEFT_OUT = 0.1  # share of the towns that are tested on
TOGETHER = 10  # scenarios of a job
_MIN_GROUPS = 5  # fewer towns are not left out, but recordings, or else scenarios
_EXPECTED = 60  # states of a scenario, before any was driven
# share of scenarios that PDM-Closed begins, and up to which step
_BEGUN, _BEGUN_STEPS = 0.5, 75

_SEE = "see whether `shiftsim run -p pdm-closed` works on the store"

OnProgress = Callable[[int, int], None]  # gets how many of how many jobs are done
RunJobs = Callable[[list[Job]], list[Driven]]  # `run_jobs` for some weights


class Towns(NamedTuple):
    """Tokens by town, or by what else is left out as a whole."""

    trained: dict[str, list[str]]
    tested: dict[str, list[str]]


def divide(store: ScenarioStore, tokens: Iterable[str], seed: int) -> Towns:
    """Towns to train on, and those to test on.

    Raises:
        DataError: There are too few scenarios.
    """
    wanted = set(tokens)
    rows = [row for row in store.summary().to_pylist() if row["token"] in wanted]
    column = "token"
    for name in ("recording", "city"):
        column = name if len({row[name] for row in rows}) >= _MIN_GROUPS else column
    groups: dict[str, list[str]] = {}
    for row in rows:
        groups.setdefault(row[column], []).append(row["token"])
    if len(groups) < 2:
        raise DataError(f"the store has {len(rows)} scenarios", hint="training needs two or more")
    names = np.random.default_rng([seed, 1]).permutation(sorted(groups)).tolist()
    count = max(1, round(LEFT_OUT * len(names)))
    return Towns({n: groups[n] for n in names[count:]}, {n: groups[n] for n in names[:count]})


def test_jobs(towns: Towns, count: int, noise: str, tau: float, *, by_expert: bool) -> list[Job]:
    """Drive scenarios of the towns that are left out, `count` at most, to their end."""
    lists = [sorted(tokens) for tokens in towns.tested.values()]
    longest = max(len(tokens) for tokens in lists)
    tokens = [found[i] for i in range(longest) for found in lists if i < len(found)][:count]
    starts = [Start(token, noise, 0, -1 if by_expert else 0) for token in sorted(tokens)]
    return [
        Job(tuple(starts[first : first + TOGETHER]), True, tau)
        for first in range(0, len(starts), TOGETHER)
    ]


def collecting_jobs(
    towns: Towns, count: int, tau: float, random: np.random.Generator, *, by_expert: bool
) -> list[Job]:
    """So many jobs that collect, each in one town, in all towns before one comes again."""
    jobs: list[Job] = []
    names: list[str] = []
    while len(jobs) < count:
        names = names or random.permutation(list(towns.trained)).tolist()
        tokens = random.permutation(towns.trained[names.pop()])[:TOGETHER]
        starts = []
        for token in tokens.tolist():
            noise = str(random.choice(list(NOISES), p=list(NOISES.values())))
            seed = int(random.integers(2**31))
            begun = int(random.integers(_BEGUN_STEPS)) if random.random() < _BEGUN else 0
            starts.append(Start(token, noise, seed, -1 if by_expert else begun))
        jobs.append(Job(tuple(starts), False, tau))
    return jobs


def run_jobs(
    settings: Settings, checkpoint: str, on_progress: OnProgress, jobs: list[Job]
) -> list[Driven]:
    """Drive jobs in worker processes; the results in the order of the jobs.

    Raises:
        ConfigError: A worker died.
    """
    make = partial(Driver, settings.store, checkpoint)
    found: dict[int, Driven] = {}
    places = {id(job): place for place, job in enumerate(jobs)}
    for outcome in map_unordered(make, jobs, workers=settings.workers):
        if outcome.result is None:
            raise ConfigError(f"{outcome.death}", hint="go on with --resume")
        found[places[id(outcome.task)]] = outcome.result
        on_progress(len(found), len(jobs))
    return [found[place] for place in range(len(jobs))]


def collect(
    settings: Settings, towns: Towns, number: int, tau: float, run: RunJobs, on_message: OnMessage
) -> Iterator[State]:
    """The labelled states of a round; PDM-Closed drives in the first if nobody else can."""
    random = np.random.default_rng([settings.seed, 2, number])
    wanted, count, jobs_done = settings.states // settings.rounds, 0, 0
    while count < wanted:
        sizes = [min(len(tokens), TOGETHER) for tokens in towns.trained.values()]
        expected = count / jobs_done if jobs_done else _EXPECTED * float(np.mean(sizes))
        needed = int(np.ceil((wanted - count) / max(expected, 1.0)))
        by_expert = number == 0 and not settings.checkpoint
        before, failed = count, list[str]()
        for driven in run(collecting_jobs(towns, needed, tau, random, by_expert=by_expert)):
            jobs_done += 1
            count += len(driven.states)
            failed += driven.failed
            yield from driven.states
        if failed:
            on_message(f"{len(failed)} scenarios ended early, such as {failed[0]}")
        if count == before:
            raise DataError(f"no state could be collected: {failed[0]}", hint=_SEE)


def mean_scores(
    towns: Towns, count: int, tau: float, run: RunJobs, *, by_expert: bool
) -> dict[str, float]:
    """Mean closed-loop score by noise, on `count` scenarios at most of towns that are left out."""
    out = {}
    for noise in TESTED:
        done = run(test_jobs(towns, count, noise, tau, by_expert=by_expert))
        scores = [score for driven in done for score in driven.scores]
        if not scores:
            failed = [text for driven in done for text in driven.failed]
            raise DataError(f"no scenario could be driven to its end: {failed[0]}", hint=_SEE)
        out[noise] = float(np.mean(scores))
    return out
