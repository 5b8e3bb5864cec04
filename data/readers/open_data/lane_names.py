"""Lanes of JSON and msgpack, whatever a data set calls their parts."""

from dataclasses import dataclass
from typing import Any

from shiftsim.data.maps.segments import LanePiece
from shiftsim.data.readers.open_data.source import Source


@dataclass(frozen=True)
class LaneNames:
    """What a data set calls the parts of a lane in the direction of travel."""

    line: Any  # form of a line, see `Source.expect`
    borders: tuple[str, str]  # left and right, as `line`
    center: str  # as `line`; may be missing
    successors: str  # list of ids, may be missing
    neighbors: tuple[str, str]  # left and right, ids, may be missing
    speed_limit: str | None = None  # [m/s], may be missing

    @property
    def form(self) -> dict[Any, Any]:
        """The form of a lane."""
        return {
            **dict.fromkeys(self.borders, self.line),
            self.center: (self.line,),
            self.successors: ([int],),
            **dict.fromkeys(self.neighbors, (int,)),
            self.speed_limit: (float,),
        }

    def piece(self, source: Source, lane: dict[Any, Any], name: str, **more: Any) -> LanePiece:
        """The piece that a lane of this form is; `more` are fields with names of their own."""
        lines = [key for key in (*self.borders, self.center) if lane.get(key) is not None]
        left, right, *center = (source.line(lane[i], f"lane {name}: {i!r}") for i in lines)
        limit = lane.get(self.speed_limit)
        if limit is not None:
            source.require("speed limit", limit, f"lane {name}: {self.speed_limit!r}")
        beside = [None if lane.get(i) is None else str(lane[i]) for i in self.neighbors]
        return LanePiece(
            name,
            left,
            right,
            next(iter(center), None),
            successors=tuple(map(str, lane.get(self.successors) or ())),
            left_neighbor=beside[0],
            right_neighbor=beside[1],
            speed_limit=limit,
            **more,
        )
