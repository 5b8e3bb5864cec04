"""A scenario store -> nuPlan's own files, one log per scenario.

OUT/nuplan-v1.1/splits/<store>/<log>.db
OUT/maps/nuplan-maps-v1.0.json, OUT/maps/<map>/<version>/map.gpkg
OUT/tokens.txt                      tokens of the scenarios, one per line
"""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from shiftsim.data.nuplan.export_log import log_token, write_nuplan_log
from shiftsim.data.nuplan.export_map import epsg_of, write_nuplan_map
from shiftsim.data.nuplan.scenarios import FUTURE_ROWS, PAST_ROWS, Mapping, read_index
from shiftsim.data.readers.samples import ego_states as states_of
from shiftsim.data.recording import EgoTrace, Recording, Window, scenario
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.recordings import ego_span, ego_states
from shiftsim.data.store.tables import write_json
from shiftsim.errors import ConversionError
from shiftsim.kernels import FloatArray
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE

MAP_VERSION = "1.0.0"
ROWS_AHEAD = 10  # behind a plan's first state, nuPlan rule 393
# nuPlan rule 426: maps that its own code opens whatever map is asked for
ALWAYS_OPENED = (
    "sg-one-north",
    "us-ma-boston",
    "us-nv-las-vegas-strip",
    "us-pa-pittsburgh-hazelwood",
)
_INDEX = "nuplan-maps-v1.0.json"
_IDENTITY = [[float(i == j) for j in range(4)] for i in range(4)]
_RASTER = {"shape": [1, 1], "transform_matrix": _IDENTITY}


@dataclass
class ExportReport:
    """What an export wrote."""

    logs: Path  # folder of the logs
    maps: Path  # folder of the maps
    token_file: Path  # file that lists the tokens
    # token in nuPlan's files by scenario; the same unless it had another form
    tokens: dict[str, str] = field(default_factory=dict)
    cities: list[str] = field(default_factory=list)  # names of the maps written
    # number of scenarios by type and mapping (duration, offset, ratio)
    mappings: Counter[tuple[str, Mapping]] = field(default_factory=Counter)
    # scenarios whose recording ends less than 0.5 s after the last plan: log-future fails in nuPlan
    cut_off: int = 0
    # scenarios whose log goes on behind their window: log-future sees more of it in nuPlan
    longer: int = 0
    # maps that nuPlan's own code opens and that are not in the folder
    missing_maps: list[str] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"<ExportReport: {len(self.tokens)} logs, {len(self.cities)} maps, in {self.logs}>"

    @property
    def renamed(self) -> dict[str, str]:
        """Scenarios whose token had to be replaced, with the new one."""
        return {old: new for old, new in self.tokens.items() if old != new}


def export_nuplan(
    store: ScenarioStore,
    out: Path,
    *,
    tokens: Sequence[str] | None = None,
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> ExportReport:
    """Write scenarios and their maps in nuPlan's formats. The same input gives the same bytes.

    Maps that are in the folder already stay listed. Only the scenarios `tokens` are written, all
    where None; `progress` is called with scenarios done, scenarios in all, and the log's name. It
    is a DataError if the store is damaged, or holds something that the formats have no place for.
    """
    chosen = store.tokens if tokens is None else tuple(tokens)
    windows = {token: store.window(token) for token in chosen}
    cities = dict(zip(*(store.summary()[n].to_pylist() for n in ("token", "city")), strict=True))
    names = _log_names(windows, cities)
    logs = out / "nuplan-v1.1" / "splits" / plain_name(store.path.resolve().name)
    report = ExportReport(logs, maps=out / "maps", token_file=out / "tokens.txt")
    report.cities = sorted({cities[token] for token in chosen})
    _write_maps(store, report)
    for done, token in enumerate(chosen):
        progress(done, len(chosen), names[token])
        scene = read_with_surroundings(store, token)
        path = report.logs / f"{names[token]}.db"
        mapping = write_nuplan_log(path, scene, epsg=epsg_of(scene.map))
        report.tokens[token] = log_token(token).hex()
        report.mappings[scene.scenario_type, mapping] += 1
        report.cut_off += int(scene.iteration_rows[-2]) + ROWS_AHEAD >= len(scene.time_us)
        behind = len(scene.time_us) - int(scene.iteration_rows[-1])
        window = windows[token]
        report.longer += behind > window.last_row - int(window.iteration_rows[-1])
    progress(len(chosen), len(chosen), "")
    report.token_file.write_text("\n".join(sorted(report.tokens.values())) + "\n", "utf-8")
    return report


def read_with_surroundings(store: ScenarioStore, token: str) -> Scenario:
    """A scenario with as many rows before and after its iterations as a conversion keeps.

    These are rows of its recording, as far as the ego was recorded there: those that its window
    leaves out, too. Raises DataError: the store is damaged.
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


def _log_names(windows: dict[str, Window], cities: dict[str, str]) -> dict[str, str]:
    """`<map>_<recording>_<ego track>_<first frame>`, with the token where that is not unique."""
    names = {}
    for token, window in windows.items():
        recording = window.log_name.removeprefix(f"{cities[token]}_")
        parts = (cities[token], recording, window.ego, str(window.first_row))
        names[token] = "_".join(map(plain_name, parts))
    count = Counter(names.values())
    return {t: name if count[name] == 1 else f"{name}_{plain_name(t)}" for t, name in names.items()}


def plain_name(name: str) -> str:
    """A name that can be part of a file name."""
    return re.sub(r"[^A-Za-z0-9._+-]+", "-", name)


def _write_maps(store: ScenarioStore, report: ExportReport) -> None:
    index = report.maps / _INDEX
    listed = read_index(index) if index.is_file() else {}
    versions = {name: entry["version"] for name, entry in listed.items()}
    for city in report.cities:
        if versions.get(city, MAP_VERSION) != MAP_VERSION:
            raise ConversionError(
                f"{index}: lists another map {city!r}, version {versions[city]!r}",
                hint="choose another folder; maps of one name cannot be told apart",
            )
        if city in (".", "..") or "/" in city:
            raise ConversionError(f"map {city!r} cannot be a folder", hint="rename the site")
        path = report.maps / city / MAP_VERSION / "map.gpkg"
        write_nuplan_map(path, store.map(city), MAP_VERSION)
        layers = {"drivable_area": _RASTER, "Intensity": _RASTER}
        listed[city] = {"version": MAP_VERSION, "layers": layers}
    write_json(index, listed)
    report.missing_maps = [name for name in ALWAYS_OPENED if name not in listed]
