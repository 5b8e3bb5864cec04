"""Reader of Argoverse 2 motion forecasting: scenes of 11 s, each with its own map.

The files have no sizes of objects (the usual ones by type are taken), no speed limits and no
lights. Ends of tracks are squeezed: positions move up to 45 % slower than the stored speed. So
stored velocities are taken, except those of tracks that they contradict throughout, and the last
0.5 s belong to no scenario.
"""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shiftsim.data.maps.build import build_lane_map
from shiftsim.data.maps.segments import MapSource
from shiftsim.data.readers.build import make_samples
from shiftsim.data.readers.codes import TYPES, LaneNames
from shiftsim.data.readers.files import SceneFolder, SourceFile
from shiftsim.data.readers.reader import SourceRecording
from shiftsim.data.readers.samples import TrackSamples

EGO = "AV"
_MOTION = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
_COLUMNS = {
    "observed": pa.bool_(),
    "track_id": pa.string(),
    "object_type": pa.string(),
    "timestep": pa.int64(),
    **dict.fromkeys(_MOTION, pa.float64()),
    "start_timestamp": pa.float64(),  # ns
    "city": pa.string(),
}
_LINE = [{"x": float, "y": float}]
_LANE = LaneNames(
    line=_LINE,
    borders=("left_lane_boundary", "right_lane_boundary"),
    center="centerline",  # the data set of sensors has none
    successors="successors",
    neighbors=("left_neighbor_id", "right_neighbor_id"),
)
_MAP = {
    "lane_segments": {str: {**_LANE.form, "id": int, "lane_type": str, "is_intersection": bool}},
    "drivable_areas": {str: {"area_boundary": _LINE}},
    "pedestrian_crossings": {str: {"edge1": _LINE, "edge2": _LINE}},
}
_STEP_US = 100_000  # us
_LEFT_OUT = "background"
_SQUEEZED_S = 0.5  # s
_MAX_BYTES = 100_000_000
_METADATA = {
    "source": "Argoverse 2 motion forecasting",
    "licence": "CC BY-NC-SA 4.0",
    "sizes": "by type",
}


class Av2Reader(SceneFolder):
    """Argoverse 2 motion forecasting; a scene is named by its Parquet file."""

    name = "av2"
    pattern = "scenario_*.parquet"
    hint = "give a folder of the motion-forecasting data set, such as val/"

    def files(self, recording: str) -> list[Path]:
        """The tracks and the map."""
        path = Path(recording)
        return [path, path.with_name(f"log_map_archive_{_scenario_id(path)}.json")]

    def read(self, recording: str) -> SourceRecording:
        """One scene."""
        tracks, road = map(SourceFile, self.files(recording))
        name = _scenario_id(tracks.path)
        with tracks.naming():
            samples = _read_tracks(tracks)
        with road.naming():
            lanes = build_lane_map(_read_map(road, f"av2-{name}"))
        return SourceRecording(
            samples,
            lanes,
            left_out_s=_SQUEEZED_S,
            metadata={**_METADATA, "scenario_id": name},
            **self.recorded_ego(EGO),
        )


def _scenario_id(path: Path) -> str:
    return path.stem.removeprefix("scenario_")


def _read_tracks(source: SourceFile) -> TrackSamples:
    table = source.columns(_COLUMNS)
    if pc.all(table["observed"]).as_py():
        what = "holds the observed 5 s only"
        raise source.fault(what, "convert train or val; test hides the future")
    start_us = round(float(source.numbers(table, "start_timestamp", "time_ns")[0]) / 1000.0)
    city = str(table["city"][0].as_py())
    table = table.filter(pc.not_equal(table["object_type"], _LEFT_OUT))
    encoded = pc.dictionary_encode(table["object_type"].combine_chunks())
    types = [str(name) for name in encoded.dictionary.to_pylist()]
    sizes = np.array([TYPES[source.known(name, TYPES, "object_type")][1:] for name in types])
    x, y, heading, *velocity = (
        source.numbers(table, name, name.partition("_")[0]) for name in _MOTION
    )
    step = source.numbers(table, "timestep", "step").astype(np.int64)
    category = encoded.indices.to_numpy().astype(np.int64)
    return make_samples(
        city,
        time_us=start_us + step * _STEP_US,
        ids=table["track_id"].to_numpy(),
        category=category,
        categories=types,
        xy=np.column_stack([x, y]),
        headings=heading,
        velocities=np.column_stack(velocity),
        sizes=sizes[category],
        kind_of={name: kind for name, (kind, *_) in TYPES.items()},
    )


def _read_map(source: SourceFile, name: str) -> MapSource:
    """The map of a scene: what its `log_map_archive_*.json` says."""
    found = source.unpack(source.content(_MAX_BYTES), json.loads, _MAP, "the JSON")
    return MapSource(
        name=name,
        pieces=[
            _LANE.piece(source, lane, str(lane["id"]), is_connector=lane["is_intersection"])
            for lane in found["lane_segments"].values()
            if lane["lane_type"] != "BIKE"  # they double the connectors of vehicles
        ],
        drivable_areas=[
            source.ring(item["area_boundary"], f"drivable_areas {key!r}")
            for key, item in found["drivable_areas"].items()
        ],
        crosswalks=[
            source.ring([*item["edge1"], *item["edge2"][::-1]], f"crossing {key!r}")
            for key, item in found["pedestrian_crossings"].items()
        ],
    )
