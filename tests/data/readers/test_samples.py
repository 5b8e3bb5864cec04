"""Recordings at 20 Hz: between frames, beyond them, and the states of egos."""

import numpy as np
import pytest
from hypothesis import given
from strategies import seeds

from shiftsim.data.readers.build import make_samples
from shiftsim.data.readers.samples import (
    ego_states,
    ego_trace,
    resample,
    rows_between,
    rows_of,
    sample_run,
    slope,
)
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.world.state import VX


def wandering(rng, counts=(12, 1, 7), period=0.1):
    """Objects with random places, headings and velocities; some frames are missing."""
    time_us = [rng.choice(20, count, replace=False) for count in counts]
    step = np.concatenate([np.sort(times) for times in time_us])
    count = len(step)
    return make_samples(
        "r",
        time_us=1_000_000 + np.rint(step * period * 1e6).astype(np.int64),
        ids=np.repeat(np.arange(len(counts)), counts),
        category=np.zeros(count, np.int64),
        xy=rng.uniform(-50.0, 50.0, (count, 2)),
        headings=rng.uniform(-np.pi, np.pi, count),
        velocities=rng.uniform(-9.0, 9.0, (count, 2)),
        velocity_rule=lambda stored, xy, time, track, _: (stored, np.zeros(len(counts), np.bool_)),
    )


def slow_sample(samples, run, time):
    """Pose and velocity at one time: linear, for one period beyond the ends too, then straight."""
    runs = samples.runs
    rows = np.arange(runs.first[run], runs.last[run] + 1)
    at, xy, velocities = samples.time[rows], samples.xy[rows], samples.velocities[rows]
    heading = np.unwrap(samples.headings[rows])
    inside = np.clip(time, at[0], at[-1])
    beyond = time - inside
    values = np.column_stack([xy, heading])
    found = np.array([np.interp(inside, at, column) for column in values.T])
    linear = np.clip(beyond, -samples.period, samples.period)
    if len(rows) > 1 and beyond != 0.0:
        ends = [0, 1] if beyond < 0.0 else [-2, -1]
        found += linear * np.diff(values[ends], axis=0)[0] / np.diff(at[ends])
    end = velocities[0 if beyond < 0.0 else -1]
    found[:2] += (beyond - linear) * end
    return found, np.array([np.interp(inside, at, column) for column in velocities.T])


@given(seeds)
def test_runs_are_sampled_linearly_and_go_on_straight(seed):
    rng = np.random.default_rng(seed)
    samples = wandering(rng)
    for run in range(len(samples.runs.first)):
        ends = samples.time[[samples.runs.first[run], samples.runs.last[run]]]
        times = np.r_[rng.uniform(-1.0, 3.0, 9), ends]
        single = ends[0] == ends[1]
        poses, velocities = sample_run(samples, run, times[-1:] if single else times)
        for time, pose, velocity in zip(times[-len(poses) :], poses, velocities, strict=True):
            expected, moving = slow_sample(samples, run, time)
            np.testing.assert_allclose(pose[:2], expected[:2], rtol=0.0, atol=1e-6)
            turn = wrap_angles(np.array([pose[2] - expected[2]]))
            np.testing.assert_allclose(turn, 0.0, rtol=0.0, atol=1e-6)
            np.testing.assert_allclose(velocity, moving, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("padding", [0, 6])
def test_a_recording_at_20_hz_holds_every_run_where_it_is(rng, padding):
    samples = wandering(rng, (12, 9, 7))
    found, runs = resample(samples, "log", "city", padding), samples.runs
    count = int(samples.duration / 0.05 + 1e-6) + 1 + padding
    expected = samples.start_us + 50_000 * (np.arange(count) - padding)
    np.testing.assert_array_equal(found.time_us, expected)
    assert len(found.tracks.tokens) == len(runs.first)
    assert (found.log_name, found.city) == ("log", "city")
    firsts = found.tracks.valid.argmax(axis=0)
    assert (np.diff(firsts) >= 0).all()
    for column, token in enumerate(found.tracks.tokens):
        run = runs.tokens.index(token)
        ends = samples.time[[runs.first[run], runs.last[run]]]
        first = -padding if ends[0] == 0.0 else round(ends[0] / 0.05)
        rows = np.arange(first, round(ends[1] / 0.05) + 1) + padding
        assert np.flatnonzero(found.tracks.valid[:, column]).tolist() == rows.tolist()
        poses, velocities = sample_run(samples, run, (rows - padding) * 0.05)
        np.testing.assert_array_equal(found.tracks.poses[rows, column], poses)
        np.testing.assert_array_equal(found.tracks.velocities[rows, column], velocities)


@pytest.mark.parametrize(("first", "last"), [(0, 9), (4, 60), (10, 20)])
def test_an_ego_trace_holds_the_rows_that_are_wanted(rng, first, last):
    samples = wandering(rng, (20,))
    trace = ego_trace(samples, 0, "log", first_row=first, last_row=last, padding=4)
    low, high = min(4, first), max(43, last)  # what derivatives are taken of
    whole = ego_states(*sample_run(samples, 0, (np.arange(low, high) - 4) * 0.05))
    np.testing.assert_array_equal(trace.states, whole[first - low : last - low])
    assert (trace.log_name, trace.name, trace.first_row) == ("log", "0", first)


@pytest.mark.parametrize(
    ("span", "rows"),
    [((0.0, 0.1), (0, 2)), ((0.01, 0.09), (1, 1)), ((0.06, 0.09), (2, 1)), ((0.15, 0.15), (3, 3))],
)
def test_rows_between_times(span, rows):
    first, last = rows_between(*np.array(span)[:, None])
    assert (first[0], last[0]) == rows
    assert rows_of(rows[1] * 0.05 + 0.02) == rows[1]


@pytest.mark.parametrize(("count", "exact"), [(1, 0), (2, 1), (3, 2), (4, 2), (11, 2), (12, 2)])
def test_slopes_are_exact_up_to_a_degree(count, exact):
    time = 0.05 * np.arange(count)
    expected = exact * time ** max(exact - 1, 0)
    np.testing.assert_allclose(slope(time**exact, 0.05), expected, rtol=0.0, atol=1e-9)


def test_states_look_along_the_heading():
    centers = np.column_stack([np.arange(5.0), np.zeros(5), np.full(5, 0.3)])
    along = ego_states(centers, np.tile([2.0, 0.0], (5, 1)))[:, VX]
    np.testing.assert_allclose(along, 2.0 * np.cos(0.3), rtol=0.0, atol=1e-12)
