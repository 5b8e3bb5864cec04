"""Lane borders along a road, and which lane leads to which.

Borders are distances t to the left of the reference line; lanes stack outward from the shifted
centre line. Links are directed edges in the direction of travel.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np

from shiftsim.data.maps.opendrive.curves import ReferenceLine
from shiftsim.data.maps.opendrive.records import Connection, Lane, OpenDrive, Road, RoadLink
from shiftsim.kernels import FloatArray

BEFORE_END = 1e-9  # m: the end of a section still belongs to it
_TOUCHING, _APART = 0.5, 2.0  # m between linked lanes at the near end, and at the wrong one
_MAX_OFFSET = 500.0  # m from the reference line, so that absurd polynomials stay harmless
START, END = "start", "end"
_Side: TypeAlias = tuple[Road, int, int, str]  # road, section, lane, and the end that touches


class LaneKey(NamedTuple):
    """A lane of one section of one road: what the lane graph is made of."""

    road: str
    section: int
    lane: int


@dataclass(frozen=True)
class SectionBorders:
    """Borders of all lanes of a section at K places."""

    # per lane, (K,) distances t, or (K, 2) points [m]
    inner: dict[int, FloatArray]  # of the border next to the centre
    outer: dict[int, FloatArray]  # of the other border


def evaluate_cubics(records: FloatArray, s: FloatArray, look_up: FloatArray) -> FloatArray:
    """Piecewise cubic (n, 5) s, a, b, c, d at `s` (K,) [m], 0 before its first record.

    `look_up` is where to look for the record; it differs from `s` at the end of a section.
    """
    if len(records) == 0:
        return np.zeros_like(s)
    index = np.searchsorted(records[:, 0], look_up, side="right") - 1
    start, a, b, c, d = records[np.maximum(index, 0)].T
    x = s - start
    with np.errstate(over="ignore", invalid="ignore"):  # absurd polynomials are cut off later
        return np.where(index < 0, 0.0, a + x * (b + x * (c + x * d)))


def section_borders(
    road: Road,
    section: int,
    s: FloatArray,
    *,
    repair: bool = False,
    look_up: FloatArray | None = None,
) -> SectionBorders:
    """Borders of the lanes of a section at road distances `s` (K,) within it [m].

    With `repair`, negative widths count as 0, borders of right lanes that were written as positive
    numbers are put on the right, and records that begin at the very end of the section are left to
    the next one. `look_up` is where to look for the records instead of at `s`.
    """
    s = np.asarray(s, np.float64)
    begin, end = road.sections[section].s, road.section_end(section)
    if look_up is None:
        look_up = np.minimum(s, max(end - BEFORE_END, begin)) if repair else s
    lanes = road.sections[section].lanes
    center = evaluate_cubics(road.offsets, s, look_up)
    if repair:
        center = np.clip(np.nan_to_num(center), -0.5 * _MAX_OFFSET, 0.5 * _MAX_OFFSET)
    borders = SectionBorders({}, {})
    for sign in (1, -1):
        previous = center
        for number in sorted((i for i in lanes if i * sign > 0), key=abs):
            lane = lanes[number]
            borders.inner[number] = previous
            # nuPlan rule 502: widths win over borders; nothing at all is width 0
            if len(lane.widths) or not len(lane.borders):
                outer = previous + sign * evaluate_cubics(lane.widths, s - begin, look_up - begin)
            else:
                outer = evaluate_cubics(lane.borders, s - begin, look_up - begin)
                outer = -outer if repair and border_is_mirrored(lane) else outer
            if repair:
                outer = np.clip(sign * np.nan_to_num(outer), sign * previous, _MAX_OFFSET) * sign
            previous = borders.outer[number] = outer
    return borders


def border_is_mirrored(lane: Lane) -> bool:
    """Whether all border records of a right lane lie on the left (nuPlan rule 513)."""
    return lane.id < 0 and not len(lane.widths) and bool((lane.borders[:, 1] > 0).all())


def runs_forward(road: Road, section: int, lane: int) -> bool:
    """Whether traffic on a lane moves along s; two-way lanes count as of their own side."""
    is_reversed = road.sections[section].lanes[lane].direction == "reversed"
    return ((lane < 0) != road.left_hand) != is_reversed


def lane_links(
    od: OpenDrive, warnings: Counter[str], *, repair: bool = False
) -> list[tuple[LaneKey, LaneKey]]:
    """Directed edges between lanes of all types, in the direction of travel, sorted.

    Only what the file links, nothing inferred from geometry; links that lead nowhere are counted.
    With `repair`, contact points that name the far end are put right.
    """
    linker = _Linker(od, warnings, repair)
    for road in od.roads.values():
        linker.link_sections(road)
        for end, link in ((START, road.predecessor), (END, road.successor)):
            if link is not None and link.kind == "road":
                linker.link_roads(road, end, link)
            elif link is not None and link.id not in od.junctions:
                warnings["link to a junction that does not exist, dropped"] += 1
    for junction in od.junctions.values():
        if junction.type == "virtual":
            warnings["virtual junction: its side connections are left out"] += 1
            continue
        for connection in junction.connections:
            linker.link_connection(junction.id, connection)
    return sorted(linker.edges)


@dataclass
class _Linker:
    """Collects edges between lanes that touch, in the direction of travel."""

    od: OpenDrive
    warnings: Counter[str]
    repair: bool  # whether to put contact points right
    edges: set[tuple[LaneKey, LaneKey]] = field(default_factory=set)
    middles: dict[tuple[str, str], dict[int, list[float]]] = field(default_factory=dict)

    def link_sections(self, road: Road) -> None:
        """Links between the sections of one road."""
        for index in range(len(road.sections) - 1):
            before, after = road.sections[index], road.sections[index + 1]
            pairs = {(i, j) for i, lane in before.lanes.items() for j in lane.successors}
            pairs |= {(i, j) for j, lane in after.lanes.items() for i in lane.predecessors}
            for i, j in sorted(pairs):
                self._add((road, index, i, END), (road, index + 1, j, START))

    def link_roads(self, road: Road, end: str, link: RoadLink) -> None:
        """Links from one end of a road to the next road."""
        other = self.od.roads.get(link.id)
        if other is None:
            self.warnings["link to a road that does not exist, dropped"] += 1
            return
        if not road.sections or not other.sections:
            return
        contact = link.contact or nearer_end(road, end, other)
        here = _end_section(road, end)
        lanes = road.sections[here].lanes.items()
        pairs = [(i, j) for i, x in lanes for j in (x.successors if end == END else x.predecessors)]
        _, contact = self._meeting(road, [end], other, contact, pairs)
        there = _end_section(other, contact)
        for number, target in pairs:
            self._add((road, here, number, end), (other, there, target, contact))

    def link_connection(self, junction: str, connection: Connection) -> None:
        """Lane links of a junction."""
        incoming = self.od.roads.get(connection.incoming)
        connecting = self.od.roads.get(connection.connecting)
        if incoming is None or connecting is None:
            self.warnings["link to a road that does not exist, dropped"] += 1
            return
        if not incoming.sections or not connecting.sections:
            return
        links = ((START, incoming.predecessor), (END, incoming.successor))
        ends = [e for e, x in links if x and (x.kind, x.id) == ("junction", junction)]
        contact = connection.contact or nearer_end(incoming, (ends or [END])[0], connecting)
        end = ends[0] if len(ends) == 1 else nearer_end(connecting, contact, incoming)
        both = ends if len(ends) == 1 else [end, START if end == END else END]
        end, contact = self._meeting(incoming, both, connecting, contact, connection.lane_links)
        here, there = _end_section(incoming, end), _end_section(connecting, contact)
        for source, target in connection.lane_links:
            self._add((incoming, here, source, end), (connecting, there, target, contact))

    def _meeting(
        self,
        road: Road,
        ends: Sequence[str],  # of `road` that may be meant, the likely one first
        other: Road,
        contact: str,  # end of `other` that the file names
        pairs: Sequence[tuple[int, int]],  # lanes of `road` and `other` that are linked
    ) -> tuple[str, str]:
        """The ends that meet: those of the file, or where they are far apart others that touch."""
        if not self.repair:
            return ends[0], contact
        ways = [(end, at) for end in ends for at in (contact, START if contact == END else END)]
        gaps = [
            min((self._gap((road.id, end, a), (other.id, at, b)) for a, b in pairs), default=0.0)
            for end, at in ways
        ]
        best = int(np.argmin(gaps))
        if not (gaps[0] > _APART and gaps[best] < _TOUCHING):
            return ways[0]
        self.warnings["contact point that names the far end, the near end taken"] += 1
        return ways[best]

    def _gap(self, *sides: tuple[str, str, int]) -> float:
        """Distance of two lanes (road, end, lane) there [m]; inf where one does not exist."""
        one, other = (self._middles(road, end).get(lane) for road, end, lane in sides)
        return np.inf if one is None or other is None else math.dist(one, other)

    def _middles(self, name: str, end: str) -> dict[int, list[float]]:
        """Middle of every lane of a road at one of its ends, x and y [m]."""
        if (name, end) not in self.middles:
            road = self.od.roads[name]
            s = np.array([0.0 if end == START else road.length])
            borders = section_borders(road, _end_section(road, end), s, repair=True)
            pose = ReferenceLine(road.geometries).evaluate(s)
            self.middles[name, end] = {
                lane: pose.offset(0.5 * (inner + borders.outer[lane]))[0].tolist()
                for lane, inner in borders.inner.items()
            }
        return self.middles[name, end]

    def _add(self, side: _Side, other: _Side) -> None:
        """A link of two lanes that touch, where traffic can pass (nuPlan rule 503)."""
        if 0 in (side[2], other[2]):
            return
        leaves = []
        for road, section, lane, end in (side, other):
            if lane not in road.sections[section].lanes:
                self.warnings["link to a lane that does not exist, dropped"] += 1
                return
            leaves.append(runs_forward(road, section, lane) == (end == END))
        source, target = (LaneKey(road.id, *place) for road, *place, _ in (side, other))
        if leaves[0] == leaves[1]:
            self.warnings["lane link against the direction of travel, dropped"] += 1
        else:
            self.edges.add((source, target) if leaves[0] else (target, source))


def _end_section(road: Road, end: str) -> int:
    return 0 if end == START else len(road.sections) - 1


def nearer_end(road: Road, end: str, other: Road) -> str:
    """The end of `other` that lies nearer to an end of `road`; a tie goes to its start."""
    at = np.array([0.0 if end == START else road.length])
    here = ReferenceLine(road.geometries).evaluate(at)
    there = ReferenceLine(other.geometries).evaluate(np.array([0.0, other.length]))
    distances = np.hypot(there.x - here.x, there.y - here.y)
    return START if distances[0] <= distances[1] else END
