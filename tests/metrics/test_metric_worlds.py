"""Golden worlds: equal to the official metric classes, and red as soon as one value is changed."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rollouts import WORLDS, load_world

from shiftsim.verify.report import Report
from shiftsim.verify.worlds import verify_metric_worlds

pytestmark = pytest.mark.golden
CRASH = next(path for path in WORLDS if path.stem.endswith("18"))
SPEEDING = next(path for path in WORLDS if path.stem.endswith("20"))


def verify(folder: Path) -> Report:
    report = Report()
    verify_metric_worlds(folder, report)
    return report


def test_golden_worlds_agree_under_both_profiles() -> None:
    report = verify(WORLDS[0].parent)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.num_cases > 200


def test_all_reference_worlds_agree(shared: Path) -> None:
    report = verify(shared / "reference" / "metric_worlds")
    assert report.mismatches == []
    assert report.not_covered == {}


def swap(path: str, change: Callable[[Any], Any]) -> Callable[[dict[str, Any]], None]:
    """Replace the value at a dotted path."""

    def apply(world: dict[str, Any]) -> None:
        *parents, last = [int(key) if key.isdigit() else key for key in path.split(".")]
        node: Any = world
        for key in parents:
            node = node[key]
        node[last] = change(node[last])

    return apply


def negate(value: Any) -> Any:
    return not value


def add(value: float) -> float:
    return value + 1e-6


FALSIFIED = {
    "scores_default.score": add,
    "scores_deepplan.ego_progress_along_expert_route": add,
    "scores_deepplan.no_ego_at_fault_collisions": add,
    "series.driven_route.5": lambda ids: [*ids, "999"],
    "series.corner_routes.5.2": lambda ids: ids[1:],
    "series.common_or_connected.7": lambda flag: 1 - flag,
    "series.corners_in_drivable_area.7": lambda flag: 1 - flag,
    "series.collisions": lambda contacts: contacts[1:],
    "series.collisions.0.time_us": lambda time: time + 1,
    "series.collisions.0.token": lambda token: token + "0",
    "series.collisions.0.type": lambda kind: kind.replace("ACTIVE", "STOPPED"),
    "series.collisions.0.ego_delta_v": add,
    "series.at_fault_times": lambda times: times[:-1],
    "series.at_fault_counts.vehicles": lambda count: count + 1,
    "series.time_to_collision.3": lambda value: 0.3 if value is None else None,
    "series.overspeed.9": add,
    "series.progress_1s_along_lane.20": add,
    "series.ego_progress.20": add,
    "series.progress_statistics.expert_total_progress_along_route": add,
    "series.comfort_flags.2": negate,
    "series.comfort_flags_deepplan.3": negate,
    "comfort_flag_order.0": lambda name: name + "x",
}


@pytest.mark.parametrize("path", FALSIFIED)
def test_a_changed_expectation_turns_the_report_red(path: str, tmp_path: Path) -> None:
    world = load_world(CRASH)
    swap(f"expected.{path}", FALSIFIED[path])(world)
    (tmp_path / CRASH.name).write_text(json.dumps(world))
    assert verify(tmp_path).exit_code() == 1


CHANGED_INPUT = {
    "time_us.108": lambda time: time + 40_000,
    "ego.40.0": lambda x: x + 0.01,
    "ego.40.3": lambda v: v + 0.01,
    "expert.109.0": lambda x: x - 5.0,
    "map.edges.0.polygon.0.0": lambda x: x + 40.0,
    "map.edges.0.speed_limit": lambda limit: limit - 1.0,
    "map.edges.0.kind": lambda kind: "connector",
    "map.edges.0.outgoing": lambda ids: [*ids, "nowhere"],
    "map.edges.0.baseline": lambda points: points[::-1],
    "map.edges.0.roadblock": lambda name: "nowhere",
    "map.drivable_area": lambda rings: [*rings, "x"],
    "map.roadblocks.R1.kind": lambda kind: "roadblock_connector",
    "state_columns.3": lambda name: "speed",
    "objects.0.frames": lambda frames: frames[:-1],
}


@pytest.mark.parametrize("path", CHANGED_INPUT)
def test_a_changed_input_turns_the_report_red(path: str, tmp_path: Path) -> None:
    world = load_world(SPEEDING)
    swap(path, CHANGED_INPUT[path])(world)
    (tmp_path / SPEEDING.name).write_text(json.dumps(world))
    assert verify(tmp_path).exit_code() == 1


@pytest.mark.parametrize("key", ["time_us", "ego", "objects", "map", "expected"])
def test_a_world_without_a_part_is_a_mismatch(key: str, tmp_path: Path) -> None:
    world = load_world(CRASH)
    del world[key]
    (tmp_path / CRASH.name).write_text(json.dumps(world))
    assert verify(tmp_path).exit_code() == 1


def test_a_truncated_file_is_a_mismatch(tmp_path: Path) -> None:
    (tmp_path / CRASH.name).write_text(CRASH.read_text()[:1000])
    assert verify(tmp_path).exit_code() == 1


def test_an_unknown_series_is_named_as_not_covered(tmp_path: Path) -> None:
    world = load_world(CRASH)
    world["expected"]["series"]["novelty"] = [1]
    (tmp_path / CRASH.name).write_text(json.dumps(world))
    report = verify(tmp_path)
    assert list(report.not_covered) == ["metric_world expected series: field 'novelty'"]
    assert report.exit_code(require_all=True) == 3
