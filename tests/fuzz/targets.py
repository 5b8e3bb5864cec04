"""What is fuzzed: for every reader, small sound files, and a call that reads all of them.

A call returns what was read; every number in it must be finite and plausible.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import dsc3d_writer
import numpy as np
import open_data_files
import opendrive_xml
from places import GOLDEN
from stores import write_toy_store

from shiftsim.world.scenario import Scenario

FORMAT = GOLDEN / "nuplan_format"
MANY = 1e12  # no range but that of a time has a larger end
MAY_BE_NAN = ("velocities", "speed_limits")


class Target(NamedTuple):
    """A reader."""

    seeds: Callable[[Path], None]  # writes one folder for each sound input
    read: Callable[[Path], Any]  # reads a folder; returns what it found
    damaged: str = "*"  # which files below are damaged


def implausible(found: Any, where: str = "") -> Iterator[str]:
    """Numbers, at any depth of what was read, that are not finite or far too large."""
    if isinstance(found, Scenario):
        yield from _implausible_scenario(found, where)
    elif isinstance(found, np.ndarray) and found.dtype.kind == "f":
        good = np.abs(found) <= MANY
        if where.rpartition(".")[2] in MAY_BE_NAN:
            good |= np.isnan(found)
        if not good.all():
            yield f"{where}: {found[~good][0]}"
    elif isinstance(found, float) and not abs(found) <= MANY:
        yield f"{where}: {found}"
    elif isinstance(found, dict):
        for key, value in found.items():
            yield from implausible(value, f"{where}[{str(key)[:40]!r}]")
    elif is_dataclass(found):
        for item in fields(found):
            yield from implausible(getattr(found, item.name), f"{where}.{item.name}")
    elif hasattr(found, "_fields"):
        for name in found._fields:
            yield from implausible(getattr(found, name), f"{where}.{name}")
    elif isinstance(found, list | tuple):
        for number, value in enumerate(found):
            yield from implausible(value, f"{where}[{number}]")


def _implausible_scenario(scene: Scenario, where: str) -> Iterator[str]:
    tracks, valid = scene.tracks, scene.tracks.valid
    for name in ("ego", "mission_goal", "mapping"):
        yield from implausible(getattr(scene, name), f"{where}.{name}")
    yield from implausible(tracks.poses[valid], f"{where}.poses")
    yield from implausible(tracks.sizes[valid], f"{where}.sizes")
    yield from implausible(tracks.velocities[valid], f"{where}.velocities")
    if (tracks.sizes[valid] < 0).any():
        yield f"{where}: a negative size"
    if (np.diff(scene.time_us) <= 0).any():
        yield f"{where}: time does not increase"
    rows = scene.iteration_rows
    if not (0 <= rows.min() and rows.max() < len(scene.time_us)):
        yield f"{where}: iterations beyond the rows"


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
    from shiftsim.data.opendrive.map import build_road_map
    from shiftsim.data.opendrive.reading import read_opendrive

    od = read_opendrive(folder / "map.xodr")
    return od.roads, build_road_map(od, name="x")[0]


# --- nuPlan


def _logs(folder: Path) -> None:
    (folder / "log").mkdir()
    shutil.copy(FORMAT / "logs/fixture_log_0001.db", folder / "log/log.db")


@cache
def _town() -> Any:
    from shiftsim.data.nuplan.map import read_map

    return read_map(FORMAT / "maps/fixture-town/1.0.0/map.gpkg", "fixture-town")


def _read_log(folder: Path) -> Any:
    from shiftsim.data.nuplan.scenarios import list_scenarios, read_scenario

    path = folder / "log.db"
    offered = list_scenarios(path)
    return [read_scenario(path, entry.token, _town()) for entry in offered[:1]]


def _packages(folder: Path) -> None:
    (folder / "town").mkdir()
    shutil.copy(FORMAT / "maps/fixture-town/1.0.0/map.gpkg", folder / "town/map.gpkg")


def _read_package(folder: Path) -> Any:
    from shiftsim.data.nuplan.map import read_map

    return read_map(folder / "map.gpkg", "x")


# --- DSC3D and stores


def _sites(folder: Path) -> None:
    times = dsc3d_writer.frame_times(5.0)
    tracks = [
        dsc3d_writer.car(1, times),
        dsc3d_writer.car(7, times, x0=60.0, y=1.75, speed=-5.0, category="pedestrian"),
    ]
    dsc3d_writer.write_site(folder / "site", tracks, 5.0)


def _read_site(folder: Path) -> Any:
    from shiftsim.data.deepplan.convert import convert_dsc3d
    from shiftsim.data.deepplan.windows import ConversionConfig
    from shiftsim.data.dsc3d.recording import open_site, read_recording

    site = open_site(folder)
    recordings = [read_recording(site, name) for name in site.recordings]
    short = ConversionConfig(window_s=4.0, overlap_s=1.0, history_s=1.0, min_drivable_share=0.0)
    convert_dsc3d(folder, folder / "store", options=short)
    return site, recordings, _read_store(folder / "store")


def _open_data(folder: Path) -> None:
    open_data_files.write_av2(folder / "av2")
    open_data_files.write_commonroad(folder / "commonroad")
    open_data_files.write_py123d(folder / "py123d")


def _read_open_data(folder: Path) -> Any:
    from shiftsim.data.open_data.av2 import Av2Reader
    from shiftsim.data.open_data.commonroad import CommonRoadReader
    from shiftsim.data.open_data.py123d import Py123dReader
    from shiftsim.data.open_data.scenes import convert_scene

    readers = {"*.parquet": Av2Reader(), "*.xml": CommonRoadReader(), "*.arrow": Py123dReader()}
    reader = next(r for pattern, r in readers.items() if any(folder.rglob(pattern)))
    made = [convert_scene(reader.read(path)) for path in reader.find(folder)]
    return [(one.road, one.converted.egos, one.converted.windows) for one in made]


def _stores(folder: Path) -> None:
    write_toy_store(folder / "toy", count=2)


def _read_store(folder: Path) -> Any:
    from shiftsim.data.store.check import check_store
    from shiftsim.data.store.reading import ScenarioStore

    check_store(folder)
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
    from shiftsim.runs.results import open_run, stored_results

    run = open_run(folder)
    state_of(folder)
    score_table([run])
    list(stored_results(folder))
    store = ScenarioStore(folder.parent.parent / "run-store")
    logs = []
    for task, place in run.rollout_places.items():
        if place is not None and task.token in store:
            logs.append(run.rollout(task, store.read(task.token)))
    return run.scores.to_pylist(), run.tasks.to_pylist(), [log.ego for log in logs]


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


def _read_checkpoint(folder: Path) -> Any:
    from shiftsim.planners.learned.checkpoint import (
        checked_state,
        find_checkpoint,
        needed_args,
        open_checkpoint,
    )
    from shiftsim.planners.learned.match import network_module

    found = open_checkpoint(find_checkpoint(str(folder)))
    if len(found.state) < 10:  # of no planner
        return found.args
    planner = "diffusion-planner" if (folder / "args.json").exists() else "plantf"
    args = needed_args(found, planner)
    state = checked_state(found, planner, args)
    network_module(planner).build_network(args).load_state_dict(state)
    return [tensor.numpy() for tensor in state.values()]


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
    "open-data": Target(_open_data, _read_open_data, "*.[ajpx]*"),
    "store": Target(_stores, _read_store),
    "run-folder": Target(_runs, _read_run),
    "checkpoint": Target(_checkpoints, _read_checkpoint),
    "settings": Target(_settings, _read_settings),
    "split": Target(_splits, _read_split),
    "reviews": Target(_reviews, _read_reviews),
}
