"""What metrics, units and violations are called where people read them."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from shiftsim.world.state import AgentKind, Tracks

COLLISIONS = "no_ego_at_fault_collisions"
REASONS = {
    "no_ego_at_fault_collisions": "at-fault collision",
    "drivable_area_compliance": "drivable area",
    "driving_direction_compliance": "driving direction",
    "ego_is_making_progress": "no progress",
    "ego_progress_along_expert_route": "progress",
    "time_to_collision_within_bound": "time to collision",
    "speed_limit_compliance": "speed limit",
    "ego_is_comfortable": "comfort",
}
UNITS = {  # nuPlan's names, shortened
    "meters": "m",
    "seconds": "s",
    "meters_per_second": "m/s",
    "meters_per_second_squared": "m/s²",
    "meters_per_second_cubed": "m/s³",
    "radians_per_second": "rad/s",
    "radians_per_second_squared": "rad/s²",
    "count": "",
    "ratio": "",
    "boolean": "",
}


def violation_words(row: Mapping[str, Any], tracks: Tracks) -> str:
    """A row of `metrics.parquet` with a violation, as "at-fault collision, pedestrian 17, …"."""
    words, partner = [REASONS.get(row["metric"], row["metric"])], row["partner_token"]
    if partner in tracks.tokens:
        kind = AgentKind(int(tracks.kinds[tracks.tokens.index(partner)]))
        words.append(f"{kind.name.lower().replace('_', ' ')} {partner}")
    value, unit = row["first_violation_value"], UNITS.get(row["unit"], row["unit"])
    if value is not None and np.isfinite(value):
        if row["metric"] == COLLISIONS:  # the speed by which it changes is kept here
            words.append(f"Δv {value:.1f} m/s")
        elif unit:
            words.append(f"{value:.3g} {unit}" if abs(value) >= 0.01 else f"under 0.01 {unit}")
    return ", ".join(words)
