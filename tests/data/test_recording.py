"""The order in which a scenario lists its tracks."""

import pytest

from shiftsim.data.recording import sort_tracks


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
