"""Real maps: self-checks of what is converted, and how fast their XML is read."""

import time
from pathlib import Path

import pytest
from map_checks import check_map

from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive


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
