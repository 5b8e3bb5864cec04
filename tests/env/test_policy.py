"""Policies of the environment as planners: the same scores, from functions and from files."""

import copy
import hashlib
import pickle
import shutil
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import shiftsim
from shiftsim.env.driving import DrivingEnv
from shiftsim.errors import ConfigError, InvalidTrajectoryError, MissingExtraError
from shiftsim.planners.registry import load_planner, planner_fingerprint, run_planner
from shiftsim.sim.planner import sees_recording

TOKEN = "0001cafe"  # of the toy store: a car is parked in the lane


class Weaving:
    """Acts by all that it sees, and notes what that was."""

    def __init__(self, action="command", space=None):
        self.action, self.observation_space, self.seen = action, space, []

    def __call__(self, seen):
        parts = [seen[name] for name in sorted(seen)] if isinstance(seen, dict) else [seen]
        self.seen.append(hashlib.sha256(b"".join(np.asarray(p).tobytes() for p in parts)).digest())
        turn = 1e-3 * (self.seen[-1][0] % 100) - 0.05
        if self.action == "command":
            return np.array([8 * turn, turn], np.float32)
        ahead = np.arange(1, 11, dtype=np.float32)
        return np.stack([0.7 * ahead, 0.1 * turn * ahead, turn * ahead], axis=1)


def scores_of_episode(env, act, row):
    """What the environment says at the end of the episode of a row of the scores."""
    seen, _ = env.reset(options={"token": row["token"], "noise_seed": row["seed"]})
    truncated = False
    while not truncated:
        seen, _, _, truncated, info = env.step(act(seen))
    return info["scores"]


def check_scores(run, env, act):
    rows = run.scores.to_pylist()
    assert rows
    for row in rows:
        scores = scores_of_episode(env, act, row)
        assert len(scores) == 9
        assert scores == {name: row[name] for name in scores}


@pytest.mark.thorough
@pytest.mark.parametrize("noise", ["none", "ou-high"])
@pytest.mark.parametrize("action", ["command", "trajectory"])
@pytest.mark.parametrize("observation", ["none", "vector", "raster"])
def test_the_scores_are_those_of_the_environment(toy, tmp_path, observation, action, noise):
    policy = Weaving(action)
    planner = shiftsim.policy_planner(policy, observation=observation, action=action)
    settings = {"store": str(toy), "noise": noise}
    run = shiftsim.run(planner, seeds=[3], workers=1, out=str(tmp_path / "run"), **settings)
    env = DrivingEnv(observation=observation, action=action, terminate=False, **settings)
    if observation == "raster":  # the rest is for those who are shown the recording
        env = gymnasium.wrappers.FilterObservation(env, ["raster", "measurements"])
    check_scores(run, env, policy)
    assert not sees_recording(planner)


@pytest.mark.parametrize("observation", ["vector", "raster"])
@pytest.mark.parametrize("traffic", ["nonreactive", "reactive"])
def test_it_is_shown_what_the_environment_shows(observation, traffic):
    settings = {"noise": "ou-high", "traffic": traffic}
    env = DrivingEnv(observation=observation, terminate=False, **settings)
    mine, other = (Weaving(space=env.observation_space) for _ in range(2))
    planner = shiftsim.policy_planner(mine)
    scenario = shiftsim.open_store("demo")["01f13e"]
    shiftsim.simulate(scenario, planner, seed=5, **settings)
    scores_of_episode(env, other, {"token": scenario.token, "seed": 5})
    assert len(mine.seen) == len(other.seen) + 1 == scenario.num_iterations - 1
    assert mine.seen[:-1] == other.seen  # the last action of a planner is never executed
    assert sees_recording(planner) == (observation == "raster")


class Remembering:
    """Predicts as a recurrent model does."""

    def predict(self, observation, state=None, deterministic=False):
        assert deterministic
        count = 0 if state is None else state
        return np.array([0.01 * count, 0.0]), count + 1


class Gap:
    """An observation of one's own: the way to the first track."""

    space = gymnasium.spaces.Box(0.0, 1e4, (1,))

    def start(self, episode):
        self.token = episode.scene.token

    def look(self, episode):
        seen = episode.observe()
        return np.array([np.hypot(*(seen.tracks.poses[0, 0, :2] - seen.ego.pose[:2]))])


class Recorded(Gap):
    def look(self, episode):
        return episode.log.ego[-1]


def test_what_a_policy_remembers_is_of_one_scenario(toy):
    scenario = shiftsim.open_store(toy)[TOKEN]
    planner = shiftsim.policy_planner(Remembering(), observation="none")
    first, again = (shiftsim.simulate(scenario, planner) for _ in range(2))
    np.testing.assert_allclose(first.commands[:-1, 0], 0.024 * np.arange(len(first.commands) - 1))
    np.testing.assert_array_equal(first.commands, again.commands)


def test_observations_of_ones_own_know_no_recording(toy, tmp_path):
    scenario, seen = shiftsim.open_store(toy)[TOKEN], []
    planner = shiftsim.policy_planner(lambda gap: seen.append(gap) or [0, 0], observation=Gap())
    shiftsim.simulate(scenario, planner)
    assert 0 < seen[-1] < seen[0]
    with pytest.raises(AttributeError, match="'PlannerEpisode' object has no attribute 'log'"):
        shiftsim.simulate(scenario, shiftsim.policy_planner(len, observation=Recorded()))


GAIN = 0.1


class Unwilling:
    def __reduce__(self):
        raise ValueError("not today")


def steady(seen):
    return [GAIN, 0.0]


def test_what_a_function_refers_to_is_a_part_of_it(monkeypatch):
    before = run_planner(shiftsim.policy_planner(steady), {}).fingerprint
    monkeypatch.setitem(steady.__globals__, "GAIN", 0.2)
    after = run_planner(shiftsim.policy_planner(steady), {}).fingerprint
    monkeypatch.setitem(steady.__globals__, "GAIN", Unwilling())
    hidden = run_planner(shiftsim.policy_planner(steady), {}).fingerprint
    assert before["source"] != after["source"]
    assert [one.get("unseen", False) for one in (before, after, hidden)] == [False, False, True]


@pytest.mark.parametrize(
    ("policy", "settings", "message"),
    [
        (3, {}, "3 is no policy"),
        (len, {"observation": "pixels"}, "observation 'pixels' unknown"),
        (len, {"action": "steer"}, "action 'steer' unknown"),
        (
            Weaving(space=gymnasium.spaces.Box(-1, 1, (7,))),
            {},
            r"Box\(.*7.*neither none nor raster",
        ),
        (
            Weaving(space=gymnasium.spaces.Box(-1, 1, (7,))),
            {"observation": "raster"},
            r"Box\(.*7.*not raster",
        ),
    ],
)
def test_what_is_no_policy_is_refused(policy, settings, message):
    with pytest.raises(ConfigError, match=message):
        shiftsim.policy_planner(policy, **settings)


@pytest.mark.parametrize(
    ("action", "error", "message"),
    [
        ([0.0, 0.0, 0.0], ConfigError, r"the action has shape \(3,\); it must be \(2,\)"),
        ("left", ConfigError, "the action is a str, no array"),
        ([np.nan, 0.0], InvalidTrajectoryError, "iteration 0: the command has acceleration nan"),
    ],
)
def test_actions_that_are_none_are_named(toy, action, error, message):
    planner = shiftsim.policy_planner(lambda seen: action, observation="none")
    with pytest.raises(error, match=message):
        shiftsim.simulate(shiftsim.open_store(toy)[TOKEN], planner)


def coast(seen):
    return [0.0, 0.0]


def test_a_function_is_told_from_another_by_its_code(tmp_path):
    one, other = (run_planner(shiftsim.policy_planner(act), {}) for act in (coast, len))
    assert (one.name, other.name) == ("coast", "len")
    assert one.fingerprint["source"] != other.fingerprint["source"]
    assert one.fingerprint == run_planner(shiftsim.policy_planner(coast), {}).fingerprint
    assert one.can_travel


def test_a_function_of_the_main_script_stays_in_its_process(monkeypatch):
    def act(seen):
        return [0.0, 0.0]

    act.__module__, act.__qualname__ = "__main__", "act"
    monkeypatch.setattr(sys.modules["__main__"], "act", act, raising=False)
    pickle.dumps(act)
    assert not run_planner(shiftsim.policy_planner(act), {}).can_travel


def test_it_obeys_the_contract_of_planners(toy):
    scenes = [*shiftsim.open_store(toy)]
    planner = shiftsim.policy_planner(coast)
    found = shiftsim.check_planner(planner, scenes[0], scenes[1])
    assert [one.severity for one in found] == ["note"]


INTERFACE = 'observation = "{}"\naction = "{}"\n'


def network(observation, action):
    """A network that weaves about, and what it is called with."""
    torch = pytest.importorskip("torch")
    torch.manual_seed(3)
    size, count = (345, 10)[observation == "raster"], (2, 30)[action == "trajectory"]
    layer = torch.nn.Linear(size, count)

    class Policy(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = layer

        def forward(self, *parts):
            out = 0.05 * torch.tanh(self.layer(parts[-1]))
            return out.view(-1, 10, 3) if count == 30 else out

    raster = [torch.zeros((1, 9, 256, 256), dtype=torch.uint8)] if observation == "raster" else []
    return Policy().eval(), (*raster, torch.zeros((1, size)))


def write_network(folder, kind, observation="vector", action="command"):
    torch = pytest.importorskip("torch")
    module, example = network(observation, action)
    path = folder / ("policy.pt" if kind == "script" else "policy.pt2")
    if kind == "script":
        torch.jit.trace(module, example).save(path)
    else:
        torch.export.save(torch.export.export(module, example), path)
    path.with_name(f"{path.name}.toml").write_text(INTERFACE.format(observation, action))
    return path, module


def command_line(folder, *words):
    call = [sys.executable, "-m", "shiftsim", *map(str, words)]
    return subprocess.run(
        call, cwd=folder, capture_output=True, text=True, stdin=subprocess.DEVNULL
    )


@pytest.mark.learned
@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "observation", "action"),
    [
        ("script", "vector", "command"),
        pytest.param("script", "raster", "trajectory", marks=pytest.mark.thorough),
        pytest.param("export", "vector", "trajectory", marks=pytest.mark.thorough),
        pytest.param("export", "raster", "command", marks=pytest.mark.thorough),
    ],
)
def test_a_network_in_a_file_drives(toy, tmp_path, kind, observation, action):
    path, module = write_network(tmp_path, kind, observation, action)
    settings = {"store": str(toy), "noise": "ou-high"}
    ways = {"many": {"workers": 2}, "apart": {"workers": 1, "isolate": True}}
    runs = [
        shiftsim.run(f"policy:{path}", out=str(tmp_path / name), **settings, **more)
        for name, more in ways.items()
    ]
    torch = pytest.importorskip("torch")

    def act(seen):
        parts = [seen["raster"], seen["measurements"]] if observation == "raster" else [seen]
        with torch.inference_mode():
            return module(*(torch.from_numpy(part[None]) for part in parts))[0].numpy()

    env = DrivingEnv(observation=observation, action=action, terminate=False, **settings)
    for run in runs:
        check_scores(run, env, act)


@pytest.mark.learned
def test_a_file_is_told_from_another_by_its_content(tmp_path):
    path, _ = write_network(tmp_path, "script")
    spec = f"policy:{path}"
    found = planner_fingerprint(spec)
    digests = [
        hashlib.sha256(p.read_bytes()).hexdigest() for p in (path, tmp_path / "policy.pt.toml")
    ]
    assert found["files"] == {"policy": digests[0], "interface": digests[1]}
    assert "source" not in found
    planner = load_planner(spec)
    assert planner.name == spec
    for twin in (copy.deepcopy(planner), pickle.loads(pickle.dumps(planner))):
        np.testing.assert_array_equal(twin.act(np.ones(345, "f4")), planner.act(np.ones(345, "f4")))


@pytest.mark.learned
@pytest.mark.thorough
def test_a_file_obeys_the_contract_on_the_command_line(toy, tmp_path):
    write_network(tmp_path, "export")
    done = command_line(tmp_path, "planners", "check", "policy:policy.pt2", "--store", toy)
    assert "policy:policy.pt2 on scenario" in done.stdout
    assert "obeys the contract" in done.stdout, done.stdout + done.stderr


@pytest.mark.learned
@pytest.mark.parametrize(
    ("interface", "message"),
    [
        (None, r"policy.pt' needs a file 'policy.pt.toml' beside it"),
        ('observation = "vector"', r"policy.pt.toml: action is missing"),
        (
            INTERFACE.format("vector", "command") + "noise = 1",
            r"policy.pt.toml: key 'noise' unknown",
        ),
        (INTERFACE.format("pixels", "command"), r"policy.pt': observation 'pixels' unknown"),
        (INTERFACE.format("vector", "trajectory"), r"has shape \(2,\); it must be \(10, 3\)"),
        (
            INTERFACE.format("none", "command"),
            r"policy.pt' cannot act: RuntimeError: ",
        ),
        ("observation", "is not TOML"),
    ],
)
def test_a_wrong_interface_is_named(tmp_path, interface, message):
    path, _ = write_network(tmp_path, "script")
    beside = tmp_path / "policy.pt.toml"
    beside.unlink() if interface is None else beside.write_text(interface)
    with pytest.raises(ConfigError, match=message):
        load_planner(f"policy:{path}")


@pytest.mark.learned
def test_files_that_hold_no_policy_are_refused(tmp_path):
    torch = pytest.importorskip("torch")
    torch.save({"a": torch.zeros(3)}, tmp_path / "weights.pt")
    (tmp_path / "text.pt").write_text("no zip")
    shutil.make_archive(str(tmp_path / "other"), "zip", tmp_path, "text.pt")
    for name, message in (
        ("missing.zip", "'.*missing.zip' is no policy: No such file"),
        ("weights.pt", "holds weights, but no network"),
        ("text.pt", "is no policy: File is not a zip file"),
        ("other.zip", "is another archive"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_planner(f"policy:{tmp_path / name}")


def write_model(path, kind, **settings):
    """A model of Stable-Baselines3 that has learned nothing."""
    library = pytest.importorskip("stable_baselines3")
    env = DrivingEnv(**settings)
    policy = "MultiInputPolicy" if settings["observation"] == "raster" else "MlpPolicy"
    small = {"buffer_size": 10} if kind in ("SAC", "TD3") else {"n_steps": 8}
    model = getattr(library, kind)(policy, env, seed=1, **small)
    model.save(path)
    return model


@pytest.mark.learned
@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "observation", "action"),
    [
        ("PPO", "vector", "command"),
        ("PPO", "raster", "command"),
        ("SAC", "vector", "trajectory"),
        ("TD3", "vector", "command"),
        ("A2C", "none", "command"),
    ],
)
def test_a_model_of_stable_baselines_drives(toy, tmp_path, kind, observation, action):
    settings = {"store": str(toy), "noise": "ou-high"}
    seen = {"observation": observation, "action": action}
    model = write_model(tmp_path / "policy.zip", kind, store=str(toy), **seen)
    spec, common = f"policy:{tmp_path / 'policy.zip'}", {**settings, "workers": 1}
    runs = [
        shiftsim.run(spec, out=str(tmp_path / "file"), **common),
        shiftsim.run(shiftsim.policy_planner(model), out=str(tmp_path / "object"), **common),
        shiftsim.run(spec, out=str(tmp_path / "apart"), isolate=True, **common),
    ]
    env = DrivingEnv(terminate=False, **settings, **seen)
    for run in runs:
        check_scores(run, env, lambda seen: model.predict(seen, deterministic=True)[0])
    assert [set(run.scores["planner"].to_pylist()) for run in runs] == [{spec}, {kind}, {spec}]


@pytest.mark.learned
def test_a_model_of_another_environment_is_refused(toy, tmp_path):
    library = pytest.importorskip("stable_baselines3")
    library.PPO("MlpPolicy", "CartPole-v1", n_steps=8).save(tmp_path / "policy.zip")
    with pytest.raises(ConfigError, match=r"made for Box\(.*which is neither none nor raster"):
        load_planner(f"policy:{tmp_path / 'policy.zip'}")
    env = gymnasium.wrappers.RescaleAction(DrivingEnv(store=str(toy)), 0.0, 1.0)
    library.PPO("MlpPolicy", env, n_steps=8).save(tmp_path / "policy.zip")
    with pytest.raises(ConfigError, match=r"Box\(0.0, 1.0.*which is neither command nor traj"):
        load_planner(f"policy:{tmp_path / 'policy.zip'}")


def test_without_stable_baselines_its_name_is_said(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    (tmp_path / "policy.pth").touch()
    shutil.make_archive(str(tmp_path / "policy"), "zip", tmp_path, "policy.pth")
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.save_util", None)
    with pytest.raises(MissingExtraError, match="pip install stable-baselines3"):
        load_planner(f"policy:{tmp_path / 'policy.zip'}")
