"""Tracker, vehicle model, noise: figures per call, from Python, warm.

Run with `pytest benchmarks/speed/test_dynamics.py -s`.
"""

import numpy as np
import pytest

from shiftsim.kernels import kernel
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, command_and_step, step_bicycle
from shiftsim.sim.dynamics.lqr import TRACKED, track_and_step
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.sim.noise import parse_noise, sample_noise
from shiftsim.sim.perception import parse_drift
from shiftsim.sim.sensing import Sensing
from shiftsim.world.state import HEADING, NUM_STATE, VX, tracks_of_boxes

NOW = 1_630_000_000_000_000
STEP_US = 100_000


@pytest.fixture(params=[21, 81, 161])
def plan(request) -> tuple[np.ndarray, np.ndarray]:
    """A winding plan at map coordinates, knots 0.1 s apart."""
    count = request.param
    states = np.zeros((count, NUM_STATE))
    states[:, HEADING] = 0.3 * np.sin(0.05 * np.arange(count))
    states[:, 0] = 664_430.0 + np.cumsum(0.8 * np.cos(states[:, HEADING]))
    states[:, 1] = 3_998_750.0 + np.cumsum(0.8 * np.sin(states[:, HEADING]))
    return NOW + STEP_US * np.arange(count), states


@pytest.fixture
def state(plan) -> np.ndarray:
    ego = plan[1][0].copy()
    ego[VX] = 7.5
    return ego


def test_tracker_and_bicycle(measure, plan, state):
    out, command = np.empty(NUM_STATE), np.empty(2)
    call = (NOW, NOW + STEP_US, state, *plan, 0.1, 0.01, out, command)

    measure(track_and_step, *call)

    assert track_and_step(*call) == TRACKED


def test_interpolation(measure, plan):
    measure(interpolate, *plan, NOW + 2 * STEP_US + 7, np.empty(NUM_STATE))


def test_command_and_bicycle(measure):
    state, out, command = np.zeros(NUM_STATE), np.empty(NUM_STATE), np.ones(2)
    measure(command_and_step, NOW, NOW + STEP_US, state, command, 0.1, 0.01, out)


@kernel
def step_bicycles(states, commands, wheel_base, dt, out):
    for row in range(len(states)):
        step_bicycle(states[row], commands[row, 0], commands[row, 1], wheel_base, dt, out[row])


def test_bicycle_batch_of_fifteen(measure):
    states, commands = np.zeros((15, NUM_STATE)), np.ones((15, 2))
    measure(step_bicycles, states, commands, WHEEL_BASE, 0.1, np.empty_like(states))


def test_noise_of_a_rollout(measure):
    model = parse_noise("ou-high")
    measure(lambda: sample_noise(model, seed=0, token="a1b2", num_steps=150), calls=5)


@pytest.mark.parametrize(
    "name", ["perception-high", "localization-high", "perception-high+miss-high"]
)
def test_seeing_a_rollout_of_100_tracks(measure, name):
    """Of 150 steps: at most 30 us per step at level high, with the numbers drawn before."""
    rng, rows = np.random.default_rng(0), 171
    boxes = rng.normal(0.0, 40.0, (rows, 100, 7))
    tracks = tracks_of_boxes(boxes, [0] * 100, [f"{i:016x}" for i in range(100)])
    drift, truth = parse_drift(name), (np.zeros((rows, NUM_STATE)), tracks)

    def see() -> None:
        sensing = Sensing(drift, 0, "a1", truth)
        for row in range(21, rows):
            sensing.see(row)

    measure(see, calls=5, target=150 * 30e-6)
