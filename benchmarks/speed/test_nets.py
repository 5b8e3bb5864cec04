"""Learned planners: features, network and the rest of a step, batches, and memory.

Run with `pytest benchmarks/speed/test_nets.py -s`. Weights are deterministic ones, which cost what
the published ones do. Every planner drives the scenes itself, so that what it sees is what it would
see. Targets on one core, batch 1: features 2 ms (PlanTF, PLUTO), 3 ms (Diffusion Planner), 1 ms
(CaRL); PLUTO's choice 6 ms; Diffusion Planner's network 0.6 of the plain sampler; a batch of 16 no
slower per scenario than one alone; 1.5 GB per worker, however many scenarios it has driven.
"""

import copy
import statistics
import subprocess
import sys
import tarfile
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import pytest

from shiftsim.data.demo.store import bench_scene, demo_store
from shiftsim.data.store.reading import open_store
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import Rollout
from shiftsim.verify.scenes import Scenes
from shiftsim.world.state import center_poses

pytest.importorskip("torch")

REPOSITORY = Path(__file__).resolve().parents[2]
REFERENCE = REPOSITORY.parent / "shared" / "reference" / "nuplan"
FEATURE_TARGETS = {"plantf": 2e-3, "pluto": 2e-3, "diffusion-planner": 3e-3, "carl": 1e-3}  # s
CHOICE_TARGETS = {"pluto": 6e-3}  # s
REUSE_TARGET = 0.6
MEMORY_TARGET, GROWTH_TARGET = 1500.0, 50.0  # MB
STEPS = 60  # of a scene
WARM = 5  # steps that are not counted
BATCH = 16
GPU_BATCHES = (1, 4, 16, 64, 256)
SCENARIOS = 500

LEARNED = tuple(FEATURE_TARGETS)
NAMES = (
    "bench_scene_100",
    "demo",
    "s01_lead_brakes",
    "s02_curve_objects",
    "s03_queue_start",
    "s04_left_turn",
    "s07_parked_in_lane",
    "s09_carpark_exit",
    "s10_lane_change",
    "s13_empty_road",
)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """The demo store."""
    return demo_store(tmp_path_factory.mktemp("store") / "demo")


@pytest.fixture(scope="module")
def scenes(store, tmp_path_factory):
    """The reference scenes, the city scene with 100 agents, and one of the demo."""
    folder = REFERENCE
    if not folder.is_dir():
        folder = tmp_path_factory.mktemp("reference") / "nuplan"
        with tarfile.open(REPOSITORY / "tests/golden/nuplan.tar.xz") as archive:
            archive.extractall(folder.parent, filter="data")
    demo = open_store(store)
    found = {**Scenes(folder), "bench_scene_100": bench_scene(100, 0)}
    return {**found, "demo": demo.read(demo.tokens[0])}


@pytest.fixture(scope="module")
def loaded():
    """Each planner with its network, made once."""
    made = {}

    def get(name, device="cpu"):
        if (name, device) not in made:
            arguments = {"checkpoint": "deterministic:drive", "device": device}
            made[name, device] = load_planner(name, arguments)
        return made[name, device]

    return get


def drive(planner, scenario, steps):
    """CPU seconds (steps, 3) of features, network and the rest, along a rollout."""
    rollout = Rollout(scenario, planner.fork())
    seconds = []
    while not rollout.done and len(seconds) < steps:
        observation, pilot = rollout.observe(), rollout.planner
        times = [process_time()]
        features = pilot.features(observation)
        times.append(process_time())
        (output,) = pilot.infer([features])
        times.append(process_time())
        plan = pilot.decode(output, observation)
        times.append(process_time())
        seconds.append(np.diff(times))
        rollout.advance(plan)
    return np.array(seconds)


def verdict(value, target):
    """Whether a target is met, in words."""
    return "" if target is None else f" (target {target:g}: {'met' if value <= target else 'NOT'})"


def lanes_near(scenario, radius=100.0):
    """Lanes and connectors whose bounds meet the square around the ego's centre at its start."""
    center = center_poses(scenario.ego[scenario.iteration_rows[0]][:3])[:2]
    bounds = scenario.map.edges.polygons.bounds
    apart = (bounds[:, :2] > center + radius) | (bounds[:, 2:] < center - radius)
    return int(np.count_nonzero(~apart.any(axis=1)))


@pytest.mark.parametrize("scene", NAMES)
@pytest.mark.parametrize("name", LEARNED)
def test_stages_of_a_step(scenes, loaded, size, calibration_seconds, note, name, scene):
    """Medians along a rollout, caches of map and scenario warm."""
    planner, scenario = loaded(name), scenes[scene]
    drive(planner, scenario, 2)  # kernels
    features, network, rest = np.median(
        drive(planner, scenario, size(STEPS, WARM + 1))[WARM:], axis=0
    )
    ratio = features / calibration_seconds
    print(
        f"\n{name} {scene}, {lanes_near(scenario)} lanes: "
        f"features {features * 1e3:.2f} ms, {ratio:.0f} of the calibration"
        f"{verdict(features, FEATURE_TARGETS[name])}, network {network * 1e3:.1f} ms, "
        f"rest {rest * 1e3:.2f} ms{verdict(rest, CHOICE_TARGETS.get(name))}",
        end="",
    )
    note(features=features, rest=rest)
    assert np.isfinite([features, network, rest]).all()


@pytest.mark.parametrize("name", LEARNED)
def test_first_step_on_a_map(scenes, loaded, name):
    """What is made once per map and scenario: kernels warm, map never seen."""
    planner, scenario = loaded(name), scenes["bench_scene_100"]
    drive(planner, scenario, 2)
    unseen = replace(scenario, map=copy.copy(scenario.map))
    began = perf_counter()
    rollout = Rollout(unseen, planner.fork())
    made = perf_counter()
    rollout.planner.features(rollout.observe())
    first = perf_counter()
    print(
        f"\n{name}: on a new map of {len(scenario.map.edges)} lanes, start {made - began:.3f} s, "
        f"first features {first - made:.3f} s",
        end="",
    )


def started(planner, scenarios, count):
    """Rollouts with forks, some steps on their way, and what each of them sees."""
    rollouts = []
    for index in range(count):
        rollout = Rollout(scenarios[index % len(scenarios)], planner.fork())
        for _ in range(2 + index // len(scenarios)):
            rollout.advance(rollout.planner.plan(rollout.observe()))
        rollouts.append(rollout)
    return [r.planner for r in rollouts], [r.observe() for r in rollouts]


@pytest.mark.parametrize("name", LEARNED)
def test_batch_against_one_alone(scenes, loaded, size, name):
    """CPU time per scenario of a batch of 16 over that of one alone, in turns."""
    planner = loaded(name)
    forks, observations = started(planner, [scenes[n] for n in NAMES if n in scenes], BATCH)
    ratios, together_ms = [], []
    for _ in range(size(5, 2)):
        began = process_time()
        for fork, observation in zip(forks, observations, strict=True):
            fork.plan(observation)
        alone = process_time()
        plans = planner.plan_batch(forks, observations)
        done = process_time()
        assert not any(isinstance(plan, Exception) for plan in plans)
        ratios.append((done - alone) / (alone - began))
        together_ms.append((done - alone) / BATCH * 1e3)
    ratio = statistics.median(ratios[1:])
    print(
        f"\n{name}: batch {BATCH}: {statistics.median(together_ms[1:]):.1f} ms per scenario, "
        f"{ratio:.2f} of one alone{verdict(ratio, 1.0)}",
        end="",
    )


def test_diffusion_planner_against_the_plain_sampler(scenes, loaded, size):
    """CPU time of the network over that of the official way of calling it."""
    import torch
    from plain_diffusion import plain_network, plain_sample

    planner = loaded("diffusion-planner")
    plain = plain_network(planner.network)
    for scene in ("bench_scene_100", "s04_left_turn", "s13_empty_road"):
        forks, observations = started(planner, [scenes[scene]], 1)
        features = [forks[0].features(observations[0])]
        inputs, noise = planner.batch(features)
        ratios = []
        with torch.inference_mode():
            for _ in range(size(40, 3)):  # times vary more than what they differ by
                began = process_time()
                plain_sample(plain, inputs, noise)
                middle = process_time()
                planner.network(inputs, noise)
                ratios.append((process_time() - middle) / (middle - began))
        ratio = statistics.median(ratios[2:])
        print(
            f"\ndiffusion-planner {scene}: network {ratio:.2f} of the plain sampler"
            f"{verdict(ratio, REUSE_TARGET)}",
            end="",
        )


@pytest.mark.parametrize("name", LEARNED)
def test_batches_on_a_gpu(scenes, loaded, name):
    """Scenarios per second, as steps of 149 iterations, by size of the batch."""
    import torch

    if not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    planner = loaded(name, "cuda")
    all_scenes = [scenes[n] for n in NAMES if n in scenes]
    forks, observations = started(planner, all_scenes, max(GPU_BATCHES))
    for size in GPU_BATCHES:
        planner.plan_batch(forks[:size], observations[:size])
        began = perf_counter()
        for _ in range(5):
            planner.plan_batch(forks[:size], observations[:size])
        per_step = (perf_counter() - began) / 5
        print(f"\n{name}: batch {size}: {size / per_step / 149:.2f} scenarios/s", end="")


MEMORY = """
import re, sys
from shiftsim.data.store.reading import open_store
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import Rollout
store = open_store(sys.argv[1])
planner = load_planner(sys.argv[2], {"checkpoint": "deterministic:drive"})
def memory(word):  # ru_maxrss would be inherited
    return int(re.search(word + r":\\s*(\\d+)", open("/proc/self/status").read())[1]) / 1024
for number in range(int(sys.argv[3])):
    rollout = Rollout(store.read(store.tokens[number % len(store.tokens)]), planner)
    for _ in range(2):
        rollout.advance(planner.plan(rollout.observe()))
    if number == int(sys.argv[3]) // 5 - 1:
        early = memory("VmRSS")
print(memory("VmHWM"), memory("VmRSS") - early)
"""


@pytest.mark.parametrize("name", LEARNED)
def test_memory_of_a_worker_over_many_scenarios(store, size, name):
    """Peak, and what is more at the end than after a fifth of the scenarios."""
    count = size(SCENARIOS, 5)
    command = [sys.executable, "-c", MEMORY, str(store), name, str(count)]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    peak, growth = map(float, out.split())
    print(
        f"\n{name}: peak {peak:.0f} MB{verdict(peak, MEMORY_TARGET)}, from scenario "
        f"{count // 5} to {count} {growth:+.0f} MB{verdict(growth, GROWTH_TARGET)}",
        end="",
    )
