"""Which scenarios a nuPlan log offers, how they are cut from it, and the maps they are on."""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.data.nuplan.log import (
    Log,
    has_goals,
    make_tracks,
    read_boxes,
    read_ego,
    read_lights,
    read_route,
    read_types,
)
from shiftsim.data.nuplan.map import read_map
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.errors import ConfigError, ConversionError, DataError
from shiftsim.kernels import IntArray
from shiftsim.world.map import VectorMap

# duration [s], offset [s] and subsample ratio with which a scenario is cut from a log
Mapping = tuple[float, float, float]

_NAMED: Mapping = (15.0, -3.0, 0.5)  # s, s, ratio; nuPlan rule 416
_OTHER: Mapping = (20.0, 0.0, 0.5)

# the scenario types that nuPlan's table names
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
_PAST_SECONDS, _FUTURE_SECONDS = 3.0, 8.0  # kept around the window
# nuPlan rule 417: rows are counted where it looks back and ahead, so keep at least as many
PAST_ROWS, FUTURE_ROWS = 60, 161
_MIN_ITERATIONS = 3
EGO = "ego"


@dataclass(frozen=True)
class ScenarioEntry:
    """One scenario that a log offers."""

    token: str  # token of its anchor row
    scenario_type: str  # its tag; `unknown` without one
    log_name: str  # the log
    city: str  # map name
    time_us: int  # time stamp of the anchor [us]


def ends_early(time_us: IntArray, end_us: int) -> bool:
    """Whether a log with rows at some times lacks a row before the end of a scenario [us]."""
    return bool(end_us - time_us[-1] > 0.9e6 * ROW_SECONDS)


def mapping_of(scenario_type: str) -> Mapping:
    """Duration [s], offset [s] and subsample ratio that nuPlan uses for a scenario type."""
    return _NAMED if scenario_type in NAMED_TYPES else _OTHER


def parse_mapping(text: str) -> Mapping:
    """A mapping from `DURATION,OFFSET,RATIO`, such as `15,0,0.5`; else a ConfigError."""
    hint = "write DURATION,OFFSET,RATIO in seconds, such as 15,0,0.5; 0 < RATIO <= 1"
    try:
        duration, offset, ratio = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"mapping {text!r} is not three numbers", hint=hint) from error
    if not (0.0 < duration <= 600.0 and abs(offset) <= 600.0 and 0.0 < ratio <= 1.0):
        raise ConfigError(f"mapping {text!r} is out of range", hint=hint)
    return duration, offset, ratio


def offered(
    log: Log,
    tokens: frozenset[str] | None = None,
    types: frozenset[str] | None = None,
    *,
    remove_invalid_goals: bool = False,
) -> list[ScenarioEntry]:
    """The scenarios that nuPlan finds in a log, ordered by time; all tokens and types where None.

    nuPlan rule 418: with types, rows without a tag are not offered, whatever the types.
    Rows of the first two and of the last two scenes (by name) are not offered.
    `remove_invalid_goals` leaves out scenes without a goal.
    """
    keep = log.is_offered
    if remove_invalid_goals:
        keep = keep & has_goals(log)
    kinds = log.types if types is None else read_types(log, types)
    return [
        ScenarioEntry(token, kind, log.name, log.map_name, time_us)
        for token, kind, time_us, is_allowed in zip(
            log.tokens, kinds, log.time_us.tolist(), keep, strict=True
        )
        if is_allowed and (tokens is None or token in tokens) and (types is None or kind in types)
    ]


def iteration_rows(time_us: IntArray, anchor_us: int, mapping: Mapping) -> IntArray:
    """Rows of the iterations of a scenario by the time of its anchor row, nuPlan rule 417."""
    duration, offset, ratio = mapping
    start = int(anchor_us + offset * 1e6)
    first = int(np.searchsorted(time_us, start))
    last = int(np.searchsorted(time_us, int(start + duration * 1e6), side="right"))
    return np.arange(first, last, int(1.0 / ratio), dtype=np.int64)


def cut_window(
    log: Log, token: str, mapping: Mapping | None = None, scenario_type: str | None = None
) -> Window:
    """The rows of a scenario; the window counts rows from the start of the log.

    `token` names the anchor row; where `mapping` is None, it is nuPlan's for the type. That is the
    anchor's own where `scenario_type` is None. Raises ConversionError: the log does not have the
    token, or too few rows there.
    """
    if token not in log.row_of:
        raise ConversionError(f"{log.path}: there is no lidar_pc {token!r}", hint="check the token")
    row = log.row_of[token]
    scenario_type = scenario_type or log.types[row]
    chosen = mapping_of(scenario_type) if mapping is None else mapping
    anchor_us = int(log.time_us[row])
    start = int(anchor_us + chosen[1] * 1e6)
    end = int(start + chosen[0] * 1e6)
    iterations = iteration_rows(log.time_us, anchor_us, chosen)
    if len(iterations) < _MIN_ITERATIONS:
        raise ConversionError(
            f"{log.path}: scenario {token!r} has {len(iterations)} iterations",
            hint=f"at least {_MIN_ITERATIONS} are needed: choose another mapping",
        )
    still = iterations[:-1][np.diff(log.time_us[iterations]) == 0]
    if len(still):
        raise ConversionError(
            f"{log.path}: scenario {token!r} has two iterations at time stamp"
            f" {log.time_us[still[0]]}, the first is lidar_pc {log.tokens[int(still[0])]!r}",
            hint="nuPlan fails there, too: leave this scenario out",
        )
    early = int(np.searchsorted(log.time_us, start - int(_PAST_SECONDS * 1e6)))
    late = int(np.searchsorted(log.time_us, end + int(_FUTURE_SECONDS * 1e6), side="right"))
    route, goal = read_route(log, row)
    return Window(
        token=token,
        scenario_type=scenario_type,
        log_name=log.name,
        ego=EGO,
        first_row=max(min(early, int(iterations[0]) - PAST_ROWS), 0),
        last_row=min(max(late, int(iterations[-1]) + 1 + FUTURE_ROWS), len(log.time_us)),
        iteration_rows=iterations,
        row_step=int(1.0 / chosen[2]),
        route=route,
        mission_goal=goal,
        mapping=chosen,
        is_short=ends_early(log.time_us, end),
    )


def read_span(
    log: Log, name: str, first: int, last: int, flaws: Counter[str]
) -> tuple[Recording, EgoTrace]:
    """The rows first … last - 1 of a log as a recording of its own, with the ego."""
    flaws["lidar_pc: time stamp repeated"] += int((np.diff(log.time_us[first:last]) == 0).sum())
    recording = Recording(
        log_name=name,
        city=log.map_name,
        time_us=log.time_us[first:last].copy(),
        tracks=make_tracks(read_boxes(log, first, last, flaws), first, last, flaws),
        lights=read_lights(log, first, last, flaws),
    )
    return recording, EgoTrace(name, EGO, 0, read_ego(log, first, last, flaws))


def find_maps(folder: Path) -> dict[str, Path]:
    """Files `map.gpkg` by map name; a DataError where the index is missing or broken."""
    indexes = sorted(folder.glob("*maps*.json"))
    if not indexes:
        what = f"{folder}: no index such as nuplan-maps-v1.0.json"
        raise DataError(what, "give the folder that holds it, in nuPlan $NUPLAN_MAPS_ROOT")
    listed = [item for index in indexes for item in read_index(index).items()]
    return {name: folder / name / str(it["version"]) / "map.gpkg" for name, it in listed}


def read_index(path: Path) -> dict[str, Any]:
    """What an index lists of each map, its version at least, or a DataError."""
    try:
        listed: dict[str, Any] = json.loads(path.read_text("utf-8"))
        [entry["version"] for entry in listed.values()]
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        what = f"{path}: not an index of maps: {error!r}"
        raise DataError(what, hint="get it again, or choose another folder") from error
    return listed


def load_map(maps: dict[str, Path], name: str) -> VectorMap:
    """One of the maps found by `find_maps`, or a DataError."""
    if name not in maps:
        what = f"there is no map {name!r} in the map folder"
        raise DataError(what, hint=f"found: {', '.join(sorted(maps))}")
    return read_map(maps[name], name)
