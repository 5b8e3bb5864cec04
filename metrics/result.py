"""What a metric is given and what it reports: threshold profiles, rows, violations, statistics.

The profiles are plain data: `nuplan` (the devkit's defaults) and `deepplan`. Their names follow the
devkit's configuration keys.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from shiftsim.errors import one_of
from shiftsim.kernels import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Every number that a score depends on; the defaults are nuPlan's."""

    name: str  # profile name, which travels with every result
    max_abs_mag_jerk: float = 8.37  # bound on the derivative of the acceleration magnitude [m/s^3]
    max_abs_lat_accel: float = 4.89  # bound on the lateral acceleration [m/s^2]
    min_lon_accel: float = -4.05  # lower bound on the longitudinal acceleration [m/s^2]
    max_lon_accel: float = 2.40  # upper bound on the longitudinal acceleration [m/s^2]
    max_abs_lon_jerk: float = 4.13  # bound on the longitudinal jerk [m/s^3]
    max_abs_yaw_accel: float = 1.93  # bound on the yaw acceleration [rad/s^2]
    max_abs_yaw_rate: float = 0.95  # bound on the yaw rate [rad/s]
    max_drivable_area_violation: float = 0.3  # how far a corner may leave the drivable area [m]
    # regress within the window up to which the score is 1 [m]
    driving_direction_compliance: float = 2.0
    driving_direction_violation: float = 6.0  # regress from which on the score is 0 [m]
    driving_direction_horizon: float = 1.0  # length of that window [s]
    least_min_ttc: float = 0.95  # the time to collision must exceed this at every sample [s]
    # at-fault collisions that halve the score instead of zeroing it
    allowed_vru_collisions: int = 0
    allowed_vehicle_collisions: int = 0  # the same for vehicles
    allowed_object_collisions: int = 1  # the same for static objects
    min_progress: float = 0.2  # progress ratio that counts as making progress
    score_progress: float = 2.0  # progress below this counts as this, for ego and expert alike [m]
    max_overspeed: float = 2.23  # over-speed that costs the whole score when held throughout [m/s]
    # share of failed lane changes that still passes; not scored
    max_lane_change_fail_rate: float = 0.3


NUPLAN = Thresholds("nuplan")
# least_min_ttc is taken literally from the paper's table
DEEPPLAN = replace(
    NUPLAN,
    name="deepplan",
    min_lon_accel=-6.0,
    max_lon_accel=4.0,
    max_abs_lon_jerk=6.0,
    max_drivable_area_violation=3.0,
    driving_direction_compliance=4.0,
    driving_direction_violation=10.0,
    least_min_ttc=0.5,
)
PROFILES = {profile.name: profile for profile in (NUPLAN, DEEPPLAN)}


def thresholds_of(profile: str | Thresholds) -> Thresholds:
    """The profile of a name, or the thresholds themselves; else a ConfigError."""
    if isinstance(profile, Thresholds):
        return profile
    return PROFILES[one_of("threshold profile", profile, PROFILES)]


class Violation(NamedTuple):
    """Where a bound is broken first."""

    iteration: int  # sample
    time_us: int  # its time stamp [us]
    partner: str | None  # token of the other track, or None
    value: float  # the value that breaks the bound, in the unit of the metric


def first_violation(broken: BoolArray, values: FloatArray, time_us: IntArray) -> Violation | None:
    """The first of the samples (K,) at which a bound is broken, with its value; None without."""
    if not broken.any():
        return None
    at = int(np.argmax(broken))
    return Violation(at, int(time_us[at]), None, float(values[at]))


class MetricRow(NamedTuple):
    """One metric of one rollout."""

    metric: str  # devkit metric name
    score: float | None  # in [0, 1]; None for a metric that is not scored
    value: float  # the number behind the score
    unit: str  # unit of value and threshold
    threshold: float | None  # bound on the value; None where there is none
    violation: Violation | None  # first violation, or None


class Statistic(NamedTuple):
    """One statistic with the name nuPlan gives it; booleans are 0 or 1."""

    metric: str
    name: str
    unit: str
    kind: str
    value: float


class Series(NamedTuple):
    """One value per sample, (K,), and its unit as nuPlan names it."""

    unit: str
    values: FloatArray


@dataclass(frozen=True, slots=True)
class MetricPart:
    """What one metric contributes to the result."""

    row: MetricRow
    statistics: tuple[Statistic, ...]
    series: Series | None

    @staticmethod
    def of(
        row: MetricRow, *statistics: tuple[str, str, str, float], series: Series | None = None
    ) -> "MetricPart":
        """A row, statistics of its metric, each a name, unit, kind and value, and its series."""
        named = (Statistic(row.metric, n, unit, kind, float(v)) for n, unit, kind, v in statistics)
        return MetricPart(row, tuple(named), series)


class Collision(NamedTuple):
    """First contact of the ego with a track."""

    iteration: int  # sample
    time_us: int  # its time stamp [us]
    token: str  # the track
    kind: int  # its AgentKind code
    collision_type: str  # one of `COLLISION_TYPES`
    delta_v: float  # change of speed of two equal masses [m/s]
    at_fault: bool  # whether the ego is to blame
