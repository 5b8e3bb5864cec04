"""What is fuzzed: for every reader, small sound files, and a call that reads all of them.

A call returns what was read; every number in it must be finite and plausible.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import dsc3d_writer
import numpy as np
import open_data_files
import opendrive_xml
from fuzz.tables import read_results, read_track_table, write_results, write_track_tables
from places import GOLDEN
from recordings import require_plausible
from stores import write_toy_store

from shiftsim.data.store.map import require_sound
from shiftsim.errors import DataError
from shiftsim.planners.table import shipped_file
from shiftsim.runs.tables import _RANGES as RUN_COLUMNS
from shiftsim.world.map import LAYERS, VectorMap
from shiftsim.world.ranges import (
    CHECKPOINT,
    DSC3D,
    MAP_EXTENT,
    OPENDRIVE,
    RUN,
    SETTINGS,
    STORE,
    Range,
)
from shiftsim.world.scenario import Scenario

FORMAT = GOLDEN / "nuplan_format"
ANYTHING = Range(-1e12, 1e12)  # of what is in no table: no range but that of a time is wider


def _rows(element: str, names: str = "sOffset a b c d") -> tuple[Range, ...]:
    return tuple(OPENDRIVE[f"{element} {name}"] for name in names.split())


# ranges of what is yielded, by `Class.field`, by key of a dictionary, or by name of a dataclass's
# field alone; for an array several, one for each column
EXPECTED: dict[str, Range | tuple[Range, ...]] = {
    **{f"Geometry.{name}": OPENDRIVE[f"geometry {name}"] for name in ("s", "x", "y", "length")},
    "Geometry.heading": OPENDRIVE["geometry hdg"],
    "Lane.widths": _rows("width"),
    "Lane.borders": _rows("border"),
    "Road.offsets": _rows("laneOffset", "s a b c d"),
    "Road.elevation": _rows("elevation", "s a b c d"),
    "Road.length": OPENDRIVE["road length"],
    "LaneSection.s": OPENDRIVE["laneSection s"],
    "RoadType.s": OPENDRIVE["type s"],
    "Speed.s": OPENDRIVE["speed sOffset"],
    "Speed.limit": OPENDRIVE["speed max"],  # in m/s not more than in the units of files
    "Outline.corners": OPENDRIVE["cornerRoad s"],  # cornerLocal's is narrower
    **{f"Repeat.{name}": OPENDRIVE[f"repeat {name}"] for name in ("s", "length", "distance")},
    "Repeat.t_start": OPENDRIVE["repeat tStart"],
    "Repeat.t_end": OPENDRIVE["repeat tEnd"],
    **{f"RoadObject.{name}": OPENDRIVE[f"object {name}"] for name in ("s", "t", "length", "width")},
    "RoadObject.heading": OPENDRIVE["object hdg"],
    **{f"Signal.{name}": OPENDRIVE[f"signal {name}"] for name in ("s", "t", "value", "width")},
    "OpenDrive.offset": tuple(OPENDRIVE[f"offset {name}"] for name in ("x", "y", "z", "hdg")),
    "Site.zone": DSC3D["reference_utm.zone"],
    "Site.offset": DSC3D["reference_utm.offset"],
    "Site.frame_rate": DSC3D["frame_rate"],
    "Site.frame_distance": DSC3D["frame_distance"],
    "TrackSamples.start_us": DSC3D["time"],
    "TrackSamples.frame": DSC3D["frame_id"],
    "TrackSamples.track_ids": DSC3D["track_id"],
    # a box rests on its bottom, which may be tilted
    "TrackSamples.xy": Range(*(1.01 * end for end in DSC3D["translation_x"][:2])),
    "TrackSamples.raw_headings": DSC3D["rotation_x"],
    "TrackSamples.sizes": DSC3D["dimension_x"]._replace(low=1e-300),
    "TrackSamples.velocities": Range(-200, 200, "m/s"),  # faster ones are not believed
    **{name: RUN[field] for name, field in RUN_COLUMNS.items()},
    "ego of a rollout": RUN["state"],
    "weight": CHECKPOINT["weight"],
    **{name: allowed for name, allowed in CHECKPOINT.items() if name != "weight"},
    **SETTINGS,
    **MAP_EXTENT,
    **{name: STORE[name] for name in ("duration_s", "offset_s", "subsample_ratio", "goal_pose")},
    **{name: STORE[name] for name in ("first_row", "last_row", "row_step")},
}
MAY_BE_NAN = ("planning_seconds",)


class Target(NamedTuple):
    """A reader."""

    seeds: Callable[[Path], None]  # writes one folder for each sound input
    read: Callable[[Path], Any]  # reads a folder; returns what it found
    damaged: str = "*"  # which files below are damaged


def implausible(found: Any, where: str = "", field: str = "") -> Iterator[str]:
    """Numbers, at any depth of what was read, that are outside of the range of their field."""
    try:
        if isinstance(found, Scenario):
            yield from _implausible_scenario(found, where)
        elif isinstance(found, VectorMap):
            require_sound(found, f"{where} map")
        elif isinstance(found, np.ndarray) and (found.dtype.kind == "f" or field in EXPECTED):
            yield from _outside(found, where, field)
        elif isinstance(found, float) or (isinstance(found, int) and field in EXPECTED):
            yield from _outside(np.array([found], np.float64), where, field)
        elif isinstance(found, dict):
            for key, value in found.items():
                name = key if isinstance(key, str) and key in EXPECTED else field
                yield from implausible(value, f"{where}[{str(key)[:40]!r}]", name)
        elif is_dataclass(found):
            for item in fields(found):
                name = f"{type(found).__name__}.{item.name}"
                name = name if name in EXPECTED else item.name
                yield from implausible(getattr(found, item.name), f"{where}.{item.name}", name)
        elif isinstance(found, tuple) and isinstance(EXPECTED.get(field), tuple):
            yield from _outside(np.array([found], np.float64), where, field)
        elif isinstance(found, list | tuple):
            for number, value in enumerate(found):
                yield from implausible(value, f"{where}[{number}]", field)
    except DataError as error:  # of what a store may hold
        yield str(error)


def _outside(found: np.ndarray, where: str, field: str) -> Iterator[str]:
    allowed = EXPECTED.get(field, ANYTHING)
    if isinstance(allowed, Range):
        good = allowed.holds(found)
        if field in MAY_BE_NAN:
            good |= np.isnan(found)
        if not good.all():
            yield f"{where}: {found[~good][0]} is beyond {allowed}"
    else:
        for column, (values, one) in enumerate(zip(found.T, allowed, strict=True)):
            if not one.holds(values).all():
                yield f"{where}, column {column}: {values} is beyond {one}"


def _implausible_scenario(scene: Scenario, where: str) -> Iterator[str]:
    require_plausible(scene)
    names = ("duration_s", "offset_s", "subsample_ratio")
    values = dict(zip(names, scene.mapping, strict=True)) | {"goal_pose": scene.mission_goal}
    yield from implausible(values, f"{where}.mapping")
    yield from implausible(scene.row_step, f"{where}.row_step", "row_step")
    rows = scene.iteration_rows
    if not (0 <= rows.min() and rows.max() < len(scene.time_us)):
        yield f"{where}: iterations beyond the rows"


def _extent(road: VectorMap) -> dict[str, float]:
    """Width or height of all layers of a map [m], as its reader limits them."""
    boxes = [getattr(road, name).polygons.bounds for name in LAYERS]
    spans = [box[:, 2:].max(axis=0) - box[:, :2].min(axis=0) for box in boxes if len(box)]
    return {"extent": float(np.max(spans, initial=0.0))}


# --- OpenDRIVE


def _roads(folder: Path) -> None:
    inner = (
        '<type s="0" type="town"><speed max="50" unit="km/h"/></type><elevationProfile>'
        '<elevation s="0" a="1" b="0.01" c="0" d="0"/></elevationProfile><objects>'
        '<object id="a" type="crosswalk" s="5" t="1" hdg="0.5" length="3" width="7"><outlines>'
        '<outline><cornerLocal u="-1" v="-4"/><cornerLocal u="1" v="-4"/>'
        '<cornerLocal u="1" v="4"/></outline></outlines></object><object id="p" type="parkingSpace"'
        ' s="20" t="-5" length="5" width="2.5"><repeat s="20" length="30" distance="6" tStart="-5"'
        ' tEnd="-5"/></object></objects><signals><signal id="b" dynamic="yes" type="1000001"'
        ' s="90" t="-4" orientation="+" value="-1" width="0.4"/></signals>'
    )
    curves = opendrive_xml.road(
        length=300,
        plan=[
            opendrive_xml.geometry('<spiral curvStart="0" curvEnd="0.02"/>', length=100),
            opendrive_xml.geometry('<arc curvature="0.02"/>', s=100, x=87, y=46, hdg=1, length=100),
            opendrive_xml.geometry(
                '<paramPoly3 aU="0" bU="100" cU="0" dU="0" aV="0" bV="0" cV="9" dV="-6"/>',
                s=200,
                x=95,
                y=140,
                hdg=3,
            ),
        ],
        inner=inner,
        offsets='<laneOffset s="0" a="0.5" b="0" c="0" d="0"/>',
    )
    header = '<header revMajor="1" revMinor="7"><offset x="1" y="2" z="3" hdg="0.5"/></header>'
    files = {
        "cross": opendrive_xml.crossroads(),
        "curves": opendrive_xml.document(curves, header=header),
        "straight": dsc3d_writer.straight_road().encode(),
    }
    for name, data in files.items():
        (folder / name).mkdir()
        (folder / name / "map.xodr").write_bytes(data)


def _read_opendrive(folder: Path) -> Any:
    from shiftsim.data.maps.opendrive.map import build_road_map
    from shiftsim.data.maps.opendrive.reading import read_opendrive

    od = read_opendrive(folder / "map.xodr")
    road = build_road_map(od, name="x")[0]
    return od, road, _extent(road)


# --- nuPlan


def _logs(folder: Path) -> None:
    (folder / "log").mkdir()
    shutil.copy(FORMAT / "logs/fixture_log_0001.db", folder / "log/log.db")


@cache
def _town() -> Any:
    from shiftsim.data.nuplan.map import read_map

    return read_map(FORMAT / "maps/fixture-town/1.0.0/map.gpkg", "fixture-town")


def _read_log(folder: Path) -> Any:
    from nuplan_logs import list_scenarios, read_scenario

    path = folder / "log.db"
    offered = list_scenarios(path)
    return [read_scenario(path, entry.token, _town()) for entry in offered[:1]]


def _packages(folder: Path) -> None:
    (folder / "town").mkdir()
    shutil.copy(FORMAT / "maps/fixture-town/1.0.0/map.gpkg", folder / "town/map.gpkg")


def _read_package(folder: Path) -> Any:
    from shiftsim.data.nuplan.map import read_map

    road = read_map(folder / "map.gpkg", "x")
    return road, _extent(road)


# --- DSC3D and stores


def _sites(folder: Path) -> None:
    times = dsc3d_writer.frame_times(5.0)
    tracks = [
        dsc3d_writer.car(1, times),
        dsc3d_writer.car(7, times, x0=60.0, y=1.75, speed=-5.0, category="pedestrian"),
    ]
    dsc3d_writer.write_site(folder / "site", tracks, 5.0)


def _read_site(folder: Path) -> Any:
    from shiftsim.data.readers.dsc3d import convert_dsc3d, open_site, read_recording
    from shiftsim.data.readers.windows import ConversionConfig

    site = open_site(folder)
    recordings = [read_recording(site, name) for name in site.recordings]
    short = ConversionConfig(window_s=4.0, overlap_s=1.0, history_s=1.0, min_drivable_share=0.0)
    convert_dsc3d(folder, folder / "store", options=short)
    return site, recordings, read_store(folder / "store")


def _av2(folder: Path) -> None:
    open_data_files.write_av2(folder / "scene")


def _commonroad(folder: Path) -> None:
    for version in ("2018b", "2020a"):
        open_data_files.write_commonroad(folder / version, version)


def _py123d(folder: Path) -> None:
    open_data_files.write_py123d(folder / "logs")


def _read_scenes(name: str, folder: Path) -> Any:
    from shiftsim.data.readers.av2 import Av2Reader
    from shiftsim.data.readers.commonroad import CommonRoadReader
    from shiftsim.data.readers.py123d import Py123dReader
    from shiftsim.data.readers.scenarios import convert_recording

    reader = {"av2": Av2Reader, "commonroad": CommonRoadReader, "py123d": Py123dReader}[name](
        folder
    )
    sources = [reader.read(name) for name in reader.recordings()]
    converted = [convert_recording(source) for source in sources]
    roads = [source.map.road for source in sources]
    return roads, [(one.egos, one.windows) for one in converted]


def _stores(folder: Path) -> None:
    write_toy_store(folder / "toy", count=2)


def read_store(folder: Path) -> Any:
    """A store, its maps and scenarios, looked at as `shiftsim check` does."""
    from shiftsim.data.store.check import survey_store
    from shiftsim.data.store.reading import ScenarioStore

    survey_store(folder)
    store = ScenarioStore(folder)
    return [store.map(city) for city in store.cities], list(store), store.summary().to_pylist()


# --- run folders


def _runs(folder: Path) -> None:
    import shiftsim

    store = write_toy_store(folder.parent / "run-store", count=2)
    shiftsim.run(
        ["constant-velocity"], noise=["none", "ou-high"], store=str(store), workers=1,
        out=str(folder / "run"),
    )  # fmt: skip


def _read_run(folder: Path) -> Any:
    from shiftsim.data.store.reading import ScenarioStore
    from shiftsim.report.scores import score_table
    from shiftsim.runs.manifest import state_of
    from shiftsim.runs.results import open_run
    from shiftsim.runs.tables import stored_results

    run = open_run(folder)
    state_of(folder)
    score_table([run])
    list(stored_results(folder))
    store = ScenarioStore(folder.parent.parent / "run-store")
    logs = []
    for task, place in run.rollout_places.items():
        if place is not None and task.token in store:
            logs.append(run.rollout(task, store.read(task.token)))
    egos = {"ego of a rollout": [log.ego for log in logs]}
    return run.scores.to_pylist(), run.tasks.to_pylist(), egos


# --- checkpoints


def _checkpoints(folder: Path) -> None:
    import torch
    from checkpoint_files import save, state_of, write_diffusion, write_published
    from safetensors.torch import save_file

    (folder / "diffusion-planner").mkdir()
    write_published(folder / "plantf", "plantf", state_of("plantf"))
    write_diffusion(folder / "diffusion-planner", state_of("diffusion-planner"))
    few = {"a.weight": torch.ones(3, 4), "a.bias": torch.ones(3)}
    for name in ("zip", "legacy", "safetensors", "object"):
        (folder / name).mkdir()
    save({"state_dict": few, "epoch": 3}, folder / "zip/model.pth")
    save({"state_dict": few}, folder / "legacy/model.pth", _use_new_zipfile_serialization=False)
    save({"state_dict": few, "x": Path("y")}, folder / "object/model.pth")
    save_file(few, folder / "safetensors/model.safetensors", {"args": '{"x": 1}'})
    (folder / "own").mkdir()
    shutil.copy(shipped_file("carl"), folder / "own")


def _read_checkpoint(folder: Path) -> Any:
    from shiftsim.planners.learned.checkpoint import (
        checked_state,
        find_checkpoint,
        needed_args,
        network_module,
        open_checkpoint,
    )

    found = open_checkpoint(find_checkpoint(str(folder)))
    if len(found.state) < 10:  # of no planner
        return {"args": found.args}
    known = {"args.json": "diffusion-planner", shipped_file("carl").name: "carl"}
    planner = next((name for file, name in known.items() if (folder / file).exists()), "plantf")
    args = needed_args(found, planner)
    state = checked_state(found, planner, args)
    network_module(planner).build_network(args).load_state_dict(state)
    return {"weight": [tensor.numpy() for tensor in state.values()], "args": args}


# --- settings, splits and reviews

RUN_TOML = """\
planners = ["idm", "pdm-closed"]
noise = ["none", "ou-high"]
seeds = [0, 1, 2]
store = "demo"
limit = 10
batch_size = 2
workers = 2
timeout = 60.0
shard = "1/4"
strict = true
[planner_args.idm]
target_velocity = 10.0
"""
CONVERT_TOML = """\
window_s = 18.0
overlap_s = 5.0
history_s = 3.0
min_drivable_share = 0.5
max_per_window = 5
country = "DE"
[category_map]
robot = "pedestrian"
"""


def _settings(folder: Path) -> None:
    for name, text in (("run", RUN_TOML), ("convert", CONVERT_TOML)):
        (folder / name).mkdir()
        (folder / name / f"{name}.toml").write_text(text)


def _read_settings(folder: Path) -> Any:
    from shiftsim.cli.convert import _options
    from shiftsim.files import read_toml
    from shiftsim.runs.config import make_config

    path = next(folder.glob("*.toml"))
    if path.stem == "run":
        made = make_config(read_toml(path), where=str(path))
        return made.to_dict() | {"planner_args": None}  # which the planners check
    return _options(path, {})


def _splits(folder: Path) -> None:
    from shiftsim.runs.scenarios import token_hash

    tokens = [f"{number:04x}cafe" for number in range(4)]
    text = f'name = "test"\ncount = 4\nhash = "{token_hash(tokens)}"\ntokens = {tokens}\n'
    for name, content in (("split.toml", text), ("split.txt", "\n".join(tokens))):
        (folder / name).mkdir()
        (folder / name / name).write_text(content)


def _read_split(folder: Path) -> Any:
    from shiftsim.runs.scenarios import find_split, read_split

    path = next(folder.glob("split.*"))
    find_split(str(path), folder, ("0000cafe",))
    return read_split(path)


def _reviews(folder: Path) -> None:
    rows = [
        {"token": "0000cafe", "decision": "accept", "comment": "good", "route": ["1", "2"]},
        {"token": "0001cafe", "decision": "reject", "comment": "", "route": None, "reviewer": "a"},
    ]
    path = folder / "store/review/review.jsonl"
    path.parent.mkdir(parents=True)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def _read_reviews(folder: Path) -> Any:
    from shiftsim.data.store.review import read_reviews

    reviews = read_reviews(folder)
    return reviews.hash, reviews.route_hash, reviews.usable(["0000cafe"], ["0001cafe"])


TARGETS = {
    "opendrive": Target(_roads, _read_opendrive),
    "nuplan-log": Target(_logs, _read_log),
    "nuplan-map": Target(_packages, _read_package),
    "dsc3d": Target(_sites, _read_site, "*.[jp]*"),
    "av2": Target(_av2, partial(_read_scenes, "av2"), "*.[jp]*"),
    "commonroad": Target(_commonroad, partial(_read_scenes, "commonroad"), "*.xml"),
    "py123d": Target(_py123d, partial(_read_scenes, "py123d"), "*.arrow"),
    "store": Target(_stores, read_store),
    "run-folder": Target(_runs, _read_run),
    "checkpoint": Target(_checkpoints, _read_checkpoint),
    "settings": Target(_settings, _read_settings),
    "split": Target(_splits, _read_split),
    "reviews": Target(_reviews, _read_reviews),
    "tracks": Target(write_track_tables, read_track_table),
    "experiment": Target(write_results, read_results),
}
