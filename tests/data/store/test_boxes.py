"""Boxes of row groups become dense arrays, in whatever order they are stored."""

import numpy as np
import pytest

from shiftsim.data.store import boxes
from shiftsim.data.store.plausible import BOX_LIMITS
from shiftsim.kernels import readonly

ROWS, TRACKS, FIRST, LAST = 12, 5, 3, 10
ODD = (0.0, -0.0, np.nan, np.inf, -np.inf, 1e300, 5e-324, -5e-324)


def block(rng: np.random.Generator, is_plain: bool) -> tuple[boxes.BoxBlock, np.ndarray]:
    """A row group, with gaps, in order or with some boxes twice and out of order; its numbers."""
    track, row = np.nonzero(rng.random((TRACKS, ROWS)) < rng.choice([0.3, 0.9, 1.0]))
    if rng.random() < 0.5:
        at = rng.integers(0, max(len(row), 1), len(row) + 3 if len(row) else 0)
        track, row = track[at], row[at] + rng.integers(-4, 5)
    values = rng.normal(0.0, 30.0, (7, len(row)))
    values[3:5, rng.random(len(row)) < 0.3] = np.nan
    values[5:] = np.abs(values[5:]) + 0.1
    if len(row) and rng.random() < 0.5:
        kind = rng.integers(0, 7)
        low, high = BOX_LIMITS[kind]
        edges = low, high, np.nextafter(low, -np.inf), np.nextafter(high, np.inf), *ODD
        values[kind, rng.integers(0, len(row))] = rng.choice(edges)
    motion = [v.view(np.uint64) if is_plain else boxes.second_differences(v) for v in values[:5]]
    extent = readonly(values[5]), readonly(values[6])
    indices = (readonly(column.astype(np.int32)) for column in (row, track))
    return boxes.BoxBlock(*indices, tuple(map(readonly, motion)), extent, is_plain), values


@pytest.mark.parametrize("is_plain", [False, True])
def test_boxes_are_where_their_row_and_track_say(is_plain, rng):
    verdicts = []
    for _ in range(300):
        part, values = block(rng, is_plain)
        place = np.zeros(TRACKS, np.int64)
        spans = np.empty((len(part.row) + 1, 3), np.int64)
        spans = spans[: boxes.cut_spans(part.row, part.track, FIRST, LAST, place, spans) + 1]
        window = (part.row >= FIRST) & (part.row < LAST)
        assert place.nonzero()[0].tolist() == sorted(set(part.track[window].tolist()))
        wanted = rng.permutation(TRACKS)[:3]
        place[:] = 0
        place[wanted] = [1, 2, 3]
        expected = np.full((LAST - FIRST, 3, 7), np.nan)
        valid = np.zeros((LAST - FIRST, 3), np.bool_)
        for row, track, box in zip(part.row - FIRST, part.track, values.T, strict=True):
            if 0 <= row < len(valid) and place[track]:
                expected[row, place[track] - 1] = box
                valid[row, place[track] - 1] = True
        there = np.zeros((3, LAST - FIRST), np.bool_)
        boxes.mark(spans, place, there)
        assert (there.T == valid).all()
        poses, velocities, sizes = (np.full(valid.size * width, np.nan) for width in (3, 2, 2))
        out = poses.view(np.uint64), velocities.view(np.uint64), sizes
        limits = boxes.HIGHEST, boxes.SIZE_LIMITS
        verdicts.append(boxes.scatter(*part[2:], spans, place, valid.shape, *limits, *out))
        found = [a.reshape(*valid.shape, -1) for a in (poses, velocities, sizes)]
        assert np.concatenate(found, axis=2).tobytes() == expected.tobytes()
        good = (values.T >= BOX_LIMITS[:, 0]) & (values.T <= BOX_LIMITS[:, 1])
        good[:, 3:5] |= np.isnan(values[3:5].T)
        assert verdicts[-1] == good.all()
    assert 30 < sum(verdicts) < 270


@pytest.mark.parametrize("wrong", [-1, TRACKS])
def test_a_track_that_is_none_is_noticed(wrong, rng):
    track = np.array([0, 0, wrong], np.int32)
    place, spans = np.zeros(TRACKS, np.int64), np.empty((4, 3), np.int64)
    rows = readonly(np.arange(3, dtype=np.int32))
    assert boxes.cut_spans(rows, readonly(track), 0, 3, place, spans) == -1


def walk(row, track, first, last):
    """Spans as `cut_spans` gives them, told box by box, and the tracks in the rows."""
    spans = []
    for box in range(len(row)):
        goes_on = box > 0 and track[box] == track[box - 1] and row[box] == row[box - 1] + 1
        if not goes_on or row[box] == (first if row[box - 1] < first else last):
            is_inside = first <= row[box] < last
            spans.append([box, row[box] - first, track[box] if is_inside else -1])
    return spans, {track for _, _, track in spans} - {-1}


def test_spans_longer_than_what_is_looked_at_together_end_where_a_walk_says(rng):
    for _ in range(300):
        pieces = [
            np.arange(rng.integers(1, 4 * boxes._AT_ONCE)) + rng.integers(0, 60) for _ in range(6)
        ]
        row = np.concatenate(pieces)
        track = np.repeat(rng.integers(0, TRACKS, 6), [len(piece) for piece in pieces])
        for column in (row, track):  # one box that is not where its neighbours are
            if rng.random() < 0.5:
                column[rng.integers(0, len(row))] = rng.integers(0, TRACKS)
        first = rng.integers(0, 100)
        last = first + rng.integers(1, 100)
        indices = (readonly(column.astype(np.int32)) for column in (row, track))
        place, out = np.zeros(TRACKS, np.int64), np.empty((len(row) + 1, 3), np.int64)
        count = boxes.cut_spans(*indices, first, last, place, out)
        spans, seen = walk(row.tolist(), track.tolist(), first, last)
        assert out[:count].tolist() == spans
        assert out[count, 0] == len(row)
        assert set(place.nonzero()[0].tolist()) == seen
