"""The builder of edited scenarios: what an edit has made so far, and the scenario at its end.

Both profiles build with it: the tables of an edit (`shiftsim.edits.apply`) and interPlan's codes
(`shiftsim.edits.interplan.build`).
"""

import random
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from shiftsim.edits.places import EgoPath, ego_path, poses_along
from shiftsim.edits.spec import Edit, edited_id
from shiftsim.errors import ConfigError, listed
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.polylines import arc_lengths
from shiftsim.geometry.rings import convex_intersect
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.events import FOLLOW, RolloutEvents, TerminationCondition
from shiftsim.world.lanes import find_start
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, PACIFICA, VX, AgentKind, Tracks, center_poses

EGO_SIZE = np.array([PACIFICA.length, PACIFICA.width])


class ScenarioBuilder:
    """A scenario while it is edited."""

    def __init__(self, recorded: Scenario, edit: Edit, seed: int | str) -> None:
        """`seed` is that of everything that is drawn."""
        self.recorded = self.scenario = recorded  # the latter as edited so far, but for its tracks
        self.edit, self.draws = edit, random.Random(seed)
        self.tracks = recorded.tracks  # in arrays that may be written once they are copied
        self.behaviors: IntArray = np.full(recorded.tracks.num_tracks, FOLLOW, np.int64)
        self.touched: list[str] = []  # tokens of tracks that were made or changed
        self.termination: TerminationCondition | None = None  # where a rollout ends early
        self.now = int(recorded.iteration_rows[0])  # row of the first iteration
        self._count: dict[str, int] = {}

    def finish(self, scenario_type: str, yielding: int, **events: Any) -> Scenario:
        """The edited scenario; `events` are further fields of its `RolloutEvents`."""
        edit, tokens = self.edit, set(self.tracks.tokens)
        script = RolloutEvents(
            base=self.recorded.token,
            name=edit.name,
            digest=edit.digest,
            words=edit.words,
            tokens=tuple(token for token in self.touched if token in tokens),
            behaviors=self.behaviors,
            yielding=yielding,
            termination=self.termination,
            **events,
        )
        return replace(
            self.scenario,
            token=edited_id(self.recorded.token, edit),
            scenario_type=scenario_type,
            tracks=self.tracks,
            script=script,
        )

    @property
    def center(self) -> FloatArray:
        """(3,) centre of the ego at the first iteration."""
        return center_poses(self.scenario.ego[None, self.now, :3])[0]

    @cached_property
    def path(self) -> EgoPath:
        """The path that places are counted along; that of the recording, always."""
        return ego_path(self.recorded)

    @property
    def seconds(self) -> FloatArray:
        """(R,) times of the rows, from the first iteration on [s]."""
        times = self.scenario.time_us
        return (times - times[self.now]) * 1e-6

    def name(self, what: str) -> str:
        """A new token for a track."""
        self._count[what] = number = self._count.get(what, -1) + 1
        return f"{self.edit.name}.{what}{number}"

    def change(self, **values: Any) -> None:
        """Replace fields of the scenario."""
        self.scenario = replace(self.scenario, **values)

    def set_ego_speed(self, speed: float) -> None:
        """Change the ego's speed at the first iteration [m/s]."""
        ego = np.array(self.scenario.ego)
        ego[self.now, VX] = speed
        self.change(ego=ego)

    def which(self, kinds: Iterable[str], tokens: Iterable[str]) -> IntArray:
        """Indices of the tracks of these kinds and tokens, or a ConfigError; of all where empty."""
        wanted, codes = list(tokens), [AgentKind[kind.upper()] for kind in kinds]
        if lost := [token for token in wanted if token not in self.tracks.tokens]:
            there = self.tracks.valid[self.now]
            seen = [t for t, is_there in zip(self.tracks.tokens, there, strict=True) if is_there]
            what = f"there is no track {lost[0]!r}"
            raise ConfigError(what, hint=f"there are: {listed(seen) or 'none'}")
        chosen = np.ones(self.tracks.num_tracks, np.bool_)
        if wanted:
            chosen &= np.array([token in wanted for token in self.tracks.tokens], np.bool_)
        if codes:
            chosen &= np.isin(self.tracks.kinds, codes)
        return np.flatnonzero(chosen)

    def select(self, which: BoolArray | IntArray) -> None:
        """Leave out all tracks but these, or put them into this order."""
        self.tracks, self.behaviors = self.tracks.select(which), self.behaviors[which]

    def add(
        self,
        tokens: Sequence[str],
        kind: int,  # AgentKind code
        sizes: FloatArray,  # (N, 2) length, width [m]; or (2,) of all
        poses: FloatArray,  # (R, N, 3) of their centres; or (N, 3) at all times
        *,
        valid: BoolArray | bool = True,  # (R, N) when they are there
        velocities: FloatArray | float = 0.0,  # (R, N, 2) in the map frame [m/s]
        behaviors: IntArray | int = FOLLOW,  # (N,) as in `RolloutEvents`
    ) -> None:
        """Add N tracks of one kind."""
        shape = (len(self.scenario.time_us), len(tokens))
        blank = np.where(np.broadcast_to(valid, shape), 0.0, np.nan)[..., None]
        moves = velocities if kind <= LAST_AGENT_KIND else np.nan
        new = (~np.isnan(blank[..., 0]), poses + blank, moves + np.repeat(blank, 2, axis=2))
        pairs = zip(self.tracks.arrays, (*new, sizes + blank), strict=True)
        there, places, moves, boxes = (np.concatenate(pair, axis=1) for pair in pairs)
        kinds = np.append(self.tracks.kinds, np.full(len(tokens), kind, np.int64))
        names = (*self.tracks.tokens, *tokens)
        self.tracks = Tracks(there, places, moves, boxes, kinds, names)
        self.behaviors = np.append(self.behaviors, np.broadcast_to(behaviors, len(tokens)))
        # nuPlan rule 410: tracks are ordered by kind, within a kind as listed
        if (np.diff(kinds) < 0).any():
            self.select(np.argsort(kinds, kind="stable"))
        self.touched += tokens

    def require_free(self, poses: FloatArray, size: FloatArray, what: str) -> None:
        """A ConfigError where boxes at poses (N, 3) touch the ego or a track at the start."""
        now, tracks = self.now, self.tracks
        there = np.flatnonzero(tracks.valid[now])
        others = np.concatenate([self.center[None], tracks.poses[now, there]])
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
            words = f"{what} is on track {tracks.tokens[there[other - 1]]!r}"
            raise ConfigError(words, hint="choose another place, or remove that track first")

    def add_vehicle(
        self, token: str, pose: FloatArray, size: FloatArray, speed: float, behavior: int
    ) -> None:
        """Add a vehicle that drives from iteration 0 on, and came along its lane before."""
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
            [token],
            AgentKind.VEHICLE,
            size,
            poses[:, None],
            valid=seconds[:, None] <= 0.0,
            velocities=speed * np.stack([np.cos(headings), np.sin(headings)], -1)[:, None],
            behaviors=behavior,
        )
