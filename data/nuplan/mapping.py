"""How a scenario is cut from a log: duration, offset and subsample ratio by scenario type."""

from shiftsim.errors import ConfigError
from shiftsim.kernels import IntArray

Mapping = tuple[float, float, float]

_NAMED: Mapping = (15.0, -3.0, 0.5)  # s, s, ratio; nuPlan rule 416
_OTHER: Mapping = (20.0, 0.0, 0.5)

# The scenario types that nuPlan's table names.
NAMED_TYPES = frozenset(
    """
    accelerating_at_crosswalk accelerating_at_stop_sign accelerating_at_stop_sign_no_crosswalk
    accelerating_at_traffic_light accelerating_at_traffic_light_with_lead
    accelerating_at_traffic_light_without_lead behind_bike behind_long_vehicle
    behind_pedestrian_on_driveable behind_pedestrian_on_pickup_dropoff changing_lane
    changing_lane_to_left changing_lane_to_right changing_lane_with_lead changing_lane_with_trail
    crossed_by_bike crossed_by_vehicle following_lane_with_lead following_lane_with_slow_lead
    following_lane_without_lead high_lateral_acceleration high_magnitude_jerk high_magnitude_speed
    low_magnitude_speed medium_magnitude_speed near_barrier_on_driveable
    near_construction_zone_sign near_high_speed_vehicle near_long_vehicle near_multiple_bikes
    near_multiple_pedestrians near_multiple_vehicles near_pedestrian_at_pickup_dropoff
    near_pedestrian_on_crosswalk near_pedestrian_on_crosswalk_with_ego
    near_trafficcone_on_driveable on_all_way_stop_intersection on_carpark on_intersection
    on_pickup_dropoff on_stopline_crosswalk on_stopline_stop_sign on_stopline_traffic_light
    on_traffic_light_intersection starting_high_speed_turn starting_left_turn
    starting_low_speed_turn starting_protected_cross_turn starting_protected_noncross_turn
    starting_right_turn starting_straight_stop_sign_intersection_traversal
    starting_straight_traffic_light_intersection_traversal starting_u_turn
    starting_unprotected_cross_turn starting_unprotected_noncross_turn stationary
    stationary_at_crosswalk stationary_at_traffic_light_with_lead
    stationary_at_traffic_light_without_lead stationary_in_traffic stopping_at_crosswalk
    stopping_at_stop_sign_no_crosswalk stopping_at_stop_sign_with_lead
    stopping_at_stop_sign_without_lead stopping_at_traffic_light_with_lead
    stopping_at_traffic_light_without_lead stopping_with_lead traversing_crosswalk
    traversing_intersection traversing_narrow_lane traversing_pickup_dropoff
    traversing_traffic_light_intersection waiting_for_pedestrian_to_cross
    """.split()
)


ROW_SECONDS = 0.05  # nominal distance of log rows


def ends_early(time_us: IntArray, end_us: int) -> bool:
    """Whether a log with rows at some times lacks a row before the end of a scenario [us]."""
    return bool(end_us - time_us[-1] > 0.9e6 * ROW_SECONDS)


def mapping_of(scenario_type: str) -> Mapping:
    """Duration [s], offset [s] and subsample ratio that nuPlan uses for a scenario type."""
    return _NAMED if scenario_type in NAMED_TYPES else _OTHER


def parse_mapping(text: str) -> Mapping:
    """A mapping from `DURATION,OFFSET,RATIO`, such as `15,0,0.5`.

    Raises:
        ConfigError: It does not consist of three sensible numbers.
    """
    hint = "write DURATION,OFFSET,RATIO in seconds, such as 15,0,0.5; 0 < RATIO <= 1"
    try:
        duration, offset, ratio = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"mapping {text!r} is not three numbers", hint=hint) from error
    if not (0.0 < duration <= 600.0 and abs(offset) <= 600.0 and 0.0 < ratio <= 1.0):
        raise ConfigError(f"mapping {text!r} is out of range", hint=hint)
    return duration, offset, ratio
