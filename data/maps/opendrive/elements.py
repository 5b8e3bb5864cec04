"""Elements of an OpenDRIVE file: numbers, with a count of what is wrong, objects and signals."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from shiftsim.data.maps.opendrive.records import Outline, Repeat, RoadObject, Signal
from shiftsim.errors import ConversionError
from shiftsim.kernels import FloatArray
from shiftsim.world.ranges import CHECK, OPENDRIVE

CUBIC = ("a", "b", "c", "d")
CRUMB = 1e-3  # m, absurd records that are shorter are rounding of an editor
# elements that cost their road where a number of theirs is out of range
_SHAPING = frozenset("arc spiral poly3 paramPoly3 width border laneOffset elevation".split())
_LEADING_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)")


class AbsurdRecordError(ConversionError):
    """A number of a geometry or a width is out of range: the road cannot be drawn."""


@dataclass
class Reader:
    """Reads attributes of one file and keeps count of what was wrong."""

    source: str  # name of the file
    place: str = "header"  # road or junction at hand, for messages
    warnings: Counter[str] = field(default_factory=Counter)  # count by kind
    # how many lanes with a vendor's direction of travel have the one of right-hand traffic
    told: Counter[bool] = field(default_factory=Counter)

    def error(self, what: str, hint: str) -> ConversionError:
        """An error that names file and place."""
        return ConversionError(f"{self.source}, {self.place}: {what}", hint)

    def warn(self, kind: str) -> None:
        """Count one thing that was repaired or left out."""
        self.warnings[kind] += 1

    def number(
        self, element: Any, name: str, default: float = 0.0, *, may_be_any: bool = False
    ) -> float:
        """An attribute as a number in its range.

        One that is not finite, or with `may_be_any` any number at all, is left to the caller.
        """
        text = element.get(name)
        if text is None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = self._rescued(element, name, text)
        allowed = OPENDRIVE[f"{element.tag} {name}"]
        if may_be_any or allowed.low <= value <= allowed.high or not np.isfinite(value):
            return value
        what = f"{element.tag} (line {element.sourceline}) has {name}={text[:40]!r}"
        error = self.error(f"{what}, not within {allowed}", CHECK)
        raise AbsurdRecordError(error.message, CHECK) if element.tag in _SHAPING else error

    def _rescued(self, element: Any, name: str, text: str) -> float:
        found = _LEADING_NUMBER.match(text.replace(",", ".", 1))
        if found is None:
            what = f"{element.tag} (line {element.sourceline}) has {name}={text[:40]!r}"
            raise self.error(what, "write a number with a decimal point there")
        self.warn("badly written number")
        return float(found[1])

    def finite(self, element: Any, name: str, default: float = 0.0) -> float:
        """An attribute as a finite number in its range."""
        value = self.number(element, name, default)
        if not np.isfinite(value):
            what = f"{element.tag} (line {element.sourceline}) has {name}={value}"
            raise self.error(what, "write a finite number there")
        return value

    def integer(self, element: Any, name: str) -> int | None:
        """An attribute as an integer, be it written `1.0`; None where it is missing or not one."""
        try:
            return int(re.sub(r"\.0+\s*$", "", element.get(name)))
        except (TypeError, ValueError):
            return None

    def pairs(self, parent: Any, tag: str, names: tuple[str, str]) -> tuple[tuple[int, int], ...]:
        """Two integers of each child of a kind, where it has both."""
        found = [[self.integer(child, name) for name in names] for child in parent.findall(tag)]
        return tuple((a, b) for a, b in found if a is not None and b is not None)

    def cubics(self, elements: list[Any], key: str, end: float = np.inf) -> FloatArray:
        """(n, 5) rows s, a, b, c, d by s, the last up to `end`; what is not finite is left out."""
        starts = [self.number(element, key) for element in elements]
        rows = np.array(
            [
                [begin, *self._cubic(element, 0 <= stop - begin < CRUMB)]
                for element, begin, stop in zip(elements, starts, [*starts[1:], end], strict=False)
            ],
            np.float64,
        ).reshape(-1, 5)
        finite = np.isfinite(rows).all(axis=1)
        if not finite.all():
            self.warnings["polynomial record that is not finite, left out"] += int((~finite).sum())
            rows = rows[finite]
        if len(rows) > 1 and (np.diff(rows[:, 0]) < 0).any():
            self.warn("records out of order")
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
        return rows

    def _cubic(self, element: Any, is_crumb: bool) -> list[float]:
        """Coefficients of a cubic; of one that is absurd but shorter than 1 mm only the first."""
        values, fits = self.coefficients(element, CUBIC, is_crumb)
        if all(fits):
            return values
        self.warn("absurd record shorter than 1 mm, ignored")
        return [values[0] if fits[0] else np.nan, 0, 0, 0]

    def coefficients(
        self, element: Any, names: Sequence[str], is_crumb: bool
    ) -> tuple[list[float], list[bool]]:
        """Coefficients of a curve, and which of them fit their ranges; a crumb's may be any."""
        values = [self.number(element, name, may_be_any=is_crumb) for name in names]
        allowed = [OPENDRIVE[f"{element.tag} {name}"] for name in names]
        fits = [
            bool(a.holds(v)) or not math.isfinite(v) for a, v in zip(allowed, values, strict=True)
        ]
        return values, fits


def read_object(element: Any, reader: Reader) -> RoadObject:
    """One object; outlines with numbers that are not finite are left out."""
    outlines = [_read_outline(outline, reader) for outline in element.iter("outline")]
    return RoadObject(
        **{key: element.get(key, "") for key in ("id", "type", "subtype", "name")},
        s=reader.finite(element, "s"),
        t=reader.finite(element, "t"),
        heading=reader.finite(element, "hdg"),
        length=_optional(element, "length", reader),
        width=_optional(element, "width", reader),
        outlines=tuple(outline for outline in outlines if outline is not None),
        repeats=tuple(_read_repeat(e, reader) for e in element.findall("repeat")),
        lanes=_read_validity(element, reader),
    )


def _read_outline(element: Any, reader: Reader) -> Outline | None:
    on_road = element.find("cornerRoad") is not None
    tag, keys = ("cornerRoad", ("s", "t")) if on_road else ("cornerLocal", ("u", "v"))
    corners = np.array(
        [[reader.number(e, k) for k in keys] for e in element.findall(tag)], np.float64
    ).reshape(-1, 2)
    if len(corners) == 0:
        return None
    if not np.isfinite(corners).all():
        reader.warn("outline that is not finite, left out")
        return None
    return Outline(on_road, corners)


def _read_repeat(element: Any, reader: Reader) -> Repeat:
    t_start = reader.finite(element, "tStart")
    s, length, distance = (reader.finite(element, name) for name in ("s", "length", "distance"))
    return Repeat(s, length, distance, t_start, reader.finite(element, "tEnd", t_start))


def _read_validity(element: Any, reader: Reader) -> tuple[tuple[int, int], ...]:
    ranges = reader.pairs(element, "validity", ("fromLane", "toLane"))
    return tuple((min(pair), max(pair)) for pair in ranges)


def _optional(element: Any, name: str, reader: Reader) -> float | None:
    if element.get(name) is None:
        return None
    value = reader.number(element, name)
    return value if np.isfinite(value) else None


def read_signal(element: Any, reader: Reader) -> Signal:
    """One signal, or a reference to one."""
    kind, subtype = element.get("type", ""), element.get("subtype", "")
    subtype = "" if subtype in ("-1", "none") else subtype
    return Signal(
        **{key: element.get(key, "") for key in ("id", "name", "country", "unit")},
        type=kind,
        subtype=subtype,
        dynamic=element.get("dynamic") == "yes",
        s=reader.finite(element, "s"),
        t=reader.finite(element, "t"),
        orientation=element.get("orientation", "none"),
        value=_optional(element, "value", reader),
        width=_optional(element, "width", reader),
        lanes=_read_validity(element, reader),
        reference=element.tag == "signalReference",
    )
