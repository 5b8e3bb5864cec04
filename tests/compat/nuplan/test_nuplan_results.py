"""Exported results are as nuPlan itself writes them, and are read back by everything that reads."""

import lzma
import os
import pickle
import subprocess
from collections import defaultdict
from functools import partial
from io import BytesIO
from types import SimpleNamespace

import msgpack
import numpy as np
import places
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import call

import shiftsim
from shiftsim.data.nuplan.convert import convert_nuplan
from shiftsim.errors import ConfigError, DataError
from shiftsim.runs.rollouts import Task
from shiftsim.sim.dynamics.perfect import KEPT_US
from shiftsim.verify.experiment import verify_experiment
from shiftsim.verify.report import Report
from shiftsim.verify.rollouts import ego_columns, light_columns, object_columns, plan_at
from shiftsim.verify.simulation_log import read_simulation_log

pytestmark = [pytest.mark.golden, pytest.mark.thorough]
GOLDEN = places.GOLDEN / "nuplan_experiment/closed_loop_nonreactive_agents/simple_planner"
REAL_LOGS = places.REPOSITORY.parent / "shared" / "reference" / "nuplan_real_logs"
DEVKIT = os.environ.get("NUPLAN_DEVKIT_PYTHON", "")
TOKENS = ["a001065c00000032", "a004065c00000032", "a007065c00000032", "a00a065c00000032"]
LOGGED = TOKENS[-1]  # of which there is nuPlan's own simulation log
TIMES = {"start_time", "end_time", "duration"}


@pytest.fixture(scope="module")
def made(nuplan_reference, tmp_path_factory):
    """A run on nuPlan's scenes, clean and disturbed, and its export."""
    folder = tmp_path_factory.mktemp("results")
    logs, maps = nuplan_reference / "logs", nuplan_reference / "maps"
    convert_nuplan(logs, maps, folder / "store", tokens=TOKENS, mapping=(15.0, 0.0, 0.5))
    settings = {"store": str(folder / "store"), "workers": 1, "out": str(folder / "run")}
    run = shiftsim.run(["simple", "idm"], noise=["none", "ou-high"], seeds=[0, 1], **settings)
    report = run.export_results(folder / "out", logs=logs, maps=maps, workers=1)
    return SimpleNamespace(folder=folder, run=run, report=report, out=folder / "out")


@pytest.fixture
def clean(made):
    return made.out / "closed_loop_nonreactive_agents" / "no-noise"


def test_there_is_a_folder_for_every_noise_and_seed(made):
    names = [str(folder.relative_to(made.out)) for folder in made.report.folders]
    assert sorted(names) == [
        f"closed_loop_nonreactive_agents/{name}"
        for name in ("no-noise", "ou-high-seed-0", "ou-high-seed-1")
    ]
    assert (made.report.rollouts, made.report.failed) == (24, 0)


def test_results_are_read_back_without_a_mismatch(made):
    store = shiftsim.open_store(made.folder / "store")
    report = verify_experiment(made.out, partial(find, store))
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.quantities["scores score"].cases == 24
    assert sum(name.startswith("metric ") for name in report.quantities) == 16
    assert sum("exported by shiftsim" in line for line in report.remarks) == 24


def find(store, token):
    return store[token] if token in store else None


def rows_of(path, planner):
    """Rows of a planner by scenario, and the types of the columns."""
    table = pq.read_table(path)
    name = "scenario" if "scenario" in table.column_names else "scenario_name"
    rows = [row for row in table.to_pylist() if row["planner_name"] == planner]
    return {row[name]: row for row in rows}, dict(
        zip(table.schema.names, table.schema.types, strict=True)
    )


@pytest.mark.parametrize("kind", ["metrics", "aggregator_metric", "."])
def test_tables_are_those_that_nuplan_wrote_of_the_same_run(clean, kind):
    for path in sorted((GOLDEN / kind).glob("*.parquet")):
        name = f"{path.name.partition('_202')[0]}*" if kind == "aggregator_metric" else path.name
        [written] = (clean / kind).glob(name)
        theirs, types = rows_of(path, "SimplePlanner")
        ours, own_types = rows_of(written, "simple")
        assert ours.keys() == theirs.keys()
        assert list(own_types)[:9] == list(types)[:9]
        for scenario, row in theirs.items():
            for column in {*row, *own_types} - {"planner_name", *TIMES}:
                if "runtimes" not in column:
                    where = f"{path.name} {scenario} {column}"
                    assert_same(ours[scenario].get(column), row.get(column), where)
        for column, kind_of in types.items():
            if column in own_types and path.stem != "speed_limit_compliance":
                assert str(own_types[column]) == str(kind_of), f"{path.name} {column}"


def assert_same(ours, theirs, where):
    if isinstance(theirs, (float, list)) or isinstance(ours, float):
        found, wanted = (np.asarray(value, np.float64) for value in (ours, theirs))
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9, err_msg=where)
    else:
        assert ours == theirs, where


def log_of(folder, planner, token=LOGGED):
    [path] = folder.glob(f"simulation_log/{planner}/*/*/{token}/{token}.msgpack.xz")
    return path


@pytest.mark.parametrize("noise", ["none", "ou-high"])
def test_logs_hold_the_rollout_to_the_last_bit(made, noise):
    task = Task("idm", noise, int(noise != "none"), LOGGED)
    name = "no-noise" if noise == "none" else "ou-high-seed-1"
    scenario = shiftsim.open_store(made.folder / "store")[LOGGED]
    log = made.run.rollout(task, scenario)
    found = read_simulation_log(
        log_of(made.out / "closed_loop_nonreactive_agents" / name, "idm"), Report()
    )
    for column, values in ego_columns(log.ego).items():
        np.testing.assert_array_equal(found.ego[column], values)
    np.testing.assert_array_equal(found.ego["time_us"], log.time_us)
    for table, columns in (
        (found.objects, object_columns(log.tracks, *np.nonzero(log.tracks.valid))),
        (found.lights, light_columns(scenario)),
    ):
        for column, values in columns.items():
            np.testing.assert_array_equal(table[column], values)
    assert found.seconds == log.planning_seconds.tolist()
    for iteration in (0, 7, 148):
        plan = plan_at(found.plans, iteration)
        count = len(plan.time_us)
        np.testing.assert_array_equal(plan.time_us, log.time_us[iteration] + KEPT_US[:count])
        np.testing.assert_array_equal(plan.states[0], log.ego[iteration])
        poses = log.plans[iteration, 1:count]
        np.testing.assert_array_equal(plan.states[1:, :3], poses)


class Record:
    """An object of a pickle: the number of its arguments, and its attributes."""

    def __new__(cls, *arguments, **_):
        record = object.__new__(cls)
        record.arguments, record.values, record.has_slots = arguments, {}, False
        return record

    def __setstate__(self, values):
        self.has_slots = isinstance(values, tuple) and len(values) == 2
        values = values[1] if self.has_slots else values
        self.values = values if isinstance(values, dict) else {}

    def extend(self, values):
        pass


class Reader(pickle.Unpickler):
    def find_class(self, module, name):
        return type(name, (Record,), {"__module__": module})


def forms(*paths):
    """By class: how its objects are made, and by attribute the types of its values."""
    found, seen, left = {}, {}, []
    for path in paths:
        content = msgpack.unpackb(lzma.decompress(path.read_bytes()), max_bin_len=1 << 30)
        left.append(Reader(BytesIO(content)).load())
    while left:
        one = left.pop()
        if id(one) in seen:
            continue
        seen[id(one)] = one
        if isinstance(one, Record):
            name = f"{type(one).__module__}.{type(one).__name__}"
            made, attributes = found.setdefault(name, (set(), defaultdict(set)))
            made.add((0 if name == "pathlib.PosixPath" else len(one.arguments), one.has_slots))
            for attribute, value in one.values.items():
                attributes[attribute].add(
                    {"scalar": "float"}.get(word := type(value).__name__, word)
                )
            left += [*one.arguments, *one.values.values()]
        elif isinstance(one, (list, tuple)):
            left += one
    return found


REUSED = {  # what the devkit keeps of values that it was asked for
    *("geometry", "speed", "acceleration", "center_acceleration_2d", "center_velocity_2d"),
}
STAND_IN = ("simple_planner.SimplePlanner", "functools.partial", "builtins.str")
SOMETIMES = ("StaticObject", "TrafficLightStatusData", "TrafficLightStatusType")


@pytest.mark.parametrize(
    "path", [*GOLDEN.rglob("*.xz"), *sorted(REAL_LOGS.glob("*.xz"))], ids=lambda path: path.name
)
def test_logs_have_the_objects_and_attributes_of_genuine_ones(clean, path):
    theirs = forms(path)
    for name, (made, attributes) in forms(*(log_of(clean, "idm", t) for t in TOKENS)).items():
        if name.endswith(STAND_IN) or (name.endswith(SOMETIMES) and name not in theirs):
            continue
        their_made, their_attributes = theirs[name]
        assert made <= their_made, name
        assert attributes.keys() <= their_attributes.keys(), name
        assert their_attributes.keys() - attributes.keys() <= REUSED | {"rear_axle"}, name
        for attribute, types in attributes.items():
            known = their_attributes[attribute]
            assert types <= known or "NoneType" in known | types, f"{name}.{attribute}: {types}"


@pytest.mark.skipif(not DEVKIT, reason="NUPLAN_DEVKIT_PYTHON names no Python with nuPlan's devkit")
def test_nuplan_itself_reads_all_of_it(made):
    script = places.REPOSITORY / "tests/devkit_reads.py"
    done = subprocess.run([DEVKIT, script, made.out], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("8 simulation logs") == 3


def test_what_cannot_be_exported_is_said(made, tmp_path):
    with pytest.raises(ConfigError, match="not empty"):
        made.run.export_results(made.out)
    settings = {"store": str(made.folder / "store"), "workers": 1, "limit": 1}
    bare = shiftsim.run("simple", save_rollouts="none", out=str(tmp_path / "bare"), **settings)
    with pytest.raises(DataError, match="holds no rollouts for 1 of 1 tasks"):
        bare.export_results(tmp_path / "bare-out")
    with pytest.raises(DataError, match="store of run 'run' is not at"):
        made.run.export_results(tmp_path / "no-store", store=str(tmp_path / "nowhere"))
    assert list(tmp_path.iterdir()) == [tmp_path / "bare"]


def test_the_command_writes_tables_alone_and_says_where(made, tmp_path):
    done = call(tmp_path, "export", "results", str(made.run.path), "--out", "x", "--tables-only")
    assert done.returncode == 0, done.stderr
    assert "24 scored rollouts" in done.stdout
    assert "experiment: x/closed_loop_nonreactive_agents/ou-high-seed-1" in done.stdout
    [nuboard] = (tmp_path / "x/closed_loop_nonreactive_agents/no-noise").glob("*.nuboard")
    assert "simulation_folder" not in pickle.loads(nuboard.read_bytes())
    assert list(tmp_path.rglob("*.xz")) == []
    again = call(tmp_path, "export", "results", str(made.run.path), "--out", "x")
    assert again.returncode == 1
    assert again.stderr.splitlines()[0] == "error: 'x' is there and not empty"


@pytest.mark.parametrize("tracks", ["recorded", "own", "none"])
def test_what_was_driven_elsewhere_is_exported_as_far_as_it_is_known(made, tmp_path, tracks):
    task, name = Task("idm", "none", 0, LOGGED), "poses.parquet"
    place = made.run.rollout_places[task]
    table = pq.read_table(place.file).slice(place.row, 60)
    kept = ["token", "planner", "time_us", "x_m", "y_m", "heading_rad"]
    boxes = {"track_tokens": [["one"]] * 60, "track_kinds": [[0]] * 60}
    near = {"x_m": 9.0, "y_m": 0.0, "heading_rad": 0.0, "vx_mps": 0.0, "vy_mps": 0.0}
    boxes |= {
        f"track_{n}": [[v]] * 60 for n, v in (near | {"length_m": 4.0, "width_m": 2.0}).items()
    }
    boxes["track_x_m"], boxes["track_y_m"] = (
        [[value + 9.0] for value in table[axis].to_pylist()] for axis in ("x_m", "y_m")
    )
    table = table.select(kept)
    for column, values in boxes.items() if tracks == "own" else ():
        table = table.append_column(column, pa.array(values))
    pq.write_table(table, tmp_path / name)
    settings = {"store": str(made.folder / "store"), "workers": 1, "out": str(tmp_path / "run")}
    settings |= {"tracks": "recorded"} if tracks == "recorded" else {}
    run = shiftsim.score_files(tmp_path / name, partial=True, **settings)
    if tracks == "none":
        with pytest.raises(
            DataError, match=r"others: undefined are no_ego_at_fault_coll"
        ) as caught:
            run.export_results(tmp_path / "out")
        assert "--tracks" in caught.value.hint
        return
    report = run.export_results(tmp_path / "out", workers=1)
    [folder] = report.folders
    traffic = {"recorded": "nonreactive", "own": "elsewhere"}[tracks]
    assert folder.parent.name == f"closed_loop_{traffic}_agents"
    row = pq.read_table(folder / "runner_report.parquet").to_pylist()[0]
    assert row["compute_trajectory_runtimes_mean"] is row["duration"] is None
    report = verify_experiment(
        tmp_path / "out", partial(find, shiftsim.open_store(made.folder / "store"))
    )
    assert (report.mismatches, report.not_covered) == ([], {})
    assert report.quantities["scores score"].cases == 1
