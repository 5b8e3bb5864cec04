"""The command that converts DSC3D recordings: what it prints and writes, and how it ends."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress

import dsc3d_writer as writer
import numpy as np
import pytest

from shiftsim.cli import main
from shiftsim.data.readers.dsc3d import convert_dsc3d
from shiftsim.data.store.check import survey_store
from shiftsim.data.store.reading import open_store
from shiftsim.errors import DataError

NAMES = ("a", "b", "broken", "c")
DURATION = 30.0


def convert(folder, capsys, *words):
    """Exit code, output and error of the command, run in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("SHIFTSIM_DATA", raising=False)
        with pytest.raises(SystemExit) as end:
            main(["convert", "dsc3d", *words])
    out, err = capsys.readouterr() if capsys else ("", "")
    return end.value.code, out, err


def start(folder, *words):
    return subprocess.Popen(
        [sys.executable, "-m", "shiftsim", "convert", "dsc3d", *words],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={k: v for k, v in os.environ.items() if k != "SHIFTSIM_DATA"},
        start_new_session=True,
    )


def content(store):
    """Bytes of every file by name."""
    return {
        path.relative_to(store).as_posix(): path.read_bytes()
        for path in sorted(store.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with the site `town` of four recordings, one of them broken, and its store."""
    folder = tmp_path_factory.mktemp("place")
    times = writer.frame_times(DURATION)
    track = writer.car(1, times)
    meta = {"locations": [{"recordings": list(NAMES)}]}
    site = writer.write_site(folder / "town", [track], DURATION, meta=meta)
    for number, name in enumerate(NAMES):
        shutil.copytree(site / "annotations/r", site / "annotations" / name)
        other = writer.car(2, times, x0=300.0 - 5.0 * number, y=1.75, speed=-8.0, yaw=np.pi)
        if name == "broken":
            other["translation"][3, 0] = np.nan
        writer.write_annotations(site, [track, other])
        os.replace(
            site / "annotations/r/annotations.parquet",
            site / "annotations" / name / "annotations.parquet",
        )
    assert convert(folder, None, "town", "--store", "whole", "--workers", "1")[0] == 3
    return folder


def test_a_broken_recording_is_skipped_with_its_reason_and_the_others_finish(place, capsys):
    words = ("--store", "again", "--workers", "1", "--json")
    code, out, _ = convert(place, capsys, "town", *words)
    report = json.loads(out)
    assert code == 3
    assert [entry["name"] for entry in report["recordings"]] == ["a", "b", "c"]
    assert report["skipped"].keys() == {"broken"}
    assert "column 'translation_x', row 379: nan" in report["skipped"]["broken"]
    kept = json.loads((place / "shiftsim-data/again/reports/town.json").read_text())
    assert kept["skipped"] == report["skipped"]
    problems = survey_store(place / "shiftsim-data/again").problems
    assert {(p.is_error, p.kind) for p in problems} == {(False, "route")}  # of one road


@pytest.mark.thorough
def test_the_bytes_do_not_depend_on_the_number_of_workers(place, capsys):
    code, _, err = convert(place, capsys, "town", "--store", "two", "--workers", "2")
    assert code == 3, err
    assert content(place / "shiftsim-data/two") == content(place / "shiftsim-data/whole")


def test_a_second_conversion_keeps_what_is_there(place, capsys):
    before = content(place / "shiftsim-data/whole")
    code, out, _ = convert(place, capsys, "town", "--store", "whole", "--workers", "1")
    assert code == 3
    assert "3 recordings kept from before" in out
    assert content(place / "shiftsim-data/whole") == before


@pytest.mark.thorough
@pytest.mark.slow
def test_a_killed_conversion_goes_on_and_ends_with_the_same_bytes(place, capsys):
    store = place / "shiftsim-data/killed"
    process = start(place, "town", "--store", "killed", "--workers", "2")
    while process.poll() is None and not list(store.glob(".partial/*/*/part.json")):
        time.sleep(0.002)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert not (store / "store.json").exists()
    with pytest.raises(DataError, match="interrupted"):
        open_store(store)
    code, out, err = convert(place, capsys, "town", "--store", "killed", "--workers", "1")
    assert code == 3, err
    assert "kept from before" in out
    assert content(store) == content(place / "shiftsim-data/whole")


@pytest.mark.parametrize("calls", range(0, 40, 3))
@pytest.mark.thorough
def test_a_conversion_stopped_anywhere_goes_on_to_the_same_bytes(place, monkeypatch, calls):
    """Every file of a store appears by a rename; the process ends right before one of them."""
    store = place / f"stopped-{calls}"
    left, replace = [calls], os.replace

    def stop(*names):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        replace(*names)

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(os, "replace", stop)
        convert_dsc3d(place / "town", store)
    convert_dsc3d(place / "town", store)
    assert content(store) == content(place / "shiftsim-data/whole")
    shutil.rmtree(store)


def test_settings_come_from_a_file_and_flags_win(place, capsys):
    (place / "short.toml").write_text("window_s = 20.0\nhistory_s = 2.0\noverlap_s = 4.0\n")
    words = (
        "--config",
        "short.toml",
        "--window-s",
        "10",
        "--category",
        "lorry=truck",
        "--workers",
        "1",
    )
    code, out, err = convert(place, capsys, "town", "--store", "short", *words)
    assert code == 3, err
    assert "a: 30.0 s, 2 tracks, 4 windows" in out
    config = json.loads((place / "shiftsim-data/short/reports/town.json").read_text())["config"]
    assert (config["window_s"], config["history_s"]) == (10.0, 2.0)
    assert config["category_map"] == {"lorry": "truck"}


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--window-s", "40"), "no window fits, the longest recording has 30.0 s"),
        (("--config", "still.toml"), "all vehicles stand"),
    ],
)
def test_a_conversion_without_scenarios_says_why(place, capsys, words, reason):
    (place / "still.toml").write_text("min_peak_speed = 50.0\n")
    store = f"empty-{words[1]}"
    code, out, _ = convert(place, capsys, "town", "--store", store, "--workers", "1", *words)
    assert code == 3
    assert f" no scenario: {reason}\n" in out
    assert ("remedy: shorter windows, such as --window-s" in out) == ("window" in reason)
    assert "next:" not in out


@pytest.mark.parametrize(
    ("words", "code", "fact"),
    [
        (("--category", "lorry"), 1, "category 'lorry' is not NAME=KNOWN"),
        (("--config", "wrong.toml"), 1, "wrong.toml: setting 'window' unknown"),
        (("--config", "text.toml"), 1, "window_s is '18'; it must be a number"),
        (("--window-s", "18.03"), 1, "window_s = 18.03"),
        (("--map", "absent.xodr"), 2, "map absent.xodr does not exist"),
    ],
)
def test_wrong_settings_are_one_error_and_leave_no_store(place, capsys, words, code, fact):
    (place / "wrong.toml").write_text("window = 18.0\n")
    (place / "text.toml").write_text('window_s = "18"\n')
    found, _, err = convert(place, capsys, "town", "--store", "none", "--workers", "1", *words)
    assert (found, fact in err) == (code, True), err
    assert len(err.splitlines()) <= 2
    assert not (place / "shiftsim-data/none").exists()


def test_a_store_that_is_being_written_is_left_alone(place, capsys):
    fcntl = pytest.importorskip("fcntl")
    handle = os.open(place / "shiftsim-data/whole", os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        code, _, err = convert(place, capsys, "town", "--store", "whole", "--workers", "1")
    finally:
        os.close(handle)
    assert code == 2
    assert "another conversion writes to this store" in err
