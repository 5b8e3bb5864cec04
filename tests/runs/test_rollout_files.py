"""Rollouts share files and row groups, and every one is found again."""

from contextlib import suppress
from itertools import count
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shiftsim.errors import DataError
from shiftsim.runs.folder import RunWriter
from shiftsim.runs.results import FORMAT_VERSION
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts import files as rollout_files
from shiftsim.runs.rollouts.files import (
    TRACKS,
    RolloutLocation,
    RolloutReader,
    encode_rows,
    rollout_rows,
    stored_plans,
    stored_tracks,
    write_rollouts,
)
from shiftsim.runs.tables import TaskResult
from shiftsim.sim.log import SimulationLog
from shiftsim.world.state import Tracks, TrafficLights

TRACK_WIDTHS = {"poses": 3, "velocities": 2, "sizes": 2}
MANIFEST = {
    "format": FORMAT_VERSION,
    "state": "finished",
    **{"split": "s", "store": "s", "config": {"planners": [], "noise": [], "seeds": []}},
    "counts": {"ok": 0, "expected": 0},
    "determining": {
        **{"store": "", "planners": {}, "traffic": "", "controller": ""},
        "metric_version": "",
        "thresholds": {"name": ""},
    },
}


def tracks_of(valid, numbers):
    """Tracks that are there where valid (K, N), with poses, velocities and sizes."""
    tokens = tuple(f"track {number}" for number in range(valid.shape[1]))
    return Tracks(valid, *numbers, np.zeros(valid.shape[1], np.int64), tokens)


def log_of(ego, plans, tracks):
    """A log of nothing but these."""
    count = len(ego)
    pairs, zeros = np.zeros((count, 2)), np.zeros(count)
    lights, whole = TrafficLights.empty(count), np.arange(count)
    rest = pairs, pairs, plans, zeros, zeros.astype(np.bool_)
    return SimulationLog("", whole, ego, tracks, lights, whole, ego, (), *rest)


def made_up(length, *, value=0.0, tracks=None):
    """A rollout of so many samples, with so many tracks."""
    rng = np.random.default_rng(length)
    valid = rng.random((length, tracks or 0)) < 0.7
    numbers = (rng.normal(value, 1.0, (*valid.shape, width)) for width in TRACK_WIDTHS.values())
    plans = rng.normal(value, 1.0, (length, 18, 3))
    log = log_of(np.full((length, 11), value), plans, tracks_of(valid, numbers))
    return rollout_rows(log, with_tracks=tracks is not None)


def key(number):
    return Task("p", "none" if number % 2 else "ou-high", number % 3, f"{number:04x}")


def without_key(rows):
    """A rollout as it was written."""
    return rows.select(rows.schema.names[5:])


@settings(max_examples=40, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 7), min_size=1, max_size=20),
    tracks=st.sampled_from([None, 0, 2]),
    per_group=st.integers(1, 4),
    per_file=st.integers(1, 9),
)
def test_every_rollout_is_found_again(tmp_path_factory, lengths, tracks, per_group, per_file):
    folder = tmp_path_factory.mktemp("rollouts")
    made = {
        key(i): made_up(length, value=float(i), tracks=tracks) for i, length in enumerate(lengths)
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout_files, "_GROUP", per_group)
        patch.setattr(rollout_files, "_FILE", per_file)
        locations = write_rollouts(folder, made.items())
    files = sorted(folder.iterdir())
    assert len(files) == -(-len(lengths) // per_file)
    assert all(pq.ParquetFile(file).metadata.row_group(0).num_rows for file in files)
    reader = RolloutReader()
    for task, location in locations.items():
        rows = reader.read(location)
        assert without_key(rows).equals(made[task])
        assert rows["iteration"].to_pylist() == list(range(len(rows)))
        named = pq.read_table(location.file, columns=[*Task._fields, "time_us"]).to_pylist()
        own = [row for row in named if Task(*(row[n] for n in Task._fields)) == task]
        assert len(own) == location.rows


def test_a_row_group_is_cut_where_it_has_enough_rollouts(tmp_path, monkeypatch):
    monkeypatch.setattr(rollout_files, "_GROUP", 3)
    locations = write_rollouts(tmp_path, ((key(number), made_up(5)) for number in range(7)))
    metadata = pq.ParquetFile(locations[key(0)].file).metadata
    assert [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)] == [15, 15, 5]


def test_a_file_that_is_not_finished_leaves_nothing(tmp_path):
    def broken():
        for number in range(40):
            yield key(number), made_up(3)
        assert [path.name for path in tmp_path.iterdir()] == [".part-00000.parquet.tmp"]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_rollouts(tmp_path, broken())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("place", [(0, 9), (3, 3), (4, 1), (400, 1)])
def test_rows_that_a_file_does_not_have_are_an_error(tmp_path, place):
    file = write_rollouts(tmp_path, [(key(0), made_up(4))])[key(0)].file
    assert len(RolloutReader().read(RolloutLocation(file, 1, 3))) == 3
    with pytest.raises(DataError, match=r"part-00000\.parquet' cannot be read"):
        RolloutReader().read(RolloutLocation(file, *place))


def under_way(folder, results, *, resume):
    writer = RunWriter(folder, MANIFEST, resume=resume)
    for task, rows in results.items():
        scores = {"cls": 1.0, "thresholds": "nuplan", "metric_version": "1"}
        metrics = [{"metric": "m", "thresholds": "nuplan", "metric_version": "1"}]
        writer.add(
            TaskResult(task, "ok", scores=scores, metrics=metrics, rollout=encode_rows(rows))
        )
    return writer


def finished(folder, results, *, resume):
    return under_way(folder, results, resume=resume).finish(MANIFEST, map(key, range(6)))


def test_a_rollout_that_is_made_again_replaces_the_first(tmp_path):
    first = {key(i): made_up(3 + i, value=float(i)) for i in range(4)}
    later = {key(i): made_up(5, value=float(10 + i)) for i in (3, 4, 5)}
    finished(tmp_path / "run", first, resume=False)
    run = finished(tmp_path / "run", later, resume=True)
    for task, rows in (first | later).items():
        assert without_key(run.rollout_rows(task)).equals(rows)
    stored = pa.concat_tables(map(pq.read_table, (run.path / "rollouts").iterdir()))
    assert len(stored) == sum(map(len, (first | later).values()))
    assert not list(run.path.glob("unfinished*"))


def test_files_of_an_earlier_attempt_stay_as_they_are(tmp_path):
    run = finished(tmp_path / "run", {key(i): made_up(3) for i in range(3)}, resume=False)
    (file,) = (run.path / "rollouts").iterdir()
    before = file.stat()
    run = finished(tmp_path / "run", {key(i): made_up(3) for i in range(3, 6)}, resume=True)
    assert (file.stat().st_ino, file.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    names = pc.unique(run.tasks["rollout"]).to_pylist()
    assert sorted(names) == [path.name for path in sorted((run.path / "rollouts").iterdir())]
    assert len(names) == 2


@pytest.mark.parametrize("moment", ["replace", "unlink"])
@pytest.mark.thorough
def test_ending_is_begun_anew_after_a_kill_at_any_step(tmp_path, monkeypatch, moment):
    """Every renaming and every removal is the last thing that happens, one after the other."""

    class Killed(BaseException):
        pass

    original = getattr(Path, moment)
    first = {key(i): made_up(3 + i, value=float(i)) for i in range(4)}
    later = {key(i): made_up(5, value=float(10 + i)) for i in (3, 4, 5)}
    expected = finished(tmp_path / "whole", first | later, resume=False)
    for step in range(1, 20):
        folder = tmp_path / f"run-{step}"
        finished(folder, first, resume=False)
        calls = count(1)

        def killing(self, *args, calls=calls, last=step, **values):
            original(self, *args, **values)
            if next(calls) == last:
                raise Killed

        writer = under_way(folder, later, resume=True)
        with monkeypatch.context() as patch:
            patch.setattr(Path, moment, killing)
            with suppress(Killed):
                writer.finish(MANIFEST, map(key, range(6)))
                break
        writer.close()
        run = finished(folder, {}, resume=True)
        for name in ("scores.parquet", "metrics.parquet"):
            assert (run.path / name).read_bytes() == (expected.path / name).read_bytes()
        for task, rows in (first | later).items():
            assert without_key(run.rollout_rows(task)).equals(rows)
        names = {path.name for path in (run.path / "rollouts").iterdir()}
        assert names == set(run.tasks["rollout"].to_pylist())
    assert step > 3


def test_the_rollouts_of_a_scenario_lie_together(tmp_path):
    tasks = [Task(planner, "none", 0, token) for planner in "ba" for token in ("y", "x")]
    writer = under_way(tmp_path / "run", dict.fromkeys(tasks, made_up(3)), resume=False)
    run = writer.finish(MANIFEST, tasks)
    ordered = sorted(tasks, key=lambda task: run.rollout_places[task])
    assert [(task.token, task.planner) for task in ordered] == [
        ("x", "a"),
        ("x", "b"),
        ("y", "a"),
        ("y", "b"),
    ]


@given(st.integers(1, 6), st.integers(0, 5), st.integers(0, 2**32))
def test_tracks_come_back_bit_by_bit(length, tracks, seed):
    rng = np.random.default_rng(seed)
    valid = rng.random((length, tracks)) < rng.choice([0.0, 0.5, 1.0])
    bits = [rng.integers(0, 2**64, (*valid.shape, w), np.uint64) for w in TRACK_WIDTHS.values()]
    given_tracks = tracks_of(valid, [values.view(np.float64) for values in bits])
    log = log_of(np.zeros((length, 11)), np.full((length, 18, 3), np.nan), given_tracks)
    found = stored_tracks(rollout_rows(log, with_tracks=True), given_tracks.tokens)
    assert np.array_equal(found["valid"], valid)
    for name, values in zip(TRACK_WIDTHS, bits, strict=True):
        assert found[name].shape == values.shape
        assert np.array_equal(found[name][valid].view(np.uint64), values[valid])
        assert np.isnan(found[name][~valid]).all()


@pytest.mark.parametrize("name", TRACKS.names[1:])
def test_a_rollout_that_lacks_boxes_is_refused(name):
    rows = made_up(5, tracks=2)
    at = rows.schema.get_field_index(name)
    lacking = pa.array([rows[name][0].as_py()[:1], *[[]] * 4], rows[name].type)
    spoilt = rows.set_column(at, rows.schema.field(at), lacking)
    with pytest.raises(ValueError, match=f"the lists of '{name}' are too short"):
        stored_tracks(spoilt, ["track 0", "track 1"])


def test_tracks_of_another_scenario_are_refused():
    with pytest.raises(ValueError, match="tracks that the scenario has not"):
        stored_tracks(made_up(5, tracks=2), ["track 0"])


@given(
    st.lists(st.integers(0, 18), min_size=1, max_size=6),
    st.floats(-1e5, 1e5),
    st.floats(-1.0e4, 1.0e4),
)
def test_plans_are_rounded_offsets_from_the_ego(lengths, place, size):
    ego = np.full((len(lengths), 11), place)
    plans = place + size / 2 * np.sin(np.arange(len(lengths) * 54.0)).reshape(-1, 18, 3)
    for plan, length in zip(plans, lengths, strict=True):
        plan[length:] = np.nan
    log = log_of(ego, plans, Tracks.empty(len(ego)))
    rows = rollout_rows(log, with_tracks=False)
    back = stored_plans(rows)
    np.testing.assert_allclose(back, plans, rtol=0.0, atol=(1.0 + 1e-6) / 4096)
    parts = rows["plan_dx_m"].flatten().to_numpy() * 2048.0
    np.testing.assert_array_equal(parts, np.rint(parts))  # few bits, which compress well
    again = rollout_rows(log_of(ego, back, log.tracks), with_tracks=False)
    assert again.equals(rows)  # whoever reads and writes it changes nothing


def test_pandas_polars_and_duckdb_read_rollouts_as_they_are(tmp_path):
    duckdb, pandas, polars = map(pytest.importorskip, ("duckdb", "pandas", "polars"))
    rows = [made_up(4, value=2.0, tracks=3), made_up(6, value=5.0, tracks=3)]
    locations = write_rollouts(tmp_path, ((key(i), each) for i, each in enumerate(rows)))
    file = locations[key(0)].file
    found = pandas.read_parquet(file)
    assert found.x_m.tolist() == [2.0] * 4 + [5.0] * 6
    second = found[found.token == "0001"]
    assert [list(one) for one in second.track_x_m] == rows[1]["track_x_m"].to_pylist()
    query = f"select unnest(track_tokens) as track, unnest(track_x_m) from '{file}'"
    boxes = sum(len(one) for each in rows for one in each["track_x_m"].to_pylist())
    assert len(duckdb.sql(query).fetchall()) == boxes
    columns = ["track_tokens", "track_x_m"]
    assert polars.read_parquet(file, columns=columns).explode(columns).height == boxes
