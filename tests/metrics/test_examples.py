"""Each metric on a straight road, with numbers that can be checked by hand."""

import numpy as np
import pytest
from rollouts import boxes, rollout, states_of, straight_poses
from worlds import join_tracks, straight_road

from shiftsim.metrics import MetricResult, MetricRow, compute_metrics, evaluate, measure
from shiftsim.metrics.result import Thresholds
from shiftsim.world.state import VX, AgentKind, Tracks

K = 60
ROAD = straight_road()
FRONT = 4.049  # m, rear axle to front bumper


def row(result: MetricResult, metric: str) -> MetricRow:
    return next(r for r in result.rows if r.metric == metric)


def score(result: MetricResult, metric: str) -> float | None:
    return result.scores[metric]


def drive(tracks: Tracks | None = None, **kwargs: float) -> MetricResult:
    states = states_of(straight_poses(K, **kwargs), kwargs.get("speed", 10.0))
    return compute_metrics(rollout(states, tracks=tracks), ROAD)


def test_an_undisturbed_drive_loses_only_the_missing_last_sample() -> None:
    result = drive()
    assert score(result, "ego_progress_along_expert_route") == pytest.approx(59 / 60, abs=1e-9)
    others = {m: s for m, s in result.scores.items() if s is not None and "progress_al" not in m}
    assert set(others.values()) == {1.0}
    assert result.score == pytest.approx((5 * 59 / 60 + 5 + 4 + 2) / 16, abs=1e-12)


def test_driving_into_a_standing_vehicle_is_the_egos_fault() -> None:
    # bumper gap 20 m, 10 m/s: first contact at sample 20
    gap = 20.0
    result = drive(boxes(K, (20.0 + FRONT + gap + 2.0, 0.0, 0.0)))
    (contact,) = result.measurements.collisions
    assert (contact.collision_type, contact.at_fault) == ("stopped_track", True)
    assert contact.iteration in (20, 21)
    assert contact.delta_v == pytest.approx(5.0)
    assert score(result, "no_ego_at_fault_collisions") == 0.0
    assert score(result, "time_to_collision_within_bound") == 0.0
    violation = row(result, "no_ego_at_fault_collisions").violation
    assert violation is not None
    assert violation.partner == "t0"


def test_being_hit_from_behind_is_not_the_egos_fault() -> None:
    result = drive(boxes(K, (10.0, 0.0, 0.0), velocity=(15.0, 0.0)))
    (contact,) = result.measurements.collisions
    assert (contact.collision_type, contact.at_fault) == ("active_rear", False)
    assert score(result, "no_ego_at_fault_collisions") == 1.0


def test_a_standing_ego_is_never_at_fault() -> None:
    result = drive(boxes(K, (40.0, 0.0, np.pi), velocity=(-10.0, 0.0)), speed=0.0)
    (contact,) = result.measurements.collisions
    assert (contact.collision_type, contact.at_fault) == ("stopped_ego", False)


def test_a_side_swipe_inside_one_lane_is_not_the_egos_fault() -> None:
    result = drive(boxes(K, (21.461, 3.0, 0.0), velocity=(10.0, -0.5)))
    (contact,) = result.measurements.collisions
    assert (contact.collision_type, contact.at_fault) == ("active_lateral", False)


@pytest.mark.parametrize(("count", "expected"), [(1, 0.5), (2, 0.0)])
def test_one_static_object_halves_the_score_and_two_zero_it(count: int, expected: float) -> None:
    cones = [(40.0 + 10.0 * index, 0.0, 0.0) for index in range(count)]
    result = drive(boxes(K, *cones, kind=AgentKind.TRAFFIC_CONE, size=(0.4, 0.4)))
    assert score(result, "no_ego_at_fault_collisions") == expected


def test_a_pedestrian_costs_everything() -> None:
    walker = boxes(K, (40.0, -2.0, 0.0), velocity=(0.0, 1.0), kind=AgentKind.PEDESTRIAN)
    assert score(drive(walker), "no_ego_at_fault_collisions") == 0.0


@pytest.mark.parametrize(
    ("gap", "ttc", "nuplan", "deepplan"), [(9.9, 1.0, 1, 1), (5.1, 0.6, 0, 1), (4.6, 0.5, 0, 0)]
)
def test_time_to_collision_of_a_standing_lead(
    gap: float, ttc: float, nuplan: int, deepplan: int
) -> None:
    # the ego creeps so that the gap hardly changes, while its speed says 10 m/s
    poses = straight_poses(K, speed=0.0)
    lead = boxes(K, (20.0 + FRONT + gap + 2.0, 0.0, 0.0))
    measured = measure(rollout(states_of(poses, 10.0), tracks=lead), ROAD)
    np.testing.assert_allclose(measured.ttc.values, ttc, rtol=0, atol=1e-12)
    metric = "time_to_collision_within_bound"
    assert evaluate(measured, "nuplan").scores[metric] == nuplan
    assert evaluate(measured, "deepplan").scores[metric] == deepplan


def test_a_stopped_ego_never_violates_the_time_to_collision() -> None:
    result = drive(boxes(K, (30.0, 0.0, np.pi), velocity=(-0.1, 0.0)), speed=0.0)
    assert row(result, "time_to_collision_within_bound").value == np.inf


def test_a_vehicle_in_the_next_lane_does_not_count_for_the_time_to_collision() -> None:
    result = drive(boxes(K, (22.0, 3.5, -0.3), velocity=(10.0, 0.0)))
    assert row(result, "time_to_collision_within_bound").value == np.inf


@pytest.mark.parametrize(
    ("out", "nuplan", "deepplan"), [(0.2985, 1, 1), (0.3485, 0, 1), (3.1, 0, 0)]
)
def test_drivable_area_tolerates_corners_up_to_the_threshold(
    out: float, nuplan: int, deepplan: int
) -> None:
    y = -(1.75 + out - 2.297 / 2)  # the right corners are `out` beyond the road's edge
    measured = measure(rollout(states_of(straight_poses(K, y=y), 10.0)), ROAD)
    assert evaluate(measured, "nuplan").scores["drivable_area_compliance"] == nuplan
    assert evaluate(measured, "deepplan").scores["drivable_area_compliance"] == deepplan
    np.testing.assert_allclose(measured.drivable.distances.max(), out, rtol=0, atol=1e-9)
    assert not evaluate(measured).series["corners_in_drivable_area"].values.any()


@pytest.mark.parametrize(("speed", "expected"), [(1.5, 1.0), (5.0, 0.5), (8.0, 0.0)])
def test_reversing_is_measured_over_eleven_samples(speed: float, expected: float) -> None:
    poses = straight_poses(K, speed=-speed, x=150.0)
    result = compute_metrics(rollout(states_of(poses, -speed)), ROAD)
    assert score(result, "driving_direction_compliance") == expected
    assert row(result, "driving_direction_compliance").value == pytest.approx(1.1 * speed)


def test_speeding_costs_the_excess_over_the_duration() -> None:
    result = drive(speed=16.0)  # 1 m/s above the limit: K terms over K - 1 intervals
    expected = 1.0 - 1.0 * K / (K - 1) / 2.23
    assert score(result, "speed_limit_compliance") == pytest.approx(expected, abs=1e-6)
    statistics = {s.name: s.value for s in result.statistics}
    assert statistics["number_of_violations_of_speed_limit_compliance"] == 1
    assert statistics["mean_violation_of_speed_limit_compliance"] == pytest.approx(1.0)


def test_a_missing_speed_limit_costs_nothing() -> None:
    states = states_of(straight_poses(K, speed=30.0), 30.0)
    result = compute_metrics(rollout(states), straight_road(speed_limit=None))
    assert score(result, "speed_limit_compliance") == 1.0


def test_standing_where_the_expert_drove_makes_no_progress() -> None:
    expert = states_of(straight_poses(K + 1), 10.0)
    result = compute_metrics(
        rollout(states_of(straight_poses(K, speed=0.0), 0.0), expert=expert), ROAD
    )
    assert score(result, "ego_progress_along_expert_route") == pytest.approx(2.0 / 60.0)
    assert score(result, "ego_is_making_progress") == 0.0


def test_an_expert_off_every_lane_gives_full_progress() -> None:
    expert = states_of(straight_poses(K + 1, y=50.0), 10.0)
    result = compute_metrics(rollout(states_of(straight_poses(K), 10.0), expert=expert), ROAD)
    assert score(result, "ego_progress_along_expert_route") == 1.0
    assert "ego_progress_along_expert_route" not in result.series


def test_a_lane_change_is_counted_and_passes() -> None:
    poses = straight_poses(K)
    poses[:, 1] = np.interp(np.arange(K), [20, 40], [0.0, 3.5])
    result = compute_metrics(rollout(states_of(poses, 10.0)), ROAD)
    lanes = result.measurements.lanes
    assert len(lanes.start) == 1
    assert not lanes.failed[0]
    assert not lanes.is_common[lanes.start[0] : lanes.end[0]].any()


def test_returning_to_the_old_lane_is_a_failed_lane_change() -> None:
    poses = straight_poses(K)
    poses[:, 1] = np.interp(np.arange(K), [10, 20, 30], [0.0, 1.75, 0.0])
    result = compute_metrics(rollout(states_of(poses, 10.0)), ROAD)
    assert result.measurements.lanes.failed.tolist() == [True]
    assert score(result, "ego_lane_change") is None


def test_a_harsh_brake_is_uncomfortable_and_says_where() -> None:
    states = states_of(straight_poses(K), 10.0)
    states[30:, 5] = -5.0
    result = compute_metrics(rollout(states), ROAD)
    assert score(result, "ego_is_comfortable") == 0.0
    violation = row(result, "ego_lon_acceleration").violation
    assert violation is not None
    assert 26 <= violation.iteration <= 33
    assert row(result, "ego_lon_acceleration").threshold == -4.05


def test_simultaneous_contacts_are_listed_by_type() -> None:
    cone = boxes(K, (40.0, 0.9, 0.0), kind=AgentKind.BARRIER, size=(2.0, 0.5))
    car = boxes(K, (40.0, -0.9, 0.0), size=(2.0, 0.5))
    from dataclasses import replace

    both = join_tracks([replace(cone, tokens=("barrier",)), replace(car, tokens=("car",))])
    result = drive(both)
    assert [c.token for c in result.measurements.collisions] == ["car", "barrier"]


def test_own_thresholds_are_named_in_the_result() -> None:
    states = states_of(straight_poses(K), 10.0)
    strict = Thresholds("strict", min_progress=0.99)
    result = compute_metrics(rollout(states), ROAD, thresholds=strict)
    assert result.thresholds == "strict"
    assert score(result, "ego_is_making_progress") == 0.0


def test_the_ego_speed_is_that_of_the_rear_axle() -> None:
    states = states_of(straight_poses(K), 10.0)
    states[:, VX + 1] = 12.0  # hypot 15.62, limit 15
    result = compute_metrics(rollout(states), ROAD)
    assert row(result, "speed_limit_compliance").value == pytest.approx(np.hypot(10, 12) - 15)
