"""Damaged files of every format: read, or refused in one line; never a traceback or a hang.

`server.py` reads each in a process of its own, with 5 s and 1 GB; `corpus/` holds what once failed.
"""

import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from fuzz.mutate import damage
from fuzz.server import CORPUS, run_case
from fuzz.targets import TARGETS, Target
from worlds import cruise_scenario, straight_road

from shiftsim.data.maps.opendrive.records import Lane, Speed
from shiftsim.errors import DataError

SERVER = Path(__file__).with_name("server.py")
LEARNED = {"checkpoint": pytest.mark.learned}
READERS = [pytest.param(name, marks=LEARNED.get(name, ())) for name in TARGETS]


def outcomes(*arguments: object) -> Counter[str]:
    """How many cases ended how; fails where one did neither give anything sound nor an error."""
    command = [sys.executable, str(SERVER), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    cases = [json.loads(line) for line in done.stdout.splitlines()]
    bad = [case for case in cases if case[2] not in ("ok", "refused")]
    assert not bad, "\n".join(" | ".join(map(str, case)) for case in bad[:5])
    return Counter(case[2] for case in cases)


@pytest.mark.slow
@pytest.mark.learned
@pytest.mark.thorough
def test_what_once_failed_is_read_or_refused():
    assert outcomes().total() == sum(1 for _ in CORPUS.glob("*/*"))


@pytest.mark.thorough
@pytest.mark.parametrize("reader", READERS)
def test_sixty_damaged_inputs_are_read_or_refused(reader):
    found = outcomes(reader, 0, 60)
    assert found["ok"] > 5  # the damage is not so bad that nothing is tried
    assert found["refused"] > 5


@pytest.mark.long
@pytest.mark.parametrize("reader", READERS)
def test_two_thousand_damaged_inputs_are_read_or_refused(reader):
    assert outcomes(reader, 0, 2000).total() == 2000


def test_the_kept_inputs_are_small():
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) <= 1_000_000


def test_the_same_number_is_the_same_damage(tmp_path):
    for name in ("a.toml", "b.toml"):
        (tmp_path / name).write_text('x = 1\ny = "z"\n' * 20)
        damage(tmp_path / name, Random("7"))
    texts = [(tmp_path / name).read_bytes() for name in ("a.toml", "b.toml")]
    assert texts[0] == texts[1] != b'x = 1\ny = "z"\n' * 20


def _loop(_folder):
    while True:
        pass


def _take(_folder):
    return np.ones(2 << 27)


def _fail(_folder):
    raise DataError("a number is bad", "mend it")


@pytest.mark.parametrize(
    ("read", "outcome"),
    [
        (_loop, "hang"),
        (_take, "traceback"),
        (lambda folder: 1 / 0, "traceback"),
        (lambda folder: {"x": [1e13]}, "garbage"),
        (lambda folder: np.array([np.nan]), "garbage"),
        (lambda folder: Speed(1e6, None), "garbage"),
        (lambda folder: {"weight": [np.array([2e9])]}, "garbage"),
        (lambda folder: Lane(1, "", np.full((1, 5), 2e4), np.zeros((0, 5))), "garbage"),
        (lambda folder: Lane(1, "", np.full((1, 5), 2e3), np.zeros((0, 5))), "ok"),
        (lambda folder: {"cls": 1.1}, "garbage"),
        (lambda folder: replace(cruise_scenario(), row_step=2**31), "garbage"),
        (lambda folder: replace(straight_road(), speed_limits=np.full(1, -1.0)), "garbage"),
        (_fail, "no file named"),
        (lambda folder: 5.0, "ok"),
    ],
)
def test_the_server_tells_what_went_wrong(read, outcome, tmp_path, monkeypatch):
    monkeypatch.setitem(TARGETS, "made-up", Target(lambda folder: None, read))
    monkeypatch.setattr("fuzz.server.SECONDS", 0.3)
    assert run_case("made-up", tmp_path)[0] == outcome
