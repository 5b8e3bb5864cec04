"""Files of open data sets with a fault: one error that names file, field and remedy."""

import json

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from open_data_files import (
    START_US,
    WRITERS,
    demo_content,
    write_av2,
    write_commonroad,
    write_py123d,
)

from shiftsim.data.readers.av2 import Av2Reader
from shiftsim.data.readers.commonroad import CommonRoadReader
from shiftsim.data.readers.py123d import Py123dReader
from shiftsim.errors import DataError


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
    refused(Av2Reader(tmp_path), path, path, message)


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
    refused(Av2Reader(tmp_path), path, map_path, message)


def test_an_obstacle_that_is_no_rectangle_is_left_out_and_counted(tmp_path):
    path = write_commonroad(tmp_path)
    text = path.read_text()
    box = text[text.index("<rectangle>") : text.index("</rectangle>") + 12]
    path.write_text(text.replace(box, "<circle><radius>1</radius></circle>", 1))
    scene = CommonRoadReader(tmp_path).read(path)
    assert scene.warnings["obstacle that is no rectangle, left out"] == 1
    assert len(scene.samples.track_ids) == len(demo_content()["tracks"])


def test_two_rows_of_one_object_at_one_time_are_refused(tmp_path):
    path = write_av2(tmp_path)
    changed_table(path, lambda table: pa.concat_tables([table, table.slice(0, 1)]))
    refused(Av2Reader(tmp_path), path, path, "object 'AV' has two rows")


def test_a_time_years_away_is_an_error_and_takes_no_memory(tmp_path):
    path = write_av2(tmp_path)
    changed_table(path, with_value("timestep", 10**8))
    refused(Av2Reader(tmp_path), path, path, r"row between 10.9 s and 1e\+07 s")
    log = write_py123d(tmp_path)
    name = f"{BOXES}.timestamp_us"
    changed_arrow(log / f"{BOXES}.arrow", with_value(name, START_US - 4_000_000_000))
    refused(Py123dReader(tmp_path), log, log, "row between 0 s and 4000 s")


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
    refused(CommonRoadReader(tmp_path), path, path, message)


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
        refused(reader(tmp_path), scene, path, f"{column}' {message}")
        path.write_bytes(sound)


@pytest.mark.parametrize("name", ["av2", "py123d"])
def test_a_file_without_rows_is_named(tmp_path, name):
    reader, write = WRITERS[name]
    scene = write(tmp_path)
    for path in [scene] if name == "av2" else sorted(scene.glob("[bemt]*.arrow")):
        sound = path.read_bytes()
        changed_file(path, lambda table: table[:0])
        refused(reader(tmp_path), scene, path, "0 rows")
        path.write_bytes(sound)


def test_a_velocity_may_be_null(tmp_path):
    log = write_py123d(tmp_path)
    changed_arrow(log / f"{BOXES}.arrow", with_nulls(VELOCITY, 1, 1))
    assert (
        len(Py123dReader(tmp_path).read(log).samples.track_ids) == len(demo_content()["tracks"]) + 1
    )


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
    refused(Py123dReader(tmp_path), log, path, message)


@pytest.mark.parametrize("name", [f"{BOXES}.label", "traffic_light_detections.status"])
def test_lists_of_one_row_that_differ_in_length_are_named(tmp_path, name):
    log = write_py123d(tmp_path)
    path = log / f"{name.partition('.')[0]}.arrow"
    changed_arrow(path, with_value(name, []))
    refused(Py123dReader(tmp_path), log, path, "have lengths of their own")


@pytest.mark.parametrize("message", ARROW_FAULTS)
def test_a_fault_of_py123d_is_named(tmp_path, message):
    log = write_py123d(tmp_path)
    name, change = ARROW_FAULTS[message]
    changed_arrow(log / f"{name}.arrow", change)
    refused(Py123dReader(tmp_path), log, log / f"{name}.arrow", message)


def test_a_test_split_of_waymo_is_refused(tmp_path):
    refused(
        Py123dReader(tmp_path),
        write_py123d(tmp_path, "wod-motion_test"),
        "log-1",
        "hides the future",
    )


def test_labels_of_an_unknown_class_are_refused(tmp_path):
    log = write_py123d(tmp_path, labels="MyLabel")
    refused(Py123dReader(tmp_path), log, BOXES, "label class 'MyLabel' is unknown")


def refused(reader, path, named, message):
    with pytest.raises(DataError, match=message) as error:
        reader.read(path)
    assert str(named) in str(error.value)
    assert error.value.hint
