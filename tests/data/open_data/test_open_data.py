"""A town of the demo, written as the files of open data sets, and converted back."""

import json
import os
import subprocess
from pathlib import Path

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import call
from open_data_files import (
    LABELS,
    START_US,
    demo_content,
    demo_map,
    lit_lane,
    write_av2,
    write_commonroad,
    write_py123d,
)

from shiftsim.data.open_data.av2 import Av2Reader
from shiftsim.data.open_data.commonroad import CommonRoadReader
from shiftsim.data.open_data.py123d import Py123dReader
from shiftsim.data.open_data.scenes import convert_scene, convert_scenes
from shiftsim.data.opendrive.check import check_map
from shiftsim.data.store.check import check_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConversionError, DataError
from shiftsim.world.state import center_poses

WRITERS = {
    "av2": (Av2Reader, write_av2),
    "commonroad": (CommonRoadReader, write_commonroad),
    "commonroad-2018b": (CommonRoadReader, lambda folder: write_commonroad(folder, "2018b")),
    "py123d": (Py123dReader, write_py123d),
}
COMMANDS = ("av2", "commonroad", "py123d")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """By data set: the scene of a town."""
    out = {}
    for name, (reader, write) in WRITERS.items():
        path = write(tmp_path_factory.mktemp(name))
        out[name] = reader().read(path)
    return out


@pytest.mark.parametrize("name", WRITERS)
def test_the_map_of_a_town_comes_back(scenes, name):
    road, before = scenes[name].map.road, demo_map()
    assert all(check_map(road, set())[0].values())
    for layer in ("edges", "blocks", "intersections"):
        assert len(getattr(road, layer)) == len(getattr(before, layer)), layer
    assert (road.num_lanes, road.num_roadblocks) == (before.num_lanes, before.num_roadblocks)
    if name != "commonroad":  # whose signs say something else
        ends = [before.edges.index[ids[0]] for ids in scenes[name].map.origins.values()]
        expected = before.speed_limits[ends] if name != "av2" else np.full(len(ends), np.nan)
        np.testing.assert_array_equal(road.speed_limits, expected)
    for edge, (first, *_) in zip(road.edges.ids, scenes[name].map.origins.values(), strict=True):
        new, old = road.edge(edge), before.edge(first)
        assert road.is_connector(new) == before.is_connector(old)
        ends = road.baselines.at(new)[[0, -1]]
        np.testing.assert_allclose(ends, before.baselines.at(old)[[0, -1]], atol=0.2)


@pytest.mark.parametrize("name", ["av2", "py123d"])
def test_the_recording_car_is_the_ego_and_drives_as_recorded(scenes, name):
    made = convert_scene(scenes[name]).converted
    (window,) = made.windows
    assert window.ego == {"av2": "AV", "py123d": "ego"}[name]
    rows = np.array(demo_content()["ego"]["rows"])
    states = made.egos[0].states[: 2 * len(rows) - 1 : 2]
    centers = center_poses(states[:, :3])[:, :2]
    np.testing.assert_allclose(centers, rows[: len(states), 1:3], atol=2e-3)
    np.testing.assert_allclose(states[5:-5, 3], rows[5 : len(states) - 5, 4], atol=0.3)
    assert window.iteration_rows[0] == 40  # 2 s of history
    assert len(window.route) >= 3


def test_argoverse_leaves_out_the_squeezed_end_of_its_tracks(scenes):
    (window,) = convert_scene(scenes["av2"]).converted.windows
    assert (window.last_row, len(window.iteration_rows), window.is_short) == (209, 85, True)
    assert window.metadata["duration_class"] == "8 s"
    assert window.metadata["licence"] == "CC BY-NC-SA 4.0"
    assert window.metadata["sizes"] == "by type"


@pytest.mark.parametrize("name", ["av2", "py123d"])
def test_with_vehicles_every_car_that_drives_is_an_ego(scenes, name):
    egos = {window.ego for window in convert_scene(scenes[name], vehicles=True).converted.windows}
    cars = {w.ego for w in convert_scene(scenes["commonroad"]).converted.windows}
    assert len(egos) == len(cars) > 3


def test_lights_of_py123d_are_those_of_the_connector_of_their_lane(scenes):
    scene = scenes["py123d"]
    lights = convert_scene(scene).converted.recording.lights
    (connector,) = lights.connector_ids
    assert scene.map.origins[connector] == (str(lit_lane(demo_content())),)
    assert lights.status[:, 0].tolist() == [2] * 60 + [0] * (len(lights.status) - 60)


def test_lights_of_commonroad_govern_what_leaves_their_lanelet(scenes):
    scene = scenes["commonroad"]
    road = scene.map.road
    lights = convert_scene(scene).converted.recording.lights
    assert len(lights.connector_ids) >= 2
    sources = {int(road.incoming.at(road.edge(i))[0]) for i in lights.connector_ids}
    assert len(sources) == 1
    # green for 30 steps, red for 50, begun 10 steps late: red, then green from step 10 to 40
    expected = [2] * 20 + [0] * 60 + [2] * 100 + [0] * (len(lights.status) - 180)
    assert lights.status[:, 0].tolist() == expected
    assert [len(road.stop_lines.at(road.edge(i))) for i in lights.connector_ids] == [1] * len(
        lights.connector_ids
    )
    assert set(road.speed_limits.tolist()) == {8.5}  # of the sign


@pytest.mark.slow
def test_a_store_of_all_three_is_sound_and_goes_on_where_it_stopped(tmp_path):
    for name in COMMANDS:
        reader, write = WRITERS[name]
        write(tmp_path / name)
        report = convert_scenes(reader(), tmp_path / name, tmp_path / "store")
        assert (report.scenes, report.failed) == (1, {})
        again = convert_scenes(reader(), tmp_path / name, tmp_path / "store")
        assert (again.scenes, again.kept) == (0, 1)
    assert not [problem for problem in check_store(tmp_path / "store") if problem.is_error]
    classes = {scene.duration_class for scene in ScenarioStore(tmp_path / "store")}
    assert classes == {"8 s"}


def test_a_broken_scene_is_skipped_and_named(tmp_path):
    write_av2(tmp_path / "good")
    bad = write_av2(tmp_path / "bad", "00000000-0000-0000-0000-00000000000b")
    bad.write_bytes(b"nonsense")
    report = convert_scenes(Av2Reader(), tmp_path, tmp_path / "store")
    assert (report.scenes, list(report.failed)) == (1, [str(bad)])
    assert "cannot be read" in report.failed[str(bad)]


def test_a_log_that_does_not_say_where_its_map_is_is_skipped_and_named(tmp_path):
    write_py123d(tmp_path / "good")
    bad = write_py123d(tmp_path / "bad")
    (bad / "sync.arrow").write_bytes(b"nonsense")
    report = convert_scenes(Py123dReader(), tmp_path, tmp_path / "store")
    assert (report.scenes, list(report.failed)) == (1, [str(bad)])
    assert "sync.arrow: cannot be read" in report.failed[str(bad)]


@pytest.mark.slow
def test_the_command_converts_and_says_what_comes_next(tmp_path):
    write_commonroad(tmp_path / "files")
    done = call(tmp_path, "convert", "commonroad", "files", "--store", "./s", "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert "1 scene converted" in done.stdout
    assert "next: shiftsim filter" in done.stdout


# --- faults: one error that names file, field and remedy


def changed_table(path, change):
    pq.write_table(change(pq.read_table(path)), path)


def without(name):
    return lambda table: table.drop_columns([name])


def as_type(name, kind):
    def change(table):
        index = table.schema.get_field_index(name)
        return table.set_column(index, name, table[name].cast(kind))

    return change


def with_value(name, value):
    def change(table):
        column = pa.array([value, *table[name].to_pylist()[1:]], table.schema.field(name).type)
        return table.set_column(table.schema.get_field_index(name), name, column)

    return change


AV2_FAULTS = {
    "column 'heading' is missing": without("heading"),
    "column 'timestep' is double, need int64": as_type("timestep", pa.float64()),
    "holds the observed 5 s only": lambda table: table.filter(table["observed"]),
    "column 'heading' is there 2 times": lambda t: t.append_column("heading", t["heading"]),
    "object_type 'tank' is unknown": with_value("object_type", "tank"),
    "0 rows at one time": lambda table: table.set_column(
        table.schema.get_field_index("object_type"),
        "object_type",
        pa.array(["background"] * len(table)),
    ),
    "'position', row 0: nan is not a finite number": with_value("position_x", float("nan")),
}


@pytest.mark.parametrize("message", AV2_FAULTS)
def test_a_fault_of_argoverse_is_named(tmp_path, message):
    path = write_av2(tmp_path)
    changed_table(path, AV2_FAULTS[message])
    refused(Av2Reader(), path, path, message)


AV2_MAP_FAULTS = {
    "map 'av2-.*' has no lane": lambda found: found["lane_segments"].clear(),
    "'drivable_areas' is missing": lambda found: found.pop("drivable_areas"),
    "'left_lane_boundary' has 0 points": lambda found: first(found)["left_lane_boundary"].clear(),
    "'centerline' is '3', need a list": lambda found: first(found).update(centerline=3),
    "'successors', item 0 is 'x', need an integer": lambda found: first(found).update(
        successors=["x"]
    ),
    "its 'extent': 3000...": lambda found: first(found)["centerline"][0].update(x=3e6),
    "its 'extent': 5000...": lambda found: next(iter(found["pedestrian_crossings"].values()))[
        "edge1"
    ][0].update(y=5e6),
    "item 0: 'x' is missing": lambda found: first(found)["left_lane_boundary"][0].pop("x"),
    "'is_intersection' is 'yes', need true or false": lambda found: first(found).update(
        is_intersection="yes"
    ),
}


def first(found):
    return next(iter(found["lane_segments"].values()))


@pytest.mark.parametrize("message", AV2_MAP_FAULTS)
def test_a_fault_of_a_map_of_argoverse_is_named(tmp_path, message):
    path = write_av2(tmp_path)
    (map_path,) = tmp_path.glob("*.json")
    found = json.loads(map_path.read_text())
    AV2_MAP_FAULTS[message](found)
    map_path.write_text(json.dumps(found))
    refused(Av2Reader(), path, map_path, message)


def test_an_obstacle_that_is_no_rectangle_is_left_out_and_counted(tmp_path):
    path = write_commonroad(tmp_path)
    text = path.read_text()
    box = text[text.index("<rectangle>") : text.index("</rectangle>") + 12]
    path.write_text(text.replace(box, "<circle><radius>1</radius></circle>", 1))
    scene = CommonRoadReader().read(path)
    assert scene.warnings["obstacle that is no rectangle, left out"] == 1
    assert len(scene.samples.track_ids) == len(demo_content()["tracks"])


def test_two_rows_of_one_object_at_one_time_are_refused(tmp_path):
    path = write_av2(tmp_path)
    changed_table(path, lambda table: pa.concat_tables([table, table.slice(0, 1)]))
    refused(Av2Reader(), path, path, "object 'AV' has two rows")


def test_a_time_years_away_is_an_error_and_takes_no_memory(tmp_path):
    path = write_av2(tmp_path)
    changed_table(path, with_value("timestep", 10**8))
    refused(Av2Reader(), path, path, r"none between 10.9 s and 1e\+07 s")
    log = write_py123d(tmp_path)
    name = f"{BOXES}.timestamp_us"
    changed_arrow(log / f"{BOXES}.arrow", with_value(name, START_US - 4_000_000_000))
    refused(Py123dReader(), log, log, "none between 0 s and 4000 s")


XML_FAULTS = {
    "has a DOCTYPE": ("<commonRoad", '<!DOCTYPE c [<!ENTITY a "b">]><commonRoad'),
    "commonRoadVersion '2017a' is unknown": ('Version="2020a"', 'Version="2017a"'),
    "'timeStepSize' is None, need a number": (' timeStepSize="0.1"', ""),
    "lanelet '.*': 'leftBound': 'x' as 'position': 1e\\+30": ("<x>", "<x>1e30</x><x>"),
    "need a number": ("<exact>", "<exact>fast</exact><exact>"),
    "not well-formed": ("</commonRoad>", ""),
}


@pytest.mark.parametrize("message", XML_FAULTS)
def test_a_fault_of_commonroad_is_named(tmp_path, message):
    path = write_commonroad(tmp_path)
    old, new = XML_FAULTS[message]
    path.write_text(path.read_text().replace(old, new, 1))
    refused(CommonRoadReader(), path, path, message)


def changed_arrow(path, change):
    with pa.OSFile(str(path)) as source:
        table = pa.ipc.open_file(source).read_all()
    table = change(table)
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)


BOXES = "box_detections_se3"


def with_line(value):
    """Another left border of the first lane of a map."""

    def change(table):
        first, *others = table["features"].to_pylist()
        shown = None
        if isinstance(value, np.ndarray):
            shown = {b"dtype": value.dtype.str, b"shape": value.shape, b"data": value.tobytes()}
        new = {"left_boundary": shown | {b"__ndarray__": True} if shown else value}
        first = msgpack.packb(msgpack.unpackb(first, strict_map_key=False) | new)
        return table.set_column(2, "features", pa.array([first, *others], pa.binary()))

    return change


ARROW_FAULTS = {
    "column 'box_detections_se3.label' is missing": (BOXES, without(f"{BOXES}.label")),
    "'box_detections_se3.label' is list": (
        BOXES,
        as_type(f"{BOXES}.label", pa.list_(pa.int64())),
    ),
    "NuPlanBoxDetectionLabel: label 9 is unknown": (
        BOXES,
        lambda table: table.set_column(
            3,
            f"{BOXES}.label",
            pa.array([[9] * len(r) for r in table[3].to_pylist()], table[3].type),
        ),
    ),
    "column 'box_detections_se3.label' is there 2 times": (
        BOXES,
        lambda table: table.append_column(f"{BOXES}.label", table[f"{BOXES}.label"]),
    ),
    "lane '1': its id occurs twice": ("map", lambda t: pa.concat_tables([t, t[:1]])),
    "'metadata' is missing": (BOXES, lambda table: table.replace_schema_metadata(None)),
    "cannot be unpacked": ("map", with_value("features", b"\xc1")),
    "lane 1: 'left_boundary' is 'x', need an array": ("map", with_line("x")),
    r"no line of points \(shape \(9,\)\)": ("map", with_line(np.arange(9.0))),
    r"no line of points \(shape \(5, 1\)\)": ("map", with_line(np.ones((5, 1)))),
    r"no line of points \(shape \(\)\)": ("map", with_line(np.array(5.0))),
    "has 0 points that differ": ("map", with_line(np.ones((0, 3)))),
    "has 1 points that differ": ("map", with_line(np.ones((4, 3)))),
    "an array of '<i8'": ("map", with_line(np.ones((5, 3), np.int64))),
    "lane 1: 'left_boundary' is missing": ("map", with_value("features", b"\x80")),
}


# --- any column, whatever is wrong with it


def changed_file(path, change):
    (changed_arrow if path.suffix == ".arrow" else changed_table)(path, change)


def with_nulls(column, rows, depth):
    """Nulls in the first rows of a column, in its lists, or in the items of these."""

    def blank(value, depth):
        return [blank(value[0], depth - 1), *value[1:]] if depth else None

    def change(table):
        values = table[column].to_pylist()
        values[:rows] = [blank(value, depth) for value in values[:rows]]
        at = table.schema.get_field_index(column)
        return table.set_column(at, column, pa.array(values, table.schema.field(column).type))

    return change


def of_other_type(name):
    def change(table):
        at = table.schema.get_field_index(name)
        kind = pa.int8() if table.schema.field(name).type == pa.bool_() else pa.bool_()
        return table.set_column(at, name, pa.nulls(len(table), kind))

    return change


def columns_of(path):
    with pa.OSFile(str(path)) as source:
        is_arrow = path.suffix == ".arrow"
        return list(pa.ipc.open_file(source).schema if is_arrow else pq.read_schema(source))


def levels_of(kind):
    """How many levels of lists a type has, its values included."""
    lists = pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)
    return 1 + levels_of(kind.value_type) if lists else 1


NOT_READ = {
    *("object_category", "scenario_id", "end_timestamp", "num_timestamps", "focal_track_id"),
    "ego_state_se3.dynamic_state_se3",
}
VELOCITY = "box_detections_se3.velocity_3d"


@pytest.mark.parametrize("name", ["av2", "py123d"])
def test_nulls_and_columns_of_another_type_are_named(tmp_path, name):
    reader, write = WRITERS[name]
    scene = write(tmp_path)
    files = [scene] if name == "av2" else sorted(scene.glob("[bemt]*.arrow"))
    damages = [
        (path, field.name.rpartition(".")[2], change, message)
        for path in files
        for field in columns_of(path)
        if field.name not in NOT_READ
        for change, message in [
            (with_nulls(field.name, 10**6, 0), "holds .* nulls"),
            *(
                (with_nulls(field.name, 1, depth), "holds .* nulls")
                for depth in range(levels_of(field.type))
                if (field.name, depth) != (VELOCITY, 1)
            ),
            (of_other_type(field.name), "is (bool|int8), need"),
            (without(field.name), "is missing"),
        ]
    ]
    assert len(damages) > 40
    for path, column, change, message in damages:
        sound = path.read_bytes()
        changed_file(path, change)
        refused(reader(), scene, path, f"{column}' {message}")
        path.write_bytes(sound)


@pytest.mark.parametrize("name", ["av2", "py123d"])
def test_a_file_without_rows_is_named(tmp_path, name):
    reader, write = WRITERS[name]
    scene = write(tmp_path)
    for path in [scene] if name == "av2" else sorted(scene.glob("[bemt]*.arrow")):
        sound = path.read_bytes()
        changed_file(path, lambda table: table[:0])
        refused(reader(), scene, path, "0 rows")
        path.write_bytes(sound)


def test_a_velocity_may_be_null(tmp_path):
    log = write_py123d(tmp_path)
    changed_arrow(log / f"{BOXES}.arrow", with_nulls(VELOCITY, 1, 1))
    assert len(Py123dReader().read(log).samples.track_ids) == len(demo_content()["tracks"]) + 1


NOTES_FAULTS = {
    "'map_metadata' is 'x', need a map": ("sync", {"map_metadata": "x"}),
    "'dataset' is missing": ("sync", {"dataset": None}),
    "'split' is '3', need a text": ("sync", {"split": 3}),
    "'length' is 'long', need a number": ("ego_state_se3", {"length": "long"}),
    "box as 'size', row 0: -1 is beyond": ("ego_state_se3", {"length": -1}),
    "box as 'position', row 0: 1e\\+30": (
        "ego_state_se3",
        {"center_to_imu_se3": [1e30, *[0.0] * 6]},
    ),
    "'center_to_imu_se3' has 6 numbers": ("ego_state_se3", {"center_to_imu_se3": [0.0] * 6}),
    "'center_to_imu_se3', item 0 is 'x'": ("ego_state_se3", {"center_to_imu_se3": ["x"] * 7}),
    "'box_detection_label_class' is '5'": (BOXES, {"box_detection_label_class": 5}),
}


@pytest.mark.parametrize("message", NOTES_FAULTS)
def test_metadata_of_another_form_are_named(tmp_path, message):
    log = write_py123d(tmp_path)
    name, new = NOTES_FAULTS[message]
    path = log / f"{name}.arrow"

    def change(table):
        notes = msgpack.unpackb(table.schema.metadata[b"metadata"]) | new
        return table.replace_schema_metadata({b"metadata": msgpack.packb(notes)})

    changed_arrow(path, change)
    refused(Py123dReader(), log, path, message)


@pytest.mark.parametrize("name", [f"{BOXES}.label", "traffic_light_detections.status"])
def test_lists_of_one_row_that_differ_in_length_are_named(tmp_path, name):
    log = write_py123d(tmp_path)
    path = log / f"{name.partition('.')[0]}.arrow"
    changed_arrow(path, with_value(name, []))
    refused(Py123dReader(), log, path, "have lengths of their own")


@pytest.mark.parametrize("message", ARROW_FAULTS)
def test_a_fault_of_py123d_is_named(tmp_path, message):
    log = write_py123d(tmp_path)
    name, change = ARROW_FAULTS[message]
    changed_arrow(log / f"{name}.arrow", change)
    refused(Py123dReader(), log, log / f"{name}.arrow", message)


def test_a_test_split_of_waymo_is_refused(tmp_path):
    refused(Py123dReader(), write_py123d(tmp_path, "wod-motion_test"), "log-1", "hides the future")


def test_labels_of_an_unknown_class_are_refused(tmp_path):
    log = write_py123d(tmp_path, labels="MyLabel")
    refused(Py123dReader(), log, BOXES, "label class 'MyLabel' is unknown")


def refused(reader, path, named, message):
    with pytest.raises(DataError, match=message) as error:
        reader.read(path)
    assert str(named) in str(error.value)
    assert error.value.hint


def test_a_folder_without_scenes_is_refused(tmp_path):
    for name in COMMANDS:
        with pytest.raises(ConversionError, match=str(tmp_path)):
            WRITERS[name][0]().find(tmp_path)


# --- the map of a city that several logs share


def test_logs_of_a_city_share_its_map(tmp_path):
    log = write_py123d(tmp_path)
    shared = tmp_path / "maps/demo/demo_here.arrow"
    shared.parent.mkdir(parents=True)
    (log / "map.arrow").rename(shared)
    scene = Py123dReader().read(log)
    assert scene.map.road.name == "demo-here"
    assert shared in Py123dReader().files(log)


# --- py123d itself


@pytest.mark.slow
def test_a_folder_that_py123d_wrote_is_read_as_ours(tmp_path, scenes):
    python = os.environ.get("SHIFTSIM_PY123D_PYTHON")
    if not python:
        pytest.skip("needs SHIFTSIM_PY123D_PYTHON, a Python with py123d 0.7.0")
    content = demo_content()
    notes = {"labels": LABELS, "lit_lane": lit_lane(content), "start_us": START_US}
    (tmp_path / "content.json").write_text(json.dumps(content | notes))
    script = Path(__file__).with_name("write_py123d.py")
    command = [python, script, tmp_path / "content.json", tmp_path]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    subprocess.run(command, check=True, capture_output=True, env=environment)
    report = convert_scenes(Py123dReader(), tmp_path, tmp_path / "store")
    assert (report.scenarios, report.failed) == (1, {})
    (found,) = ScenarioStore(tmp_path / "store")
    expected = convert_scene(scenes["py123d"]).converted
    np.testing.assert_allclose(found.ego, expected.egos[0].states, atol=1e-9)
    assert len(found.route) == len(expected.windows[0].route)
    assert found.traffic_lights.status.tolist() == expected.recording.lights.status.tolist()
    assert found.tracks.num_tracks == expected.recording.tracks.num_tracks - 1
    assert len(found.map.edges) == len(scenes["py123d"].map.road.edges)
