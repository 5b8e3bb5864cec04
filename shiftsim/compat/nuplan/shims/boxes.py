"""Vehicle dimensions and oriented boxes."""

import math
from dataclasses import astuple, dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
import shapely

from shiftsim.compat.nuplan.shims.geometry import Point2D, StateSE2, derived, part
from shiftsim.compat.nuplan.shims.transforms import (
    translate_longitudinally,
    translate_longitudinally_and_laterally,
)
from shiftsim.world import state


class _Halves:
    """What follows from width and length."""

    width: Any
    length: Any

    half_width = derived(lambda self: float(self.width / 2.0), "Half the width [m].")
    half_length = derived(lambda self: float(self.length / 2.0), "Half the length [m].")


@dataclass
class BoxParameters(_Halves):
    """Width and length [m]."""

    width: float
    length: float


@dataclass(unsafe_hash=True)
class VehicleParameters(BoxParameters):
    """Dimensions of a vehicle [m]."""

    length: float = field(init=False)
    front_length: float
    rear_length: float
    cog_position_from_rear_axle: float
    wheel_base: float
    vehicle_name: str
    vehicle_type: str
    height: float | None = None

    def __post_init__(self) -> None:
        self.length = self.front_length + self.rear_length

    rear_axle_to_center = derived(
        lambda self: self.half_length - self.rear_length,
        "From the rear axle forward to the centre of the box [m].",
    )
    length_cog_to_front_axle = derived(
        lambda self: self.wheel_base - self.cog_position_from_rear_axle,
        "From the centre of gravity forward to the front axle [m].",
    )


def dimensions_of(vehicle: state.VehicleParameters) -> tuple[Any, ...]:
    """What nuPlan makes its own parameters of; a part of shiftsim."""
    # rear axle to the centre of gravity [m], nuPlan's pacifica
    axles = 1.67, vehicle.wheel_base
    bumpers = vehicle.front_length, vehicle.rear_length
    return vehicle.width, *bumpers, *axles, "pacifica", "gen1", vehicle.height


def get_pacifica_parameters() -> VehicleParameters:
    """The car of nuPlan, which is also shiftsim's ego."""
    return VehicleParameters(*dimensions_of(state.PACIFICA))


class OrientedBoxPointType(IntEnum):
    """Points of a box."""

    FRONT_BUMPER, REAR_BUMPER, FRONT_LEFT, FRONT_RIGHT = range(1, 5)
    REAR_LEFT, REAR_RIGHT, CENTER, LEFT, RIGHT = range(5, 10)


# half lengths forward and half widths to the left of the centre
_WHERE = {
    OrientedBoxPointType.FRONT_LEFT: (1, 1),
    OrientedBoxPointType.REAR_LEFT: (-1, 1),
    OrientedBoxPointType.REAR_RIGHT: (-1, -1),
    OrientedBoxPointType.FRONT_RIGHT: (1, -1),
    OrientedBoxPointType.FRONT_BUMPER: (1, 0),
    OrientedBoxPointType.REAR_BUMPER: (-1, 0),
    OrientedBoxPointType.LEFT: (0, 1),
    OrientedBoxPointType.RIGHT: (0, -1),
}
_CORNERS = tuple(_WHERE)[:4]


@dataclass(frozen=True)
class Dimension:
    """Length, width and height [m]."""

    length: float
    width: float
    height: float


class OrientedBox(_Halves):
    """A box by the pose of its centre and its size [m]; its polygon is made when asked for."""

    def __init__(self, center: StateSE2, length: float, width: float, height: float) -> None:
        self.dimensions = Dimension(length, width, height)
        self._center = center

    @classmethod
    def from_new_pose(cls, box: "OrientedBox", pose: StateSE2) -> "OrientedBox":
        return OrientedBox(pose, *astuple(box.dimensions))

    center = part("_center", "Pose of the centre.")
    length = part("dimensions.length", "Length [m].")
    width = part("dimensions.width", "Width [m].")
    height = part("dimensions.height", "Height [m].")

    half_height = derived(lambda self: float(self.height / 2.0), "Half the height [m].")

    def corner(self, point: OrientedBoxPointType) -> Point2D:
        if point == OrientedBoxPointType.CENTER:
            return self.center.point
        along, across = _WHERE[point]
        return translate_longitudinally_and_laterally(
            self.center, along * self.half_length, across * self.half_width
        ).point

    def all_corners(self) -> list[Point2D]:
        """Front left, rear left, rear right, front right."""
        return [self.corner(point) for point in _CORNERS]

    @cached_property
    def geometry(self) -> shapely.Polygon:
        return shapely.Polygon([(point.x, point.y) for point in self.all_corners()])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OrientedBox):
            return NotImplemented
        pairs = zip(astuple(self.dimensions), astuple(other.dimensions), strict=True)
        return all(math.isclose(a, b) for a, b in pairs) and self.center == other.center

    def __hash__(self) -> int:
        return hash((self.center, self.dimensions))


class CarFootprint(OrientedBox):
    """The box of a vehicle."""

    def __init__(self, center: StateSE2, vehicle_parameters: VehicleParameters) -> None:
        height: Any = vehicle_parameters.height
        super().__init__(center, vehicle_parameters.length, vehicle_parameters.width, height)
        self.vehicle_parameters = vehicle_parameters

    @classmethod
    def build_from_rear_axle(
        cls, rear_axle_pose: StateSE2, vehicle_parameters: VehicleParameters
    ) -> "CarFootprint":
        """From the pose of the rear axle, which is kept as it is."""
        distance = vehicle_parameters.rear_axle_to_center
        footprint = cls(translate_longitudinally(rear_axle_pose, distance), vehicle_parameters)
        footprint.__dict__["rear_axle"] = rear_axle_pose  # nuPlan computes it back, off by one bit
        return footprint

    @classmethod
    def build_from_center(
        cls, center: StateSE2, vehicle_parameters: VehicleParameters
    ) -> "CarFootprint":
        return cls(center, vehicle_parameters)

    @classmethod
    def build_from_cog(
        cls, cog_pose: StateSE2, vehicle_parameters: VehicleParameters
    ) -> "CarFootprint":
        """From the pose of the centre of gravity."""
        behind = vehicle_parameters.cog_position_from_rear_axle
        distance = vehicle_parameters.rear_axle_to_center - behind
        return cls(translate_longitudinally(cog_pose, distance), vehicle_parameters)

    def get_point_of_interest(self, point_of_interest: OrientedBoxPointType) -> Point2D:
        return self.corner(point_of_interest)

    oriented_box = derived(lambda self: self, "The box itself.")
    rear_axle_to_center_dist = derived(
        lambda self: float(self.vehicle_parameters.rear_axle_to_center),
        "From the rear axle forward to the centre [m].",
    )

    @cached_property
    def rear_axle(self) -> StateSE2:
        return translate_longitudinally(self.center, -self.rear_axle_to_center_dist)


def collision_by_radius_check(
    box1: OrientedBox, box2: OrientedBox, radius_threshold: float | None
) -> bool:
    """Whether the centres are nearer than a radius [m]; without one, whether the circles meet."""
    reach = radius_threshold or 0.5 * (
        np.hypot(box1.width, box1.length) + np.hypot(box2.width, box2.length)
    )
    return bool(box1.center.distance_to(box2.center) < reach)


def in_collision(
    box1: OrientedBox, box2: OrientedBox, radius_threshold: float | None = None
) -> bool:
    """Whether two boxes share a point, provided they pass `collision_by_radius_check`."""
    near = collision_by_radius_check(box1, box2, radius_threshold)
    return near and bool(box1.geometry.intersects(box2.geometry))
