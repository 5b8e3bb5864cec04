"""Drives scenarios in a worker: to collect labelled states, or to score a policy.

Several scenarios go in lock step, so that the network sees them as one batch. Either the network
drives or PDM-Closed, through the actions that it is imitated with.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from shiftsim.env.episode import Episode
from shiftsim.errors import ShiftsimError
from shiftsim.planners.learned.carl.planner import Carl, CarlFeatures, command_of
from shiftsim.runs.scenarios import open_named_store
from shiftsim.sim.loop import Setting
from shiftsim.train.expert import Action, Expert
from shiftsim.train.pictures import packed

EVERY = 2  # steps of which one is kept: neighbours are nearly the same
_SOON = 30  # steps before an infraction


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


class State(NamedTuple):
    """A labelled state."""

    picture: bytes  # `pictures.packed`
    measurements: Action  # (10,) of `CarlFeatures`
    action: Action  # (2,) what the expert would do
    is_urgent: bool = False  # whether the network ended with an infraction soon after


class Driven(NamedTuple):
    """What a job came to."""

    states: list[State]
    scores: list[float]  # closed-loop score of each scenario that was driven to its end
    failed: list[str]  # why a scenario was not


class PolicyPlanner(Carl):
    """The network that is trained, as a planner."""

    def remember(self, action: Action) -> None:
        """Take an action that somebody else did as its own last one."""
        self._last_action = action


class Lane:
    """One scenario under way."""

    def __init__(self, start: Start, job: Job, scenario: Any, student: PolicyPlanner) -> None:
        self.start, self.job, self.student = start, job, student
        setting = Setting(start.noise, start.seed)
        self.episode = Episode(scenario, setting, np.zeros(2, np.float32))
        student.reset(self.episode.scene)
        self.expert = Expert(self.episode.scene, job.tau)
        self.states: list[State] = []
        self.features: CarlFeatures | None = None  # what the student is asked about
        self.action: Action | None = None  # what is done in this step

    @property
    def is_over(self) -> bool:
        """Whether nothing is to be learnt from going on."""
        return self.episode.is_over or (not self.job.is_test and self.episode.infraction != "")

    @property
    def learnt(self) -> list[State]:
        """What was noted; the last of it is urgent where the network drove into an infraction."""
        by_network = 0 <= self.start.expert_steps < self.episode.iteration
        if not (self.episode.infraction and by_network):
            return self.states
        calm = max(0, len(self.states) - _SOON // EVERY)
        return self.states[:calm] + [state._replace(is_urgent=True) for state in self.states[calm:]]

    def look(self) -> None:
        """Note the state and its label, where it is kept, and who drives."""
        step, observation = self.episode.iteration, self.episode.observe()
        is_expert = self.start.expert_steps < 0 or step < self.start.expert_steps
        is_kept = not self.job.is_test and step % EVERY == 0
        self.action = self.expert.act(observation) if is_expert or is_kept else None
        features = self.student.features(observation) if is_kept or not is_expert else None
        if is_kept and features is not None and self.action is not None:
            state = State(packed(features.pictures), features.measurements, self.action)
            self.states.append(state)
        self.features = None if is_expert else features

    def advance(self, action: Action) -> None:
        """Drive one step."""
        self.student.remember(action)
        ego = self.episode.log.ego[self.episode.iteration]
        self.episode.advance(command_of(action, ego))


class Driver:
    """Does jobs, one after the other."""

    def __init__(self, store: str, checkpoint: str) -> None:
        """`checkpoint` is of the network that drives; any where PDM-Closed does."""
        self._store, self._student = open_named_store(store), PolicyPlanner(checkpoint)

    def __call__(self, job: Job) -> Driven:
        """Drive all scenarios of a job."""
        lanes, failed = [], []
        for start in job.starts:
            try:
                scenario = self._store.read(start.token)
                lanes.append(Lane(start, job, scenario, self._student.fork()))
            except ShiftsimError as error:
                failed.append(f"{start.token}: {error.message}")
        active = list(lanes)
        while active := [lane for lane in active if not lane.is_over]:
            active = _step(active, self._student, failed)
        states = [state for lane in lanes for state in lane.learnt]
        ended = [lane.episode for lane in lanes if job.is_test and lane.episode.is_over]
        return Driven(states, [episode.scores.get("cls", 0.0) for episode in ended], failed)


def _step(lanes: list[Lane], student: PolicyPlanner, failed: list[str]) -> list[Lane]:
    """Drive all of them one step; those that can go on."""
    seen = []
    for lane in lanes:
        try:
            lane.look()
            seen.append(lane)
        except ShiftsimError as error:  # a scenario in which the expert fails teaches nothing
            failed.append(f"{lane.start.token}: {error.message}")
    asked = [lane for lane in seen if lane.features is not None]
    if asked:
        for lane, action in zip(
            asked, student.infer([lane.features for lane in asked if lane.features]), strict=True
        ):
            lane.action = action
    for lane in seen:
        if lane.action is not None:
            lane.advance(lane.action)
    return seen
