"""What governs traffic: lights, signs and stop lines at junctions, and speed limits."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
import shapely

from shiftsim.data.maps.builder import StopArea
from shiftsim.data.maps.opendrive.areas import is_stop_line, rings_of
from shiftsim.data.maps.opendrive.graph import Graph, LaneSegment
from shiftsim.data.maps.opendrive.records import SPEED_UNITS, OpenDrive, Road, Signal
from shiftsim.data.maps.opendrive.shapes import Shapes
from shiftsim.data.polygons import largest_part
from shiftsim.kernels import FloatArray

LIGHT, STOP, YIELD = "light", "stop", "yield"
STOP_KINDS = {LIGHT: 2, STOP: 1, YIELD: 4}  # kinds of stop polygons
STOP_LINE_DEPTH = 1.0  # m
_APPROACH = 100.0  # m before a junction within which a signal governs it
_NEAR_END = 10.0  # m between a drawn stop line and the end of its lane
_SIGNS = {"206": STOP, "R1-1": STOP, "205": YIELD, "R1-2": YIELD}  # by type
_KMH, _MPH = SPEED_UNITS["km/h"], SPEED_UNITS["mph"]
TOWN = ("town", "townCollector", "townArterial", "townLocal", "townPrivate")
_DEFAULTS_DE: dict[str, float | None] = {
    **dict.fromkeys(TOWN, 50 * _KMH),
    "lowSpeed": 30 * _KMH,
    **dict.fromkeys(("pedestrian", "townPlayStreet"), 10 * _KMH),
    **dict.fromkeys(("rural", "townExpressway"), 100 * _KMH),
    "motorway": None,
}
_DEFAULTS_US = _DEFAULTS_DE | dict.fromkeys(TOWN, 25 * _MPH) | {"motorway": 65 * _MPH}


def signal_control(signal: Signal) -> str | None:
    """What a signal asks of traffic: LIGHT, STOP, YIELD, or None."""
    is_light = signal.dynamic and signal.type.startswith("1000")
    return LIGHT if is_light else _SIGNS.get(signal.type)


def connector_controls(od: OpenDrive, graph: Graph) -> list[frozenset[str]]:
    """What governs each connector: signals on its own roads, or before it on its lane."""
    signals = [signal for road in od.roads.values() for signal in road.signals]
    known = {signal.id: signal for signal in signals if not signal.reference}
    controls = []
    for connector in graph.connectors:
        last = graph.lanes[connector.source].segments[-1]
        places = [*((piece, np.inf) for piece in connector.segments), (last, _APPROACH)]
        found = set[str | None]()
        for piece, reach in places if connector.junctions else ():
            side = "+" if piece.is_forward else "-"
            found |= {
                signal_control(known.get(signal.id, signal))
                for signal in od.roads[piece.key.road].signals
                if signal.orientation in ("none", side)
                and applies_to(signal, piece.key.lane)
                and abs(signal.s - piece.end) <= reach
            }
        controls.append(frozenset(control for control in found if control))
    return controls


def stop_lines(
    od: OpenDrive,
    graph: Graph,
    shapes: Shapes,
    controls: Sequence[frozenset[str]],  # what governs each connector
    polygons: Sequence[shapely.Polygon],  # of the lanes
) -> list[StopArea]:
    """One stop line per lane that ends at a controlled or marked junction (nuPlan rule 506)."""
    by_lane: dict[int, set[str]] = {}
    for connector, governed in zip(graph.connectors, controls, strict=True):
        if connector.junctions:
            by_lane.setdefault(connector.source, set()).update(governed)
    drawn = _drawn_lines(od, shapes)
    tree = shapely.STRtree(np.array(drawn, dtype=object))
    lines = []
    for lane, found in sorted(by_lane.items()):
        left, right = shapes.borders(graph.lanes[lane].segments[-1])
        box = _end_box(left, right)
        near = tree.query(box.buffer(_NEAR_END), predicate="intersects").tolist()
        near = [i for i in near if polygons[lane].intersects(drawn[i])]
        near = [i for i in near if drawn[i].distance(box) < _NEAR_END]
        if near:
            line = drawn[min(near, key=lambda i: drawn[i].distance(box))]
            if line.area <= 0.1:  # drawn without a depth
                line = line.buffer(STOP_LINE_DEPTH / 2, cap_style="flat")
            box = shapely.intersection(line, polygons[lane])
        if (found or near) and (polygon := largest_part(box)).area > 0.01:
            control = next((c for c in (LIGHT, STOP, YIELD) if c in found), STOP)
            lines.append(StopArea(polygon, STOP_KINDS[control], lane))
    return lines


def _drawn_lines(od: OpenDrive, shapes: Shapes) -> list[shapely.Geometry]:
    drawn: list[shapely.Geometry] = []
    for road in od.roads.values():
        rings = rings_of([road], shapes, is_stop_line, least=2)
        drawn += [shapely.MultiPoint(ring).convex_hull for ring in rings]
        for signal in road.signals:
            is_finite = np.isfinite([signal.s, signal.t]).all()
            if signal.type == "294" and not signal.reference and is_finite:
                half = (signal.width or 3.0) / 2
                ends = shapes.lines[road.id].evaluate(np.full(2, signal.s))
                drawn.append(shapely.LineString(ends.offset(signal.t + np.array([-half, half]))))
    return drawn


def _end_box(left: FloatArray, right: FloatArray) -> shapely.Polygon:
    """A rectangle across the end of a lane, as deep as a stop line."""
    across = left[-1] - right[-1]
    width = float(np.hypot(*across))
    if width < 1e-3:
        return shapely.Polygon()
    back = STOP_LINE_DEPTH * np.array([across[1], -across[0]]) / width
    if back @ (left[-2] - left[-1]) < 0:
        back = -back
    return shapely.Polygon([left[-1], right[-1], right[-1] + back, left[-1] + back])


def speed_limits(
    od: OpenDrive, segment: LaneSegment, country: str
) -> Iterator[tuple[float | None, float]]:
    """Limits along a segment [m/s], None for none, and over which lengths they hold [m]."""
    road = od.roads[segment.key.road]
    start = road.sections[segment.key.section].s
    lane = road.sections[segment.key.section].lanes[segment.key.lane]
    low, high = segment.span
    places = [start + r.s for r in lane.speeds] + [t.s for t in road.types]
    places += [signal.s for signal in road.signals]
    for begin, end in pairwise(sorted({low, high, *(s for s in places if low < s < high)})):
        yield _limit_at(road, segment, 0.5 * (begin + end), country), end - begin


def _limit_at(road: Road, piece: LaneSegment, s: float, country: str) -> float | None:
    section = road.sections[piece.key.section]
    own = [speed for speed in section.lanes[piece.key.lane].speeds if speed.s <= s - section.s]
    if own and own[-1].limit is not None:  # else the limit of the road holds
        return own[-1].limit
    kinds = [kind for kind in road.types if kind.s <= s] or list(road.types[:1])
    if kinds and kinds[-1].speed is not None:
        return kinds[-1].speed.limit
    signal = _signal_limit(road, piece, s)
    if signal is not None:
        return signal
    land = (kinds[-1].country if kinds else "") or country
    table = _DEFAULTS_US if land.upper() in ("US", "USA") else _DEFAULTS_DE
    return table.get(kinds[-1].type if kinds else "town", table["town"])


def _signal_limit(road: Road, piece: LaneSegment, s: float) -> float | None:
    """Limit of the last sign that traffic has passed on this road."""
    forward = piece.is_forward
    passed = [
        (signal.s, limit)
        for signal in road.signals
        if (signal.s <= s) == forward
        and signal.orientation in ("none", "+" if forward else "-")
        and applies_to(signal, piece.key.lane)
        and (limit := _sign_value(signal)) is not None
    ]
    if not passed:
        return None
    return (max if forward else min)(passed)[1]


def applies_to(signal: Signal, lane: int) -> bool:
    """Whether a signal is valid for a lane."""
    return not signal.lanes or any(low <= lane <= high for low, high in signal.lanes)


def _sign_value(signal: Signal) -> float | None:
    """Limit on a speed sign [m/s]; None for any other signal."""
    is_us = signal.type in ("R2-1", "r2_1")
    if signal.type != "274" and not is_us:
        return None
    value = signal.value if signal.value and signal.value > 0 else None
    if value is None and signal.subtype.isdecimal():
        number = int(signal.subtype)
        value = float((number - 50) * 10 if 51 <= number <= 63 else number)  # nuPlan rule 509
    if value is None or value <= 0:
        return None
    return value * SPEED_UNITS.get(signal.unit.lower(), _MPH if is_us else _KMH)
