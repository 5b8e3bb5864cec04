"""What planners see in place of the truth, and plans that arrive late."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario, standing_tracks

from shiftsim.errors import ConfigError
from shiftsim.planners.basic import ConstantVelocity, LogFuture
from shiftsim.sim import sensing
from shiftsim.sim.loop import Rollout, simulate, simulate_together
from shiftsim.sim.noise import NoiseModel, keyed_generator
from shiftsim.sim.perception import (
    Drift,
    Localization,
    Perception,
    drift_order,
    make_drift,
    make_drifts,
    parse_drift,
)
from shiftsim.sim.sensing import Sensing, ar1, first_plans
from shiftsim.world.state import AgentKind, Command, Trajectory, tracks_of_boxes

ROWS, TRACKS = 400, 300
EVERYTHING = {"perception": "high+miss-high+dropout-high+range-60", "localization": "high"}


class Witness:
    """Drives straight on at 8 m/s and keeps what it was shown."""

    def reset(self, scene):
        self.scene, self.shown = scene, []

    def plan(self, observation):
        self.shown.append(observation)
        x, y, heading = observation.ego.pose
        times = 0.1 * np.arange(41)
        ahead = 8.0 * times[:, None] * [np.cos(heading), np.sin(heading)]
        return Trajectory.from_poses(times, np.c_[ahead + np.array([x, y]), np.full(41, heading)])


class Cruiser(Witness):
    """Plans the lane's centre, wherever it believes to be."""

    def plan(self, observation):
        super().plan(observation)
        times = 0.1 * np.arange(41)
        poses = np.c_[observation.ego.x + 8.0 * times, np.zeros(41), np.zeros(41)]
        return Trajectory.from_poses(times, poses)


def world(distance=20.0, names="t{}", rows=ROWS, count=TRACKS):
    """A standing ego, (R, 11), and boxes around it at a distance."""
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    boxes = np.tile(np.zeros((1, count, 7)), (rows, 1, 1))
    boxes[..., 0], boxes[..., 1] = distance * np.cos(angles), distance * np.sin(angles)
    boxes[..., 3:] = 3.0, -1.0, 4.0, 2.0
    tokens = [names.format(i) for i in range(count)]
    return np.zeros((rows, 11)), tracks_of_boxes(boxes, np.zeros(count, np.int64), tokens)


def seen_in(truth, seed=0, token="a1", **drift):
    found = Sensing(make_drift(**drift), seed, token, truth)
    found.see(len(truth[0]) - 1)
    return found


def scene(rows=60):
    scenario = cruise_scenario(speed=8.0, iterations=rows)
    poses = np.array([[30.0, 4.0, 0.0], [60.0, -4.0, 3.0], [130.0, 4.0, 1.0]])
    tracks = standing_tracks(len(scenario.time_us), poses, [AgentKind.VEHICLE] * 3)
    return replace(scenario, tracks=tracks)


def shown_tracks(one):
    return one.history.tracks


def same(a, b):
    return all(
        np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        for name in ("valid", "poses", "velocities", "sizes")
    )


@pytest.mark.parametrize(
    "name",
    [
        "none",
        "ou-high",
        "perception-low",
        "miss-mid",
        "dropout-high",
        "range-60",
        "localization-mid",
        "latency-200",
        "ou-low+perception-mid+miss-low+range-40+localization-high+latency-300",
    ],
)
def test_every_name_is_parsed_and_kept(name):
    assert parse_drift(name).name == name


def test_levels_are_those_of_the_boxes_and_of_the_pose():
    both = make_drift("ou-low", "mid", "low", 100)
    assert both.name == "ou-low+perception-mid+localization-low+latency-100"
    assert make_drift(perception="low+miss-low") == parse_drift("perception-low+miss-low")
    assert (both.perception.position, both.localization.position) == (0.3, 0.05)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("perception-huge", "perception 'huge' unknown"),
        ("loud", "noise 'loud' unknown"),
        ("latency-150", "latency 150 is not a multiple of 100 ms"),
        ("latency-soon", "latency 'soon' is not a whole number"),
        ("ou-low+awgn-low", "^'ou-low' and 'awgn-low' are two of a kind"),
        ("no.where:model", "cannot be imported"),
    ],
)
def test_a_wrong_name_is_refused(name, message):
    with pytest.raises(ConfigError, match=message):
        parse_drift(name)


def test_a_wrong_value_is_named_as_it_was_given():
    with pytest.raises(ConfigError, match=r"^'ou-low' and 'ou-high' are two of a kind") as caught:
        make_drift("none+ou-low+ou-high")
    assert "one each of noise, perception, miss" in caught.value.hint
    with pytest.raises(ConfigError, match=r"^latency '-100' is not a whole number, 0 or more"):
        make_drift(latency=-100)


def test_values_out_of_their_bounds_are_refused():
    with pytest.raises(ConfigError, match="perception missed is"):
        Perception(missed=0.5)
    with pytest.raises(ConfigError, match="localization position is nan"):
        Localization(position=np.nan)


def test_own_models_have_names_and_are_combined_with_all_others():
    blurred = Perception(position=1.0)
    assert blurred.name == "perception(position=1)"
    found = make_drifts(["none", "ou-low"], blurred, "none", [0, 100])
    assert [one.name for one in found] == [
        "perception(position=1)",
        "perception(position=1)+latency-100",
        "ou-low+perception(position=1)",
        "ou-low+perception(position=1)+latency-100",
    ]
    assert len(make_drifts("all", "none", "none", 0)) == 7


def test_drifts_are_ordered_by_kind_and_strength():
    names = ["latency-200", "latency-1000", "mine", "perception-high", "perception-low", "ou-low"]
    ordered = ["none", "ou-low", "perception-low", "perception-high"]
    assert drift_order([*names, "none"]) == [*ordered, "latency-200", "latency-1000", "mine"]


def test_noise_alone_has_the_fingerprint_it_always_had():
    found = Drift(NoiseModel("ou", 1.0, 0.2)).fingerprint()
    assert [*found] == ["kind", "sigma_accel", "sigma_rate", "theta", "function"]
    assert parse_drift("latency-200").fingerprint()["kind"] == "none"
    assert parse_drift("perception-low").fingerprint()["kind"] == "sensing"


@pytest.mark.parametrize(
    "level", [{}, {"perception": Perception(), "localization": Localization()}, {"latency": 0}]
)
def test_level_zero_is_byte_equal_to_none(level):
    plain = simulate(scene(), ConstantVelocity(), noise="ou-high")
    other = simulate(scene(), ConstantVelocity(), noise="ou-high", **level)
    assert other.seen is None
    assert plain.ego.tobytes() == other.ego.tobytes()
    assert plain.plans.tobytes() == other.plans.tobytes()


def test_a_history_shows_the_same_errors_at_every_step():
    planner = Witness()
    log = simulate(scene(), planner, **EVERYTHING)
    for before, after in zip(planner.shown, planner.shown[1:], strict=False):
        old, new = shown_tracks(before).rows(slice(1, None)), shown_tracks(after)
        if len(new) == 22:
            assert same(old, new.rows(slice(0, -1)))
            np.testing.assert_array_equal(before.history.ego[1:], after.history.ego[:-1])
    last = planner.shown[-1]
    assert same(last.tracks, log.seen.tracks.rows(slice(-1, None)))
    np.testing.assert_array_equal(last.ego.pose, log.seen.ego[-1])
    np.testing.assert_array_equal(planner.scene.start, log.seen.ego[0])


def test_errors_are_the_same_for_every_planner_and_in_lock_step():
    slow, fast = ConstantVelocity(), Witness()
    first = simulate(scene(), slow, perception="miss-high", seed=1)
    other = simulate(scene(), fast, perception="miss-high", seed=1)
    rows = slice(0, 10)  # before they are at different distances
    assert same(first.seen.tracks.rows(rows), other.seen.tracks.rows(rows))
    rollouts = [Rollout(scene(), Witness(), seed=seed, **EVERYTHING) for seed in (1, 2)]
    alone = simulate(scene(), Witness(), seed=2, **EVERYTHING)
    together = simulate_together(rollouts)[1]
    assert same(together.seen.tracks, alone.seen.tracks)
    np.testing.assert_array_equal(together.ego, alone.ego)


def test_a_track_has_the_same_errors_whoever_else_is_there():
    truth = world()
    ego, tracks = truth
    chosen = np.array([7, 3, 250])
    some = seen_in((ego, tracks.select(chosen)), perception="high+miss-high+dropout-high")
    everyone = seen_in(truth, perception="high+miss-high+dropout-high").tracks
    for number, token in enumerate(some.tracks.tokens):
        column = everyone.tokens.index(token)
        np.testing.assert_array_equal(some.tracks.poses[:, number], everyone.poses[:, column])


def test_seed_scenario_and_channel_are_keys():
    truth = world(count=3)
    one = seen_in(truth, perception="high").tracks.poses
    for other in ({"seed": 1}, {"token": "a2"}):
        assert not np.isclose(seen_in(truth, perception="high", **other).tracks.poses, one).any()
    normals = keyed_generator(0, "a1", "boxes\nt1").standard_normal((ROWS, 6))
    keeps = 0.9
    process = normals[:2, 0] * [1.0, np.sqrt(1.0 - keeps**2)] + [0.0, keeps * normals[0, 0]]
    truth_x = truth[1].poses[:2, 1, 0]
    np.testing.assert_allclose(one[:2, 1, 0] - truth_x, 0.5 * process, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("distance", "scale"), [(0.0, 0.5), (20.0, 1.0), (100.0, 3.0), (200.0, 3.0)]
)
def test_errors_of_boxes_have_the_stated_statistics(distance, scale):
    truth = world(distance)
    seen, true = seen_in(truth, perception="mid").tracks, truth[1]
    parts = {
        0.3: (seen.poses - true.poses)[..., :2],
        np.radians(3.0): (seen.poses - true.poses)[..., 2],
        0.5: seen.velocities - true.velocities,
        0.05: seen.sizes / true.sizes - 1.0,
    }
    for sigma, errors in parts.items():
        assert abs(errors.mean()) < 0.05 * scale * sigma
        assert errors.std() == pytest.approx(scale * sigma, rel=0.05)
        correlation = (errors[1:] * errors[:-1]).mean() / errors.var()
        assert correlation == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize(("distance", "share"), [(20.0, 0.1), (80.0, 0.2)])
def test_misses_have_the_stated_share_and_mean_length(distance, share):
    seen = seen_in(world(distance), perception="miss-mid").tracks
    assert (~seen.valid).mean() == pytest.approx(share, rel=0.05)
    ends = np.count_nonzero(~seen.valid[:-1] & seen.valid[1:])
    assert np.count_nonzero(~seen.valid[:-1]) / ends * 0.1 == pytest.approx(0.5, rel=0.1)
    assert np.isnan(seen.poses[~seen.valid]).all()


def test_lost_tracks_return_under_a_new_token():
    truth = world()
    seen = seen_in(truth, perception="dropout-high").tracks
    new = [token for token in seen.tokens if "~" in token]
    expected = TRACKS * ROWS * 0.1 / 75.0
    assert len(new) == pytest.approx(expected, rel=0.25)
    assert seen.valid.sum(axis=1).max() <= TRACKS
    token = new[0]
    before = seen.valid[:, seen.tokens.index(token.partition("~")[0])]
    after = seen.valid[:, seen.tokens.index(token)]
    assert np.flatnonzero(after)[0] - np.flatnonzero(before)[-1] - 1 == 40
    assert seen.kinds.shape == (len(seen.tokens),)


def test_boxes_beyond_the_range_are_not_seen():
    assert not seen_in(world(61.0), perception="range-60").tracks.valid.any()
    assert same(seen_in(world(59.0), perception="range-60").tracks, world(59.0)[1])


def test_the_pose_has_the_stated_statistics_and_boxes_move_with_it():
    ego, tracks = world(count=1, rows=100)
    found = np.stack([seen_in((ego, tracks), seed, localization="high").ego for seed in range(300)])
    for column, sigma in enumerate((0.3, 0.3, np.radians(1.0))):
        errors = found[:, :, column]
        assert abs(errors.mean()) < 0.1 * sigma
        assert errors.std() == pytest.approx(sigma, rel=0.1)
        correlation = (errors[:, 1:] * errors[:, :-1]).mean() / errors.var()
        assert correlation == pytest.approx(np.exp(-0.1 / 3.0), abs=0.01)
    moved = seen_in((ego, tracks), 1, localization="high")
    here, box = moved.ego[5, :3], moved.tracks.poses[5, 0]
    assert np.hypot(*(box - here)[:2]) == pytest.approx(20.0)
    assert box[2] == pytest.approx(here[2])


def test_a_plan_is_driven_from_where_the_ego_is():
    relative = simulate(scene(), Witness(), localization="high", seed=4)
    assert np.abs(relative.ego[:, 1]).max() < 0.5  # its errors of heading alone steer it
    scenario, planner = scene(150), Cruiser()
    log = simulate(scenario, planner, localization=Localization(0.3, 0.0, tau=60.0), seed=4)
    shift = (log.seen.ego - log.ego[:, :3])[:, 1]
    # who keeps to the lane drives beside it by the error
    np.testing.assert_allclose(log.ego[60:, 1], -shift[60:], rtol=0, atol=0.15)


def test_the_kernel_does_what_plain_python_does():
    drift = make_drift(**EVERYTHING)
    truth = world(55.0, rows=30, count=9)
    truth[1].valid[10:20, 4] = False
    compiled, plain = (Sensing(drift, 3, "a1", truth) for _ in range(2))
    compiled.see(29)
    kernel = sensing.see_boxes
    sensing.see_boxes = kernel.py_func
    try:
        plain.see(29)
    finally:
        sensing.see_boxes = kernel
    for name in ("valid", "poses", "velocities", "sizes"):
        ours, theirs = (getattr(one.tracks, name) for one in (compiled, plain))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


def test_an_ar1_process_begins_stationary():
    process = ar1(np.random.default_rng(0).standard_normal((5, 100_000)), 0.5)
    np.testing.assert_allclose(process.std(axis=1), 1.0, atol=0.02)


def test_a_late_plan_is_followed_so_many_steps_later():
    scenario = scene()

    class Pusher:
        def reset(self, scene):
            self.count = 0

        def plan(self, observation):
            self.count += 1
            return Command(0.1 * self.count, 0.0)

    on_time, late = (simulate(scenario, Pusher(), latency=ms) for ms in (0, 300))
    np.testing.assert_array_equal(late.commands[3:-1], on_time.commands[:-4])
    assert np.abs(late.commands[:3]).max() < 0.2  # before, it keeps its speed
    assert np.isnan(late.commands[-1]).all()


def test_the_first_plan_keeps_speed_and_curvature():
    turn = 0.02 * np.arange(11)
    past = np.zeros((11, 11))
    past[:, 0], past[:, 1], past[:, 2] = 50.0 * np.sin(turn), 50.0 * (1 - np.cos(turn)), turn
    past[:, 3] = 10.0
    [plan] = first_plans(100, past, 7)
    assert len(plan.time_us) == 12
    assert plan.time_us[0] == 7
    ahead = turn[-1] + 0.02 * np.arange(12)
    expected = np.c_[50.0 * np.sin(ahead), 50.0 * (1.0 - np.cos(ahead)), ahead]
    np.testing.assert_allclose(plan.states[:, :3], expected, rtol=0, atol=1e-3)


def test_a_plan_that_ends_before_it_arrives_goes_on_as_it_ends():
    class Short(Witness):
        def plan(self, observation):
            plan = super().plan(observation)
            return Trajectory(plan.time_us[:12], plan.states[:12], relative=True)

    log = simulate(scene(), Short(), latency=1500)
    np.testing.assert_allclose(log.ego[:, 3], 8.0, atol=0.5)


def test_planners_with_the_recording_drive_by_it_whatever_is_seen():
    first, second = (simulate(scene(), LogFuture(), perception=level) for level in ("none", "high"))
    np.testing.assert_array_equal(first.ego, second.ego)
