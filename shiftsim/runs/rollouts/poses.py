"""Poses that were driven elsewhere become a rollout of a scenario: checked, sampled, with states.

The closed-loop metrics read pose, velocity, acceleration and yaw rates of the rear axle at the
iterations of the scenario. What is not given is derived from the poses. What cannot be right is
refused, with the row and the number that show it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.metrics.comfort import MIN_SAMPLES, derived_states
from shiftsim.sim.log import SimulationLog, as_recorded
from shiftsim.world import state
from shiftsim.world.ranges import single_step
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import HEADING, STATE_COLUMNS, VX, VY, Tracks, center_poses, rear_poses

REAR_AXLE, CENTER = POINTS = ("rear_axle", "center")
NEED_BOXES = ("no_ego_at_fault_collisions", "time_to_collision_within_bound")
_READ = (VX, VY, state.AX, state.AY, state.YAW_RATE, state.YAW_ACCEL)  # by metrics, beside poses
_STEP = 100_000  # us between iterations
_EXACT, _NEAR = 1_000, 25_000  # us from an iteration: taken as it is, or interpolated
_LONGEST_STEP = 150_000  # us
_OTHER_MAP = 50.0  # m from the recorded pose at iteration 0
_SAME_START = (0.05, 0.01)  # m, rad from it
_TURNED, _MISTAKEN = 0.5, 0.1  # rad from it, and where another meaning of the number explains it
_STANDING = 1e-3  # m per iteration
_JUMP = (10.0, 1.0)  # m, rad in 0.1 s
# state that contradicts the positions: by how much, in how many samples in a row
_CHECKED = {VX: ("m/s", 0.5, 3), state.AX: ("m/s²", 1.5, 8)}
_ON_EGO, _FAR = (0.5, 0.1), 200.0  # m, rad between a box and the ego; m to the nearest one
_FRAME = "give metres in the frame of the store's map: no local frame, no latitude"
_RADIANS = "give radians, counter-clockwise from x, within ±pi"


class Boxes(NamedTuple):
    """The others at F times of their own."""

    time_us: IntArray  # (F,) increasing; time stamps or from 0 on, as those of the ego [us]
    tracks: Tracks  # F rows; kinds may be -1 and velocities NaN where they are not given
    where: str = ""  # the file, where it is another one than that of the ego


@dataclass(frozen=True, slots=True)
class Driven:
    """What is given of one rollout. R samples."""

    where: str  # the file, for messages
    time_us: IntArray  # (R,) time stamps of the recording, or from 0 on [us]
    states: FloatArray  # (R, 11) of the ego; columns behind the pose are NaN where not given
    rows: IntArray  # (R,) row of each in the file, from 0 on
    boxes: Callable[[], Boxes] | None = None  # what makes the others, where they are given
    fields: Mapping[str, Any] = field(default_factory=dict)  # (R, …) other ones of `SimulationLog`
    remarks: tuple[str, ...] = ()  # what a reader of the score must know
    is_simulated: bool = False  # by shiftsim or nuPlan, whose perfect tracking is as the plan says

    def refuse(self, bad: BoolArray, words: Callable[[int], str], hint: str) -> None:
        """Refuse the first of the samples (R,) that is bad; `words` say why."""
        if bad.any():
            row = int(np.argmax(bad))
            raise DataError(f"{self.where}, row {self.rows[row]}: {words(row)}", hint)

    def refuse_one(self, row: int, words: str, hint: str) -> None:
        """Refuse a sample."""
        self.refuse(np.arange(len(self.rows)) == row, lambda _: words, hint)


class _Samples(NamedTuple):
    """Where K times lie among F others."""

    at: IntArray  # (K,) the nearest time where it is taken as it is, else the one before
    weight: FloatArray  # (K,) of the time after `at`; 0 where the nearest is taken as it is
    distance: IntArray  # (K,) to the nearest [us]


def rollout_of(
    driven: Driven,
    scenario: Scenario,
    *,
    point: str = REAR_AXLE,
    recorded: bool = False,
    partial: bool = False,
) -> tuple[SimulationLog, tuple[str, ...]]:
    """The rollout that poses in a scenario are, and remarks; a DataError names the row."""
    _check_rows(driven)
    states, remarks = np.array(driven.states), [*driven.remarks]
    if point == CENTER:
        states[:, :3] = rear_poses(states[:, :3])
    shift = _shift(driven, scenario, states[0], point)
    time_us, times = driven.time_us + shift, scenario.iteration_times[:-1]
    reached = int(np.count_nonzero(times <= time_us[-1] + _NEAR))
    if reached < len(times):
        _check_end(driven, times, reached, partial=partial)
        scenario = replace(scenario, iteration_rows=scenario.iteration_rows[: reached + 1])
        times = times[:reached]
        remarks.append("partial: scored against the expert up to where it ends")
    elif time_us[-1] > scenario.iteration_times[-1] + _NEAR:
        remarks.append("cut at the end of the scenario")
    samples = _locate(time_us, times)
    if (far := samples.distance > _NEAR).any():
        step = int(np.argmax(far))
        driven.refuse_one(
            int(samples.at[step]),
            f"no sample within {_NEAR // 1000} ms of iteration {step}, the nearest is "
            f"{samples.distance[step] * 1e-3:.1f} ms away",
            "give 10 Hz in step with the recording, or 20 Hz and more, from iteration 0 on",
        )
    ego = _at(states, samples)
    if samples.weight.any():
        ego[:, 3:] = np.nan
        remarks.append("poses interpolated to the iterations")
    _check_start(driven, int(samples.at[0]), ego[0], scenario.expert[0], point)
    remarks += _fill(ego, times, driven, samples)
    fields = {name: values[samples.at] for name, values in driven.fields.items()}
    log = replace(as_recorded(scenario), ego=ego, **fields)
    if driven.boxes is not None:
        tracks, more = _others(driven, driven.boxes(), shift, log)
        return replace(log, tracks=tracks), (*remarks, *more)
    if recorded:
        return log, (*remarks, "others replayed from the recording")
    log = replace(log, tracks=Tracks.empty(len(times)))
    return log, (*remarks, "others not given: collisions, time to collision and score undefined")


def _check_rows(driven: Driven) -> None:
    """Refuse rows that cannot be right, whatever the scenario."""
    time_us, states, count = driven.time_us, driven.states, len(driven.rows)
    if count < MIN_SAMPLES:
        words = f"{count} samples; the metrics need {MIN_SAMPLES}"
        driven.refuse_one(0, words, "give a sample for each iteration, every 0.1 s")
    is_given: BoolArray = ~np.isnan(states).all(axis=0) | (np.arange(len(STATE_COLUMNS)) < VX)
    broken = ~np.isfinite(states) & is_given
    driven.refuse(
        np.logical_or.reduce(broken, axis=1),
        lambda row: f"{STATE_COLUMNS[np.argmax(broken[row])]} is missing or not finite",
        "give a number in every row; states may lack as whole columns of a rollout",
    )
    steps = np.diff(time_us, prepend=time_us[0] - _STEP)
    driven.refuse(
        steps <= 0,
        lambda row: (
            f"its time, {time_us[row]} us, is not after that of the row before, "
            f"{time_us[row - 1]} us"
        ),
        "sort rows by time, one per time: nuPlan gives no metric at all where two are equal",
    )
    driven.refuse(
        steps > _LONGEST_STEP,
        lambda row: f"{steps[row] * 1e-6:.3f} s after the row before",
        "give a sample for each iteration, every 0.1 s",
    )
    headings = states[:, HEADING]
    turns = np.abs(np.diff(headings, prepend=headings[0]))
    driven.refuse(  # a step by a whole turn is one from pi to -pi
        (np.abs(headings) > 7.0) | ((turns > 5.0) & (np.abs(turns - 2.0 * np.pi) > 1.0)),
        lambda row: f"heading {headings[row]:.6g}, {turns[row]:.3g} from the row before: degrees?",
        _RADIANS,
    )
    _refuse_single(f"{driven.where}, row {driven.rows[0]}", states)
    moved = np.hypot(*np.diff(states[:, :2], axis=0, prepend=states[:1, :2]).T)
    turned = np.abs(wrap_angles(turns))
    tenths = np.maximum(steps / _STEP, 1.0)
    driven.refuse(
        (moved > _JUMP[0] * tenths) | (turned > _JUMP[1] * tenths),
        lambda row: (
            f"{moved[row]:.2f} m and {turned[row]:.2f} rad from the row before, "
            f"in {steps[row] * 1e-6:.2f} s"
        ),
        "a vehicle does not jump: check units, and that the rows are of one rollout",
    )


def _refuse_single(where: str, poses: FloatArray) -> None:
    """Refuse positions (R, …) that went through single precision, where its steps are large."""
    for name, values in zip("xy", poses.T[:2], strict=True):
        if len(values) and (step := single_step(values)):
            words = f"{where}: {name} is {values[0]:.10g}, and in all rows of single precision"
            hint = "write float64: speeds and accelerations of such positions are noise"
            raise DataError(f"{words}, which has steps of {step:g} m there", hint)


def _apart(pose: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    turn = float(wrap_angles(pose[HEADING] - other[HEADING]))
    return float(np.hypot(*(pose[:2] - other[:2]))), abs(turn)


def _shift(driven: Driven, scenario: Scenario, first: FloatArray, point: str) -> int:
    """What is added to times [us]: those from 0 on begin at iteration 0, where the expert is."""
    start, expert = int(scenario.iteration_times[0]), scenario.expert[0]
    gap, turn = _apart(first, expert)
    is_there = gap <= _SAME_START[0] and turn <= _SAME_START[1]
    begin, end = driven.time_us[[0, -1]].tolist()
    if abs(begin) > _EXACT or (end >= start and not is_there):
        return 0
    if not is_there:
        _check_start(driven, 0, first, expert, point)
        driven.refuse_one(
            0,
            f"time 0, but {gap:.2f} m and {turn:.3f} rad from the recorded pose of iteration 0",
            "begin where the recording begins, as nuPlan does, or give time stamps of the log",
        )
    return start - begin


def _check_start(
    driven: Driven, row: int, pose: FloatArray, expert: FloatArray, point: str
) -> None:
    """Refuse a pose at iteration 0 that shows another map, point or unit."""
    gap, turn = _apart(pose, expert)
    words = f"({pose[0]:.10g}, {pose[1]:.10g}) at iteration 0, the recording is {gap:.4g} m away"
    if gap > _OTHER_MAP:
        driven.refuse_one(row, f"{words}, at ({expert[0]:.10g}, {expert[1]:.10g})", _FRAME)
    for other in {*POINTS} - {point}:
        mistaken = center_poses(expert[:3]) if other == CENTER else rear_poses(expert[:3])
        if _apart(pose, mistaken)[0] < _SAME_START[0]:
            side = "ahead of" if other == CENTER else "behind"
            driven.refuse_one(
                row,
                f"at iteration 0 the pose is {state.PACIFICA.rear_axle_to_center:.3f} m {side} the "
                f"recorded rear axle: it is of the {other.replace('_', ' ')}",
                f"say so: --point {other}",
            )
    heading, said = driven.states[row, HEADING], expert[HEADING]
    meant = {"in degrees": np.radians(heading), "counted clockwise": -heading}
    meant |= {"of a compass": np.pi / 2 - heading, "backwards": heading + np.pi}
    near = [how for how in meant if abs(wrap_angles(meant[how] - said)) < _SAME_START[1]]
    if turn > (_MISTAKEN if near else _TURNED):
        words = f"heading {heading:.4g}, {[*near, 'not'][0]} the recorded one, {said:.4g} rad"
        driven.refuse_one(row, f"{words}, at iteration 0", _RADIANS)


def _check_end(driven: Driven, times: IntArray, reached: int, *, partial: bool) -> None:
    """Refuse a rollout that reaches only some iterations, unless it may be partial."""
    if reached == 0:
        words = f"its time, {driven.time_us[-1]} us, is before the scenario begins, {times[0]} us"
        driven.refuse_one(-1 % len(driven.rows), words, "give times of the log, or from 0 on")
    if not partial or reached < MIN_SAMPLES:
        ends, lasts = (times[[reached - 1, -1]] - times[0]) * 1e-6
        driven.refuse_one(
            -1 % len(driven.rows),
            f"the last sample is {ends:.1f} s after iteration 0, the scenario lasts {lasts:.1f} s",
            "drive it to the end, or have what there is scored as partial (--partial); "
            f"{MIN_SAMPLES} samples at least",
        )


def _locate(time_us: IntArray, wanted: IntArray) -> _Samples:
    """Where times (K,) lie among others (F,)."""
    last = len(time_us) - 1
    after = np.clip(np.searchsorted(time_us, wanted), min(1, last), last)
    before = np.maximum(after - 1, 0)
    nearest = np.where(wanted - time_us[before] <= time_us[after] - wanted, before, after)
    distance = np.abs(time_us[nearest] - wanted)
    between = (wanted - time_us[before]) / np.maximum(time_us[after] - time_us[before], 1)
    is_exact = distance <= _EXACT
    index, weight = np.where(is_exact, nearest, before), np.where(is_exact, 0.0, between)
    return _Samples(index, weight, distance)


def _at(states: FloatArray, samples: _Samples) -> FloatArray:
    """(K, …, C) of states (F, …, C), which begin with a pose; headings turn the short way."""
    out, between = np.array(states[samples.at]), np.flatnonzero(samples.weight)
    index = samples.at[between]
    change = states[np.minimum(index + 1, len(states) - 1)] - out[between]
    change[..., HEADING] = wrap_angles(change[..., HEADING])
    out[between] += samples.weight[between].reshape(-1, *[1] * (states.ndim - 1)) * change
    is_wound = np.abs(out[..., HEADING]) > np.pi  # the others keep their digits
    out[is_wound, HEADING] = wrap_angles(out[is_wound, HEADING])
    return out


def _fill(ego: FloatArray, times: IntArray, driven: Driven, samples: _Samples) -> list[str]:
    """Derive the columns of states (K, 11) that are NaN; what was derived, in words."""
    derived, is_given = derived_states(times, ego[:, :3]), ~np.isnan(ego[0])
    for column, (unit, limit, count) in _CHECKED.items():
        name, gaps = STATE_COLUMNS[column], np.abs(ego[:, column] - derived[:, column])
        limit /= 1.0 + (np.ptp(ego[:, column]) == 0.0)  # what never changes was hardly measured
        runs = np.convolve(gaps > limit, np.ones(count), "valid") == count
        if runs.any() and not driven.is_simulated:
            at = int(np.argmax(runs))
            given, known = (f"{states[at, column]:.3g} {unit}" for states in (ego, derived))
            words = f"{name} is {given}, but the positions move by {known} along the heading"
            hint = f"give {name} in {unit} in the frame of the ego, or leave it out"
            driven.refuse_one(int(samples.at[at]), f"{words}, and so on for {count} samples", hint)
    names, remarks = [STATE_COLUMNS[column] for column in _READ if not is_given[column]], []
    if names:
        remarks.append(f"derived from poses: {', '.join(names)}")
    stands = np.hypot(*np.diff(ego[:, :2], axis=0).T) < _STANDING
    stands = np.append(True, stands) & np.append(stands, True)
    if stands.any() and not is_given[[VX, VY]].all():
        derived[stands, VX : VY + 1] = 0.0
        remarks.append("speed 0 where the pose moves less than 1 mm")
    np.copyto(ego, derived, where=~is_given)
    return remarks


def _others(
    driven: Driven, boxes: Boxes, shift: int, log: SimulationLog
) -> tuple[Tracks, list[str]]:
    """The given boxes at the samples of a log, and what was done; between two times if at both."""
    times, given, remarks = log.time_us, boxes.tracks, list[str]()
    where, (first, last) = boxes.where or driven.where, times[[0, -1]] + [-_NEAR, _NEAR]
    if not ((boxes.time_us + shift >= first) & (boxes.time_us + shift <= last)).any():
        shift = 0 if shift else int(times[0])  # of the two kinds of times they have the other one
    lost = np.ones(len(times), np.bool_)
    tracks = Tracks.empty(len(times))
    if len(given):
        _refuse_single(where, given.poses[given.valid])
        samples = _locate(boxes.time_us + shift, times)
        lost = samples.distance > _NEAR
        after = np.minimum(samples.at + (samples.weight != 0.0), len(given) - 1)
        tracks = replace(
            given.rows(samples.at),
            valid=given.valid[samples.at] & given.valid[after] & ~lost[:, None],
            poses=_at(given.poses, samples),
        )
        tracks = tracks.select(np.logical_or.reduce(tracks.valid, axis=0))
        if samples.weight[~lost].any():
            remarks.append("boxes of others interpolated to the iterations")
    lost &= log.tracks.valid.any(axis=1)
    if lost.any():
        step = int(np.argmax(lost))
        raise DataError(
            f"{where}: no boxes of others at iteration {step}, {times[step]} us, where the "
            f"recording of {log.token!r} has {np.count_nonzero(log.tracks.valid[step])}",
            "give those of all iterations; without any, collisions are undefined",
        )
    near, recorded_near = (
        float(np.hypot(*(some.poses - log.ego[:, None, :3])[some.valid].T[:2]).min(initial=np.inf))
        for some in (tracks, log.tracks)
    )
    if recorded_near <= _FAR < near < np.inf:
        words = f"{where}: the nearest box is {near:.4g} m from the ego, the nearest recorded one"
        raise DataError(f"{words} {recorded_near:.4g} m, scenario {log.token!r}", _FRAME)
    _check_ego(where, tracks, log.ego)
    kinds = np.array(tracks.kinds)
    recorded = dict(zip(log.tracks.tokens, log.tracks.kinds.tolist(), strict=True))
    for index in np.flatnonzero(kinds < 0).tolist():
        if (token := tracks.tokens[index]) not in recorded:
            words = f"{where}: track {token!r} has no type, and is not in the recording"
            raise DataError(words, "add a column type: VEHICLE, PEDESTRIAN, BICYCLE, …")
        kinds[index] = recorded[token]
    velocities, moves = np.array(tracks.velocities), kinds <= state.LAST_AGENT_KIND
    unknown = tracks.valid & moves & np.isnan(velocities).any(axis=2)
    if unknown.any():
        velocities[unknown] = _differences(tracks, times)[unknown]
        remarks.append("velocities of others derived from their positions")
    velocities[:, ~moves] = np.nan
    if np.count_nonzero(tracks.valid) < 2 * tracks.num_tracks:
        remarks.append("tracks last one sample: each contact counts anew")
    there = tracks.valid[..., None]
    arrays = (tracks.poses, velocities, tracks.sizes)
    poses, velocities, sizes = (np.where(there, values, np.nan) for values in arrays)
    return Tracks(tracks.valid, poses, velocities, sizes, kinds, tracks.tokens), remarks


def _differences(tracks: Tracks, times: IntArray) -> FloatArray:
    """(K, N, 2) velocities since the sample before, of the first one until that after; else 0."""
    places = np.where(tracks.valid[..., None], tracks.poses[..., :2], np.nan)
    rates = np.diff(places, axis=0) / (np.diff(times)[:, None, None] * 1e-6)
    none = np.full((1, *places.shape[1:]), np.nan)
    before, after = np.concatenate([none, rates]), np.concatenate([rates, none])
    return np.nan_to_num(np.where(np.isnan(before), after, before))


def _check_ego(where: str, tracks: Tracks, ego: FloatArray) -> None:
    """Refuse a track that is the ego, by its centre or its rear axle."""
    is_ego = np.zeros(tracks.valid.shape, np.bool_)
    for poses in (ego[:, :3], center_poses(ego[:, :3])):
        gaps = tracks.poses - poses[:, None]
        near = np.hypot(gaps[..., 0], gaps[..., 1]) < _ON_EGO[0]
        is_ego |= near & (np.abs(wrap_angles(gaps[..., HEADING])) < _ON_EGO[1])
    is_ego &= tracks.valid
    counts, there = np.count_nonzero(is_ego, axis=0), np.count_nonzero(tracks.valid, axis=0)
    found = np.flatnonzero((counts > 2) & (2 * counts > there)).tolist()
    if found:
        which = found[0]
        raise DataError(
            f"{where}: track {tracks.tokens[which]!r} is on the ego, with its heading, in "
            f"{counts[which]} of {there[which]} samples from {np.argmax(is_ego[:, which])} on",
            "leave the ego out of the boxes, or give it the type EGO",
        )
