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
from shiftsim.data.lanes.pieces import LanePiece, MapSource, StopArea
from shiftsim.data.open_data.scenes import LightStates, Scene
from shiftsim.data.open_data.source import Source, find_below
from shiftsim.data.opendrive.areas import drivable_tiles
from shiftsim.data.opendrive.control import STOP_LINE_DEPTH
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples
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
_CONNECTORS = [f"intersection/incoming/successors{way}" for way in ("Right", "Straight", "Left")]
_STATE = {  # field of `OPEN_DATA` by path
    "time/exact": "step",
    "position/point/x": "position",
    "position/point/y": "position",
    "orientation/exact": "heading",
}
_SPEED = "velocity/exact"


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


class CommonRoadReader:
    """CommonRoad; a scene is named by its file."""

    def find(self, folder: Path) -> list[Path]:
        """XML files, sorted."""
        return find_below(folder, "*.xml", "give a folder of CommonRoad scenarios in XML")

    def files(self, path: Path) -> list[Path]:
        """The file itself."""
        return [path]

    def read(self, path: Path) -> Scene:
        """One scene."""
        file = _File(path)
        name = file.root.get("benchmarkID") or path.stem
        with file.naming():
            lanes = build_lane_map(file.map(f"commonroad-{name}"))
            samples = file.tracks()
        warnings = {**samples.warnings, **file.warnings}
        return Scene(
            samples=replace(samples, warnings=warnings),
            map=lanes,
            egos=None,
            lights=file.lights(samples.duration),
            metadata={
                "source": f"CommonRoad {name}: {file.root.get('source', 'unknown')}",
                "licence": "that of the source",
                "author": file.root.get("author", ""),
            },
        )


class _File(Source):
    """What one file says."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.root = self._parse()
        self.warnings: Counter[str] = Counter()
        self.step_s = self.number(
            self.root.get("timeStepSize", ""), "step length", "'timeStepSize'"
        )

    def _parse(self) -> Any:
        """The root. Entities and document types are refused."""
        parser = etree.XMLParser(
            resolve_entities=False,
            no_network=True,
            load_dtd=False,
            huge_tree=False,
            remove_comments=True,
            remove_pis=True,
        )
        try:
            root = etree.fromstring(self.content(_MAX_BYTES), parser)
        except (etree.XMLSyntaxError, ValueError) as error:
            raise self.fault(f"not well-formed XML ({error})") from error
        if root.getroottree().docinfo.doctype:
            raise self.fault("has a DOCTYPE", "remove it and its entities")
        if root.tag != "commonRoad" or root.get("commonRoadVersion") not in VERSIONS:
            found = f"<{root.tag} commonRoadVersion={root.get('commonRoadVersion')!r}>"
            raise self.fault(
                f"begins with {found}, need commonRoad of {' or '.join(VERSIONS)}",
                "write it again with a current commonroad-io, or leave it out",
            )
        return root

    def _number(self, element: Any, path: str, field: str, place: str) -> float:
        """The number at a path below an element."""
        return self.number(element.findtext(path), field, f"{place}: {path!r}")

    def lights(self, duration: float) -> LightStates | None:
        """States of all lights with a cycle, a row per step."""
        steps = np.arange(min(round(duration / self.step_s), _MAX_STEPS) + 1)
        columns = {}
        for light in self.root.iterfind("trafficLight"):
            place = f"trafficLight {light.get('id')!r}"
            elements = light.findall("cycle/cycleElement")
            lengths = [self._number(e, "duration", "step", place) for e in elements]
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
        time_us = np.rint(steps * self.step_s * 1e6).astype(np.int64)
        return LightStates(tuple(columns), time_us, np.stack(list(columns.values()), axis=1))

    def map(self, name: str) -> MapSource:
        """The lanelets and what belongs to them."""
        limits = self._sign_limits()
        inside = {ref for path in _CONNECTORS for ref in _refs(self.root, path)}
        areas: dict[str, list[shapely.Polygon]] = {"crosswalk": [], "parking": [], "paved": []}
        pieces: list[LanePiece] = []
        stops: list[StopArea] = []
        for lanelet in self.root.iterfind("lanelet"):
            types = {(e.text or "").strip() for e in lanelet.iterfind("laneletType")}
            piece = self._piece(lanelet, inside, limits)
            for kind in (types if types & _UNPAVED else types | {"paved"}) & areas.keys():
                areas[kind].append(piece.polygon)
            if not types & _NO_LANES:
                pieces.append(piece)
                stops += self._stop_areas(lanelet, piece)
        return MapSource(
            name=name,
            pieces=pieces,
            drivable_areas=drivable_tiles(areas["paved"]),
            stop_areas=stops,
            crosswalks=areas["crosswalk"],
            car_parks=areas["parking"],
        )

    def _sign_limits(self) -> dict[str, float]:
        """Speed limit by traffic sign [m/s]."""
        return {
            sign.get("id", ""): self._number(
                element, "additionalValue", "speed limit", f"trafficSign {sign.get('id')!r}"
            )
            for sign in self.root.iterfind("trafficSign")
            for element in sign.iterfind("trafficSignElement")
            if element.findtext("additionalValue")
            and element.findtext("trafficSignID", "").startswith(_SPEED_SIGNS)
        }

    def _piece(self, lanelet: Any, inside: set[str], limits: dict[str, float]) -> LanePiece:
        name = lanelet.get("id", "")
        left, right = (
            next(iter(_refs(lanelet, f"{side}[@drivingDir='same']")), None)
            for side in ("adjacentLeft", "adjacentRight")
        )
        own = [
            self.number(e.text, "speed limit", f"lanelet {name!r}: 'speedLimit'")
            for e in lanelet.iterfind("speedLimit")
        ]
        own += [limits[ref] for ref in _refs(lanelet, "trafficSignRef") if ref in limits]
        return LanePiece(
            id=name,
            left=self._border(lanelet, "leftBound", name),
            right=self._border(lanelet, "rightBound", name),
            successors=tuple(_refs(lanelet, "successor")),
            left_neighbor=left,
            right_neighbor=right,
            is_connector=name in inside
            or any(e.text == "intersection" for e in lanelet.iterfind("laneletType")),
            speed_limit=min(own, default=None),
            light=next(iter(_refs(lanelet, "trafficLightRef")), None),
        )

    def _border(self, lanelet: Any, tag: str, name: str) -> FloatArray:
        """(K, 2) a line of a lanelet."""
        place = f"lanelet {name!r}: {tag!r}"
        points = [
            [self.number(point.findtext(axis), "position", place) for axis in "xy"]
            for point in lanelet.iterfind(f"{tag}/point")
        ]
        line = self.line(points, place)
        if len(line) < 2:
            raise self.fault(f"{place} has no length")
        return line

    def _stop_areas(self, lanelet: Any, piece: LanePiece) -> Iterator[StopArea]:
        for line in lanelet.iterfind("stopLine"):
            if len(line.findall("point")) >= 2:
                ends = self._border(lanelet, "stopLine", piece.id)[:2]
            else:
                ends = np.stack([piece.left[-1], piece.right[-1]])
            step = piece.middle[-2] - piece.middle[-1]
            back = STOP_LINE_DEPTH * step / np.hypot(*step)
            polygon = shapely.Polygon(np.concatenate([ends, ends[::-1] + back])).buffer(0)
            kind = _OTHER_STOP if piece.light is None else _LIGHT_STOP
            if isinstance(polygon, shapely.Polygon) and polygon.area > 0:
                yield StopArea(polygon, kind, piece.id)

    def tracks(self) -> TrackSamples:
        """All obstacles whose states are exact; the others are counted."""
        rows = [row for obstacle in self._obstacles("dynamic") for row in self._rows(obstacle)]
        if not rows:
            raise self.fault("no dynamic obstacle with a trajectory of exact states")
        every = range(int(min(row.step for row in rows)), int(max(row.step for row in rows)) + 1)
        if len(every) > _MAX_STEPS:
            raise self.fault(f"{len(every)} time steps", "split the scenario")
        still = {row.id: row for one in self._obstacles("static") for row in self._rows(one)}
        rows += [row._replace(step=step) for row in still.values() for step in every]
        ids, names, *values = zip(*rows, strict=True)
        step, x, y, heading, speed, length, width = np.array(values)
        categories = sorted(set(names))
        along = np.column_stack([np.cos(heading), np.sin(heading)])
        return make_samples(
            "tracks",
            time_us=np.rint(step * self.step_s * 1e6).astype(np.int64),
            ids=np.array(ids),
            category=np.array([categories.index(name) for name in names], np.int64),
            categories=categories,
            xy=np.column_stack([x, y]),
            headings=heading,
            velocities=speed[:, None] * along,
            sizes=np.column_stack([length, width]),
            kind_of={n: _KINDS.get(n, AgentKind.GENERIC_OBJECT) for n in categories},
        )

    def _obstacles(self, role: str) -> Iterator[Any]:
        yield from self.root.iterfind(f"{role}Obstacle")
        yield from self.root.iterfind(f"obstacle[role='{role}']")  # 2018b

    def _rows(self, obstacle: Any) -> Iterator[_Row]:
        name = obstacle.get("id", "")
        place = f"obstacle {name!r}"
        box = obstacle.find("shape/rectangle")
        if box is None:
            self.warnings["obstacle that is no rectangle, left out"] += 1
            return
        length, width = (self._number(box, n, "size", place) for n in ("length", "width"))
        category = (obstacle.findtext("type") or "unknown").strip()
        for state in (*obstacle.iterfind("initialState"), *obstacle.iterfind("trajectory/state")):
            if any(state.find(path) is None for path in _STATE):
                self.warnings["state that is not exact, left out"] += 1
                continue
            step, x, y, heading = (
                self._number(state, path, field, place) for path, field in _STATE.items()
            )
            speed = np.nan
            if state.find(_SPEED) is not None:
                speed = self._number(state, _SPEED, "velocity", place)
            yield _Row(name, category, step, x, y, heading, speed, length, width)


def _refs(element: Any, path: str) -> list[str]:
    return [found.get("ref", "") for found in element.iterfind(path)]
