"""Ctrl-C ends every long command in one line that says how to go on."""

import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

import shiftsim.runs.execute  # noqa: F401  what is imported while a test replaces it would stay
from shiftsim.cli import main

CASES = [
    ("filter {store}", "shiftsim.runs.filter.filter_store", "kept; go on with: shiftsim filter"),
    (
        "convert dsc3d x --store y",
        "shiftsim.data.readers.deepplan.convert.convert_dsc3d",
        "kept; go on with: shiftsim convert dsc3d x --store y",
    ),
    (
        "convert av2 x --store y",
        "shiftsim.data.readers.open_data.scenes.convert_scenes",
        "kept; go on with: shiftsim convert av2 x --store y",
    ),
    (
        "convert nuplan x y --store z",
        "shiftsim.data.nuplan.convert.convert_nuplan",
        "start again with: shiftsim convert nuplan x y --store z",
    ),
    ("stats {store}", "shiftsim.data.store.statistics.store_stats", "start again with: shiftsim"),
    ("demo --out x", "shiftsim.data.synthetic.store.demo_store", "start again with: shiftsim demo"),
    (
        "run -p idm --store {store}",
        "shiftsim.runs.prepare.prepare",
        "start again with: shiftsim run",
    ),
    (
        "run -p idm --store {store} --out x",
        "shiftsim.runs.execute.execute",
        "kept: x; go on with: shiftsim run -p idm --store {store} --out x --resume",
    ),
]


def leave(words, capsys, monkeypatch):
    """Exit code and errors of a command."""
    monkeypatch.setattr("sys.argv", ["shiftsim", *words])
    with pytest.raises(SystemExit) as left:
        main()
    return left.value.code, capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(("words", "work", "hint"), CASES, ids=[case[0] for case in CASES])
def test_an_interrupt_ends_in_one_line(words, work, hint, toy, tmp_path, capsys, monkeypatch):
    def stop(*given, **settings):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(work, stop)

    code, lines = leave(words.format(store=toy).split(), capsys, monkeypatch)

    assert code == 130
    assert lines[-2] == "error: interrupted"
    assert hint.format(store=toy) in lines[-1]


@pytest.mark.parametrize("swallowed", ["lost", "changed"])
def test_an_interrupt_that_a_library_catches_ends_the_command_too(
    swallowed, toy, capsys, monkeypatch
):
    def work(*given, on_progress, **settings):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(30.0)
        except KeyboardInterrupt:
            if swallowed == "changed":
                raise SystemError("a library of C code") from None
        on_progress(1, 2)
        raise AssertionError("it went on")

    monkeypatch.setattr("shiftsim.runs.filter.filter_store", work)

    code, lines = leave(["filter", str(toy)], capsys, monkeypatch)

    assert (code, lines[-2]) == (130, "error: interrupted")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_training_goes_on_with_resume(toy, tmp_path, capsys, monkeypatch):
    pytest.importorskip("torch")

    def stop(training):
        raise KeyboardInterrupt

    monkeypatch.setattr("shiftsim.train.recipe.Training.run", stop)
    words = ["train", "carl", "--out", str(tmp_path / "out"), "--store", str(toy)]

    code, lines = leave(words, capsys, monkeypatch)

    assert code == 130
    assert lines[-1].endswith(f"--store {toy} --resume")


EARLY = """
import os, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it


class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)


sys.meta_path.insert(0, Interrupts())
sys.argv = ["shiftsim", "planners", "list"]
from shiftsim.__main__ import main

main()
"""


@pytest.mark.parametrize("module", ["shiftsim.cli", "typer", "shiftsim.cli.planners"])
def test_an_interrupt_while_it_imports_ends_in_one_line(module):
    done = subprocess.run(
        [sys.executable, "-c", EARLY.format(module=module)], capture_output=True, text=True
    )

    assert done.returncode in (130, -signal.SIGINT)
    assert done.stderr.splitlines()[0] == "error: interrupted"
    assert "Traceback" not in done.stderr


def test_the_installed_command_is_the_module_that_hears_interrupts_first():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())

    assert project["project"]["scripts"] == {"shiftsim": "shiftsim.__main__:main"}
