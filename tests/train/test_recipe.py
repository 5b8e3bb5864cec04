"""The whole recipe on a tiny store: the same again, after a kill as well, and drivable."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pyarrow.parquet as pq
import pytest

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.errors import CheckpointError, ConfigError, DataError
from shiftsim.planners.learned.carl.planner import Carl
from shiftsim.train import recipe
from shiftsim.train.driving import Driven, Driver, Job, Start, divide
from shiftsim.train.folder import (
    BEST,
    LATEST,
    STATE,
    ImitationSettings,
    Settings,
    TrafficSettings,
)
from shiftsim.train.recipe import ImitationTraining, Training
from shiftsim.train.traffic.recipe import train_traffic

pytestmark = pytest.mark.thorough


def curve_of(settings):
    return pq.read_table(settings.out / "curve.parquet").to_pylist()


def train(settings, **options):
    Training(settings, lambda text: None, **options).run()


def test_the_same_seed_gives_the_same_curve_and_network(small, trained):
    first, _ = trained
    again, other = small("again"), small("other", seed=6)
    for settings in (again, other):
        train(settings)
    assert curve_of(first) == curve_of(again) != curve_of(other)
    assert (first.out / LATEST).read_bytes() == (again.out / LATEST).read_bytes()


def test_a_training_that_was_ended_goes_on_as_if_it_had_not(small, trained, monkeypatch):
    whole, ended = trained[0], small()
    monkeypatch.setattr(recipe, "_WRITE_EVERY", 0.0)
    monkeypatch.setattr(recipe, "_CURVE_EVERY", 1)
    learn, steps = recipe.learning.Learner.learn, []

    def stopping(learner, *batch):
        steps.append(1)
        if len(steps) == 5:
            raise KeyboardInterrupt
        return learn(learner, *batch)

    monkeypatch.setattr(recipe.learning.Learner, "learn", stopping)
    with pytest.raises(KeyboardInterrupt):
        train(ended)
    train(ended, resume=True)
    assert len(steps) == 7  # 6 steps, of which the interrupted one was begun twice
    assert (ended.out / LATEST).read_bytes() == (whole.out / LATEST).read_bytes()


def test_what_comes_out_drives_and_says_how_it_came(trained, toy, tmp_path):
    settings, lines = trained
    for name in ("best.safetensors", "curves.png", "scores.parquet", "settings.json"):
        assert (settings.out / name).stat().st_size > 0
    assert len(pq.read_table(settings.out / "scores.parquet")) == 2
    assert any("training on" in line for line in lines)
    assert (settings.out / BEST).stat().st_size < 8_000_000
    done = shiftsim.run(
        "carl",
        checkpoints=[f"carl={settings.out / BEST}"],
        store=str(toy),
        workers=1,
        out=str(tmp_path / "run"),
    )
    assert done.is_complete


def test_with_weights_to_begin_with_the_network_drives_at_once(small, trained, monkeypatch):
    asked = []

    def run_jobs(training, checkpoint, what, jobs):
        asked.append(checkpoint)
        return [Driven([None] * 20, [], [])]

    monkeypatch.setattr(Training, "_run_jobs", run_jobs)
    monkeypatch.setattr(recipe, "write_part", lambda folder, states: list(states))
    settings = small("more", checkpoint=str(trained[0].out / BEST))
    training = Training(settings, print)
    training._collect()
    assert asked == [str(settings.out / LATEST)]
    assert (settings.out / LATEST).read_bytes() == (trained[0].out / BEST).read_bytes()


def test_what_comes_before_an_infraction_of_the_network_is_urgent(toy, monkeypatch):
    def veering(policy, features):
        return [np.ones(2, np.float32) for _ in features]

    def urgent(expert_steps):
        starts = tuple(Start(token, "none", 0, expert_steps) for token in sorted(tokens)[:2])
        return [x.is_urgent for x in driver(Job(starts, False, 0.3)).states]

    tokens = open_store(toy).tokens
    driver = Driver(str(toy), "deterministic:base")
    monkeypatch.setattr(Carl, "infer", veering)
    assert 0 < sum(urgent(0)) <= 2 * 15
    assert not any(urgent(-1))


def test_tau_is_chosen_by_driving_the_expert_through_its_labels(small):
    settings = small(tau=0.0, samples=64, rounds=1)
    train(settings)
    rows = pq.read_table(settings.out / "tau.parquet").to_pylist()
    assert [row["tau"] for row in rows] == [0.2, 0.3, 0.5]
    assert min(row["none"] for row in rows) > 0.3


def test_every_round_collects_something(small):
    settings = small(states=1)
    train(settings)
    assert settings.part(1).exists()


def test_towns_that_are_tested_on_are_not_trained_on(toy):
    store = open_store(toy)
    towns = divide(store, store.tokens, 0)
    trained = {token for tokens in towns.trained.values() for token in tokens}
    tested = {token for tokens in towns.tested.values() for token in tokens}
    assert trained | tested == set(store.tokens)
    assert not trained & tested
    assert tested


@pytest.mark.parametrize("of", [Settings, ImitationSettings, TrafficSettings])
def test_a_split_that_the_store_lacks_a_part_of_is_refused(of, toy, tmp_path):
    (tmp_path / "mix.txt").write_text("0000cafe\n0001cafe\n0002cafe\nffffcafe\n")
    train = {TrafficSettings: train_traffic, Settings: Training}.get(of, ImitationTraining)
    settings = of(store=str(toy), split=str(tmp_path / "mix.txt"), out=tmp_path / "out")
    with pytest.raises(DataError, match=r"split 'mix' needs 4 scenarios, .* lacks 1 of them"):
        train(settings, print)
    assert not settings.out.exists()


def test_a_folder_holds_one_training(small, tmp_path):
    settings = small()
    Training(settings, print)
    with pytest.raises(ConfigError, match="holds a training already"):
        Training(settings, print)
    with pytest.raises(ConfigError, match="seed 5, not 6"):
        Training(small(seed=6), print, resume=True)
    (settings.out / STATE).write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match=r"state\.pt"):
        Training(settings, print, resume=True)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(ConfigError, match="not empty"):
        Training(small("full"), print)


@pytest.mark.parametrize(
    "changes", [{"rounds": 0}, {"tau": -1.0}, {"seed": -1}, {"workers": 0}, {"samples": 0}]
)
def test_numbers_that_make_no_training_are_refused(tmp_path, changes):
    with pytest.raises(ConfigError):
        Settings(store="demo", out=tmp_path, **changes)


def test_a_killed_command_goes_on(small, toy):
    whole, killed = small("whole", samples=6_400), small("killed", samples=6_400)
    train(whole)
    words = [*(sys.executable, "-m", "shiftsim", "train", "carl", "--store", str(toy))]
    words += ["--out", str(killed.out), "--rounds", "2", "--states", "40", "--samples", "6400"]
    words += ["--tau", "0.3", "--tests", "2", "--workers", "1", "--seed", "5"]
    process = subprocess.Popen(words)
    while not (killed.out / LATEST).exists():
        assert process.poll() is None
        time.sleep(0.2)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    subprocess.run([*words, "--resume"], check=True)
    assert (killed.out / LATEST).read_bytes() == (whole.out / LATEST).read_bytes()
