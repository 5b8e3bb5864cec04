"""What readers ask of files: forms, types, ranges, sizes; a fault names file and place."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

from shiftsim.data.readers.files import SourceFile, items, vectors
from shiftsim.errors import ConversionError

FORM = {"ids": [int], "speed": (float,), "any": {str: bool}}


class Casting(SourceFile):
    """Columns of other types are cast."""

    casts = True
    remedy = "try again"


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"ids": [1, 2], "speed": 1, "any": {}}, ""),
        ({"ids": [], "speed": None, "any": {"x": True}, "more": 1}, ""),
        ({"ids": [1], "any": {}}, ""),
        ({"speed": 1.0, "any": {}}, "here: 'ids' is missing"),
        ({"ids": [1, 2.0], "any": {}}, "here: 'ids', item 1 is '2.0', need an integer"),
        ({"ids": [True], "any": {}}, "item 0 is 'True', need an integer"),
        ({"ids": [1], "speed": "1", "any": {}}, "'speed' is '1', need a number"),
        ({"ids": [1], "any": {"x": 1}}, "here: 'any': 'x' is '1', need true or false"),
        ({"ids": {}, "any": {}}, "need a list"),
        ([], "here is '\\[\\]', need a map"),
        (None, "here is missing"),
    ],
)
def test_forms_of_json(value, words):
    file = SourceFile("scene.json")
    if not words:
        assert file.unpack(b"x", lambda _: value, FORM, "here") == value
        return
    with pytest.raises(ConversionError, match=f"scene.json: .*{words}"):
        file.unpack(b"x", lambda _: value, FORM, "here")


def test_what_cannot_be_unpacked_or_known():
    file = SourceFile("scene.json")

    def broken(data):
        raise ValueError(f"no {data!r}")

    with pytest.raises(ConversionError, match=r"here cannot be unpacked \(no b'x'\)"):
        file.unpack(b"x", broken, FORM, "here")
    with pytest.raises(ConversionError, match="here is missing"):
        file.unpack(None, broken, FORM, "here")
    assert file.known("a", ["a", "b"], "kind") == "a"
    with pytest.raises(ConversionError, match="kind 'c' is unknown") as error:
        file.known("c", ["a", "b"], "kind")
    assert error.value.hint == "known are: a, b"


@pytest.mark.parametrize(
    ("points", "line"),
    [
        ([[0, 0], [1, 0], [1, 0], [2, 0]], [[0, 0], [1, 0], [2, 0]]),
        ([{"x": 0, "y": 1, "z": 9}, {"x": 3, "y": 1, "z": 9}], [[0, 1], [3, 1]]),
        ([[0, 0, 7], [4, 0, 7]], [[0, 0], [4, 0]]),
        (np.array([[0.0, 0.0], [4.0, 0.0]]), [[0, 0], [4, 0]]),
    ],
)
def test_lines_without_repeated_points(points, line):
    assert SourceFile("f").line(points, "border").tolist() == line


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([], "border has 0 points that differ, need 2"),
        ([[0, 0], [0, 0]], "border has 1 points that differ, need 2"),
        ([[0], [1]], r"no line of points \(shape \(2, 1\)\)"),
        ([0, 1], r"no line of points \(shape \(2,\)\)"),
        ([[0, 0], [1]], "no line of points"),
        ([[0, 0], [float("nan"), 0]], "not a finite number"),
    ],
)
def test_faults_of_lines(points, words):
    with pytest.raises(ConversionError, match=words):
        SourceFile("f").line(points, "border")


def test_areas_are_the_largest_valid_part():
    file = SourceFile("f")
    bow = [[0, 0], [4, 4], [4, 0], [0, 6]]
    assert file.ring(bow, "area").is_valid
    assert file.ring([[0, 0], [4, 0], [4, 2]], "area").area == 4.0
    with pytest.raises(ConversionError, match="area has 2 points that differ, need 3"):
        file.ring([[0, 0], [4, 0]], "area")
    box = shapely.force_3d(shapely.box(0, 0, 3, 2))
    found = file.area(shapely.to_wkb(box), "area")
    assert (found.area, found.has_z) == (6.0, False)
    for shape in (shapely.Point(0, 0), shapely.Polygon()):
        with pytest.raises(ConversionError, match="area is no polygon"):
            file.area(shapely.to_wkb(shape), "area")
    with pytest.raises(ConversionError, match="area is no polygon"):
        file.area(b"x", "area")


@pytest.mark.parametrize(("value", "number"), [("1.5", 1.5), (2, 2.0), (None, None), ("x", None)])
def test_numbers_and_texts_that_are_numbers(value, number):
    if number is not None:
        assert SourceFile("f").number(value, "position", "x") == number
        return
    with pytest.raises(ConversionError, match=f"x is {value!r}, need a number"):
        SourceFile("f").number(value, "position", "x")


def test_sizes_of_files(tmp_path):
    path = tmp_path / "f"
    with pytest.raises(ConversionError, match="f is missing") as error:
        SourceFile(path).content()
    assert error.value.hint == "copy all files of the scene"
    path.write_bytes(b"12345")
    assert SourceFile(path).content(5) == b"12345"
    with pytest.raises(ConversionError, match="more than 4 bytes") as error:
        SourceFile(path).content(4)
    assert error.value.hint == "split the recording"
    with pytest.raises(ConversionError, match="cannot be read"):
        SourceFile(tmp_path).content()


@pytest.mark.parametrize(
    ("count", "is_good"), [(0, False), (1, True), (8_000_000, True), (8_000_001, False)]
)
def test_from_one_row_to_eight_million(count, is_good):
    file = SourceFile("f")
    if is_good:
        file._require_rows(count)
        return
    with pytest.raises(ConversionError, match=f"f: {count} rows, need 1 to 8000000") as error:
        file._require_rows(count)
    assert error.value.hint == ("split the recording" if count else SourceFile.remedy)


WANTED = {
    "x": pa.float64(),
    "name": pa.dictionary(pa.int32(), pa.string()),
    "way": items(pa.int64()),
}


def table(**changed):
    columns = {
        "x": pa.array([1.0, 2.0]),
        "name": pa.array(["a", "b"]).dictionary_encode(),
        "way": pa.array([[1], [2, 3]]),
        "unused": pa.array([None, None]),
    }
    kept = {name: array for name, array in {**columns, **changed}.items() if array is not None}
    return pa.table(kept)


@pytest.mark.parametrize("suffix", [".parquet", ".arrow"])
@pytest.mark.parametrize(
    ("changed", "plain", "cast"),
    [
        ({}, "", ""),
        ({"x": None}, "", ""),  # may be missing
        ({"way": None}, "column 'way' is missing", "column 'way' is missing"),
        ({"x": pa.array([1, 2])}, "column 'x' is int64, need double", ""),
        ({"x": pa.array(["1", "y"])}, "'x' is string", "'x' is string, need double"),
        ({"x": pa.array([1.0, None])}, "'x' holds 1 nulls", "'x' holds 1 nulls"),
        ({"way": pa.array([[1], [None, 3]])}, "'way' holds 1 nulls", "'way'"),
        ({"way": pa.array([[1], None])}, "'way' holds 1 nulls", "'way'"),
    ],
)
def test_columns_are_of_their_type(changed, plain, cast, suffix, tmp_path):
    path = tmp_path / f"f{suffix}"
    written = table(**changed)
    if suffix == ".parquet":
        pq.write_table(written, path)
    else:
        with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, written.schema) as writer:
            writer.write_table(written)
    for kind, words in ((SourceFile, plain), (Casting, cast)):
        if words:
            with pytest.raises(ConversionError, match=words) as error:
                kind(path).columns(WANTED, optional=["x"])
            assert error.value.hint == kind.remedy
            continue
        found = kind(path).columns(WANTED, optional=["x"])
        assert found.column_names == [name for name in WANTED if changed.get(name, name)]
        if "x" in found.column_names:
            assert kind(path).numbers(found, "x", "position").tolist() == [1.0, 2.0]
        rows, parts = kind(path).lists(found.select(["way"]))
        assert (rows.tolist(), parts[0].to_pylist()) == ([0, 1, 1], [1, 2, 3])


def test_lists_that_belong_together_are_equally_long():
    one, other = pa.array([[1], [2, 3]]), pa.array([[1, 2], [3]])
    with pytest.raises(ConversionError, match="lists of 'b' have lengths of their own"):
        SourceFile("f").lists(pa.table({"a": one, "b": other}))
    found = vectors(pa.array([[1.0, 2.0, 3.0], None], items(pa.float64(), 3)), 2)
    np.testing.assert_array_equal(found, [[1.0, 2.0], [np.nan, np.nan]])


def test_errors_inside_name_the_file_once():
    file = SourceFile("f.csv")
    with pytest.raises(ConversionError, match=r"^f\.csv: broken") as error, file.naming():
        raise ConversionError("broken", "mend it")
    assert error.value.hint == "mend it"
    with pytest.raises(ConversionError, match=r"^f\.csv is broken"), file.naming():
        raise ConversionError("f.csv is broken")
    file.require_that(1, "no fault")
    with pytest.raises(ConversionError, match=r"f\.csv: a fault") as error:
        file.require_that(0, "a fault")
    assert error.value.hint == SourceFile.remedy
