"""The automatic filter: what it drops and why, that it goes on, and that runs know of it."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from stores import write_toy_store
from worlds import cruise_scenario, standing_tracks

import shiftsim
from shiftsim.data.store.check import survey_store
from shiftsim.data.store.reading import open_store
from shiftsim.errors import ConfigError, DataError
from shiftsim.runs.filter import (
    AREA,
    COLLISION,
    OFF_ROUTE,
    RESULTS,
    STANDING,
    FilterConfig,
    filter_store,
    judge_scenario,
    read_filter_results,
)
from shiftsim.world.state import AgentKind, Y


@pytest.fixture
def store(tmp_path):
    """Six scenarios, of which those faster than 8 m/s travel more than 19 m."""
    return write_toy_store(tmp_path / "toy", count=6)


def reasons(scenario, **settings):
    row = judge_scenario(scenario, FilterConfig(**settings))
    assert (row["verdict"] == "accepted") == (row["reason"] == "")
    return row["reason"]


def test_a_free_drive_along_its_lane_is_accepted():
    assert reasons(cruise_scenario(speed=8.0)) == ""


def test_a_recording_that_drives_through_a_parked_car_is_dropped_and_names_it():
    scene = cruise_scenario(speed=8.0)
    ahead = np.array([[scene.expert[0, 0] + 12.0, 0.0, 0.0]])
    tracks = standing_tracks(len(scene.time_us), ahead, [AgentKind.VEHICLE])
    row = judge_scenario(replace(scene, tracks=tracks), FilterConfig())
    assert row["reason"] == COLLISION
    assert row["partner_token"] == tracks.tokens[0]
    assert 0.0 < row["first_violation_s"] < 1.5


@pytest.mark.parametrize(
    ("shift", "thresholds", "dropped"),
    [(-1.8, "deepplan", False), (-1.8, "nuplan", True), (-6.0, "deepplan", True)],
)
def test_leaving_the_road_is_judged_by_the_profile(shift, thresholds, dropped):
    scene = cruise_scenario(speed=8.0)
    ego = scene.ego.copy()
    ego[:, Y] += shift
    # the lane ends 1.75 m beside its middle, and the car is 2.297 m wide
    assert (AREA in reasons(replace(scene, ego=ego), thresholds=thresholds)) == dropped


def test_a_car_that_hardly_moves_is_dropped():
    scene = cruise_scenario(speed=1.0, iterations=30)
    row = judge_scenario(scene, FilterConfig())
    assert row["reason"] == STANDING
    assert row["path_m"] == pytest.approx(2.9)
    assert reasons(scene, min_path_m=2.5) == ""


def test_a_drive_without_progress_along_a_lane_is_dropped():
    scene = cruise_scenario(speed=8.0)
    ego = scene.ego.copy()
    ego[:, Y] += 40.0
    row = judge_scenario(replace(scene, ego=ego), FilterConfig())
    assert row["progress_m"] == 0.0
    assert row["reason"].split(", ") == [AREA, OFF_ROUTE]


def test_settings_out_of_range_are_refused():
    with pytest.raises(ConfigError, match="min_progress_share 2"):
        FilterConfig(min_progress_share=2.0)
    with pytest.raises(ConfigError, match="profile 'deeplan'"):
        FilterConfig(thresholds="deeplan")


def test_verdicts_are_beside_the_scenarios_which_stay_as_they_were(store):
    before = open_store(store).hash
    found = filter_store(store, FilterConfig(min_path_m=19.0), workers=1)
    assert open_store(store).hash == before
    assert found.counts()[STANDING] == found.counts()["dropped"] > 0
    assert survey_store(store).problems == []
    assert read_filter_results(store, before).rows == found.rows


def test_a_second_filter_has_nothing_to_do_unless_the_settings_changed(store):
    calls = []
    filter_store(store, workers=1)
    filter_store(store, workers=1, on_progress=lambda *done: calls.append(done))
    assert calls == [(6, 6)]
    filter_store(
        store, FilterConfig(min_path_m=1.0), workers=1, on_progress=lambda *d: calls.append(d)
    )
    assert calls[1:3] == [(0, 6), (1, 6)]


def test_a_killed_filter_goes_on_where_it_stopped(store):
    whole = filter_store(store, workers=1).path.read_bytes()
    (store / RESULTS).unlink()

    class Stop(Exception):
        pass

    def stop_at_three(done, total):
        if done == 3:
            raise Stop

    with pytest.raises(Stop):
        filter_store(store, workers=1, on_progress=stop_at_three)
    assert not (store / RESULTS).exists()
    unfinished = store / "filter/unfinished.sqlite"
    assert unfinished.exists()
    calls = []
    again = filter_store(store, workers=1, on_progress=lambda *done: calls.append(done))
    assert calls == [(3, 6), (4, 6), (5, 6), (6, 6)]
    assert again.path.read_bytes() == whole
    assert not unfinished.exists()


def test_a_scenario_that_cannot_be_driven_is_listed_as_failed_and_tried_again(store):
    token = open_store(store).tokens[2]
    folder = store / "recordings" / open_store(store).window(token).log_name
    good = (folder / "tracks.parquet").read_bytes()
    (folder / "tracks.parquet").write_bytes(b"broken")
    row = next(row for row in filter_store(store, workers=1).rows if row["token"] == token)
    assert row["verdict"] == "failed"
    assert "tracks.parquet" in row["reason"]
    (folder / "tracks.parquet").write_bytes(good)
    assert filter_store(store, workers=1).counts()["failed"] == 0


def test_a_run_uses_the_accepted_scenarios_and_says_by_which_verdicts(store, tmp_path):
    found = filter_store(store, FilterConfig(min_path_m=19.0), workers=1)
    settings = {"store": str(store), "workers": 1, "save_rollouts": "none"}
    run = shiftsim.run("log-future", **settings, out=str(tmp_path / "some"))
    assert tuple(run.tasks["token"].to_pylist()) == found.accepted
    assert run.manifest["determining"]["filter"] == found.hash
    every = shiftsim.run("log-future", **settings, out=str(tmp_path / "all"), all_scenarios=True)
    assert len(every.tasks) == 6
    assert "filter" not in every.manifest["determining"]


def test_a_split_names_its_scenarios_itself(store, tmp_path):
    found = filter_store(store, FilterConfig(min_path_m=19.0), workers=1)
    named = tmp_path / "dropped.txt"
    named.write_text(found.rejected[0]["token"])
    run = shiftsim.run(
        "log-future", store=str(store), split=str(named), workers=1, out=str(tmp_path / "run")
    )
    assert run.tasks["token"].to_pylist() == [found.rejected[0]["token"]]


def test_verdicts_of_another_content_are_refused_with_what_to_do(store):
    filter_store(store, workers=1)
    write_toy_store(store, count=1, first=6)
    with pytest.raises(DataError, match="another content") as caught:
        shiftsim.run("log-future", store=str(store), workers=1)
    assert "--all" in caught.value.hint
    assert len(filter_store(store, workers=1).rows) == 7


def test_a_filter_that_drops_everything_stops_a_run(store):
    filter_store(store, FilterConfig(min_path_m=1000.0), workers=1)
    with pytest.raises(DataError, match="dropped all 6 scenarios"):
        shiftsim.run("log-future", store=str(store), workers=1)


@pytest.mark.thorough
def test_a_killed_command_goes_on_with_other_workers_to_the_same_bytes(tmp_path):
    store = write_toy_store(tmp_path / "toy", count=40)
    command = [sys.executable, "-m", "shiftsim", "filter", str(store), "--json", "--workers"]
    unfinished = store / "filter/unfinished.sqlite-wal"
    process = subprocess.Popen(
        [*command, "1"], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 60.0
    while not (unfinished.exists() and unfinished.stat().st_size > 40_000):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = unfinished.exists()
    done = subprocess.run([*command, "2"], capture_output=True, text=True, check=True)
    assert kept
    counts = json.loads(done.stdout)["counts"]
    assert (counts["accepted"] + counts["dropped"], counts["failed"]) == (40, 0)
    resumed = (store / RESULTS).read_bytes()
    (store / RESULTS).unlink()
    alone = filter_store(store, workers=1)
    assert alone.path.read_bytes() == resumed
    assert [row["token"] for row in alone.rows] == list(open_store(store).tokens)
