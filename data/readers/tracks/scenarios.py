"""Scenarios from any tracks on a map: which spans of time, which egos; then as DeepPlan does it.

A recording of 18 s or more is cut into DeepPlan's windows (3 s of history, 15 s simulated); a
shorter one is one window with 2 s of history. A named ego's windows begin where it is first seen.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from shiftsim.data.readers.deepplan.recording import Converted, convert_recording
from shiftsim.data.readers.deepplan.states import rows_between
from shiftsim.data.readers.deepplan.windows import (
    ROW_S,
    ConversionConfig,
    Span,
    find_runs,
    rows_of,
    window_spans,
)
from shiftsim.data.readers.tracks.samples import TrackSamples
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import ConfigError, nearest
from shiftsim.world.map import VectorMap

EGO_CATEGORIES = ("car", "van", "pickup", "vehicle")
SHORT_HISTORY_S = 2.0
_LEAST_S = 0.3  # simulated


def make_scenarios(
    samples: TrackSamples,
    road: VectorMap,
    *,
    egos: Sequence[str] | None = None,
    config: ConversionConfig | None = None,
    scenario_type: str = "unknown",
    left_out_s: float = 0.0,
) -> Converted:
    """All scenarios of a recording; both it and the map are in the frame of the map.

    Args:
        samples: The recording.
        road: The map.
        egos: Ids of the egos, of any category; by default every car, van, pickup or vehicle that
            is there throughout the window.
        config: Thresholds of DeepPlan's conversion.
        scenario_type: Tag of the scenarios.
        left_out_s: Time at the end of the recording that no window reaches [s].

    Raises:
        ConfigError: No object has the id of an ego.
    """
    config = config or ConversionConfig(ego_categories=EGO_CATEGORIES)
    if egos is None:
        rows = _rows(samples.duration - left_out_s) + 1
        spans = list(_spans(0, rows, -1, config))
    else:
        spans = list(_named_spans(samples, egos, config, left_out_s))
    return convert_recording(
        samples, road, np.zeros(2), config, spans=spans, scenario_type=scenario_type
    )


def write_converted(writer: StoreWriter, converted: Converted) -> None:
    """Put a recording and its scenarios into a store that has the map, for those it had."""
    writer.forget_recording(converted.recording.log_name)
    writer.add_recording(converted.recording)
    for ego in converted.egos:
        writer.add_ego(ego)
    for window in converted.windows:
        writer.add_window(window)


def _rows(seconds: float) -> int:
    return int(np.floor(seconds / ROW_S + 1e-9))


def _spans(first: int, rows: int, only: int, config: ConversionConfig) -> Iterator[Span]:
    """Windows within some rows of 0.05 s; one shorter window where none fits."""
    found = window_spans(rows * ROW_S, config)
    for span in found:
        start = round((first + rows_of(span.start_s)) * ROW_S, 2)
        yield Span(start, span.length_s, span.history_s, only)
    if not found and rows * ROW_S >= SHORT_HISTORY_S + _LEAST_S:
        history = min(SHORT_HISTORY_S, config.history_s)
        yield Span(round(first * ROW_S, 2), round(rows * ROW_S, 2), history, only)


def _named_spans(
    samples: TrackSamples, egos: Sequence[str], config: ConversionConfig, left_out_s: float
) -> Iterator[Span]:
    names = {str(one): number for number, one in enumerate(samples.track_ids.tolist())}
    runs = find_runs(samples, config.max_hole_s)
    end = samples.duration - left_out_s
    last_s = np.minimum(samples.time[runs.last], end)
    first, last = rows_between(samples.time[runs.first], last_s)
    # beyond its last row an ego is known to exist only where the recording ends, too
    rows = last - first + (samples.frame[runs.last] == len(samples.clock) - 1)
    for ego in egos:
        if ego not in names:
            near = nearest(ego, names)
            hint = f"did you mean {near!r}? " if near else ""
            raise ConfigError(
                f"{samples.name}: no object has the id {ego!r}",
                f"{hint}there are {len(names)}, such as {', '.join(list(names)[:5])}",
            )
        for run in np.flatnonzero(runs.track == names[ego]).tolist():
            yield from _spans(int(first[run]), int(rows[run]), names[ego], config)
