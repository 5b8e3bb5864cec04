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
import shapely

from shiftsim.data.lanes.map import build_lane_map
from shiftsim.data.lanes.pieces import MapSource
from shiftsim.data.open_data.codes import TYPES
from shiftsim.data.open_data.lane_names import LaneNames
from shiftsim.data.open_data.scenes import Scene
from shiftsim.data.open_data.source import Source, find_below, need
from shiftsim.data.polygons import largest_part
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples

EGO = "AV"
# columns of positions, headings and velocities, and the field of `OPEN_DATA` of each
_MOTION = {
    name: name.partition("_")[0]
    for name in ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
}
_COLUMNS = [
    need("observed", pa.bool_()),
    need("track_id", pa.string()),
    need("object_type", pa.string()),
    need("timestep", pa.int64()),
    *(need(name, pa.float64()) for name in _MOTION),
    need("start_timestamp", pa.float64()),  # ns
    need("city", pa.string()),
]
_LINE = [{"x": float, "y": float}]
_LANE = LaneNames(
    left="left_lane_boundary",
    right="right_lane_boundary",
    center="centerline",  # the data set of sensors has none
    successors="successors",
    left_neighbor="left_neighbor_id",
    right_neighbor="right_neighbor_id",
    line=_LINE,
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


class Av2Reader:
    """Argoverse 2 motion forecasting; a scene is named by its Parquet file."""

    def find(self, folder: Path) -> list[Path]:
        """Parquet files of the scenes, sorted."""
        hint = "give a folder of the motion-forecasting data set, such as val/"
        return find_below(folder, "scenario_*.parquet", hint)

    def files(self, path: Path) -> list[Path]:
        """The tracks and the map."""
        name = path.stem.removeprefix("scenario_")
        return [path, path.with_name(f"log_map_archive_{name}.json")]

    def read(self, path: Path) -> Scene:
        """One scene."""
        tracks, road = map(Source, self.files(path))
        name = path.stem.removeprefix("scenario_")
        with tracks.naming():
            samples = _read_tracks(tracks)
        with road.naming():
            lanes = build_lane_map(_read_map(road, f"av2-{name}"))
        return Scene(
            samples=samples,
            map=lanes,
            egos=(EGO,),
            left_out_s=_SQUEEZED_S,
            metadata={**_METADATA, "scenario_id": name},
        )


def _read_tracks(source: Source) -> TrackSamples:
    table = source.columns(_COLUMNS)
    if pc.all(table["observed"]).as_py():
        raise source.fault(
            "holds the observed 5 s only", "convert train or val; test hides the future"
        )
    start_us = round(float(source.numbers(table, "start_timestamp", "time_ns")[0]) / 1000.0)
    city = str(table["city"][0].as_py())
    table = table.filter(pc.not_equal(table["object_type"], _LEFT_OUT))
    encoded = pc.dictionary_encode(table["object_type"].combine_chunks())
    types = [str(name) for name in encoded.dictionary.to_pylist()]
    source.known(types, TYPES, "object_type")
    sizes = np.array([TYPES[name][1:] for name in types])
    read = {name: source.numbers(table, name, field) for name, field in _MOTION.items()}
    step = source.numbers(table, "timestep", "step").astype(np.int64)
    category = encoded.indices.to_numpy().astype(np.int64)
    return make_samples(
        city,
        time_us=start_us + step * _STEP_US,
        ids=table["track_id"].to_numpy(),
        category=category,
        categories=types,
        xy=np.column_stack([read["position_x"], read["position_y"]]),
        headings=read["heading"],
        velocities=np.column_stack([read["velocity_x"], read["velocity_y"]]),
        sizes=sizes[category],
        kind_of={name: kind for name, (kind, *_) in TYPES.items()},
    )


def _read_map(source: Source, name: str) -> MapSource:
    """The map of a scene: what its `log_map_archive_*.json` says."""
    try:
        found = json.loads(source.content(_MAX_BYTES))
    except (ValueError, RecursionError) as error:
        raise source.fault(f"not readable as JSON ({error})") from error
    source.expect(found, _MAP, "the file")
    return MapSource(
        name=name,
        pieces=[
            _LANE.piece(source, lane, str(lane["id"]), is_connector=lane["is_intersection"])
            for lane in found["lane_segments"].values()
            if lane["lane_type"] != "BIKE"  # they double the connectors of vehicles
        ],
        drivable_areas=[
            _area(source, item["area_boundary"], f"drivable_areas {key!r}")
            for key, item in found["drivable_areas"].items()
        ],
        crosswalks=[
            _area(source, [*item["edge1"], *item["edge2"][::-1]], f"crossing {key!r}")
            for key, item in found["pedestrian_crossings"].items()
        ],
    )


def _area(source: Source, points: list[object], place: str) -> shapely.Polygon:
    return largest_part(shapely.Polygon(source.line(points, place, least=3)))
