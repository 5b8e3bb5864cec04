"""Time to collision against a slow projection with shapely, and the verdict on it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from hypothesis import given
from rollouts import boxes, states_of
from strategies import seeds
from worlds import join_tracks

from shiftsim.geometry.boxes import BEHIND, boxes_to_corners
from shiftsim.metrics import collision
from shiftsim.metrics.result import NUPLAN, Collision, Violation
from shiftsim.metrics.time_to_collision import TimeToCollision, evaluate, time_to_collision
from shiftsim.world.layers import make_layer
from shiftsim.world.state import PACIFICA, AgentKind, Tracks

CROSSING = shapely.box(-10.0, 0.0, 10.0, 10.0)
ROAD = SimpleNamespace(intersections=make_layer(["9"], [CROSSING]))
TIMES = 1_000_000 + 100_000 * np.arange(5, dtype=np.int64)


def random_scene(seed: int, samples: int = 4, count: int = 5) -> tuple[np.ndarray, Tracks]:
    """An ego and boxes around it, slow ones and fast ones, on the way to each other or not."""
    rng = np.random.default_rng(seed)
    poses = rng.uniform([-9.0, -9.0, -3.0], [9.0, 9.0, 3.0], (samples, 3))
    states = states_of(poses, rng.choice([0.0, 0.005, 0.006, 2.0, 10.0], samples))
    shape = (samples, count)
    tracks = Tracks(
        rng.random(shape) < 0.9,
        rng.uniform([-30.0, -30.0, -3.0], [30.0, 30.0, 3.0], (*shape, 3)),
        rng.uniform(-9.0, 9.0, (*shape, 2)) * (rng.random(shape) < 0.7)[..., None],
        rng.uniform(0.5, 5.0, (*shape, 2)),
        rng.integers(0, 7, count),
        tuple(f"t{index}" for index in range(count)),
    )
    return states, tracks


def slow_time(
    states: np.ndarray, tracks: Tracks, first: np.ndarray, is_common: np.ndarray, sample: int
) -> tuple[float, int]:
    """Time to collision at one sample and the track; nobody is at fault."""
    ego = collision.flat_ego(states, PACIFICA)
    speed, (x, y, heading) = states[sample, 3], states[sample, :3]
    if speed <= 0.005:
        return np.inf, -1
    beside = not is_common[sample] or shapely.contains_xy(CROSSING, x, y)
    moving = []
    for track in range(tracks.num_tracks):
        dx, dy = tracks.poses[sample, track, :2] - [x, y]
        angle = abs((np.arctan2(dy, dx) - heading + np.pi) % (2.0 * np.pi) - np.pi)
        near = angle < np.deg2rad(30.0) or (angle <= np.deg2rad(150.0) and beside)
        if tracks.valid[sample, track] and first[track] > sample and near:
            moving.append(track)
    for k in range(1, 30):
        ahead = 0.1 * k * speed * np.array([np.cos(heading), np.sin(heading)])
        box = shapely.Polygon(ego.corners[sample] + ahead)
        for track in moving:
            turn, velocity = tracks.poses[sample, track, 2], tracks.velocities[sample, track]
            fast = 0.0 if tracks.kinds[track] > 2 else np.hypot(*velocity)
            corners = boxes_to_corners(tracks.poses[sample, track], tracks.sizes[sample, track])
            corners = corners + 0.1 * k * fast * np.array([np.cos(turn), np.sin(turn)])
            if box.intersects(shapely.Polygon(corners)):
                return 0.1 * k, track
    return np.inf, -1


def measured(
    states: np.ndarray, tracks: Tracks, is_common: np.ndarray, blamed: tuple[Collision, ...] = ()
) -> tuple[TimeToCollision, np.ndarray]:
    ego, flat = collision.flat_ego(states, PACIFICA), collision.flat_tracks(tracks)
    contacts = collision.first_contacts(ego, flat)
    ttc = time_to_collision(ego, flat, contacts, blamed, is_common, ROAD, tracks)
    return ttc, contacts.first


@given(seeds)
def test_times_and_partners_are_those_of_a_slow_projection(seed: int) -> None:
    states, tracks = random_scene(seed)
    is_common = np.random.default_rng(seed).random(len(states)) < 0.5
    ttc, first = measured(states, tracks, is_common)
    for sample in range(len(states)):
        value, partner = slow_time(states, tracks, first, is_common, sample)
        assert ttc.values[sample] == pytest.approx(value, abs=1e-12)
        assert ttc.partners[sample] == partner


def ahead(*gaps: float, speed: float = 0.0) -> Tracks:
    """Boxes on the ego's line, behind one another, at gaps from its front bumper [m]."""
    bumper = PACIFICA.rear_axle_to_center + PACIFICA.length / 2.0
    parts = [boxes(5, (bumper + gap + 2.0, 0.0, 0.0)) for gap in gaps]
    tracks = join_tracks(parts)
    tracks.velocities[..., 0] = speed
    return tracks


@pytest.mark.parametrize(
    ("gap", "speed", "expected"),
    [
        (28.99, 10.0, 2.9),  # 29 steps are tested, the horizon itself is not
        (29.01, 10.0, np.inf),
        (0.05, 10.0, 0.1),
        (0.005, 0.005, np.inf),  # the ego counts as standing
        (0.005, 0.0051, 1.0),
    ],
)
def test_the_steps_and_the_slowest_speed_are_nuplans(
    gap: float, speed: float, expected: float
) -> None:
    states = states_of(np.zeros((5, 3)), speed)
    ttc, _ = measured(states, ahead(gap), np.ones(5, np.bool_))
    np.testing.assert_allclose(ttc.values, expected, rtol=0.0, atol=1e-12)


def test_boxes_that_just_touch_are_hit() -> None:
    # less than 1e-6 m decides: on corners
    states = states_of(np.zeros((5, 3)), 10.0)
    for gap, expected in ((5.0 - 5e-7, 0.5), (5.0 + 5e-7, 0.6)):
        ttc, _ = measured(states, ahead(gap), np.ones(5, np.bool_))
        np.testing.assert_allclose(ttc.values, expected, rtol=0.0, atol=1e-12)


def test_the_nearer_of_two_tracks_is_the_partner_whatever_their_order() -> None:
    states = states_of(np.zeros((5, 3)), 10.0)
    for gaps, partner in (((5.0, 12.0), 0), ((12.0, 5.0), 1)):
        ttc, _ = measured(states, ahead(*gaps), np.ones(5, np.bool_))
        np.testing.assert_allclose(ttc.values, 0.5, rtol=0.0, atol=0.11)
        assert ttc.partners.tolist() == [partner] * 5


def test_at_an_at_fault_collision_the_time_is_zero_and_the_partner_the_first_that_is_blamed() -> (
    None
):
    states, tracks = states_of(np.zeros((5, 3)), 10.0), ahead(12.0, 90.0, 95.0)
    tracks = replace(tracks, tokens=("a", "b", "c"))

    def hit(sample: int, token: str, at_fault: bool) -> Collision:
        return Collision(sample, int(TIMES[sample]), token, 0, "active_front", 1.0, at_fault)

    blamed = (hit(1, "b", False), hit(2, "c", True), hit(2, "b", True), hit(4, "b", True))
    ttc, _ = measured(states, tracks, np.ones(5, np.bool_), blamed)
    assert ttc.partners.tolist() == [0, 0, 2, 0, 1]
    np.testing.assert_allclose(ttc.values[[2, 4]], 0.0)
    assert (ttc.values[[0, 1, 3]] > 1.0).all()
    assert evaluate(ttc, TIMES, NUPLAN).row.violation == Violation(2, int(TIMES[2]), "c", 0.0)


def test_a_track_at_exactly_the_angle_is_not_behind() -> None:
    x, y = 8.0 * np.cos(BEHIND), 8.0 * np.sin(BEHIND)  # the bearing is BEHIND to the last bit
    states = states_of(np.zeros((5, 3)), 0.01)
    for nearer, seen in ((0.0, True), (-1e-9, False)):
        other = boxes(5, (x, y + nearer, -np.deg2rad(30.0)))
        other.velocities[..., 0] = 9.0
        ttc, _ = measured(states, other, np.zeros(5, np.bool_))
        assert np.isfinite(ttc.values).all() == seen


def test_static_objects_do_not_move() -> None:
    states = states_of(np.zeros((5, 3)), 10.0)
    cone = boxes(5, (20.0, 0.0, 0.0), velocity=(10.0, 0.0), kind=AgentKind.TRAFFIC_CONE)
    cone.poses[..., 0] = 20.0
    assert (measured(states, cone, np.ones(5, np.bool_))[0].values < 2.0).all()


@pytest.mark.parametrize(("lowest", "score"), [(0.95, 0.0), (np.nextafter(0.95, 1.0), 1.0)])
def test_the_bound_must_be_exceeded(lowest: float, score: float) -> None:
    values = np.array([np.inf, 2.0, lowest, 1.5, lowest])
    ttc = TimeToCollision(values, np.array([-1, 1, -1, 0, 0]), ("a", "b"))
    part = evaluate(ttc, TIMES, NUPLAN)
    assert part.row.score == score
    assert part.row.value == lowest
    assert [s.value for s in part.statistics] == [lowest, score]
    expected = Violation(2, int(TIMES[2]), None, lowest) if score == 0.0 else None
    assert part.row.violation == expected


def test_the_partner_of_the_first_violation_is_named() -> None:
    ttc = TimeToCollision(np.array([3.0, 0.5, 0.4]), np.array([1, 0, 1]), ("a", "b"))
    assert evaluate(ttc, TIMES, NUPLAN).row.violation == Violation(1, int(TIMES[1]), "a", 0.5)
