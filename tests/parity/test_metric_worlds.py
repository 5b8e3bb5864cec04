"""Metrics of small worlds in plain JSON against the official metric classes; no importer."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import places
import pytest
from json_worlds import read_world
from parity_cases import Cases, change_json, name_unknown, noticed, tracked

from shiftsim.metrics import DEEPPLAN, NUPLAN, Measurements, evaluate, measure
from shiftsim.metrics.collision import at_fault_counts
from shiftsim.metrics.comfort import BOUNDED_SIGNALS, within_bounds
from shiftsim.verify.rollouts import SCORES

pytestmark = [pytest.mark.golden, pytest.mark.reference("metric_worlds")]
ATOL = 1e-9


@pytest.mark.files("metric_world_*.json")
def test_world(path: Path, cases: Cases) -> None:
    """Scores under both profiles, and the series they follow from."""
    world, where = tracked(json.loads(path.read_text())), path.stem
    cases.note("metric_world world, kind: label")
    world.used |= {"world", "kind"}
    log, road = read_world(world)
    # a connector lies in a roadblock connector, a lane in a roadblock
    kinds, is_connector = road.block_of >= road.num_roadblocks, np.arange(len(road.edges))
    cases.compare(
        "kind of edges and their roadblocks", where, kinds, is_connector >= road.num_lanes
    )
    expected, measured = world["expected"], measure(log, road)
    flags = {}
    for name, profile in (("deepplan", DEEPPLAN), ("default", NUPLAN)):
        result, theirs = evaluate(measured, profile), expected[f"scores_{name}"]
        for metric, score in {**result.scores, "score": result.score}.items():
            if score is not None:
                atol = SCORES.get(metric, 0.0)
                cases.compare(
                    f"score {metric}", f"{where} {name}", score, theirs[metric], atol=atol
                )
        flags[name] = within_bounds(measured.comfort, profile)
    order = list(BOUNDED_SIGNALS.values())
    cases.compare("comfort_flag_order", where, order, expected["comfort_flag_order"])
    compare_series(cases, where, expected["series"], measured, road, result, flags)
    world.finish(cases, "metric_world")


def compare_series(
    cases: Cases,
    where: str,
    series: Any,
    measured: Measurements,
    road: Any,
    result: Any,
    flags: dict[str, Any],
) -> None:
    """Everything along the rollout; `result` is that of nuPlan's own thresholds."""
    samples, corners = range(len(measured.time_us)), measured.corners
    ours = {
        "driven_route": [measured.route.ids(road, i) for i in samples],
        "corner_routes": [[corners.ids(road, i, corner) for corner in range(4)] for i in samples],
        "common_or_connected": measured.lanes.is_common,
        "corners_in_drivable_area": ~measured.drivable.outside.any(axis=1),
        "at_fault_times": [one.time_us for one in measured.collisions if one.at_fault],
        "at_fault_counts": at_fault_counts(measured.collisions),
        "time_to_collision": np.where(np.isinf(measured.ttc.values), np.nan, measured.ttc.values),
        "overspeed": measured.overspeed,
        "progress_1s_along_lane": result.series["driving_direction_compliance"].values,
        "ego_progress": measured.progress.ego,
        "comfort_flags": flags["default"],
        "comfort_flags_deepplan": flags["deepplan"],
    }
    for name, value in ours.items():
        theirs = series[name]
        theirs = dict(theirs.items()) if isinstance(theirs, dict) else theirs
        cases.compare(name, where, value, theirs, atol=ATOL)
    statistics = {one.name: one.value for one in result.statistics}
    progress = series["progress_statistics"]
    for name in (
        "expert_total_progress_along_route",
        "ego_total_progress_along_route",
        "ego_expert_progress_along_route_ratio",
    ):
        label = f"progress_statistics {name}"
        cases.compare(label, where, statistics[name], progress[name], atol=ATOL)
    listed, contacts = series["collisions"], measured.collisions
    cases.compare("number of collisions", where, len(contacts), len(listed))
    for contact, theirs in zip(contacts, listed, strict=False):
        kind = f"{contact.collision_type.upper()}_COLLISION"
        mine = {"time_us": contact.time_us, "token": contact.token, "type": kind}
        for name, value in {**mine, "ego_delta_v": contact.delta_v}.items():
            at = f"{where} {contact.token}"
            cases.compare(f"collisions {name}", at, value, theirs[name], atol=ATOL)


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    name_unknown(folder, cases, "metric_world_*.json")


CRASH = "metric_world_18.json"


@pytest.mark.parametrize(
    "keys",
    [
        ("expected", "scores_default", "score"),
        ("expected", "scores_deepplan", "no_ego_at_fault_collisions"),
        ("expected", "series", "driven_route", 5),
        ("expected", "series", "corner_routes", 5, 2),
        ("expected", "series", "common_or_connected", 7),
        ("expected", "series", "corners_in_drivable_area", 7),
        ("expected", "series", "collisions"),
        ("expected", "series", "collisions", 0, "type"),
        ("expected", "series", "collisions", 0, "ego_delta_v"),
        ("expected", "series", "at_fault_times"),
        ("expected", "series", "at_fault_counts", "vehicles"),
        ("expected", "series", "time_to_collision", 3),
        ("expected", "series", "overspeed", 9),
        ("expected", "series", "progress_1s_along_lane", 20),
        ("expected", "series", "ego_progress", 20),
        ("expected", "series", "progress_statistics", "ego_total_progress_along_route"),
        ("expected", "series", "comfort_flags", 2),
        ("expected", "series", "comfort_flags_deepplan", 3),
        ("expected", "comfort_flag_order", 0),
        ("ego", 40, 0),
    ],
)
def test_a_changed_value_is_noticed(keys: tuple[Any, ...], tmp_path: Path) -> None:
    cases = Cases()
    change_json(places.GOLDEN / "metric_worlds" / CRASH, tmp_path / CRASH, *keys, amount=1e-2)
    assert noticed(test_world, tmp_path / CRASH, cases)


def test_an_unknown_series_is_named(tmp_path: Path) -> None:
    world, cases = json.loads((places.GOLDEN / "metric_worlds" / CRASH).read_text()), Cases()
    world["expected"]["series"]["novelty"] = [1]
    (tmp_path / CRASH).write_text(json.dumps(world))
    test_world(tmp_path / CRASH, cases)
    assert list(cases.not_covered) == ["metric_world expected series: field 'novelty'"]
