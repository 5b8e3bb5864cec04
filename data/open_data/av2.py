"""Reader of Argoverse 2 motion forecasting: scenes of 11 s, each with its own map.

The files have no sizes of objects (the usual ones by type are taken), no speed limits and no
lights. Ends of tracks are squeezed: positions move up to 45 % slower than the stored speed. So
stored velocities are taken, except those of tracks that they contradict throughout, and the last
0.5 s belong to no scenario.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.data.lanes.map import build_lane_map
from shiftsim.data.lanes.pieces import LanePiece, MapSource, clean_line
from shiftsim.data.open_data.scenes import REPAIR, Scene
from shiftsim.data.open_data.tables import naming, numbers, read_columns
from shiftsim.data.polygons import largest_part
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples
from shiftsim.errors import ConversionError
from shiftsim.world.ranges import OPEN_DATA, require
from shiftsim.world.state import AgentKind

# by type: what nuPlan calls it, length and width [m]
TYPES = {
    "vehicle": (AgentKind.VEHICLE, 4.6, 1.9),
    "bus": (AgentKind.VEHICLE, 11.6, 2.9),
    "cyclist": (AgentKind.BICYCLE, 1.8, 0.6),
    "motorcyclist": (AgentKind.BICYCLE, 2.2, 0.8),
    "pedestrian": (AgentKind.PEDESTRIAN, 0.7, 0.7),
    "construction": (AgentKind.CZONE_SIGN, 0.5, 0.5),
    "riderless_bicycle": (AgentKind.GENERIC_OBJECT, 1.6, 0.5),
    "static": (AgentKind.GENERIC_OBJECT, 1.0, 1.0),
    "unknown": (AgentKind.GENERIC_OBJECT, 1.0, 1.0),
}
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
        found = sorted(folder.rglob("scenario_*.parquet"))
        if not found:
            raise ConversionError(
                f"{folder}: no scenario_*.parquet below it",
                "give a folder of the motion-forecasting data set, such as val/",
            )
        return found

    def files(self, path: Path) -> list[Path]:
        """The tracks and the map."""
        name = path.stem.removeprefix("scenario_")
        return [path, path.with_name(f"log_map_archive_{name}.json")]

    def read(self, path: Path) -> Scene:
        """One scene."""
        path, map_path = self.files(path)
        name = path.stem.removeprefix("scenario_")
        with naming(path):
            samples = _read_tracks(path)
        with naming(map_path):
            lanes = build_lane_map(read_map(map_path, f"av2-{name}"))
        return Scene(
            samples=samples,
            map=lanes,
            egos=(EGO,),
            left_out_s=_SQUEEZED_S,
            metadata={**_METADATA, "scenario_id": name},
        )


def _read_tracks(path: Path) -> TrackSamples:
    table = read_columns(path, _COLUMNS, REPAIR)
    if not len(table):
        raise ConversionError(f"{path}: no rows", REPAIR)
    if pc.all(table["observed"]).as_py():
        raise ConversionError(
            f"{path}: holds the observed 5 s only", "convert train or val; test hides the future"
        )
    start_us = round(float(numbers(table, "start_timestamp", "time_ns", path)[0]) / 1000.0)
    city = str(table["city"][0].as_py())
    table = table.filter(pc.not_equal(table["object_type"], _LEFT_OUT))
    encoded = pc.dictionary_encode(table["object_type"].combine_chunks())
    types = [str(name) for name in encoded.dictionary.to_pylist()]
    unknown = sorted(set(types) - set(TYPES))
    if unknown:
        what = f"{path}: column 'object_type' holds {unknown[0]!r}"
        raise ConversionError(what, f"known are: {', '.join(TYPES)}")
    sizes = np.array([TYPES[name][1:] for name in types])
    read = {name: numbers(table, name, field, path) for name, field in _MOTION.items()}
    step = numbers(table, "timestep", "step", path).astype(np.int64)
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


def read_map(path: Path, name: str) -> MapSource:
    """The map of a scene: what its `log_map_archive_*.json` says.

    Raises:
        ConversionError: The file is missing or broken.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConversionError(f"{path}: more than {_MAX_BYTES} bytes", REPAIR)
        found = json.loads(path.read_text("utf-8"))
    except FileNotFoundError as error:
        raise ConversionError(f"{path} is missing", "copy the map beside the tracks") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ConversionError(f"{path}: not readable as JSON ({error})", REPAIR) from error
    try:
        return MapSource(
            name=name,
            pieces=[
                _piece(item, f"{path}: lane_segments {key!r}")
                for key, item in found["lane_segments"].items()
                if item["lane_type"] != "BIKE"  # they double the connectors of vehicles
            ],
            drivable_areas=[
                largest_part(shapely.Polygon(_line(item, "area_boundary", f"{path}: {key!r}", 3)))
                for key, item in found["drivable_areas"].items()
            ],
            crosswalks=[
                _crosswalk(item, f"{path}: pedestrian_crossings {key!r}")
                for key, item in found["pedestrian_crossings"].items()
            ],
        )
    except KeyError as error:
        raise ConversionError(f"{path}: {error.args[0]!r} is missing", REPAIR) from error
    except (TypeError, ValueError, AttributeError) as error:
        raise ConversionError(f"{path}: a value has the wrong type ({error})", REPAIR) from error


def _piece(item: dict[str, Any], where: str) -> LanePiece:
    center = item.get("centerline")  # the data set of sensors has none
    return LanePiece(
        id=str(item["id"]),
        left=_line(item, "left_lane_boundary", where, 2),
        right=_line(item, "right_lane_boundary", where, 2),
        center=None if center is None else _line(item, "centerline", where, 2),
        successors=tuple(map(str, item["successors"])),
        left_neighbor=_name(item.get("left_neighbor_id")),
        right_neighbor=_name(item.get("right_neighbor_id")),
        is_connector=bool(item["is_intersection"]),
    )


def _name(value: Any) -> str | None:
    return None if value is None else str(value)


def _crosswalk(item: dict[str, Any], where: str) -> shapely.Polygon:
    first, second = (_line(item, edge, where, 2) for edge in ("edge1", "edge2"))
    return largest_part(shapely.Polygon(np.concatenate([first, second[::-1]])))


def _line(item: dict[str, Any], key: str, where: str, least: int) -> FloatArray:
    """(K, 2) a list of points of a map."""
    points = np.array([(point["x"], point["y"]) for point in item[key]], np.float64)
    if len(points) < least:
        raise ConversionError(f"{where}: {key!r} has {len(points)} points", REPAIR)
    require(OPEN_DATA, "position", points, f"{where}: {key!r} as", error=ConversionError)
    return clean_line(points)
