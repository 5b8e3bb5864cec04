"""Reader of CommonRoad scenario files (XML, 2018b and 2020a), each with its own map.

TUM's converters write drone recordings (INTERACTION, inD, highD and others) in this format. A
planning problem has no recorded track, so every car that drives is an ego.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.data.lanes.lights import Cycle, LightStates, states_of_cycles
from shiftsim.data.lanes.map import build_lane_map
from shiftsim.data.lanes.pieces import LanePiece, MapSource, StopArea, stop_area
from shiftsim.data.open_data import codes
from shiftsim.data.open_data.scenes import Scene
from shiftsim.data.open_data.source import find_below
from shiftsim.data.open_data.xml_source import XmlSource, first_ref, refs
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples
from shiftsim.world.state import AgentKind, LightStatus

VERSIONS = ("2018b", "2020a")
_MAX_BYTES = 500_000_000
_MAX_STEPS = 1_000_000
_CONNECTORS = [f"intersection/incoming/successors{way}" for way in ("Right", "Straight", "Left")]
_SPEED = "velocity/exact"
_STATE = {  # field of `OPEN_DATA` by path
    "time/exact": "step",
    "position/point/x": "position",
    "position/point/y": "position",
    "orientation/exact": "heading",
    _SPEED: "velocity",
}


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


class _File(XmlSource):
    """What one file says."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, _MAX_BYTES)
        version = self.root.get("commonRoadVersion")
        if self.root.tag != "commonRoad" or version not in VERSIONS:
            found = f"<{self.root.tag} commonRoadVersion={version!r}>"
            raise self.fault(
                f"begins with {found}, need commonRoad of {' or '.join(VERSIONS)}",
                "write it again with a current commonroad-io, or leave it out",
            )
        self.warnings: Counter[str] = Counter()
        length = self.root.get("timeStepSize", "")
        self.step_s = self.number(length, "step length", "'timeStepSize'")

    def lights(self, duration: float) -> LightStates | None:
        """States of all lights with a cycle, a row per step."""
        cycles = {}
        for light in self.root.iterfind("trafficLight"):
            place = f"trafficLight {light.get('id')!r}"
            elements = light.findall("cycle/cycleElement")
            lengths = [self.number_at(e, "duration", "step", place) for e in elements]
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
        limits = self._sign_limits()
        inside = {ref for path in _CONNECTORS for ref in refs(self.root, path)}
        areas: dict[str, list[shapely.Polygon]] = {"crosswalk": [], "parking": [], "paved": []}
        pieces, stops = list[LanePiece](), list[StopArea]()
        for lanelet in self.root.iterfind("lanelet"):
            types = {(e.text or "").strip() for e in lanelet.iterfind("laneletType")}
            piece = self._piece(lanelet, inside, limits)
            kinds = types if types & codes.UNPAVED else types | {"paved"}
            for kind in kinds & areas.keys():
                areas[kind].append(piece.polygon)
            if not types & codes.NO_LANES:
                pieces.append(piece)
                stops += self._stop_areas(lanelet, piece)
        return MapSource(
            name=name,
            pieces=pieces,
            paved=areas["paved"],
            stop_areas=stops,
            crosswalks=areas["crosswalk"],
            car_parks=areas["parking"],
        )

    def _sign_limits(self) -> dict[str, float]:
        """Speed limit by traffic sign [m/s]."""
        return {
            sign.get("id", ""): self.number_at(
                element, "additionalValue", "speed limit", f"trafficSign {sign.get('id')!r}"
            )
            for sign in self.root.iterfind("trafficSign")
            for element in sign.iterfind("trafficSignElement")
            if element.findtext("additionalValue")
            and element.findtext("trafficSignID", "").startswith(codes.SPEED_SIGNS)
        }

    def _piece(self, lanelet: Any, inside: set[str], limits: dict[str, float]) -> LanePiece:
        name = lanelet.get("id", "")
        place = f"lanelet {name!r}"
        own = [
            self.number(e.text, "speed limit", f"{place}: 'speedLimit'")
            for e in lanelet.iterfind("speedLimit")
        ]
        own += [limits[ref] for ref in refs(lanelet, "trafficSignRef") if ref in limits]
        return LanePiece(
            id=name,
            left=self.line_at(lanelet, "leftBound", f"{place}: 'leftBound'"),
            right=self.line_at(lanelet, "rightBound", f"{place}: 'rightBound'"),
            successors=tuple(refs(lanelet, "successor")),
            left_neighbor=first_ref(lanelet, "adjacentLeft[@drivingDir='same']"),
            right_neighbor=first_ref(lanelet, "adjacentRight[@drivingDir='same']"),
            is_connector=name in inside or "intersection" in lanelet.xpath("laneletType/text()"),
            speed_limit=min(own, default=None),
            light=first_ref(lanelet, "trafficLightRef"),
        )

    def _stop_areas(self, lanelet: Any, piece: LanePiece) -> Iterator[StopArea]:
        kind = codes.OTHER_STOP if piece.light is None else codes.LIGHT_STOP
        for line in lanelet.iterfind("stopLine"):
            place, drawn = f"lanelet {piece.id!r}: 'stopLine'", len(line.findall("point")) >= 2
            ends = self.line_at(lanelet, "stopLine", place)[:2] if drawn else None
            if area := stop_area(piece, kind, ends):
                yield area

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
            velocities=speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]),
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
            size = [self.number_at(box, n, "size", place) for n in ("length", "width")]
            for state in obstacle.xpath("initialState | trajectory/state"):
                lacking = {path for path in _STATE if state.find(path) is None}
                if lacking - {_SPEED}:
                    self.warnings["state that is not exact, left out"] += 1
                    continue
                values = [
                    np.nan if path in lacking else self.number_at(state, path, field, place)
                    for path, field in _STATE.items()
                ]
                yield name, category.strip(), [*values, *size]
