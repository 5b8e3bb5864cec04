"""A scenario while it is edited: its arrays, writable, and what the edit has made so far."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.rings import convex_intersect
from shiftsim.world.script import FOLLOW, Finish, Walker
from shiftsim.world.state import (
    LAST_AGENT_KIND,
    PACIFICA,
    AgentKind,
    Tracks,
    center_poses,
)

if TYPE_CHECKING:
    from shiftsim.world.scenario import Scenario

EGO_SIZE = np.array([PACIFICA.length, PACIFICA.width])


@dataclass
class Draft:
    """A scenario while it is edited."""

    scenario: "Scenario"  # as recorded, but for what does not move
    joined: Tracks
    known: IntArray  # (N,) behaviours of these tracks, as in `Script`
    touched: list[str] = field(default_factory=list)  # tokens of tracks made or changed
    walkers: list[tuple[str, Walker]] = field(default_factory=list)  # with the token of their track
    finish: Finish | None = None
    waiting: list[tuple[Tracks, int]] = field(default_factory=list)  # new tracks, one each

    @property
    def tracks(self) -> Tracks:
        """All tracks; in arrays that may be written after `own`."""
        self._join()
        return self.joined

    @property
    def behaviors(self) -> IntArray:
        """(N,) behaviours of the tracks, as in `Script`."""
        self._join()
        return self.known

    def _join(self) -> None:
        """Put new tracks where they belong."""
        if not self.waiting:
            return
        parts = [self.joined, *(tracks for tracks, _ in self.waiting)]
        valid, poses, velocities, sizes = (
            np.concatenate([getattr(part, name) for part in parts], axis=1)
            for name in ("valid", "poses", "velocities", "sizes")
        )
        kinds = np.concatenate([part.kinds for part in parts])
        # nuPlan rule 410: tracks are ordered by kind, within a kind as listed
        order = np.argsort(kinds, kind="stable")
        tokens = tuple(token for part in parts for token in part.tokens)
        new = Tracks(valid, poses, velocities, sizes, kinds, tokens)
        self.joined = new.select(order)
        behaviors = np.array([behavior for _, behavior in self.waiting], np.int64)
        self.known = np.concatenate([self.known, behaviors])[order]
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
        self.joined, self.known = self.tracks.select(which), self.behaviors[which]

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
        velocity_of: AgentKind = LAST_AGENT_KIND,
    ) -> None:
        """Add a track: poses (R, 3) of its centre, velocities (R, 2), standing where None."""
        rows = len(self.scenario.time_us)
        there = np.ones(rows, np.bool_) if valid is None else valid
        moves = np.zeros((rows, 2)) if velocities is None else velocities
        if kind > velocity_of:
            moves = np.full((rows, 2), np.nan)
        blank = np.where(there, 0.0, np.nan)[:, None]
        new = Tracks(
            there[:, None],
            (poses + blank)[:, None],
            (moves + blank)[:, None],
            (size + blank)[:, None],
            np.array([kind], np.int64),
            (token,),
        )
        self.waiting.append((new, behavior))
        self.touched.append(token)

    def still(self, pose: FloatArray) -> FloatArray:
        """(R, 3) a pose in all rows."""
        return np.tile(pose, (len(self.scenario.time_us), 1))

    def require_free(self, pose: FloatArray, size: FloatArray, what: str) -> None:
        """Refuse a box that touches the ego or a track at the first iteration.

        Raises:
            ConfigError: It does.
        """
        box = boxes_to_corners(pose, size)
        ego = center_poses(self.scenario.ego[self.now : self.now + 1, :3])[0]
        if convex_intersect(box, boxes_to_corners(ego, EGO_SIZE)):
            raise ConfigError(f"{what} is on the ego", hint="choose a place farther ahead or aside")
        there = np.flatnonzero(self.tracks.valid[self.now])
        poses, sizes = self.tracks.poses[self.now, there], self.tracks.sizes[self.now, there]
        near = np.hypot(*(poses[:, :2] - pose[:2]).T) < np.hypot(*size) + np.hypot(*sizes.T)
        for track in there[near].tolist():
            other = boxes_to_corners(
                self.tracks.poses[self.now, track], self.tracks.sizes[self.now, track]
            )
            if convex_intersect(box, other):
                raise ConfigError(
                    f"{what} is on track {self.tracks.tokens[track]!r}",
                    hint="choose another place, or remove that track first",
                )


def begin(scenario: "Scenario") -> Draft:
    """A draft of a scenario in which nothing is changed yet."""
    tracks = scenario.tracks
    return Draft(scenario, tracks, np.full(tracks.num_tracks, FOLLOW, np.int64))
