"""What the shell offers for a value, asked as the shell asks; what is made of a value."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import pytest
import typer
from stores import write_toy_store

from shiftsim.cli.values import NOISES, with_plain_values
from shiftsim.sim.noise import NOISE_NAMES

WATCHED = """
import sys
from shiftsim.cli import main
try:
    main()
finally:
    heavy = {"numba", "numpy", "pyarrow", "torch"} & set(sys.modules)
    print("HEAVY", *heavy)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("shell")
    write_toy_store(out / "data" / "mine", count=2)
    (out / "data" / "mine" / "splits").mkdir(exist_ok=True)
    (out / "data" / "mine" / "splits" / "rare.toml").write_text("")
    (out / "weights.pth").write_text("")
    return out


def offered(folder, line):
    """What a shell is told for a line, whose last word is being typed."""
    words = line.split(" ")
    asked = {
        "_SHIFTSIM_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
        "SHIFTSIM_DATA": str(folder / "data"),
        "SHIFTSIM_CHECKPOINTS": str(folder / "none"),
    }
    done = subprocess.run(
        [sys.executable, "-c", WATCHED],
        cwd=folder,
        env=os.environ | asked,
        capture_output=True,
        text=True,
        check=False,
    )
    *found, heavy = done.stdout.split("\n")[:-1]
    assert heavy == "HEAVY", heavy
    return found


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("shiftsim run --planner pl", ["plantf", "pluto"]),
        ("shiftsim run -n ou-", ["ou-high", "ou-low", "ou-mid"]),
        ("shiftsim run --store ", ["mine"]),
        ("shiftsim run --store mine --split ", ["mine", "rare"]),
        ("shiftsim run --checkpoint ", ["official", "shiftsim", "weights.pth"]),
        ("shiftsim run --device cu", ["cuda"]),
        ("shiftsim run --controller ", ["log-playback", "lqr", "perfect"]),
        ("shiftsim bench sem", ["semantic-shift"]),
        ("shiftsim bench state-drift -p id", ["idm"]),
        ("shiftsim planners check simp", ["simple"]),
        ("shiftsim filter ", ["mine"]),
        ("shiftsim stats m", ["mine"]),
        ("shiftsim ver", ["verify"]),
    ],
)
def test_values_are_offered_without_heavy_imports(folder, line, expected):
    assert offered(folder, line) == expected


def test_every_noise_is_offered():
    assert (*NOISE_NAMES, "all") == NOISES


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "-p", "idm", "--limit", "2", "--timeout", "1e1", "--store", "no"], "'no'"),
        (["report", "no-run"], "no-run"),
        (["planners", "check", "idm", "--store", "no"], "'no'"),
    ],
)
def test_plain_values_need_no_library(words, said, tmp_path):
    code = (
        "import sys\n"
        "from shiftsim.cli import main\n"
        "try:\n    main()\nfinally:\n    print('pydantic' in sys.modules)"
    )
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert said in done.stderr
    assert done.stdout.endswith("False\n")


@pytest.mark.parametrize(
    ("words", "made"),
    [
        ([], (None, None, [], 0.5, None, False)),
        (["--count", " 7", "-f", "1e3"], (7, None, [], 1000.0, None, False)),
        (["--count", "7.0"], (7, None, [], 0.5, None, False)),  # only typer takes this for whole
        (["-w", "a", "-w", "", "x", "--least", "3"], (None, "x", ["a", ""], 0.5, 3, False)),
        (["--flag"], (None, None, [], 0.5, None, True)),
        (["--count", "seven"], "count"),
        (["-f", "fast"], "--factor"),
        (["--least", "0"], "--least"),
        (["no/rights"], "no/rights"),
    ],
)
def test_values_are_those_that_typer_makes(words, made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) != "no/rights")
    (tmp_path / "no").mkdir()
    (tmp_path / "no" / "rights").touch()
    seen = []

    def command(
        path: Annotated[Path | None, typer.Argument()] = None,
        count: int | None = None,
        words: Annotated[list[str] | None, typer.Option("-w")] = None,
        factor: Annotated[float, typer.Option("--factor", "-f")] = 0.5,
        least: Annotated[int | None, typer.Option(min=1)] = None,
        flag: bool = False,
    ):
        seen.append((count, path and str(path), words or [], factor, least, flag))

    def called(adapt):
        app = typer.Typer(add_completion=True)
        app.command()(command)
        try:
            adapt(typer.main.get_command(app)).main(words, standalone_mode=False)
        except Exception as error:
            seen.append(error.format_message())

    called(lambda command: command)
    called(with_plain_values)
    assert seen[0] == seen[1]
    assert seen[1] == made or (isinstance(made, str) and made in seen[1])
