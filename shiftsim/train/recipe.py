"""Training networks in rounds: collect, learn, and drive in towns that are left out.

CaRL's imitates PDM-Closed (DAgger). A round collects states, first those that PDM-Closed meets
under noise, then those that the network meets, at once where it has weights to begin with;
PDM-Closed labels all of them. It trains on the states of all rounds so far. PlanTF's and PLUTO's
learn from recordings: samples are made when they are needed, and nothing is collected. What was
done is kept at least every two minutes.
"""

import shutil
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from shiftsim.data import open_store
from shiftsim.errors import ConfigError, DataError, listed
from shiftsim.files import write_text
from shiftsim.metrics.open_loop import METRICS
from shiftsim.planners.learned.checkpoint import load_weights, resolve_device
from shiftsim.runs.config import make_config
from shiftsim.runs.execute import execute
from shiftsim.runs.prepare import prepare
from shiftsim.runs.results import Run
from shiftsim.runs.scenarios import usable_tokens
from shiftsim.runs.workers import map_unordered
from shiftsim.train import driving, folder, learning
from shiftsim.train.checks import check
from shiftsim.train.folder import BEST, LATEST, OnMessage
from shiftsim.train.imitation import ImitationLearner
from shiftsim.train.samples import KINDS
from shiftsim.train.states import State, States, write_part
from shiftsim.train.stream import Stream, load_blocks

_WRITE_EVERY = 120.0  # s
_CURVE_EVERY = 50  # steps
DRIVEN = 0.06  # of the scenarios that are trained on, in each round
_BASELINE = "constant-velocity"  # driven beside a network, for comparison
_NO_DRIVER = "deterministic:base"  # where PDM-Closed drives, and no network
_EXPECTED = 60  # states of a scenario, before any was driven
_SEE = "see whether `shiftsim run -p pdm-closed` works on the store"


@dataclass
class Progress:
    """How far a training is, with all that it has noted."""

    tau: float = 0.0
    round: int = 0  # the present one
    done: int = 0  # steps of it
    curve: list[dict[str, Any]] = field(default_factory=list)
    scores: list[dict[str, Any]] = field(default_factory=list)
    taus: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0  # that it took so far


class Recipe(ABC):
    """One training in its folder, of whatever planner."""

    learner: learning.TrainedNetwork

    def __init__(self, settings: Any, on_message: OnMessage, *, resume: bool = False) -> None:
        """Begin, or go on where it was kept last; a ConfigError if the folder holds another one."""
        self._settings, self._on_message, self.planner = settings, on_message, settings.planner
        samples, self._rounds, batch, *_ = settings.recipe
        self.steps = max(1, samples // self._rounds // batch)  # of a round
        self.device = resolve_device(settings.device)
        store = open_store(settings.store)
        tokens = usable_tokens(store, settings.split)
        self.towns: driving.Towns = driving.divide(store, tokens, settings.seed)
        folder.prepare_folder(settings, store.hash, resume=resume)
        self.progress = Progress()
        self._make_learner(self.steps * self._rounds)
        if (settings.out / folder.STATE).exists():
            state = folder.read_state(settings.out / folder.STATE)
            self.progress = Progress(**state["progress"])
            self.learner.restore(state["learner"])
        self._began = monotonic() - self.progress.seconds

    @abstractmethod
    def _make_learner(self, total: int) -> None:
        """Make the learner, for so many steps."""

    @abstractmethod
    def _collect(self) -> None:
        """Collect what the round needs, where it is not there."""

    @abstractmethod
    def _results(self) -> Iterator[learning.StepResult]:
        """Do step after step, from where the round is."""

    @abstractmethod
    def _scores(self, network: Path, where: str) -> dict[str, float]:
        """Mean closed-loop scores by noise, in towns that are left out."""

    def run(self) -> None:
        """Do all rounds that are not done yet."""
        progress = self.progress
        while progress.round < self._rounds:
            self._collect()
            self._train()
            self._test()
            progress.round, progress.done = progress.round + 1, 0
            self._write_state()

    def _train(self) -> None:
        progress, learner = self.progress, self.learner
        reported = written = monotonic()
        before, results = progress.done, list[learning.StepResult]()
        for result in islice(self._results(), self.steps - progress.done):
            results.append(result)
            progress.done += 1
            if progress.done % _CURVE_EVERY == 0 or progress.done == self.steps:
                samples = learner.step * learner.batch
                progress.curve.append(_curve_row(progress.round, samples, results))
                results = []
                if monotonic() - written > _WRITE_EVERY:
                    self._write_state()
                    written = monotonic()
            if monotonic() - reported > folder.REPORT_EVERY:
                rate = (progress.done - before) * learner.batch / (monotonic() - reported)
                reported, before = monotonic(), progress.done
                self._report(rate)

    def _report(self, rate: float) -> None:
        done, total = (n * self.learner.batch for n in (self.learner.step, self.learner.total))
        left = (total - done) / rate
        curve = self.progress.curve
        loss = f"loss {curve[-1]['loss']:.3f}  " if curve else ""
        self._on_message(
            f"{self._where} {done} of {total} samples  {rate:.0f} samples/s  "
            f"{loss}{left / 60.0:.0f} min of training left"
        )

    def _test(self) -> None:
        settings, progress = self._settings, self.progress
        state = self.learner.driving()
        folder.write_network(settings.out / LATEST, state, self.planner)
        found = self._scores(settings.out / LATEST, self._where)
        seconds = monotonic() - self._began
        samples = self.learner.step * self.learner.batch
        row = {"round": progress.round, "samples": samples, **found, "seconds": seconds}
        before = max((sum_of(row) for row in progress.scores), default=-1.0)
        progress.scores.append(row)
        if sum_of(row) > before:
            folder.write_network(settings.out / BEST, state, self.planner)
        self._on_message(f"{self._where} {_in_words(found)}  after {seconds / 60.0:.0f} min")
        folder.write_table(settings.out / "scores.parquet", progress.scores)
        folder.write_table(settings.out / "curve.parquet", progress.curve)
        picture = settings.out / "curves.png"
        folder.draw_curves(picture, progress.curve, progress.scores, self.planner)

    def _write_state(self) -> None:
        self.progress.seconds = monotonic() - self._began
        state = {"progress": vars(self.progress), "learner": self.learner.state()}
        folder.write_state(self._settings.out / folder.STATE, state)

    @property
    def _where(self) -> str:
        return f"round {self.progress.round + 1} of {self._rounds}:"


class Training(Recipe):
    """Of CaRL's network."""

    learner: learning.Learner

    def _make_learner(self, total: int) -> None:
        settings, begin = self._settings, None
        if settings.checkpoint:  # which is the network that drives first
            state = load_weights(settings.checkpoint, "carl").state
            begin = learning.from_official(state)
            if not (settings.out / LATEST).exists():
                folder.write_network(settings.out / LATEST, state)
        self.learner = learning.Learner(self.device, settings.workers, total, settings.seed, begin)

    def run(self) -> None:
        """Do all rounds that are not done yet, and PPO if it is asked for."""
        if not self.progress.tau:
            self.progress.tau = self._settings.tau or self._choose_tau()
            self._write_state()
        super().run()
        if self._settings.ppo_samples:
            self._reinforce()

    def _reinforce(self) -> None:
        """Go on with PPO from the best network, and test what comes out."""
        from shiftsim.train.ppo import reinforce

        settings = self._settings
        state = load_weights(str(settings.out / BEST), "carl").state
        folder.write_network(
            settings.out / folder.REINFORCED,
            reinforce(settings, self.towns, state, self.device, self._on_message),
        )
        found = self._scores(settings.out / folder.REINFORCED, "PPO:")
        self._on_message(f"PPO: {_in_words(found)}")

    def _choose_tau(self) -> float:
        """The tau with which PDM-Closed drives best through its labels, with and without noise."""
        rows = self.progress.taus
        for tau in folder.TAUS:
            found = self._mean_scores(_NO_DRIVER, f"tau {tau:g} s", tau)
            rows.append({"tau": tau, **found})
            self._on_message(f"tau {tau:g} s: {_in_words(found)}")
        folder.write_table(self._settings.out / "tau.parquet", rows)
        return float(max(rows, key=lambda row: sum(row.values()) - row["tau"])["tau"])

    def _collect(self) -> None:
        part = self._settings.part(self.progress.round)
        if not part.exists():
            write_part(part, self._states())
            self._write_state()

    def _states(self) -> Iterator[State]:
        """The labelled states of a round; PDM-Closed drives in the first if nobody else can."""
        settings, number = self._settings, self.progress.round
        checkpoint = str(settings.out / LATEST) if number or settings.checkpoint else _NO_DRIVER
        random = np.random.default_rng([settings.seed, 2, number])
        wanted, count, jobs_done = -(-settings.states // settings.rounds), 0, 0
        while count < wanted:
            sizes = [min(len(tokens), driving.TOGETHER) for tokens in self.towns.trained.values()]
            expected = count / jobs_done if jobs_done else _EXPECTED * float(np.mean(sizes))
            how = self.towns, int(np.ceil((wanted - count) / max(expected, 1.0))), self.progress.tau
            jobs = driving.collecting_jobs(*how, random, by_expert=checkpoint == _NO_DRIVER)
            before, failed = count, list[str]()
            for driven in self._run_jobs(checkpoint, f"{self._where} collecting", jobs):
                jobs_done += 1
                count += len(driven.states)
                failed += driven.failed
                yield from driven.states
            if failed:
                self._on_message(f"{len(failed)} scenarios ended early, such as {failed[0]}")
            if count == before:
                raise DataError(f"no state could be collected: {failed[0]}", hint=_SEE)

    def _results(self) -> Iterator[learning.StepResult]:
        settings, progress, learner = self._settings, self.progress, self.learner
        states = States([settings.part(number) for number in range(progress.round + 1)])
        self._on_message(f"{self._where} training on {len(states)} states")
        while True:
            key = (settings.seed, 3, progress.round, progress.done)
            yield learner.learn(states, learning.draw_batch(states, key))

    def _scores(self, network: Path, where: str) -> dict[str, float]:
        return self._mean_scores(str(network), f"{where} testing", self.progress.tau)

    def _mean_scores(self, checkpoint: str, what: str, tau: float) -> dict[str, float]:
        """Mean closed-loop score by noise in towns left out, of a network or the expert."""
        out, tokens = {}, driving.tested_tokens(self.towns, self._settings.tests)
        steps = -1 if checkpoint == _NO_DRIVER else 0
        for noise in driving.TESTED:
            starts = tuple(driving.Start(token, noise, 0, steps) for token in tokens)
            first = range(0, len(starts), driving.TOGETHER)
            jobs = [driving.Job(starts[i : i + driving.TOGETHER], True, tau) for i in first]
            done = self._run_jobs(checkpoint, what, jobs)
            scores = [score for driven in done for score in driven.scores]
            if not scores:
                failed = [text for driven in done for text in driven.failed]
                raise DataError(f"no scenario could be driven to its end: {failed[0]}", hint=_SEE)
            out[noise] = float(np.mean(scores))
        return out

    def _run_jobs(
        self, checkpoint: str, what: str, jobs: list[driving.Job]
    ) -> list[driving.Driven]:
        """Drive jobs in worker processes: results in the order of the jobs, or a ConfigError."""
        settings, reported = self._settings, monotonic()
        make = partial(driving.Driver, settings.store, checkpoint)
        found: dict[int, driving.Driven] = {}
        for outcome in map_unordered(make, jobs, workers=settings.workers):
            if outcome.result is None:
                raise ConfigError(f"{outcome.death}", hint="go on with --resume")
            found[id(outcome.task)] = outcome.result
            if monotonic() - reported > folder.REPORT_EVERY or len(found) == len(jobs):
                reported = monotonic()
                self._on_message(f"{what} {len(found)} of {len(jobs)} jobs")
        return [found[id(job)] for job in jobs]


class ImitationTraining(Recipe):
    """Of PlanTF's network, or of PLUTO's."""

    learner: ImitationLearner

    def _make_learner(self, total: int) -> None:
        how = self.planner, self.device, self._settings.recipe, total, self._settings.seed
        self.learner = ImitationLearner(*how)
        self._left_out = Counter[str]()  # samples that could not be made, by reason

    def run(self) -> None:
        """Do all rounds that are not done yet, then see what the best network acts on."""
        super().run()
        settings = self._settings
        planner = KINDS[self.planner].planner(str(settings.out / BEST), device=self.device)
        tokens = driving.tested_tokens(self.towns, settings.tests)
        rows = check(planner, map(open_store(settings.store).read, tokens))
        folder.write_table(settings.out / "checks.parquet", rows)
        for row in rows:
            passed = f"{100.0 * row['passed']:.0f} %" if row["cases"] else "no share"
            self._on_message(f"{row['check']}: {passed} of {row['cases']} cases")

    def _collect(self) -> None:
        """From the second round on, let the network drive where it is trained."""
        settings, number = self._settings, self.progress.round
        if number == 0 or settings.recipe.published:
            return
        tokens = self.towns.trained_tokens
        drawn = np.random.default_rng([settings.seed, 6, number]).permutation(tokens)
        share = round(DRIVEN * len(tokens))
        self._drive(self._driven[-1], sorted(drawn[: max(share, 1)].tolist()), [self.planner])

    @property
    def _driven(self) -> list[Path]:
        """Runs of the rounds so far in which the network drove where it is trained."""
        rounds = 0 if self._settings.recipe.published else self.progress.round
        return [self._settings.out / "driven" / f"round-{i + 1:02d}" for i in range(rounds)]

    def _drive(self, out: Path, tokens: list[str], planners: list[str], **more: Any) -> Run:
        """Drive some scenarios with the latest network, with and without noise."""
        settings, split = self._settings, out.with_suffix(".txt")
        out.parent.mkdir(parents=True, exist_ok=True)
        write_text(split, "\n".join(tokens) + "\n")
        shutil.rmtree(out, ignore_errors=True)  # of a training that was ended in it
        values: dict[str, Any] = {
            "planners": planners,
            "checkpoints": [f"{self.planner}={settings.out / LATEST}"],
            "store": settings.store,
            "split": str(split),
            "out": str(out),
            "noise": list(driving.TESTED),
            "workers": settings.workers,
            "device": settings.device,
            "batch_size": driving.TOGETHER if self.device == "cpu" else driving.TOGETHER_ON_GPU,
            **more,
        }
        return execute(prepare(make_config(values)))

    def _results(self) -> Iterator[learning.StepResult]:
        settings, learner = self._settings, self.learner
        tokens, driven = tuple(self.towns.trained_tokens), tuple(map(str, self._driven))
        preset, where = settings.recipe, (settings.store, tokens, settings.seed)
        stream = Stream(*where, preset.batch, self.planner, preset.published, driven)
        self._on_message(f"{self._where} training on {len(tokens)} scenarios")
        block, done = learner.place
        unused = 0
        for found in load_blocks(stream, block, settings.workers):
            if not done:  # else the block was begun, and counted, in the round before
                self._left_out.update(found.failed)
            unused += 1
            for batch in found.batches[done:]:
                done += 1
                if 2 * len(batch.target) >= stream.batch:  # fewer give poor statistics
                    unused, learner.place = 0, (block, done)
                    yield learner.learn(batch)
            if unused > stream.blocks:
                raise DataError(
                    f"no batch of {stream.batch} samples could be made: {self._reasons}",
                    hint="training needs more scenarios with a future of 8 s",
                )
            block, done = block + 1, 0

    def _scores(self, network: Path, where: str) -> dict[str, float]:
        tokens = driving.tested_tokens(self.towns, self._settings.tests)
        self._on_message(f"{where} testing; samples that could not be made: {self._reasons}")
        run_folder = self._settings.out / "runs" / f"round-{self.progress.round:02d}"
        run = self._drive(run_folder, tokens, [self.planner, _BASELINE], open_loop=True)
        rows = [row for row in run.scores.to_pylist() if row["planner"] == self.planner]
        if not rows:
            raise DataError(f"no scenario could be driven to its end, see {str(run_folder)!r}")
        by_noise = {n: [r["cls"] for r in rows if r["noise"] == n] for n in driving.TESTED}
        scores = {n: sum(found) / len(tokens) for n, found in by_noise.items()}  # failures score 0
        return scores | _open_loop_errors(run.metrics.to_pylist())

    @property
    def _reasons(self) -> str:
        counts = self._left_out.most_common()
        return listed([f"{count} {reason}" for reason, count in counts]) or "none"


def _open_loop_errors(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Mean errors along the recording [m], by planner, over the scenarios that were tested."""
    found: dict[str, list[float]] = {}
    for row in rows:
        short = METRICS.get(row["metric"], ("",))[0]
        if short in ("ADE", "FDE") and row["value"] is not None:
            found.setdefault(f"{short} of {row['planner']} [m]", []).append(row["value"])
    return {name: sum(values) / len(values) for name, values in sorted(found.items())}


def sum_of(row: dict[str, Any]) -> float:
    """What the best network has most of: scores with and without noise."""
    return float(row["none"] + row["ou-high"])


def _curve_row(number: int, samples: int, results: list[learning.StepResult]) -> dict[str, Any]:
    count = len(results)
    terms = {n: sum(one.terms[n] for one in results) / count for n in results[0].terms}
    loss = sum(one.loss for one in results) / count
    return {"round": number, "samples": samples, "loss": loss, **terms}


def _in_words(found: dict[str, float]) -> str:
    scale = dict.fromkeys(driving.TESTED, 100.0)
    return "  ".join(f"{name} {scale.get(name, 1.0) * value:.1f}" for name, value in found.items())
