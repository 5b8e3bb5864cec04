"""What the network is to learn, and how a step of learning is done."""

import numpy as np
import pytest
import torch
from worlds import cruise_scenario

from shiftsim.planners.learned.carl import view
from shiftsim.planners.learned.carl.network import CarlNetwork, Policy
from shiftsim.planners.learned.carl.planner import MAX_STEERING, command_of, measure
from shiftsim.sim.log import Setting
from shiftsim.sim.loop import simulate
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.train.driving import Expert, brake_at_stand, encode_action
from shiftsim.train.learning import (
    BATCH,
    LATE,
    MIRRORED,
    UNITS,
    Learner,
    draw_batch,
    from_official,
    log_density,
    loss_of,
    schedule,
    to_official,
)
from shiftsim.train.states import (
    MIRRORED_ACTION,
    State,
    States,
    compress_raster,
    importance,
    mirror_measurements,
    read_raster,
    write_part,
)


@pytest.mark.parametrize(
    ("command", "steering", "action"),
    [
        ((1.2, 0.0), 0.0, (0.5, 0.0)),
        ((-1.6, 0.0), 0.0, (-0.5, 0.0)),
        ((9.0, 0.0), 0.0, (1.0, 0.0)),
        ((-9.0, 0.0), 0.0, (-1.0, 0.0)),
        ((0.0, 0.0), 0.5 * MAX_STEERING, (0.0, 0.5)),
        ((0.0, 1.0), 0.1, (0.0, (0.1 + 0.3) / 0.83775804096)),
        ((0.0, -9.0), 0.0, (0.0, -1.0)),
    ],
)
def test_a_label_asks_for_the_acceleration_and_the_angle_after_tau(command, steering, action):
    assert encode_action(*command, steering, 0.3) == pytest.approx(np.float32(action), abs=1e-7)


def test_with_a_tau_of_one_step_a_label_is_the_command_of_the_tracker():
    ego = np.zeros(11)
    ego[3], ego[7] = 5.0, 0.02
    found = command_of(encode_action(-0.7, 0.11, ego[7], 0.1), ego)
    assert found.acceleration == pytest.approx(-0.7, rel=1e-5)
    assert found.steering_rate == pytest.approx(0.11, rel=1e-4)


@pytest.mark.parametrize(
    ("throttle", "speed", "held"),
    [(0.0, 0.0, -0.3), (-0.1, 0.2, -0.3), (-0.8, 0.1, -0.8), (0.2, 0.0, 0.2), (-0.1, 0.4, -0.1)],
)
def test_who_is_to_stand_is_taught_to_brake(throttle, speed, held):
    action = np.array([throttle, 0.1], np.float32)
    np.testing.assert_allclose(brake_at_stand(action, speed), [held, 0.1], rtol=1e-6)


def test_the_expert_does_what_pdm_closed_and_the_tracker_do():
    scenario = cruise_scenario(speed=8.0, iterations=25)
    from shiftsim.planners.pdm.planner import PdmClosed

    log = simulate(scenario, PdmClosed(), Setting())
    action = Expert(scene_info(scenario), 0.1).act(observe_log(scenario, 0))
    found = command_of(action, log.ego[0])
    assert found.acceleration == pytest.approx(log.commands[0, 0], rel=1e-5)
    assert found.steering_rate == pytest.approx(log.commands[0, 1], rel=1e-4, abs=1e-6)


def rasters(random, count):
    out = np.zeros((count, 9, 256, 256), np.uint8)
    for raster in out:
        for channel in (0, 1, 2, 3, 5, 6, 7, 8):
            row, column = random.integers(0, 250, 2)
            raster[channel, row : row + 40, column : column + 25] = random.integers(1, 256)
    return out


def measurements(random, count):
    return (random.normal(size=(count, 10)) * UNITS).astype(np.float32)


def test_a_raster_is_kept_without_loss(rng):
    (raster,) = rasters(rng, 1)
    assert np.array_equal(read_raster(compress_raster(raster)), raster)


def test_units_are_taken_into_the_first_layer_and_out_of_it(rng):
    network, official = CarlNetwork(), CarlNetwork()
    official.load_state_dict(to_official(network.state_dict()))
    pictures, measured = torch.from_numpy(rasters(rng, 2)), measurements(rng, 2)
    with torch.no_grad():
        wanted = network(pictures, torch.from_numpy(measured / UNITS)).action
        found = official(pictures, torch.from_numpy(measured)).action
    assert found.numpy() == pytest.approx(wanted.numpy(), abs=1e-5)
    restored = from_official(official.state_dict())
    for name, value in network.state_dict().items():
        assert torch.allclose(restored[name], value)


def test_a_mirrored_raster_is_that_of_the_mirrored_world(rng):
    frame = np.array([0.0, 0.0, 1.0, 0.0])
    left, right = np.zeros((2, 9, 256, 256), np.uint8)
    for raster, sign in ((left, 1.0), (right, -1.0)):
        box = (10.3, sign * 7.21, sign * 0.4, 4.6, 2.1)
        view.draw_box(raster[view.VEHICLES], frame, *box, 200)
    # the corners of a box are cut to whole pixels, of which some lie one aside
    assert (left[:, ::-1] != right).sum() <= 8
    assert (right != 0).sum() > 40


def test_mirrored_measurements_are_those_of_the_mirrored_ego(rng):
    ego = rng.normal(size=11)
    mirrored = ego * [1, -1, -1, 1, -1, 1, -1, -1, -1, -1, -1]
    action = np.float32([0.3, 0.2])
    found = mirror_measurements(measure(ego, action))
    other = measure(mirrored, action * MIRRORED_ACTION)
    assert found == pytest.approx(other, abs=1e-5)


def test_the_density_is_that_of_torch():
    alpha, beta, x = torch.tensor([1.5, 30.0]), torch.tensor([2.5, 1.0]), torch.tensor([0.2, 0.97])
    wanted = torch.distributions.Beta(alpha, beta).log_prob(x)
    assert log_density(alpha, beta, x).numpy() == pytest.approx(wanted.numpy(), rel=1e-5)


def test_the_mean_is_fitted_by_the_error_and_the_width_by_likelihood():
    alpha = torch.tensor([[3.0, 3.0]], requires_grad=True)
    beta = torch.tensor([[3.0, 3.0]], requires_grad=True)
    loss, errors = loss_of(Policy(alpha, beta), torch.tensor([[0.3, 0.0]]))
    up, down = torch.autograd.grad(loss, [alpha, beta])
    assert errors.tolist() == pytest.approx([0.3, 0.0])
    assert up[0, 0] < 0 < down[0, 0]  # towards more acceleration
    # steering is right: only the width changes, both alike, and gets narrower
    assert up[0, 1] == pytest.approx(float(down[0, 1]), abs=1e-6)
    assert up[0, 1] < 0


def test_to_brake_less_than_the_label_is_worse_than_more():
    def slope(label):
        alpha = torch.full((1, 2), 3.0, requires_grad=True)
        loss, _ = loss_of(Policy(alpha, torch.full((1, 2), 3.0)), torch.tensor([[label, 0.0]]))
        return abs(float(torch.autograd.grad(loss, alpha)[0][0, 0]))

    certain = slope(0.0)  # what the likelihood adds is small
    assert slope(-0.2) - certain == pytest.approx(LATE * (slope(0.2) - certain), rel=0.05)


def test_learning_begins_with_given_weights():
    torch.manual_seed(3)
    begin = CarlNetwork().state_dict()
    learner = Learner("cpu", 1, total=4, seed=0, begin=begin)
    official = to_official(begin)
    assert all(torch.equal(value, official[name]) for name, value in learner.driving().items())


def test_the_learning_rate_rises_and_falls():
    values = [schedule(done) for done in np.linspace(0.0, 1.0, 101)]
    assert max(values) == pytest.approx(1.0, abs=1e-3)
    assert values[0] < 0.01
    assert values[-1] == pytest.approx(0.01)
    assert sorted(values[3:], reverse=True) == values[3:]


@pytest.fixture
def states(tmp_path, rng):
    found = [
        State(
            compress_raster(raster),
            measured,
            rng.uniform(-1, 1, 2).astype(np.float32),
            number % 5 == 0,
        )
        for number, (raster, measured) in enumerate(
            zip(rasters(rng, 24), measurements(rng, 24), strict=True)
        )
    ]
    write_part(tmp_path / "round-00", found[:10])
    write_part(tmp_path / "round-01", found[10:])
    made = States([tmp_path / f"round-0{number}" for number in range(2)])
    for index, state in enumerate(found):
        raster = read_raster(state.picture)
        both = made.rasters(np.array([index, index]), [False, True])
        assert np.array_equal(both, [raster, raster[:, ::-1]])
        assert np.array_equal(made.actions[index], state.action)
    return made


def test_rare_states_are_drawn_more_often(states):
    measured, actions = np.zeros((5, 10), np.float32), np.zeros((5, 2), np.float32)
    actions[1, 0], actions[2, 1], actions[3, 0] = -0.5, 0.5, -0.7
    urgent = np.arange(5) == 4
    assert importance(measured, actions, urgent).tolist() == [1.0, 2.0, 3.0, 3.0, 4.0]
    drawn = states.draw(20_000, np.random.default_rng(0))
    weights = importance(states.measurements, states.actions, np.arange(24) % 5 == 0)
    shares = np.bincount(drawn, minlength=len(states)) / len(drawn)
    assert shares == pytest.approx(weights / weights.sum(), abs=0.01)


def test_a_batch_hides_last_actions_and_mirrors_with_the_sign_of_steering(states):
    batch = draw_batch(states, (1, 2), size=4000)
    plain = states.actions[batch.indices]
    flipped = np.where(batch.mirrored[:, None], MIRRORED_ACTION, np.float32([1, 1]))
    assert np.array_equal(batch.actions, plain * flipped)
    assert batch.mirrored.mean() == pytest.approx(MIRRORED, abs=0.05)
    hidden = (batch.measurements[:, :2] == 0.0).all(axis=1)
    assert hidden.mean() == pytest.approx(0.5, abs=0.05)
    again = draw_batch(states, (1, 2), size=4000)
    assert np.array_equal(again.measurements, batch.measurements)


@pytest.mark.thorough
def test_learning_depends_on_the_seed_and_not_on_the_number_of_threads(states):
    def learnt(threads, seed):
        learner = Learner("cpu", threads, total=4, seed=seed)
        for step in range(3):
            done = learner.learn(states, draw_batch(states, (0, step)))
        return done, learner.driving()

    one, network = learnt(1, 0)
    two, other = learnt(2, 0)
    assert one == two
    assert all(torch.equal(network[name], other[name]) for name in network)
    assert learnt(1, 1)[0] != one


@pytest.mark.thorough
def test_it_learns_a_few_states_by_heart(states):
    learner = Learner("cpu", 2, total=60, seed=0)
    losses = [learner.learn(states, draw_batch(states, (0, step))).loss for step in range(60)]
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
    assert BATCH == 64
