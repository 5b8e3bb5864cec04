"""Edits of scenarios in a file, which scenarios of a store they are for, and the store they make.

The store keeps its bytes: an edited scenario is made when it is read. A run keeps the edits in its
manifest, so that its folder alone says how to make its scenarios again.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.data.store.reading import ScenarioStore
from shiftsim.edits.apply import NONREACTIVE, apply_edit
from shiftsim.edits.spec import PROFILES, Edit, digest_of, edited_id, make_edit
from shiftsim.errors import ConfigError, DataError, beginning, one_of
from shiftsim.files import read_toml
from shiftsim.kernels import FloatArray
from shiftsim.metrics.interplan import driven_lanes
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.sim.log import Snapshot
from shiftsim.sim.loop import Rollout
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks

FOLDER = "edits"  # below that of a store
_FORMAT = 1
_TOP = ("format", "name", "profile", "edit")


@dataclass(frozen=True, slots=True)
class EditSet:
    """The edits of a file."""

    name: str  # as in tables and folder names
    profile: str  # `shiftsim`, or `interplan` for edits that are codes
    edits: tuple[Edit, ...]  # in the order of the file

    def to_dict(self) -> dict[str, Any]:
        """What `make_edits` makes them of again, as JSON values."""
        tables = [{k: v for k, v in asdict(edit).items() if v or v == 0.0} for edit in self.edits]
        return {"name": self.name, "profile": self.profile, "edit": tables}

    @property
    def digest(self) -> str:
        """What the edited scenarios depend on, beside the recorded ones."""
        return digest_of([self.profile, sorted(edit.digest for edit in self.edits)])

    def expand(self, store: ScenarioStore, tokens: Iterable[str]) -> "dict[str, Edited]":
        """The edited scenarios, by id, of those of a store that are given; one at least."""
        chosen, out = set(tokens), dict[str, Edited]()
        columns = (store.summary()[name].to_pylist() for name in ("token", "type"))
        types = dict(zip(*columns, strict=True))
        for edit in self.edits:
            where = f"edits {self.name!r}, edit {edit.name!r}: the store"
            named = {beginning(where, "scenario", token, types) for token in edit.tokens}
            for base in sorted(named or types):
                if base not in chosen or (edit.types and types[base] not in edit.types):
                    continue
                token = edited_id(base, edit)
                if token in out or token in types:
                    what = f"edits {self.name!r}: two scenarios have the id {token!r}"
                    raise ConfigError(what, hint="give each edit of a scenario a name of its own")
                out[token] = Edited(base, edit)
        if not out:
            what = f"edits {self.name!r} are for no scenario of the {len(chosen)} chosen"
            raise ConfigError(what, hint="check tokens, split and types of its edits")
        return out

    def named(self, store: ScenarioStore) -> dict[str, str]:
        """The recorded scenarios that edits name, by the ids of what is made of them."""
        found = self.expand(store, store.tokens)
        return {token: one.base for token, one in found.items() if one.edit.tokens}

    def describe(self, store: ScenarioStore, tokens: Iterable[str]) -> dict[str, Any]:
        """For a manifest: base token and digest of the edited scenarios, by id."""
        return {
            token: {"base": found.base, "edit": found.edit.name, "digest": found.edit.digest}
            for token, found in self.expand(store, tokens).items()
        }

    def require_traffic(self, traffic: str) -> None:
        """Refuse traffic that cannot drive what an edit asks for, with a ConfigError."""
        for edit in self.edits:
            where = f"edits {self.name!r}, edit {edit.name!r}"
            if edit.start is not None and edit.start.traffic not in (NONREACTIVE, traffic):
                what = f"{where}: it begins in traffic {edit.start.traffic}, not {traffic}"
                raise ConfigError(what, hint=f"--traffic {edit.start.traffic}")
            moving = bool(edit.density) or any(
                spawn.kind == "vehicle" and spawn.behavior != "stopped" for spawn in edit.spawn
            )
            if traffic == "nonreactive" and moving:
                what = f"{where}: spawned vehicles that drive have no recording to be replayed"
                raise ConfigError(what, hint='--traffic reactive, or behavior = "stopped"')
            if traffic != "reactive" and edit.code:
                what = f"{where}: the code {edit.code!r} is for reactive traffic, not {traffic}"
                raise ConfigError(what, hint="--traffic reactive")
            slowed = bool(edit.stop) or any(
                not slow.kinds or "vehicle" in slow.kinds for slow in edit.slow
            )
            if traffic == "reactive" and (slowed or (edit.speed and edit.speed.tracks != 1.0)):
                raise ConfigError(
                    f"{where}: slower and stopping vehicles are for replayed traffic; reactive "
                    "vehicles drive by themselves",
                    hint="--traffic nonreactive, or slow only kinds that are replayed",
                )


@dataclass(frozen=True, slots=True)
class Edited:
    """An edited scenario."""

    base: str  # token of the recorded one
    edit: Edit


class EditedStore(ScenarioStore):
    """A store whose scenarios are those that edits make of its own."""

    def __init__(
        self, store: ScenarioStore, edits: EditSet, made: Mapping[str, Any] | None = None
    ) -> None:
        """The edited scenarios of an open store; those `made` in a run, as `describe` gave them."""
        vars(self).update(vars(store))
        self._parts = store, edits, made
        if made is None:
            self.edited = edits.expand(store, store.tokens)
        else:  # a bundle need not hold what other scenarios of the run are made of
            by_digest = {edit.digest: edit for edit in edits.edits}
            try:
                self.edited = {
                    token: Edited(str(found["base"]), by_digest[found["digest"]])
                    for token, found in made.items()
                }
            except (KeyError, TypeError) as error:
                what = f"edits {edits.name!r} of the manifest do not make its scenarios"
                raise DataError(what, hint="make the run again") from error
        self.tokens = tuple(self.edited)

    def __reduce__(self) -> Any:
        return EditedStore, self._parts

    def __contains__(self, token: object) -> bool:
        return token in self.edited

    def base(self, token: str) -> str:
        """Token of the recorded scenario that an edited one was made of."""
        if token not in self.edited:
            what = f"store {self.path.name!r} has no edited scenario {token!r}"
            raise DataError(what, hint="its `tokens` are the scenarios it has")
        return self.edited[token].base

    def read(self, token: str, *, validate: bool = True) -> Scenario:
        """One edited scenario; a ConfigError where it cannot be made, a DataError if missing."""
        recorded = super().read(self.base(token), validate=validate)
        return apply_edit(recorded, self.edited[token].edit, driven_lanes, _replay)


def _replay(scenario: Scenario, ego: FloatArray, traffic: str) -> Tracks:
    """Tracks of the iterations in which the ego drives states (i + 1, 11)."""
    rollout = Rollout(scenario, ConstantVelocity(), traffic=traffic)
    steps = len(ego) - 1
    blank = np.full((steps, 2), np.nan), np.zeros(steps), np.zeros(steps, np.bool_)
    rollout.resume(Snapshot(scenario.token, rollout.setting, ego, *blank))
    return rollout.log().tracks.rows(slice(0, len(ego)))


def edit_words(manifest: Mapping[str, Any], token: str) -> list[str]:
    """What was edited in a scenario of a run, in words; empty where nothing was."""
    table = manifest.get("edits", {})
    found = table.get("made", {}).get(token)
    if found is None:
        return []
    return [
        f"edit {edit.name} of {found['base']}: {line}"
        for edit in make_edits(table, "of the run").edits
        if edit.digest == found["digest"]
        for line in edit.words
    ]


def make_edits(table: Mapping[str, Any], name: str) -> EditSet:
    """Edits from the table of a file, or a ConfigError; `name` is theirs where they have none."""
    where = f"edits {name!r}"
    for key in {*table} - {"made"}:  # a manifest says what was made
        one_of(f"{where}: key", key, _TOP)
    if table.get("format", _FORMAT) != _FORMAT:
        raise ConfigError(f"{where}: format {table['format']!r} is not {_FORMAT}")
    profile = one_of(f"{where}: profile", table.get("profile", PROFILES[0]), PROFILES)
    listed = table.get("edit", [])
    if not isinstance(listed, list) or not listed:
        raise ConfigError(f"{where} holds no edits", hint="write one or more [[edit]] tables")
    edits = tuple(make_edit(item, f"{where}, edit {i}") for i, item in enumerate(listed, 1))
    codes = [edit for edit in edits if edit.code]
    if codes and profile != "interplan":
        what = f"{where}: the code of edit {codes[0].name!r} is interPlan's"
        raise ConfigError(what, hint='write profile = "interplan" at the top of the file')
    return EditSet(str(table.get("name", name)), profile, edits)


def read_edits(name: str, store: Path | None = None) -> EditSet:
    """Edits by the path of a file, or the name of one in a store's `edits/`; else a ConfigError."""
    path = Path(name)
    if path.suffix != ".toml":
        folder = (store or Path()) / FOLDER
        known = [found.stem for found in folder.glob("*.toml")] or ["none"]
        path = folder / f"{one_of('edits', name, known, ', or the path of a .toml file')}.toml"
    return make_edits(read_toml(path), path.stem)


def edits_text(table: Mapping[str, Any]) -> str:
    """The table of edits as TOML; what is null is left out, or 0 in a list."""
    top = {name: value for name, value in table.items() if name != "edit"}
    lines = [f"{name} = {_toml(value)}" for name, value in top.items()]
    for edit in table["edit"]:
        lines += ["", "[[edit]]"]
        lines += [f"{_key(name)} = {_toml(value)}" for name, value in edit.items()]
    return "\n".join(lines) + "\n"


def _key(name: str) -> str:
    return name if name.replace("_", "").isalnum() and name.isascii() else json.dumps(name)


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        pairs = (f"{_key(k)} = {_toml(v)}" for k, v in value.items() if v is not None)
        return f"{{{', '.join(pairs)}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_toml(0 if item is None else item) for item in value)}]"
    return json.dumps(value)
