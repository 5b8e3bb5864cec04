"""More of a recording than the window of a scenario shows: what came before and what came after."""

from dataclasses import replace

import numpy as np

from shiftsim.data.nuplan.scenarios import FUTURE_ROWS, PAST_ROWS
from shiftsim.data.readers.samples import ego_states as states_of
from shiftsim.data.recording import EgoTrace, Recording, scenario
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.recordings import ego_span, ego_states
from shiftsim.kernels import FloatArray
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE


def read_with_surroundings(store: ScenarioStore, token: str) -> Scenario:
    """A scenario with as many rows before and after its iterations as a conversion keeps.

    These are rows of its recording, as far as the ego was recorded there: those that its window
    leaves out, too.

    Raises:
        DataError: The store is damaged.
    """
    shown, window = store.read(token), store.window(token)
    stored, trace = store.recording(window.log_name), store.ego(window.log_name, window.ego)
    known = ego_span(trace)
    start, stop = int(window.iteration_rows[0]), int(window.iteration_rows[-1]) + 1
    first = max(0, min(window.first_row, start - PAST_ROWS))
    last = min(stored.num_rows, max(window.last_row, stop + FUTURE_ROWS))
    span = stored.read(first, last)
    states = _driven(span, window.ego)
    begin, end = max(known[0], first), min(known[1], last)
    states[begin - first : end - first] = ego_states(trace, begin, end)
    unknown = np.flatnonzero(~np.isfinite(states).all(axis=1))
    place = int(np.searchsorted(unknown, start - first))
    low = int(unknown[place - 1]) + 1 if place > 0 else 0
    high = int(unknown[place]) if place < len(unknown) else last - first
    more = scenario(
        span,
        EgoTrace(span.log_name, window.ego, 0, states[low:high]),
        replace(window, first_row=first + low, last_row=first + high),
        shown.map,
        offset=first,
    )
    return replace(more, route=shown.route)


def _driven(span: Recording, ego: str) -> FloatArray:
    """(R, 11) ego states from the boxes of the track that is the ego; NaN where there are none."""
    states = np.full((len(span.time_us), NUM_STATE), np.nan)
    tracks = span.tracks
    if ego in tracks.tokens:
        track = tracks.tokens.index(ego)
        seen = np.flatnonzero(tracks.valid[:, track])
        for rows in np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1):
            states[rows] = states_of(tracks.poses[rows, track], tracks.velocities[rows, track])
    return states
