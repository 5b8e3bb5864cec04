"""Do the boxes of a recording move as their velocities, headings and sizes say?"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from shiftsim.data.readers.motion import (
    MAX_SHARE,
    contradiction,
    fitted_velocities,
)
from shiftsim.data.store.tracks import StoredRecording
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.state import HEADING, LAST_AGENT_KIND, VX, VY, AgentKind

_US = 1e-6  # s
_ROW_S = 0.05
_FAST = 2.0  # m/s
_MAX_TURNED = 0.5  # rad, median angle between heading and motion of a vehicle
_LEAST_ROWS = 20  # of motion that say something of a heading
_UNITS = "check the unit and the axes of velocities and positions where they came from"


class Finding(NamedTuple):
    """One thing that is wrong with a recording or an ego."""

    kind: str  # short name of what was looked at
    what: str  # value and limit
    remedy: str
    is_error: bool = True  # else it is only unusual


class Boxes(NamedTuple):
    """All boxes of a recording, sorted by track and row. A boxes."""

    row: IntArray  # (A,)
    track: IntArray  # (A,)
    poses: FloatArray  # (A, 3)
    velocities: FloatArray  # (A, 2)


def read_boxes(recording: StoredRecording) -> Boxes:
    """All boxes of a recording, those that occur twice, too."""
    row, track, motion = recording.boxes()
    order = np.lexsort((row, track))
    return Boxes(row[order], track[order], motion[order, :3], motion[order, 3:])


def check_boxes(recording: StoredRecording, boxes: Boxes, time_us: IntArray) -> Iterator[Finding]:
    """What is wrong with the boxes of a recording; `time_us` (R,) are its time stamps."""
    twice = np.flatnonzero((np.diff(boxes.row) == 0) & (np.diff(boxes.track) == 0))
    if len(twice):
        name = recording.tokens[boxes.track[twice[0]]]
        yield Finding(
            "repeated rows",
            f"track {name!r} has two boxes in row {boxes.row[twice[0]]} ({len(twice)} such boxes)",
            "leave repeated rows out, and give every object an id of its own",
        )
        return
    good = np.isfinite(boxes.poses).all(axis=1) & np.isfinite(boxes.velocities).all(axis=1)
    good &= (recording.kinds <= LAST_AGENT_KIND)[boxes.track]
    good &= (boxes.row >= 0) & (boxes.row < len(time_us))
    if not good.any() or (np.diff(time_us) <= 0).any():
        return
    names, track = np.unique(boxes.track[good], return_inverse=True)
    time = (time_us[boxes.row[good]] - time_us[0]) * _US
    derived = fitted_velocities(boxes.poses[good, :2], time, track, _ROW_S)
    is_wrong, share = contradiction(boxes.velocities[good], derived, time, track)
    if is_wrong.any():
        worst = int(np.argmax(np.where(is_wrong, share, -1.0)))
        yield Finding(
            "velocity",
            f"the velocity of {is_wrong.sum()} of {len(names)} tracks contradicts their positions,"
            f" most that of track {recording.tokens[names[worst]]!r}, by {share[worst]:.0%},"
            f" at most {MAX_SHARE:.0%}",
            _UNITS,
        )
    moving = np.hypot(derived[:, 0], derived[:, 1]) > _FAST
    moving &= (recording.kinds == AgentKind.VEHICLE)[names[track]]
    yield from _check_headings(
        boxes.poses[good, 2][moving], derived[moving], track[moving], recording, names
    )


def _check_headings(
    headings: FloatArray,
    velocities: FloatArray,
    track: IntArray,
    recording: StoredRecording,
    names: IntArray,
) -> Iterator[Finding]:
    """Whether most vehicles point somewhere else than they move; some do go backwards."""
    turned = np.abs(wrap_angles(headings - np.arctan2(velocities[:, 1], velocities[:, 0])))
    rows = np.bincount(track, minlength=len(names))
    away = np.bincount(track, turned > _MAX_TURNED, minlength=len(names))
    known = rows >= _LEAST_ROWS
    wrong = known & (away > 0.5 * rows)
    if wrong.sum() > 0.5 * known.sum():
        first = int(np.flatnonzero(wrong)[0])
        yield Finding(
            "heading",
            f"{wrong.sum()} of {known.sum()} moving vehicles point more than {_MAX_TURNED:g} rad"
            f" away from their motion, such as track {recording.tokens[names[first]]!r}",
            "check the unit (radians), zero (x axis) and sense (counter-clockwise) of headings",
        )


def check_ego(states: FloatArray, time_us: IntArray) -> Iterator[Finding]:
    """What is wrong with the states (R, 11) of an ego at times (R,)."""
    if not np.isfinite(states).all() or (np.diff(time_us) <= 0).any():
        return
    cos, sin = np.cos(states[:, HEADING]), np.sin(states[:, HEADING])
    vx, vy = states[:, VX], states[:, VY]
    stored = np.column_stack([vx * cos - vy * sin, vx * sin + vy * cos])
    time, track = (time_us - time_us[0]) * _US, np.zeros(len(states), np.int64)
    derived = fitted_velocities(states[:, :2], time, track, _ROW_S)
    is_wrong, share = contradiction(stored, derived, time, track)
    if is_wrong[0]:
        yield Finding(
            "velocity",
            f"the velocity of the ego contradicts its positions by {share[0]:.0%}, at most"
            f" {MAX_SHARE:.0%}",
            f"{_UNITS}: the ego's are along and across the vehicle, at the rear axle",
        )
