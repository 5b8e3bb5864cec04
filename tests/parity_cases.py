"""Outputs of official code: what files hold, which of their values were used, and the scenes."""

import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from nuplan_logs import read_scenario

from shiftsim.data.nuplan.scenarios import find_maps, load_map
from shiftsim.errors import DataError
from shiftsim.sim.traffic.idm.scene import REPLAYED_KINDS
from shiftsim.verify.report import EXACT, TOLERANCE, Groups, Report, Source, Tolerances, read_table
from shiftsim.verify.rollouts import LOGGED, REACTIVE, SCORES, SIMULATED, object_columns
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks

MAPPING = (15.0, 0.0, 0.5)  # the reference scenes start at their tag
NETS = ("carl", "diffusion_planner", "plantf", "pluto", "route_correction")

# kinds of folders: patterns that must all match something (`a|b`: either), in this order
KINDS = {
    "nuplan": ["scenes.json", "expected/*.parquet"],
    "idm_ties": ["scenes.json", "official/ties.json"],
    "nuplan_format": ["devkit_readback.json"],
    "metric_worlds": ["metric_world_*.json"],
    "pdm": ["kernels/*.npz|kernels/*.json|routes.json|idm_calls.json|loop/steps.parquet"],
    "nets": ["|".join(NETS)],
    "route_correction": ["route_correction_*.json"],
    "network": ["state_dict.json|*.npz"],
    "dynamics": [
        "bicycle_*.npz|lqr_commands.npz|closed_loop*.npz|idm_*.npz|idm_world_*.json|comfort_*.npz"
        "|ego_*.npz|traj*.npz"
    ],
    "dsc3d_sample": ["expected_rows.parquet", "data"],
    "dsc3d_synthetic": ["expected_ego_20hz.parquet|*/expected_ego_20hz.parquet"],
    "opendrive": ["*.refline.parquet"],
    "open_loop": ["openloop_plans.parquet"],
    "navsim": ["frames.parquet", "v1_scores.parquet"],
    "scenario_edits": ["tokens.json", "build.json", "traffic.json"],
    "nuplan_real_logs": ["*.msgpack.xz", "tracker_steps.parquet", "comfort_signals.parquet"],
    "nuplan_experiment": [
        "|".join(
            f"{deep}{name}"
            for name in ("aggregator_metric", "simulation_log")
            for deep in ("", "*/", "*/*/")
        )
    ],
}
# folders without a kind: where they are compared instead
COMPARED_ELSEWHERE = {
    "open_data": "compared by tests/data/readers/open_data/test_samples.py",
    "paper": "published figures, compared by tests/benchmarks/test_tracks.py",
}


# folders that look like those of `nets`, but are compared by tests/parity/test_training.py
COMPARED_APART = {"training"}


@dataclass
class Cases(Report):
    """What one test has compared; `mode` limits the runs (NR, R or PT), None is all of them."""

    mode: str | None = None


def recognise(folder: Path) -> list[tuple[str, Path]]:
    """Kinds and places of the references in a folder, which may hold several."""
    for kind, patterns in KINDS.items():
        if all(any(any(folder.glob(p)) for p in either.split("|")) for either in patterns):
            if kind == "nets":
                parts = [folder / part for part in NETS if (folder / part).is_dir()]
                return [pair for part in parts for pair in recognise(part)]
            if kind == "network":
                manifest = folder / "state_dict.json"
                listed = json.loads(manifest.read_text()) if manifest.is_file() else {}
                called = listed.get("planner", folder.name)
                kind = next((name for name in NETS if called.startswith(name)), "")
                if not kind:
                    continue
            return [(kind, folder)]
    return []


@dataclass
class File(Source):
    """Named values of one file, or of a part of it: arrays, columns or fields."""

    prefix: str = ""  # of the names in the file, for a part with shorter ones
    _parts: "dict[str, list[File]]" = field(init=False, default_factory=dict)

    def __contains__(self, name: str) -> bool:
        return name.partition("[")[0] in self.values

    def __getitem__(self, name: str) -> Any:
        """A value, which is used from now on, or a part of one, as in `poses[:, :2]`."""
        name, _, index = name.rstrip("]").partition("[")
        if name not in self.values:
            raise DataError(f"{self.name}: {self.what} {name!r} is missing")
        self.used.add(self.prefix + name)
        value = self.values[name] if self.rows is None else self.values[name][self.rows]
        return value[_index(index)] if index else value

    def take(self, name: str, *shape: int) -> Any:
        """An array of a given shape, contiguous; -1 is any length."""
        array = np.ascontiguousarray(self[name])
        sizes = zip(shape, array.shape, strict=False)
        if array.ndim != len(shape) or any(wanted not in (-1, size) for wanted, size in sizes):
            found = f"{self.what} {name!r} has shape {array.shape}"
            raise DataError(f"{self.name}: {found}, not {shape}")
        return array

    def below(self, prefix: str) -> "File":
        """The values whose names begin with a prefix, by the rest of their names."""
        values = {n.removeprefix(prefix): v for n, v in self.values.items() if n.startswith(prefix)}
        return replace(self, values=values, prefix=self.prefix + prefix)

    def each(self, name: str) -> "list[File]":
        """The objects in a list of a `.json`, as parts of the file; or the one that is not listed.

        `finish` names the fields of these objects that nothing used.
        """
        if name not in self._parts:
            found, label = self[name], f"{self.name} {name}"
            used = set[str]()
            items = found if isinstance(found, list) else [found]
            self._parts[name] = [File(label, self.what, i, self.report, used) for i in items]
        return self._parts[name]

    def match(
        self,
        where: str,
        ours: Mapping[str, Any],
        atol: Tolerances = EXACT,
        *,
        quantity: str | None = None,
        angles: Collection[str] = (),
        unordered: Collection[str] = (),
    ) -> bool:
        """Compare values of ours with those of the same names; a missing one is a mismatch.

        `quantity` begins the names of the quantities, instead of the name of the file. `angles` are
        equal up to whole turns, `unordered` lists in any order. Returns whether all agree.
        """
        prefix, agree = self.name if quantity is None else quantity, True
        for name, value in ours.items():
            bound = atol if isinstance(atol, float) else atol.get(name, atol.get("", EXACT))
            label = f"{prefix} {name}".strip()
            if name not in self:
                agree = self.report.fail(label, where, f"no {self.what} {name!r}")
                continue
            sides = value, self[name]
            if name in unordered and isinstance(value, list):
                sides = sorted(map(repr, value)), sorted(map(repr, sides[1]))
            angle = name in angles
            agree &= self.report.compare(label, where, *sides, atol=bound, angle=angle)
        return agree

    def note(self, what: str, *names: str) -> None:
        """Name values that need not be compared."""
        self.used.update(self.prefix + name for name in names)
        self.report.note(f"{self.name} {', '.join(names)}{': ' if names else ''}{what}")

    def finish(self) -> None:
        """Name the values that nothing used; an empty table has none."""
        if self.what == "column" and self.values and not self.num_rows:
            return
        for name in self.values:
            if self.prefix + name not in self.used:
                self.report.skip(f"{self.name}: {self.what} {name!r}")
        for part in (part for parts in self._parts.values() for part in parts):
            part.finish()

    def cases(self) -> "Iterator[File]":
        """The cases of the file, each of which is finished behind its comparison.

        They are the entries of a `.json`; arrays whose names begin with the same number, `3_name`;
        the rows of all arrays.
        """
        if self.what == "field":
            cases = [File(f"{self.name}.json", "field", i, self.report) for i in self["rows"]]
        elif next(iter(self))[0].isdigit():
            numbers = sorted({int(name.split("_")[0]) for name in self})
            cases = [self.below(f"{number}_") for number in numbers]
        else:
            cases = self.array_rows()
        for case in cases:
            yield case
            if case.rows is None or case is cases[-1]:  # rows share what was used
                case.finish()

    def array_rows(self) -> "list[File]":
        """The rows of all arrays as parts, as many as those have that nothing has used yet.

        `<prefix>_ptr` says which rows of the arrays `<prefix>_…` belong together: from a number in
        it to the next one. A `DataError` if these are not all rows.
        """
        arrays, counted = dict(self.values), self.values.keys() - self.used
        for ends in [name for name in arrays if name.endswith("_ptr")]:
            begins = self.take(ends, -1)
            for name in arrays:
                if name.startswith(ends.removesuffix("ptr")) and name != ends:
                    size = len(arrays[name])
                    if begins[0] or begins[-1] != size or (np.diff(begins) < 0).any():
                        where = f"which are not those of {len(begins) - 1} cases"
                        raise DataError(f"{self.name}: array {name!r} has {size} rows, {where}")
                    arrays[name] = np.split(arrays[name], begins[1:-1])
            arrays[ends] = begins[:-1]
        # a shorter array fails where it is read; one that nothing reads is named as such
        count = max(len(arrays[name]) for name in counted)
        return [replace(self, values=arrays, rows=row) for row in range(count)]


def _index(text: str) -> Any:
    """The index that `-1`, `:, 0` or `..., :2` stands for."""
    keys: list[Any] = []
    for part in text.split(","):
        numbers = [int(n) if n.strip() else None for n in part.split(":") if part.strip() != "..."]
        keys.append(slice(*numbers) if len(numbers) > 1 else numbers[0] if numbers else ...)
    return tuple(keys) if len(keys) > 1 else keys[0]


def read_file(path: Path, report: Report, name: str = "") -> File:
    """The values of a file, named without the number that its name may end with.

    A `.json` that is a list has the one field `rows`.
    """
    name = name or re.sub(r"_\d+$", "", path.stem)
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            return File(name, "array", dict(archive), report)
    if path.suffix == ".parquet":
        return File(name, "column", read_table(path, report).values, report)
    content = json.loads(path.read_text("utf-8"))
    return File(name, "field", {"rows": content} if isinstance(content, list) else content, report)


class Fields(dict[str, Any]):
    """An object of a `.json`, and which of its fields were read; those in it are of this class."""

    def __init__(self, fields: Mapping[str, Any]) -> None:
        super().__init__({name: tracked(value) for name, value in fields.items()})
        self.used = set[str]()

    def __getitem__(self, name: str) -> Any:
        self.used.add(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """A field, if there is one."""
        return self[name] if name in self else default

    def items(self) -> Any:
        """All fields, which are used then."""
        self.used.update(self)
        return super().items()

    def finish(self, report: Report, what: str) -> None:
        """Name the fields that nothing used, of those that were read the ones in them."""
        for name, value in super().items():
            if name not in self.used:
                report.skip(f"{what}: field {name!r}")
            for inner in value if isinstance(value, list) else [value]:
                if isinstance(inner, Fields):
                    inner.finish(report, f"{what} {name}")


def tracked(value: Any) -> Any:
    """A value of a `.json` with `Fields` for objects."""
    if isinstance(value, Mapping):
        return Fields(value)
    return [tracked(item) for item in value] if isinstance(value, list) else value


class Rows(Groups):
    """The rows of a table by key; `atol` holds unless a comparison names another."""

    def __init__(self, table: File, key: list[str], atol: Tolerances = EXACT) -> None:
        super().__init__(table, key)
        self.atol = atol
        mode = table.report.mode if isinstance(table.report, Cases) else None
        self._mode = mode if "challenge" in key else None

    def of_mode(self) -> list[tuple[str, ...]]:
        """Keys of what the test is about: of the runs of its mode, or all."""
        return [key for key in self if self._mode is None or self._mode in key]

    def match(
        self, key: tuple[str, ...], ours: Any, atol: Tolerances | None = None, **options: Any
    ) -> bool:
        """`File.match` for the rows of a key."""
        return self[key].match(" ".join(key), ours, self.atol if atol is None else atol, **options)

    def match_keys(self, key: tuple[str, ...], ours: list[tuple[str, ...]]) -> None:
        """Compare which keys begin with `key`, by the rest of them."""
        theirs = [name[len(key) :] for name in self if name[: len(key)] == key]
        label, where = f"{self.table.name} present", " ".join(key)
        self.table.report.compare(label, where, sorted(ours), sorted(theirs))

    def finish(self) -> None:
        """Name rows of the mode that nothing asked for, and columns that nothing used."""
        for key in self.of_mode():
            if key not in self._asked:
                self.table.report.skip(f"{self.table.name}: rows of {' '.join(key)}")
        if self._asked & set(self):
            self.table.finish()


_RUN = ["scene", "challenge", "planner"]
TABLES: dict[str, tuple[list[str], Tolerances]] = {  # by name: columns of the key, tolerances
    "log_ego": (["scene", "kind"], LOGGED),
    "traffic_lights": (["scene"], EXACT),
    "scripted": (["scene", "planner"], EXACT),
    "map_objects": (["map", "layer"], EXACT),
    "map_lines": (["map", "id", "line"], {"x": 1e-6, "y": 1e-6, "heading": 1e-7}),
    "map_queries": (
        ["map"],
        {
            **dict.fromkeys(("drivable_area_distance", "nearest_lane_distance"), 1e-6),
            **dict.fromkeys(("lane_arc_length", "lane_pose_x", "lane_pose_y"), 1e-6),
            "lane_pose_heading": 1e-7,
            "lane_curvature": 1e-9,  # 1/m; follows from coordinates, not stored in the map
        },
    ),
    "ego": (_RUN, SIMULATED),
    "objects": (_RUN, REACTIVE),
    "trajectories": (_RUN, {"": TOLERANCE}),
    "route": (_RUN, EXACT),
    "collisions": (_RUN, EXACT),
    "scores": ([*_RUN, "thresholds"], SCORES),
    "metrics": ([*_RUN, "thresholds", "metric"], EXACT),
    # exact where the unit is boolean or count
    "statistics": ([*_RUN, "thresholds", "metric", "statistic"], {"value": TOLERANCE}),
    "time_series": ([*_RUN, "metric"], {"value": TOLERANCE}),
    "steps": (["scene", "challenge"], EXACT),
    "proposals": (["scene", "challenge"], EXACT),
    # README of the scripted recordings
    "expected_ego_20hz": (["window_start_s", "track_id"], {"yaw": 2e-3}),
}


def open_tables(folder: Path, report: Report, *names: str) -> dict[str, Rows]:
    """The `.parquet` files of these names; one that does not exist is named as not covered."""
    tables = {}
    for path in (folder / f"{name}.parquet" for name in names):
        if path.is_file():
            table = read_file(path, report, path.stem)
        else:
            report.skip(f"{path.name} is missing")
            table = File(path.stem, "column", {}, report)
        tables[path.stem] = Rows(table, *TABLES[path.stem])
    return tables


class Scenes:
    """The scenarios of a nuplan reference folder by scene name, each read when first asked for.

    Attributes:
        folder: Holds `scenes.json`, `logs` and `maps`, or closed loops with logs and maps beside.
        entries: What `scenes.json`, or the closed loops, say of their scenes, by scene name.
        mapping: Duration [s], offset [s] and subsample ratio that the scenarios are cut with.
    """

    def __init__(
        self, folder: Path, report: Report | None = None, mapping: tuple[float, ...] = MAPPING
    ) -> None:
        path, used = folder / "scenes.json", report or Report()
        listed = json.loads(path.read_text()) if path.is_file() else _scenes_of_loops(folder)
        entries = [File("scenes.json", "field", entry, used) for entry in listed]
        self.folder, self.entries = folder, {entry["scene"]: entry for entry in entries}
        self.mapping, self._read = mapping, dict[str, Scenario]()

    def __getitem__(self, scene: str) -> Scenario:
        if scene not in self._read:
            entry = self.entries[scene]
            path, road = self.folder / entry["db"], self.maps[entry["map"]]
            self._read[scene] = read_scenario(path, entry["token"], road, self.mapping)
        return self._read[scene]

    @cached_property
    def map_files(self) -> dict[str, Path]:
        """Files of all maps of the folder, by name."""
        beside = {path.parents[1].name: path for path in self.folder.glob("*/*/map.gpkg")}
        return beside or find_maps(self.folder / "maps")

    @cached_property
    def maps(self) -> dict[str, VectorMap]:
        """All maps of the folder by name."""
        return {name: load_map(self.map_files, name) for name in self.map_files}

    def by_token(self, token: str) -> Scenario | None:
        """The scenario of a token, None where there is none."""
        names = {entry["token"]: name for name, entry in self.entries.items()}
        return self[names[token]] if token in names else None


open_scenes = cache(Scenes)  # one for all tests


def _scenes_of_loops(folder: Path) -> list[dict[str, str]]:
    """As in `scenes.json`, for the closed loops in a folder with their logs beside them."""
    out = []
    for path in sorted(folder.glob("closed_loop_*.npz")):
        with np.load(path, allow_pickle=False) as archive:
            names = {"scene": "scene", "token": "token", "map": "map_name"}
            scene = {name: str(archive[f"meta/{key}"]) for name, key in names.items()}
        if (folder / f"{scene['scene']}.db").is_file():
            out.append({**scene, "db": f"{scene['scene']}.db"})
    return out


def ids(layer: Any, rows: Any) -> Any:
    """Ids of rows of a layer of a map, or of one row."""
    return [layer.ids[i] for i in rows] if np.ndim(rows) else layer.ids[rows]


def object_ids(things: Any) -> list[str | None]:
    """Ids of objects behind nuPlan's map interface; None stays None."""
    return [getattr(thing, "id", None) for thing in things]


def order_observed(kinds: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Indices of present tracks in nuPlan's order: agents, then replayed kinds as listed."""
    parts = [np.flatnonzero(valid & ~np.isin(kinds, REPLAYED_KINDS))]
    parts += [np.flatnonzero(valid & (kinds == kind)) for kind in REPLAYED_KINDS]
    return np.concatenate(parts)


def observed_columns(tracks: Tracks, challenge: str) -> dict[str, Any]:
    """Objects of every sample in the order of observation, without heights."""
    listed = (lambda kinds, row: np.flatnonzero(row)) if challenge != "R" else order_observed
    orders = [listed(tracks.kinds, row) for row in tracks.valid]
    iteration = np.repeat(np.arange(len(orders)), [len(order) for order in orders])
    return object_columns(tracks, iteration, np.concatenate(orders))


def name_unknown(folder: Path, report: Report, *patterns: str, where: str = "") -> None:
    """Name what no pattern matches, `README*` apart, as not covered."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith("README"):
            report.note(f"{path.name} (for reading)")
        elif not any(fnmatch(path.name, pattern) for pattern in patterns):
            report.skip(f"file {where}{path.name}")


# --- proof that a changed value is noticed


def changed(value: Any, index: int = -1, amount: float = 0.5) -> Any:
    """A value, or one of an array, that differs."""
    if isinstance(value, np.ndarray):
        out = value.astype(object) if value.dtype.kind in "US" else value.copy()
        flat = out.reshape(-1)
        flat[index] = changed(flat[index : index + 1 or None].tolist()[0], amount=amount)
        return out.astype(str) if value.dtype.kind in "US" else out
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return f"{value}9"
    if isinstance(value, list):
        return value[:-1] if value else ["9"]
    if isinstance(value, dict):
        return {**value, "9": 9}
    if isinstance(value, int):
        return value + 1
    return amount if value is None or not np.isfinite(value) else value + amount


def noticed(test: Callable[..., Any], *arguments: Any) -> bool:
    """Whether a test fails; the last argument are its cases."""
    try:
        test(*arguments)
    except Exception:
        return True
    return bool(arguments[-1].mismatches)


def change_array(path: Path, target: Path, name: str, index: int = -1, amount: float = 0.5) -> None:
    """Write an `.npz` in which one value of an array differs."""
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(target, **{**arrays, name: changed(arrays[name], index, amount)})


def change_column(path: Path, target: Path, name: str, row: int = 0, amount: float = 0.5) -> None:
    """Write a `.parquet` in which one cell differs."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    values = table[name].to_pylist()
    values[row] = changed(values[row], amount=amount)
    index = table.column_names.index(name)
    column = pa.array(values, table[name].type)
    pq.write_table(table.set_column(index, name, column), target)


def change_json(path: Path, target: Path, *keys: Any, amount: float = 0.5) -> None:
    """Write a `.json` in which the value at a path of keys differs."""
    content = json.loads(path.read_text())
    holder = content
    for key in keys[:-1]:
        holder = holder[key]
    holder[keys[-1]] = changed(holder[keys[-1]], amount=amount)
    target.write_text(json.dumps(content))
