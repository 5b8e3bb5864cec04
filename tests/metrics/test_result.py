"""The numbers of both profiles: the devkit's configuration and the paper's table."""

from dataclasses import asdict

from shiftsim.metrics.result import DEEPPLAN, NUPLAN, thresholds_of

DEVKIT = {
    "name": "nuplan",
    "max_abs_mag_jerk": 8.37,
    "max_abs_lat_accel": 4.89,
    "min_lon_accel": -4.05,
    "max_lon_accel": 2.40,
    "max_abs_lon_jerk": 4.13,
    "max_abs_yaw_accel": 1.93,
    "max_abs_yaw_rate": 0.95,
    "max_drivable_area_violation": 0.3,
    "driving_direction_compliance": 2.0,
    "driving_direction_violation": 6.0,
    "driving_direction_horizon": 1.0,
    "least_min_ttc": 0.95,
    "allowed_vru_collisions": 0,
    "allowed_vehicle_collisions": 0,
    "allowed_object_collisions": 1,
    "min_progress": 0.2,
    "score_progress": 2.0,
    "max_overspeed": 2.23,
    "max_lane_change_fail_rate": 0.3,
}
PAPER = {
    "name": "deepplan",
    "min_lon_accel": -6.0,
    "max_lon_accel": 4.0,
    "max_abs_lon_jerk": 6.0,
    "max_drivable_area_violation": 3.0,
    "driving_direction_compliance": 4.0,
    "driving_direction_violation": 10.0,
    "least_min_ttc": 0.5,
}


def test_the_profiles_are_those_of_the_devkit_and_of_the_paper() -> None:
    assert asdict(NUPLAN) == DEVKIT
    assert asdict(DEEPPLAN) == DEVKIT | PAPER


def test_profiles_are_found_by_name_and_own_ones_are_kept() -> None:
    assert thresholds_of("nuplan") is NUPLAN
    assert thresholds_of("deepplan") is DEEPPLAN
    assert thresholds_of(DEEPPLAN) is DEEPPLAN
