"""Rules for kernels that cannot be seen when they run."""

import ast
import gc
import importlib
import inspect
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path

import dsc3d_writer
import numpy as np
import pytest
from kernels import compile_environment, scene
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import _nrt_python, rtsys
from track_files import export_town, write_tracks
from worlds import cruise_scenario

from shiftsim.data.readers.dsc3d import convert_dsc3d
from shiftsim.data.readers.tracks.reader import TracksReader, convert_tracks
from shiftsim.data.recording import visible_columns
from shiftsim.data.store.check import survey_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.edits import edited
from shiftsim.files import PACKAGE
from shiftsim.kernels import _is_trusted
from shiftsim.metrics import compute_metrics
from shiftsim.planners.registry import load_planner
from shiftsim.planners.table import PLANNERS
from shiftsim.runs.rollouts.branches import branch
from shiftsim.sim.loop import Rollout, simulate
from shiftsim.sim.planner import Planner, scene_info
from shiftsim.sim.traffic import _MODELS
from shiftsim.train.traffic.realism import compare
from shiftsim.train.traffic.states import compute_labels
from shiftsim.world.layers import nearest
from shiftsim.world.scenario import Scenario

PARTS = ("", "planners", "metrics", "data", "benchmarks")  # linked into the package
DECORATED = re.compile(r"^@kernel$", re.MULTILINE)
RAISES = re.compile(r"^\s*(raise|assert)\b", re.MULTILINE)


@pytest.fixture(scope="module")
def kernels() -> dict[str, Dispatcher]:
    """All kernels by module and name."""
    out = {}
    for path in {path for part in PARTS for path in (PACKAGE / part).rglob("*.py")}:
        if path.parent.name == "env" and not find_spec("gymnasium"):
            continue
        if DECORATED.search(path.read_text("utf-8")):
            name = ".".join(("shiftsim", *path.relative_to(PACKAGE).with_suffix("").parts))
            for value in vars(importlib.import_module(name)).values():
                if isinstance(value, Dispatcher):
                    out[f"{value.py_func.__module__}.{value.py_func.__name__}"] = value
    return out


def called_by(kernel: Dispatcher) -> Iterator[Dispatcher]:
    code, names = kernel.py_func.__code__, kernel.py_func.__globals__
    assert not any(inspect.iscode(constant) for constant in code.co_consts), kernel  # a closure
    for name in code.co_names:
        value = names.get(name)
        assert value is np or not inspect.ismodule(value), kernel  # its kernels would go unseen
        if isinstance(value, Dispatcher):
            yield value


def test_no_kernel_raises(kernels: dict[str, Dispatcher]) -> None:
    # its arrays would never be given back
    assert not [
        name for name, kernel in kernels.items() if RAISES.search(inspect.getsource(kernel.py_func))
    ]


def works(folder: Path) -> dict[str, Callable[[], object]]:
    """A rollout of each planner in each mode of traffic, and what else has kernels."""
    scenario, times = scene(), dsc3d_writer.frame_times(18.08)
    cars = [dsc3d_writer.car(1, times), dsc3d_writer.car(2, times, x0=60.0)]
    site = dsc3d_writer.write_site(folder / "site", cars, 18.08)

    @cache
    def load(name: str) -> Planner:
        is_learned = PLANNERS[name].kind == "learned"
        return load_planner(name, {"checkpoint": "deterministic:drive"} if is_learned else {})

    def drive(name: str, mode: str) -> None:
        simulate(scenario, load(name), traffic=mode)

    def convert() -> None:
        shutil.rmtree(folder / "store", ignore_errors=True)
        assert convert_dsc3d(site, folder / "store").accepted
        assert len(list(ScenarioStore(folder / "store"))) == 2

    town = export_town(folder, "roundabout")
    table = write_tracks(folder / "tracks.csv", town[0])

    def convert_table() -> None:
        shutil.rmtree(folder / "own", ignore_errors=True)
        convert_tracks(TracksReader(table, town[1], city="roundabout"), folder / "own")
        survey_store(folder / "own")

    def drive_edited() -> None:
        # agents that look where the ego will be: one of them is beside it, another one far ahead
        places = [{"pose": [x, y, 0.0]} for x, y in ((230.0, 3.5), (190.0, 3.5), (260.0, 0.0))]
        van = {"at": {"ahead_m": 60.0, "left_m": 3.5}, "behavior": "stopped"}
        crowded = edited(scenario, agents="mixed", spawn=[*places, van])
        simulate(crowded, load("idm"), traffic="reactive")

    # a scripted planner needs a file, and has no kernels
    names = [name for name in PLANNERS if name != "scripted"]
    drives = {f"{name}, {mode}": partial(drive, name, mode) for name in names for mode in _MODELS}
    return {
        **drives,
        "branches": lambda: branch(
            Rollout(scenario, load("constant-velocity")).snapshot(), np.zeros((2, 8, 3)), 5
        ),
        "environment": compile_environment,
        "sensing": lambda: simulate(
            scenario, load("constant-velocity"), noise="perception-low+miss-low"
        ),
        "way back": lambda: come_back(scenario),
        "edited": drive_edited,
        "conversion": convert,
        "tracks and check": convert_table,
        "realism": lambda: measure_realism(scenario),
        "metrics": lambda: compute_metrics(
            simulate(scenario, load("constant-velocity")), scenario.map
        ),
        "order of tracks": lambda: visible_columns(
            np.eye(3, dtype=bool)[::-1] | [False, True, True],
            np.zeros(3, int),
            ["a", "b", "c"],
            without="",
        ),
        "lines": lambda: look_along(scenario),
        "nearest": lambda: nearest(scenario.map.edges.polygons, 0.0, 0.0, np.inf),
    }


def come_back(scenario: Scenario) -> None:
    """The way back of an ego that was moved, and a sample for training."""
    from shiftsim.planners.learned.plantf.planner import PlanTF  # these need torch
    from shiftsim.train.samples import make_sample, way_back

    way_back(3.0, scenario.ego[:81, :3] - scenario.ego[0, :3])
    recorded, planner = cruise_scenario(speed=4.0, iterations=121), PlanTF.asking(list)
    planner.reset(scene_info(recorded))
    assert make_sample(planner, recorded, 5, np.random.default_rng(0)).valid.all()


def measure_realism(scenario: Scenario) -> None:
    """Labels of agents, and how real they are."""
    compare([cruise_scenario(speed=4.0, iterations=60, tracks=scenario.tracks)], {})
    poses = np.zeros((scenario.tracks.num_tracks, 3))
    away = np.zeros((len(poses), 2))
    compute_labels(scenario.tracks, 30, poses, np.zeros(len(poses)), away)


def look_along(scenario: Scenario) -> None:
    """Poses as seen from the line of a route."""
    scene_info(scenario).route_line(scenario.ego[0, :3]).to_frenet(scenario.ego[:, :3])


def num_kept() -> int:
    stats = rtsys.get_allocation_stats()
    return stats.alloc - stats.free


def num_lost(work: Callable[[], object]) -> int:
    """Allocations of kernels that work leaves behind, where it was done before."""
    work()  # what is kept for all later ones
    before = num_kept()
    work()
    if num_kept() == before:  # nothing was collected meanwhile: the collector is off
        return 0
    gc.collect()
    before = num_kept()
    work()
    gc.collect()
    return num_kept() - before


@pytest.mark.thorough
@pytest.mark.learned
def test_no_kernel_loses_an_array(kernels: dict[str, Dispatcher], tmp_path: Path) -> None:
    _nrt_python.memsys_enable_stats()
    gc.disable()
    try:
        lost = {name: num_lost(work) for name, work in works(tmp_path).items()}
    finally:
        gc.enable()
    assert rtsys.get_allocation_stats().alloc > 10_000
    assert not {name: count for name, count in lost.items() if count}
    called = {kernel for kernel in kernels.values() if kernel.signatures}
    for _ in range(9):
        called |= {callee for kernel in called for callee in called_by(kernel)}
    assert not [
        name
        for name, kernel in kernels.items()
        if kernel not in called and ".benchmarks." not in name
    ]


CHILD_AND_PARENT = """
import numpy as np
from shiftsim.kernels import kernel

@kernel
def child(n):
    return np.arange(n)

@kernel
def parent(n):
    return child(n).sum()
"""


@pytest.mark.thorough
def test_a_kernel_cached_as_a_part_of_another_can_be_called_itself(tmp_path: Path) -> None:
    (tmp_path / "family.py").write_text(CHILD_AND_PARENT)
    search = os.pathsep.join([str(tmp_path), str(PACKAGE.parent)])
    environment = os.environ | {"PYTHONPATH": search, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for calls in ("child(4)", "parent(4); child(4)", "child(4); parent(4)"):
        code = f"from family import *; {calls}; assert parent(4) == 6"
        subprocess.run([sys.executable, "-c", code], env=environment, check=True)


def _poison(folder: Path) -> None:
    """An index of numba's that runs a command when it is read, wherever one may lie."""
    done = subprocess.run(
        [sys.executable, "-c", "from family import *; child(4)"],
        env=os.environ | {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": _search(folder)},
        check=True,
    )
    assert done.returncode == 0
    for index in folder.rglob("*.nbi"):
        index.write_bytes(b"cos\nsystem\n(S'touch %s'\ntR." % str(folder.parent / "ran").encode())


def _search(folder: Path) -> str:
    return os.pathsep.join([str(folder.parent), str(PACKAGE.parent)])


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="no owners and modes of files")
@pytest.mark.parametrize("change", ["folder", "part", "file", "group", "owner", "parent"])
def test_machine_code_that_others_may_have_written_is_not_read(tmp_path: Path, change: str) -> None:
    (tmp_path / "family.py").write_text(CHILD_AND_PARENT)
    folder = tmp_path / "cache"
    _poison(folder)
    index = next(folder.rglob("*.nbi"))
    assert folder.stat().st_mode & 0o777 == 0o700
    if change == "owner":
        if os.getuid():
            pytest.skip("only root can give a file away")
        os.chown(index, 4321, -1)
    elif change == "group":
        folder.chmod(0o755)
        index.chmod(0o664)
    else:
        changed = {"folder": folder, "part": index.parent, "file": index, "parent": tmp_path}
        changed[change].chmod(0o777)
    code = "from family import *; assert child(4)[3] == 3"
    own = {"NUMBA_CACHE_DIR": str(folder), "SHIFTSIM_CACHE": str(tmp_path / "own")}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | own | {"PYTHONPATH": _search(folder)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "ran").exists()
    assert done.stderr.count("may be written by other users") == 1
    assert str(folder) in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="no owners and modes of files")
@pytest.mark.parametrize(
    ("mode", "is_trusted"), [(0o700, True), (0o775, True), (0o1777, True), (0o777, False)]
)
def test_a_cache_is_where_others_cannot_exchange_its_folder(
    tmp_path: Path, mode: int, is_trusted: bool
) -> None:
    # the private folder between does not help: it can be exchanged itself
    folder = tmp_path / "parent" / "between" / "cache"
    for path in (tmp_path / "parent", folder.parent, folder):
        path.mkdir(mode=0o700)
    (tmp_path / "parent").chmod(mode)
    assert _is_trusted(folder) == is_trusted


@pytest.mark.thorough
def test_a_process_that_is_started_does_not_say_it_again(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir(mode=0o700)
    (tmp_path / "cache").chmod(0o777)
    code = "import shiftsim.kernels as k, subprocess as s, sys; print(k.CACHE_FOLDER, flush=True);"
    code += "s.run([sys.executable, '-c', 'import shiftsim.kernels as k; print(k.CACHE_FOLDER)'])"
    own = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | own, capture_output=True, text=True
    )
    first, second = done.stdout.split()
    assert first == second != str(tmp_path / "cache")
    assert done.stderr.count("may be written by other users") == 1


@pytest.mark.skipif(sys.platform == "win32" or os.getuid() != 0, reason="needs another user")
def test_a_user_without_a_home_has_a_cache_all_the_same() -> None:
    code = "import os; from shiftsim.files import checkpoint_folder, store_path, user_cache; "
    code += "os.environ.pop('HOME', None); os.setuid(54321); "
    code += "print(user_cache('kernels'), checkpoint_folder(), store_path('~/x'))"
    names = ("SHIFTSIM_CACHE", "SHIFTSIM_CHECKPOINTS")
    env = {k: v for k, v in os.environ.items() if k not in names}
    env |= {"PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    cache, checkpoints, store = done.stdout.split()
    assert cache.endswith("/shiftsim-54321/kernels")
    assert checkpoints.endswith("/shiftsim-54321/checkpoints")
    assert store == "~/x"


@pytest.mark.thorough  # compiles the kernels of three planners and two kinds of traffic
def test_runs_of_several_planners_in_turn_share_a_cache(toy: Path, tmp_path: Path) -> None:
    environment = os.environ | {
        "PYTHONPATH": str(PACKAGE.parent),
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
    }
    for number, (planner, traffic) in enumerate(
        [
            ("constant-velocity", "nonreactive"),
            ("idm", "reactive"),
            ("constant-velocity", "reactive"),
            ("pdm-closed", "nonreactive"),
            ("idm", "nonreactive"),
            ("constant-velocity", "nonreactive"),
        ]
    ):
        words = ["run", "-p", planner, "--traffic", traffic, "--store", str(toy), "--limit", "1"]
        words += ["--workers", "1", "--out", str(tmp_path / f"run-{number}")]
        command = [sys.executable, "-m", "shiftsim", *words]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        is_said = "compiling kernels, once per version" in done.stderr
        assert is_said or number not in (0, 1)
        assert not (is_said and number == 5)  # as the first one, whose kernels are there


def test_nothing_private_of_another_package_is_used() -> None:
    paths = [path for part in PARTS for path in (PACKAGE / part).rglob("*.py")]
    assert len(paths) > 200
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [alias.name for alias in getattr(node, "names", []) if hasattr(alias, "name")]
            module = getattr(node, "module", None) or ""
            for name in [module, *(f"{module}.{name}".lstrip(".") for name in names)]:
                is_ours = name.startswith(("shiftsim", "__future__")) or not name
                assert not name.startswith(("numba.core", "llvmlite", "numba.extending")), path
                assert is_ours or not re.search(r"(^|\.)_[a-z]", name), f"{path}: {name}"
