"""What an edit asks of a rollout, beyond tracks, lights and route of the edited scenario."""

from dataclasses import dataclass, field

import numpy as np
import shapely

from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.layers import contains
from shiftsim.world.map import VectorMap

FOLLOW, STOPPED, CAUTIOUS, LOGGED = 0, 1, 2, 3  # how a track behaves under reactive traffic
OFF, ASSERTIVE, WARY, MIXED, DEFAULT = -1, 0, 1, 2, 3  # how reactive agents treat the ego
CROSSING_SIZE = (0.9000033778444835, 0.7913900336773054)  # length, width of a pedestrian's box [m]


@dataclass(frozen=True, slots=True)
class ScriptedPedestrian:
    """A pedestrian that sets off once, and stands at the end of its way.

    Attributes:
        track: Its track.
        start: (3,) where it stands first: x [m], y [m], heading [rad].
        end: (2,) where it goes [m].
        size: (2,) length, width [m].
        speed: How fast [m/s].
        ego_within: Distance of the ego's centre that sets it off [m].
        visible: Whether it is there before.
    """

    track: int
    start: FloatArray
    end: FloatArray
    size: FloatArray
    speed: float
    ego_within: float
    visible: bool

    def walk(
        self, seconds: FloatArray, start_time: float
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Poses (R, 3), velocities (R, 2) and presence (R,) at times (R,), from one of them on [s].

        Where the start time is infinite, it waits.
        """
        step = self.end - self.start[:2]
        length = float(np.hypot(*step))
        gone = np.zeros(len(seconds))
        if start_time < np.inf:
            gone = np.clip((seconds - start_time) * self.speed, 0.0, length)
        poses = np.tile(self.start, (len(seconds), 1))
        poses[:, :2] += (gone / length)[:, None] * step
        walks = (seconds >= start_time) & (gone < length)
        velocities = np.where(walks[:, None], self.speed * step / length, 0.0)
        return poses, velocities, (seconds >= start_time) | self.visible


@dataclass(frozen=True, slots=True)
class Crossing:
    """A pedestrian of interPlan: not there until it sets off, and slower the later it does.

    Attributes:
        token: Its token.
        start: (3,) where it sets off: x [m], y [m], heading [rad].
        end: (2,) where it goes [m].
        iteration: When it sets off; 0 where the ego decides.
        track: Its track.
    """

    token: str
    start: FloatArray
    end: FloatArray
    iteration: int
    track: int = -1


@dataclass(frozen=True, slots=True)
class TerminationCondition:
    """A line that ends a rollout: the ego is beyond `progress` on a path.

    Attributes:
        line: (K, 2) the path [m].
        progress: Arc length on it [m].
        block: Roadblock in which the ego must be; -1 for any.
    """

    line: FloatArray
    progress: float
    block: int = -1

    def is_reached(self, road: VectorMap, x: float, y: float) -> bool:
        """Whether the ego's centre is beyond the line."""
        line = shapely.LineString(self.line)
        if not shapely.line_locate_point(line, shapely.Point(x, y)) > self.progress:
            return False
        return self.block < 0 or contains(road.blocks.polygons, self.block, x, y)


@dataclass(frozen=True, slots=True)
class RolloutEvents:
    """What an edit asks of a rollout.

    Attributes:
        base: Token of the recorded scenario.
        name: Name of the edit.
        digest: Digest of the edit.
        words: What was edited, one line each.
        tokens: Tokens of the tracks that the edit made or changed.
        behaviors: (N,) FOLLOW, STOPPED or CAUTIOUS of each track; LOGGED where it is not driven.
        yielding: How reactive agents treat the ego: ASSERTIVE, WARY, MIXED or DEFAULT as those of
            interPlan do, OFF as nuPlan's do.
        pedestrians: Pedestrians that move by themselves.
        termination: Where a rollout ends before its time; None where it does not.
        seed: Of what is drawn during a rollout.
        profile: `shiftsim`, or `interplan` where its oddities are kept.
        crossings: Pedestrians of interPlan.
        sorts: What a scenario of interPlan is about, such as `stopped_vehicle`; else empty.
        obstacles: (M, 2) where that is [m].
    """

    base: str
    name: str
    digest: str
    words: tuple[str, ...]
    tokens: tuple[str, ...]
    behaviors: IntArray
    yielding: int = OFF
    pedestrians: tuple[ScriptedPedestrian, ...] = ()
    termination: TerminationCondition | None = None
    seed: int = 0
    profile: str = "shiftsim"
    crossings: tuple[Crossing, ...] = ()
    sorts: str = ""
    obstacles: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def stopped(self) -> BoolArray:
        """(N,) tracks that stand whatever happens."""
        stands: BoolArray = self.behaviors == STOPPED
        return stands

    @property
    def has_pedestrians(self) -> bool:
        """Whether there are pedestrians that look for the ego."""
        return bool(self.pedestrians or self.crossings)
