"""Poses that were driven elsewhere, as a rollout of a scenario: checked, sampled, with states.

The closed-loop metrics read poses, velocity, acceleration and yaw rates at the iterations of the
scenario. What was not given is derived from the poses, by the Savitzky-Golay filters of nuPlan's
comfort metrics. What cannot be right is refused, with the row and the number that show it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics.comfort import MIN_SAMPLES, derived_states
from shiftsim.sim.log import SimulationLog, as_recorded
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import (
    AX,
    AY,
    HEADING,
    LAST_AGENT_KIND,
    PACIFICA,
    STATE_COLUMNS,
    VX,
    VY,
    YAW_ACCEL,
    YAW_RATE,
    Tracks,
    center_poses,
    rear_poses,
)

REAR_AXLE, CENTER = POINTS = ("rear_axle", "center")
NEEDS_BOXES = ("no_ego_at_fault_collisions", "time_to_collision_within_bound")
DERIVED = (VX, VY, AX, AY, YAW_RATE, YAW_ACCEL)  # what metrics read beside poses
_EXACT, _NEAR = 1_000, 25_000  # us from an iteration: taken as it is, and interpolated
_LONGEST_STEP = 150_000  # us
_SAME_START = (0.05, 0.01)  # m, rad from the recorded pose at iteration 0
_OTHER_MAP = 50.0  # m from it
_STANDING = 1e-3  # m per iteration
_MAX_STEP = (10.0, 1.0)  # m, rad in 0.1 s
_MAX_HEADING = 7.0  # rad
_SPACING = 0.02  # m between neighbouring numbers of single precision
_CONTRADICTION, _IN_A_ROW = 0.5, 3  # m/s between velocity and positions, and samples
_ON_EGO = (0.5, 0.1)  # m, rad between a box and the ego


class Boxes(NamedTuple):
    """The others at F times of their own."""

    time_us: IntArray  # (F,) increasing [us]
    tracks: Tracks  # over the F times; velocities of agents may be NaN


@dataclass(frozen=True, slots=True)
class Driven:
    """What somebody gives of one rollout. R samples."""

    where: str  # the file, for messages
    time_us: IntArray  # (R,) time stamps of the recording, or from 0 on [us]
    states: FloatArray  # (R, 11) ego; columns beside the pose are NaN where not given
    rows: IntArray  # (R,) rows of the file, from 0 on
    boxes: Boxes | None = None  # the others, where they are given
    fields: Mapping[str, Any] = field(default_factory=dict)  # (R, …) more of `SimulationLog`
    remarks: tuple[str, ...] = ()  # what a reader of the score must know

    def error(self, row: int, fact: str, hint: str) -> DataError:
        """The error that a sample shows."""
        return DataError(f"{self.where}, row {self.rows[row]}: {fact}", hint)


class Rollout(NamedTuple):
    """A rollout that can be scored."""

    log: SimulationLog
    undefined: tuple[str, ...]  # metrics that cannot be known
    remarks: tuple[str, ...]  # what a reader of the score must know


class _Samples(NamedTuple):
    """Where K times lie among F others."""

    index: IntArray  # (K,) the nearest time where it is near enough, else the one before
    weight: FloatArray  # (K,) of the time after `index`; 0 where the nearest is taken as it is
    distance: IntArray  # (K,) to the nearest [us]


def rollout_of(
    driven: Driven,
    scenario: Scenario,
    *,
    point: str = REAR_AXLE,
    recorded: bool = False,
    partial: bool = False,
) -> Rollout:
    """The rollout that poses in a scenario are.

    Args:
        driven: The poses, with states and boxes as far as they are given.
        scenario: Where they were driven.
        point: Which of `POINTS` the poses are of.
        recorded: Whether the others did what was recorded; else there are those of `driven` alone.
        partial: Whether it may end early: the expert then ends as well.

    Raises:
        DataError: Something cannot be right; the message names the row.
    """
    check_poses(driven)
    states = np.array(driven.states)
    if point == CENTER:
        states[:, :3] = rear_poses(states[:, :3])
    time_us = _on_the_clock(driven, scenario, states[:, :3], point)
    times = scenario.iteration_times[:-1]
    reached = int(np.count_nonzero(times <= time_us[-1] + _NEAR))
    remarks = list(driven.remarks)
    if reached < len(times):
        _refuse_short(driven, times, reached, partial=partial)
        remarks.append("partial: ends before the scenario, progress is of the time driven")
        scenario = replace(scenario, iteration_rows=scenario.iteration_rows[: reached + 1])
        times = times[:reached]
    elif time_us[-1] > times[-1] + _NEAR:
        remarks.append("cut at the end of the scenario")
    samples = _locate(time_us, times)
    _refuse_far(driven, samples)
    ego = _interpolated(states, samples)
    if samples.weight.any():
        ego[:, 3:] = np.nan
        remarks.append("poses interpolated to the iterations")
    _check_start(driven, samples.index[0], ego[0], scenario.expert[0], point)
    remarks += _complete(ego, times, driven, samples)
    log = replace(
        as_recorded(scenario),
        ego=ego,
        **{name: values[samples.index] for name, values in driven.fields.items()},
    )
    if driven.boxes is not None:
        tracks, more = _tracks_at(driven, times, time_us[0] - driven.time_us[0], log)
        return Rollout(replace(log, tracks=tracks), (), (*remarks, *more))
    if recorded:
        return Rollout(log, (), (*remarks, "others replayed from the recording"))
    log = replace(log, tracks=Tracks.empty(len(times)))
    return Rollout(log, NEEDS_BOXES, (*remarks, "others not given: collisions, TTC, CLS undefined"))


def check_poses(driven: Driven) -> None:
    """Refuse rows that cannot be right, whatever the scenario.

    Raises:
        DataError: A number is missing, or time stamps or poses cannot be right.
    """
    time_us, states = driven.time_us, driven.states
    if len(time_us) < MIN_SAMPLES:
        what = f"{len(time_us)} samples; the metrics need {MIN_SAMPLES}"
        raise driven.error(0, what, "give samples every 0.1 s")
    is_given = ~np.isnan(states).all(axis=0)
    is_given[:3] = True
    bad = np.argwhere(~np.isfinite(states) & is_given)
    if len(bad):
        row, column = bad[0].tolist()
        raise driven.error(
            row,
            f"{STATE_COLUMNS[column]} is {states[row, column]}",
            "give finite numbers; leave a column out, or empty for the whole rollout",
        )
    steps = np.diff(time_us)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        same = "the same time as" if steps[row - 1] == 0 else "before"
        raise driven.error(
            row,
            f"its time {time_us[row]} us is {same} that of the row before"
            f"{'' if steps[row - 1] == 0 else f', {time_us[row - 1]} us'}",
            "sort the rows by time, one per time; nuPlan has no metrics where two times are equal",
        )
    if (steps > _LONGEST_STEP).any():
        row = int(np.argmax(steps > _LONGEST_STEP)) + 1
        what = f"{steps[row - 1] * 1e-6:.3f} s after the row before"
        raise driven.error(row, what, "give samples every 0.1 s")
    _check_headings(driven)
    _check_precision(driven)
    seconds = np.maximum(steps, 100_000) * 1e-5  # in units of 0.1 s
    moved = np.hypot(*np.diff(states[:, :2], axis=0).T)
    turned = np.abs(wrap_angles(np.diff(states[:, HEADING])))
    jumps = (moved > _MAX_STEP[0] * seconds) | (turned > _MAX_STEP[1] * seconds)
    if jumps.any():
        row = int(np.argmax(jumps)) + 1
        raise driven.error(
            row,
            f"{moved[row - 1]:.2f} m and {turned[row - 1]:.2f} rad from the row before, in "
            f"{steps[row - 1] * 1e-6:.3f} s",
            "a vehicle does not jump: check units, and that the rows are of one rollout",
        )


def _check_headings(driven: Driven) -> None:
    headings = driven.states[:, HEADING]
    steps = np.abs(np.diff(headings))
    # a step of a whole turn is one between -pi and pi
    is_jump = (steps > 5.0) & (steps < 180.0) & (np.abs(steps - 2.0 * np.pi) > 1.0)
    is_odd = (np.abs(headings) > _MAX_HEADING) | np.append(False, is_jump)
    if is_odd.any():
        row = int(np.argmax(is_odd))
        what = f"heading {headings[row]:.6g} is no angle in radians: degrees?"
        raise driven.error(row, what, "give radians, counter-clockwise from x, within ±pi")


def _check_precision(driven: Driven) -> None:
    for axis, name in enumerate("xy"):
        values = driven.states[:, axis]
        single = values.astype(np.float32)
        spacing = float(np.spacing(np.abs(single).max()))
        if spacing > _SPACING and np.ptp(values) > 0.0 and (values == single).all():
            raise driven.error(
                0,
                f"{name} {values[0]:.10g} and all after it went through single precision, which "
                f"has steps of {spacing:g} m here",
                "write float64: speeds and accelerations of such positions mean nothing",
            )


def _on_the_clock(driven: Driven, scenario: Scenario, poses: FloatArray, point: str) -> IntArray:
    """(R,) time stamps of the recording; times from 0 on begin at iteration 0."""
    time_us, start = driven.time_us, int(scenario.iteration_times[0])
    if abs(time_us[0]) > _EXACT:
        return time_us
    gap, turn = _apart(poses[0], scenario.expert[0])
    if gap <= _SAME_START[0] and turn <= _SAME_START[1]:
        return time_us - time_us[0] + start
    if time_us[-1] >= start:  # the recording counts from 0 as well
        return time_us
    _check_start(driven, 0, poses[0], scenario.expert[0], point)
    raise driven.error(
        0,
        f"times from 0 on, but the first pose is {gap:.2f} m and {turn:.3f} rad from where the "
        "recording begins",
        "begin at the recorded pose of iteration 0, as nuPlan does, or give time_us of the log",
    )


def _apart(pose: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    turn = wrap_angles(np.array([pose[HEADING] - other[HEADING]]))
    return float(np.hypot(*(pose[:2] - other[:2]))), float(np.abs(turn)[0])


def _check_start(
    driven: Driven, row: int, pose: FloatArray, expert: FloatArray, point: str
) -> None:
    """Refuse a pose (3,) at iteration 0 that shows another map, point or unit."""
    gap, turn = _apart(pose, expert)
    x, y = driven.states[row, :2]
    if gap > _OTHER_MAP:
        raise driven.error(
            row,
            f"the pose at ({x:.10g}, {y:.10g}) is {gap:.4g} m from the recorded one at iteration "
            f"0, ({expert[0]:.10g}, {expert[1]:.10g})",
            "give metres in the frame of the store's map: no local frame, no latitude, no origin",
        )
    along, across = _in_frame((pose[:2] - expert[:2])[None], expert[HEADING])[0]
    offset = PACIFICA.rear_axle_to_center * (1.0 if point == REAR_AXLE else -1.0)
    if abs(along - offset) < _SAME_START[0] and abs(across) < _SAME_START[0]:
        other = CENTER if point == REAR_AXLE else REAR_AXLE
        raise driven.error(
            row,
            f"at iteration 0 the pose is {abs(along):.3f} m {'ahead of' if along > 0 else 'behind'}"
            f" the recorded rear axle: it is of the {other.replace('_', ' ')}",
            f"--point {other}",
        )
    _, in_degrees = _apart(np.array([0.0, 0.0, np.radians(pose[HEADING])]), [0, 0, *expert[2:3]])
    if turn > 0.1 and in_degrees < 0.01 and gap < _SAME_START[0]:
        what = f"heading {pose[HEADING]:.4g} is that of the recording in degrees"
        raise driven.error(row, what, "give radians, counter-clockwise from x, within ±pi")


def _refuse_short(driven: Driven, times: IntArray, reached: int, *, partial: bool) -> None:
    last, span = len(driven.rows) - 1, (times[-1] - times[0]) * 1e-6
    if reached == 0:
        raise driven.error(
            last,
            f"its time {driven.time_us[-1]} us is before the scenario begins, {times[0]} us",
            "give time stamps of the log in microseconds, or times from 0 on",
        )
    if not partial or reached < MIN_SAMPLES:
        raise driven.error(
            last,
            f"the rollout ends {(times[reached - 1] - times[0]) * 1e-6:.1f} s after iteration 0, "
            f"the scenario at {span:.1f} s",
            f"drive it to the end; --partial scores what there is, from {MIN_SAMPLES} samples on, "
            "and says so",
        )


def _refuse_far(driven: Driven, samples: _Samples) -> None:
    is_far = samples.distance > _NEAR
    if is_far.any():
        step = int(np.argmax(is_far))
        raise driven.error(
            int(samples.index[step]),
            f"no sample within {_NEAR // 1000} ms of iteration {step}, the nearest is "
            f"{samples.distance[step] * 1e-3:.1f} ms away",
            "give a sample for each iteration: 10 Hz in step with the recording, or 20 Hz and more",
        )


def _locate(time_us: IntArray, wanted: IntArray) -> _Samples:
    """Where times (K,) lie among others (F,)."""
    after = np.clip(np.searchsorted(time_us, wanted), 1, max(1, len(time_us) - 1))
    after = np.minimum(after, len(time_us) - 1)
    before = np.maximum(after - 1, 0)
    is_before = wanted - time_us[before] <= time_us[after] - wanted
    nearest = np.where(is_before, before, after)
    distance = np.abs(time_us[nearest] - wanted)
    step = np.maximum(time_us[after] - time_us[before], 1)
    is_exact = distance <= _EXACT
    weight = np.where(is_exact, 0.0, (wanted - time_us[before]) / step)
    return _Samples(np.where(is_exact, nearest, before), weight, distance)


def _interpolated(states: FloatArray, samples: _Samples) -> FloatArray:
    """(K, …) of (R, …), whose last axis begins with a pose; headings turn the short way."""
    index, weight = samples.index, samples.weight
    out = np.array(states[index])
    is_wound = np.abs(out[..., HEADING]) > np.pi  # others keep all their digits
    out[is_wound, HEADING] = wrap_angles(out[is_wound, HEADING])
    between = np.flatnonzero(weight)
    if len(between):
        first, second = states[index[between]], states[index[between] + 1]
        change = second - first
        change[..., HEADING] = wrap_angles(change[..., HEADING])
        shape = (-1, *[1] * (states.ndim - 1))
        mixed = first + weight[between].reshape(shape) * change
        mixed[..., HEADING] = wrap_angles(mixed[..., HEADING])
        out[between] = mixed
    return out


def _complete(ego: FloatArray, times: IntArray, driven: Driven, samples: _Samples) -> list[str]:
    """Fill the columns of states (K, 11) that are NaN; what was filled, in words."""
    derived, given = derived_states(times, ego[:, :3]), ~np.isnan(ego).all(axis=0)
    if given[VX]:
        wrong = np.abs(ego[:, VX] - derived[:, VX]) > _CONTRADICTION
        runs = np.convolve(wrong, np.ones(_IN_A_ROW), "valid") == _IN_A_ROW
        if runs.any():
            at = int(np.argmax(runs))
            raise driven.error(
                int(samples.index[at]),
                f"vx is {ego[at, VX]:.3g} m/s, the positions move {derived[at, VX]:.3g} m/s along "
                f"the heading, and so on for {_IN_A_ROW} samples",
                "give vx and vy in m/s in the frame of the ego; or leave them out",
            )
    remarks, names = [], [STATE_COLUMNS[c] for c in DERIVED if not given[c]]
    if names:
        remarks.append(f"derived from poses: {', '.join(names)}")
    steps = np.hypot(*np.diff(ego[:, :2], axis=0).T) < _STANDING
    stands = np.append(True, steps) & np.append(steps, True)
    if stands.any() and not given[VX : VY + 1].all():
        derived[stands, VX : VY + 1] = 0.0
        remarks.append("derived speed 0 where the ego stands")
    np.copyto(ego, derived, where=~given)
    return remarks


def _in_frame(vectors: FloatArray, heading: Any) -> FloatArray:
    """Vectors (K, 2) of the map as seen along headings."""
    x, y, cos, sin = vectors[:, 0], vectors[:, 1], np.cos(heading), np.sin(heading)
    return np.stack([x * cos + y * sin, y * cos - x * sin], axis=1)


def _tracks_at(
    driven: Driven, times: IntArray, shift: int, log: SimulationLog
) -> tuple[Tracks, list[str]]:
    """The given boxes at the iterations, and what was done to them; `log` has the recorded ones."""
    assert driven.boxes is not None
    boxes, remarks = driven.boxes.tracks, []
    if not len(boxes):  # nobody was there at any time
        boxes, samples = boxes.rows(np.zeros(0, np.int64)), None
        missing = np.ones(len(times), np.bool_)
        tracks = Tracks.empty(len(times))
    else:
        samples = _locate(driven.boxes.time_us + shift, times)
        missing = samples.distance > _NEAR
        tracks = _boxes_at(boxes, samples, missing)
        if samples.weight[~missing].any():
            remarks.append("boxes of others interpolated to the iterations")
    lost = missing & log.tracks.valid.any(axis=1)
    if lost.any():
        step = int(np.argmax(lost))
        raise DataError(
            f"{driven.where}: no boxes of others at iteration {step}, {times[step]} us; the "
            f"recording has {int(log.tracks.valid[step].sum())}",
            "give the boxes of all iterations, or leave --tracks out: collisions are undefined",
        )
    _refuse_ego(driven, tracks, log.ego)
    moves = tracks.kinds <= LAST_AGENT_KIND
    velocities = np.array(tracks.velocities)
    velocities[:, ~moves] = np.nan
    unknown = tracks.valid & moves & np.isnan(velocities).any(axis=2)
    if unknown.any():
        velocities[unknown] = _differences(tracks, times)[unknown]
        remarks.append("velocities of others derived from their positions")
    if tracks.valid.sum() < 2 * tracks.num_tracks and len(times) > 2:
        remarks.append("tokens of others change at every sample: each contact counts anew")
    return replace(tracks, velocities=velocities), remarks


def _boxes_at(boxes: Tracks, samples: _Samples, missing: Any) -> Tracks:
    """Tracks at K times; one between two times must be there at both."""
    index, last = samples.index, len(boxes) - 1
    valid = boxes.valid[index] & ~missing[:, None]
    between = samples.weight != 0.0
    valid[between] &= boxes.valid[np.minimum(index[between] + 1, last)]
    poses = _interpolated(
        boxes.poses, samples._replace(weight=np.where(missing, 0.0, samples.weight))
    )
    found = replace(boxes.rows(index), valid=valid, poses=poses)
    for name in ("poses", "velocities", "sizes"):
        values = np.where(valid[..., None], getattr(found, name), np.nan)
        found = replace(found, **{name: values})
    return found.select(valid.any(axis=0))


def _differences(tracks: Tracks, times: IntArray) -> FloatArray:
    """(K, N, 2) velocities by the sample before, at the first one by that after; 0 without."""
    steps = np.diff(times)[:, None, None] * 1e-6
    rates = np.diff(tracks.poses[..., :2], axis=0) / steps
    none = np.full((1, *rates.shape[1:]), np.nan)
    before, after = np.concatenate([none, rates]), np.concatenate([rates, none])
    return np.nan_to_num(np.where(np.isnan(before), after, before))


def _refuse_ego(driven: Driven, tracks: Tracks, ego: FloatArray) -> None:
    """Refuse a box that is the ego."""
    on_ego = np.zeros(tracks.valid.shape, np.bool_)
    for poses in (ego[:, :3], center_poses(ego[:, :3])):
        gaps = tracks.poses - poses[:, None]
        turns = np.abs(wrap_angles(np.nan_to_num(gaps[..., HEADING])))
        with np.errstate(invalid="ignore"):
            near = np.hypot(gaps[..., 0], gaps[..., 1]) < _ON_EGO[0]
        on_ego |= near & (turns < _ON_EGO[1])
    counts, there = on_ego.sum(axis=0), tracks.valid.sum(axis=0)
    found = np.flatnonzero((counts >= 3) & (2 * counts > there))
    if len(found):
        which = int(found[0])
        raise DataError(
            f"{driven.where}: track {tracks.tokens[which]!r} is on the ego, with its heading, at "
            f" {counts[which]} of {there[which]} samples, from iteration "
            f"{int(np.argmax(on_ego[:, which]))} on",
            "leave the ego out of the tracks, or name its type EGO",
        )
