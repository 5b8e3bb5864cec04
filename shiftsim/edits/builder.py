"""The builder of edited scenarios: writable arrays, and what the edit has made so far."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.polylines import arc_lengths
from shiftsim.geometry.rings import convex_intersect
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.events import FOLLOW, STOPPED, ScriptedPedestrian, TerminationCondition
from shiftsim.world.lanes import find_start
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import (
    LAST_AGENT_KIND,
    PACIFICA,
    AgentKind,
    Tracks,
    center_poses,
)

EGO_SIZE = np.array([PACIFICA.length, PACIFICA.width])


@dataclass
class ScenarioBuilder:
    """A scenario while it is edited."""

    scenario: Scenario  # as recorded, but for what does not move
    joined: Tracks
    joined_behaviors: IntArray  # (N,) behaviours of these tracks, as in `RolloutEvents`
    touched: list[str] = field(default_factory=list)  # tokens of tracks made or changed
    # with the token of their track
    pedestrians: list[tuple[str, ScriptedPedestrian]] = field(default_factory=list)
    termination: TerminationCondition | None = None
    waiting: list[tuple[Tracks, Sequence[int]]] = field(
        default_factory=list
    )  # new, with their behaviours

    @property
    def tracks(self) -> Tracks:
        """All tracks; in arrays that may be written after `own`."""
        self._join()
        return self.joined

    @property
    def behaviors(self) -> IntArray:
        """(N,) behaviours of the tracks, as in `RolloutEvents`."""
        self._join()
        return self.joined_behaviors

    def _join(self) -> None:
        """Put new tracks where they belong."""
        if not self.waiting:
            return
        parts = [self.joined, *(tracks for tracks, _ in self.waiting)]
        kinds = np.concatenate([part.kinds for part in parts])
        # nuPlan rule 410: tracks are ordered by kind, within a kind as listed
        order = np.argsort(kinds, kind="stable")
        part_of = np.repeat(np.arange(len(parts)), [part.num_tracks for part in parts])[order]
        ends = np.flatnonzero((np.diff(order) != 1) | (np.diff(part_of) != 0)) + 1
        starts = np.cumsum([0, *(part.num_tracks for part in parts)])
        runs = []  # what stays together is copied at once
        for run, number in zip(np.split(order, ends), part_of[[0, *ends]].tolist(), strict=True):
            first = int(run[0] - starts[number])
            runs.append((parts[number], slice(first, first + len(run))))
        valid, poses, velocities, sizes = (
            np.concatenate([getattr(part, name)[:, where] for part, where in runs], axis=1)
            for name in ("valid", "poses", "velocities", "sizes")
        )
        tokens = tuple(token for part, where in runs for token in part.tokens[where])
        self.joined = Tracks(valid, poses, velocities, sizes, kinds[order], tokens)
        behaviors = [self.joined_behaviors, *(np.array(new, np.int64) for _, new in self.waiting)]
        self.joined_behaviors = np.concatenate(behaviors)[order]
        self.waiting = []

    @property
    def now(self) -> int:
        """Row of the first iteration."""
        return int(self.scenario.iteration_rows[0])

    @property
    def seconds(self) -> FloatArray:
        """(R,) times of the rows, from the first iteration on [s]."""
        times = self.scenario.time_us
        return (times - times[self.now]) * 1e-6

    def own(self) -> None:
        """Copy the arrays of the tracks, so that they may be written."""
        self.joined = self.tracks.rows(np.arange(len(self.scenario.time_us)))

    def change(self, **values: object) -> None:
        """Replace fields of the scenario."""
        self.scenario = replace(self.scenario, **values)  # type: ignore[arg-type]

    def which(self, kinds: Iterable[str], tokens: Iterable[str]) -> IntArray:
        """Indices of the tracks of these kinds and of these tokens; of all where empty.

        Raises:
            ConfigError: There is no such track.
        """
        wanted, codes = list(tokens), [AgentKind[kind.upper()] for kind in kinds]
        if lost := [token for token in wanted if token not in self.tracks.tokens]:
            there = self.tracks.valid[self.now]
            seen = [t for t, is_there in zip(self.tracks.tokens, there, strict=True) if is_there]
            raise ConfigError(
                f"there is no track {lost[0]!r}", hint=f"there are: {', '.join(seen[:8]) or 'none'}"
            )
        chosen = np.ones(self.tracks.num_tracks, np.bool_)
        if wanted:
            chosen &= np.array([token in wanted for token in self.tracks.tokens], np.bool_)
        if codes:
            chosen &= np.isin(self.tracks.kinds, codes)
        return np.flatnonzero(chosen)

    def keep(self, which: BoolArray) -> None:
        """Keep some of the tracks (a mask) only."""
        self.joined, self.joined_behaviors = self.tracks.select(which), self.behaviors[which]

    def add(
        self,
        token: str,
        kind: int,
        size: FloatArray,
        poses: FloatArray,
        *,
        valid: BoolArray | None = None,
        velocities: FloatArray | None = None,
        behavior: int = FOLLOW,
    ) -> None:
        """Add a track: poses (R, 3) of its centre, velocities (R, 2), standing where None."""
        rows = len(self.scenario.time_us)
        there = np.ones(rows, np.bool_) if valid is None else valid
        moves = np.zeros((rows, 2)) if velocities is None else velocities
        arrays = (poses[:, None], there[:, None], moves[:, None])
        self.add_all([token], kind, size[None], *arrays, behaviors=[behavior])

    def add_standing(
        self, tokens: Sequence[str], kind: int, size: FloatArray, poses: FloatArray
    ) -> None:
        """Add N tracks of a size (2,) that stand at poses (N, 3) all the time."""
        shape = (len(self.scenario.time_us), len(tokens))
        there, places = np.ones(shape, np.bool_), np.broadcast_to(poses, (*shape, 3))
        sizes, moves = np.broadcast_to(size, (len(tokens), 2)), np.zeros((*shape, 2))
        behaviors = [STOPPED] * len(tokens)
        self.add_all(tokens, kind, sizes, places, there, moves, behaviors=behaviors)

    def add_all(
        self,
        tokens: Sequence[str],
        kind: int,
        sizes: FloatArray,
        poses: FloatArray,
        valid: BoolArray,
        velocities: FloatArray,
        *,
        behaviors: Sequence[int],
    ) -> None:
        """Add N tracks: sizes (N, 2), poses (R, N, 3), valid (R, N), velocities (R, N, 2)."""
        blank = np.where(valid, 0.0, np.nan)[..., None]
        new = Tracks(
            valid,
            poses + blank,
            (velocities if kind <= LAST_AGENT_KIND else np.nan) + np.repeat(blank, 2, axis=2),
            sizes + blank,
            np.full(len(tokens), kind, np.int64),
            tuple(tokens),
        )
        self.waiting.append((new, behaviors))
        self.touched += tokens

    def still(self, pose: FloatArray) -> FloatArray:
        """(R, 3) a pose in all rows."""
        return np.tile(pose, (len(self.scenario.time_us), 1))

    def require_free(self, poses: FloatArray, size: FloatArray, what: str) -> None:
        """Refuse boxes at poses (N, 3) that touch the ego or a track at the first iteration.

        Raises:
            ConfigError: One does.
        """
        now, tracks = self.now, self.tracks
        ego = center_poses(self.scenario.ego[now : now + 1, :3])
        there = np.flatnonzero(tracks.valid[now])
        others = np.concatenate([ego, tracks.poses[now, there]])
        sizes = np.concatenate([EGO_SIZE[None], tracks.sizes[now, there]])
        boxes = boxes_to_corners(poses, np.broadcast_to(size, (len(poses), 2)))
        reach = np.hypot(*size) + np.hypot(sizes[:, 0], sizes[:, 1])
        apart = others[:, None, :2] - poses[:, :2]
        near = np.hypot(apart[..., 0], apart[..., 1]) < reach[:, None]
        for other, number in np.argwhere(near).tolist():
            if not convex_intersect(boxes[number], boxes_to_corners(others[other], sizes[other])):
                continue
            if other == 0:
                hint = "choose a place farther ahead or aside"
                raise ConfigError(f"{what} is on the ego", hint=hint)
            raise ConfigError(
                f"{what} is on track {tracks.tokens[there[other - 1]]!r}",
                hint="choose another place, or remove that track first",
            )

    def add_vehicle(
        self, token: str, pose: FloatArray, size: FloatArray, speed: float, behavior: int
    ) -> None:
        """Add a vehicle that drives from the first iteration on; until then it came along its lane.

        Raises:
            ConfigError: It is on no lane, or on something.
        """
        road = self.scenario.map
        start = find_start(road, pose)
        if start is None:
            raise ConfigError(
                f"spawned vehicle at ({pose[0]:.1f}, {pose[1]:.1f}) is on no lane, so it cannot "
                "drive",
                hint='put it on a lane, or give behavior = "stopped"',
            )
        self.require_free(start.pose[None], size, "spawned vehicle")
        seconds, lanes, driven = self.seconds, [start.edge], start.progress
        while driven < -seconds[0] * speed:
            before = road.incoming.at(lanes[-1]).tolist()
            if not before or before[0] in lanes:
                break
            lanes.append(before[0])
            driven += road.baselines.length(before[0])
        lines = [road.baselines.at(edge) for edge in reversed(lanes)]
        xy = np.concatenate([lines[0], *(line[1:] for line in lines[1:])])
        arc = arc_lengths(xy, np.array([0, len(xy)]))
        along = start.progress + np.minimum(seconds, 0.0) * speed
        poses = poses_along(xy, arc, along + arc[-1] - road.baselines.length(start.edge))
        headings = poses[:, 2]
        self.add(
            token,
            AgentKind.VEHICLE,
            size,
            poses,
            valid=seconds <= 0.0,
            velocities=speed * np.stack([np.cos(headings), np.sin(headings)], -1),
            behavior=behavior,
        )


def poses_along(xy: FloatArray, arc: FloatArray, along: FloatArray) -> FloatArray:
    """(N, 3) poses at arc lengths (N,) of a line with vertices (K, 2) and arc lengths (K,) [m]."""
    steps = np.diff(xy, axis=0)
    segment = np.clip(np.searchsorted(arc, along, side="right") - 1, 0, len(steps) - 1)
    x, y = (np.interp(along, arc, xy[:, column]) for column in (0, 1))
    return np.column_stack([x, y, np.arctan2(steps[segment, 1], steps[segment, 0])])


def begin(scenario: Scenario) -> ScenarioBuilder:
    """A builder of a scenario in which nothing is changed yet."""
    tracks = scenario.tracks
    return ScenarioBuilder(scenario, tracks, np.full(tracks.num_tracks, FOLLOW, np.int64))
