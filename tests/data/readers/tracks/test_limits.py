"""From which value on something about a table is doubted: small tables on a straight road."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import straight_road

from shiftsim.data.readers.tracks.axes import Diagnostics, check_reference
from shiftsim.data.readers.tracks.columns import recognise
from shiftsim.data.readers.tracks.diagnostics import diagnose
from shiftsim.data.readers.tracks.table import TrackTable

ROAD = straight_road()  # 420 m x 7 m from (0, -1.75) on, 15 m/s
NAMES = "id time x y kind heading length width vx vy".split()


def table_of(*objects, hz=10.0, columns=NAMES):
    """Objects along +x: kind, x, y, speed, first and last time [s], acceleration."""
    rows = []
    for number, (kind, x, y, speed, first, last, *accel) in enumerate(objects):
        time = np.arange(round(first * hz), round(last * hz) + 1) / hz
        way = speed * time + 0.5 * sum(accel) * time**2
        values = [number, ["car", "pedestrian", "bicycle", "tank"].index(kind), time, x + way, y]
        rows.append(np.column_stack(np.broadcast_arrays(*values)))
    number, kind, time, x, y = np.concatenate(rows).T
    number, count = number.astype(np.int64), len(number)
    return TrackTable(
        "t",
        recognise(columns, {}, "t.csv"),
        None,
        np.rint(time * 1e6).astype(np.int64),
        number,
        np.unique(number),
        kind.astype(np.int64),
        ("car", "pedestrian", "bicycle", "tank"),
        np.column_stack([x, y]),
        np.full(count, np.nan),
        np.full((count, 2), np.nan),
        np.full((count, 2), np.nan),
    )


CARS = [("car", 10.0, 0.0, 10.0, 0.0, 9.0), ("car", 60.0, 3.5, 12.0, 0.0, 9.5)]


def doubts(table):
    """All that is wrong, then all that is unusual."""
    found = diagnose(table, ROAD, 0.95)
    return [*(error.what for error in found.errors), *(note.what for note in found.warnings)]


def said(table, words):
    """Whether just one thing is doubted, in these words; nothing where there are none."""
    found = doubts(table)
    return words in " ".join(found) if words and len(found) == 1 else found == [] and not words


@pytest.mark.parametrize(
    ("objects", "words"),
    [
        (CARS, ""),
        ([("tank", 10.0, 0.0, 10.0, 0.0, 9.0)], "kinds 'tank' are unknown"),
        ([("pedestrian", 10.0, 0.0, 1.0, 0.0, 9.0)], "none of the 1 objects is a vehicle"),
        ([("car", 10.0, 0.0, 10.0, 0.0, 0.0)] * 2, "each of the 2 objects has one row only"),
        ([("car", 10.0, 0.0, 0.99, 0.0, 9.0)], "no vehicle is faster than 0.99 m/s"),
        ([("car", 10.0, 0.0, 1.01, 0.0, 9.0)], ""),
        ([("car", 10.0, 0.0, 61.0, 0.0, 6.0)], "vehicles move at 61 m/s"),
        ([("car", 10.0, 0.0, 23.9, 0.0, 9.0)], ""),  # 1.6 times the limit
        ([("car", 10.0, 0.0, 24.1, 0.0, 9.0)], "1.6 times as fast as the speed limit"),
        ([("car", 10.0, 0.0, 6.0, 0.0, 3.0, 5.9)], ""),
        ([("car", 10.0, 0.0, 6.0, 0.0, 3.0, 6.1)], "with 6.1 m/s² in the middle"),
        ([("car", 400.0, 0.0, -9.0, 0.0, 9.0)], "only 0% of the moving vehicles drive along"),
    ],
)
def test_kinds_speeds_and_accelerations(objects, words):
    assert said(table_of(*objects), words)


@pytest.mark.parametrize(
    ("hz", "words"),
    [
        (100.0, ""),
        (102.0, "rows of an object are 0.009804 s apart"),
        (2.0, ""),
        (1.99, ""),
        (1.97, "rows of an object are 0.507614 s apart (1.97 Hz)"),
    ],
)
def test_rates_from_two_to_a_hundred_hertz(hz, words):
    assert said(table_of(*[(*car[:5], car[5] * 0.9) for car in CARS], hz=hz), words)


def test_accelerations_are_those_over_half_a_second_or_a_row():
    found = diagnose(table_of(("car", 10.0, 0.0, 6.0, 0.0, 5.0, 3.0), hz=2.0), ROAD, 0.95)
    assert found.figures["acceleration_mps2"] == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("gap", "words"), [(1.0, ""), (1.1, "no object has a row between 5 s and 6.1 s (1 such gaps")]
)
def test_gaps_of_more_than_a_second(gap, words):
    one, two = [("car", 10.0, y, 10.0, 0.0, 9.0) for y in (0.0, 3.5)]
    table = table_of(one, two)
    kept = (table.time <= 5.0) | (table.time >= 5.0 + gap - 1e-6)
    rows = ("time_us", "track", "category", "xy", "headings", "velocities", "sizes")
    assert said(replace(table, **{name: getattr(table, name)[kept] for name in rows}), words)


@pytest.mark.parametrize(
    ("hz", "way", "words"),
    [
        (10.0, 11.0, "jumps 11.0 m within 0.1 s at 4.1 s (1 such jumps"),
        (10.0, 9.9, ""),
        (50.0, 5.1, "jumps 5.1 m"),
        (50.0, 4.9, ""),
    ],
)
def test_jumps_are_far_and_fast(hz, way, words):
    table = table_of(("car", 10.0, 0.0, 10.0, 0.0, 9.0), ("car", 90.0, 3.5, 10.0, 0.0, 20.0), hz=hz)
    table.xy[round(4.1 * hz) + 1 :][table.track[round(4.1 * hz) + 1 :] == 0] += [way - 10.0 / hz, 0]
    found = doubts(table)
    assert (words in " ".join(found) and len(found) >= 1) if words else "jumps" not in str(found)
    jumps = diagnose(table, ROAD, 0.95).figures["jumps"]
    assert jumps == float(bool(words))


@pytest.mark.parametrize(
    ("way", "speed", "words"),
    [
        (2.5, 10.0, ""),
        (2.7, 10.0, "moves 3.7 m within 0.1 s at 4.1 s, farther than its speed before and"),
        (2.7, 40.0, "moves 6.7 m within 0.1 s"),
    ],
)
def test_a_step_is_unusual_where_the_speed_beside_it_does_not_explain_it(way, speed, words):
    table = table_of(("car", 10.0, 0.0, 10.0, 0.0, 9.0), ("car", 5.0, 3.5, speed, 0.0, 9.0))
    table.xy[table.track == 1] += np.where(table.time < 4.15, 0.0, way)[table.track == 1, None] * [
        1,
        0,
    ]
    found = [note.what for note in diagnose(table, ROAD, 0.0).warnings if "moves" in note.what]
    assert words in str(found) if words else not found


@pytest.mark.parametrize(
    ("count", "speed", "last", "words"),
    [
        (5, 0.84, 9.0, "walks with 0.84 m/s"),
        (5, 0.86, 9.0, ""),
        (5, 2.09, 9.0, ""),
        (5, 2.11, 9.0, "walks with 2.1 m/s"),
        (4, 0.5, 9.0, ""),
        (5, 0.5, 7.9, ""),  # less than 4 m
        (5, 0.5, 8.2, "walks with 0.5 m/s"),
    ],
)
def test_five_pedestrians_that_walk_tell_the_clock(count, speed, last, words):
    walkers = [("pedestrian", 10.0 * n, 9.0, speed, 0.1, last) for n in range(count)]
    assert said(table_of(*CARS, *walkers), words)


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ([(60.0, 12.0), (4.5, 1.9), (4.5, 1.9)], ""),
        ([(60.1, 2.0), (4.5, 1.9), (4.5, 1.9)], "object 0 is 60.1 m long and 2 m wide"),
        ([(5.0, 12.1), (4.5, 1.9), (4.5, 1.9)], "object 0 is 5 m long and 12.1 m wide"),
        ([(2.8, 1.3)] * 3, ""),
        ([(9.0, 2.9)] * 3, ""),
        ([(2.79, 1.9)] * 3, "the median vehicle is 2.79 m long"),
        ([(9.01, 1.9)] * 3, "the median vehicle is 9.01 m long"),
        ([(4.5, 1.29)] * 3, "1.29 m wide"),
        ([(4.5, 2.91)] * 3, "2.91 m wide"),
        ([(4.5, 1.9), (4.5, 1.9), (0.9, 0.5)], ""),
        ([(-4.5, -1.9)] * 3, "all lengths and widths are negative"),
        (
            [(4.5, 1.9), (4.5, -1.9), (4.5, 1.9)],
            "91 lengths and widths are negative, the first -1.9",
        ),
        ([(0.0, 0.0), (0.0, 0.0), (0.9, 0.5)], "0.9 m long"),
    ],
)
def test_sizes_of_vehicles(sizes, words):
    cars = [("car", 10.0 + 50.0 * n, 0.0, 10.0, 0.0, 9.0) for n in range(3)]
    table = table_of(*cars)
    table.sizes[:] = np.array(sizes)[table.track]
    assert said(table, words)


@pytest.mark.parametrize(
    ("lengths", "words"),
    [
        ([2.0, 2.0, 9.0], ""),
        ([2.01, 2.01, 0.5], "the median pedestrian is 2.01 m long"),
        ([0.0, 3.0, np.nan], "the median pedestrian is 3 m long"),
        ([np.nan] * 3, ""),
    ],
)
def test_sizes_of_pedestrians(lengths, words):
    table = table_of(*CARS, *[("pedestrian", 9.0 * n, 9.0, 0.1, 0.0, 9.0) for n in range(3)])
    table.sizes[:, 0] = np.array([4.5, 4.5, *lengths])[table.track]
    table.sizes[:, 1] = np.where(table.track < 2, 1.9, 0.6)
    assert said(table, words)


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        (0.19, ""),
        (0.21, "differ from the direction of motion by 0.21 rad"),
        (-0.21, "by 0.21 rad"),
        (np.pi, "by 3.14 rad"),
    ],
)
def test_headings_are_those_of_motion(turn, words):
    table = table_of(*CARS)
    table.headings[:] = turn
    assert said(table, words)


@pytest.mark.parametrize(("against", "words"), [(9, ""), (10, "in 11% of the rows the heading")])
def test_few_headings_point_backwards(against, words):
    table = table_of(("car", 10.0, 0.0, 10.0, 0.0, 8.9))
    table.headings[:] = np.where(np.arange(90) < against, np.pi, 0.0)
    assert said(table, words)


@pytest.mark.parametrize(
    ("given", "words", "remedy"),
    [
        (([10.0, 0.0], [12.0, 0.0]), "", ""),
        (([0.0, 10.0], [0.0, 12.0]), "(vx, vy) contradict", "vx = 'vy', vy = 'vx'"),
        (([-10.0, 0.0], [-12.0, 0.0]), "100% of the moving", "vx = '-vx'"),
        (([36.0, 0.0], [43.2, 0.0]), "3.6 times", "velocity = 'kmh'"),
        (([20.0, 0.0], [24.0, 0.0]), "2 times", "leave them out"),
        (
            ([10.0, 0.0], [99.0, 0.0]),
            "in 50% of the moving vehicles: the speeds are 8.25 times",
            "leave",
        ),
    ],
)
def test_velocities_are_those_of_positions(given, words, remedy):
    table = table_of(*CARS)
    table.velocities[:] = np.array(given)[table.track]
    assert said(table, words)
    assert remedy in " ".join(error.remedy for error in diagnose(table, ROAD, 0.95).errors)


@pytest.mark.parametrize(("wrong", "words"), [([1], ""), ([0, 1], "in 100% of the moving")])
def test_velocities_that_nothing_explains_are_doubted_where_most_are_wrong(wrong, words):
    table = table_of(*CARS)
    table.velocities[:] = np.array([[10.0, 0.0], [12.0, 0.0]])[table.track]
    random = np.random.default_rng(5).uniform(-20.0, 20.0, table.velocities.shape)
    rows = np.isin(table.track, wrong)
    table.velocities[rows] = random[rows]
    assert said(table, words)


@pytest.mark.parametrize(
    ("share", "remedy"), [(0.0, ""), (0.4, ""), (0.5, "'front'"), (-0.1, ""), (-0.2, "'rear'")]
)
def test_places_are_those_of_the_middle(share, remedy):
    """Cars of 4 m turn at 0.4 rad/s; places are so many lengths ahead of what does not slide."""
    table = table_of(*[("car", 0.0, 0.0, 8.0, 0.0, 5.0)] * 3)
    table.sizes[:], table.headings[:] = (4.0, 2.0), 0.4 * table.time
    cos, sin = np.cos(table.headings), np.sin(table.headings)
    ahead = share * 4.0
    table.xy[:] = np.column_stack([20.0 * sin + ahead * cos, ahead * sin - 20.0 * cos])
    found = Diagnostics()
    check_reference(table, found)
    assert found.figures == {"reference_share": pytest.approx(share, abs=0.01)}
    assert [remedy in error.remedy for error in found.errors] == [True] * bool(remedy)


def test_rows_that_move_faster_are_those_of_vehicles():
    table = table_of(*CARS, ("pedestrian", 10.0, 9.0, 2.0, 0.0, 9.0))
    fastest = float(table.speed.max())
    assert len(table.moving_rows(fastest)) == 0
    assert set(table.track[table.moving_rows(1.0)].tolist()) == {0, 1}
    assert len(table.moving_rows(1.0)) == 91 + 96
    assert table.vehicle_size is None
    assert table.period == pytest.approx(0.1)
