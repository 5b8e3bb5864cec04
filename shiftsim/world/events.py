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
    """A pedestrian that sets off once, and stands at the end of its way."""

    track: int  # its track
    start: FloatArray  # (3,) where it stands first: x [m], y [m], heading [rad]
    end: FloatArray  # (2,) where it goes [m]
    size: FloatArray  # (2,) length, width [m]
    speed: float  # how fast [m/s]
    ego_within: float  # distance of the ego's centre that sets it off [m]
    visible: bool  # whether it is there before

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
    """A pedestrian of interPlan: not there until it sets off, and slower the later it does."""

    token: str  # its token
    start: FloatArray  # (3,) where it sets off: x [m], y [m], heading [rad]
    end: FloatArray  # (2,) where it goes [m]
    iteration: int  # when it sets off; 0 where the ego decides
    track: int = -1  # its track


@dataclass(frozen=True, slots=True)
class TerminationCondition:
    """A line that ends a rollout: the ego is beyond `progress` on a path."""

    line: FloatArray  # (K, 2) the path [m]
    progress: float  # arc length on it [m]
    block: int = -1  # roadblock in which the ego must be; -1 for any

    def is_reached(self, road: VectorMap, x: float, y: float) -> bool:
        """Whether the ego's centre is beyond the line."""
        line = shapely.LineString(self.line)
        if not shapely.line_locate_point(line, shapely.Point(x, y)) > self.progress:
            return False
        return self.block < 0 or contains(road.blocks.polygons, self.block, x, y)


@dataclass(frozen=True, slots=True)
class RolloutEvents:
    """What an edit asks of a rollout."""

    base: str  # token of the recorded scenario
    name: str  # name of the edit
    digest: str  # digest of the edit
    words: tuple[str, ...]  # what was edited, one line each
    tokens: tuple[str, ...]  # tracks that the edit made or changed
    behaviors: IntArray  # (N,) FOLLOW, STOPPED or CAUTIOUS; LOGGED where a track is not driven
    # how reactive agents treat the ego: ASSERTIVE, WARY, MIXED or DEFAULT as those of interPlan do,
    # OFF as nuPlan's do
    yielding: int = OFF
    pedestrians: tuple[ScriptedPedestrian, ...] = ()  # those that move by themselves
    termination: TerminationCondition | None = None  # where a rollout ends before its time
    seed: int = 0  # of what is drawn during a rollout
    profile: str = "shiftsim"  # or `interplan`, where its oddities are kept
    crossings: tuple[Crossing, ...] = ()  # pedestrians of interPlan
    sorts: str = ""  # what a scenario of interPlan is about, such as `stopped_vehicle`; else empty
    obstacles: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # (M, 2) of that [m]

    @property
    def stopped(self) -> BoolArray:
        """(N,) tracks that stand whatever happens."""
        return self.behaviors == STOPPED

    @property
    def has_pedestrians(self) -> bool:
        """Whether there are pedestrians that look for the ego."""
        return bool(self.pedestrians or self.crossings)
