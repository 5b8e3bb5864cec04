"""What the comparisons of the learned planners share: scenes, recorded loops, networks, manifests.

A closed-loop file holds the ego states of one rollout. Every step of it is made again on its own:
the planner sees the recorded ego history, and the tracks and lights of the scene's own log.
"""

import hashlib
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.data.nuplan.scenarios import find_maps
from shiftsim.errors import DataError, ShiftsimError
from shiftsim.planners.learned.deterministic import deterministic_state, keyed_normals, rule_of
from shiftsim.sim.dynamics.bicycle import command_and_step
from shiftsim.sim.dynamics.lqr import raise_for_status, track_and_step
from shiftsim.sim.observation import HISTORY_SAMPLES
from shiftsim.sim.planner import History, Observation, SceneInfo
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nuplan.reading import load_scenes, read_json
from shiftsim.verify.observing import scene_info
from shiftsim.verify.report import Report
from shiftsim.world import state
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command, Trajectory

FEATURE = 5e-5  # m, rad, …: features are stored as 32 bit floats
OUTPUT = {"base": 2e-5, "drive": 5e-4}  # outputs that the drive weights scale up, by variant
DERIVED_HEADING = 5e-4  # rad, arctangent of small vectors
POSITION, HEADING = 2e-3, 2e-4  # m, rad: plans of closed loops
STATE = 1e-8  # m, rad, m/s, …: logged and simulated ego states

ERRORS = (ShiftsimError, OSError, KeyError, ValueError, TypeError, IndexError, AttributeError)

# As in state.STATE_COLUMNS, in the words of the files.
FILE_COLUMNS = (*state.STATE_COLUMNS[:9], "angular_velocity", "angular_acceleration")


class Scenes:
    """The scenes with their logs and maps, read when first asked for."""

    def __init__(self, folder: Path) -> None:
        """`folder` holds `scenes.json`, `logs` and `maps`; it may be absent."""
        self.folder = folder
        self._entries: dict[str, dict[str, Any]] = {}
        self._scenarios: dict[str, Scenario] | None = None
        if (folder / "scenes.json").is_file():
            self._entries = {str(e["scene"]): e for e in read_json(folder / "scenes.json")}

    def __contains__(self, scene: str) -> bool:
        return scene in self._entries

    def __getitem__(self, scene: str) -> Scenario:
        if self._scenarios is None:
            self._scenarios = load_scenes(self.folder)
        return self._scenarios[scene]

    def sources(self, scene: str) -> tuple[Path, Path]:
        """Log and map file of a scene."""
        entry = self._entries[scene]
        return self.folder / entry["db"], find_maps(self.folder / "maps")[entry["map"]]


@dataclass(frozen=True, slots=True)
class Loop:
    """One closed-loop file. N recorded iterations.

    Attributes:
        file: Its arrays.
        scene: Name of the scene.
        scenario: The scene.
        variant: Variant of the weights.
        error: How the official planner failed after the last iteration; empty when it did not.
        time_us: (N,) time stamps of the iterations [us].
        ego: (N, 11) ego states, columns of `state.STATE_COLUMNS`.
        past: (22, 11) ego states up to iteration 0.
        past_us: (22,) their time stamps [us].
    """

    file: ArrayFile
    scene: str
    scenario: Scenario
    variant: str
    error: str
    time_us: IntArray
    ego: FloatArray
    past: FloatArray
    past_us: IntArray

    @property
    def info(self) -> SceneInfo:
        """What the planner is told before the first step."""
        return scene_info(self.scenario)

    def observation(self, iteration: int) -> Observation:
        """What the planner saw at a recorded iteration."""
        scenario = self.scenario
        ego = np.concatenate([self.past, self.ego[1 : iteration + 1]])[-HISTORY_SAMPLES:]
        rows = _history_rows(scenario, iteration)[-len(ego) :]
        history = History(scenario.time_us[rows], ego, scenario.tracks.rows(rows))
        lights = scenario.traffic_lights.rows(rows[-1:])
        return Observation(iteration, int(scenario.time_us[rows[-1]]), history, lights)

    def compare(
        self, quantity: str, where: str, ours: object, theirs: object, atol: float = 0.0
    ) -> None:
        """Compare one quantity of this loop."""
        at = f"{self.file.name} {where}".strip()
        self.file.report.compare(quantity, at, ours, theirs, atol=atol)


def _history_rows(scenario: Scenario, iteration: int) -> IntArray:
    row = int(scenario.iteration_rows[iteration])
    rows = np.arange(row - (HISTORY_SAMPLES - 1) * scenario.row_step, row + 1, scenario.row_step)
    return rows[rows >= 0]


def open_loop(path: Path, report: Report, scenes: Scenes, planner: str) -> Loop | None:
    """Read a closed-loop file and compare what it says about its scene.

    Args:
        path: The file.
        report: Receives the comparisons.
        scenes: The scenes.
        planner: Name of the planner, for the report.

    Returns:
        The loop; None, named in the report, where its scene is not at hand.
    """
    file = ArrayFile(path, report)
    scene = str(file["meta/scene"])
    if scene not in scenes:
        report.skip(f"{planner} {path.name}: scene {scene}, which is not at hand")
        return None
    loop = Loop(
        file=file,
        scene=scene,
        scenario=scenes[scene],
        variant=str(file["meta/variant"]),
        error=str(file["meta/error"]),
        time_us=file.take("ego/current_time_us", -1),
        ego=file.take("ego/current", -1, state.NUM_STATE),
        past=file.take("ego/initial_history", -1, state.NUM_STATE),
        past_us=file.take("ego/initial_history_time_us", -1),
    )
    if len(loop.ego) != len(loop.time_us) or len(loop.past) != len(loop.past_us):
        raise DataError("ego states and time stamps are not equally many")
    _compare_scene(loop, planner)
    _compare_sources(loop, scenes, planner)
    return loop


def _compare_scene(loop: Loop, planner: str) -> None:
    file, scenario = loop.file, loop.scenario
    said = {
        "token": scenario.token,
        "scenario_type": scenario.scenario_type,
        "map_name": scenario.map.name,
        "route_roadblock_ids": list(scenario.route),
        "state_columns": list(FILE_COLUMNS),
    }
    for name, ours in said.items():
        loop.compare(f"{planner} scene {name}", "", ours, file[f"meta/{name}"].tolist())
    rows = _history_rows(scenario, 0)
    times = scenario.iteration_times[: len(loop.time_us)]
    loop.compare(f"{planner} time [us]", "history", scenario.time_us[rows], loop.past_us)
    loop.compare(f"{planner} time [us]", "iterations", times, loop.time_us)
    loop.compare(f"{planner} logged ego", "history", scenario.ego[rows], loop.past, STATE)
    loop.compare(f"{planner} logged ego", "iteration 0", scenario.ego[rows[-1]], loop.ego[0], STATE)


def _compare_sources(loop: Loop, scenes: Scenes, planner: str) -> None:
    """The log and the map must be those which the file was made from."""
    file, sources = loop.file, scenes.sources(loop.scene)
    for name, path in zip(("meta/db_md5", "meta/map_md5"), sources, strict=True):
        if name in file.arrays:
            ours = hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest()
            loop.compare(f"{planner} source checksum", path.name, ours, str(file[name]))
    if "meta/source_crc32" in file.arrays:
        checksums = [zlib.crc32(path.read_bytes()) for path in sources]
        names = [path.relative_to(scenes.folder).as_posix() for path in sources]
        loop.compare(
            f"{planner} source checksum", "", checksums, file["meta/source_crc32"].tolist()
        )
        loop.compare(f"{planner} source name", "", names, file["meta/source_files"].tolist())


def compare_driven(loop: Loop, plans: list[Trajectory | Command], planner: str) -> None:
    """Compare the recorded ego states with what the recorded plans lead to.

    Args:
        loop: The loop.
        plans: The recorded plan or command of every iteration, with log time stamps.
        planner: Name of the planner, for the report.
    """
    command, after = np.empty(2), np.empty(state.NUM_STATE)
    for iteration, plan in enumerate(plans[: len(loop.ego) - 1]):
        now_us, next_us = int(loop.time_us[iteration]), int(loop.time_us[iteration + 1])
        ego = loop.ego[iteration]
        if isinstance(plan, Command):
            command[:] = plan.acceleration, plan.steering_rate
            command_and_step(now_us, next_us, ego, command, 0.0, 0.0, after)
        else:
            status = track_and_step(
                now_us, next_us, ego, plan.time_us, plan.states, 0.0, 0.0, after, command
            )
            raise_for_status(status, now_us, plan.time_us)
        where = f"after iteration {iteration}"
        loop.compare(f"{planner} driven ego", where, after, loop.ego[iteration + 1], STATE)


def make_network(planner: str, variant: str, args: Mapping[str, Any] | None = None) -> Any:
    """The network of a planner with deterministic weights, ready to be called.

    Args:
        planner: Folder in `shiftsim.planners.learned`, whose `network` has `build_network(args)`,
            `drive_overrides(state)` and, where the table of names does not fit, `RULES`.
        variant: `base` or `drive`.
        args: Hyper-parameters; None for the released ones.
    """
    import torch

    if variant not in OUTPUT:
        raise DataError(f"unknown variant {variant!r} of the weights")
    torch.set_num_threads(1)
    module = import_module(f"shiftsim.planners.learned.{planner.removesuffix('_planner')}.network")
    network = module.build_network(args)
    weights = deterministic_state(_constructed(network), getattr(module, "RULES", None))
    if variant == "drive":
        module.drive_overrides(weights)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    return network.eval()


def _constructed(network: Any) -> dict[str, Any]:
    return {name: value.detach().numpy() for name, value in network.state_dict().items()}


def verify_state_dict(
    path: Path, report: Report, planner: str, others: Mapping[str, Callable[[Any], object] | None]
) -> None:
    """Compare the manifest of a network: names, shapes, types, rules and weights.

    Args:
        path: The file `state_dict.json`.
        report: Receives the comparisons.
        planner: Its folder, as in `make_network`.
        others: Further top-level fields: what gives our value from theirs, or None for a text
            that need not be compared.
    """
    content = read_json(path)
    module = import_module(f"shiftsim.planners.learned.{planner.removesuffix('_planner')}.network")
    network = module.build_network(None)
    built = _constructed(network)
    rules = getattr(module, "RULES", None) or {}
    entries = content.get("keys") or content.get("entries") or []
    names = [entry.get("key", entry.get("name")) for entry in entries]
    report.compare(f"{planner} state names", path.name, sorted(built), sorted(map(str, names)))
    parameters = {name for name, _ in network.named_parameters()}
    for name, entry in zip(names, entries, strict=True):
        if name not in built:
            continue
        ours: dict[str, Any] = {
            "shape": list(built[name].shape),
            "dtype": str(built[name].dtype),
            "kind": "parameter" if name in parameters else "buffer",
            "ckpt_key": module.PREFIXES[0] + name if "ckpt_key" in entry else "",
            "rule": rules.get(name) or rule_of(name, built[name].ndim),
            "value": built[name].tolist(),
        }
        for field in sorted(set(entry) - {"key", "name"}):
            if field in ours:
                report.compare(f"{planner} state {field}", name, ours[field], entry[field])
            else:
                report.skip(f"{planner} {path.name}: field {field!r} of an entry")
    _compare_selfcheck(content, built, rules, report, planner)
    for field in sorted(set(content) - {"planner", "keys", "entries", "selfcheck"}):
        if field not in others:
            report.skip(f"{planner} {path.name}: field {field!r}")
        elif (make := others[field]) is None:
            report.note(f"{planner} {path.name}: {field} (description)")
        else:
            mine = make(content[field])
            report.compare(f"{planner} manifest", field, mine, content[field])


def _compare_selfcheck(
    content: Mapping[str, Any],
    built: Mapping[str, Any],
    rules: Mapping[str, str],
    report: Report,
    planner: str,
) -> None:
    given = dict(content.get("selfcheck", {}))
    if "first3_raw_z" in given:
        shape = tuple(given["shape"])
        first = keyed_normals(given["name"], shape).ravel()[:3]
        report.compare(f"{planner} selfcheck", given["name"], first, given["first3_raw_z"])
        report.compare(f"{planner} selfcheck", "shape", built[given["name"]].shape, shape)
        given = {
            k: v for k, v in given.items() if k not in ("name", "shape", "first3_raw_z", "note")
        }
    weights = deterministic_state(built, rules)
    for name, values in given.items():
        if name not in weights:
            report.skip(f"{planner} selfcheck: {name!r}")
        else:
            ours = weights[name].ravel()[: len(values)].astype(np.float64)
            report.compare(f"{planner} selfcheck", name, ours, values)
