"""Speed limits: one per lane, from the records of its pieces (deepplan-conversion.md §2.10)."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from shiftsim.data.opendrive.graph import Piece
from shiftsim.data.opendrive.records import OpenDrive, Road, Signal, Speed

KMH, MPH = 1 / 3.6, 0.44704  # m/s
DEFAULTS_DE: dict[str, float | None] = {
    "town": 50 * KMH,
    "townCollector": 50 * KMH,
    "townArterial": 50 * KMH,
    "townLocal": 50 * KMH,
    "townPrivate": 50 * KMH,
    "lowSpeed": 30 * KMH,
    "pedestrian": 10 * KMH,
    "townPlayStreet": 10 * KMH,
    "rural": 100 * KMH,
    "townExpressway": 100 * KMH,
    "motorway": None,
}
DEFAULTS_US: dict[str, float | None] = DEFAULTS_DE | {
    "town": 25 * MPH,
    "townCollector": 25 * MPH,
    "townArterial": 25 * MPH,
    "townLocal": 25 * MPH,
    "townPrivate": 25 * MPH,
    "motorway": 65 * MPH,
}


def speed_limit(od: OpenDrive, pieces: Sequence[Piece], country: str) -> float | None:
    """The limit that holds on most of a lane, the lower one on ties [m/s]; None for no limit."""
    lengths: dict[float, float] = defaultdict(float)
    for piece in pieces:
        road = od.roads[piece.key.road]
        start = road.sections[piece.key.section].s
        lane = road.sections[piece.key.section].lanes[piece.key.lane]
        low, high = min(piece.begin, piece.end), max(piece.begin, piece.end)
        places = [start + r.s for r in lane.speeds] + [t.s for t in road.types]
        places += [signal.s for signal in road.signals]
        stops = np.array(sorted({low, high, *(s for s in places if low < s < high)}))
        for begin, end in pairwise(stops):
            limit = _limit_at(road, piece, 0.5 * (begin + end), country)
            lengths[np.inf if limit is None else limit] += end - begin
    if not lengths:
        return None
    best = min(lengths, key=lambda limit: (-round(lengths[limit], 6), limit))
    return None if np.isinf(best) else best


def _limit_at(road: Road, piece: Piece, s: float, country: str) -> float | None:
    section = road.sections[piece.key.section]
    own = _last(section.lanes[piece.key.lane].speeds, s - section.s)
    if own is not None:
        return own.limit
    kinds = [kind for kind in road.types if kind.s <= s] or list(road.types[:1])
    if kinds and kinds[-1].speed is not None:
        return kinds[-1].speed.limit
    signal = _signal_limit(road, piece, s)
    if signal is not None:
        return signal
    land = (kinds[-1].country if kinds else "") or country
    table = DEFAULTS_US if land.upper() in ("US", "USA") else DEFAULTS_DE
    return table.get(kinds[-1].type if kinds else "town", table["town"])


def _last(records: Sequence[Speed], s: float) -> Speed | None:
    before = [record for record in records if record.s <= s]
    return before[-1] if before else None


def _signal_limit(road: Road, piece: Piece, s: float) -> float | None:
    """Limit of the last sign that traffic has passed on this road."""
    forward = piece.end >= piece.begin
    passed = [
        (signal.s, limit)
        for signal in road.signals
        if (signal.s <= s) == forward
        and signal.orientation in ("none", "+" if forward else "-")
        and applies_to(signal, piece.key.lane)
        and (limit := _sign_value(signal)) is not None
    ]
    if not passed:
        return None
    return (max if forward else min)(passed)[1]


def applies_to(signal: Signal, lane: int) -> bool:
    """Whether a signal is valid for a lane."""
    return not signal.lanes or any(low <= lane <= high for low, high in signal.lanes)


def _sign_value(signal: Signal) -> float | None:
    """Limit on a speed sign [m/s]; None for any other signal."""
    is_us = signal.type in ("R2-1", "r2_1")
    if signal.type != "274" and not is_us:
        return None
    value = signal.value if signal.value and signal.value > 0 else None
    if value is None and signal.subtype.isdecimal():
        number = int(signal.subtype)
        value = float((number - 50) * 10 if 51 <= number <= 63 else number)  # 274-55 is 50 km/h
    if value is None or value <= 0:
        return None
    units = {"km/h": KMH, "mph": MPH, "m/s": 1.0}
    return value * units.get(signal.unit, MPH if is_us else KMH)
