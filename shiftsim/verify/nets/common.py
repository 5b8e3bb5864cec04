"""The nets folder: the learned planners with deterministic weights against the official code.

Here is what is compared of all: the manifest of a network, closed loops, routes as the planners
correct them. The module of a planner has the `PLANNER`, its `TABLES`, `compare`, which looks at one
iteration of a closed loop, and `FILES`: what compares a further file, by glob pattern.
Weights are deterministic: anybody can make them again from the names of the tensors.
In a closed loop a rollout of ours is moved by what is recorded; the planner sees it, and what it
says is compared.
"""

import hashlib
import json
import re
import zlib
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.data.nuplan.scenarios import find_maps
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.planners.learned.checkpoint import network_module
from shiftsim.planners.learned.deterministic import deterministic_state, keyed_normals, rule_of
from shiftsim.planners.learned.features import PLAN_POSES, STEP
from shiftsim.planners.routes import correction
from shiftsim.sim.loop import Rollout
from shiftsim.sim.planner import past_rows
from shiftsim.verify.files import Scenes, Source, read_file, verify_files
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.world import state
from shiftsim.world.scenario import Scenario

TABLES = read_tables(__file__)
PARTS = ("carl", "diffusion_planner", "plantf", "pluto", "route_correction")  # sub-folders
SQUARE = 1.0  # m, half width
STATE = 1e-8  # m, rad, m/s, …: logged and simulated ego states

# As in state.STATE_COLUMNS, in the words of the files.
FILE_COLUMNS = (*state.STATE_COLUMNS[:9], "angular_velocity", "angular_acceleration")
# how one official planner fails where it has no reference line; ours falls back there
FAILURE = "ValueError: zero-size array to reduction operation maximum which has no identity"


def verify_nets(folder: Path, report: Report, *, scenes: Path | None = None) -> None:
    """Compare every file of a folder with sub-folders named as the parts, or of one of these.

    `scenes` holds the logs and maps, by default `nuplan` beside `nets`.
    """
    home, manifest = folder.resolve().parent, folder / "state_dict.json"
    part = read_file(manifest, Report())["planner"] if manifest.is_file() else ""
    if any(folder.glob("route_correction_*.json")):
        part = "route_correction"
    known = Scenes(scenes or (home.parent if part in PARTS else home) / "nuplan")
    if part in PARTS:
        verify_part(part, folder, report, known)
    else:
        parts = {name: partial(verify_part, name, report=report, scenes=known) for name in PARTS}
        verify_files(folder, report, parts)


def verify_part(part: str, folder: Path, report: Report, scenes: Scenes) -> None:
    """Compare every file of a sub-folder, whose name as in `PARTS` is `part`."""
    is_network = part != "route_correction"
    if is_network and find_spec("torch") is None:
        report.skip(f"{part}: torch is not installed")
        return
    files: dict[str, Any] = {"route_correction_*.json": partial(verify_corrections, scenes)}
    if is_network:
        module = import_module(f"shiftsim.verify.nets.{part}")
        files = {"closed_loop_*.npz": partial(verify_loop, module, scenes), **module.FILES}
        files["state_dict.json"] = partial(verify_manifest, module)
    parts = {pattern: partial(_verify, files[pattern], report, scenes) for pattern in files}
    with import_module("torch").no_grad() if is_network else nullcontext():
        verify_files(folder, report, parts)


def _verify(compare: Callable[[Source], None], report: Report, scenes: Scenes, path: Path) -> None:
    """Compare one file, if its scene is at hand."""
    file = read_file(path, report)
    scene = next((str(file[name]) for name in ("meta/scene", "scene") if name in file), None)
    if scene is not None and scene not in scenes.entries:
        report.skip(f"{path.name}: scene {scene}, which is not at hand")
        return
    compare(file)
    file.finish()


@cache
def make_planner(make: Callable[[str], Any], variant: str) -> Any:
    """A planner with a variant of the deterministic weights; its network serves all files."""
    return make(f"deterministic:{variant}")


def match_meta(file: Source, planner: str, **ours: object) -> None:
    """Compare the JSON text in the array `meta`."""
    file.report.compare(f"{planner} meta", file.name, ours, json.loads(str(file["meta"])))


def match_case(file: Source, planner: str) -> list[str]:
    """`match_meta` of a forward pass: its name, and the variants of the weights that it has."""
    variants = sorted({name.split(".")[1] for name in file if name.count(".") > 1})
    match_meta(file, planner, case=file.name.removeprefix("forward_"), variants=variants)
    return variants


def verify_manifest(compared: Any, file: Source) -> None:
    """Compare `state_dict.json`: names, shapes, types, rules and weights, and the other fields.

    Section `manifest` of the tables has these; `weights` has by field which weights it counts, as
    a pattern of their names: the trainable ones if it says so.
    """
    report, tables, planner = file.report, compared.TABLES, compared.PLANNER.name
    module = network_module(planner)
    network, rules = module.build_network(), getattr(module, "RULES", {})
    built = {name: value.detach().numpy() for name, value in network.state_dict().items()}
    trained = {name for name, _ in network.named_parameters()}
    entries = file.each("keys" if "keys" in file else "entries")
    listed = [str(entry["key" if "key" in entry else "name"]) for entry in entries]
    report.compare(f"{planner} state names", file.name, sorted(built), sorted(listed))
    for name, entry in zip(listed, entries, strict=True):
        if name in built:
            tensor, kind = built[name], "parameter" if name in trained else "buffer"
            known = {"tensor": tensor, "kind": kind, "name": name, "network": module}
            known["rule"] = rules.get(name) or rule_of(name, tensor.ndim)
            TABLES["tensor"].match(entry, name, f"{planner} state", **known)
    (check,) = file.each("selfcheck")
    if "first3_raw_z" in check:
        where, shape = check["name"], built[check["name"]].shape
        firsts = {"shape": shape, "first3_raw_z": keyed_normals(where, shape).ravel()[:3]}
        check.used.add("note")
    else:
        where, weights = "selfcheck", deterministic_state(built, rules)
        firsts = {name: weights[name].ravel()[:3].astype(float) for name in check}
    check.match(where, firsts, quantity=f"{planner} selfcheck")
    heads = {
        layer: {"C": len(head.gain), **{name: list(v) for name, v in asdict(head).items()}}
        for layer, head in getattr(module, "DRIVE_HEADS", {}).items()
    }
    called, made = f"{planner} manifest", import_module(compared.PLANNER.__module__)
    names = {"network": module, "heads": heads, "scales": getattr(module, "DRIVE_SCALES", {})}
    names |= {"planner": made, "step": STEP, "future": PLAN_POSES * STEP}
    tables["manifest"].match(file, file.name, called, **names)
    counts = {}
    for field, pattern in tables["weights"].rows.items():
        counted = trained if "trainable" in field else built
        counts[field] = sum(built[name].size for name in counted if re.match(pattern, name))
    file.match(file.name, counts, quantity=called)
    file.used.add("planner")


class Loop:
    """One closed-loop file, and its iteration that is compared just now."""

    def __init__(self, module: Any, file: Source, scenario: Scenario) -> None:
        self.file, self.tables, self.where = file, {**TABLES, **module.TABLES}, file.name
        self.scenario, self.road, self.tracks = scenario, scenario.map, scenario.tracks
        self.variant = str(file["meta/variant"])  # of its weights
        self.planner = make_planner(module.PLANNER, self.variant)  # after this iteration
        self.name, self.rollout = self.planner.name, Rollout(scenario, self.planner)

    def step(self, number: int) -> None:
        """Look at an iteration, which must be that of the rollout, and make its plan again."""
        self.where = f"{self.file.name} iteration {number}"
        self.stored = self.file.below(f"it{number:02d}/")  # what is stored of it alone
        self.row = self.file.below("out/").at(number)  # of the arrays of the whole loop
        self.seen = self.rollout.observe()  # what the planner saw
        self.features = self.planner.features(self.seen)
        (self.output,) = self.planner.infer([self.features])
        self.answer = self.planner.decode(self.output, self.seen)

    def advance(self) -> None:
        """Go to the next iteration by the recorded plan."""
        if "command" in self.row:
            self.rollout.advance(state.Command(*self.row["command"].tolist()))
        else:
            plan = self.row["trajectory"]  # pose, velocity, acceleration
            states = np.pad(plan, ((0, 0), (0, state.NUM_STATE - plan.shape[1])))
            self.rollout.advance(state.Trajectory(self.row["trajectory_time_us"], states))

    def compare(self, quantity: str, ours: object, theirs: object, atol: float = 0.0) -> None:
        """Compare one quantity of this iteration."""
        report = self.file.report
        report.compare(f"{self.name} {quantity}", self.where, ours, theirs, atol=atol)

    def match(self, section: str, theirs: Source, called: str = "", /, **names: Any) -> None:
        """Compare by a section of the tables, which finds what this object has."""
        called = f"{self.name} {called}".strip()
        self.tables[section].match(theirs, self.where, called, **{**vars(self), **names})


def verify_loop(module: Any, scenes: Scenes, file: Source) -> None:
    """Make every step of a closed loop again, and compare it.

    The arrays of section `iteration` of the tables have a row for every plan.
    """
    loop = Loop(module, file, scenes[str(file["meta/scene"])])
    egos, plans = file["ego/current"], file.below("out/")
    counts = [len(plans[name.partition("[")[0]]) for name in loop.tables["iteration"].rows]
    loop.compare("plans", counts, counts[:1] * len(counts))
    entry, meta = scenes.entries[str(file["meta/scene"])], file.below("meta/")
    paths = scenes.folder / entry["db"], find_maps(scenes.folder / "maps")[entry["map"]]
    content = [path.read_bytes() for path in paths]
    names = {"columns": FILE_COLUMNS, "past": past_rows(loop.scenario, 0)}
    names["time_us"] = loop.scenario.iteration_times[: len(egos)]
    names["md5"] = [hashlib.md5(data, usedforsecurity=False).hexdigest() for data in content]
    names["crc32"] = [zlib.crc32(data) for data in content]
    names["paths"] = [path.relative_to(scenes.folder).as_posix() for path in paths]
    loop.match("scene", meta, "scene", **names)
    loop.match("sources", meta, "scene", **names)
    loop.match("ego", file.below("ego/"), **names)
    failure = f"iteration {counts[0]}: {FAILURE}" if counts[0] < len(egos) else ""
    loop.compare("failure", failure, str(file["meta/error"]))
    for number, ego in enumerate(egos):
        loop.step(number)
        loop.compare("driven ego", loop.seen.history.ego[-1], ego, STATE)
        # where the official planner failed, ours says that its answer is a fallback
        loop.compare("fallback", bool(loop.planner.degraded), number == counts[0])
        if number < counts[0]:
            module.compare(loop)
            loop.advance()


def verify_corrections(scenes: Scenes, file: Source) -> None:
    """Correct every route of a file as the learned planners do."""
    scenario = scenes[str(file["scene"])]
    road, size = scenario.map, np.array([state.PACIFICA.length, state.PACIFICA.width])
    TABLES["corrected_scene"].match(file, file.name, scenario=scenario)
    for number, case in enumerate(file.each("cases")):
        where = f"{file.name} {number} ({case['case']})"
        with file.report.attempt("corrected route", where):
            rear_axle = np.array(case["rear_axle"], np.float64).reshape(3)
            if case["case"] == "as_logged":
                TABLES["logged"].match(case, where, scenario=scenario)
            blocks = correction.known_blocks(road, case["route"], "of the file", "route correction")
            square = correction.RouteCorrector(road, blocks, SQUARE).at(rear_axle)
            corners = boxes_to_corners(state.center_poses(rear_axle), size)
            start = correction.find_start(road, blocks, rear_axle, corners)
            around = {"square": square, "footprint": correction.correct_route(road, blocks, start)}
            TABLES["corrections"].match(case, where, road=road, **around)
