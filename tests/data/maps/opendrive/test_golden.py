"""Real maps: sampled references, self-checks, and references that were tampered with."""

import json
import shutil
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from map_checks import check_map

from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.verify.opendrive import verify_opendrive
from shiftsim.verify.report import Report

SMALL = ("crosswalk_object", "fabriksgatan_traffic_lights", "poly3_and_border_record")


def verify_copy(shared: Path, folder: Path) -> Report:
    """Verify a folder of reference files against the maps."""
    report = Report()
    verify_opendrive(folder, report, shared / "maps")
    return report


@pytest.fixture
def copy(shared: Path, tmp_path: Path) -> Path:
    """Reference files of a few small maps, to tamper with."""
    for path in (shared / "reference" / "opendrive").iterdir():
        if path.name.partition(".")[0] in SMALL:
            shutil.copyfile(path, tmp_path / path.name)
    return tmp_path


@pytest.mark.golden
@pytest.mark.slow
def test_every_reference_of_every_map_is_met(shared: Path):
    report = verify_copy(shared, shared / "reference" / "opendrive")
    assert report.mismatches == []
    assert report.exit_code(require_all=True) == 0


@pytest.mark.golden
def test_small_maps_meet_their_references(shared: Path, copy: Path):
    report = verify_copy(shared, copy)
    assert report.mismatches == []
    assert report.num_cases > 100


@pytest.mark.golden
@pytest.mark.parametrize(
    ("file", "column"),
    [
        ("refline", "s"),
        ("refline", "x"),
        ("refline", "y"),
        ("refline", "hdg"),
        ("lanes", "s"),
        ("lanes", "t_inner"),
        ("lanes", "t_outer"),
        ("lanes", "cx"),
        ("lanes", "cy"),
        ("lanes", "ix"),
        ("lanes", "iy"),
        ("lanes", "ox"),
        ("lanes", "oy"),
        ("lanes", "section"),
        ("lanes", "lane"),
        ("topology", "from_lane"),
        ("topology", "to_section"),
    ],
)
def test_changed_number_turns_the_report_red(shared: Path, copy: Path, file: str, column: str):
    path = copy / f"crosswalk_object.{file}.parquet"
    table = pq.read_table(path)
    values = table.column(column).to_pylist()
    values[1] += 1 if isinstance(values[1], int) else 1e-2
    index = table.column_names.index(column)
    changed = pa.array(values, table.schema.field(column).type)
    pq.write_table(table.set_column(index, column, changed), path)
    assert verify_copy(shared, copy).exit_code() == 1


@pytest.mark.golden
@pytest.mark.parametrize(
    ("file", "column"),
    [
        ("refline", "kind"),
        ("refline", "road"),
        ("lanes", "type"),
        ("lanes", "road"),
        ("topology", "to_type"),
    ],
)
def test_changed_text_turns_the_report_red(shared: Path, copy: Path, file: str, column: str):
    path = copy / f"crosswalk_object.{file}.parquet"
    table = pq.read_table(path)
    index = table.column_names.index(column)
    changed = pc.binary_join_element_wise(table.column(column), pa.scalar("x"), "")
    pq.write_table(table.set_column(index, column, changed), path)
    assert verify_copy(shared, copy).exit_code() == 1


@pytest.mark.golden
def test_any_changed_summary_value_turns_the_report_red(shared: Path, copy: Path):
    path = copy / "fabriksgatan_traffic_lights.summary.json"
    for other in set(copy.iterdir()) - {path}:
        other.unlink()
    original = json.loads(path.read_text())
    path.write_text(json.dumps({key: _other(value) for key, value in original.items()}))
    lines = verify_copy(shared, copy).mismatches
    where = "fabriksgatan_traffic_lights"
    known = (f"summary {{}}: {where}: ", f": {where} {{}}: ")
    seen = [key for key in original for name in known if name.format(key) in " ".join(lines)]
    assert set(seen) == set(original)


def _other(value: object) -> object:
    if isinstance(value, (int, float)):
        return value * 1.01 + 1
    if isinstance(value, dict):
        return value | {"new": 1}
    if isinstance(value, list):
        return [*value[:-1], value[-1] + 1.0 if isinstance(value[-1], float) else "other"]
    return "other"


@pytest.mark.golden
def test_moved_crosswalk_turns_the_report_red(shared: Path, copy: Path):
    path = copy / "crosswalk_object.crosswalks.json"
    rows = json.loads(path.read_text())
    rows[0]["polygon"][2][1] += 1e-4
    path.write_text(json.dumps(rows))
    assert verify_copy(shared, copy).exit_code() == 1


@pytest.mark.golden
def test_unknown_files_columns_and_maps_are_named(shared: Path, copy: Path):
    (copy / "extra.bin").write_bytes(b"")
    shutil.copyfile(copy / "crosswalk_object.summary.json", copy / "nowhere.summary.json")
    path = copy / "crosswalk_object.refline.parquet"
    table = pq.read_table(path)
    pq.write_table(table.append_column("z", table.column("x")), path)
    report = verify_copy(shared, copy)
    assert len(report.not_covered) == 3
    assert report.exit_code(require_all=True) == 3


def test_broken_reference_file_is_a_mismatch(shared: Path, copy: Path):
    (copy / "crosswalk_object.refline.parquet").write_bytes(b"PAR1")
    (copy / "crosswalk_object.summary.json").write_text("{")
    assert len(verify_copy(shared, copy).mismatches) == 2


@pytest.mark.slow
def test_every_map_converts_and_passes_its_self_checks(shared: Path):
    for path in sorted((shared / "maps").rglob("*.xodr")):
        built, report = build_road_map(read_opendrive(path), name=path.stem)
        checks = check_map(built, report.stacked)[0]
        failed = [name for name, passed in checks.items() if not passed]
        empty = path.stem in ("empty_town", "missing_attributes")
        assert failed == (["has lanes"] if empty else []), path.stem
        assert built.flaws == {}, path.stem


@pytest.mark.slow
def test_three_megabytes_of_xml_parse_in_two_seconds(shared: Path):
    path = shared / "maps" / "town03.xodr"
    start = time.process_time()
    read_opendrive(path)
    assert time.process_time() - start < path.stat().st_size / 1.5e6
