"""Learned planners: features, network and the rest of a step, batches, and memory.

Run with `pytest benchmarks/speed/test_nets.py -s`. Weights are deterministic ones, which cost what
the published ones do. Every planner drives the scenes itself, so that what it sees is what it would
see. Targets on one core, batch 1: features 2 ms (PlanTF, PLUTO), 3 ms (Diffusion Planner), 1 ms
(CaRL); PLUTO's choice 6 ms; a batch of 16 no slower per scenario than one alone; 1.5 GB per worker,
however many scenarios it has driven.
"""

import copy
import pickle
import statistics
import subprocess
import sys
import tarfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import pytest
from parity_cases import Scenes

from shiftsim.benchmarks.speed import gpu
from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.benchmarks.speed.conftest import median_seconds
from shiftsim.data.store.reading import open_store
from shiftsim.data.synthetic.store import demo_store
from shiftsim.planners.learned.owner import InferenceClient, InferenceServer, new_address
from shiftsim.planners.registry import load_planner
from shiftsim.processes import in_background
from shiftsim.sim.loop import Rollout
from shiftsim.world.state import center_poses

pytest.importorskip("torch")

REPOSITORY = Path(__file__).resolve().parents[2]
REFERENCE = REPOSITORY.parent / "shared" / "reference" / "nuplan"
FEATURE_TARGETS = {"plantf": 2e-3, "pluto": 2e-3, "diffusion-planner": 3e-3, "carl": 1e-3}  # s
CHOICE_TARGETS = {"pluto": 6e-3}  # s
NETWORK_ROUNDS = 5
MEMORY_TARGET, GROWTH_TARGET = 1500.0, 50.0  # MB
STEPS = 60  # of a scene
WARM = 5  # steps that are not counted
ASKED = 300  # times
DRIVES = 3  # of which the fastest counts
BATCH = 16
GPU_BATCHES = (1, 16, 64, 256)
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
            archive.extractall(folder.parent)
    demo = open_store(store)
    scenes = Scenes(folder)
    found = {name: scenes[name] for name in scenes.entries}
    found["bench_scene_100"] = bench_scene(100, 0)
    return {**found, "demo": demo.read(demo.tokens[0])}


@pytest.fixture(scope="module")
def loaded():
    """Each planner with its network, made once."""
    made = {}

    def get(name, device="cpu", variant="drive"):
        if (name, device, variant) not in made:
            arguments = {"checkpoint": f"deterministic:{variant}", "device": device}
            made[name, device, variant] = load_planner(name, arguments)
        return made[name, device, variant]

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
    drives = [drive(planner, scenario, size(STEPS, WARM + 1)) for _ in range(size(DRIVES))]
    features, network, rest = np.min([np.median(one[WARM:], axis=0) for one in drives], axis=0)
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


@pytest.mark.parametrize("batch", [1, BATCH])
@pytest.mark.parametrize("name", LEARNED)
def test_a_network_alone(scenes, loaded, size, note, name, batch):
    """CPU time of forward passes, scenes alone one after another or all at once."""
    planner = loaded(name)
    forks, observations = started(planner, [scenes[n] for n in NAMES if n in scenes], BATCH)
    features = [fork.features(seen) for fork, seen in zip(forks, observations, strict=True)]
    times = []
    for _ in range(size(NETWORK_ROUNDS, 1) + 1):
        began = process_time()
        for start in range(0, BATCH, batch):
            planner.infer(features[start : start + batch])
        times.append((process_time() - began) / BATCH)
    network = float(np.min(times[1:]))
    print(f"\n{name:17} batch {batch:2}: {network * 1e3:6.2f} ms per scene", end="")
    note(network=network)


@pytest.mark.parametrize("name", LEARNED)
def test_rollouts_on_a_gpu(store, size, capsys, name):
    """What `gpu.py` prints, on a GPU or, on little, the same path on the CPU."""
    import torch

    batches = GPU_BATCHES if torch.cuda.is_available() and size(2) > 1 else (1, 2)
    few = "--scenarios 2 --seeds 1 --iterations 6 --workers 2".split() if len(batches) == 2 else []
    gpu.main([str(store), "--planners", name, "--batches", *map(str, batches), *few])
    printed = capsys.readouterr().out
    print(f"\n{printed}", end="")
    rows = [line for line in printed.splitlines() if "rollouts/s" in line]
    assert len(rows) > len(batches)
    assert all(line.startswith(name) for line in rows)
    assert "workers" in rows[-1]
    if not torch.cuda.is_available():
        assert all(" 0.0 % of scores differ" in line for line in rows)


@pytest.mark.parametrize("batch", [1, BATCH])
@pytest.mark.parametrize("name", LEARNED)
def test_asking_another_process(scenes, loaded, size, note, name, batch):
    """What it costs that the network is in another process: pickling, the socket, the answer."""
    planner, address = loaded(name), new_address()
    forks, observations = started(planner, [scenes[n] for n in NAMES if n in scenes], batch)
    features = [fork.features(seen) for fork, seen in zip(forks, observations, strict=True)]
    outputs = list(planner.infer(features))
    with in_background(partial(InferenceServer, {name: partial(gpu.Repeating, outputs)}, address)):
        ask = InferenceClient(address, name)
        seconds = median_seconds(lambda: ask(features), size(ASKED, 2))
        answered = ask(features)
    assert pickle.dumps(answered) == pickle.dumps(outputs)
    bytes_sent = len(pickle.dumps(features, 5))
    print(
        f"\n{name:17} batch {batch:2}: {bytes_sent / 1e3:6.0f} kB, {seconds * 1e6:6.0f} µs", end=""
    )
    note(asking=seconds)


MEMORY = """
import re, sys
from shiftsim.data.store.reading import open_store
from shiftsim.planners.learned.owner import InferenceClient, InferenceServer, new_address
from shiftsim.planners.registry import load_planner
from shiftsim.processes import in_background
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
