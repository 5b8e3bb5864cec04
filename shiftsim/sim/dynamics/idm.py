"""Intelligent Driver Model: acceleration behind a lead, and nuPlan's forward Euler step.

Used by reactive agents and by the IDM planner.
"""

import numpy as np

from shiftsim.kernels import kernel

EXPONENT = 4.0  # of the free-road term, nuPlan


@kernel
def idm_acceleration(
    speed: float,  # own speed [m/s]
    # free distance to the lead's rear, own progress and the lead's rear length taken off; less than
    # `min_gap` counts as `min_gap` [m]
    gap: float,
    lead_speed: float,  # speed of the lead along the own direction, may be negative [m/s]
    target_speed: float,  # speed on a free road [m/s]
    min_gap: float,  # gap kept at standstill [m]
    headway: float,  # time gap kept [s]
    accel_max: float,  # largest acceleration [m/s^2]
    decel_max: float,  # comfortable deceleration, positive [m/s^2]
) -> float:
    """Unclipped IDM acceleration [m/s^2]."""
    # nuPlan rule 21: the desired gap is not clamped at zero, it is squared
    desired = (
        min_gap
        + speed * headway
        + speed * (speed - lead_speed) / (2.0 * np.sqrt(accel_max * decel_max))
    )
    ratio = desired / max(gap, min_gap)
    return accel_max * (1.0 - (speed / target_speed) ** EXPONENT - ratio**2)


@kernel
def idm_step(
    speed: float,
    gap: float,
    lead_speed: float,
    target_speed: float,
    min_gap: float,
    headway: float,
    accel_max: float,
    decel_max: float,
    dt: float,
) -> tuple[float, float]:
    """One forward Euler step: distance driven [m] and new speed [m/s], which may be negative.

    The acceleration is clipped to [-decel_max, accel_max] first; the distance follows from the old
    speed. Arguments as for `idm_acceleration`, and the step `dt` [s].
    """
    accel = idm_acceleration(
        speed, gap, lead_speed, target_speed, min_gap, headway, accel_max, decel_max
    )
    accel = min(max(accel, -decel_max), accel_max)
    return dt * speed, speed + dt * accel
