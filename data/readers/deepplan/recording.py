"""One recording to scenarios.

One pass: windows and verdicts on the source frames, everything at 20 Hz once, then an ego trace per
accepted track and a scenario per accepted (window, track). Whatever is dropped is counted.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shiftsim.data.readers.deepplan.route import find_route, nearest_lane
from shiftsim.data.readers.deepplan.states import ROW_US, ego_trace, resample, sample_runs
from shiftsim.data.readers.deepplan.windows import (
    EGO,
    GAP,
    LANE,
    ROUTE,
    ConversionConfig,
    Span,
    find_runs,
    judge_windows,
    rows_of,
)
from shiftsim.data.readers.tracks.samples import TrackSamples
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.kernels import FloatArray
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import FULL_DURATION, duration_class
from shiftsim.world.state import rear_poses

SCENARIO_TYPE = "deepplan"
_MAP_MARGIN = 200.0  # m around the map in which objects are expected


@dataclass(frozen=True)
class RecordingSummary:
    """What became of one recording."""

    name: str  # name of the recording
    duration_s: float  # its length [s]
    tracks: int  # tracks in it
    windows: int  # windows that fit
    seen: int  # (window, track) pairs looked at
    candidates: int  # pairs that pass category, presence, speed and overlap
    accepted: int  # scenarios
    rejected: dict[str, int]  # count of the other pairs by the rule they failed
    warnings: dict[str, int]  # count by kind of what was repaired


@dataclass(frozen=True)
class Converted:
    """One recording, ready for the store."""

    recording: Recording
    egos: tuple[EgoTrace, ...]
    windows: tuple[Window, ...]
    summary: RecordingSummary


def convert_recording(
    source: TrackSamples,
    road: VectorMap,
    offset: FloatArray,
    config: ConversionConfig,
    *,
    spans: Sequence[Span] | None = None,
    scenario_type: str = SCENARIO_TYPE,
) -> Converted:
    """All scenarios of one recording.

    Args:
        source: The recording.
        road: The map.
        offset: (2,) what to add to places of the recording to get those of the map [m].
        config: Thresholds.
        spans: Windows to look at; all that fit into the recording by default.
        scenario_type: Tag of the scenarios.
    """
    return _Conversion(source, road, offset, config, spans, scenario_type).convert()


class _Conversion:
    """One recording on its way; arguments as above."""

    def __init__(
        self,
        source: TrackSamples,
        road: VectorMap,
        offset: FloatArray,
        config: ConversionConfig,
        spans: Sequence[Span] | None,
        scenario_type: str,
    ) -> None:
        self.source, self.road, self.offset, self.config = source, road, offset, config
        self.scenario_type = scenario_type
        self.log_name = f"{road.name}_{source.name}"
        self.runs = find_runs(source, config.max_hole_s)
        self.padding = rows_of(config.padding_s)
        self.windows = judge_windows(source, self.runs, config, spans)
        self.verdicts: Counter[str] = Counter()

    def convert(self) -> Converted:
        source, config = self.source, self.config
        recording = resample(
            source,
            self.runs,
            log_name=self.log_name,
            city=self.road.name,
            offset=self.offset,
            padding_s=config.padding_s,
        )
        accepted = self._accepted()
        egos: list[EgoTrace] = []
        scenarios: list[Window] = []
        for run in sorted(accepted):
            trace = self._trace(run, accepted[run])
            made = self._scenarios(run, accepted[run], trace)
            scenarios += made
            egos += [trace] if made else []
        warnings = Counter(source.warnings)
        warnings["rows far outside the map"] += self._rows_outside_map()
        summary = RecordingSummary(
            name=source.name,
            duration_s=source.duration,
            tracks=len(source.track_ids),
            windows=len(self.windows),
            seen=sum(len(window.tracks) for window in self.windows),
            candidates=sum(map(len, accepted.values())),
            accepted=len(scenarios),
            rejected=dict(sorted(self.verdicts.items())),
            warnings=dict(+warnings),
        )
        order = sorted(scenarios, key=lambda w: (w.first_row, len(w.ego), w.ego))
        return Converted(recording, tuple(egos), tuple(order), summary)

    def _accepted(self) -> dict[int, list[int]]:
        """Numbers of the windows in which each run may serve as ego."""
        accepted: dict[int, list[int]] = {}
        for number, window in enumerate(self.windows):
            num_egos = 0
            for run, verdict in zip(window.runs.tolist(), window.verdicts, strict=True):
                if verdict == EGO and num_egos != self.config.max_per_window:
                    accepted.setdefault(run, []).append(number)
                    num_egos += 1
                else:
                    self.verdicts[verdict if verdict != EGO else "beyond max_per_window"] += 1
        return accepted

    def _trace(self, run: int, numbers: list[int]) -> EgoTrace:
        spans = [self.windows[number].span for number in numbers]
        return ego_trace(
            self.source,
            self.runs,
            run,
            log_name=self.log_name,
            offset=self.offset,
            first_row=min(rows_of(span.start_s) for span in spans),
            last_row=max(rows_of(s.start_s) + rows_of(s.length_s) for s in spans) + self.padding,
            padding=self.padding,
        )

    def _scenarios(self, run: int, numbers: list[int], trace: EgoTrace) -> list[Window]:
        """Scenarios of one ego; what has no lane or no route is counted."""
        spans = [self.windows[number].span for number in numbers]
        starts = np.array([span.start_s + span.history_s for span in spans])
        at_start = sample_runs(self.source, self.runs, np.full(len(starts), run), starts).poses
        at_start[:, :2] += self.offset
        out = []
        for number, pose in zip(numbers, at_start, strict=True):
            if nearest_lane(self.road, pose, self.config) is None:
                self.verdicts[LANE] += 1
            elif isinstance(made := self._scenario(run, number, trace), str):
                self.verdicts[made] += 1
            else:
                out.append(made)
        return out

    def _scenario(self, run: int, number: int, trace: EgoTrace) -> Window | str:
        """One scenario, or the rule that its route fails."""
        source, config, road = self.source, self.config, self.road
        span = self.windows[number].span
        start_s = span.start_s
        first = rows_of(start_s)  # with the padding, one padding earlier than the window
        start = first + self.padding + rows_of(span.history_s)
        end = first + self.padding + rows_of(span.length_s)
        states = trace.states[start - trace.first_row : end - trace.first_row]
        track = int(self.runs.track[run])
        route = find_route(road, states[:, :3], config)
        if route is None or not route.is_linked:
            return ROUTE if route is None else GAP
        goal = states[-1, :3].copy()
        last = int(np.searchsorted(source.track, track, side="right")) - 1
        if source.time[last] > start_s + span.length_s:
            center = np.array([*source.centers[last, :2] + self.offset, source.headings[last]])
            goal = rear_poses(center)  # nuPlan rule 457
        key = f"{road.name}|{source.name}|{start_s}|{source.track_ids[track]}|{span.length_s}"
        return Window(
            token=hashlib.blake2b(key.encode(), digest_size=8).hexdigest(),
            scenario_type=self.scenario_type,
            log_name=self.log_name,
            ego=trace.name,
            first_row=first,
            last_row=end,
            iteration_rows=np.arange(start, end, 2),
            row_step=2,
            route=route.ids,
            mission_goal=goal,
            mapping=(span.length_s - span.history_s, 0.0, 0.5),
            is_short=span.is_short,
            metadata={
                "recording": source.name,
                "window": number,
                "window_start_s": start_s,
                "track_id": source.track_ids[track].item(),
                "category": source.categories[track],
                "size_m": source.sizes[track].tolist(),
                "driven_blocks": route.num_driven,
                "padded_history_s": max(0.0, config.padding_s - start_s),
                **_duration_note(end - start),
            },
        )

    def _rows_outside_map(self) -> int:
        bounds = self.road.edges.polygons.bounds
        low, high = bounds[:, :2].min(axis=0) - _MAP_MARGIN, bounds[:, 2:].max(axis=0) + _MAP_MARGIN
        outside = np.zeros(len(self.source.centers), np.bool_)
        for axis in (0, 1):
            place = self.source.centers[:, axis] + self.offset[axis]
            outside |= (place < low[axis]) | (place > high[axis])
        return int(outside.sum())


def _duration_note(rows: int) -> dict[str, object]:
    """What the metadata of a scenario of so many rows says of its duration, if it is short."""
    found = duration_class(np.arange(0, rows, 2) * ROW_US)
    return {} if found == FULL_DURATION else {"duration_class": found}
