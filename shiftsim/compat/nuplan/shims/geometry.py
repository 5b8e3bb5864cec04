"""Times, points, poses and vectors."""

import math
import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from shiftsim.kernels import FloatArray


def part(path: str, doc: str) -> Any:
    """A property that is an attribute of a part: `part("center.x", "Of the centre [m].")`."""
    return property(attrgetter(path), doc=doc)


def derived(function: Callable[[Any], Any], doc: str) -> Any:
    """A property that follows from the others."""
    return property(function, doc=doc)


def _component(index: int, doc: str) -> Any:
    """A property that is one number of a vector, which can be changed."""

    def change(vector: "StateVector2D", value: float) -> None:
        vector.array[index] = value

    return property(lambda vector: float(vector.array[index]), change, doc=doc)


def _scaled(operation: Callable[[float, float], float]) -> Any:
    """An operator between a span and a number, by the seconds of the span."""

    def scale(span: "TimeDuration", number: object) -> Any:
        if isinstance(number, (int, float)):
            return span.from_s(operation(span.time_s, number))
        return NotImplemented

    return scale


@dataclass(init=False, order=True, unsafe_hash=True, repr=False, slots=True)
class TimeDuration:
    """A span of time, whole microseconds; made with `from_us`, `from_ms` or `from_s`."""

    time_us: int

    def __init__(self, *, time_us: int, _direct: bool = True) -> None:
        if _direct:
            raise RuntimeError("a TimeDuration is made with from_us, from_ms or from_s")
        self.time_us = time_us

    @classmethod
    def from_us(cls, t_us: int) -> "TimeDuration":
        return cls(time_us=int(t_us), _direct=False)

    @classmethod
    def from_ms(cls, t_ms: float) -> "TimeDuration":
        """A span in milliseconds, cut to whole microseconds."""
        return cls.from_us(int(t_ms * 1000))

    @classmethod
    def from_s(cls, t_s: float) -> "TimeDuration":
        """A span in seconds, cut to whole microseconds."""
        return cls.from_us(int(t_s * 1_000_000))

    time_ms = derived(lambda self: self.time_us / 1e3, "The span [ms].")
    # nuPlan rule 571: a division here, a product in TimePoint
    time_s = derived(lambda self: self.time_us / 1e6, "The span [s].")

    def __add__(self, other: object) -> Any:
        if isinstance(other, TimeDuration):
            return self.from_us(self.time_us + other.time_us)
        return NotImplemented

    def __sub__(self, other: object) -> Any:
        if isinstance(other, TimeDuration):
            return self.from_us(self.time_us - other.time_us)
        return NotImplemented

    __mul__ = __rmul__ = _scaled(operator.mul)
    __truediv__ = _scaled(operator.truediv)
    __floordiv__ = _scaled(operator.floordiv)

    def __repr__(self) -> str:
        return f"TimeDuration({self.time_s}s)"


@dataclass(order=True, unsafe_hash=True, slots=True)
class TimePoint:
    """A moment: whole microseconds since the epoch, never negative."""

    time_us: int

    def __post_init__(self) -> None:
        assert self.time_us >= 0, f"a time point is not negative: {self.time_us} us"

    time_s = derived(lambda self: self.time_us * 1e-6, "Seconds since the epoch.")

    def __add__(self, other: object) -> Any:
        if isinstance(other, (TimeDuration, TimePoint)):
            return TimePoint(self.time_us + other.time_us)
        return NotImplemented

    __radd__ = __add__

    def __sub__(self, other: object) -> Any:
        # nuPlan rule 572: the difference of two time points is a time point, not a duration
        if isinstance(other, (TimeDuration, TimePoint)):
            return TimePoint(self.time_us - other.time_us)
        return NotImplemented

    def diff(self, time_point: "TimePoint") -> TimeDuration:
        return TimeDuration.from_us(self.time_us - time_point.time_us)


@dataclass(unsafe_hash=True, slots=True)
class Point2D:
    """A point [m]."""

    x: float
    y: float

    def __iter__(self) -> Iterator[float]:
        return iter((self.x, self.y))

    array = derived(lambda self: np.array((self.x, self.y), np.float64), "(2,) x [m], y [m].")


@dataclass(eq=False, slots=True)
class StateSE2(Point2D):
    """A pose: x [m], y [m], heading [rad]. Equal means within 1 mm and 1e-4 rad."""

    heading: float

    point = derived(lambda self: Point2D(self.x, self.y), "The position.")

    def as_matrix(self) -> FloatArray:
        """(3, 3) homogeneous transform from this pose's frame to the map's."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return np.array([[cos, -sin, self.x], [sin, cos, self.y], [0.0, 0.0, 1.0]])

    def distance_to(self, state: Point2D) -> float:
        """Distance between the positions [m]."""
        return float(np.hypot(self.x - state.x, self.y - state.y))

    @staticmethod
    def from_matrix(matrix: FloatArray) -> "StateSE2":
        assert matrix.shape == (3, 3), f"a 3x3 transform is needed, not {matrix.shape}"
        return StateSE2(matrix[0, 2], matrix[1, 2], np.arctan2(matrix[1, 0], matrix[0, 0]))

    @staticmethod
    def deserialize(vector: Sequence[float]) -> "StateSE2":
        if len(vector) != 3:
            raise RuntimeError(f"a pose has 3 numbers, not {len(vector)}")
        return StateSE2(*vector)

    def serialize(self) -> list[float]:
        return [self.x, self.y, self.heading]

    def __iter__(self) -> Iterator[float]:
        return iter((self.x, self.y, self.heading))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, StateSE2):
            return NotImplemented
        return (
            math.isclose(self.x, other.x, abs_tol=1e-3)
            and math.isclose(self.y, other.y, abs_tol=1e-3)
            and math.isclose(self.heading, other.heading, abs_tol=1e-4)
        )

    def __hash__(self) -> int:
        return hash((self.x, self.y, self.heading))


@dataclass(eq=False, slots=True)
class ProgressStateSE2(StateSE2):
    """A pose on a path, with the distance along it [m]."""

    progress: float

    def __init__(self, progress: float, x: float, y: float, heading: float) -> None:
        self.x, self.y, self.heading, self.progress = x, y, heading, progress

    @staticmethod
    def deserialize(vector: Sequence[float]) -> "ProgressStateSE2":
        if len(vector) != 4:
            raise RuntimeError(f"a pose with progress has 4 numbers, not {len(vector)}")
        return ProgressStateSE2(*vector)

    def __iter__(self) -> Iterator[float]:
        return iter((self.progress, self.x, self.y, self.heading))


@dataclass(eq=False, slots=True)
class TemporalStateSE2(StateSE2):
    """A pose at a moment."""

    time_point: TimePoint

    time_us = part("time_point.time_us", "Microseconds since the epoch.")
    time_seconds = part("time_point.time_s", "Seconds since the epoch.")


class StateVector2D:
    """A vector in the plane; `array` is its storage, (2,)."""

    __slots__ = ("array",)

    def __init__(self, x: float, y: float) -> None:
        self.array: FloatArray = np.array((x, y), np.float64)

    x = _component(0, "First component.")
    y = _component(1, "Second component.")

    def magnitude(self) -> float:
        return float(np.hypot(self.x, self.y))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, StateVector2D):
            return NotImplemented
        return bool(np.array_equal(self.array, other.array))

    __hash__ = None  # type: ignore[assignment]  # it can be changed, so it has no hash

    def __repr__(self) -> str:
        return f"x: {self.x}, y: {self.y}"
