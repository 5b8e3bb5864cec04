"""Training CaRL's network by imitation of PDM-Closed, in rounds (DAgger).

A round collects states, first those that PDM-Closed meets under noise, then those that the network
meets, at once where it has weights to begin with; PDM-Closed labels all of them. It trains on the
states of all rounds so far, and drives in towns that are left out. What was done is kept at least
every two minutes.
"""

from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

from shiftsim.planners.learned.device import resolve_device
from shiftsim.runs.scenarios import find_split, open_named_store
from shiftsim.runs.verdicts import read_verdicts
from shiftsim.train.curves import Say, draw_curves, write_table
from shiftsim.train.jobs import Towns, collect, divide, mean_scores
from shiftsim.train.keeping import read_state, write_network, write_state
from shiftsim.train.learning import (
    BATCH,
    Learner,
    State,
    draw_batch,
    from_official,
    to_official,
)
from shiftsim.train.settings import TAUS, Settings, prepare_folder
from shiftsim.train.states import States, read_part, write_part

_KEPT_EVERY, _SAID_EVERY = 120.0, 10.0  # s
_NOTED_EVERY = 50  # steps
_NOBODY = "deterministic:base"  # where the network does not drive


@dataclass
class Course:
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

    def __init__(self, settings: Settings, say: Say, *, resume: bool = False) -> None:
        """Begin, or go on where it was kept last.

        Raises:
            ConfigError: The folder holds another training, or there is no such device.
            DataError: The store is not there.
        """
        self._settings, self._say = settings, say
        self.device = resolve_device(settings.device)
        store = open_named_store(settings.store)
        verdicts = read_verdicts(store.path, store.hash)
        usable = verdicts.accepted if verdicts else store.tokens
        tokens = find_split(settings.split, store.path, usable).tokens
        self.towns: Towns = divide(store, tokens, settings.seed)
        prepare_folder(settings, store.hash, resume=resume)
        self.steps = max(1, settings.samples // settings.rounds // BATCH)
        total = self.steps * settings.rounds
        begin = from_official(self._begin()) if settings.checkpoint else None
        self.learner = Learner(self.device, settings.workers, total, settings.seed, begin)
        self.course = Course()
        if settings.state.exists():
            kept = read_state(settings.state)
            self.course = Course(**kept["course"])
            self.learner.restore(kept["learner"])
        self._began = monotonic() - self.course.seconds

    def _begin(self) -> State:
        """The weights to begin with, which are the network that drives first."""
        from shiftsim.planners.learned.checkpoint import load_weights

        settings = self._settings
        state = load_weights(settings.checkpoint, "carl").state
        if not settings.network.exists():
            write_network(settings.network, state)
        return state

    def run(self) -> None:
        """Do all rounds that are not done yet, and PPO if it is asked for."""
        self._imitate()
        if self._settings.ppo_samples:
            self._reinforce()

    def _imitate(self) -> None:
        settings, course = self._settings, self.course
        if not course.tau:
            course.tau = settings.tau or self._choose_tau()
            self._keep()
        while course.round < settings.rounds:
            self._collect()
            self._train()
            self._test()
            course.round, course.done = course.round + 1, 0
            self._keep()

    def _reinforce(self) -> None:
        """Go on with PPO from the best network, and test what comes out."""
        from shiftsim.planners.learned.checkpoint import load_weights
        from shiftsim.train.ppo import reinforce

        settings = self._settings
        state = load_weights(str(settings.best), "carl").state
        write_network(
            settings.reinforced, reinforce(settings, self.towns, state, self.device, self._say)
        )
        found = self._scores(settings.reinforced, "PPO:")
        self._say(f"PPO: {_in_words(found)}")

    def _choose_tau(self) -> float:
        """The tau with which PDM-Closed drives best through its labels, with and without noise."""
        for tau in TAUS:
            show = self._shower(f"tau {tau:g} s")
            found = mean_scores(self._settings, self.towns, _NOBODY, tau, by_expert=True, show=show)
            self.course.taus.append({"tau": tau, **found})
            self._say(f"tau {tau:g} s: {_in_words(found)}")
        write_table(self._settings.out / "tau.parquet", self.course.taus)
        best = max(self.course.taus, key=lambda row: sum(row.values()) - row["tau"])
        return float(best["tau"])

    def _collect(self) -> None:
        settings, course = self._settings, self.course
        folder = settings.part(course.round)
        if folder.exists():
            return
        drives = course.round or settings.checkpoint
        checkpoint = str(settings.network) if drives else _NOBODY
        show = self._shower(f"{self._where} collecting")
        number, tau, towns = course.round, course.tau, self.towns
        states = collect(settings, towns, checkpoint, number, tau, show, self._say)
        write_part(folder, states)
        self._keep()

    def _train(self) -> None:
        settings, course, learner = self._settings, self.course, self.learner
        parts = [read_part(settings.part(number)) for number in range(course.round + 1)]
        states = States(parts)
        self._say(f"{self._where} training on {len(states)} states")
        said = kept = monotonic()
        before, noted = course.done, []
        while course.done < self.steps:
            key = (settings.seed, 3, course.round, course.done)
            noted.append(learner.learn(states, draw_batch(states, key)))
            course.done += 1
            if course.done % _NOTED_EVERY == 0 or course.done == self.steps:
                course.curve.append(_noted(course.round, learner.step, noted))
                noted = []
                if monotonic() - kept > _KEPT_EVERY:
                    self._keep()
                    kept = monotonic()
            if monotonic() - said > _SAID_EVERY:
                rate = (course.done - before) * BATCH / (monotonic() - said)
                said, before = monotonic(), course.done
                self._report(rate)

    def _report(self, rate: float) -> None:
        left = (self.learner.total - self.learner.step) * BATCH / rate
        row = self.course.curve[-1] if self.course.curve else {"loss": float("nan")}
        self._say(
            f"{self._where} {self.learner.step * BATCH} of {self.learner.total * BATCH} samples  "
            f"{rate:.0f} samples/s  loss {row['loss']:.3f}  {left / 60.0:.0f} min of training left"
        )

    def _test(self) -> None:
        settings, course = self._settings, self.course
        state = to_official(self.learner.driving())
        write_network(settings.network, state)
        found = self._scores(settings.network, self._where)
        seconds = monotonic() - self._began
        samples = self.learner.step * BATCH
        row = {"round": course.round, "samples": samples, **found, "seconds": seconds}
        before = max((sum_of(row) for row in course.scores), default=-1.0)
        course.scores.append(row)
        if sum_of(row) > before:
            write_network(settings.best, state)
        self._say(f"{self._where} {_in_words(found)}  after {seconds / 60.0:.0f} min")
        write_table(settings.out / "scores.parquet", course.scores)
        write_table(settings.out / "curve.parquet", course.curve)
        draw_curves(settings.out / "curves.png", course.curve, course.scores)

    def _scores(self, network: Path, where: str) -> dict[str, float]:
        settings, tau, show = self._settings, self.course.tau, self._shower(f"{where} testing")
        return mean_scores(settings, self.towns, str(network), tau, by_expert=False, show=show)

    def _keep(self) -> None:
        self.course.seconds = monotonic() - self._began
        kept = {"course": vars(self.course), "learner": self.learner.state()}
        write_state(self._settings.state, kept)

    @property
    def _where(self) -> str:
        return f"round {self.course.round + 1} of {self._settings.rounds}:"

    def _shower(self, what: str) -> Any:
        said = [monotonic()]

        def show(done: int, total: int) -> None:
            if monotonic() - said[0] > _SAID_EVERY or done == total:
                said[0] = monotonic()
                self._say(f"{what} {done} of {total} jobs")

        return show


def sum_of(row: dict[str, Any]) -> float:
    """What the best network has most of: scores with and without noise."""
    return float(row["none"] + row["ou-high"])


def _noted(number: int, step: int, noted: list[Any]) -> dict[str, Any]:
    count = len(noted)
    return {
        "round": number,
        "samples": step * BATCH,
        "loss": sum(one.loss for one in noted) / count,
        "acceleration_error": sum(one.errors[0] for one in noted) / count,
        "steering_error": sum(one.errors[1] for one in noted) / count,
    }


def _in_words(found: dict[str, float]) -> str:
    return "  ".join(f"{noise} {100.0 * score:.1f}" for noise, score in found.items())
