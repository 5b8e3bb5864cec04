"""The order in which a scenario lists its tracks."""

import numpy as np
import pytest

from shiftsim.data.recording import sort_tracks, visible_columns


def obvious_order(before, kinds, first):
    """Of all that are left always the best: by kind, then free of predecessors, then age."""
    left, order = list(range(len(kinds))), []
    while left:
        best = min(left, key=lambda t: (kinds[t], any(before[o, t] for o in left), first[t], t))
        left.remove(best)
        order.append(best)
    return order


@pytest.mark.parametrize("share", [0.0, 0.05, 0.2, 0.6])
def test_tracks_are_sorted_as_by_choosing_the_best_each_time(share, rng):
    for count in (0, 1, 2, 7, 40):
        kinds, first = rng.integers(0, 3, count), rng.integers(0, 5, count)
        before = (rng.random((count, count)) < share) & (kinds[:, None] == kinds)
        found = sort_tracks(before, kinds, first)
        assert found.tolist() == obvious_order(before, kinds, first)


@pytest.mark.parametrize("gaps", [0.0, 0.1, 0.6])
def test_columns_are_ordered_by_what_directly_follows_what_in_any_row(gaps, rng):
    """As they are, or not: a track that comes late stands before those listed after it."""
    moved = 0
    for count in (0, 1, 2, 5, 12):
        for _ in range(40):
            start = rng.integers(0, 4, count)
            if rng.random() < 0.5:
                start.sort()
            valid = (np.arange(9)[:, None] >= start) & (rng.random((9, count)) >= gaps)
            kinds = rng.integers(0, 2, count)
            tokens = [f"t{track}" for track in range(count)]
            seen = [t for t in range(count) if valid[:, t].any() and t != 3]
            before = np.zeros((len(seen), len(seen)), bool)
            for row in valid:
                for kind in (0, 1):
                    listed = [i for i, t in enumerate(seen) if row[t] and kinds[t] == kind]
                    before[listed[:-1], listed[1:]] = True
            first = [int(valid[:, t].argmax()) for t in seen]
            order = [seen[i] for i in obvious_order(before, kinds[seen], first)]
            found = visible_columns(valid, kinds, tokens, without="t3").tolist()
            assert found == order
            moved += found != sorted(found, key=lambda t: (kinds[t], valid[:, t].argmax(), t))
    assert moved > 5
