"""Lanes of JSON and msgpack, whatever a data set calls their parts."""

from dataclasses import dataclass
from typing import Any

from shiftsim.data.lanes.pieces import LanePiece
from shiftsim.data.open_data.source import Source


@dataclass(frozen=True)
class LaneNames:
    """What a data set calls the parts of a lane in the direction of travel."""

    left: str  # border, as `line`
    right: str
    center: str  # as `line`; may be missing
    successors: str  # list of ids, may be missing
    left_neighbor: str  # id, may be missing
    right_neighbor: str
    line: Any  # form of a line, see `Source.expect`
    speed_limit: str | None = None  # [m/s], may be missing

    @property
    def form(self) -> dict[Any, Any]:
        """The form of a lane."""
        return {
            self.left: self.line,
            self.right: self.line,
            self.center: (self.line,),
            self.successors: ([int],),
            self.left_neighbor: (int,),
            self.right_neighbor: (int,),
            self.speed_limit: (float,),
        }

    def piece(self, source: Source, lane: dict[Any, Any], name: str, **more: Any) -> LanePiece:
        """The piece that a lane of this form is; `more` are fields with names of their own."""
        lines: dict[str, Any] = {
            side: source.line(lane[key], f"lane {name}: {key!r}")
            for side, key in (("left", self.left), ("right", self.right), ("center", self.center))
            if lane.get(key) is not None
        }
        limit = lane.get(self.speed_limit)
        if limit is not None:
            source.require("speed limit", limit, f"lane {name}: {self.speed_limit!r}")
        return LanePiece(
            id=name,
            speed_limit=limit,
            successors=tuple(map(str, lane.get(self.successors) or ())),
            left_neighbor=text_or_none(lane.get(self.left_neighbor)),
            right_neighbor=text_or_none(lane.get(self.right_neighbor)),
            **lines,
            **more,
        )


def text_or_none(value: Any) -> str | None:
    """An id as text."""
    return None if value is None else str(value)
