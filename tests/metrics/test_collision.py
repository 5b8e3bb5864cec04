"""Contacts against a slow search with shapely, the borders between their types, and the verdict."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from rollouts import boxes, states_of, straight_poses
from strategies import seeds
from worlds import join_tracks

from shiftsim.geometry.boxes import BEHIND, boxes_to_corners
from shiftsim.metrics import collision
from shiftsim.metrics.collision import (
    COLLISION_TYPES,
    Contacts,
    classify,
    collide,
    evaluate,
    set_box,
)
from shiftsim.metrics.result import NUPLAN, Collision, Thresholds, Violation
from shiftsim.world.state import PACIFICA, VY, AgentKind, Tracks

TIMES = 1_000_000 + 100_000 * np.arange(12, dtype=np.int64)
BUMPER = PACIFICA.rear_axle_to_center + PACIFICA.length / 2.0  # from the rear axle [m]


def made_box(pose: np.ndarray, size: np.ndarray) -> np.ndarray:
    out = np.empty(collision.BOX_SIZE)
    set_box(out, pose, *size)
    return out


@given(seeds)
def test_boxes_collide_where_shapely_says_so(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        poses = rng.uniform(-4.0, 4.0, (2, 3))
        sizes = rng.uniform(0.2, 6.0, (2, 2))
        one, other = (shapely.Polygon(c) for c in boxes_to_corners(poses, sizes))
        a, b = (made_box(*box) for box in zip(poses, sizes, strict=True))
        assert collide(a, b, np.empty((2, 4, 2))) == one.intersects(other)


@given(seeds)
def test_boxes_that_touch_but_for_rounding_are_decided_on_their_corners(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        heading, size = rng.uniform(-3.0, 3.0), rng.uniform(0.2, 6.0, (2, 2))
        ahead = 0.5 * (size[0, 0] + size[1, 0]) + rng.choice([-1e-15, 0.0, 1e-15])
        poses = np.array([[*rng.uniform(-4.0, 4.0, 2), heading]] * 2)
        poses[1, :2] += ahead * np.array([np.cos(heading), np.sin(heading)])
        one, other = (shapely.Polygon(c) for c in boxes_to_corners(poses, size))
        a, b = (made_box(*box) for box in zip(poses, size, strict=True))
        assert collide(a, b, np.empty((2, 4, 2))) == one.intersects(other)


@pytest.mark.parametrize("gap", [1e-3, 1e-5, 1e-7, 1e-9, 1e-12])
@pytest.mark.parametrize("place", [(4.0, 0.0), (0.0, 2.0), (-4.0, 0.3), (0.3, -2.0)])
def test_boxes_collide_until_the_gap_is_there(gap: float, place: tuple[float, float]) -> None:
    # both at an angle at which no number is round, so that the exact test decides the last digits
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    size, scratch = np.array([4.0, 2.0]), np.empty((2, 4, 2))
    away = np.sign(place) * (np.abs(place) >= 2.0)
    for side, expected in ((1.0, False), (-1.0, True)):
        pose = np.array([*((np.array(place) + side * gap * away) @ turn), 0.3])
        ego = made_box(np.array([0.0, 0.0, 0.3]), size)
        assert collide(ego, made_box(pose, size), scratch) == expected
        assert collide(made_box(pose, size), ego, scratch) == expected


SPEEDS = np.array([0.0, 0.04, 0.05, 0.0500001, 0.06, 3.0, 9.0])


def random_scene(seed: int, samples: int = 6, count: int = 5) -> tuple[np.ndarray, Tracks]:
    """An ego that jumps about, and boxes near it of every kind; some come and go."""
    rng = np.random.default_rng(seed)
    states = states_of(rng.uniform(-3.0, 3.0, (samples, 3)), rng.choice(SPEEDS, samples))
    shape = (samples, count)
    velocity = rng.choice(SPEEDS, shape)
    angle = rng.choice([0.0, 0.5 * np.pi, np.pi, 1.0], shape)
    tracks = Tracks(
        rng.random(shape) < 0.8,
        rng.uniform([-9.0, -9.0, -3.0], [9.0, 9.0, 3.0], (*shape, 3)),
        np.stack([np.cos(angle), np.sin(angle)], -1).round(3) * velocity[..., None],
        rng.uniform(0.5, 5.0, (*shape, 2)),
        rng.integers(0, 7, count),
        tuple(f"t{index}" for index in range(count)),
    )
    return states, tracks


def slow_contacts(states: np.ndarray, tracks: Tracks) -> list[tuple[int, int, float, str, float]]:
    """Track, sample, ego speed, type and change of speed of the first contact with each track."""
    ego = collision.flat_ego(states, PACIFICA)
    found = []
    for track in range(tracks.num_tracks):
        for i in range(len(states)):
            corners = boxes_to_corners(tracks.poses[i, track], tracks.sizes[i, track])
            box, other = shapely.Polygon(ego.corners[i]), shapely.Polygon(corners)
            if not tracks.valid[i, track] or not box.intersects(other):
                continue
            x, y, heading = states[i, :3]
            dx, dy = tracks.poses[i, track, :2] - [x, y]
            angle = abs((np.arctan2(dy, dx) - heading + np.pi) % (2.0 * np.pi) - np.pi)
            v, w = np.hypot(*states[i, 3:5]), np.hypot(*tracks.velocities[i, track])
            w = 0.0 if tracks.kinds[track] > 2 else w
            front = shapely.LineString(ego.corners[i, [0, 3]])
            side = "active_front" if front.intersects(other) else "active_lateral"
            kind = (
                "stopped_ego"
                if v <= 0.05
                else "stopped_track"
                if w <= 0.05
                else "active_rear"
                if angle > np.deg2rad(150.0)
                else side
            )
            turn = heading - tracks.poses[i, track, 2]
            both = np.array([v - w * np.cos(turn), w * np.sin(turn)])
            found.append((track, i, v, kind, 0.5 * np.hypot(*both)))
            break
    return found


@given(seeds)
def test_first_contacts_are_those_of_a_slow_search(seed: int) -> None:
    states, tracks = random_scene(seed)
    states[:, VY] = np.random.default_rng(seed).choice([0.0, 2.0], len(states))
    contacts = collision.first_contacts(
        collision.flat_ego(states, PACIFICA), collision.flat_tracks(tracks)
    )
    expected = slow_contacts(states, tracks)
    hit = [track for track, *_ in expected]
    assert np.flatnonzero(contacts.first < len(states)).tolist() == hit
    assert contacts.first[hit].tolist() == [sample for _, sample, *_ in expected]
    assert [COLLISION_TYPES[kind] for kind in contacts.types[hit]] == [
        kind for *_, kind, _ in expected
    ]
    np.testing.assert_allclose(contacts.delta_v[hit], [dv for *_, dv in expected], atol=1e-9)


@pytest.mark.parametrize(
    ("ego", "other", "kind"),
    [
        (0.05, 9.0, "stopped_ego"),
        (0.0500001, 0.05, "stopped_track"),
        (0.0500001, 0.0500001, "active_front"),
    ],
)
def test_up_to_five_centimetres_per_second_count_as_standing(
    ego: float, other: float, kind: str
) -> None:
    states = states_of(straight_poses(4, speed=0.0), ego)
    ahead = boxes(4, (20.0 + BUMPER + 1.0, 0.0, 0.0))
    ahead.velocities[..., 0] = other
    contacts = collision.first_contacts(
        collision.flat_ego(states, PACIFICA), collision.flat_tracks(ahead)
    )
    assert COLLISION_TYPES[contacts.types[0]] == kind


def test_a_track_at_exactly_the_angle_is_not_behind() -> None:
    x, y = 8.0 * np.cos(BEHIND), 8.0 * np.sin(BEHIND)  # the bearing is BEHIND to the last bit
    states = states_of(np.zeros((4, 3)), 3.0)
    for nearer, kind in ((0.0, "active_lateral"), (-1e-9, "active_rear")):
        beside = boxes(4, (x, y + nearer, 0.0), size=(12.0, 6.0))
        beside.velocities[..., 0] = 3.0
        contacts = collision.first_contacts(
            collision.flat_ego(states, PACIFICA), collision.flat_tracks(beside)
        )
        assert COLLISION_TYPES[contacts.types[0]] == kind


def test_contacts_are_judged_by_type_and_by_the_lanes_at_their_own_sample() -> None:
    kinds = [AgentKind.TRAFFIC_CONE, *[AgentKind.VEHICLE] * 5]
    tracks = join_tracks([boxes(12, (0.0, 0.0, 0.0), kind=kind) for kind in kinds])
    contacts = Contacts(np.array([4, 4, 2, 3, 12, 7]), np.array([1, 0, 4, 4, 3, 3]), np.arange(6.0))
    is_common = np.ones(12, np.bool_)
    is_common[3] = False
    found = classify(contacts, TIMES, tracks, is_common)
    rows = [(c.iteration, c.kind, c.collision_type, c.delta_v, c.at_fault) for c in found]
    assert rows == [
        (2, 0, "active_lateral", 2.0, False),
        (3, 0, "active_lateral", 3.0, True),
        (4, 0, "stopped_ego", 1.0, False),
        (4, int(AgentKind.TRAFFIC_CONE), "stopped_track", 0.0, True),
        (7, 0, "active_front", 5.0, True),
    ]
    assert [c.time_us for c in found] == TIMES[[2, 3, 4, 4, 7]].tolist()
    assert all(type(c.at_fault) is bool for c in found)  # as JSON needs it


def hits(kind: AgentKind, *delta_v: float, at_fault: bool = True) -> list[Collision]:
    return [
        Collision(5 + n, 500 + n, f"{kind}-{n}", int(kind), "active_front", value, at_fault)
        for n, value in enumerate(delta_v)
    ]


COSTS = [
    (hits(AgentKind.TRAFFIC_CONE, 1.0), NUPLAN, 0.5),
    (hits(AgentKind.GENERIC_OBJECT, 1.0, 1.0), NUPLAN, 0.0),
    (hits(AgentKind.BARRIER, 1.0, 1.0, 1.0), NUPLAN, 0.0),
    (hits(AgentKind.CZONE_SIGN, 1.0), Thresholds("x", allowed_object_collisions=3), 0.75),
    (hits(AgentKind.PEDESTRIAN, 1.0), Thresholds("x", allowed_vru_collisions=1), 0.5),
    (hits(AgentKind.VEHICLE, 1.0), Thresholds("x", allowed_vehicle_collisions=2), 2.0 / 3.0),
    (hits(AgentKind.VEHICLE, 1.0) + hits(AgentKind.BICYCLE, 1.0), NUPLAN, 0.0),
    (
        hits(AgentKind.VEHICLE, 1.0) + hits(AgentKind.BARRIER, 1.0),
        Thresholds("x", allowed_vehicle_collisions=1),
        0.25,
    ),
    (hits(AgentKind.VEHICLE, 1.0, 2.0, at_fault=False), NUPLAN, 1.0),
]


@pytest.mark.parametrize(("collisions", "thresholds", "score"), COSTS)
def test_every_group_of_kinds_has_its_own_allowance(
    collisions: list[Collision], thresholds: Thresholds, score: float
) -> None:
    part = evaluate(tuple(collisions), thresholds)
    assert part.row.score == pytest.approx(score, abs=1e-12)
    total = sum(c.at_fault for c in collisions)
    assert part.row.value == total
    assert part.statistics[0].value == (total == 0)


def test_the_violation_and_the_statistics_are_those_of_the_blamed_contacts() -> None:
    free = hits(AgentKind.VEHICLE, 9.0, at_fault=False)
    blamed = hits(AgentKind.BICYCLE, 2.0, 4.0, 9.0) + hits(AgentKind.BARRIER, 3.0)
    part = evaluate((*free, *blamed), NUPLAN)
    assert part.row.violation == Violation(5, 500, f"{AgentKind.BICYCLE}-0", 2.0)
    name = "number_of_at_fault_collisions_with_{}".format
    energy = "{}_collision_energy_with_{}".format
    assert {s.name: s.value for s in part.statistics} == {
        "no_ego_at_fault_collisions": 0.0,
        "number_of_all_at_fault_collisions": 4.0,
        name("VRUs"): 3.0,
        name("vehicles"): 0.0,
        name("objects"): 1.0,
        energy("max", "VRUs"): 9.0,
        energy("min", "VRUs"): 2.0,
        energy("mean", "VRUs"): 5.0,
        energy("max", "objects"): 3.0,
        energy("min", "objects"): 3.0,
        energy("mean", "objects"): 3.0,
    }
    assert (part.row.unit, part.row.threshold) == ("count", 0.0)
