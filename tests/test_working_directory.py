"""What lies in the working directory is not code, unless the user names it."""

import os
import subprocess
import sys

import pytest
from commands import call
from stores import write_toy_store

pytestmark = pytest.mark.thorough

STRAY = "open('stray-was-executed', 'a').write(__name__ + ' ')\nraise SystemExit('stray')\n"
# modules of the standard library that workers import, and packages that may be missing
NAMES = (
    "bisect",
    "heapq",
    "random",
    "torch",
    "matplotlib",
    "distributed",
    "IPython",
    "sitecustomize",
)
SCRIPT = """
import shiftsim
if __name__ == "__main__":
    shiftsim.run("constant-velocity", store="./toy", workers=2, out="run")
"""
PLUGINS = """
from shiftsim.metrics.result import MetricRow
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.sim.traffic import LogReplay

import my_helper

class MyPlanner(ConstantVelocity):
    def reset(self, scene):
        import my_late_helper
        super().reset(scene)

class MyTraffic(LogReplay):
    pass

def my_metric(log, road):
    return 1.0

def my_noise(accel, steering, num_steps, dt):
    return accel.normal(size=(num_steps, 2)) * 0.01
"""
ALONE = """
import importlib.util
import my_helper
from shiftsim import Command

class Still:
    def reset(self, scene):
        assert importlib.util.find_spec("my_helper") and my_helper.SPEED
        import json.tool

    def plan(self, observation):
        return Command(0.0, 0.0)
"""


@pytest.fixture
def folder(tmp_path):
    """A folder with a store, and files that must not be executed."""
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(STRAY)
    write_toy_store(tmp_path / "toy")
    yield tmp_path
    assert not (tmp_path / "stray-was-executed").exists()


@pytest.mark.parametrize("workers", ["2", pytest.param("1", marks=pytest.mark.thorough)])
def test_a_run_executes_nothing_that_lies_about(folder, workers):
    words = ["-p", "constant-velocity", "-s", "./toy", "--workers", workers, "--out", "run"]
    done = call(folder, "run", *words)
    assert done.returncode == 0, done.stderr


def test_the_console_script_executes_nothing_that_lies_about(folder):
    code = "from shiftsim.cli import main; main(['doctor'])"
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=folder, check=False)
    assert done.returncode == 0


def test_workers_of_a_script_elsewhere_execute_nothing_that_lies_about(folder, tmp_path_factory):
    script = tmp_path_factory.mktemp("elsewhere") / "script.py"
    script.write_text(SCRIPT)
    done = subprocess.run([sys.executable, script], cwd=folder, check=False, capture_output=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("workers", ["2", pytest.param("1", marks=pytest.mark.thorough)])
def test_what_the_user_names_is_found_with_all_that_it_imports(tmp_path, workers):
    write_toy_store(tmp_path / "toy")
    (tmp_path / "my_plugins.py").write_text(PLUGINS)
    (tmp_path / "my_helper.py").touch()
    (tmp_path / "my_late_helper.py").touch()
    words = ["-p", "my_plugins:MyPlanner", "--traffic", "my_plugins:MyTraffic", "-s", "./toy"]
    words += ["--metric", "my_plugins:my_metric", "--noise", "my_plugins:my_noise"]
    done = call(tmp_path, "run", *words, "--workers", workers, "--out", "run")
    assert done.returncode == 0, done.stderr


def test_each_plugin_alone_is_found(tmp_path):
    write_toy_store(tmp_path / "toy", count=1)
    (tmp_path / "my_plugins.py").write_text(PLUGINS)
    (tmp_path / "my_helper.py").touch()
    for number, (option, name) in enumerate(
        [("--metric", "my_metric"), ("--noise", "my_noise"), ("--traffic", "MyTraffic")]
    ):
        words = ["run", "-p", "constant-velocity", "-s", "./toy", option, f"my_plugins:{name}"]
        done = call(tmp_path, *words, "--workers", "1", "--out", f"run{number}")
        assert done.returncode == 0, done.stderr


def test_a_named_module_does_not_replace_one_that_is_installed(folder):
    (folder / "my_planner.py").write_text(
        PLUGINS.replace("import my_helper", "import bisect, heapq")
    )
    (folder / "my_late_helper.py").touch()
    words = ["-p", "my_planner:MyPlanner", "-s", "./toy", "--workers", "2", "--out", "run"]
    done = call(folder, "run", *words)
    assert done.returncode == 0, done.stderr


def test_the_command_works_where_the_folder_has_gone(tmp_path):
    gone = f"import os; os.rmdir({str(tmp_path)!r})"
    code = f"{gone}; from shiftsim.cli import main; main(['--version'])"
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=False)
    assert done.returncode == 0
    assert not os.path.exists(tmp_path)


PROBE = """
import sys
tried = set()
class Recorder:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if path is None:
            tried.add(name)
sys.meta_path.append(Recorder)
import shiftsim.cli
import shiftsim.files
try:
    shiftsim.cli.main(sys.argv[1:])
finally:
    print("tried:", *sorted(tried - {"my_plugins", "my_helper", "my_late_helper"}))
"""


@pytest.fixture
def own(tmp_path):
    """A folder with a planner of one's own and its helpers, and what a run of it is called with."""
    write_toy_store(tmp_path / "toy", count=2)
    (tmp_path / "my_plugins.py").write_text(PLUGINS)
    (tmp_path / "my_helper.py").touch()
    (tmp_path / "my_late_helper.py").touch()
    words = ["-p", "my_plugins:MyPlanner", "-s", "./toy", "--limit", "2"]
    return tmp_path, words


def test_no_import_that_is_tried_in_vain_finds_a_stray_file(own):
    folder, words = own
    probe = [sys.executable, "-P", "-c", PROBE, "run", *words, "--workers", "1", "--out", "probe"]
    done = subprocess.run(probe, cwd=folder, capture_output=True, text=True, check=False)
    tried = done.stdout.rpartition("tried:")[2].split()
    for name in {*NAMES, *tried, "colorama", "cupy"}:
        (folder / f"{name}.py").write_text(STRAY)
    for number, more in enumerate([["--workers", "2"], ["--workers", "1", "--isolate"]]):
        done = call(folder, "run", *words, *more, "--out", f"run-{number}")
        assert done.returncode == 0, done.stderr
    assert not (folder / "stray-was-executed").exists()


def test_a_planner_in_another_interpreter_finds_its_neighbours_and_no_stray_file(tmp_path):
    write_toy_store(tmp_path / "toy", count=1)
    (tmp_path / "my_planner.py").write_text(ALONE)
    (tmp_path / "my_helper.py").write_text("SPEED = 1.0\n")
    (tmp_path / "numpy.py").write_text(STRAY)
    (tmp_path / "colorama.py").write_text(STRAY)
    words = ["run", "-p", "my_planner:Still", "-s", "./toy", "--planner-python", sys.executable]
    done = call(tmp_path, *words, "--workers", "1", "--out", "run")
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "stray-was-executed").exists()


@pytest.mark.parametrize("more", [["--workers", "2"], ["--isolate"]])
def test_a_planner_in_a_package_of_the_working_directory_is_found(own, more):
    folder, words = own
    (folder / "mine" / "deep").mkdir(parents=True)
    (folder / "mine" / "__init__.py").touch()
    (folder / "mine" / "tools.py").write_text("import my_helper\n")
    text = PLUGINS.replace("import my_helper", "from mine import tools")
    (folder / "mine" / "deep" / "planner.py").write_text(text)
    words[1] = "mine.deep.planner:MyPlanner"
    done = call(folder, "run", *words, *more, "--out", "run")
    assert done.returncode == 0, done.stderr
