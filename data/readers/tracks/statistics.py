"""How the objects of a table move, and what was found out about it."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from shiftsim.data.readers.codes import KINDS
from shiftsim.data.readers.motion import fitted_velocities, track_ends, track_medians
from shiftsim.data.readers.tracks.table import TrackTable
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.state import AgentKind

FAST = 2.0  # m/s, above which a direction of motion is sure
# share of the moving vehicles whose velocities contradict their positions; more than the first is
# wrong if one explanation fits all of them
LEAST_CONTRADICTING, MAX_CONTRADICTING = 0.1, 0.5
_MAX_ROWS = 40_000  # that are looked at


class Finding(NamedTuple):
    """Something that is wrong, or unusual, with a table."""

    what: str  # value and limit
    remedy: str


@dataclass
class Diagnostics:
    """What was found out about a table."""

    errors: list[Finding] = field(default_factory=list)  # what cannot be right
    warnings: list[Finding] = field(default_factory=list)  # what is unusual
    figures: dict[str, float] = field(default_factory=dict)  # numbers behind it
    # (A, 2) velocities by the positions [m/s], where these could be derived
    derived: FloatArray | None = None

    def error(self, what: str, remedy: str) -> None:
        """Add something that cannot be right."""
        self.errors.append(Finding(what, remedy))

    def warn(self, what: str, remedy: str) -> None:
        """Add something that is unusual."""
        self.warnings.append(Finding(what, remedy))


@dataclass(frozen=True)
class TrackStatistics:
    """A table and how its objects move. A rows, N objects."""

    table: TrackTable
    time: FloatArray  # (A,) [s]
    period: float  # s

    @cached_property
    def is_vehicle(self) -> BoolArray:
        """(A,) whether a row is of a vehicle."""
        return self.is_of(AgentKind.VEHICLE)

    def is_of(self, kind: AgentKind) -> BoolArray:
        """(A,) whether a row is of an object of a kind."""
        known = [KINDS.get(name) == kind for name in self.table.categories]
        return np.array(known, np.bool_)[self.table.category]

    @cached_property
    def ends(self) -> IntArray:
        """(N + 1,) first row of every object, and the number of rows."""
        return track_ends(self.table.track)

    @cached_property
    def derived(self) -> FloatArray:
        """(A, 2) velocities by the positions [m/s]."""
        return fitted_velocities(self.table.xy, self.time, self.table.track, self.period)

    @cached_property
    def speed(self) -> FloatArray:
        """(A,) [m/s]."""
        return np.hypot(self.derived[:, 0], self.derived[:, 1])

    @cached_property
    def vehicle_size(self) -> tuple[float, float] | None:
        """Length and width of the median vehicle [m], where vehicles have sizes."""
        sizes, track = self.table.sizes, self.table.track
        if sizes is None:
            return None
        vehicles = np.unique(track[self.is_vehicle])
        medians = np.column_stack([track_medians(sizes[:, axis], track) for axis in (0, 1)])
        known = medians[vehicles][(medians[vehicles] > 0).all(axis=1)]
        if not len(known):
            return None
        length, width = np.median(known, axis=0).tolist()
        return length, width

    def rows(self, faster: float) -> IntArray:
        """Some rows of vehicles that move faster."""
        found = np.flatnonzero(self.is_vehicle & (self.speed > faster))
        return found[:: max(1, len(found) // _MAX_ROWS)]
