"""Planners learn from a store: the same again, also when interrupted, and drivable."""

import pyarrow.parquet as pq
import pytest
import torch
from stores import write_toy_store

import shiftsim
from shiftsim.errors import ConfigError, DataError
from shiftsim.planners.learned.checkpoint import network_module
from shiftsim.train import folder, recipe
from shiftsim.train.folder import BEST, LATEST, ImitationSettings, Preset, Settings
from shiftsim.train.imitation import ImitationLearner, motion
from shiftsim.train.recipe import ImitationTraining
from shiftsim.train.stream import Stream, load_blocks

pytestmark = [pytest.mark.learned, pytest.mark.thorough]
STEPS, BATCH = 6, 8
both = pytest.mark.parametrize("planner", ["plantf", "pluto"])  # what they share is the third's too
each = pytest.mark.parametrize("planner", ["plantf", "pluto", "diffusion-planner"])


@pytest.fixture(scope="module")
def road(tmp_path_factory):
    """A store of ten scenarios of 12 s, one of which is left out."""
    return write_toy_store(tmp_path_factory.mktemp("stores") / "road", count=10, iterations=121)


@pytest.fixture
def small(road, tmp_path, monkeypatch):
    """Makes the settings of a training that takes seconds."""
    preset = Preset(samples=STEPS * BATCH, rounds=2, batch=BATCH, rate=5e-4)
    monkeypatch.setitem(folder.PRESETS, "laptop", preset)
    for name in folder.COSTS:
        monkeypatch.setitem(folder.COSTS, name, 1.0)

    def make(name, **changes):
        return ImitationSettings(
            **{"store": str(road), "out": tmp_path / name, "tests": 1, "workers": 1, **changes}
        )

    return make


def train(settings, **options):
    lines = []
    ImitationTraining(settings, lines.append, **options).run()
    return lines


@both
def test_the_same_seed_gives_the_same_network_for_any_number_of_workers(small, planner):
    one, two, other = (
        small(name, planner=planner, **changes)
        for name, changes in (("one", {}), ("two", {"workers": 2}), ("other", {"seed": 1}))
    )
    for settings in (one, two, other):
        train(settings)
    networks = [(settings.out / LATEST).read_bytes() for settings in (one, two, other)]
    assert networks[0] == networks[1] != networks[2]


@both
def test_a_training_that_was_ended_goes_on_as_if_it_had_not(small, monkeypatch, planner):
    whole, ended = small("whole", planner=planner), small("ended", planner=planner)
    monkeypatch.setattr(recipe, "_WRITE_EVERY", 0.0)
    monkeypatch.setattr(recipe, "_CURVE_EVERY", 1)
    train(whole)
    learn, steps = ImitationLearner.learn, []

    def stopping(learner, batch):
        steps.append(1)
        if len(steps) == 5:
            raise KeyboardInterrupt
        return learn(learner, batch)

    monkeypatch.setattr(ImitationLearner, "learn", stopping)
    with pytest.raises(KeyboardInterrupt):
        train(ended)
    train(ended, resume=True)
    assert len(steps) == STEPS + 1  # the interrupted one was begun twice
    assert (ended.out / LATEST).read_bytes() == (whole.out / LATEST).read_bytes()


@each
def test_what_comes_out_drives_and_says_how_it_came(small, road, tmp_path, planner):
    settings = small("out", planner=planner)
    lines = train(settings)
    assert not [line for line in lines if "nan" in line]
    for name in ("curves.png", "curve.parquet", "settings.json", "runs/round-01/scores.parquet"):
        assert (settings.out / name).stat().st_size > 0
    rows = pq.read_table(settings.out / "scores.parquet").to_pylist()
    assert [row["samples"] for row in rows] == [24, 48]
    assert all(0.0 <= row[noise] <= 1.0 for row in rows for noise in ("none", "ou-high"))
    for row in rows:  # what is planned along the recording, beside what is driven
        assert row[f"ADE of {planner} [m]"] > row["ADE of constant-velocity [m]"] >= 0.0
    done = shiftsim.run(
        planner,
        checkpoints=[f"{planner}={settings.out / BEST}"],
        store=str(road),
        limit=1,
        workers=1,
        out=str(tmp_path / "run"),
    )
    assert done.is_complete


@each
def test_the_loss_of_one_batch_falls(road, planner):
    tokens = tuple(sorted(shiftsim.open_store(road).tokens))
    learner = ImitationLearner(planner, "cpu", Preset(0, 1, BATCH, 3e-3), total=200, seed=0)
    stream = Stream(str(road), tokens, seed=0, batch=BATCH, planner=planner)
    batch = next(load_blocks(stream, 0, 0)).batches[0]
    losses = [learner.learn(batch).loss for _ in range(100)]
    # the tokens of Diffusion Planner's agents take long to differ: first it learns their mean
    assert losses[-1] < (0.8 if planner == "diffusion-planner" else 0.6) * losses[0]


def test_the_published_schedule_goes_by_rounds_and_drives_with_the_last_weights(road):
    tokens = tuple(sorted(shiftsim.open_store(road).tokens))
    preset = Preset(0, 5, BATCH, 1e-3, published=True)
    learner = ImitationLearner("plantf", "cpu", preset, total=10, seed=0)
    batch = next(load_blocks(Stream(str(road), tokens, seed=0, batch=BATCH), 0, 0)).batches[0]
    rates = []
    for _ in range(10):
        learner.learn(batch)
        rates.append(learner.optimiser.param_groups[0]["lr"])
    expected = [1e-3 / 3, 2e-3 / 3, 1e-3, 1e-3, 1e-6 + 0.5 * (1e-3 - 1e-6)]
    assert rates == pytest.approx([rate for rate in expected for _ in range(2)])
    state = learner.network.state_dict()
    assert all(torch.equal(state[name], value) for name, value in learner.driving().items())


@pytest.mark.parametrize("planner", ["plantf", "pluto"])
def test_files_have_metres_where_training_has_units(road, planner):
    tokens = tuple(sorted(shiftsim.open_store(road).tokens))
    learner = ImitationLearner(planner, "cpu", Preset(0, 1, BATCH, 1e-3), total=10, seed=0)
    stream = Stream(str(road), tokens, seed=0, batch=BATCH, planner=planner)
    batch = next(load_blocks(stream, 0, 0)).batches[0]
    learner.learn(batch)
    for name, value in learner.mean.items():  # what is trained is what drives, for once
        value.copy_(learner.network.state_dict()[name])
    plain = network_module(planner).build_network()
    plain.load_state_dict(learner.driving())
    with torch.no_grad():
        ours, files = learner.network.eval()(batch.inputs), plain.eval()(batch.inputs)
    for name, value in ours._asdict().items():
        torch.testing.assert_close(getattr(files, name), value, atol=1e-4, rtol=1e-4)
    assert float(ours.trajectory[..., -1, 0].mean()) == pytest.approx(36.0, abs=30.0)


def test_diffusion_planner_begins_at_no_plan_and_draws_anew_each_step(road):
    tokens = tuple(sorted(shiftsim.open_store(road).tokens))
    learner = ImitationLearner("diffusion-planner", "cpu", Preset(0, 1, BATCH, 1e-3), 10, seed=0)
    stream = Stream(str(road), tokens, seed=0, batch=BATCH, planner="diffusion-planner")
    batch = next(load_blocks(stream, 0, 0)).batches[0]
    states = motion(batch.target[:, 0])
    states[..., :2] = (states[..., :2] - torch.tensor([10.0, 0.0])) / 20.0
    first = learner.learn(batch).terms["ego_planning_loss"]
    assert first == pytest.approx(float(states.square().sum(-1).mean()), rel=1e-4)
    assert learner.optimiser.param_groups[0]["weight_decay"] == 0.01


def test_too_few_scenarios_are_refused(small, tmp_path):
    store = write_toy_store(tmp_path / "two", count=2, iterations=121)
    settings = small("few", store=str(store))
    preset = Preset(samples=4_000, rounds=1, batch=400, rate=1e-3)
    folder.PRESETS["laptop"] = preset
    with pytest.raises(DataError, match="no batch of 400 samples"):
        train(settings)


@pytest.mark.parametrize("changes", [{"preset": "phone"}, {"tests": 0}, {"seed": -1}])
def test_settings_that_make_no_training_are_refused(small, changes):
    with pytest.raises(ConfigError):
        small("wrong", **changes)


def test_the_folder_of_another_planner_is_refused(small):
    folder.prepare_folder(small("out"), "a store", resume=False)
    with pytest.raises(ConfigError, match="planner 'plantf', not 'pluto'"):
        folder.prepare_folder(small("out", planner="pluto"), "a store", resume=True)


def test_the_folder_of_another_recipe_is_refused(small, tmp_path):
    folder.prepare_folder(Settings(out=tmp_path / "out"), "a store", resume=False)
    with pytest.raises(ConfigError, match="is of a training by another recipe, without batch"):
        folder.prepare_folder(small("out"), "a store", resume=True)


def test_a_sample_of_pluto_costs_more(monkeypatch):
    plantf, pluto = (ImitationSettings(out="out", planner=name) for name in ("plantf", "pluto"))
    assert pluto.recipe.samples == round(plantf.recipe.samples / 1.6)
    assert pluto.recipe[1:] == plantf.recipe[1:]


def test_a_folder_that_does_not_name_its_planner_is_of_plantf(small):
    folder.prepare_folder(small("out"), "a store", resume=False)
    place = small("out").out / folder.SETTINGS
    place.write_text(place.read_text().replace('"planner": "plantf",', ""))
    folder.prepare_folder(small("out"), "a store", resume=True)
    with pytest.raises(ConfigError, match="planner 'plantf', not 'pluto'"):
        folder.prepare_folder(small("out", planner="pluto"), "a store", resume=True)
