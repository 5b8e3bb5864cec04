"""From a rollout to its score: measure once, apply thresholds, and weigh.

What depends on geometry and on no threshold is measured once; any number of threshold profiles can
be applied to the result.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from shiftsim.errors import DataError, missing_attribute
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.metrics import (
    collision,
    comfort,
    drivable_area,
    lane_change,
    progress,
    speed_limit,
    time_to_collision,
)
from shiftsim.metrics.comfort import MIN_SAMPLES, ComfortSignals, comfort_signals
from shiftsim.metrics.result import (
    Collision,
    MetricPart,
    MetricRow,
    Series,
    Statistic,
    Thresholds,
    thresholds_of,
)
from shiftsim.metrics.route import EdgeLists, corner_routes, driven_route
from shiftsim.sim.log import SimulationLog
from shiftsim.world.map import VectorMap
from shiftsim.world.state import STATE_COLUMNS, VehicleParameters, center_poses

_FAR = 1e9  # m, rad, m/s of a box in sum
MULTIPLIERS = (
    "no_ego_at_fault_collisions",
    "drivable_area_compliance",
    "ego_is_making_progress",
    "driving_direction_compliance",
)
WEIGHTS = {
    "ego_progress_along_expert_route": 5.0,
    "time_to_collision_within_bound": 5.0,
    "speed_limit_compliance": 4.0,
    "ego_is_comfortable": 2.0,
}
SHORT_NAMES = {
    "no_ego_at_fault_collisions": "NCR",
    "drivable_area_compliance": "DAC",
    "ego_is_making_progress": "EMP",
    "driving_direction_compliance": "DDC",
    "ego_progress_along_expert_route": "PER",
    "time_to_collision_within_bound": "TTC",
    "speed_limit_compliance": "SLC",
    "ego_is_comfortable": "EIC",
    "score": "CLS",
}
_CATEGORIES = {  # as nuPlan files metrics; the others are of `Planning`
    **dict.fromkeys(("speed_limit_compliance", "ego_is_comfortable"), "Violations"),
    **dict.fromkeys(("ego_jerk", "ego_lat_acceleration", "ego_lon_acceleration"), "Dynamics"),
    **dict.fromkeys(("ego_lon_jerk", "ego_yaw_acceleration", "ego_yaw_rate"), "Dynamics"),
    "no_ego_at_fault_collisions": "Dynamics",
}
_SCORE_UNITS = {  # of scores that have one
    **dict.fromkeys(("drivable_area_compliance", "driving_direction_compliance"), "bool"),
    **dict.fromkeys(("ego_is_comfortable", "ego_is_making_progress"), "bool"),
    "time_to_collision_within_bound": "bool",
    **dict.fromkeys(("no_ego_at_fault_collisions", "speed_limit_compliance"), "float"),
}
_TYPES = {"boolean": bool, "count": int}  # of statistics, by unit


@dataclass(frozen=True, slots=True)
class Measurements:
    """One rollout, measured. K samples."""

    time_us: IntArray  # (K,) time stamps [us]
    route: EdgeLists  # edges of the ego centre
    corners: EdgeLists  # (K, 4, C) edges of the corners
    lanes: lane_change.LaneChanges  # whether the corners share lanes, and the lane changes
    comfort: ComfortSignals  # the seven signals
    progress: progress.Progress  # progress of ego and expert along the expert's route
    drivable: drivable_area.DrivableArea  # corners outside and their distances
    collisions: tuple[Collision, ...]  # first contacts, in order of time
    ttc: time_to_collision.TimeToCollision  # time to collision and partner at each sample
    overspeed: FloatArray  # (K,) speed above the limit, 0 where there is none [m/s]
    lane_progress: FloatArray  # (K,) progress along the lane since the sample before [m]


@dataclass(frozen=True, slots=True)
class MetricResult:
    """Everything nuPlan says about one rollout under one threshold profile."""

    score: float  # closed-loop score in [0, 1]; NaN where a metric is undefined
    scores: dict[str, float | None]  # by devkit name, None for metrics without; in one order
    rows: tuple[MetricRow, ...]  # one row per metric, in the same order
    statistics: tuple[Statistic, ...]  # named statistics, grouped by metric
    series: dict[str, Series]  # one value per sample, by metric
    thresholds: str  # name of the threshold profile
    measurements: Measurements  # routes, collisions, signals and distances behind the scores
    extra: tuple[MetricRow, ...] = ()  # rows of the user's own metrics; they never enter the score

    def __repr__(self) -> str:
        return f"<MetricResult: score {100.0 * self.score:.2f}, thresholds {self.thresholds}>"


setattr(MetricResult, "__getattr__", missing_attribute)  # noqa: B010


def measure(log: SimulationLog, map: VectorMap) -> Measurements:
    """Measure one rollout; `evaluate` applies thresholds to the result.

    Raises DataError: the rollout is too short, or a state is not finite. MapError: the map is such
    that nuPlan's own code stops.
    """
    tracks = collision.flat_tracks(log.tracks)
    _check(log, tracks)
    vehicle = VehicleParameters()
    ego = collision.flat_ego(log.ego, vehicle)
    # nuPlan's order of evaluation, which decides what is reported when several things are wrong
    route = driven_route(map, ego.centers)
    corners = corner_routes(map, ego.corners)
    lanes = lane_change.lane_changes(map, corners)
    comfort = comfort_signals(log.time_us, log.ego)
    along = progress.measure(map, ego.centers, center_poses(log.expert_ego[:, :3], vehicle))
    drivable = drivable_area.measure(map, ego.corners, route, corners)
    contacts = collision.first_contacts(ego, tracks)
    collisions = collision.classify(contacts, log.time_us, log.tracks, lanes.is_common)
    ttc = time_to_collision.time_to_collision(
        ego, tracks, contacts, collisions, lanes.is_common, map, log.tracks
    )
    return Measurements(
        time_us=log.time_us,
        route=route,
        corners=corners,
        lanes=lanes,
        comfort=comfort,
        progress=along,
        drivable=drivable,
        collisions=collisions,
        ttc=ttc,
        overspeed=speed_limit.overspeed(map, route, ego.speeds),
        lane_progress=progress.lane_progress(map, route, ego.centers),
    )


def evaluate(measurements: Measurements, thresholds: str | Thresholds = "nuplan") -> MetricResult:
    """Apply one threshold profile to a measured rollout."""
    profile = thresholds_of(thresholds)
    parts = _parts(measurements, profile)
    scores = {part.row.metric: part.row.score for part in parts}
    return MetricResult(
        score=closed_loop_score(scores),
        scores=scores,
        rows=tuple(part.row for part in parts),
        statistics=tuple(statistic for part in parts for statistic in part.statistics),
        series={part.row.metric: part.series for part in parts if part.series is not None},
        thresholds=profile.name,
        measurements=measurements,
    )


def without(result: MetricResult, undefined: Collection[str]) -> MetricResult:
    """A result without metrics that cannot be known; where there are some, the score is NaN."""
    if not undefined:
        return result
    return replace(
        result,
        score=np.nan,
        scores={name: s if name not in undefined else None for name, s in result.scores.items()},
        rows=tuple(row for row in result.rows if row.metric not in undefined),
        statistics=tuple(one for one in result.statistics if one.metric not in undefined),
        series={name: one for name, one in result.series.items() if name not in undefined},
    )


def nuplan_columns(result: MetricResult, metric: str) -> dict[str, Any]:
    """The row of a metric in nuPlan's own table, by column: score, statistics and time series."""
    series = result.series.get(metric)
    row: dict[str, Any] = {
        "metric_score": result.scores[metric],
        "metric_score_unit": _SCORE_UNITS.get(metric),
        "metric_category": _CATEGORIES.get(metric, "Planning"),
    }
    for one in (one for one in result.statistics if one.metric == metric):
        # nuPlan has the booleans of the drivable area as numbers
        kind = float if "drivable_area" in metric else _TYPES.get(one.unit, float)
        values = {"type": one.kind or None, "unit": one.unit or None, "value": kind(one.value)}
        row |= {f"{one.name}_stat_{name}": value for name, value in values.items()}
    return row | {
        "time_series_unit": series.unit or None if series else None,
        "time_series_timestamps": result.measurements.time_us if series else None,
        "time_series_values": series.values if series else None,
    }


def weight_of(metric: str) -> float | None:
    """Weight of a metric, 1 for one that is not listed; None for a multiplier."""
    return None if metric in MULTIPLIERS else WEIGHTS.get(metric, 1.0)


def closed_loop_score(
    scores: Mapping[str, float | None], weigh: Callable[[str], float | None] = weight_of
) -> float:
    """Product of the multipliers times the weighted mean of other metrics that have a score."""
    product, total, weights = 1.0, 0.0, 0.0
    for metric, score in scores.items():
        if score is None:
            continue
        if (weight := weigh(metric)) is None:
            product *= score
        else:
            total += weight * score
            weights += weight
    return product * (total / weights if weights > 0.0 else 0.0)


def _parts(m: Measurements, profile: Thresholds) -> list[MetricPart]:
    signals, comfortable = comfort.evaluate(m.comfort, m.time_us, profile)
    along, making = progress.evaluate(m.progress, profile)
    area, corners = drivable_area.evaluate(m.drivable, m.time_us, profile)
    return [
        lane_change.evaluate(m.lanes, m.time_us, profile),
        *signals,
        along,
        area,
        corners,
        collision.evaluate(m.collisions, profile),
        time_to_collision.evaluate(m.ttc, m.time_us, profile),
        speed_limit.evaluate(m.overspeed, m.time_us, profile),
        comfortable,
        making,
        progress.evaluate_direction(m.lane_progress, m.time_us, profile),
    ]


def _check(log: SimulationLog, tracks: collision.FlatTracks) -> None:
    where = f"rollout of scenario {log.token!r}"
    if len(log.time_us) < MIN_SAMPLES:
        what = f"{where} has {len(log.time_us)} samples; the metrics need {MIN_SAMPLES}"
        raise DataError(what, f"simulate at least {MIN_SAMPLES + 1} iterations")
    if len(log.expert_ego) == 0:
        raise DataError(f"{where} has no expert states, which progress is measured against")
    if not len(log.time_us) == len(log.ego) == len(log.tracks):
        raise DataError(
            f"{where}: {len(log.time_us)} time stamps, {len(log.ego)} ego states and "
            f"{len(log.tracks)} rows of tracks do not belong together"
        )
    for name, states in (("ego", log.ego), ("expert", log.expert_ego)):
        if not np.isfinite(states).all():
            row, column = (int(i) for i in np.argwhere(~np.isfinite(states))[0])
            what = f"{where}: {name} {STATE_COLUMNS[column]} at sample {row} is not finite"
            raise DataError(what)
    row, column = _first_broken(tracks)
    if row >= 0:
        raise DataError(
            f"{where}: track {log.tracks.tokens[column]!r} at sample {row} has a pose or size "
            f"or velocity that is not finite or beyond {_FAR:g}, or a negative size"
        )


@kernel
def _first_broken(tracks: collision.FlatTracks) -> tuple[int, int]:
    """Sample and track of the first box that cannot be; -1, -1 where there is none."""
    for row in range(len(tracks.valid)):
        for column in range(len(tracks.is_static)):
            if tracks.valid[row, column]:
                length, width = tracks.sizes[row, column, 0], tracks.sizes[row, column, 1]
                far = length + width
                for part in range(3):
                    far += abs(tracks.poses[row, column, part])
                if not tracks.is_static[column]:  # these have no velocity
                    for part in range(2):
                        far += abs(tracks.velocities[row, column, part])
                if not (far <= _FAR and length >= 0.0 and width >= 0.0):  # NaN neither
                    return row, column
    return -1, -1
