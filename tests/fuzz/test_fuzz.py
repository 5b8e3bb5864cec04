"""Damaged files of every format: read, or refused in one line; never a traceback or a hang.

`server.py` reads each in a process of its own, with 5 s and 1 GB; `corpus/` holds what once failed.
"""

import json
import lzma
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fuzz.mutate import DEEP, damage
from fuzz.server import CORPUS, run_case, seeds_of
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


def _twice(path, name):
    table = pq.read_table(path)
    with pq.ParquetWriter(path, table.append_column(name, table[name]).schema) as writer:
        writer.write_table(table.append_column(name, table[name]))


def _null(path, name):
    table = pq.read_table(path)
    kind = table[name].type
    hole = pa.chunked_array([pa.array([None, *table[name].to_pylist()[1:]], kind)])
    index = table.column_names.index(name)
    pq.write_table(table.set_column(index, pa.field(name, kind), hole), path)


def _planners(path, where, value):
    content = json.loads(path.read_text())
    content[where]["planners"] = value
    path.write_text(json.dumps(content))


def _deep_args(path, _):
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end]) | {"__metadata__": {"args": DEEP}}
    new = json.dumps(header).encode()
    path.write_bytes(len(new).to_bytes(8, "little") + new + data[end:])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "seed", "file", "change"),
    [
        ("settings", "run", "run.toml", lambda path: path.write_text(f"limit = {DEEP}")),
        ("settings", "run", "run.toml", lambda path: path.write_text("limit = " + "9" * 5000)),
        ("dsc3d", "site", "annotations.parquet", partial(_twice, name="translation_x")),
        ("dsc3d", "site", "frames.parquet", partial(_twice, name="frame_id")),
        ("run-folder", "run", "scores.parquet", partial(_twice, name="noise")),
        ("run-folder", "run", "part-*.parquet", partial(_null, name="planning_seconds")),
        ("run-folder", "run", "part-*.parquet", partial(_null, name="degraded")),
        (
            *("run-folder", "run", "manifest.json"),
            partial(_planners, where="config", value=[["constant-velocity"]]),
        ),
        (
            *("run-folder", "run", "manifest.json"),
            partial(_planners, where="determining", value={"constant-velocity": ["x"]}),
        ),
        pytest.param(
            *("checkpoint", "safetensors", "model.safetensors", partial(_deep_args, _=0)),
            marks=pytest.mark.learned,
        ),
    ],
)
@pytest.mark.thorough
def test_what_was_once_a_traceback_is_refused(target, seed, file, change):
    with seeds_of(target) as (seeds, place):
        folder = next(found for found in seeds if found.name == seed)
        case = shutil.copytree(folder, place / "case")
        change(next(case.rglob(file)))
        assert run_case(target, case)[0] == "refused"


def _xz(data):
    return lambda path: path.write_bytes(lzma.compress(data, preset=0))


def _whole(text):
    return lambda path: path.write_text(text)


def _line(text):
    """A last line more."""
    return lambda path: path.write_text(f"{path.read_text()}{text}\n")


def _packed(data):
    """The first element of a map of py123d holds these bytes."""

    def change(path):
        with pa.OSFile(str(path)) as source:
            table = pa.ipc.open_file(source).read_all()
        cells = pa.array([data, *table["features"].to_pylist()[1:]], pa.binary())
        table = table.set_column(table.column_names.index("features"), "features", cells)
        with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
            writer.write_table(table)

    return change


def _repeated(path):
    table = pq.read_table(path)
    pq.write_table(pa.concat_tables([table] * 700), path)


DIGITS = "9" * 5_000
STRANGE = {
    "av2": [
        ("scene", "log_map_archive_*.json", _whole(DEEP)),
        ("scene", "log_map_archive_*.json", _whole(f'{{"lane_segments": {DIGITS}}}')),
        ("scene", "scenario_*.parquet", partial(_twice, name="heading")),
        ("scene", "scenario_*.parquet", partial(_null, name="position_x")),
    ],
    "py123d": [
        ("logs", "map.arrow", _packed(b"\x91" * 20_000 + b"\x90")),
        ("logs", "map.arrow", _packed(b"\xdd\xff\xff\xff\xff")),
        ("logs", "map.arrow", _packed(b"\xc6\xff\xff\xff\xff")),
    ],
    "tracks": [
        ("named", "columns.toml", _whole(f"hz = {DEEP}")),
        ("named", "columns.toml", _whole(f"hz = {DIGITS}")),
        ("named", "columns.toml", _whole(f"shift_m = [{DIGITS[:400]}, 0]")),
        ("named", "tracks.csv", _line("1," * 100_000)),
        ("named", "tracks.csv", _line(",".join([DIGITS] * 10))),
        ("levelx", "01_recordingMeta.csv", _whole(f"frameRate\n{DIGITS}\n")),
        ("parquet", "tracks.parquet", partial(_twice, name="x")),
        ("parquet", "tracks.parquet", partial(_null, name="x")),
    ],
    "store": [
        ("toy", "store.json", _whole(DEEP)),
        ("toy", "store.json", _whole(f'{{"version": {DIGITS}}}')),
        ("toy", "tracks.parquet", partial(_twice, name="x_m")),
        ("toy", "tracks.parquet", partial(_null, name="x_m")),
    ],
    "experiment": [
        ("scores", "scores.parquet", partial(_twice, name="score")),
        ("scores", "scores.parquet", _repeated),
        ("metric", "metric.parquet", _whole(DEEP)),
        ("log", "log.msgpack.xz", _xz(b"\xc6\xff\xff\xff\xff")),
        ("log", "log.msgpack.xz", _xz(b"\x91" * 20_000 + b"\x90")),
        ("whole", "closed_loop*.parquet", partial(_twice, name="score")),
    ],
}


@pytest.mark.thorough
@pytest.mark.parametrize("target", STRANGE)
def test_what_no_program_writes_is_refused(target):
    """Deep nesting, numbers of thousands of digits, nulls, columns twice, absurd lengths."""
    with seeds_of(target) as (seeds, place):
        for number, (seed, file, change) in enumerate(STRANGE[target]):
            folder = next(found for found in seeds if found.name == seed)
            case = shutil.copytree(folder, place / f"case{number}")
            change(next(case.rglob(file)))
            outcome = run_case(target, case)
            assert outcome[0] == "refused", (number, outcome)


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
