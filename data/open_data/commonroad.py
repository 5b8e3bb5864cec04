"""Reader of CommonRoad scenario files (XML, 2018b and 2020a), each with its own map.

TUM's converters write drone recordings (INTERACTION, inD, highD and others) in this format. A
planning problem has no recorded track, so every car that drives is an ego.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from lxml import etree

from shiftsim.arrays import FloatArray
from shiftsim.data.lanes.map import build_lane_map
from shiftsim.data.lanes.pieces import LanePiece, MapSource, StopArea, clean_line
from shiftsim.data.open_data.scenes import REPAIR, LightStates, Scene
from shiftsim.data.open_data.tables import naming
from shiftsim.data.opendrive.areas import drivable_tiles
from shiftsim.data.opendrive.control import STOP_LINE_DEPTH
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples
from shiftsim.errors import ConversionError
from shiftsim.world.ranges import OPEN_DATA, require
from shiftsim.world.state import AgentKind, LightStatus

VERSIONS = ("2018b", "2020a")
_KINDS = {
    **dict.fromkeys(
        "car truck bus taxi priorityVehicle parkedVehicle train".split(), AgentKind.VEHICLE
    ),
    **dict.fromkeys(("bicycle", "motorcycle"), AgentKind.BICYCLE),
    "pedestrian": AgentKind.PEDESTRIAN,
}
_NO_LANES = frozenset(
    "bicycleLane busStop sidewalk crosswalk shoulder parking border restricted_area".split()
)
_UNPAVED = frozenset(("sidewalk", "crosswalk", "bicycleLane"))
_SPEED_SIGNS = ("274", "R2-1", "r301")  # maximum speed, by country
_COLORS = {"green": LightStatus.GREEN, "yellow": LightStatus.YELLOW, "red": LightStatus.RED}
_COLORS |= {"redYellow": LightStatus.RED}
_LIGHT_STOP, _OTHER_STOP = 2, 5  # types of stop polygons
_MAX_BYTES = 500_000_000
_MAX_STEPS = 1_000_000


class CommonRoadReader:
    """CommonRoad; a scene is named by its file."""

    def find(self, folder: Path) -> list[Path]:
        """XML files, sorted."""
        found = [folder] if folder.is_file() else sorted(folder.rglob("*.xml"))
        if not found:
            what = f"{folder}: no .xml file below it"
            raise ConversionError(what, "give a folder of CommonRoad scenarios in XML")
        return found

    def files(self, path: Path) -> list[Path]:
        """The file itself."""
        return [path]

    def read(self, path: Path) -> Scene:
        """One scene."""
        root = _parse(path)
        file = _File(path, root)
        name = root.get("benchmarkID") or path.stem
        step_s = file.number(root.get("timeStepSize", ""), "step length", "'timeStepSize'")
        with naming(path):
            lanes = build_lane_map(file.map(f"commonroad-{name}"))
            samples = file.tracks(step_s)
        warnings = {**samples.warnings, **file.warnings}
        return Scene(
            samples=replace(samples, warnings=warnings),
            map=lanes,
            egos=None,
            lights=file.lights(step_s, samples.duration),
            metadata={
                "source": f"CommonRoad {name}: {root.get('source', 'unknown')}",
                "licence": "that of the source",
                "author": root.get("author", ""),
            },
        )


def _parse(path: Path) -> Any:
    """The root of a file. Entities and document types are refused."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConversionError(f"{path}: more than {_MAX_BYTES} bytes", "split the scenario")
        parser = etree.XMLParser(
            resolve_entities=False,
            no_network=True,
            load_dtd=False,
            huge_tree=False,
            remove_comments=True,
            remove_pis=True,
        )
        root = etree.fromstring(path.read_bytes(), parser)
    except OSError as error:
        raise ConversionError(f"{path}: cannot be read ({error})", REPAIR) from error
    except (etree.XMLSyntaxError, ValueError) as error:
        raise ConversionError(f"{path}: not well-formed XML ({error})", REPAIR) from error
    if root.getroottree().docinfo.doctype:
        raise ConversionError(f"{path}: has a DOCTYPE", "remove it and its entities")
    if root.tag != "commonRoad" or root.get("commonRoadVersion") not in VERSIONS:
        found = f"<{root.tag} commonRoadVersion={root.get('commonRoadVersion')!r}>"
        raise ConversionError(
            f"{path}: begins with {found}, need commonRoad of {' or '.join(VERSIONS)}",
            "write it again with a current commonroad-io, or leave it out",
        )
    return root


class _Row(NamedTuple):
    """An object at one step."""

    id: str
    category: str
    step: float
    x: float
    y: float
    heading: float
    speed: float  # NaN where the file has none
    length: float
    width: float


class _File:
    """What one file says."""

    def __init__(self, path: Path, root: Any) -> None:
        self.path, self.root = path, root
        self.warnings: Counter[str] = Counter()

    def number(self, text: str | None, field: str, place: str) -> float:
        """A number in the range of its field.

        Raises:
            ConversionError: It is missing, no number, or beyond.
        """
        try:
            value = float(text or "")
        except ValueError:
            what = f"{self.path}: {place} is {text!r}, need a number"
            raise ConversionError(what, REPAIR) from None
        require(OPEN_DATA, field, value, f"{self.path}: {place} as", error=ConversionError)
        return value

    def lights(self, step_s: float, duration: float) -> LightStates | None:
        """States of all lights with a cycle, a row per step."""
        steps = np.arange(min(round(duration / step_s), _MAX_STEPS) + 1)
        columns = {}
        for light in self.root.iterfind("trafficLight"):
            place = f"trafficLight {light.get('id')!r}"
            elements = light.findall("cycle/cycleElement")
            lengths = [
                self.number(e.findtext("duration"), "step", f"{place}: 'duration'")
                for e in elements
            ]
            if not lengths or min(lengths) < 0 or not sum(lengths):
                continue
            colors = [_COLORS.get(e.findtext("color"), LightStatus.UNKNOWN) for e in elements]
            offset = light.findtext("cycle/timeOffset", "0")
            at = (steps - self.number(offset, "step", f"{place}: 'timeOffset'")) % sum(lengths)
            columns[light.get("id", "")] = np.array(colors, np.int64)[
                np.searchsorted(np.cumsum(lengths), at, side="right")
            ]
        if not columns:
            return None
        time_us = np.rint(steps * step_s * 1e6).astype(np.int64)
        return LightStates(tuple(columns), time_us, np.stack(list(columns.values()), axis=1))

    def map(self, name: str) -> MapSource:
        """The lanelets and what belongs to them."""
        limits = self._sign_limits()
        paths = "successorsRight", "successorsStraight", "successorsLeft"
        inside = {r for p in paths for r in _refs(self.root, f"intersection/incoming/{p}")}
        pieces, crosswalks, car_parks, paved = [], [], [], []
        stops: list[StopArea] = []
        for lanelet in self.root.iterfind("lanelet"):
            piece = self._piece(lanelet, inside, limits)
            types = {(e.text or "").strip() for e in lanelet.iterfind("laneletType")}
            if "crosswalk" in types:
                crosswalks.append(piece.polygon)
            if "parking" in types:
                car_parks.append(piece.polygon)
            if not types & _UNPAVED:
                paved.append(piece.polygon)
            if not types & _NO_LANES:
                pieces.append(piece)
                stops += self._stop_areas(lanelet, piece)
        paved = drivable_tiles(paved)
        return MapSource(name, pieces, paved, stops, crosswalks, (), car_parks)

    def _sign_limits(self) -> dict[str, float]:
        """Speed limit by traffic sign [m/s]."""
        out = {}
        for sign in self.root.iterfind("trafficSign"):
            for element in sign.iterfind("trafficSignElement"):
                value = element.findtext("additionalValue")
                if value and element.findtext("trafficSignID", "").startswith(_SPEED_SIGNS):
                    place = f"trafficSign {sign.get('id')!r}: 'additionalValue'"
                    out[sign.get("id", "")] = self.number(value, "speed limit", place)
        return out

    def _piece(self, lanelet: Any, inside: set[str], limits: dict[str, float]) -> LanePiece:
        name = lanelet.get("id", "")
        neighbors = {
            side: next(
                (e.get("ref") for e in lanelet.iterfind(side) if e.get("drivingDir") == "same"),
                None,
            )
            for side in ("adjacentLeft", "adjacentRight")
        }
        own = [
            self.number(e.text, "speed limit", f"lanelet {name!r}: 'speedLimit'")
            for e in lanelet.iterfind("speedLimit")
        ]
        own += [limits[ref] for ref in _refs(lanelet, "trafficSignRef") if ref in limits]
        return LanePiece(
            id=name,
            left=self._line(lanelet, "leftBound", name),
            right=self._line(lanelet, "rightBound", name),
            successors=tuple(_refs(lanelet, "successor")),
            left_neighbor=neighbors["adjacentLeft"],
            right_neighbor=neighbors["adjacentRight"],
            is_connector=name in inside
            or any(e.text == "intersection" for e in lanelet.iterfind("laneletType")),
            speed_limit=min(own, default=None),
            light=next(iter(_refs(lanelet, "trafficLightRef")), None),
        )

    def _line(self, element: Any, tag: str, name: str) -> FloatArray:
        """(K, 2) a line of a lanelet."""
        place = f"lanelet {name!r}: {tag!r}"
        points = [
            [self.number(point.findtext(axis), "position", place) for axis in "xy"]
            for point in element.iterfind(f"{tag}/point")
        ]
        line = clean_line(np.array(points, np.float64).reshape(-1, 2))
        if len(line) < 2:
            raise ConversionError(f"{self.path}: {place} has fewer than two points", REPAIR)
        return line

    def _stop_areas(self, lanelet: Any, piece: LanePiece) -> Iterator[StopArea]:
        for line in lanelet.iterfind("stopLine"):
            if len(line.findall("point")) >= 2:
                ends = self._line(lanelet, "stopLine", piece.id)[:2]
            else:
                ends = np.stack([piece.left[-1], piece.right[-1]])
            step = piece.middle[-2] - piece.middle[-1]
            back = STOP_LINE_DEPTH * step / np.hypot(*step)
            polygon = shapely.Polygon(np.concatenate([ends, ends[::-1] + back])).buffer(0)
            kind = _OTHER_STOP if piece.light is None else _LIGHT_STOP
            if isinstance(polygon, shapely.Polygon) and polygon.area > 0:
                yield StopArea(polygon, kind, piece.id)

    def tracks(self, step_s: float) -> TrackSamples:
        """All obstacles whose states are exact; the others are counted."""
        rows = [row for obstacle in self._obstacles() for row in self._rows(obstacle)]
        still = {
            row.id: row for obstacle in self._obstacles("static") for row in self._rows(obstacle)
        }
        if not rows:
            what = f"{self.path}: no dynamic obstacle with a trajectory of exact states"
            raise ConversionError(what, "leave the file out")
        steps = range(int(min(r.step for r in rows)), int(max(r.step for r in rows)) + 1)
        if len(steps) > _MAX_STEPS:
            raise ConversionError(f"{self.path}: {len(steps)} time steps", "split the scenario")
        rows += [row._replace(step=step) for row in still.values() for step in steps]
        ids, names, *values = zip(*rows, strict=True)
        step, x, y, heading, speed, length, width = np.array(values)
        categories = sorted(set(names))
        along = np.column_stack([np.cos(heading), np.sin(heading)])
        return make_samples(
            "tracks",
            time_us=np.rint(step * step_s * 1e6).astype(np.int64),
            ids=np.array(ids),
            category=np.array([categories.index(name) for name in names], np.int64),
            categories=categories,
            xy=np.column_stack([x, y]),
            headings=heading,
            velocities=speed[:, None] * along,
            sizes=np.column_stack([length, width]),
            kind_of={n: _KINDS.get(n, AgentKind.GENERIC_OBJECT) for n in categories},
        )

    def _obstacles(self, role: str = "dynamic") -> Iterator[Any]:
        yield from self.root.iterfind(f"{role}Obstacle")
        for obstacle in self.root.iterfind("obstacle"):  # 2018b
            if obstacle.findtext("role") == role:
                yield obstacle

    def _rows(self, obstacle: Any) -> Iterator[_Row]:
        name = obstacle.get("id", "")
        place = f"obstacle {name!r}"
        box = obstacle.find("shape/rectangle")
        if box is None:
            self.warnings["obstacle that is no rectangle, left out"] += 1
            return
        size = [
            self.number(box.findtext(n), "size", f"{place}: {n!r}") for n in ("length", "width")
        ]
        category = (obstacle.findtext("type") or "unknown").strip()
        for state in (*obstacle.iterfind("initialState"), *obstacle.iterfind("trajectory/state")):
            paths = {"position/point/x": "position", "position/point/y": "position"}
            paths |= {"orientation/exact": "heading", "time/exact": "step"}
            if any(state.find(path) is None for path in paths):
                self.warnings["state that is not exact, left out"] += 1
                continue
            x, y, heading, step = (
                self.number(state.findtext(path), field, f"{place}: {path!r}")
                for path, field in paths.items()
            )
            speed = state.findtext("velocity/exact")
            speed_mps = np.nan
            if speed is not None:
                speed_mps = self.number(speed, "velocity", f"{place}: 'velocity'")
            yield _Row(name, category, step, x, y, heading, speed_mps, *size)


def _refs(element: Any, path: str) -> list[str]:
    return [found.get("ref", "") for found in element.iterfind(path)]
