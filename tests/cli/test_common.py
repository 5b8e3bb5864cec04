"""Options of the command line are the settings of a run."""

import os
import subprocess
import sys
from dataclasses import fields

import pytest
import typer
from typer.testing import CliRunner

from shiftsim.cli import app, with_settings
from shiftsim.cli.convert import _failures
from shiftsim.errors import listed
from shiftsim.runs.config import RunConfig, make_config


def options_of(command):
    group = typer.main.get_command(app)
    return {parameter.name: parameter for parameter in group.get_command(None, command).params}


def test_every_setting_is_an_option_with_its_help():
    options = options_of("run")
    for item in fields(RunConfig):
        option = item.metadata["option"]
        assert options[item.name].help == option.help
        if option.flags:
            assert options[item.name].opts == list(option.flags)


def test_the_options_are_those_of_before():
    flags = [max(option.opts, key=len) for option in options_of("run").values()]
    words = """--planner --noise --perception --localization --latency --seeds --store --split
        --limit --all --edits --traffic
        --controller --thresholds --planner-arg --metric --checkpoint --device --batch-size
        --isolate --planner-python --strict --open-loop --out --workers --timeout
        --resume --retry-failed --shard --executor --scheduler --save-rollouts
        --bundle --allow-partial --config --dry-run --live --quiet --json"""
    assert flags == words.split()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], {}),
        (["--seeds", "3,4"], {"seeds": [3, 4]}),
        (["-n", "none", "-n", "ou-high"], {"noise": ["none", "ou-high"]}),
        (["--workers", "auto"], {"workers": 0}),
        (["--workers", "3", "--all"], {"workers": 3, "all_scenarios": True}),
        (["--timeout", "2.5", "--limit", "0"], {"timeout": 2.5, "limit": 0}),
        (["--out", ""], {"out": ""}),
    ],
)
def test_a_command_gets_the_settings_that_were_given(words, expected):
    found = []

    @with_settings("seeds", "noise", "workers", "all_scenarios", "timeout", "limit", "out")
    def command(settings, *, quiet: bool = False):
        found.append(settings)

    alone = typer.Typer()
    alone.command()(command)
    done = CliRunner().invoke(alone, words)
    assert done.exit_code == 0, done.output
    assert found == [expected]
    make_config({"planners": ["idm"], **found[0]})


@pytest.mark.parametrize(("given", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_a_command_computes_in_one_thread_unless_told_otherwise(given, threads):
    code = (
        "import os, sys\n"
        "from shiftsim.__main__ import main\n"
        "try:\n    main()\nfinally:\n"
        "    import numpy\n"
        "    print(os.environ['OPENBLAS_NUM_THREADS'], len(os.listdir('/proc/self/task')))"
    )
    others = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    command = [sys.executable, "-c", code, "--version"]
    done = subprocess.run(command, env=others | given, capture_output=True, text=True, check=True)
    told, running = done.stdout.splitlines()[-1].split()
    assert told == threads
    assert int(running) <= int(threads)


def test_names_and_failures_beyond_the_first_are_counted():
    assert listed([]) == ""
    assert listed(["a", "b"]) == "a, b"
    assert listed(list("abcdefghij")) == "a, b, c, d, e, f, g, h and 2 more"
    lines = [*_failures({f"log{number:02d}": "torn" for number in range(23)})]
    assert lines[-2:] == [" failed: log19: torn", " failed: 3 more, which --json lists"]
