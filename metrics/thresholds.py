"""Threshold profiles as plain data: `nuplan` (the devkit's defaults) and `deepplan`.

The names follow the devkit's configuration keys.
"""

from dataclasses import dataclass, replace

from shiftsim.errors import one_of


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
    """The profile of a name, or the thresholds themselves.

    Raises:
        ConfigError: There is no profile of that name.
    """
    if isinstance(profile, Thresholds):
        return profile
    return PROFILES[one_of("threshold profile", profile, PROFILES)]
