"""What the geoReference of a file means."""

from collections import Counter

import pytest
from opendrive_xml import document

from shiftsim.data.opendrive.crs import coordinate_system
from shiftsim.data.opendrive.reading import parse_opendrive
from shiftsim.data.opendrive.records import OpenDrive


def file_with(reference: str) -> OpenDrive:
    """A file with this geoReference."""
    header = f"<header><geoReference><![CDATA[{reference}]]></geoReference></header>"
    return parse_opendrive(document(header=header), "a.xodr")


@pytest.mark.parametrize("text", ["epsg:25833", "+proj=utm +zone=33 +ellps=GRS80 +units=m"])
def test_projection_and_code_are_understood(text: str):
    warnings: Counter[str] = Counter()
    crs = coordinate_system(file_with(text), warnings)
    assert crs.is_projected
    assert warnings == {}


def test_origin_alone_is_taken_as_transverse_mercator():
    warnings: Counter[str] = Counter()
    crs = coordinate_system(file_with("+lat_0=4.9e+1 +lon_0=8.0e+0"), warnings)
    assert crs.coordinate_operation.method_name == "Transverse Mercator"
    assert sum(warnings.values()) == 1


@pytest.mark.parametrize("text", ["", "somewhere", "+lat_0=4.9e+1"])
def test_anything_else_is_a_local_frame(text: str):
    assert coordinate_system(file_with(text), Counter()) is None
