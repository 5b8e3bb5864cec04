"""What may be edited of a recorded scenario, as plain data: one frozen dataclass per table.

The fields of a dataclass are the keys of its table in `edits.toml`, so that the file, the Python
calls and the checks cannot differ. `docs/edits.md` explains every key.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass
from functools import cached_property
from typing import Any

from shiftsim.errors import ConfigError, one_of
from shiftsim.files import make_table
from shiftsim.world.state import AgentKind, LightStatus

KINDS = tuple(kind.name.lower() for kind in AgentKind)
STATUSES = ("green", "yellow", "red", "unknown")
BEHAVIORS = ("idm", "stopped", "cautious")  # of a spawned vehicle
MANNERS = ("assertive", "cautious", "mixed", "default")  # of all agents, towards the ego
LEVELS = {"low": (10.0, 100.0), "medium": (10.0, 50.0), "high": (10.0, 33.0)}  # m between vehicles
COMMANDS = ("left", "right", "straight")
PROFILES = ("shiftsim", "interplan")
_CHOICES: dict[str, Sequence[str]] = {
    "kind": KINDS,
    "kinds": KINDS,
    "status": STATUSES,
    "behavior": BEHAVIORS,
    "agents": MANNERS,
    "level": tuple(LEVELS),
    "command": COMMANDS,
}
_FREE_SIGN = ("ahead_m", "left_m", "turn", "pose", "near", "goal", "also_at", "from_s", "ego")
_POSITIVE = ("length_m", "decel_mps2")
_WITHIN = 50.0  # m, from a pedestrian to the ego that sets it off
_MAX_NAME = 60  # characters
# of keys, in words
_SIDES = {"ahead_m": ("ahead", "behind"), "left_m": ("left", "right")}
_UNITS = {"_mps2": "m/s²", "_mps": "m/s", "_m": "m", "_s": "s"}
_UNNAMED = ("at", "kind", "kinds", "behavior")


@dataclass(frozen=True, slots=True)
class At:
    """A place beside the recorded path of the ego, counted from where it is at the start."""

    ahead_m: float = 0.0  # along the path from the ego's centre, negative behind [m]
    left_m: float = 0.0  # to the left of the path [m]
    turn: float = 0.0  # heading against that of the path [rad]


@dataclass(frozen=True, slots=True)
class Place:
    """Where something is: beside the recorded path (`at`) or in the frame of the map (`pose`)."""

    at: At | None = None
    pose: tuple[float, float, float] | None = None  # x [m], y [m], heading [rad]


@dataclass(frozen=True, slots=True)
class Remove:
    """Tracks that are taken away; all conditions must hold."""

    kinds: tuple[str, ...] = ()  # only these kinds; all where empty
    tokens: tuple[str, ...] = ()  # only these tracks; all where empty
    share: float = 1.0  # this share of them, drawn with the seed of the edit
    near: tuple[float, float, float] | None = None  # x [m], y [m], radius [m] at the start


@dataclass(frozen=True, slots=True)
class Move:
    """Tracks whose whole motion is shifted."""

    tokens: tuple[str, ...]  # which tracks
    ahead_m: float = 0.0  # along their own heading [m]
    left_m: float = 0.0  # to the left of it [m]


@dataclass(frozen=True, slots=True)
class Slow:
    """Tracks that go on more slowly on their recorded paths."""

    factor: float  # of the recorded speed, 0 … 1
    kinds: tuple[str, ...] = ()  # only these kinds; all that move where empty
    tokens: tuple[str, ...] = ()  # only these tracks
    from_s: float = 0.0  # from this time on [s]


@dataclass(frozen=True, slots=True)
class Stop:
    """Tracks that brake and stand from then on."""

    tokens: tuple[str, ...]  # which tracks
    from_s: float = 0.0  # when they begin to brake [s]
    decel_mps2: float = 3.0  # how hard [m/s^2]


@dataclass(frozen=True, slots=True)
class Density:
    """Vehicles in the lanes around the ego, and other places, at random distances."""

    level: str = ""  # low, medium or high; empty where `gap_m` is given
    gap_m: tuple[float, float] | None = None  # least and largest distance of two fronts [m]
    also_at: tuple[tuple[float, float], ...] = ()  # lanes of the roadblocks at these points, too
    reach_m: float = 50.0  # how far beyond the ego the lanes are filled [m]


@dataclass(frozen=True, slots=True)
class Spawn:
    """One more track."""

    kind: str = "vehicle"
    at: At | None = None
    pose: tuple[float, float, float] | None = None
    size_m: tuple[float, float] | None = None  # length, width [m]
    speed_mps: float = 0.0
    behavior: str = "idm"  # idm, cautious or stopped; what is no vehicle always stands


@dataclass(frozen=True, slots=True)
class Walk:
    """A pedestrian that crosses."""

    start: Place
    end: Place
    start_s: float | None = None  # when it sets off [s]; without, when the ego is near
    ego_within_m: float = _WITHIN  # distance of the ego's centre that sets it off [m]
    speed_mps: float = 1.4
    visible: bool = True  # whether it can be seen before it sets off


@dataclass(frozen=True, slots=True)
class Block:
    """A lane closed by a row of cones."""

    at: At | None = None
    pose: tuple[float, float, float] | None = None
    length_m: float = 10.0
    spacing_m: float = 2.0
    kind: str = "traffic_cone"
    width_m: float = 3.0  # of what is closed, by a slanted row over `taper_m` [m]
    taper_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Reroute:
    """Another route: a command at every junction, a goal, or the roadblocks themselves."""

    command: str = ""
    goal: tuple[float, float] | None = None  # x [m], y [m]
    route: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Light:
    """Traffic lights that show something else for a while."""

    status: str
    connectors: tuple[str, ...] = ()
    route: bool = False  # all connectors on the route
    from_s: float = 0.0
    to_s: float | None = None  # to the end where absent


@dataclass(frozen=True, slots=True)
class Speed:
    """Speeds of everything."""

    tracks: float = 1.0  # factor on the motion in time of recorded vehicles
    limit: float = 1.0  # factor on the speed limits of the map
    ego_mps: float | None = None  # the ego's at the start


@dataclass(frozen=True, slots=True)
class Start:
    """What a rollout drove: the scenario begins where that had come."""

    ego: tuple[tuple[float, ...], ...]  # (i + 1, 11) states of the iterations until then
    traffic: str = "nonreactive"  # beside which traffic


@dataclass(frozen=True)
class Edit:
    """Everything that makes one new scenario of each recorded one that it is for."""

    name: str  # ends the id of the new scenario
    tokens: tuple[str, ...] = ()  # recorded scenarios, or unambiguous beginnings
    split: str = ""  # those of a split
    types: tuple[str, ...] = ()  # those of these types
    type: str = ""  # type of the new scenario; kept where empty
    window_s: float | None = None  # its duration [s]; kept where absent
    seed: int | None = None  # of what is drawn; made from the id where absent
    agents: str = ""  # how reactive agents treat the ego; as nuPlan's do where empty
    end_at_goal: bool | None = None  # whether a rollout ends there; true with a reroute
    code: str = ""  # of interPlan, instead of all tables; needs `profile = "interplan"`
    details: Mapping[str, Any] = field(default_factory=dict)  # interPlan's, of the token
    remove: tuple[Remove, ...] = ()
    move: tuple[Move, ...] = ()
    reroute: Reroute | None = None
    density: Density | None = None
    spawn: tuple[Spawn, ...] = ()
    block_lane: tuple[Block, ...] = ()
    walk: tuple[Walk, ...] = ()
    slow: tuple[Slow, ...] = ()
    stop: tuple[Stop, ...] = ()
    light: tuple[Light, ...] = ()
    speed: Speed | None = None
    start: Start | None = None

    @cached_property
    def digest(self) -> str:
        """What the new scenario depends on, beside the recorded one."""
        content = asdict(self)
        if self.start is None:  # as before there was such a table
            del content["start"]
        return digest_of(content)

    @cached_property
    def words(self) -> tuple[str, ...]:
        """What is edited, one line each."""
        if self.code:
            return (f"interPlan code {self.code}",)
        out = []
        if self.start is not None:
            out.append(f"start: {0.1 * (len(self.start.ego) - 1):.1f} s into a rollout")
        for item in fields(self)[11:-1]:
            value = getattr(self, item.name)
            for table in value if isinstance(value, tuple) else filter(None, [value]):
                out.append(f"{item.name.replace('_', ' ')}: {_words(table)}")
        if self.window_s is not None:
            out.append(f"window: {self.window_s:g} s")
        return tuple(out)


def edited_id(token: str, edit: Edit) -> str:
    """Id of the scenario that an edit makes of a recorded one; never parsed back."""
    return f"{token}-{edit.name}"


def digest_of(content: Any) -> str:
    """Digest of JSON values; the order of keys does not matter."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _words(table: Any) -> str:
    """What a table says that is not the default, as "30 m ahead, 1.2 m right, stopped"."""
    parts = []
    for item in fields(table):
        value = getattr(table, item.name)
        if value != (None if item.default is MISSING else item.default):
            parts.append(_phrase(item.name, value))
    return ", ".join(parts) or "everything"


def _phrase(name: str, value: Any) -> str:
    if name in _SIDES:
        return f"{abs(value):g} m {_SIDES[name][value < 0.0]}"
    words = _words(value) if is_dataclass(value) else _plain(value)
    if name in _UNNAMED:
        return words.replace("_", " ")
    ending = next(filter(name.endswith, _UNITS), "")
    unit = f" {_UNITS[ending]}" if ending else ""
    return f"{name.removesuffix(ending).replace('_', ' ')} {words}{unit}"


def _plain(value: Any) -> str:
    if isinstance(value, (tuple, list)):
        return " ".join(map(_plain, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def make_edit(table: Mapping[str, Any], where: str) -> Edit:
    """An edit from its table, or a ConfigError, whose message begins with `where`."""
    edit = make_table(Edit, _renamed(table), where, _check)
    where = f"{where} {edit.name!r}"
    good = edit.name and len(edit.name) <= _MAX_NAME and edit.name.replace("_", "").isalnum()
    if not good or not edit.name.isascii():
        what = f"{where}: name is not of up to {_MAX_NAME} letters, digits and underscores"
        raise ConfigError(what, 'for example name = "closed_lane"')
    for what, hint in _contradictions(edit):
        raise ConfigError(f"{where}{what}", hint)
    return edit


def _contradictions(edit: Edit) -> Iterator[tuple[str, str]]:
    """What is wrong with keys that are right by themselves, and what to do."""
    edits = [item.name for item in fields(edit)[11:] if getattr(edit, item.name)]
    if edit.code and edits:
        yield f": code and {edits[0]} exclude each other", "write an edit for each"
    if not edit.code and not edits and edit.window_s is None:
        yield ": nothing is edited", "add a table, such as spawn"
    places: list[tuple[str, Place | Spawn | Block]] = [
        *(("spawn", spawn) for spawn in edit.spawn),
        *(("block_lane", block) for block in edit.block_lane),
        *(("walk from", walk.start) for walk in edit.walk),
        *(("walk to", walk.end) for walk in edit.walk),
    ]
    for name, place in places:
        if (place.at is None) == (place.pose is None):
            what = f", {name}: give either pose or a place by the recorded path"
            yield what, "pose = [x, y, heading], or at = {ahead_m = 30, left_m = -2}"
    if density := edit.density:
        if bool(density.level) == bool(density.gap_m):
            yield ", density: give either level or gap_m", ""
        if density.gap_m and not 1 <= density.gap_m[0] < density.gap_m[1]:
            yield ", density: gap_m is not [least, largest], from 1 m on", ""
    if (new := edit.reroute) and sum(map(bool, (new.command, new.goal, new.route))) != 1:
        yield ", reroute: give one of command, goal and route", ""
    if edit.split and edit.tokens:
        yield ": give either tokens or a split", ""
    if any(bool(light.connectors) == light.route for light in edit.light):
        yield ", light: give either connectors or route = true", ""
    if any(light.to_s is not None and light.to_s <= light.from_s for light in edit.light):
        yield ", light: to_s is not after from_s", "leave to_s out for the end of the scenario"
    if any(walk.start_s is not None and walk.ego_within_m != _WITHIN for walk in edit.walk):
        yield ", walk: give either start_s or ego_within_m", ""
    if any(one.speed_mps and _stands(one) for one in edit.spawn):
        what = ", spawn: speed_mps is for a vehicle that is not stopped"
        yield what, 'leave speed_mps out, or give behavior = "idm"'
    if any(not slow.tokens and not slow.kinds for slow in edit.slow):
        yield ", slow: say which tracks, by tokens or kinds", ""
    if any(not stop.tokens for stop in edit.stop):
        yield ", stop: say which tracks, by tokens or kinds", ""
    if any(not slow.factor <= 1.0 for slow in edit.slow):
        yield ", slow: factor is above 1", "a recording cannot be sped up"
    if any(not remove.share <= 1.0 for remove in edit.remove):
        yield ", remove: share is above 1", ""


def _stands(spawn: Spawn) -> bool:
    return spawn.behavior == "stopped" or spawn.kind != "vehicle"


def _renamed(table: Mapping[str, Any]) -> dict[str, Any]:
    """`from` and `to` are no names in Python; places of a walk may be written without `at`."""
    out = dict(table)
    listed = out.get("walk")
    if isinstance(listed, Mapping):
        listed = [listed]
    if isinstance(listed, (list, tuple)):
        out["walk"] = [_walk(walk) if isinstance(walk, Mapping) else walk for walk in listed]
    return out


def _walk(table: Mapping[str, Any]) -> dict[str, Any]:
    names = {"from": "start", "to": "end"}
    out = {names.get(name, name): value for name, value in table.items()}
    for name in ("start", "end"):
        place = out.get(name)
        if isinstance(place, Mapping) and not {"at", "pose"} & set(place):
            out[name] = {"at": place}
    return out


def _check(name: str, value: Any, where: str) -> None:
    """Refuse a number that is none or of the wrong sign, and a word that is no choice."""
    if isinstance(value, (int, float)):
        is_positive, is_free = name in _POSITIVE, name in _FREE_SIGN
        if not math.isfinite(value) or (value < 0.0 and not is_free) or (is_positive and not value):
            signed = "finite" if is_free else "above 0" if is_positive else "0 or more"
            allowed = "from 0 to 1" if name in ("factor", "share") else signed
            raise ConfigError(f"{where}: {name} {value!r} must be {allowed}")
    elif value and name in _CHOICES:
        one_of(f"{where}: {name}", value, _CHOICES[name])


LIGHT_CODES = {name: LightStatus[name.upper()] for name in STATUSES}
KIND_CODES = {name: AgentKind[name.upper()] for name in KINDS}
