"""What the shell offers for a value, asked as the shell asks."""

import os
import subprocess
import sys

import pytest
from stores import write_toy_store

from shiftsim.cli.values import NOISES
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
