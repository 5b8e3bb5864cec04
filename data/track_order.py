"""One order of tracks such that every frame lists its tracks as nuPlan does.

nuPlan lists the objects of a frame by type, and within a type as the log lists them
(nuplan-simulation.md §9). The order here depends only on the frames given, so that a window cut
from a longer recording is ordered as if it had been read alone.
"""

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel


def order_tracks(frame: IntArray, track: IntArray, kinds: IntArray) -> IntArray:
    """Order tracks by kind, then as the frames list them, then by first appearance.

    Args:
        frame: (B,) frame of each box, ascending.
        track: (B,) track of each box, in the order in which its frame lists the boxes.
        kinds: (N,) type of each track.

    Returns:
        (N,) indices of the tracks in their new order. Where frames contradict each other, the
        track that appears first comes first.
    """
    num = len(kinds)
    before = np.zeros((num, num), np.bool_)
    _link(frame, track, kinds, before)
    return _sorted(before, kinds, _first_frames(frame, track, num))


def order_of_columns(valid: BoolArray, kinds: IntArray) -> IntArray:
    """The same for dense tracks (R, N), each frame listing its tracks by column."""
    before = np.zeros((len(kinds), len(kinds)), np.bool_)
    first = np.full(len(kinds), len(valid), np.int64)
    _link_columns(valid, kinds, before, first)
    return _sorted(before, kinds, first)


@kernel
def copy_columns(  # type: ignore[no-untyped-def]  # compiled; the arrays are those of `Tracks`
    index: IntArray,
    valid: BoolArray,
    poses: FloatArray,
    velocities: FloatArray,
    sizes: FloatArray,
    out_valid: BoolArray,
    out_poses: FloatArray,
    out_velocities: FloatArray,
    out_sizes: FloatArray,
):
    """Copy the tracks `index` (N',) of dense arrays (R, N, …) into others (R, N', …)."""
    for row in range(valid.shape[0]):
        for to in range(len(index)):
            track = index[to]
            out_valid[row, to] = valid[row, track]
            out_poses[row, to, 0] = poses[row, track, 0]
            out_poses[row, to, 1] = poses[row, track, 1]
            out_poses[row, to, 2] = poses[row, track, 2]
            out_velocities[row, to, 0] = velocities[row, track, 0]
            out_velocities[row, to, 1] = velocities[row, track, 1]
            out_sizes[row, to, 0] = sizes[row, track, 0]
            out_sizes[row, to, 1] = sizes[row, track, 1]


@kernel
def _link(frame: IntArray, track: IntArray, kinds: IntArray, before: BoolArray) -> None:
    """Mark neighbours of one kind in a frame: `before[a, b]` when b directly follows a."""
    last = np.full(16, -1)
    for box in range(len(frame)):
        if box == 0 or frame[box] != frame[box - 1]:
            for kind in range(len(last)):
                last[kind] = -1
        kind = kinds[track[box]]
        if last[kind] >= 0 and last[kind] != track[box]:
            before[last[kind], track[box]] = True
        last[kind] = track[box]


@kernel
def _link_columns(valid: BoolArray, kinds: IntArray, before: BoolArray, first: IntArray) -> None:
    last = np.full(16, -1)
    for frame in range(valid.shape[0]):
        for kind in range(len(last)):
            last[kind] = -1
        for track in range(valid.shape[1]):
            if not valid[frame, track]:
                continue
            kind = kinds[track]
            if last[kind] >= 0:
                before[last[kind], track] = True
            last[kind] = track
            first[track] = min(first[track], frame)


@kernel
def _first_frames(frame: IntArray, track: IntArray, num: int) -> IntArray:
    first = np.full(num, np.iinfo(np.int64).max)
    for box in range(len(frame)):
        first[track[box]] = min(first[track[box]], frame[box])
    return first


@kernel
def _sorted(before: BoolArray, kinds: IntArray, first: IntArray) -> IntArray:
    num = len(kinds)
    waiting = np.zeros(num, np.int64)
    for a in range(num):
        for b in range(num):
            if before[a, b]:
                waiting[b] += 1
    done = np.zeros(num, np.bool_)
    out = np.empty(num, np.int64)
    for place in range(num):
        best = -1
        for track in range(num):
            if not done[track] and (best < 0 or _precedes(track, best, waiting, kinds, first)):
                best = track
        out[place] = best
        done[best] = True
        for track in range(num):
            if before[best, track]:
                waiting[track] -= 1
    return out


@kernel
def _precedes(a: int, b: int, waiting: IntArray, kinds: IntArray, first: IntArray) -> bool:
    """Whether track a is to be placed before b: by kind, then free of predecessors, then age."""
    if kinds[a] != kinds[b]:
        return kinds[a] < kinds[b]
    if (waiting[a] <= 0) != (waiting[b] <= 0):
        return waiting[a] <= 0
    return first[a] < first[b]
