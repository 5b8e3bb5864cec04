"""Reader of CommonRoad scenario files (XML, 2018b and 2020a), each with its own map.

TUM's converters write drone recordings (INTERACTION, inD, highD and others) in this format. A
planning problem has no recorded track, so every car that drives is an ego.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.data.maps.build import build_lane_map
from shiftsim.data.maps.lights import Cycle, LightStates, states_of_cycles
from shiftsim.data.maps.opendrive.reading import xml_elements
from shiftsim.data.maps.segments import LanePiece, MapSource, StopArea, stop_area
from shiftsim.data.readers import codes
from shiftsim.data.readers.build import make_samples
from shiftsim.data.readers.files import SceneFolder, SourceFile
from shiftsim.data.readers.motion import unit_vectors
from shiftsim.data.readers.reader import SourceRecording
from shiftsim.data.readers.samples import TrackSamples
from shiftsim.kernels import FloatArray
from shiftsim.world.state import AgentKind, LightStatus

_MAX_BYTES = 500_000_000
_MAX_STEPS = 1_000_000
_STATE = {  # field of `OPEN_DATA` by path
    "time/exact": "step",
    "position/point/x": "position",
    "position/point/y": "position",
    "orientation/exact": "heading",
    "velocity/exact": "velocity",  # may be missing
}


class CommonRoadReader(SceneFolder):
    """CommonRoad; a scene is named by its file, and every vehicle that drives is an ego."""

    name = "commonroad"
    pattern = "*.xml"
    hint = "give a folder of CommonRoad scenarios in XML"

    def files(self, recording: str) -> list[Path]:
        """The file itself."""
        return [Path(recording)]

    def read(self, recording: str) -> SourceRecording:
        """One scene."""
        file = _File(Path(recording))
        name = file.root.get("benchmarkID") or file.path.stem
        with file.naming():
            lanes = build_lane_map(file.map(f"commonroad-{name}"))
            samples = file.tracks()
        return SourceRecording(
            samples,
            lanes,
            lights=file.lights(samples.duration),
            warnings=file.warnings,
            metadata={
                "source": f"CommonRoad {name}: {file.root.get('source', 'unknown')}",
                "licence": "that of the source",
                "author": file.root.get("author", ""),
            },
        )


class _File(SourceFile):
    """What one file says."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        (self.root,) = xml_elements(self.content(_MAX_BYTES), "commonRoad", self.fault)
        self.known(self.root.get("commonRoadVersion"), ("2018b", "2020a"), "commonRoadVersion")
        self.warnings: Counter[str] = Counter()
        self.step_s = self.number(self.root.get("timeStepSize"), "step length", "'timeStepSize'")

    def lights(self, duration: float) -> LightStates | None:
        """States of all lights with a cycle, a row per step."""
        cycles = {}
        for light in self.root.iterfind("trafficLight"):
            place = f"trafficLight {light.get('id')!r}"
            elements = light.findall("cycle/cycleElement")
            lengths = [self._at(e, "duration", "step", place) for e in elements]
            if not lengths or min(lengths) < 0 or not sum(lengths):
                continue
            colors = [codes.COLORS.get(e.findtext("color"), LightStatus.UNKNOWN) for e in elements]
            offset = light.findtext("cycle/timeOffset", "0")
            start = self.number(offset, "step", f"{place}: 'timeOffset'")
            cycles[light.get("id", "")] = Cycle(colors, lengths, start)
        steps = np.arange(min(round(duration / self.step_s), _MAX_STEPS) + 1)
        return states_of_cycles(cycles, steps, self.step_s)

    def map(self, name: str) -> MapSource:
        """The lanelets and what belongs to them."""
        limits = {}  # by traffic sign [m/s]
        for sign in self.root.iterfind("trafficSign/trafficSignElement"):
            kind = sign.findtext("trafficSignID", "")
            if kind.startswith(codes.SPEED_SIGNS) and sign.findtext("additionalValue"):
                number = sign.getparent().get("id", "")
                limits[number] = self._at(
                    sign, "additionalValue", "speed limit", f"sign {number!r}"
                )
        inside = set(
            self.root.xpath("intersection/incoming/*[contains(name(), 'successors')]/@ref")
        )
        areas: dict[str, list[shapely.Polygon]] = {"crosswalk": [], "parking": [], "paved": []}
        pieces, stops = list[LanePiece](), list[StopArea]()
        for lanelet in self.root.iterfind("lanelet"):
            types = {(e.text or "").strip() for e in lanelet.iterfind("laneletType")}
            piece = self._piece(lanelet, inside, limits)
            kinds = types if types & codes.UNPAVED else types | {"paved"}
            for area in kinds & areas.keys():
                areas[area].append(piece.polygon)
            if not types & codes.NO_LANES:
                pieces.append(piece)
                kind = codes.OTHER_STOP if piece.light is None else codes.LIGHT_STOP
                for line in lanelet.iterfind("stopLine"):
                    drawn = len(line.findall("point")) >= 2  # else at the end of the lanelet
                    ends = self._line(line, ".", f"stopLine of {piece.id!r}")[:2] if drawn else None
                    stops += filter(None, [stop_area(piece, kind, ends)])
        return MapSource(
            name=name,
            pieces=pieces,
            paved=areas["paved"],
            stop_areas=stops,
            crosswalks=areas["crosswalk"],
            car_parks=areas["parking"],
        )

    def _piece(self, lanelet: Any, inside: set[str], limits: dict[str, float]) -> LanePiece:
        name = lanelet.get("id", "")
        place = f"lanelet {name!r}"
        own = [limits[i] for i in lanelet.xpath("trafficSignRef/@ref") if i in limits]
        if lanelet.find("speedLimit") is not None:
            own.append(self._at(lanelet, "speedLimit", "speed limit", place))
        beside = (f"adjacent{side}[@drivingDir='same']/@ref" for side in ("Left", "Right"))
        left, right = (next(iter(lanelet.xpath(path)), None) for path in beside)
        return LanePiece(
            id=name,
            left=self._line(lanelet, "leftBound", place),
            right=self._line(lanelet, "rightBound", place),
            successors=tuple(lanelet.xpath("successor/@ref")),
            left_neighbor=left,
            right_neighbor=right,
            is_connector=name in inside or "intersection" in lanelet.xpath("laneletType/text()"),
            speed_limit=min(own, default=None),
            light=next(iter(lanelet.xpath("trafficLightRef/@ref")), None),
        )

    def tracks(self) -> TrackSamples:
        """All obstacles whose states are exact; the others are counted."""
        rows = list(self._rows("dynamic"))
        if not rows:
            raise self.fault("no dynamic obstacle with a trajectory of exact states")
        steps = [int(values[0]) for _, _, values in rows]
        every = range(min(steps), max(steps) + 1)
        if len(every) > _MAX_STEPS:
            raise self.fault(f"{len(every)} time steps", "split the scenario")
        still = {row[0]: row for row in self._rows("static")}
        rows += [(i, kind, [step, *at[1:]]) for i, kind, at in still.values() for step in every]
        ids, names, values = zip(*rows, strict=True)
        step, x, y, heading, speed, length, width = np.array(values).T
        categories, category = np.unique(names, return_inverse=True)
        return make_samples(
            "tracks",
            time_us=np.rint(step * self.step_s * 1e6).astype(np.int64),
            ids=np.array(ids),
            category=category,
            categories=categories.tolist(),
            xy=np.column_stack([x, y]),
            headings=heading,
            velocities=speed[:, None] * unit_vectors(heading),
            sizes=np.column_stack([length, width]),
            kind_of={name: codes.OBSTACLES.get(name, AgentKind.GENERIC_OBJECT) for name in names},
        )

    def _rows(self, role: str) -> Iterator[tuple[str, str, list[float]]]:
        """Id, category, and what `_STATE` names, length and width, by obstacle and step."""
        for obstacle in self.root.xpath(f"{role}Obstacle | obstacle[role='{role}']"):  # 2018b
            box = obstacle.find("shape/rectangle")
            if box is None:
                self.warnings["obstacle that is no rectangle, left out"] += 1
                continue
            name, category = obstacle.get("id", ""), obstacle.findtext("type") or "unknown"
            place = f"obstacle {name!r}"
            size = [self._at(box, side, "size", place) for side in ("length", "width")]
            for state in obstacle.xpath("initialState | trajectory/state"):
                values = {
                    path: self._at(state, path, field, place)
                    for path, field in _STATE.items()
                    if state.find(path) is not None
                }
                if values.keys() | {"velocity/exact"} != _STATE.keys():
                    self.warnings["state that is not exact, left out"] += 1
                    continue
                yield name, category.strip(), [*(values.get(k, np.nan) for k in _STATE), *size]

    def _at(self, element: Any, path: str, field: str, place: str) -> float:
        """The number at a path below an element."""
        return self.number(element.findtext(path), field, f"{place}: {path!r}")

    def _line(self, element: Any, path: str, place: str) -> FloatArray:
        """(K, 2) the line of the points at a path below an element [m]."""
        place = f"{place}: {path!r}"
        found = element.iterfind(f"{path}/point")
        points = [[self._at(point, axis, "position", place) for axis in "xy"] for point in found]
        return self.line(points, place)
