"""Reader of Argoverse 2 motion forecasting: scenes of 11 s, each with its own map.

The files have no sizes of objects (the usual ones by type are taken), no speed limits and no
lights. Ends of tracks are squeezed: positions move up to 45 % slower than the stored speed. So
stored velocities are taken, except those of tracks that they contradict throughout, and the last
0.5 s belong to no scenario.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from shiftsim.data.lanes.map import build_lane_map
from shiftsim.data.lanes.pieces import LanePiece, MapSource
from shiftsim.data.open_data.codes import TYPES
from shiftsim.data.open_data.scenes import Scene
from shiftsim.data.open_data.source import Source, find_below, text_or_none
from shiftsim.data.polygons import largest_part
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples

EGO = "AV"
_COLUMNS = {
    "observed": pa.bool_(),
    "track_id": pa.string(),
    "object_type": pa.string(),
    "timestep": pa.int64(),
    "position_x": pa.float64(),
    "position_y": pa.float64(),
    "heading": pa.float64(),
    "velocity_x": pa.float64(),
    "velocity_y": pa.float64(),
    "start_timestamp": pa.float64(),  # ns
    "city": pa.string(),
}
_MOTION = {n: n.partition("_")[0] for n in list(_COLUMNS)[4:9]}  # column -> field of `OPEN_DATA`
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
    if not len(table):
        raise source.fault("no rows")
    if pc.all(table["observed"]).as_py():
        raise source.fault(
            "holds the observed 5 s only", "convert train or val; test hides the future"
        )
    start_us = round(float(source.numbers(table, "start_timestamp", "time_ns")[0]) / 1000.0)
    city = str(table["city"][0].as_py())
    table = table.filter(pc.not_equal(table["object_type"], _LEFT_OUT))
    encoded = pc.dictionary_encode(table["object_type"].combine_chunks())
    types = [str(name) for name in encoded.dictionary.to_pylist()]
    if unknown := sorted(set(types) - set(TYPES)):
        what = f"column 'object_type' holds {unknown[0]!r}"
        raise source.fault(what, f"known are: {', '.join(TYPES)}")
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
        return MapSource(
            name=name,
            pieces=[
                _piece(source, item, f"lane_segments {key!r}")
                for key, item in found["lane_segments"].items()
                if item["lane_type"] != "BIKE"  # they double the connectors of vehicles
            ],
            drivable_areas=[
                _area(source, f"drivable_areas {key!r}", item["area_boundary"])
                for key, item in found["drivable_areas"].items()
            ],
            crosswalks=[
                _area(source, f"crossing {key!r}", [*item["edge1"], *item["edge2"][::-1]])
                for key, item in found["pedestrian_crossings"].items()
            ],
        )
    except json.JSONDecodeError as error:
        raise source.fault(f"not readable as JSON ({error})") from error
    except KeyError as error:
        raise source.fault(f"{error.args[0]!r} is missing") from error
    except (TypeError, ValueError, AttributeError, RecursionError) as error:
        raise source.fault(f"a value has the wrong type ({error})") from error


def _piece(source: Source, item: dict[str, Any], place: str) -> LanePiece:
    lines = {
        key: source.line(_points(item[key]), f"{place}: {key!r}")
        for key in ("left_lane_boundary", "right_lane_boundary", "centerline")
        if key != "centerline" or item.get(key) is not None  # the data set of sensors has none
    }
    return LanePiece(
        id=str(item["id"]),
        left=lines["left_lane_boundary"],
        right=lines["right_lane_boundary"],
        center=lines.get("centerline"),
        successors=tuple(map(str, item["successors"])),
        left_neighbor=text_or_none(item.get("left_neighbor_id")),
        right_neighbor=text_or_none(item.get("right_neighbor_id")),
        is_connector=bool(item["is_intersection"]),
    )


def _area(source: Source, place: str, points: Sequence[Any]) -> shapely.Polygon:
    return largest_part(shapely.Polygon(source.line(_points(points), place, least=3)))


def _points(found: Sequence[Any]) -> list[tuple[float, float]]:
    return [(point["x"], point["y"]) for point in found]
