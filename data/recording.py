"""What a reader hands to the store: a recording once, and scenarios as windows into it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks, TrafficLights


@dataclass(frozen=True)
class Recording:
    """Everything observed during one recorded drive, except the ego. R rows."""

    # unique in a store; a part of a longer log is named `<log>@<anything>`, and its scenarios carry
    # the name of the log alone
    log_name: str
    city: str  # map it was recorded on
    time_us: IntArray  # (R,) time stamps, never decreasing [us]
    # a track that serves as ego in some scenario is among them, and left out of that scenario
    tracks: Tracks
    lights: TrafficLights


@dataclass(frozen=True)
class EgoTrace:
    """The ego's own states over a span of a recording."""

    log_name: str  # the recording
    name: str  # `ego` for the recording vehicle, else the token of the track that serves as ego
    first_row: int  # of the recording, for the first state
    states: FloatArray  # (R', 11) columns of `state.STATE_COLUMNS`, one per row of the recording


@dataclass(frozen=True)
class Window:
    """One scenario: a span of a recording, seen from one ego."""

    token: str  # id of the scenario, unique in a store
    scenario_type: str  # its tag; `unknown` without one
    log_name: str  # the recording
    ego: str  # name of its `EgoTrace`
    first_row: int  # first row that is kept (history before iteration 0 included)
    last_row: int  # one past the last row that is kept
    iteration_rows: IntArray  # (T,) rows of the iterations, from the start of the recording
    row_step: int  # rows between iterations
    route: tuple[str, ...]  # roadblock ids
    mission_goal: FloatArray | None  # (3,) x [m], y [m], heading [rad]
    mapping: tuple[float, float, float]  # duration [s], offset [s], subsample ratio
    is_short: bool = False  # whether the recording ended before the duration did
    metadata: dict[str, object] = field(default_factory=dict)  # anything else, JSON values only


def scenario(
    recording: Recording,
    ego: EgoTrace,
    window: Window,
    road: VectorMap,
    *,
    offset: int = 0,
    is_chosen: bool = False,
) -> Scenario:
    """The scenario that a window shows. Its arrays are read-only.

    `recording` may be a span that holds the window and begins at row `offset` of the whole; with
    `is_chosen` it holds the tracks that the window shows, as `visible_tracks` gives them.
    """
    rows = slice(window.first_row - offset, window.last_row - offset)
    start = window.first_row - ego.first_row - offset
    count = window.last_row - window.first_row
    tracks = recording.tracks.rows(rows)
    return Scenario(
        token=window.token,
        scenario_type=window.scenario_type,
        log_name=recording.log_name.partition("@")[0],
        city=recording.city,
        map=road,
        time_us=recording.time_us[rows].copy(),
        ego=ego.states[start : start + count].copy(),
        tracks=tracks if is_chosen else visible_tracks(tracks, without=window.ego),
        traffic_lights=listed_lights(recording.lights.rows(rows)),
        iteration_rows=window.iteration_rows - window.first_row,
        row_step=window.row_step,
        route=window.route,
        mission_goal=None if window.mission_goal is None else window.mission_goal.copy(),
        mapping=window.mapping,
        is_short=window.is_short,
    )


def visible_tracks(tracks: Tracks, *, without: str) -> Tracks:
    """The tracks that occur in the rows given, in nuPlan's order, except the one named."""
    index = visible_columns(tracks.valid, tracks.kinds, tracks.tokens, without)
    seen = tracks.map_arrays(lambda array: array.take(index, axis=1))
    names = tuple(tracks.tokens[i] for i in index.tolist())
    return replace(seen, kinds=tracks.kinds[index], tokens=names)


def visible_columns(
    valid: BoolArray, kinds: IntArray, tokens: Sequence[str], without: str
) -> IntArray:
    """(N',) columns of the tracks of `valid` (R, N) that `visible_tracks` gives, in its order.

    nuPlan rule 410: every frame lists its tracks by type, and within a type as the log does. The
    order depends only on the rows given, so that a window of a longer recording is ordered as if it
    had been read alone.
    """
    first = valid.argmax(axis=0)
    seen = valid[first, np.arange(len(first))]
    if without in tokens:
        seen[tokens.index(without)] = False
    index = np.flatnonzero(seen)
    valid, kinds, first = valid[:, index], kinds[index], first[index]
    order = np.lexsort((first, kinds))
    if (order == kinds.argsort(kind="stable")).all():
        return index[order]  # the oldest of a kind come first: as they are listed, whoever is there
    before = np.zeros((len(kinds), len(kinds)), np.bool_)
    for kind in np.unique(kinds).tolist():
        same = np.flatnonzero(kinds == kind)
        row, column = np.nonzero(valid[:, same])
        follows = row[1:] == row[:-1]
        before[same[column[:-1][follows]], same[column[1:][follows]]] = True
    return index[sort_tracks(before, kinds, first)]


def listed_lights(lights: TrafficLights) -> TrafficLights:
    """The connectors listed in the rows given, ordered by first appearance."""
    if not lights.status.size:
        return TrafficLights.empty(len(lights.status))
    listed = lights.status >= 0
    seen = np.flatnonzero(listed.any(axis=0))
    order = seen[np.argsort(listed.argmax(axis=0)[seen], kind="stable")]
    names = tuple(lights.connector_ids[i] for i in order.tolist())
    return TrafficLights(names, np.ascontiguousarray(lights.status[:, order]))


def sort_tracks(before: BoolArray, kinds: IntArray, first: IntArray) -> IntArray:
    """(N,) indices of tracks by kind, then as the frames list them, then by first appearance.

    `before` (N, N) tells whether one directly precedes another in a frame, `first` (N,) the frame
    in which each appears first, which decides where frames contradict each other.
    """
    order = np.lexsort((first, kinds))
    _move_behind(np.ascontiguousarray(before), kinds, order)
    return order


@kernel
def _move_behind(before: BoolArray, kinds: IntArray, order: IntArray) -> None:
    """Sort tracks that are ordered by kind and age such that each stands behind those before it."""
    num = len(kinds)
    waiting = np.zeros(num, np.int64)
    for track in range(num):
        waiting += before[track]
    for place in range(num):
        best = place  # the oldest where all of its kind wait
        for other in range(place, num):
            if kinds[order[other]] != kinds[order[place]]:
                break
            if waiting[order[other]] <= 0:
                best = other
                break
        chosen = order[best]
        for other in range(best, place, -1):
            order[other] = order[other - 1]
        order[place] = chosen
        waiting -= before[chosen]
