"""What is done to the records of a file before a map is made of them."""

from collections import Counter
from dataclasses import replace

import numpy as np

from shiftsim.data.maps.opendrive import records
from shiftsim.data.maps.opendrive.curves import ReferenceLine, length_error
from shiftsim.data.maps.opendrive.lanes import border_is_mirrored
from shiftsim.errors import MapError
from shiftsim.world.ranges import MAP_EXTENT, require

GAP_NOTED, GAP_SERIOUS = 0.01, 0.5  # m
MAX_LENGTH_ERROR = 3.0  # as a share; a cubic that far from its stated length is nonsense
MAX_LANE_LENGTH = 3e6  # m, of all lanes together


def prepare(od: records.OpenDrive, warnings: Counter[str]) -> records.OpenDrive:
    """The file in the frame of its header, without roads that cannot be drawn; counts them.

    Raises:
        MapError: The file has more road than one map can hold.
    """
    roads = {}
    for name, road in od.roads.items():
        errors = [length_error(geometry) for geometry in road.geometries]
        if max(errors) > MAX_LENGTH_ERROR:
            warnings["road left out: paramPoly3 far from its stated length"] += 1
            continue
        wrong = sum(error > 0 for error in errors)
        if wrong:
            warnings["paramPoly3 that is not as long as it says, stretched"] += wrong
        _note_gaps(road, warnings)
        _note_lanes(road, warnings)
        roads[name] = _placed(road, od.offset) if od.offset else road
    starts = [(g.x, g.y) for road in roads.values() for g in road.geometries]
    extent = np.ptp(starts, axis=0).max() if starts else 0.0
    require(MAP_EXTENT, "extent", extent, f"{od.source}: the roads'", error=MapError)
    total = sum(
        (road.section_end(index) - section.s) * len(section.lanes)
        for road in roads.values()
        for index, section in enumerate(road.sections)
    )
    if total > MAX_LANE_LENGTH:
        raise MapError(
            f"{od.source}: {total / 1000:.0f} km of lanes, more than {MAX_LANE_LENGTH / 1000:.0f}",
            "cut the map into smaller files",
        )
    return replace(od, roads=roads, offset=None)


def _placed(road: records.Road, offset: tuple[float, float, float, float]) -> records.Road:
    """A road with the header's offset applied to its reference line."""
    x, y, _, turn = offset
    cos, sin = np.cos(turn), np.sin(turn)
    geometries = tuple(
        replace(
            g,
            x=float(x + cos * g.x - sin * g.y),
            y=float(y + sin * g.x + cos * g.y),
            heading=g.heading + turn,
        )
        for g in road.geometries
    )
    return replace(road, geometries=geometries)


def _note_gaps(road: records.Road, warnings: Counter[str]) -> None:
    gaps, _ = ReferenceLine(road.geometries).joints()
    for low, high in ((GAP_NOTED, GAP_SERIOUS), (GAP_SERIOUS, np.inf)):
        count = int(((gaps > low) & (gaps <= high)).sum())
        if count:
            warnings[f"gap of more than {low:g} m between geometries"] += count


def _note_lanes(road: records.Road, warnings: Counter[str]) -> None:
    known = records.DRIVABLE | records.PAVED | records.WALKED | records.SEAMS | records.UNUSED
    for section in road.sections:
        for lane in section.lanes.values():
            if lane.type in ("tram", "rail"):
                warnings["tram or rail lane left out"] += 1
            elif lane.type not in known:
                warnings["lane of unknown type left out"] += 1
            if border_is_mirrored(lane):
                warnings["border of a right lane given on the left, mirrored"] += 1
