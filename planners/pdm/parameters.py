"""Numbers of PDM-Closed. Defaults are those of the official configuration."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from shiftsim.errors import ConfigError
from shiftsim.planners.proposals.comfort import ComfortBounds


class FollowingModel(NamedTuple):
    """Parameters of the batch IDM policy."""

    min_gap: float = 1.0  # gap kept at standstill [m]
    headway: float = 1.5  # time gap kept [s]
    accel_max: float = 1.5  # largest acceleration [m/s^2]
    decel_max: float = 3.0  # largest deceleration, positive [m/s^2]
    # of the ratio between speed and target speed
    exponent: float = 10.0  # nuPlan rule 182: its own IDM uses 4


@dataclass(frozen=True, slots=True)
class PdmParameters:
    """What a user may change."""

    # target speeds as shares of the lane's limit, slowest first
    speed_fractions: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0)
    fallback_velocity: float = 15.0  # stands in for a missing limit [m/s]
    # of the paths beside the centerline, left is positive [m]
    lateral_offsets: tuple[float, ...] = (-1.0, 1.0)
    following: FollowingModel = field(default_factory=FollowingModel)  # the longitudinal policy
    map_radius: float = 50.0  # objects nearer than this are seen; half side of the map square [m]
    max_static: int = 50  # most static objects that are seen
    max_vehicles: int = 50  # most vehicles that are seen
    max_pedestrians: int = 25  # most pedestrians that are seen
    max_bicycles: int = 10  # most bicycles that are seen
    progress_weight: float = 5.0  # of the score
    ttc_weight: float = 5.0  # of the score
    comfort_weight: float = 2.0  # of the score
    comfort: ComfortBounds = field(default_factory=ComfortBounds)  # bounds of the comfort test
    # oncoming travel up to which the factor is 1, and 0.5 [m]
    direction_limits: tuple[float, float] = (2.0, 6.0)
    brake_time: float = 2.0  # an at-fault collision within this brakes [s], if
    brake_speed: float = 5.0  # the ego is not faster than this [m/s]

    def __post_init__(self) -> None:
        if not self.speed_fractions or not np.isfinite(self.speed_fractions).all():
            raise ConfigError(
                f"pdm-closed: speed_fractions={self.speed_fractions!r} must be finite numbers",
                hint="for example (0.2, 0.4, 0.6, 0.8, 1.0)",
            )
        for name in ("fallback_velocity", "map_radius"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"pdm-closed: {name}={getattr(self, name)!r} must be positive")


DEFAULT = PdmParameters()
