"""Roads of generated towns: reference lines from a few pieces, written as OpenDRIVE.

A road is a start pose and a list of pieces (line, arc, clothoid, cubic); what the traffic drives on
is sampled from the same pieces that go into the file.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import accumulate

import numpy as np

from shiftsim.kernels import FloatArray

STEP = 0.5  # m between the points of a line
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)

Pose = tuple[float, float, float]  # x [m], y [m], heading [rad]


@dataclass(frozen=True)
class Piece:
    """One geometry record: a clothoid from `start` to `end` curvature, or a cubic."""

    length: float  # [m]
    start: float = 0.0  # curvature at the start [1/m]
    end: float = 0.0  # curvature at the end [1/m]
    cubic: tuple[float, ...] = ()  # (8,) aU bU cU dU aV bV cV dV over p in [0, 1], or empty


@dataclass(frozen=True)
class LaneSpec:
    """One lane of a road: type, width at both ends [m], lanes before and after."""

    id: int
    type: str
    width: float
    end_width: float
    predecessor: int | None = None
    successor: int | None = None


@dataclass(frozen=True)
class CrosswalkSpec:
    """A crosswalk across a road from `first` to `last` along s, `half` to both sides [m]."""

    name: str
    first: float
    last: float
    half: float


@dataclass(frozen=True)
class RoadSpec:
    """One road."""

    id: int  # road id
    start: Pose
    pieces: tuple[Piece, ...]  # geometry
    lanes: tuple[LaneSpec, ...]  # all lanes except the centre one
    limit_kmh: float  # speed limit [km/h]
    junction: int = -1  # junction id, -1 for none
    predecessor: tuple[str, int, str] | None = None  # element type and id, contact point
    successor: tuple[str, int, str] | None = None  # likewise
    crosswalks: tuple[CrosswalkSpec, ...] = ()  # on this road
    stop_sign: float | None = None  # s of a stop sign for traffic against s; None for none [m]
    # s of traffic lights, and the direction that they are for, + along s, - against it
    lights: tuple[tuple[float, str], ...] = ()

    @property
    def length(self) -> float:
        """Length of the reference line [m]."""
        return sum(piece.length for piece in self.pieces)

    @cached_property
    def records(self) -> list[tuple[float, Pose, Piece]]:
        """Where each piece begins along the road [m], the pose there, and the piece."""
        begins = accumulate((piece.length for piece in self.pieces), initial=0.0)
        poses = accumulate(self.pieces, _end, initial=self.start)
        return list(zip(begins, poses, self.pieces, strict=False))

    @cached_property
    def line(self) -> FloatArray:
        """(n, 2) centre of the only lane of a connecting road, `STEP` apart."""
        return self.center_of(-1, np.arange(0.0, self.length, STEP))[:, :2]

    @property
    def incoming(self) -> tuple[int, int | None]:
        """Road before a connecting road, and its lane."""
        assert self.predecessor is not None
        return self.predecessor[1], self.lanes[0].predecessor

    @property
    def lane_behind(self) -> int:
        """Lane behind a connecting road, from 1 on, counted from the middle of the street."""
        return abs(self.lanes[0].successor or 0)

    def at(self, s: FloatArray, t: FloatArray | float = 0.0) -> FloatArray:
        """(n, 3) x [m], y [m], heading [rad] at road coordinates (s, t)."""
        out = np.empty((len(s), 3))
        for begin, pose, piece in self.records:
            is_last = begin == self.records[-1][0]
            inside = (s >= begin) & ((s < begin + piece.length) | is_last)
            out[inside] = _along(piece, pose, np.minimum(s[inside] - begin, piece.length))
        out[:, 0] -= t * np.sin(out[:, 2])
        out[:, 1] += t * np.cos(out[:, 2])
        return out

    def center_of(self, lane: int, s: FloatArray) -> FloatArray:
        """(n, 3) centre of a lane at s; the heading is that of the road."""
        share = s / self.length
        inner, lane_width = np.zeros(len(s)), np.zeros(len(s))
        for spec in self.lanes:
            width = spec.width + share * (spec.end_width - spec.width)
            if spec.id * lane > 0 and abs(spec.id) < abs(lane):
                inner = inner + width
            lane_width = width if spec.id == lane else lane_width
        return self.at(s, np.sign(lane) * (inner + 0.5 * lane_width))


def connect(start: Sequence[float], end: Sequence[float], *, ease: bool) -> tuple[Piece, ...]:
    """Pieces from one pose to another: a line, a turn, or a cubic where neither fits.

    A turn is clothoid-arc-clothoid with `ease`, else line-arc-line.
    """
    dx, dy = end[0] - start[0], end[1] - start[1]
    cos, sin = np.cos(start[2]), np.sin(start[2])
    u, v = dx * cos + dy * sin, dy * cos - dx * sin
    turn = float((end[2] - start[2] + np.pi) % (2 * np.pi) - np.pi)
    if abs(turn) < 1e-9 and abs(v) < 1e-9:
        return (Piece(float(u)),)
    if abs(turn) < 0.5:
        return (_cubic(float(u), float(v), turn),)
    after = v / np.sin(turn)  # from the corner of the two tangents to the end
    before = u - after * np.cos(turn)
    tangent = float(min(before, after))
    shape = _turn(turn, tangent, ease)
    head, tail = float(before) - tangent, float(after) - tangent
    return tuple(piece for piece in (Piece(head), *shape, Piece(tail)) if piece.length > 1e-6)


def _turn(turn: float, tangent: float, ease: bool) -> list[Piece]:
    if not ease:
        radius = tangent / np.tan(abs(turn) / 2)
        curvature = float(np.sign(turn) / radius)
        return [Piece(float(radius * abs(turn)), curvature, curvature)]
    unit = [Piece(1.0, 0.0, turn / 2), Piece(1.0, turn / 2, turn / 2), Piece(1.0, turn / 2, 0.0)]
    x, y, _ = reduce(_end, unit, (0.0, 0.0, 0.0))
    scale = float(tangent * 2 * np.cos(turn / 2) / np.hypot(x, y))
    return [Piece(p.length * scale, p.start / scale, p.end / scale) for p in unit]


def _cubic(u: float, v: float, turn: float) -> Piece:
    """A Hermite cubic from the origin along u to (u, v), turned by `turn`."""
    reach = float(np.hypot(u, v))
    end_u, end_v = reach * np.cos(turn), reach * np.sin(turn)
    along = (0.0, reach, float(3 * u - 2 * reach - end_u), float(reach + end_u - 2 * u))
    aside = (0.0, 0.0, float(3 * v - end_v), float(end_v - 2 * v))
    return Piece(float(_cubic_arc(along + aside)[1][-1]), cubic=along + aside)


def _cubic_arc(c: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Parameters, and the arc length up to each."""
    p = np.linspace(0.0, 1.0, 401)
    step = p[1] * 0.5 * (_NODES + 1.0)
    at = p[:-1, None] + step
    rate = np.hypot(
        c[1] + 2 * c[2] * at + 3 * c[3] * at**2, c[5] + 2 * c[6] * at + 3 * c[7] * at**2
    )
    return p, np.r_[0.0, np.cumsum(rate @ _WEIGHTS * 0.5 * p[1])]


def _end(pose: Pose, piece: Piece) -> Pose:
    """The pose at the end of a piece that starts at `pose`."""
    x, y, heading = _along(piece, pose, np.array([piece.length]))[0].tolist()
    return x, y, heading


def _along(piece: Piece, pose: Pose, d: FloatArray) -> FloatArray:
    """(n, 3) poses at distances d along a piece that starts at `pose`."""
    if piece.cubic:
        p_grid, arc_grid = _cubic_arc(piece.cubic)
        p = np.interp(d, arc_grid, p_grid)
        c = piece.cubic
        u = c[0] + p * (c[1] + p * (c[2] + p * c[3]))
        v = c[4] + p * (c[5] + p * (c[6] + p * c[7]))
        turn = np.arctan2(
            c[5] + p * (2 * c[6] + 3 * p * c[7]), c[1] + p * (2 * c[2] + 3 * p * c[3])
        )
    else:
        change = (piece.end - piece.start) / piece.length
        at = d[:, None] * 0.5 * (_NODES + 1.0)
        angle = piece.start * at + 0.5 * change * at**2
        u = (np.cos(angle) @ _WEIGHTS) * 0.5 * d
        v = (np.sin(angle) @ _WEIGHTS) * 0.5 * d
        turn = piece.start * d + 0.5 * change * d**2
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.column_stack(
        [pose[0] + u * cos - v * sin, pose[1] + u * sin + v * cos, pose[2] + turn]
    )


def town_xml(name: str, roads: Sequence[RoadSpec]) -> str:
    """The OpenDRIVE file of all roads of a town."""
    header = {"revMajor": 1, "revMinor": 7, "name": name, "version": 1}
    parts = ['<?xml version="1.0" encoding="UTF-8"?>\n<OpenDRIVE>', _xml("header", header)]
    parts += map(_road_xml, roads)
    for junction in sorted({road.junction for road in roads} - {-1}):
        parts.append(f'<junction id="{junction}" name="{name}{junction}">')
        inside = (road for road in roads if road.junction == junction)
        for number, road in enumerate(inside):
            incoming, lane = road.incoming
            ends = {"incomingRoad": incoming, "connectingRoad": road.id, "contactPoint": "start"}
            link = _xml("laneLink", {"from": lane, "to": -1})
            parts.append(_xml("connection", {"id": number, **ends}, link))
        parts.append("</junction>")
    return "\n".join([*parts, "</OpenDRIVE>", ""])


def _xml(tag: str, attributes: Mapping[str, object], *children: str) -> str:
    """An element; numbers are written so that they are read back as they are."""
    begin = "".join([f"<{tag}", *(f' {name}="{value}"' for name, value in attributes.items())])
    return f"{begin}>{''.join(children)}</{tag}>" if children else f"{begin}/>"


def _road_xml(road: RoadSpec) -> str:
    geometry = []
    for begin, (x, y, heading), piece in road.records:
        place = {"s": begin, "x": x, "y": y, "hdg": heading, "length": piece.length}
        geometry.append(_xml("geometry", place, _shape_xml(piece)))
    ends = []
    for name, end in (("predecessor", road.predecessor), ("successor", road.successor)):
        if end:
            contact = {"contactPoint": end[2]} if end[2] else {}
            ends.append(_xml(name, {"elementType": end[0], "elementId": end[1], **contact}))
    speed = _xml("speed", {"max": f"{road.limit_kmh:g}", "unit": "km/h"})
    center = _xml("lane", {"id": 0, "type": "none", "level": "false"})
    sides = {"left": "", "right": ""}
    for lane in sorted(road.lanes, key=lambda lane: -lane.id):
        sides["left" if lane.id > 0 else "right"] += _lane_xml(lane, road)
    left, right = (_xml(side, {}, lanes) if lanes else "" for side, lanes in sides.items())
    section = _xml("laneSection", {"s": 0}, left, _xml("center", {}, center), right)
    objects, signals = map(_crosswalk_xml, road.crosswalks), _signals_xml(road)
    return _xml(
        "road",
        {"id": road.id, "length": road.length, "junction": road.junction, "rule": "RHT"},
        _xml("link", {}, "", *ends),
        _xml("type", {"s": 0, "type": "town"}, speed),
        _xml("planView", {}, *geometry),
        _xml("lanes", {}, section),
        _xml("objects", {}, *objects) if road.crosswalks else "",
        _xml("signals", {}, *signals) if signals else "",
    )


def _shape_xml(piece: Piece) -> str:
    if piece.cubic:
        names = ("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV")
        values = dict(zip(names, piece.cubic, strict=True))
        return _xml("paramPoly3", {"pRange": "normalized", **values})
    if piece.start == piece.end:
        return _xml("arc", {"curvature": piece.start}) if piece.start else _xml("line", {})
    return _xml("spiral", {"curvStart": piece.start, "curvEnd": piece.end})


def _lane_xml(lane: LaneSpec, road: RoadSpec) -> str:
    ends = {"predecessor": lane.predecessor, "successor": lane.successor}
    links = [_xml(name, {"id": other}) for name, other in ends.items() if other is not None]
    slope = (lane.end_width - lane.width) / road.length
    return _xml(
        "lane",
        {"id": lane.id, "type": lane.type, "level": "false"},
        _xml("link", {}, "", *links),
        _xml("width", {"sOffset": 0, "a": lane.width, "b": slope, "c": 0, "d": 0}),
    )


def _crosswalk_xml(walk: CrosswalkSpec) -> str:
    half = 0.5 * (walk.last - walk.first)
    corners = (
        _xml("cornerLocal", {"u": u * half, "v": v * walk.half, "z": 0, "height": 0})
        for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    )
    names = {"id": walk.name, "type": "crosswalk", "name": walk.name}
    place = {"s": 0.5 * (walk.first + walk.last), "t": 0, "zOffset": 0, "hdg": 0}
    size = {"orientation": "none", "length": 2 * half, "width": 2 * walk.half}
    return _xml("object", {**names, **place, **size}, _xml("outline", {}, *corners))


def _signals_xml(road: RoadSpec) -> list[str]:
    stop = {"dynamic": "no", "orientation": "-", "zOffset": 2, "country": "DE", "type": 206}
    light = {"zOffset": 4, "country": "OpenDRIVE", "type": 1000001, "subtype": -1, "value": -1}
    signals = []
    if road.stop_sign is not None:
        place = {"id": f"{road.id}1", "s": road.stop_sign, "t": 5, "name": "stop"}
        signals.append(_xml("signal", {**place, **stop, "subtype": -1, "value": -1}))
    for number, (s, orientation) in enumerate(road.lights, start=2):
        place = {"id": f"{road.id}{number}", "s": s, "t": 5, "name": "light", "dynamic": "yes"}
        signals.append(_xml("signal", {**place, "orientation": orientation, **light}))
    return signals
