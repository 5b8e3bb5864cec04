"""How hard an edited scenario is: driven, with brakes and with PDM-Closed, until nothing is hit.

A driver who does not react drives what was recorded. One who brakes notices what is in the way, and
half a second later decelerates evenly along the recorded path until it stands. Both go through the
tracker and the motion model of every rollout, beside replayed traffic.
"""

import numpy as np

from shiftsim.edits.sampling import GRADES, HARDEST
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics.collision import classify, first_contacts, flat_ego, flat_tracks
from shiftsim.metrics.result import Collision
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.loop import Rollout
from shiftsim.sim.planner import Observation, Planner, SceneInfo
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, PACIFICA, AgentKind, Trajectory, speeds

REACTION_US = 500_000  # before the ego brakes
_LOOKS = 10  # iterations between looks for contacts
_MOVES = 0.1  # m/s, from which a pedestrian has set off
_BEYOND = 200.0  # m, how far the path goes on straight behind the recording
_AHEAD: IntArray = np.arange(0, 2_100_000, 100_000)  # us, times of a plan


def grade(scenario: Scenario) -> str:
    """How hard an edited scenario is, of `GRADES`; empty where it is not in the way or unavoidable.

    That is the least of their decelerations with which a driver who brakes hits nothing; the
    hardest where PDM-Closed hits nothing, though such braking does. It is in the way where a driver
    who does not react hits something that the edit made.
    """
    edited = set(scenario.script.tokens if scenario.script else ())
    if not hits(scenario, Braking(scenario, 0.0)) & edited:
        return ""
    *easier, hardest = GRADES
    if hits(scenario, Braking(scenario, HARDEST)):
        return "" if hits(scenario, PdmClosed()) else hardest
    enough = (name for name in easier if not hits(scenario, Braking(scenario, GRADES[name])))
    return next(enough, hardest)


def is_avoidable(scenario: Scenario) -> bool:
    """Whether a driver who brakes at 4 m/s^2, or PDM-Closed, hits nothing."""
    return not hits(scenario, Braking(scenario, HARDEST)) or not hits(scenario, PdmClosed())


def hits(scenario: Scenario, planner: Planner) -> set[str]:
    """Tokens of the tracks that a planner hits first, at fault or at its side."""
    rollout, found = Rollout(scenario, planner), set[str]()
    while not rollout.done and not found:
        rollout.advance(planner.plan(rollout.observe()))
        if rollout.iteration % _LOOKS == 0 or rollout.done:
            found = {hit.token for hit in at_fault(rollout.log(), rollout.iteration)}
    return found


def at_fault(log: SimulationLog, count: int) -> list[Collision]:
    """First contacts at fault with each track in the first samples, as `hits` counts them."""
    ego, tracks = log.ego[:count], log.tracks.rows(slice(0, count))
    contacts = first_contacts(flat_ego(ego, PACIFICA), flat_tracks(tracks))
    never_common = np.zeros(count, np.bool_)
    hits = classify(contacts, log.time_us[:count], tracks, never_common)
    return [hit for hit in hits if hit.at_fault]


class Braking:
    """Drives what was recorded, and brakes half a second after it has noticed something.

    What stands is noticed at the start, pedestrians that an edit made when they set off.
    """

    name = "braking"

    def __init__(
        self,
        scenario: Scenario,
        deceleration: float,
        *,
        driven: tuple[IntArray, FloatArray] | None = None,
    ) -> None:
        """A deceleration of 0 [m/s^2] does not react; `driven`: times (K,) [us], states (K, 11)."""
        rows = slice(int(scenario.iteration_rows[0]), None)
        time_us, states = driven or (scenario.time_us[rows], scenario.ego[rows])
        distinct = np.flatnonzero(np.diff(time_us, prepend=-1) > 0)
        end, heading = states[distinct[-1], :2], states[distinct[-1], 2]
        beyond = end + _BEYOND * np.array([np.cos(heading), np.sin(heading)])
        self._time_us = time_us[distinct]
        self._xy = np.concatenate([states[distinct, :2], beyond[None]])
        headings = np.unwrap(states[distinct, 2])
        self._heading = np.append(headings, headings[-1])
        self._arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self._xy, axis=0).T))])
        self._speed = speeds(states[distinct])
        self._deceleration = deceleration
        # tracks that are pedestrians which an edit made
        edited = set(scenario.script.tokens if scenario.script else ())
        of_edit = np.array([token in edited for token in scenario.tracks.tokens], np.bool_)
        self._is_edit = of_edit & (scenario.tracks.kinds == AgentKind.PEDESTRIAN)
        self._brakes_us: int | None = None

    def reset(self, scene: SceneInfo) -> None:
        """Notice nothing yet."""
        self._brakes_us = None

    def plan(self, observation: Observation) -> Trajectory:
        """The coming 2 s."""
        now = observation.time_us
        if self._brakes_us is None and self._deceleration > 0.0 and self._notices(observation):
            self._brakes_us = now + REACTION_US
        brakes = self._brakes_us is not None and now >= self._brakes_us
        arc = self._braked(now + _AHEAD) if brakes else self._recorded(now + _AHEAD)
        states = np.zeros((len(_AHEAD), NUM_STATE))
        for column, values in enumerate((*self._xy.T, self._heading)):
            states[:, column] = np.interp(arc, self._arc, values)
        return Trajectory(now + _AHEAD, states)

    def _notices(self, observation: Observation) -> bool:
        if not self._is_edit.any():
            return True
        velocities = observation.tracks.velocities[-1, self._is_edit]
        return bool((np.hypot(*np.nan_to_num(velocities).T) > _MOVES).any())

    def _braked(self, time_us: IntArray) -> FloatArray:
        """Where it is on the path once it brakes [m]."""
        since = self._brakes_us or 0
        start = self._recorded(np.array([since]))[0]
        speed = float(np.interp(since, self._time_us, self._speed))
        late = np.clip((time_us - since) * 1e-6, 0.0, speed / self._deceleration)
        return start + speed * late - 0.5 * self._deceleration * late**2

    def _recorded(self, time_us: IntArray) -> FloatArray:
        """Where the recording was, and goes on at its last speed [m]."""
        arc: FloatArray = np.interp(time_us, self._time_us, self._arc[:-1])
        late = np.maximum(time_us - self._time_us[-1], 0) * 1e-6
        return arc + self._speed[-1] * late
