"""From lanes of lane sections to lanes, roadblocks and connectors of the map: which are which.

A group holds the drivable lanes of one direction of one lane section; roads of junctions are
connectors.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TypeAlias

import numpy as np
import shapely

from shiftsim.data.maps import topology
from shiftsim.data.maps.opendrive import records
from shiftsim.data.maps.opendrive.curves import ReferenceLine
from shiftsim.data.maps.opendrive.lanes import LaneKey, lane_links, runs_forward, section_borders
from shiftsim.data.maps.opendrive.records import DRIVABLE, OpenDrive
from shiftsim.data.maps.topology import Topology
from shiftsim.kernels import FloatArray

MIN_LENGTH = 0.1  # m, shorter lanes are linked through
MIN_WIDTH = 0.5  # m, lanes never wider are linked through
INFER_GAP, SNAP_GAP = 0.1, 0.05  # m
_MAX_CHAIN = 63  # lanes along one connector
_Group: TypeAlias = tuple[str, int, bool]  # road, section, whether it runs along the road
_CARS = frozenset(("all", "car", "autonomousTraffic", "motorVehicle"))


@dataclass(frozen=True)
class LaneSegment:
    """Part of a lane: travel enters at `begin` and leaves at `end`, distances on its road [m]."""

    key: LaneKey
    begin: float
    end: float

    @property
    def length(self) -> float:
        """Length along the reference line [m]."""
        return abs(self.end - self.begin)

    @property
    def span(self) -> tuple[float, float]:
        """Where it lies on its road, from and to [m]."""
        return min(self.begin, self.end), max(self.begin, self.end)

    @property
    def is_forward(self) -> bool:
        """Whether travel follows the road."""
        return self.end >= self.begin

    def split(self, at: float) -> tuple["LaneSegment", "LaneSegment"]:
        """The parts before and after a distance from where travel enters [m]."""
        place = float(self.begin + np.sign(self.end - self.begin) * at)
        return replace(self, end=place), replace(self, begin=place)


Lane: TypeAlias = topology.Lane[LaneSegment]
Connector: TypeAlias = topology.Connector[LaneSegment]
Graph: TypeAlias = topology.LaneGraph[LaneSegment]


def is_drivable(lane: records.Lane) -> bool:
    """Whether cars may drive on a lane."""
    if lane.type not in DRIVABLE:
        return False
    denied = {what for rule, what in lane.access if rule == "deny"}
    allowed = {what for rule, what in lane.access if rule == "allow"}
    return not (denied & _CARS) and (not allowed or bool(allowed & _CARS))


def road_order(road: str) -> tuple[int, int, str]:
    """Sorting key of a road id: numbers by value, then other names."""
    return (0, int(road), "") if road.isdecimal() else (1, 0, road)


def build_lane_graph(od: OpenDrive, warnings: Counter[str]) -> Graph:
    """Lanes, roadblocks and connectors of a file; counts what was inferred or dropped."""
    return _Builder(od, warnings).build()


class _Builder(Topology[LaneKey, LaneSegment]):
    def __init__(self, od: OpenDrive, warnings: Counter[str]) -> None:
        super().__init__(warnings)
        self.od = od
        # first and last cross-section of a lane, from its left to its right border
        self.ends: dict[LaneKey, tuple[FloatArray, FloatArray]] = {}

    def build(self) -> Graph:
        narrow = self._collect_nodes()
        for source, target in lane_links(self.od, self.warnings, repair=True):
            if source in self.segments and target in self.segments:
                self.join(source, target)
        self._infer_links()
        self._infer_road_links()
        for key in sorted(narrow):
            self._link_through(key)
        self.drop_wide_gaps(self.ends.__getitem__, SNAP_GAP)
        for links in self.after.values():
            links.sort()
        self.build_lanes(self._groups())
        self.cut_connectors()
        what = "connector without both ends, dropped"
        self.build_connectors(_MAX_CHAIN, self._junctions, what)
        return self.graph

    def is_lane(self, node: LaneKey) -> bool:
        return self.od.roads[node.road].junction is None

    def _junctions(self, keys: Sequence[LaneKey]) -> frozenset[str]:
        found = (self.od.roads[key.road].junction for key in keys)
        return frozenset(junction for junction in found if junction is not None)

    def _collect_nodes(self) -> list[LaneKey]:
        """Fill segments and ends; returns the lanes that are too short or too narrow to keep."""
        unfit = []
        for road in self.od.roads.values():
            line = ReferenceLine(road.geometries)
            for index, section in enumerate(road.sections):
                begin, end = section.s, road.section_end(index)
                s = np.linspace(begin, end, 9)
                borders = section_borders(road, index, s, repair=True)
                poses = line.evaluate(s[[0, -1]])
                for number, lane in section.lanes.items():
                    if not is_drivable(lane):
                        continue
                    key = LaneKey(road.id, index, number)
                    inner, outer = borders.inner[number], borders.outer[number]
                    left, right = poses.offset(inner[[0, -1]]), poses.offset(outer[[0, -1]])
                    ends = [np.stack([left[i], right[i]]) for i in (0, 1)]
                    forward = runs_forward(road, index, number)
                    travel = (begin, end) if forward else (end, begin)
                    self.segments[key] = LaneSegment(key, *travel)
                    self.ends[key] = (ends[0], ends[1]) if forward else (ends[1], ends[0])
                    widest = float(np.abs(outer - inner).max())
                    if end - begin < MIN_LENGTH or widest < MIN_WIDTH:
                        unfit.append(key)
                    if widest > 15.0:
                        self.warnings["driving lane wider than 15 m"] += 1
        return unfit

    def _infer_links(self) -> None:
        """Links between sections of a road that the file forgot: same number, same place."""
        for key in self.segments:
            onward = LaneKey(key.road, key.section + 1, key.lane)
            if onward not in self.segments:
                continue
            is_forward = self._is_forward(key)
            source, target = (key, onward) if is_forward else (onward, key)
            linked = self.after[source] or self.before[target]
            if linked or self._is_forward(onward) != is_forward:
                continue
            if np.abs(self.ends[source][1] - self.ends[target][0]).max() < INFER_GAP:
                self.join(source, target)
                self.warnings["lane link missing between sections, inferred"] += 1

    def _infer_road_links(self) -> None:
        """Links to a linked road that no lane tells of, where lanes touch.

        Lanes that end where another begins, but that nothing links, are counted.
        """
        loose = [key for key in self.segments if not self.after[key]]
        first = [key for key in self.segments if not self._beyond(key, entry=True)[0]]
        if not loose or not first:
            return
        starts = shapely.STRtree(shapely.points([self.ends[key][0].mean(axis=0) for key in first]))
        places = shapely.points([self.ends[key][1].mean(axis=0) for key in loose])
        touching = []
        for i, j in starts.query(places, "dwithin", INFER_GAP).T.tolist():
            source, target = loose[i], first[j]
            turned = np.abs(self.ends[source][1] - self.ends[target][0]).max() >= INFER_GAP
            is_told, onward = self._beyond(source, entry=False)
            if turned or source.road == target.road or is_told:
                continue
            if onward == target.road or self._beyond(target, entry=True)[1] == source.road:
                self.join(source, target)
                self.warnings["lane link missing between linked roads, inferred"] += 1
            elif not self.before[target]:
                touching.append((source, target))
        if touching:
            names = " and ".join(repr(key.road) for key in touching[0])
            what = f"lanes that touch end to end without a link, the first of roads {names}"
            self.warnings[what] += len(touching)

    def _beyond(self, key: LaneKey, *, entry: bool) -> tuple[bool, str | None]:
        """Whether the file names a lane where travel enters (or leaves) one, and the road there."""
        road, at_start = self.od.roads[key.road], self._is_forward(key) == entry
        lane = road.sections[key.section].lanes[key.lane]
        last = 0 if at_start else len(road.sections) - 1
        is_told = key.section != last or bool(lane.predecessors if at_start else lane.successors)
        link = road.predecessor if at_start else road.successor
        return is_told, link.id if link is not None and link.kind == "road" else None

    def _is_forward(self, key: LaneKey) -> bool:
        return runs_forward(self.od.roads[key.road], key.section, key.lane)

    def _link_through(self, key: LaneKey) -> None:
        """Take a lane out and join what lies before it to what follows (nuPlan rule 514)."""
        sources, targets = sorted(self.before[key]), sorted(self.after[key])
        for source in sources:
            self.separate(source, key)
        for target in targets:
            self.separate(key, target)
        for source, target in product(sources, targets):
            if source != target:
                self.join(source, target)
        self.graph.dropped.append(self.segments.pop(key))
        what = "drivable lane shorter than 0.1 m or narrower than 0.5 m, linked through"
        self.warnings[what] += 1

    def _groups(self) -> list[list[LaneKey]]:
        """Lanes of one direction of one section, leftmost first, in the order of their roads."""
        groups: dict[_Group, list[LaneKey]] = defaultdict(list)
        for key in filter(self.is_lane, self.segments):
            groups[key.road, key.section, self._is_forward(key)].append(key)
        order = sorted(groups, key=lambda group: (road_order(group[0]), *group[1:]))
        for (_, _, forward), keys in groups.items():  # seen in the direction of travel
            keys.sort(key=lambda key: -key.lane if forward else key.lane)
        return [groups[group] for group in order]
