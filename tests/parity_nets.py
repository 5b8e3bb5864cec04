"""Learned planners with deterministic weights against the official code: what is the same for all.

Weights are deterministic: anybody can make them again from the names of the tensors. In a closed
loop a rollout of ours is moved by what is recorded; the planner sees it, and what it says is
compared.
"""

import hashlib
import json
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from parity_cases import Cases, File, Scenes, read_file

from shiftsim.planners.learned.checkpoint import network_module
from shiftsim.planners.learned.deterministic import deterministic_state, keyed_normals, rule_of
from shiftsim.planners.learned.features import PLAN_POSES, STEP
from shiftsim.sim.loop import Rollout
from shiftsim.sim.planner import past_rows
from shiftsim.world import state

STATE = 1e-8  # m, rad, m/s, …: logged and simulated ego states
PLAN = [2e-3, 2e-3, 2e-4, 2e-3, 2e-3, 2e-3, 2e-3]  # m, m, rad, m/s, …: planned states
# As in state.STATE_COLUMNS, in the words of the files.
FILE_COLUMNS = (*state.STATE_COLUMNS[:9], "angular_velocity", "angular_acceleration")
# how one official planner fails where it has no reference line; ours falls back there
FAILURE = "ValueError: zero-size array to reduction operation maximum which has no identity"
ANY = "*"  # ends a text of a manifest that may go on in any way
PREFIXES = {"plantf": "model.", "pluto": "model.", "carl": ""}  # of names in published checkpoints
CODES = ("category", "kind", "on_route", "light", "object_category")  # integers, stored as floats
# which array of the files is which field of the inputs of a network
INPUTS: dict[str, str | list[str]] = {
    **{name: f"agent.{name}" for name in ("position", "heading", "velocity", "shape", "category")},
    "valid": "agent.valid_mask",
    "current_state": "current_state[:, :6]",  # the yaw rate behind them is not read
    "points": "map.point_position[:, :, 0]",  # of the centre line
    "vectors": "map.point_vector[:, :, 0]",
    "orientations": "map.point_orientation[:, :, 0]",
    "centers": "map.polygon_center",
    "kind": "map.polygon_type",
    "on_route": "map.polygon_on_route",
    "light": "map.polygon_tl_status",
    "has_limit": "map.polygon_has_speed_limit",
    "limit": "map.polygon_speed_limit",
    "point_valid": "map.valid_mask",
}
PLUTO_INPUTS: dict[str, str | list[str]] = {
    **INPUTS,
    "points": "map.point_position",  # of the boundaries, too
    "object_pose": ["static_objects.position", "static_objects.heading"],
    "object_shape": "static_objects.shape",
    "object_category": "static_objects.category",
    "object_valid": "static_objects.valid_mask",
    "line_points": "reference_line.position",
    "line_vectors": "reference_line.vector",
    "line_orientations": "reference_line.orientation",
    "line_valid": "reference_line.valid_mask",
}
_PERCEPTION = {
    "dim": 128,
    "state_channel": 6,
    "polygon_channel": 6,
    "history_channel": 9,
    "history_steps": 21,
    "future_steps": PLAN_POSES,
    "encoder_depth": 4,
    "drop_path": 0.2,
    "state_dropout": 0.75,
    "use_ego_history": False,
    "state_attn_encoder": True,
}
HYPER_PARAMETERS = {
    "plantf": {**_PERCEPTION, "num_heads": 8, "num_modes": 6},
    "pluto": {
        **_PERCEPTION,
        "decoder_depth": 4,
        "dropout": 0.1,
        "num_heads": 4,
        "num_modes": 12,
        "use_hidden_proj": True,
        "cat_x": True,
        "ref_free_traj": True,
    },
    "carl": {
        "image_encoder": "roach_ln2",
        "in_channels": 9,
        "image": [256, 256],
        "use_layer_norm": True,
        "use_layer_norm_policy_head": True,
        "features_dim": 256,
        "states_neurons": [256, 256],
        "policy_head_arch": [256, 256],
        "value_head_arch": [256, 256],
        "obs_num_measurements": 10,
        "num_value_measurements": 4,
        "distribution": "beta",
        "beta_min_a_b_value": 1.0,
        "action_dim": 2,
        "action_low": -1.0,
        "action_high": 1.0,
        "use_lstm": False,
        "layer_norm_eps": 1e-5,
    },
}


@cache
def make_planner(kind: Any, variant: str) -> Any:
    """A planner with a variant of the deterministic weights; its network serves all files."""
    return kind(f"deterministic:{variant}")


def drive_bound(variant: str, base: float = 2e-5, drive: float = 5e-4) -> float:
    """A tolerance; the drive weights scale up what the network says."""
    return {"base": base, "drive": drive}[variant]


def match_meta(file: File, planner: str, **ours: object) -> None:
    """Compare the JSON text in the array `meta`."""
    file.report.compare(f"{planner} meta", file.name, ours, json.loads(str(file["meta"])))


def match_case(file: File, planner: str) -> list[str]:
    """`match_meta` of a forward pass: its name, and the variants of the weights that it has."""
    variants = sorted({name.split(".")[1] for name in file if name.count(".") > 1})
    match_meta(file, planner, case=file.name.removeprefix("forward_"), variants=variants)
    return variants


def _filled(ours: Any, theirs: Any) -> Any:
    """Ours, with `theirs` for an open text that it begins like."""
    if isinstance(ours, Mapping):
        known = theirs if isinstance(theirs, Mapping) else {}
        return {name: _filled(value, known.get(name)) for name, value in ours.items()}
    is_open = isinstance(ours, str) and ours.endswith(ANY) and isinstance(theirs, str)
    return theirs if is_open and theirs.startswith(ours[:-1]) else ours


def compare_manifest(
    path: Path, cases: Cases, planner: Any, manifest: Any, weights: dict[str, str]
) -> None:
    """Compare `state_dict.json`: names, shapes, types, rules and weights, and the other fields.

    `manifest` makes these fields from the module of the network; `weights` has by field which
    weights it counts, as a pattern of their names: the trainable ones if it says so.
    """
    file, called = read_file(path, cases, path.stem), planner.name
    module = network_module(called)
    network, rules = module.build_network(), getattr(module, "RULES", {})
    built = {name: value.detach().numpy() for name, value in network.state_dict().items()}
    trained = {name for name, _ in network.named_parameters()}
    entries = file.each("keys" if "keys" in file else "entries")
    listed = [str(entry["key" if "key" in entry else "name"]) for entry in entries]
    cases.compare(f"{called} state names", file.name, sorted(built), sorted(listed))
    for name, entry in zip(listed, entries, strict=True):
        if name in built:
            tensor = built[name]
            ours = {
                "shape": tensor.shape,
                "dtype": str(tensor.dtype),
                "kind": "parameter" if name in trained else "buffer",
                "ckpt_key": f"{PREFIXES.get(called, '')}{name}",
                "rule": rules.get(name) or rule_of(name, tensor.ndim),
                "value": tensor,
            }
            ours = {field: value for field, value in ours.items() if field in entry}
            entry.match(name, ours, quantity=f"{called} state")
    (check,) = file.each("selfcheck")
    if "first3_raw_z" in check:
        where, shape = check["name"], built[check["name"]].shape
        firsts = {"shape": shape, "first3_raw_z": keyed_normals(where, shape).ravel()[:3]}
        check.used.add("note")
    else:
        where, made = "selfcheck", deterministic_state(built, rules)
        firsts = {name: made[name].ravel()[:3].astype(float) for name in check}
    check.match(where, firsts, quantity=f"{called} selfcheck")
    ours = {name: _filled(value, file.values.get(name)) for name, value in manifest(module).items()}
    for field, pattern in weights.items():
        counted = trained if "trainable" in field else built
        ours[field] = sum(built[name].size for name in counted if re.match(pattern, name))
    file.match(file.name, ours, quantity=f"{called} manifest")
    file.used.add("planner")
    file.finish()


def vector_manifest(module: Any, planner: Any, **features: object) -> dict[str, Any]:
    """The fields of the manifests of PlanTF and PLUTO."""
    settings = import_module(planner.__module__)
    heads = {
        layer: {"C": len(head.gain), **{name: list(v) for name, v in asdict(head).items()}}
        for layer, head in getattr(module, "DRIVE_HEADS", {}).items()
    }
    return {
        "hyper_parameters": HYPER_PARAMETERS[planner.name],
        "drive_overrides": {
            "meaning": ANY,
            "heads": heads,
            "scale": getattr(module, "DRIVE_SCALES", {}),
        },
        "checkpoint": {
            "weights_under": "state_dict",
            "prefix": PREFIXES[planner.name],
            **dict.fromkeys(("container", "loading", "other_entries"), ANY),
        },
        "feature_builder": {
            "radius": settings.RADIUS,
            "max_agents": settings.MAX_AGENTS,
            "history_horizon": 2.0,
            "future_horizon": PLAN_POSES * STEP,
            "sample_interval": STEP,
            **features,
        },
    }


class Loop:
    """One closed-loop file, and its iteration that is compared just now.

    Attributes:
        stored: What is stored of this iteration alone.
        row: This iteration of the arrays of the whole loop.
        seen: What the planner saw; `features`, `output` and `answer` are what it made of that.
    """

    def __init__(self, path: Path, planner: Any, scenes: Scenes, cases: Cases) -> None:
        self.file = file = read_file(path, cases, path.stem)
        self.scenario = scenes[str(file["meta/scene"])]
        self.road, self.tracks, self.where = self.scenario.map, self.scenario.tracks, file.name
        self.variant = str(file["meta/variant"])  # of its weights
        self.planner = make_planner(planner, self.variant)  # after this iteration
        self.name, self.rollout = planner.name, Rollout(self.scenario, self.planner)

    def step(self, number: int) -> None:
        """Look at an iteration, which must be that of the rollout, and make its plan again."""
        self.where = f"{self.file.name} iteration {number}"
        self.stored = self.file.below(f"it{number:02d}/")
        self.row = self.file.below("out/").at(number)
        self.seen = self.rollout.observe()
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
        cases = self.file.report
        cases.compare(f"{self.name} {quantity}", self.where, ours, theirs, atol=atol)

    def match(
        self, theirs: File, ours: Mapping[str, Any], atol: Any = 0.0, called: str = "", **how: Any
    ) -> bool:
        """Compare values of this iteration."""
        quantity = f"{self.name} {called}".strip()
        return theirs.match(self.where, ours, atol, quantity=quantity, **how)


def loop_steps(
    path: Path, planner: Any, scenes: Scenes, cases: Cases, plans: tuple[str, ...]
) -> Iterator[Loop]:
    """Make every step of a closed loop again; the caller compares each where it ends.

    `plans` are the arrays that have a row for every plan.
    """
    with np.load(path, allow_pickle=False) as archive:
        scene = str(archive["meta/scene"])
    if scene not in scenes.entries:
        cases.skip(f"{path.name}: scene {scene}, which is not at hand")
        return
    loop = Loop(path, planner, scenes, cases)
    file = loop.file
    egos, out = file["ego/current"], file.below("out/")
    counts = [len(out[name]) for name in plans]
    loop.compare("plans", counts, counts[:1] * len(counts))
    compare_scene(loop, scenes)
    failure = f"iteration {counts[0]}: {FAILURE}" if counts[0] < len(egos) else ""
    loop.compare("failure", failure, str(file["meta/error"]))
    for number, ego in enumerate(egos):
        loop.step(number)
        loop.compare("driven ego", loop.seen.history.ego[-1], ego, STATE)
        # where the official planner failed, ours says that its answer is a fallback
        loop.compare("fallback", bool(loop.planner.degraded), number == counts[0])
        if number < counts[0]:
            yield loop
            loop.advance()
    file.finish()


def compare_scene(loop: Loop, scenes: Scenes) -> None:
    """Where the loop is, which log and map it was made from, and how its ego got there."""
    file, scenario = loop.file, loop.scenario
    entry, meta = scenes.entries[str(file["meta/scene"])], file.below("meta/")
    paths = scenes.folder / entry["db"], scenes.map_files[entry["map"]]
    content = [path.read_bytes() for path in paths]
    md5 = [hashlib.md5(data, usedforsecurity=False).hexdigest() for data in content]
    facts = {
        "token": scenario.token,
        "scenario_type": scenario.scenario_type,
        "map_name": loop.road.name,
        "route_roadblock_ids": scenario.route,
        "state_columns": FILE_COLUMNS,
    }
    sources = {  # a loop has some of these
        **{"db_md5": md5[0], "map_md5": md5[1]},
        "source_files": [path.relative_to(scenes.folder).as_posix() for path in paths],
        "source_crc32": [zlib.crc32(data) for data in content],
    }
    facts |= {name: value for name, value in sources.items() if name in meta}
    loop.match(meta, facts, called="scene")
    past = past_rows(scenario, 0)
    ego = {
        "initial_history": scenario.ego[past],
        "initial_history_time_us": scenario.time_us[past],
        "current_time_us": scenario.iteration_times[: len(file["ego/current"])],
    }
    loop.match(file.below("ego/"), ego, STATE)


def only(file: File, values: Mapping[str, Any]) -> dict[str, Any]:
    """Those of our values that a file has."""
    return {name: value for name, value in values.items() if name in file}
