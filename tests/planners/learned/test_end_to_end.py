"""Every learned planner drives: on a demo town, in any company, alone and in batches."""

import importlib.util
from dataclasses import fields, is_dataclass, replace
from functools import partial

import numpy as np
import pytest
from stores import write_toy_store
from track_files import write_demo
from worlds import cruise_scenario, standing_tracks, straight_road

import shiftsim
from shiftsim.data.readers.dsc3d import convert_dsc3d
from shiftsim.data.store.reading import open_store
from shiftsim.metrics import compute_metrics
from shiftsim.planners.contract import check_planner
from shiftsim.planners.registry import load_planner
from shiftsim.report.build import make_tables
from shiftsim.report.groups import read_groups
from shiftsim.sim.loop import Rollout, simulate, simulate_together
from shiftsim.world.state import AgentKind

if importlib.util.find_spec("torch") is None:
    pytest.skip("needs torch", allow_module_level=True)

pytestmark = [pytest.mark.learned, pytest.mark.slow, pytest.mark.thorough]

LEARNED = ("carl", "diffusion-planner", "plantf", "pluto")
STEPS = 13
BATCH = 2e-5  # how much a batch may change what a network says, and what comes of it
NOISE = {"noise": "ou-high", "seed": 1}


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The first scenarios of one demo town, cut short."""
    folder = tmp_path_factory.mktemp("demo")
    write_demo(folder / "recordings", "junction")
    convert_dsc3d(folder / "recordings" / "junction", folder / "store", site="junction")
    store = open_store(folder / "store")
    return [cut(store.read(token)) for token in store.tokens[:3]]


def cut(scenario, iterations=STEPS):
    return replace(scenario, iteration_rows=scenario.iteration_rows[:iterations])


@pytest.fixture(scope="module")
def planners():
    """Each planner with its network, made once per kind of weights."""
    made = {}

    def get(name, variant="drive"):
        if (name, variant) not in made:
            made[name, variant] = load_planner(name, {"checkpoint": f"deterministic:{variant}"})
        return made[name, variant].fork()

    return get


@pytest.mark.parametrize("traffic", ["nonreactive", "reactive"])
@pytest.mark.parametrize("name", LEARNED)
def test_a_demo_scenario_is_driven_and_scored(demo, planners, name, traffic):
    log = simulate(demo[0], planners(name), traffic=traffic, **NOISE)
    assert len(log.ego) == STEPS - 1
    assert np.isfinite(log.ego).all()
    assert np.isfinite(log.commands[:-1]).all()
    assert not log.degraded.any()
    assert (log.planning_seconds > 0.0).all()
    score = compute_metrics(log, demo[0].map).score
    assert 0.0 <= score <= 1.0


@pytest.mark.parametrize("name", LEARNED)
def test_the_same_run_gives_the_same_bytes_after_another_one(demo, planners, name):
    planner = planners(name)
    first = simulate(demo[0], planner, **NOISE)
    simulate(demo[1], planner)
    again = simulate(demo[0], planner, **NOISE)
    assert first.ego.tobytes() == again.ego.tobytes()
    assert first.plans.tobytes() == again.plans.tobytes()


def test_diffusion_planner_samples_by_seed(demo, planners):
    plans = [simulate(demo[0], planners("diffusion-planner"), seed=seed).plans for seed in (0, 1)]
    assert not np.array_equal(plans[0], plans[1])


@pytest.mark.parametrize("name", LEARNED)
def test_a_planner_obeys_the_contract(demo, name):
    make = partial(load_planner, name, {"checkpoint": "deterministic:drive"})
    findings = check_planner(make, demo[0])
    assert [finding for finding in findings if finding.severity == "error"] == []


def numbers_of(output):
    """All numbers of what a network says, by place."""
    if output is None:
        return {}
    if is_dataclass(output):
        output = {field.name: getattr(output, field.name) for field in fields(output)}
    elif hasattr(output, "_asdict"):
        output = output._asdict()
    if not isinstance(output, dict):
        return {"": np.asarray(output)}
    return {
        f"{name}.{inner}": value
        for name, part in output.items()
        for inner, value in numbers_of(part).items()
    }


@pytest.mark.parametrize("variant", ["base", "drive"])
@pytest.mark.parametrize("name", LEARNED)
def test_a_batch_says_what_each_alone_says(demo, planners, name, variant):
    forks = [planners(name, variant) for _ in demo]
    seen = [Rollout(scene, fork) for scene, fork in zip(demo, forks, strict=True)]
    features = [r.planner.features(r.observe()) for r in seen]
    together = planners(name, variant).infer(features)
    for one, output in zip(features, together, strict=True):
        (alone,) = planners(name, variant).infer([one])
        expected = numbers_of(alone)
        assert expected
        for place, value in numbers_of(output).items():
            np.testing.assert_allclose(value, expected[place], rtol=0.0, atol=BATCH)


@pytest.mark.parametrize("name", LEARNED)
def test_scenarios_in_lock_step_are_driven_as_each_alone(demo, planners, name):
    scenes = [demo[0], cut(demo[1], 9), demo[2]]
    logs = simulate_together([Rollout(scene, planners(name), **NOISE) for scene in scenes])
    for scene, log in zip(scenes, logs, strict=True):
        alone = simulate(scene, planners(name), **NOISE)
        np.testing.assert_allclose(log.ego, alone.ego, rtol=0.0, atol=BATCH)
        a, b = (compute_metrics(one, scene.map).score for one in (log, alone))
        assert a == pytest.approx(b, abs=BATCH)


def test_a_run_with_made_up_weights_says_so_beside_its_scores(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_toy_store(tmp_path / "toy", count=2, iterations=6)
    arguments = {"planner_args": {"plantf": {"checkpoint": "deterministic:drive"}}}
    run = shiftsim.run("plantf", store="./toy", workers=1, **arguments)
    marked = "MEANINGLESS: made-up weights of plantf"
    assert marked in run.table()
    notes = {table.name: " ".join(table.notes) for table in make_tables(read_groups([run]))}
    assert marked in notes["scores"]
    assert marked in notes["planning-time"]
    honest = shiftsim.run("constant-velocity", store="./toy", workers=1)
    assert "MEANINGLESS" not in honest.table()


def crowd(scene, count):
    """As many standing tracks of all kinds around the start, none of them on the ego."""
    angle = np.linspace(0.0, 40.0, count)
    x, y = scene.ego[scene.iteration_rows[0], :2]
    radius = 15.0 + 2.0 * angle
    poses = np.c_[x + radius * np.cos(angle), y + radius * np.sin(angle), angle]
    kinds = [AgentKind(index % len(AgentKind)) for index in range(count)]
    return replace(scene, tracks=standing_tracks(len(scene.time_us), poses, kinds))


def strange_scenes():
    """Worlds that a planner must cope with, and whether its steps may be makeshifts."""
    bare = cruise_scenario(iterations=6, road=straight_road(speed_limit=None))
    yield "no agents, no limits, no lights", bare, False
    yield "500 agents", crowd(cruise_scenario(iterations=6), 500), False
    yield "no history", cruise_scenario(iterations=6, history_rows=0), True
    yield "short history", cruise_scenario(iterations=6, history_rows=9), True
    yield "no route", replace(cruise_scenario(iterations=6), route=()), True
    far = cruise_scenario(iterations=6, start=(5000.0, 5000.0, 1.0))
    yield "no road", far, True


@pytest.mark.parametrize(
    ("scene", "makeshift"),
    [pytest.param(scene, makeshift, id=name) for name, scene, makeshift in strange_scenes()],
)
@pytest.mark.parametrize("name", LEARNED)
def test_a_planner_copes_with_a_strange_world(planners, name, scene, makeshift):
    log = simulate(scene, planners(name), noise="awgn-high")
    assert np.isfinite(log.ego).all()
    if not makeshift:
        assert not log.degraded.any()
