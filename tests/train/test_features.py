"""Samples in files: those of the stream, made once, and the same after an interruption."""

import json
from dataclasses import replace

import pytest
from commands import call
from safetensors.torch import load_file
from stores import write_toy_store

from shiftsim.data import open_store
from shiftsim.errors import ConfigError, DataError, PlannerError
from shiftsim.planners.learned.pluto.planner import Pluto
from shiftsim.train import stream
from shiftsim.train.folder import FeatureSettings, write_features
from shiftsim.train.stream import Stream, load_blocks

pytestmark = [pytest.mark.learned, pytest.mark.slow]


@pytest.fixture(scope="module")
def road(tmp_path_factory):
    """A store of 40 scenarios of 12 s."""
    return write_toy_store(tmp_path_factory.mktemp("stores") / "road", count=40, iterations=121)


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks of 16 scenarios."""
    monkeypatch.setattr(stream, "PER_BLOCK", 16)


@pytest.fixture
def asked(road, tmp_path):
    """Settings of a folder with all blocks."""
    return FeatureSettings(
        store=str(road), planner="pluto", out=tmp_path / "all", seed=7, workers=0
    )


def write(settings):
    lines = []
    return write_features(settings, lines.append)


@pytest.mark.parametrize("planner", ["plantf", "pluto"])
def test_files_hold_the_batches_of_the_stream(asked, road, planner):
    index = write(replace(asked, planner=planner, samples=1))
    assert index == json.loads((asked.out / "index.json").read_text())
    assert (index["planner"], index["seed"]) == (planner, 7)
    assert index["store_hash"] == open_store(road).hash
    assert list(index["files"]) == ["samples-000000.safetensors"]
    tokens = tuple(sorted(open_store(road).tokens))
    samples = Stream(str(road), tokens, 7, 10_000, planner, as_published=True)
    (batch,) = next(load_blocks(samples, 0, 0)).batches
    known, found = batch.tensors(), load_file(asked.out / "samples-000000.safetensors")
    assert found.keys() == known.keys() > {"current_state", "counts", "target", "target_valid"}
    assert found["valid"].equal(batch.inputs.valid)  # of the past, not of the target
    assert ("projection" in found) == (planner == "pluto")
    assert all(found[name].equal(value) for name, value in known.items())
    assert index["samples"] == len(found["target"])
    assert found["counts"][0].tolist() == batch.inputs.counts[0]


def test_it_goes_on_where_it_was_ended(asked, tmp_path, small_blocks):
    ended = replace(asked, out=tmp_path / "ended")
    write(asked)
    write(replace(ended, samples=1))
    first = ended.out / "samples-000000.safetensors"
    before = first.stat().st_mtime_ns
    write(ended)
    assert first.stat().st_mtime_ns == before
    names = sorted(path.name for path in asked.out.iterdir())
    assert names == sorted(path.name for path in ended.out.iterdir())
    assert len(names) == 3 + 2
    for name in names:
        assert (asked.out / name).read_bytes() == (ended.out / name).read_bytes()


def test_a_folder_of_other_samples_is_refused(asked):
    write(replace(asked, samples=1))
    with pytest.raises(ConfigError, match="seed 7, not 8"):
        write(replace(asked, seed=8))


def test_where_no_sample_can_be_made_it_says_why(asked, monkeypatch):
    def nothing(planner, observation):
        raise PlannerError("no route")

    monkeypatch.setattr(Pluto, "features", nothing)
    with pytest.raises(DataError, match="no sample could be made") as caught:
        write(asked)
    assert "PlannerError: no route" in caught.value.hint


def test_a_split_that_the_store_lacks_a_part_of_is_refused(asked, road, tmp_path):
    (tmp_path / "mix.txt").write_text(f"{open_store(road).tokens[0]}\nffffcafe\n")
    with pytest.raises(DataError, match=r"split 'mix' needs 2 scenarios, .* lacks 1 of them"):
        write(replace(asked, split=str(tmp_path / "mix.txt")))
    assert not asked.out.exists()


@pytest.mark.parametrize("changes", [{"planner": "carl"}, {"samples": -1}, {"workers": -1}])
def test_settings_that_make_no_samples_are_refused(asked, changes):
    with pytest.raises(ConfigError):
        replace(asked, **changes)


@pytest.mark.thorough
def test_the_command_writes_them_with_any_number_of_workers(asked, road, tmp_path):
    write(asked)
    done = call(
        *(tmp_path, "features", str(road), "--for", "pluto"),
        *("--out", "two", "--seed", "7", "--workers", "2"),
    )
    assert done.returncode == 0, done.stderr
    assert "samples in 1 file:" in done.stdout
    for path in asked.out.glob("*.safetensors"):
        assert (tmp_path / "two" / path.name).read_bytes() == path.read_bytes()
