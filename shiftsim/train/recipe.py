"""Training CaRL's network by imitation of PDM-Closed, in rounds (DAgger).

A round collects states, first those that PDM-Closed meets under noise, then those that the network
meets, at once where it has weights to begin with; PDM-Closed labels all of them. It trains on the
states of all rounds so far, and drives in towns that are left out. What was done is kept at least
every two minutes.
"""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any

from shiftsim.data import open_store
from shiftsim.planners.learned.checkpoint import resolve_device
from shiftsim.runs.filter import read_filter_results
from shiftsim.runs.scenarios import find_split
from shiftsim.train import folder, learning
from shiftsim.train.driving import RunJobs, Towns, collect, divide, mean_scores, run_jobs
from shiftsim.train.folder import BEST, LATEST, OnMessage, Settings, Weights
from shiftsim.train.states import States, write_part

_WRITE_EVERY, _REPORT_EVERY = 120.0, 10.0  # s
_CURVE_EVERY = 50  # steps
_NO_DRIVER = "deterministic:base"  # where the network does not drive


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


class Training:
    """One training in its folder."""

    def __init__(self, settings: Settings, on_message: OnMessage, *, resume: bool = False) -> None:
        """Begin, or go on where it was kept last.

        Raises:
            ConfigError: The folder holds another training, or there is no such device.
            DataError: The store is not there.
        """
        self._settings, self._on_message = settings, on_message
        self.device = resolve_device(settings.device)
        store = open_store(settings.store)
        filtered = read_filter_results(store.path, store.hash)
        usable = filtered.accepted if filtered else store.tokens
        tokens = find_split(settings.split, store.path, usable).tokens
        self.towns: Towns = divide(store, tokens, settings.seed)
        folder.prepare_folder(settings, store.hash, resume=resume)
        self.steps = max(1, settings.samples // settings.rounds // learning.BATCH)
        total = self.steps * settings.rounds
        begin = learning.from_official(self._begin()) if settings.checkpoint else None
        self.learner = learning.Learner(self.device, settings.workers, total, settings.seed, begin)
        self.progress = Progress()
        if (settings.out / folder.STATE).exists():
            state = folder.read_state(settings.out / folder.STATE)
            self.progress = Progress(**state["progress"])
            self.learner.restore(state["learner"])
        self._began = monotonic() - self.progress.seconds

    def _begin(self) -> Weights:
        """The weights to begin with, which are the network that drives first."""
        from shiftsim.planners.learned.checkpoint import load_weights

        settings = self._settings
        state = load_weights(settings.checkpoint, "carl").state
        if not (settings.out / LATEST).exists():
            folder.write_network(settings.out / LATEST, state)
        return state

    def run(self) -> None:
        """Do all rounds that are not done yet, and PPO if it is asked for."""
        self._imitate()
        if self._settings.ppo_samples:
            self._reinforce()

    def _imitate(self) -> None:
        settings, progress = self._settings, self.progress
        if not progress.tau:
            progress.tau = settings.tau or self._choose_tau()
            self._write_state()
        while progress.round < settings.rounds:
            self._collect()
            self._train()
            self._test()
            progress.round, progress.done = progress.round + 1, 0
            self._write_state()

    def _reinforce(self) -> None:
        """Go on with PPO from the best network, and test what comes out."""
        from shiftsim.planners.learned.checkpoint import load_weights
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
        settings, rows = self._settings, self.progress.taus
        for tau in folder.TAUS:
            run = self._run_jobs(_NO_DRIVER, f"tau {tau:g} s")
            found = mean_scores(self.towns, settings.tests, tau, run, by_expert=True)
            rows.append({"tau": tau, **found})
            self._on_message(f"tau {tau:g} s: {_in_words(found)}")
        folder.write_table(settings.out / "tau.parquet", rows)
        return float(max(rows, key=lambda row: sum(row.values()) - row["tau"])["tau"])

    def _collect(self) -> None:
        settings, progress = self._settings, self.progress
        part = settings.part(progress.round)
        if part.exists():
            return
        drives = progress.round or settings.checkpoint
        checkpoint = str(settings.out / LATEST) if drives else _NO_DRIVER
        run = self._run_jobs(checkpoint, f"{self._where} collecting")
        number, tau = progress.round, progress.tau
        write_part(part, collect(settings, self.towns, number, tau, run, self._on_message))
        self._write_state()

    def _train(self) -> None:
        settings, progress, learner = self._settings, self.progress, self.learner
        states = States([settings.part(number) for number in range(progress.round + 1)])
        self._on_message(f"{self._where} training on {len(states)} states")
        reported = written = monotonic()
        before, results = progress.done, list[learning.StepResult]()
        while progress.done < self.steps:
            key = (settings.seed, 3, progress.round, progress.done)
            results.append(learner.learn(states, learning.draw_batch(states, key)))
            progress.done += 1
            if progress.done % _CURVE_EVERY == 0 or progress.done == self.steps:
                progress.curve.append(_curve_row(progress.round, learner.step, results))
                results = []
                if monotonic() - written > _WRITE_EVERY:
                    self._write_state()
                    written = monotonic()
            if monotonic() - reported > _REPORT_EVERY:
                rate = (progress.done - before) * learning.BATCH / (monotonic() - reported)
                reported, before = monotonic(), progress.done
                self._report(rate)

    def _report(self, rate: float) -> None:
        done, total = (n * learning.BATCH for n in (self.learner.step, self.learner.total))
        left = (total - done) / rate
        row = self.progress.curve[-1] if self.progress.curve else {"loss": float("nan")}
        self._on_message(
            f"{self._where} {done} of {total} samples  {rate:.0f} samples/s  "
            f"loss {row['loss']:.3f}  {left / 60.0:.0f} min of training left"
        )

    def _test(self) -> None:
        settings, progress = self._settings, self.progress
        state = learning.to_official(self.learner.driving())
        folder.write_network(settings.out / LATEST, state)
        found = self._scores(settings.out / LATEST, self._where)
        seconds = monotonic() - self._began
        samples = self.learner.step * learning.BATCH
        row = {"round": progress.round, "samples": samples, **found, "seconds": seconds}
        before = max((sum_of(row) for row in progress.scores), default=-1.0)
        progress.scores.append(row)
        if sum_of(row) > before:
            folder.write_network(settings.out / BEST, state)
        self._on_message(f"{self._where} {_in_words(found)}  after {seconds / 60.0:.0f} min")
        folder.write_table(settings.out / "scores.parquet", progress.scores)
        folder.write_table(settings.out / "curve.parquet", progress.curve)
        folder.draw_curves(settings.out / "curves.png", progress.curve, progress.scores)

    def _scores(self, network: Path, where: str) -> dict[str, float]:
        run, count = self._run_jobs(str(network), f"{where} testing"), self._settings.tests
        return mean_scores(self.towns, count, self.progress.tau, run, by_expert=False)

    def _write_state(self) -> None:
        self.progress.seconds = monotonic() - self._began
        state = {"progress": vars(self.progress), "learner": self.learner.state()}
        folder.write_state(self._settings.out / folder.STATE, state)

    @property
    def _where(self) -> str:
        return f"round {self.progress.round + 1} of {self._settings.rounds}:"

    def _run_jobs(self, checkpoint: str, what: str) -> RunJobs:
        """What drives jobs with some weights and says how far it is, now and then."""
        last = [monotonic()]

        def on_progress(done: int, total: int) -> None:
            if monotonic() - last[0] > _REPORT_EVERY or done == total:
                last[0] = monotonic()
                self._on_message(f"{what} {done} of {total} jobs")

        return partial(run_jobs, self._settings, checkpoint, on_progress)


def sum_of(row: dict[str, Any]) -> float:
    """What the best network has most of: scores with and without noise."""
    return float(row["none"] + row["ou-high"])


def _curve_row(number: int, step: int, results: list[learning.StepResult]) -> dict[str, Any]:
    count = len(results)
    return {
        "round": number,
        "samples": step * learning.BATCH,
        "loss": sum(one.loss for one in results) / count,
        "acceleration_error": sum(one.errors[0] for one in results) / count,
        "steering_error": sum(one.errors[1] for one in results) / count,
    }


def _in_words(found: dict[str, float]) -> str:
    return "  ".join(f"{noise} {100.0 * score:.1f}" for noise, score in found.items())
