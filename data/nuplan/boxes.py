"""Objects of a nuPlan log: box by box as the log has them, and as dense tracks."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from shiftsim.data.nuplan.log import Log, as_numbers, note_implausible, read_rows, token_text
from shiftsim.data.recording import sort_tracks
from shiftsim.errors import ConversionError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.ranges import STORE
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind, Tracks, tracks_of_boxes

_COLUMNS = ("x", "y", "heading", "vx", "vy", "length", "width")
_KINDS = {kind.name.lower(): int(kind) for kind in AgentKind}


@dataclass(frozen=True)
class Boxes:
    """Objects of a span of rows, box by box, each frame in the order nuPlan lists it. B boxes."""

    row: IntArray  # (B,) row of the log
    token: list[str]  # B track tokens
    kind: IntArray  # (B,) AgentKind codes
    # (B, 8) centre x, y [m], heading [rad], velocity x, y in the map frame [m/s], length, width,
    # height [m]
    values: FloatArray


def read_boxes(log: Log, first: int, last: int, flaws: Counter[str] | None = None) -> Boxes:
    """Objects of the rows first … last - 1; else a ConversionError."""
    row, rows = read_rows(
        log,
        first,
        last,
        columns="t.token, c.name, b.x, b.y, b.yaw, b.vx, b.vy, b.length, b.width, b.height",
        joins="JOIN lidar_box AS b ON b.lidar_pc_token = pc.token"
        " JOIN track AS t ON b.track_token = t.token"
        " JOIN category AS c ON t.category_token = c.token",
        order="b.rowid",
    )
    unknown = sorted({str(r[1]) for r in rows} - set(_KINDS))
    if unknown:
        what = f"{log.path}: table 'category': unknown category {unknown[0]!r}"
        raise ConversionError(what, f"known are {', '.join(_KINDS)}")
    kind = np.array([_KINDS[r[1]] for r in rows], np.int64)
    values = as_numbers(log.path, "lidar_box", [r[2:] for r in rows]).reshape(-1, 8)
    order = np.lexsort((np.arange(len(rows)), kind, row))
    token = [token_text(rows[i][0], log.path, "track") for i in order.tolist()]
    boxes = Boxes(row[order].astype(np.int64), token, kind[order], values[order])
    counts = Counter[str]() if flaws is None else flaws
    boxes = _checked(log, boxes, counts)
    note_implausible("lidar_box", _COLUMNS, boxes.values[:, :7], counts)
    _bound(boxes.values)
    return boxes


def _bound(values: FloatArray) -> None:
    """Bring boxes, as in `Boxes.values`, into the ranges that a store can hold.

    These are so wide that a box is on the whole map, or off it after the first step, before and
    after; headings keep their directions.
    """
    heading, speed, size = (STORE[name] for name in ("heading_rad", "vx_mps", "length_m"))
    turned = ~heading.holds(values[:, 2])
    values[turned, 2] = np.arctan2(np.sin(values[turned, 2]), np.cos(values[turned, 2]))
    np.clip(values[:, 3:5], speed.low, speed.high, out=values[:, 3:5])  # NaN stays
    np.minimum(values[:, 5:7], size.high, out=values[:, 5:7])


def _checked(log: Log, boxes: Boxes, flaws: Counter[str]) -> Boxes:
    """The boxes that something can touch, with positive sizes."""
    places, sizes = boxes.values[:, :2], boxes.values[:, 5:7]
    is_nowhere = np.isnan(places).any(axis=1) | ~np.isfinite(boxes.values[:, 2])
    for bad, what in (
        (is_nowhere, "a pose that is not finite"),
        (np.isinf(boxes.values[:, 3:5]).any(axis=1), "an infinite velocity"),
        (~np.isfinite(sizes).all(axis=1), "no finite length or width"),
    ):
        if bad.any():
            box = int(np.flatnonzero(bad)[0])
            raise ConversionError(
                f"{log.path}: lidar_box of track {boxes.token[box]!r} at lidar_pc"
                f" {log.tokens[int(boxes.row[box])]!r} has {what}",
                hint="leave this scenario out or repair the log",
            )
    # nuPlan rule 436
    is_near = STORE["x_m"].holds(places).all(axis=1)
    is_flat = is_near & (np.abs(sizes) < STORE["length_m"].low).any(axis=1)
    is_negative = is_near & ~is_flat & (sizes < 0.0).any(axis=1)
    for odd, what in (
        (is_flat, "boxes without length or width touch nothing and are left out"),
        (~is_near, "boxes off the earth touch nothing and are left out"),
        (is_negative, "boxes of negative length or width cover the same area as positive ones"),
    ):
        if odd.any():
            first = boxes.token[int(np.flatnonzero(odd)[0])]
            first = log.examples.setdefault(what, first)
            flaws[f"lidar_box: {what}; first of track {first!r}"] += int(odd.sum())
    keep = np.flatnonzero(is_near & ~is_flat)
    values = boxes.values[keep]
    values[:, 5:7] = np.abs(values[:, 5:7])
    return Boxes(boxes.row[keep], [boxes.token[i] for i in keep.tolist()], boxes.kind[keep], values)


def make_tracks(boxes: Boxes, first: int, last: int, flaws: Counter[str]) -> Tracks:
    """Dense tracks over the rows first … last - 1 from their boxes."""
    index: dict[str, int] = {}
    track = np.array([index.setdefault(token, len(index)) for token in boxes.token], np.int64)
    frame = boxes.row - first
    kinds = np.zeros(len(index), np.int64)
    kinds[track] = boxes.kind
    before = np.zeros((len(index), len(index)), np.bool_)  # in a frame, directly before the other
    next_to = (np.diff(frame) == 0) & (np.diff(boxes.kind) == 0) & (np.diff(track) != 0)
    before[track[:-1][next_to], track[1:][next_to]] = True
    first_frame = frame[np.unique(track, return_index=True)[1]]
    order = sort_tracks(before, kinds, first_frame)
    place = np.argsort(order)
    dense = np.full((last - first, len(index), 7), np.nan)
    dense[frame, place[track]] = boxes.values[:, :7]
    dense[:, kinds[order] > LAST_AGENT_KIND, 3:5] = np.nan  # nuPlan rule 420
    tokens = np.array(list(index), object)[order].tolist()
    tracks = tracks_of_boxes(dense, kinds[order], tokens)
    twice = int(len(frame) - tracks.valid.sum())
    flaws["track listed twice in a frame: the last one is kept"] += twice
    return tracks
