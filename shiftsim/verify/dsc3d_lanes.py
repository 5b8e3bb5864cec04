"""OpenDRIVE lanes behind the edges of a converted map, and the lanes that a path passes."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.data.dsc3d.recording import Site
from shiftsim.data.opendrive.curves import ReferenceLine
from shiftsim.data.opendrive.lanes import LaneKey, section_borders
from shiftsim.data.opendrive.map import Origin, build_road_map
from shiftsim.data.opendrive.reading import read_opendrive
from shiftsim.data.opendrive.records import OpenDrive
from shiftsim.world.map import VectorMap

_STEP_S = 0.05
_MIN_PIECE_S = 0.5  # shorter pieces at the ends of a lane sequence may be missing (expected.json)
_SWITCH, _JUMP = 1.0, 10.0  # costs of a lane sequence: to a linked edge, to any other


@dataclass(frozen=True)
class LocalMap:
    """A map in the local frame, with the OpenDRIVE lanes behind its edges."""

    drive: OpenDrive
    road: VectorMap
    pieces: dict[int, list[tuple[LaneKey, shapely.Polygon]]]


def load_map(path: Path) -> LocalMap:
    """A map file in its own frame."""
    drive = read_opendrive(path)
    road, made = build_road_map(drive, name=path.stem)
    return LocalMap(drive, road, _pieces(drive, road, made.origins))


def placed_map(local: LocalMap, site: Site) -> VectorMap:
    """The same map in UTM."""
    offset = float(site.offset[0]), float(site.offset[1])
    road, _ = build_road_map(local.drive, name=local.road.name, offset=offset, epsg=site.epsg)
    return road


def _pieces(
    drive: OpenDrive, road: VectorMap, origins: tuple[Origin, ...]
) -> dict[int, list[tuple[LaneKey, shapely.Polygon]]]:
    """OpenDRIVE lanes behind every edge, with their areas."""
    out: dict[int, list[tuple[LaneKey, shapely.Polygon]]] = {}
    for origin in origins:
        edge = road.edges.index.get(origin.id)
        if edge is None:
            continue
        source = drive.roads[origin.key.road]
        low, high = sorted((origin.begin, origin.end))
        s = np.linspace(low, high, max(2, round((high - low) / 0.5) + 1))
        borders = section_borders(source, origin.key.section, s, repair=True)
        poses = ReferenceLine(source.geometries).evaluate(s)
        inner = poses.offset(borders.inner[origin.key.lane])
        outer = poses.offset(borders.outer[origin.key.lane])
        area = shapely.Polygon(np.concatenate([inner, outer[::-1]]))
        out.setdefault(edge, []).append((origin.key, area))
    return out


def keys_at(local: LocalMap, points: FloatArray) -> list[list[LaneKey]]:
    """OpenDRIVE lanes of the edges that hold each point (n, 2)."""
    return [
        [
            _key_on(local, edge, x, y)
            for edge in local.road.edges.containing(x, y).tolist()
            if edge in local.pieces
        ]
        for x, y in points.tolist()
    ]


def _key_on(local: LocalMap, edge: int, x: float, y: float) -> LaneKey:
    """The piece of an edge nearest to a point."""
    point = shapely.Point(x, y)
    return min(local.pieces[edge], key=lambda piece: shapely.distance(piece[1], point))[0]


def lane_sequences(local: LocalMap, centers: FloatArray) -> list[list[LaneKey]]:
    """OpenDRIVE lanes passed by box centres (n, 3) at 20 Hz, without and with short end pieces."""
    points = centers[:, :2].tolist()
    candidates = [
        [e for e in local.road.edges.containing(x, y).tolist() if e in local.pieces]
        for x, y in points
    ]
    keys = [
        _key_on(local, edge, x, y)
        for edge, (x, y) in zip(_likeliest(local.road, candidates), points, strict=True)
        if edge >= 0
    ]
    starts = [i for i in range(len(keys)) if i == 0 or keys[i] != keys[i - 1]]
    lengths = np.diff([*starts, len(keys)]) * _STEP_S
    lanes = [keys[start] for start in starts]
    long = np.flatnonzero(lengths >= _MIN_PIECE_S - 1e-9)
    if not len(long):
        return [lanes]
    return [
        lanes[first : last + 1]
        for first in range(long[0], -1, -1)
        for last in range(long[-1], len(lanes))
    ]


def _likeliest(road: VectorMap, candidates: list[list[int]]) -> Iterator[int]:
    """One edge per sample with the fewest changes, -1 where there is none."""
    best: dict[int, tuple[float, list[int]]] = {}
    for here in candidates:
        if not here:
            best = {e: (cost, [*path, -1]) for e, (cost, path) in best.items()} or {-1: (0.0, [-1])}
            continue
        options = {}
        for edge in here:
            ways = [
                (cost + _change(road, before, edge), path) for before, (cost, path) in best.items()
            ] or [(0.0, [])]
            cost, path = min(ways, key=lambda way: way[0])
            options[edge] = (cost, [*path, edge])
        best = options
    return iter(min(best.values(), key=lambda way: way[0])[1])


def _change(road: VectorMap, before: int, after: int) -> float:
    if before in (after, -1):
        return 0.0
    return _SWITCH if after in road.outgoing.at(before) else _JUMP
