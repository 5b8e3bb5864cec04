"""The environment: what Gymnasium demands, and that it drives as a run does."""

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stores import write_toy_store
from worlds import cruise_scenario, standing_tracks

import shiftsim
import shiftsim.env
from shiftsim.data import open_store
from shiftsim.data.store.review import Review, Reviews, write_reviews
from shiftsim.env.driving import DrivingEnv
from shiftsim.errors import ConfigError, DataError, InvalidTrajectoryError
from shiftsim.planners.learned.carl.planner import MAX_ACCELERATION, command_of
from shiftsim.runs.edited import EditedStore, make_edits
from shiftsim.sim.loop import simulate
from shiftsim.sim.noise import sample_noise
from shiftsim.sim.perception import Localization, Perception
from shiftsim.world.state import AgentKind

TOKEN = "0001cafe"  # of the toy store: a car is parked in the lane
COAST = np.zeros(2, np.float32)


def drive(env, actions, **options):
    """Rewards, and the last step, of an episode driven by these actions or until it ends."""
    env.reset(options=options)
    rewards = []
    for action in actions:
        *_, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        if terminated or truncated:
            break
    return rewards, terminated, truncated, info


def weave(count=200):
    time = 0.1 * np.arange(count)
    return np.stack([0.8 * np.sin(time), 0.01 * np.cos(2 * time)], axis=1).astype(np.float32)


class Acting:
    """A planner that does what it is told."""

    def __init__(self):
        self.actions = weave()

    def reset(self, scene): ...

    def plan(self, observation):
        return command_of(self.actions[observation.iteration], observation.history.ego[-1])


@pytest.mark.thorough
@pytest.mark.parametrize("action", ["command", "trajectory"])
@pytest.mark.parametrize("observation", ["none", "vector", "raster"])
def test_gymnasium_has_nothing_to_say(toy, observation, action):
    made = gymnasium.make(
        "shiftsim/Driving-v0",
        store=str(toy),
        observation=observation,
        action=action,
        noise="ou-high",
        render_mode="rgb_array",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if action == "trajectory":  # metres, not -1 to 1
            warnings.filterwarnings("ignore", message=".*symmetric.*")
        check_env(made.unwrapped)


@pytest.mark.parametrize("observation", ["none", "vector", "raster"])
def test_stable_baselines_has_nothing_to_say(toy, observation):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(DrivingEnv(store=str(toy), observation=observation))


@pytest.mark.slow
@pytest.mark.parametrize("traffic", ["nonreactive", "reactive"])
def test_the_scores_are_those_of_a_run_with_the_same_actions(toy, tmp_path, traffic):
    run = shiftsim.run(
        Acting,
        noise="ou-high",
        seeds=[7],
        store=str(toy),
        traffic=traffic,
        workers=1,
        out=str(tmp_path / "run"),
    )
    env = DrivingEnv(store=str(toy), noise="ou-high", traffic=traffic, terminate=False)
    rows = run.scores.to_pylist()

    assert len(rows) == 4
    for row in rows:
        *_, truncated, info = drive(env, weave(), token=row["token"], noise_seed=7)
        assert truncated
        assert info["scores"] == {name: row[name] for name in info["scores"]}
        assert len(info["scores"]) == 9


def test_reset_gives_the_noise_of_a_task(toy):
    env = DrivingEnv(store=str(toy), noise="awgn-mid")
    _, info = env.reset(options={"token": TOKEN, "noise_seed": 3})
    expected = sample_noise("awgn-mid", seed=3, token=TOKEN, num_steps=24)
    np.testing.assert_array_equal(env.episode.log.noise, expected)
    assert (info["token"], info["noise_seed"]) == (TOKEN, 3)


def test_a_seed_decides_scenarios_and_noise(toy):
    def drawn(seed):
        env = DrivingEnv(store=str(toy))
        first = env.reset(seed=seed)[1]
        return [first, *(env.reset()[1] for _ in range(7))]

    assert drawn(4) == drawn(4)
    assert drawn(4) != drawn(5)
    assert len({info["token"] for info in drawn(4)}) > 1


@pytest.mark.parametrize("traffic", ["nonreactive", "reactive", "constant-velocity"])
def test_ego_and_traffic_move_as_in_the_closed_loop(source_of, traffic):
    poses, kinds = np.array([[30.0, 0.0, 0.0], [15.0, 3.5, 0.0]]), [AgentKind.VEHICLE] * 2
    tracks = standing_tracks(60 + 2 * 40 + 1 + 160, poses, kinds)
    tracks.velocities[:] = 5.0, 0.0
    scenario = cruise_scenario(iterations=41, tracks=tracks)
    settings = {"noise": "ou-high", "traffic": traffic}
    log = simulate(scenario, Acting(), seed=1, **settings)
    env = DrivingEnv(store=source_of(scenario), observation="none", terminate=False, **settings)
    drive(env, weave(), noise_seed=1)
    driven = env.episode.log
    np.testing.assert_array_equal(driven.ego, log.ego)
    np.testing.assert_array_equal(driven.commands[:-1], log.commands[:-1])
    np.testing.assert_array_equal(driven.tracks.poses, log.tracks.poses)
    assert (driven.tracks.poses[-1] == poses).all() == (traffic == "nonreactive")


def test_an_infraction_ends_an_episode_unless_it_may_go_on(source_of):
    scenario = cruise_scenario(iterations=101)
    left = np.array([0.0, 0.4], np.float32)
    source = source_of(scenario)
    rewards, terminated, truncated, info = drive(DrivingEnv(store=source, penalty=-5), [left] * 200)
    assert (terminated, truncated, info["infraction"]) == (True, False, "off_road")
    assert rewards[-1] == -5.0
    assert "scores" not in info

    short = len(rewards)
    env = DrivingEnv(store=source, terminate=False)
    rewards, terminated, truncated, info = drive(env, [left] * 200)
    assert (len(rewards), terminated, truncated) == (99, False, True)
    assert rewards[short - 1] == 0.0
    paid, *_ = drive(DrivingEnv(store=source, terminate=False, penalty=-5), [left] * 200)
    assert paid[short - 1 : short + 19] == [-5.0] * 20  # in every step off the road
    assert info["scores"]["drivable_area_compliance"] == 0.0


def test_the_score_is_paid_at_the_end(source_of):
    env = DrivingEnv(store=source_of(cruise_scenario(iterations=31)), reward="score")
    rewards, *_, info = drive(env, [COAST] * 200)
    assert rewards == [0.0] * 28 + [info["scores"]["cls"]]
    assert rewards[-1] > 0.9


def test_a_scenario_without_scores_says_why(source_of):
    env = DrivingEnv(store=source_of(cruise_scenario(iterations=4)), reward="score")
    rewards, *_, info = drive(env, [COAST] * 200)
    assert rewards == [0.0, 0.0]
    assert info["scores"] == {}
    assert "metrics need 4" in info["error"]


def test_actions_are_cut_at_their_bounds(source_of):
    env = DrivingEnv(store=source_of(cruise_scenario(iterations=11)))
    drive(env, [np.array([9.0, -9.0])])
    far = env.episode.log.ego[1].copy()
    drive(env, [np.array([1.0, -1.0])])
    np.testing.assert_array_equal(env.episode.log.ego[1], far)
    np.testing.assert_array_equal(env.episode.action, [1.0, -1.0])


def test_actions_that_cannot_be_executed_are_refused(source_of):
    env = DrivingEnv(store=source_of(cruise_scenario(iterations=4)))
    with pytest.raises(ConfigError, match="no episode"):
        env.step(COAST)
    env.reset()
    with pytest.raises(ConfigError, match=r"shape \(3,\); it must be \(2,\)"):
        env.step(np.zeros(3))
    with pytest.raises(InvalidTrajectoryError):
        env.step(np.array([np.nan, 0.0]))
    drive(env, [COAST] * 9)
    with pytest.raises(ConfigError, match="has ended"):
        env.step(COAST)


def test_a_trajectory_is_driven_by_the_tracker(source_of):
    env = DrivingEnv(store=source_of(cruise_scenario(iterations=31)), action="trajectory")
    plan = np.zeros((10, 3), np.float32)
    plan[:, 0] = 0.8 * np.arange(1, 11)  # at 8 m/s, as the ego is
    *_, truncated, info = drive(env, [plan] * 200)
    assert truncated
    np.testing.assert_allclose(env.episode.log.ego[-1, :3], [10 + 8.0 * 2.9, 0, 0], atol=0.05)
    assert info["scores"]["cls"] > 0.9


def test_observations_and_rewards_of_ones_own(source_of):
    class Speed:
        space = gymnasium.spaces.Box(0.0, 100.0, (1,))

        def start(self, episode):
            self.token = episode.scene.token

        def look(self, episode):
            return np.array([episode.observe().ego.speed], np.float32)

    source = source_of(cruise_scenario(speed=7.0))
    env = DrivingEnv(
        store=source, observation=Speed(), reward=lambda episode: float(episode.iteration)
    )
    assert env.reset()[0] == 7.0
    seen, reward, *_ = env.step(np.array([1.0, 0.0]))
    assert seen > 7.0
    assert reward == 1.0


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"reward": "regulr"}, ConfigError, "did you mean 'regular'|unknown"),
        ({"observation": "pixels"}, ConfigError, "observation 'pixels' unknown"),
        ({"action": "steer"}, ConfigError, "action 'steer' unknown"),
        ({"noise": "loud"}, ConfigError, "noise 'loud' unknown"),
        ({"noise": ["none", "ou-high"]}, ConfigError, "noise .*'ou-high'.* is no name or model"),
        (
            {"perception": "hihg"},
            ConfigError,
            "perception 'hihg' .*\nhint: did .* 'high'?.*miss-",
        ),
        (
            {"localization": "blur"},
            ConfigError,
            "localization 'blur' .*\nhint: .*high, low, mid$",
        ),
        ({"penalty": "x"}, ConfigError, "penalty is 'x'\nhint: give a finite number"),
        ({"penalty": np.nan}, ConfigError, "penalty is nan"),
        ({"terminate": "no"}, ConfigError, "terminate is 'no'\nhint: give True or False"),
        ({"latency": 150}, ConfigError, "not a multiple of 100 ms"),
        ({"traffic": "busy"}, ConfigError, "traffic 'busy' unknown"),
        ({"split": "none"}, ConfigError, "split 'none' unknown"),
        ({"render_mode": "human"}, ConfigError, "render_mode 'human' unknown"),
    ],
)
def test_settings_that_are_wrong_are_named(toy, settings, error, message):
    with pytest.raises(error, match=message):
        DrivingEnv(store=str(toy), **settings)


def test_what_is_not_there_is_named(toy, tmp_path, source_of):
    (tmp_path / "other.txt").write_text("0001cafe\nffffcafe\n")
    for store in (str(toy), source_of(cruise_scenario())):
        with pytest.raises(DataError, match=r"split 'other' needs 2 scenarios, .* lacks (1|2)"):
            DrivingEnv(store=store, split=str(tmp_path / "other.txt"))
    with pytest.raises(DataError, match="has no scenarios"):
        DrivingEnv(store=source_of())
    env = DrivingEnv(store=str(toy))
    with pytest.raises(ConfigError, match="option of reset 'tokn' unknown"):
        env.reset(options={"tokn": TOKEN})
    with pytest.raises(ConfigError, match="the store has no scenario 'ffff'"):
        env.reset(options={"token": "ffff"})
    assert env.reset(options={"token": TOKEN[:4], "noise_seed": np.int64(3)})[1]["token"] == TOKEN


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"noise_seed": one}, f"noise_seed is {one!r}") for one in (1.5, "3", True, -1, None)),
        ({"token": [TOKEN] * 3}, r"token is \['0001cafe'.*\nhint: give one token"),
        ({"snapshot": {}}, r"snapshot is {}\nhint: give the `snapshot` of an info"),
        ({"snapshot": ..., "token": TOKEN, "noise_seed": 1}, "has its own token and noise_seed"),
    ],
)
def test_options_that_are_wrong_are_named(toy, options, message):
    env = DrivingEnv(store=str(toy), observation="none")
    snapshot = env.reset()[1]["snapshot"]
    given = {name: snapshot if value is ... else value for name, value in options.items()}
    with pytest.raises(ConfigError, match=message):
        env.reset(options=given)


def test_a_reward_that_is_no_number_is_named(source_of):
    def nothing(episode): ...

    env = DrivingEnv(store=source_of(cruise_scenario()), reward=nothing)
    env.reset()
    with pytest.raises(ConfigError, match="reward nothing returned None"):
        env.step(COAST)


def test_a_split_limits_what_is_drawn(toy, tmp_path):
    (tmp_path / "one.txt").write_text(f"{TOKEN}\n")
    env = DrivingEnv(store=str(toy), split=str(tmp_path / "one.txt"))
    assert {env.reset()[1]["token"] for _ in range(6)} == {TOKEN}


def test_scenarios_that_filter_or_review_dropped_are_not_drawn(tmp_path):
    store = write_toy_store(tmp_path / "toy", count=2)
    write_reviews(store, Reviews([Review(TOKEN, "reject")]))
    for place in (str(store), open_store(store)):
        env = DrivingEnv(store=place)
        assert {env.reset()[1]["token"] for _ in range(6)} == {"0000cafe"}
    assert env.reset(options={"token": TOKEN})[1]["token"] == TOKEN
    edits = make_edits({"edit": [{"name": "none", "remove": {}, "tokens": [TOKEN]}]}, "x")
    assert DrivingEnv(store=EditedStore(open_store(store), edits)).reset()[1]["token"] != TOKEN


def test_the_picture_shows_the_ego_on_the_road(source_of):
    env = DrivingEnv(store=source_of(cruise_scenario()), render_mode="rgb_array")
    env.reset()
    picture = env.render()
    assert picture.shape == (256, 256, 3)
    np.testing.assert_array_equal(picture[127, 100], [180, 40, 120])
    np.testing.assert_array_equal(picture[120, 100], [185, 210, 190])  # the lane on the left
    np.testing.assert_array_equal(picture[10, 100], [245, 245, 245])


def test_without_gymnasium_the_extra_is_named():
    code = "import sys; sys.modules['gymnasium'] = None; import shiftsim.env"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "MissingExtraError: the environment needs gymnasium" in done.stderr


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("opened", [False, True])
def test_a_copy_in_mid_episode_goes_on_with_the_same_numbers(toy, duplicate, opened):
    store = shiftsim.open_store(toy) if opened else str(toy)
    env = DrivingEnv(store=store, noise="ou-high", traffic="reactive")
    env.reset(seed=5, options={"token": TOKEN})
    action = np.zeros(2, np.float32)
    for action[:] in weave(8):
        env.step(action)
    twin = duplicate(env)
    assert twin.episode.iteration == 8
    twin.step(COAST)  # leaves the original as it is
    assert env.episode.iteration == 8
    twin = duplicate(env)
    for action in weave(4):
        (seen, *others), (seen_by_twin, *others_of_twin) = env.step(action), twin.step(action)
        assert others_of_twin[:3] == others[:3]
        np.testing.assert_array_equal(seen_by_twin, seen)
    assert env.reset()[1] == twin.reset()[1]


def test_a_copy_before_the_first_episode_has_none(toy):
    twin = copy.deepcopy(DrivingEnv(store=str(toy)))
    with pytest.raises(ConfigError, match="no episode is under way"):
        twin.step(COAST)


def test_an_episode_goes_on_from_the_snapshot_of_a_step(toy):
    env = DrivingEnv(store=str(toy), noise="ou-high", traffic="reactive")
    other = DrivingEnv(store=str(toy), noise="ou-high", traffic="reactive")
    _, info = env.reset(options={"token": TOKEN, "noise_seed": 4})
    assert info["snapshot"].iteration == 0
    action = np.zeros(2, np.float32)
    for action[:] in weave(7):
        seen, *_, info = env.step(action)
    seen_by_other, begun = other.reset(options={"snapshot": info["snapshot"]})
    np.testing.assert_array_equal(seen_by_other, seen)
    assert begun["snapshot"] == info["snapshot"]
    assert other.episode.terms == env.episode.terms
    for action[:] in weave(5):
        (seen, *step, info), (seen_by_other, *step_of_other, told) = (
            env.step(action),
            other.step(action),
        )
        np.testing.assert_array_equal(seen_by_other, seen)
        assert (step_of_other, told) == (step, info)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_an_episode_can_be_copied(toy, duplicate):
    env = DrivingEnv(store=str(toy), observation="none")
    env.reset(options={"token": TOKEN})
    env.step(COAST)
    twin = duplicate(env.episode)
    assert (twin.iteration, twin.terms) == (1, env.episode.terms)
    assert twin.snapshot() == env.episode.snapshot()


def episode_under(toy, actions=None, **drift):
    """Observations, steps as texts, and the environment at the end."""
    env = DrivingEnv(store=str(toy), terminate=False, **drift)
    seen, info = env.reset(options={"token": TOKEN, "noise_seed": 4})
    shown, told = [seen], []
    for action in weave(140) if actions is None else actions:
        seen, *step, info = env.step(action)
        shown.append(seen)
        told.append(repr((step, info["terms"], info["infraction"], info.get("scores"))))
        if step[-1]:
            break
    return np.array(shown), told, env


@pytest.mark.parametrize("kind", ["perception", "localization"])
def test_observations_drift_and_the_truth_does_not(toy, kind):
    shown, told, env = episode_under(toy)
    zero = {"perception": Perception(), "localization": Localization(), "latency": 0}
    same, said, _ = episode_under(toy, **zero)
    assert same.tobytes() == shown.tobytes()
    assert said == told
    other, said, drifting = episode_under(toy, **{kind: "high"})
    assert said == told
    assert drifting.episode.log.ego.tobytes() == env.episode.log.ego.tobytes()
    assert (other != shown).any(axis=1).all()


def test_actions_arrive_late(toy):
    first = np.zeros((8, 2), np.float32)
    first[0, 0] = 1.0
    for latency in (0, 300):
        _, _, env = episode_under(toy, latency=latency, actions=first)
        sent = env.episode.log.commands[:8, 0]
        assert np.flatnonzero(sent == MAX_ACCELERATION).tolist() == [latency // 100]


@pytest.mark.parametrize("action", ["command", "trajectory"])
def test_an_episode_under_drift_goes_on_from_a_snapshot(toy, action):
    drift = {"perception": "high", "localization": "high", "latency": 200, "action": action}
    ahead = np.zeros((10, 3), np.float32)
    ahead[:, 0] = 0.5 * np.arange(1, 11)
    actions = weave(9) if action == "command" else [ahead] * 9
    *_, env = episode_under(toy, actions=actions, **drift)
    twin = copy.deepcopy(env)
    for given in actions:
        (seen, *step), (seen_by_twin, *step_of_twin) = env.step(given), twin.step(given)
        np.testing.assert_array_equal(seen_by_twin, seen)
        assert step_of_twin == step
    assert twin.episode.log.ego.tobytes() == env.episode.log.ego.tobytes()


def test_a_snapshot_of_another_setting_is_refused(toy):
    env = DrivingEnv(store=str(toy), observation="none")
    _, info = env.reset(options={"token": TOKEN})
    with pytest.raises(ConfigError, match="the snapshot has"):
        DrivingEnv(store=str(toy), traffic="reactive").reset(options=info_of(info))


def info_of(info):
    """The options that go on from a step."""
    return {"snapshot": info["snapshot"]}
