"""Samples of PlanTF and PLUTO: right by hand, and the same whoever makes them."""

import hashlib
import pickle
from dataclasses import asdict, replace
from functools import partial
from itertools import islice

import numpy as np
import pytest
import torch
from stores import write_toy_store
from worlds import cruise_scenario

from shiftsim.data import open_store
from shiftsim.data.synthetic.store import write_towns
from shiftsim.errors import PlannerError
from shiftsim.geometry.boxes import from_frame, to_frame
from shiftsim.planners.basic import LogFuture
from shiftsim.planners.learned import features
from shiftsim.planners.learned.diffusion.planner import DiffusionPlanner
from shiftsim.planners.learned.plantf.planner import Plans, PlanTF
from shiftsim.planners.learned.pluto.planner import Pluto
from shiftsim.runs.workers import map_unordered
from shiftsim.sim.loop import simulate
from shiftsim.sim.planner import scene_info
from shiftsim.train import samples
from shiftsim.train.imitation import motion
from shiftsim.train.samples import (
    free_state,
    make_sample,
    motion_targets,
    projections,
    targets,
)
from shiftsim.train.stream import Stream, load_blocks, pack, unpack
from shiftsim.world.state import PACIFICA, LightStatus, TrafficLights

pytestmark = [pytest.mark.learned, pytest.mark.slow]


@pytest.fixture(scope="module")
def road(tmp_path_factory):
    """A store of 24 scenarios of which 12 s were recorded."""
    folder = tmp_path_factory.mktemp("stores") / "road"
    return write_toy_store(folder, count=24, iterations=121)


@pytest.fixture
def stream(road):
    return Stream(str(road), tuple(sorted(open_store(road).tokens)), seed=3, batch=4)


@pytest.fixture
def asked(road):
    """A scenario and a planner that was reset to it."""
    scenario, planner = open_store(road).read("0000cafe"), PlanTF.asking(lambda scenes: ())
    planner.reset(scene_info(scenario))
    return scenario, planner


class Draws:
    """Random numbers that are known: perturbed or not, and by how much."""

    def __init__(self, first, noise=None):
        self._first, self._noise = first, noise

    def random(self):
        return self._first

    def uniform(self, low, high):
        return np.array(self._noise)


def arrays_of(batch):
    inputs = batch.inputs
    if not isinstance(inputs, dict):
        inputs = asdict(replace(inputs, counts=None))
    both = [*inputs.values(), *batch[1:]]
    return [value for value in both if value is not None]


def digest(stream, workers, count=50):
    """SHA-256 of the first batches of a stream, and which samples failed."""
    total, seen, failed = hashlib.sha256(), 0, []
    for block in load_blocks(stream, 0, workers):
        failed.append(block.failed)
        for batch in block.batches:
            for tensor in arrays_of(batch):
                total.update(tensor.numpy().tobytes())
            seen += 1
            if seen == count:
                return total.hexdigest(), failed
    raise AssertionError(f"only {seen} batches")


def test_the_target_of_a_straight_drive_is_its_speed(asked):
    scenario, planner = asked
    one = make_sample(planner, scenario, 10, Draws(0.9))
    np.testing.assert_allclose(one.target[0, :, 0], 0.6 * np.arange(1, 81), atol=1e-5)
    np.testing.assert_allclose(one.target[0, :, 1:], 0.0, atol=1e-6)
    np.testing.assert_array_equal(one.target[1:], 0.0)  # it is parked
    assert one.valid.all()


def test_targets_are_as_recorded_and_0_where_nothing_was():
    future = np.array([[[3.0, 4.0, 0.5], [np.nan] * 3]])
    frame = np.array([0.0, 0.0, np.pi / 2.0])
    made = targets(np.array([[1.0, 1.0, 0.25]]), future, frame)
    np.testing.assert_allclose(made, [[[3.0, -2.0, 0.25], [0.0, 0.0, 0.0]]], atol=1e-6)


def test_as_published_a_moved_ego_is_back_at_once(asked):
    scenario, planner = asked
    noise = [0.5, -0.4, 0.2, 1.0, 0.3, 0.1, 0.05]
    plain, moved = (
        make_sample(planner, scenario, 10, Draws(draw, noise), as_published=True)
        for draw in (0.9, 0.1)
    )
    ego = scenario.expert[10, :3]
    frame = features.map_poses(np.array(noise[:3]), ego)
    for sample, origin in ((plain, ego), (moved, frame)):
        back = from_frame(sample.target[0].astype(np.float64), origin)
        recorded = scenario.expert[11:91, :3]
        np.testing.assert_allclose(back, recorded, atol=1e-4)
    state = moved.features.current_state - plain.features.current_state
    np.testing.assert_allclose(state[3:], noise[3:], atol=1e-6)
    np.testing.assert_array_equal(moved.features.current_state[:3], 0.0)


def drive_back(pose, speed, recorded=8.0):
    """Poses by which an ego comes back to a straight drive along x, in the frame of that drive."""
    future = np.zeros((81, 3))
    future[:, 0] = 0.1 * recorded * np.arange(81)
    moved = np.array(pose)
    local = to_frame(future, moved)
    return from_frame(samples.way_back(speed, local), moved)


def test_an_ego_that_was_moved_comes_back_smoothly():
    back = drive_back([0.5, 0.75, 0.2], 8.0)
    assert np.abs(back[0, 1] - 0.75 - 0.8 * np.sin(0.2)) < 0.02  # goes on as it is turned
    np.testing.assert_allclose(back[30:, 1:], 0.0, atol=1e-9)
    moved = np.diff(np.vstack([[0.5, 0.75, 0.2], back]), axis=0)
    turned = np.arctan2(moved[1:, 1], moved[1:, 0]) - back[:-1, 2]
    assert np.abs(turned).max() < 0.06  # it drives where it looks
    np.testing.assert_allclose(np.hypot(moved[:, 0], moved[:, 1]), 0.8, atol=0.05)


def test_a_slow_ego_gathers_speed_and_stays_behind():
    back = drive_back([0.0, 0.0, 0.0], 2.0)
    speeds = np.diff(back[:, 0]) / 0.1
    np.testing.assert_allclose(speeds[:35], 2.3 + 0.15 * np.arange(35), atol=1e-9)
    np.testing.assert_allclose(speeds[45:], 8.0, atol=1e-9)


def test_a_fast_ego_slows_down_to_the_recording():
    back = drive_back([0.0, 0.0, 0.0], 9.0)
    np.testing.assert_allclose(back[10:, 0] - 0.8 * np.arange(11, 81), 0.25, atol=0.06)


def test_an_ego_that_stands_beside_a_standing_recording_stays():
    back = drive_back([0.3, -0.5, 0.1], 0.0, recorded=0.0)
    np.testing.assert_allclose(back, [[0.3, -0.5, 0.1]] * 80, atol=1e-9)


def test_a_slow_ego_waits_where_the_recording_waits():
    place = np.minimum(0.5 * np.arange(81), 10.0)
    place[60:] = 10.0 + 0.5 * np.arange(21)  # it stands from 2 to 6 s
    poses = np.stack([place, 0.0 * place, 0.0 * place], axis=-1)
    back = samples.way_back(2.0, poses)
    assert (back[:, 0] <= place[1:] + 1e-9).all()
    np.testing.assert_allclose(back[50:59, 0], 10.0, atol=1e-9)
    assert back[-1, 0] > 12.0


def test_an_ego_that_was_driven_late_and_aside_follows_the_recording(asked):
    scenario, planner = asked
    driven = scenario.expert.copy()  # at 6 m/s, 4 s late, 1 m to the left, and slower
    driven[40:] = driven[:-40]
    driven[:, 1] += 1.0
    driven[:, 3] = 3.0
    one = make_sample(planner, scenario, 60, Draws(0.9), driven=driven)
    np.testing.assert_allclose(one.features.current_state[3], 3.0)
    target = one.target[0]
    np.testing.assert_allclose(
        np.diff(target[:10, 0]), 0.1 * (3.15 + 0.15 * np.arange(1, 10)), atol=5e-3
    )
    np.testing.assert_allclose(target[-1, :2], [target[-1, 0], -1.0], atol=1e-4)
    assert 40.0 < target[-1, 0] < 48.0  # as fast as the recording, and still late
    driven[:, 1] += 1.0
    assert "far from" in make_sample(planner, scenario, 60, Draws(0.9), driven=driven)
    driven[:, 0] -= 100.0
    assert "far from" in make_sample(planner, scenario, 60, Draws(0.9), driven=driven)


def test_targets_of_diffusion_planner_are_poses_of_the_ego_and_its_neighbours(asked):
    planner = DiffusionPlanner.asking(lambda scenes: ())
    planner.reset(scene_info(asked[0]))
    plain = make_sample(planner, asked[0], 10, Draws(0.9))
    assert plain.target.shape == (11, 80, 3)
    np.testing.assert_allclose(plain.target[0, :, 0], 0.6 * np.arange(1, 81), atol=1e-5)
    parked = plain.features.neighbor_agents_past[0, -1]
    np.testing.assert_allclose(plain.target[1], [[*parked[:2], 0.0]] * 80, atol=1e-5)
    assert plain.valid[:2].all()
    assert not plain.valid[2:].any()
    moved = make_sample(planner, asked[0], 10, Draws(0.1, [0.0, 0.5, 0.1, 0, 0, 0, 0]))
    assert np.hypot(*moved.target[0, 0, :2]) < 0.65  # the authors' ego is moved 0.5 m at once
    np.testing.assert_allclose(moved.target[0, 40:, 2], -0.1, atol=1e-5)


def test_the_ego_is_not_moved_into_another(asked):
    scenario, planner = asked
    beside = [0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0]  # beyond what is drawn: the car parks beside
    there = int(np.argmin(np.abs(scenario.expert[:, 0] - 30.0)))
    assert not make_sample(planner, scenario, min(there, 40), Draws(0.1, beside)) == ""
    pose, size = np.array([0.0, 0.0, 0.0]), np.array([[5.0, 2.0]])
    assert not samples.is_free(pose, np.array([[3.0, 0.0, 0.0]]), size)
    assert samples.is_free(pose, np.array([[3.0, 3.0, 0.0]]), size)


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.thorough
@pytest.mark.parametrize(
    ("planner", "workers"), [("plantf", (1, 2, 3, 4)), ("pluto", (2,)), ("diffusion-planner", (2,))]
)
def test_batches_are_the_same_for_any_number_of_workers(stream, planner, workers):
    stream = replace(stream, planner=planner)
    alone = digest(stream, 0)
    for number in workers:
        assert digest(stream, number) == alone
    assert digest(replace(stream, seed=4), 0) != alone


def test_a_block_is_the_same_behind_its_way_between_processes(stream):
    block = next(load_blocks(replace(stream, planner="pluto"), 0, 0))
    found = unpack(pack(block))
    assert found.failed == block.failed
    for one, other in zip(block.batches, found.batches, strict=True):
        assert one.inputs.counts == other.inputs.counts
        for a, b in zip(arrays_of(one), arrays_of(other), strict=True):
            assert a.dtype == b.dtype
            assert torch.equal(a, b)
    valid = found.batches[0].valid
    valid[:] = False  # who learns may write to it, and nothing else changes
    assert torch.equal(found.batches[0].target, block.batches[0].target)
    assert len(pickle.dumps(valid)) < valid.nbytes + 1000  # a copy of it is not one of the block


@pytest.mark.thorough
def test_a_stream_goes_on_where_it_ended(stream):
    whole = [
        arrays_of(batch)
        for block in islice(load_blocks(stream, 0, 0), 4)
        for batch in block.batches
    ]
    ends = (islice(load_blocks(stream, first, 0), 2) for first in (0, 2))
    parts = [arrays_of(batch) for part in ends for block in part for batch in block.batches]
    assert len(whole) == len(parts)
    for one, other in zip(whole, parts, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_an_epoch_has_every_scenario_once(stream):
    tokens = [token for block in range(stream.blocks) for token in stream.tokens_of(block)]
    assert sorted(tokens) == list(stream.tokens)
    assert stream.tokens_of(stream.blocks) != stream.tokens_of(0)


def test_samples_that_cannot_be_made_are_counted(stream, monkeypatch):
    read, asked = PlanTF.features, []

    def sometimes(planner, observation):
        asked.append(1)
        if len(asked) % 4 == 1:
            raise PlannerError("no route")
        return read(planner, observation)

    monkeypatch.setattr(PlanTF, "features", sometimes)
    block = next(load_blocks(stream, 0, 0))
    made = sum(len(batch.target) for batch in block.batches)
    assert block.failed == {"PlannerError: no route": -(-len(asked) // 4)}
    assert made == len(asked) - block.failed["PlannerError: no route"]


def test_an_iteration_without_8_s_after_it_is_no_sample(asked):
    scenario, planner = asked
    short = replace(scenario, iteration_rows=scenario.iteration_rows[-1:] + 2 * 79)
    assert "8 s" in make_sample(planner, short, 0, Draws(0.9))


def pluto_sample(scenario, iteration=10, draws=None):
    planner = Pluto.asking(lambda scenes: ())
    planner.reset(scene_info(scenario))
    return make_sample(planner, scenario, iteration, draws or Draws(0.9), as_published=True)


def test_the_target_of_pluto_on_a_straight_road_is_its_speed(asked):
    one = pluto_sample(asked[0])
    np.testing.assert_allclose(one.target[0, :, 0], 0.6 * np.arange(1, 81), atol=1e-5)
    np.testing.assert_allclose(one.target[0, :, 1:], [[0, 1, 0, 6, 0]] * 80, atol=1e-6)
    np.testing.assert_array_equal(one.target[1:], [[[0, 0, 1, 0, 0, 0]] * 80])  # it is parked
    assert one.target.dtype == one.projection.dtype == np.float32
    assert one.valid.all()


def test_a_turning_agent_turns_its_velocity_and_heading_in_the_frame_of_the_ego():
    # on a circle of 20 m around (10, 20), at 8 m/s, from (10, 0); the ego looks along +y
    angle = 0.04 * np.arange(81)
    x, y = 10.0 + 20.0 * np.sin(angle), 20.0 - 20.0 * np.cos(angle)
    poses = np.stack([x, y, angle], axis=-1)[None]
    velocities = 8.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[None, 1:]
    poses[0, 80], velocities[0, 79] = np.nan, np.nan
    made = motion_targets(poses[:, 0], poses[:, 1:], velocities, np.array([3.0, -2.0, np.pi / 2]))
    turn = angle[1:80]
    forward, left = 20.0 * (1.0 - np.cos(turn)), -20.0 * np.sin(turn)
    known = [forward, left, np.cos(turn), np.sin(turn), 8.0 * np.sin(turn), -8.0 * np.cos(turn)]
    np.testing.assert_allclose(made[0, :79], np.stack(known, axis=-1), atol=2e-6)
    np.testing.assert_array_equal(made[0, 79], 0.0)


def test_projections_are_arc_length_and_distance_on_every_line():
    along = np.linspace(0.0, 120.0, 481)
    straight = np.stack([along, 0.0 * along, 0.0 * along], axis=-1)
    turn = along / 60.0
    curve = np.stack([60.0 * np.sin(turn), 60.0 - 60.0 * np.cos(turn), turn], axis=-1)
    times = 0.1 * np.arange(1, 81)
    ego = np.stack([5.0 * times, 0.0 * times + 1.5, 0.0 * times], axis=-1)
    inside = np.stack([58.0 * np.sin(times / 10), 60.0 - 58.0 * np.cos(times / 10)], axis=-1)
    seconds = np.arange(1, 9)
    made = projections([straight, curve], ego)
    np.testing.assert_allclose(made[0], np.stack([5.0 * seconds, [1.5] * 8], axis=-1), rtol=1e-6)
    made = projections([curve], inside)
    # beside a vertex the foot is on a chord, which is turned by up to 0.0021 rad, 2 m away
    np.testing.assert_allclose(made[0, :, 0], 6.0 * seconds, atol=5e-3)
    np.testing.assert_allclose(made[0, :, 1], 2.0, atol=1e-3)


def test_lines_begin_where_the_ego_was_moved_to(asked):
    plain = pluto_sample(asked[0])
    moved = pluto_sample(asked[0], draws=Draws(0.1, [0.5, 0.25, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert len(plain.projection) == len(plain.features.line_valid)
    nearest = plain.projection[:, 0, 1].argmin()
    known = np.stack([6.0 * np.arange(1, 9), [0.0] * 8], axis=-1)
    np.testing.assert_allclose(plain.projection[nearest], known, atol=1e-5)
    np.testing.assert_allclose(moved.projection[nearest], known - [0.5, 0.0], atol=1e-5)


def test_steering_and_yaw_rate_are_derived_as_recordings_have_none():
    scenario = cruise_scenario()
    turning = scenario.ego.copy()
    turning[:, 2] = 0.01 * np.arange(len(turning))  # 0.2 rad/s
    read = pluto_sample(replace(scenario, ego=turning)).features
    steering = np.arctan(0.2 * PACIFICA.wheel_base / 8.0)
    np.testing.assert_allclose(read.current_state[3:], [8.0, 0.0, steering, 0.2], rtol=1e-5)


@pytest.mark.parametrize(
    ("connector", "status", "steps"),
    [("21", LightStatus.RED, 48), ("21", LightStatus.GREEN, 80), ("20", LightStatus.RED, 80)],
)
def test_what_the_ego_did_beyond_a_red_light_does_not_count(connector, status, steps):
    # its centre, at 151.461 m and 10 m/s, comes to the connector at 200 m in the 49th step
    scenario = cruise_scenario(speed=10.0, start=(150.0, 0.0, 0.0))
    rows = np.full((len(scenario.time_us), 1), status, np.int8)
    one = pluto_sample(replace(scenario, traffic_lights=TrafficLights((connector,), rows)), 0)
    assert one.valid[0].tolist() == [True] * steps + [False] * (80 - steps)


def test_a_sample_without_a_reference_line_is_none():
    assert "no reference line" in pluto_sample(cruise_scenario(start=(10.0, 30.0, 0.0)))


def test_of_pluto_the_noise_is_halved_until_the_place_is_free():
    state, noise = np.zeros(7), np.full(7, 0.8)
    found = free_state(state, noise, lambda pose: pose[0] < 0.3, 5)
    np.testing.assert_array_equal(found, [0.2] * 7)
    np.testing.assert_array_equal(free_state(state, noise, lambda pose: False, 5), [0.05] * 7)
    assert free_state(state, noise, lambda pose: False, 1) is None


class LabelReplay(PlanTF):
    """Plans what a network is to learn: the recorded future, by way of a target."""

    def on(self, scenario):
        self._scenario = scenario
        return self

    def decode(self, output, observation):
        scenario, ego = self._scenario, observation.history.ego[-1:, :3]
        row = scenario.iteration_rows[observation.iteration]
        rows = row + scenario.row_step * np.arange(1, samples.STEPS + 1)
        future = scenario.ego[np.minimum(rows, len(scenario.ego) - 1), :3]
        label = motion(torch.from_numpy(targets(ego, future[None], ego[0])))
        plans = Plans(label.numpy(), np.zeros(1, np.float32))
        return super().decode(plans, observation)


@pytest.mark.thorough
def test_labels_that_are_driven_are_those_of_log_future(tmp_path):
    store = write_towns(
        tmp_path / "town", towns=2, seed=5, spread=partial(map_unordered, workers=1)
    )
    apart = []  # from what log-future drives, where the ego turns and 8 s after it are recorded
    for scenario in map(store.read, store.tokens):
        count = len(scenario.iteration_rows) - samples.STEPS
        if np.ptp(np.unwrap(scenario.ego[scenario.iteration_rows[:count], 2])) > 0.4:
            planner = LabelReplay.asking(lambda scenes: [None] * len(scenes)).on(scenario)
            ours, theirs = (simulate(scenario, one) for one in (planner, LogFuture()))
            apart.append(np.hypot(*(ours.ego - theirs.ego)[:count, :2].T).max())
    assert len(apart) >= 2
    assert max(apart) < 0.6  # m: a plan begins where the ego is, 0.1 s are up to 1 m
