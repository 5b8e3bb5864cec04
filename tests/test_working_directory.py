"""What lies in the working directory is not code, unless the user names it."""

import os
import subprocess
import sys

import pytest
from commands import call
from stores import write_toy_store

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
from shiftsim.planners.basic.constant_velocity import ConstantVelocity
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


@pytest.fixture
def folder(tmp_path):
    """A folder with a store, and files that must not be executed."""
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(STRAY)
    write_toy_store(tmp_path / "toy")
    yield tmp_path
    assert not (tmp_path / "stray-was-executed").exists()


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["2", pytest.param("1", marks=pytest.mark.thorough)])
def test_a_run_executes_nothing_that_lies_about(folder, workers):
    words = ["-p", "constant-velocity", "-s", "./toy", "--workers", workers, "--out", "run"]
    done = call(folder, "run", *words)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_console_script_executes_nothing_that_lies_about(folder):
    code = "from shiftsim.cli import main; main(['doctor'])"
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=folder, check=False)
    assert done.returncode == 0


@pytest.mark.slow
def test_workers_of_a_script_elsewhere_execute_nothing_that_lies_about(folder, tmp_path_factory):
    script = tmp_path_factory.mktemp("elsewhere") / "script.py"
    script.write_text(SCRIPT)
    done = subprocess.run([sys.executable, script], cwd=folder, check=False, capture_output=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
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


@pytest.mark.thorough
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


@pytest.mark.slow
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
