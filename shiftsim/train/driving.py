"""Which scenarios are driven, and the workers that do it: for labelled states, or for scores.

Several scenarios go in lock step, so that the network sees them as one batch. Either the network
drives or PDM-Closed, through the actions that it is imitated with: the tracker turns its plan into
an acceleration and a steering rate; CaRL's action asks for an acceleration and a steering angle.
The angle is the present one and what the rate adds to it in `tau` seconds. CaRL's angle is reached
within 0.1 s: a larger `tau` steers harder than the tracker.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain, islice, zip_longest
from typing import Any, NamedTuple

import numpy as np

from shiftsim.data import open_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.env.episode import Episode
from shiftsim.errors import DataError, ShiftsimError, plural
from shiftsim.kernels import FloatArray
from shiftsim.planners.learned.carl import planner as carl
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.sim.dynamics.lqr import NUPLAN, raise_for_status, track
from shiftsim.sim.log import Setting
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.train.states import State, compress_raster
from shiftsim.world.state import STEERING, VX

EVERY = 2  # steps of which one is kept: neighbours are nearly the same
_URGENT_STEPS = 30  # before an infraction
# m/s; throttle of setting off; throttle of staying
SLOW, PARTING, HOLD = 0.3, 0.02, -0.3

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
TOGETHER, TOGETHER_ON_GPU = 10, 32  # scenarios of a job
_MIN_GROUPS = 5  # fewer towns are not left out, but recordings, or else scenarios
# share of scenarios that PDM-Closed begins, and up to which step
_BEGUN, _BEGUN_STEPS = 0.5, 75


@dataclass(frozen=True, slots=True)
class Start:
    """One scenario to be driven."""

    token: str
    noise: str
    seed: int  # of the noise
    # so many steps PDM-Closed drives before the network takes over; -1 for all of them
    expert_steps: int = 0


@dataclass(frozen=True, slots=True)
class Job:
    """What a worker is handed at once."""

    starts: tuple[Start, ...]
    is_test: bool  # whether scores are wanted, else labelled states
    tau: float  # of the labels [s]


class Driven(NamedTuple):
    """What a job came to."""

    states: list[State]
    scores: list[float]  # closed-loop score of each scenario that was driven to its end
    failed: list[str]  # why a scenario was not


def encode_action(
    acceleration: float, steering_rate: float, steering: float, tau: float
) -> carl.Action:
    """(2,) the action in [-1, 1] that stands for a command at a steering angle.

    `acceleration` [m/s^2], `steering_rate` [rad/s], `steering` [rad], `tau` [s].
    """
    most = carl.MAX_ACCELERATION if acceleration >= 0.0 else carl.MAX_BRAKING
    angle = steering + tau * steering_rate
    action = np.array([acceleration / most, angle / carl.MAX_STEERING])
    return np.clip(action, -1.0, 1.0).astype(np.float32)


def brake_at_stand(action: carl.Action, speed: float) -> carl.Action:
    """The action, which brakes where a vehicle at `speed` [m/s] is to stand or come to a stand.

    A network that is taught a throttle of 0 there errs to either side, and creeps.
    """
    if speed < SLOW and action[0] < PARTING:
        action[0] = min(float(action[0]), HOLD)
    return action


class Expert:
    """PDM-Closed in one scenario."""

    def __init__(self, scene: SceneInfo, tau: float) -> None:
        """`tau` as in `encode_action`."""
        self._planner, self._tau = PdmClosed(), tau
        self._planner.reset(scene)

    def act(self, observation: Observation) -> carl.Action:
        """What it would do now."""
        plan = self._planner.plan(observation)
        ego: FloatArray = observation.history.ego[-1].copy()
        now = observation.time_us
        status, acceleration, rate = track(now, ego, plan.time_us, plan.states, NUPLAN)
        raise_for_status(status, now, plan.time_us)
        action = encode_action(acceleration, rate, float(ego[STEERING]), self._tau)
        return brake_at_stand(action, float(ego[VX]))


class DrivenScenario:
    """One scenario under way."""

    def __init__(self, start: Start, job: Job, scenario: Any, policy: carl.Carl) -> None:
        self.start, self.job, self.policy = start, job, policy
        setting = Setting(start.noise, start.seed)
        self.episode = Episode(scenario, setting, np.zeros(2, np.float32))
        policy.reset(self.episode.scene)
        self.expert = Expert(self.episode.scene, job.tau)
        self.states: list[State] = []
        self.features: carl.CarlFeatures | None = None  # what the network is asked about
        self.action = np.zeros(2, np.float32)  # what is done in this step

    @property
    def is_over(self) -> bool:
        """Whether nothing is to be learnt from going on."""
        return self.episode.is_over or (not self.job.is_test and self.episode.infraction != "")

    @property
    def labelled(self) -> list[State]:
        """What was noted; the last of it is urgent where the network drove into an infraction."""
        by_network = 0 <= self.start.expert_steps < self.episode.iteration
        if not (self.episode.infraction and by_network):
            return self.states
        first = max(0, len(self.states) - _URGENT_STEPS // EVERY)
        return self.states[:first] + [one._replace(is_urgent=True) for one in self.states[first:]]

    def prepare(self) -> None:
        """Note the state and its label, where it is kept, and who drives."""
        step, observation = self.episode.iteration, self.episode.observe()
        is_expert = self.start.expert_steps < 0 or step < self.start.expert_steps
        is_kept = not self.job.is_test and step % EVERY == 0
        if is_expert or is_kept:
            self.action = self.expert.act(observation)
        features = self.policy.features(observation) if is_kept or not is_expert else None
        if is_kept and features is not None:
            state = State(compress_raster(features.pictures), features.measurements, self.action)
            self.states.append(state)
        self.features = None if is_expert else features

    def advance(self) -> None:
        """Drive one step."""
        self.policy.last_action = self.action  # also where it is somebody else's
        ego = self.episode.log.ego[self.episode.iteration]
        self.episode.advance(carl.command_of(self.action, ego))


class Driver:
    """Does jobs, one after the other."""

    def __init__(self, store: str, checkpoint: str) -> None:
        """`checkpoint` is of the network that drives; any where PDM-Closed does."""
        self._store, self._policy = open_store(store), carl.Carl(checkpoint)

    def __call__(self, job: Job) -> Driven:
        """Drive all scenarios of a job."""
        scenarios, failed = [], []
        for start in job.starts:
            try:
                scenario = self._store.read(start.token)
                scenarios.append(DrivenScenario(start, job, scenario, self._policy.fork()))
            except ShiftsimError as error:
                failed.append(f"{start.token}: {error.message}")
        active = scenarios
        while active := [one for one in active if not one.is_over]:
            ready = []
            for one in active:
                try:
                    one.prepare()
                    ready.append(one)
                except ShiftsimError as error:  # where the expert fails there is nothing to learn
                    failed.append(f"{one.start.token}: {error.message}")
            asked = [(one, one.features) for one in ready if one.features is not None]
            actions = self._policy.infer([features for _, features in asked]) if asked else ()
            for (one, _), action in zip(asked, actions, strict=True):
                one.action = action
            for one in ready:
                one.advance()
            active = ready
        states = [state for one in scenarios for state in one.labelled]
        ended = [one.episode for one in scenarios if job.is_test and one.episode.is_over]
        return Driven(states, [episode.scores.get("cls", 0.0) for episode in ended], failed)


class Towns(NamedTuple):
    """Tokens by town, or by what else is left out as a whole."""

    trained: dict[str, list[str]]
    tested: dict[str, list[str]]

    @property
    def trained_tokens(self) -> list[str]:
        """Of all towns to train on, sorted."""
        return sorted(chain.from_iterable(self.trained.values()))


def divide(store: ScenarioStore, tokens: Iterable[str], seed: int) -> Towns:
    """Towns to train on, and those to test on; a DataError if there are too few scenarios."""
    wanted = set(tokens)
    rows = [row for row in store.summary().to_pylist() if row["token"] in wanted]
    column = "token"
    for name in ("recording", "city"):
        column = name if len({row[name] for row in rows}) >= _MIN_GROUPS else column
    groups: dict[str, list[str]] = {}
    for row in rows:
        groups.setdefault(row[column], []).append(row["token"])
    if len(groups) < 2:
        what = f"{plural(len(rows), 'scenario')} to train on"
        raise DataError(what, hint="training needs two or more")
    names = np.random.default_rng([seed, 1]).permutation(sorted(groups)).tolist()
    count = max(1, round(LEFT_OUT * len(names)))
    return Towns({n: groups[n] for n in names[count:]}, {n: groups[n] for n in names[:count]})


def tested_tokens(towns: Towns, count: int) -> list[str]:
    """Scenarios of the towns that are left out, `count` at most, as many of each as can be."""
    turns = zip_longest(*(sorted(tokens) for tokens in towns.tested.values()))
    return sorted(islice(filter(None, chain.from_iterable(turns)), count))


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
