"""Which column of a file is what, and in which unit: recognised by name, or named in a TOML file.

A column of ours has a name, the names that others give it, and a quantity, whose unit the name may
end in: `x_m`, `heading_deg`, `timestamp_ms`, `v [km/h]`. Formats that are known by their columns
(`_LAYOUTS`) say what a TOML file would have to.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from shiftsim.data.readers.codes import KINDS, SAME, normalise_category
from shiftsim.errors import ConfigError, ConversionError, nearest, one_of

# our name -> names in other files, the surest first
_NAMES = {
    "time": "time timestamp timestampus t timesteptime globaltime seconds simtime localtime",
    "frame": "frame frameid row framenumber frameindex timestep step",
    "id": "trackid track objectid objid agentid vehicleid tracktoken participantid actorid carid"
    " id",
    "kind": "kind category class agenttype objecttype objectclass vehicleclass vehicletype vclass"
    " type label",
    "x": "xcenter centerx x positionx posx translationx vehiclex localx utmx easting",
    "y": "ycenter centery y positiony posy translationy vehicley localy utmy northing",
    "heading": "heading yaw psi orientation hdg theta headingangle vehicleangle angle",
    "length": "length vehiclelength len dimensionx l vlength",
    "width": "width vehiclewidth dimensiony w vwidth",
    "vx": "vx xvelocity velocityx velx xspeed speedx",
    "vy": "vy yvelocity velocityy vely yspeed speedy",
    "speed": "speed v vel velocity vvel absvelocity vehiclespeed",
}
_OF = {"x": "position", "y": "position", "length": "size", "width": "size", "id": "", "kind": ""}
_OF |= dict.fromkeys(("vx", "vy", "speed"), "velocity")
QUANTITIES = {role: _OF.get(role, role) for role in _NAMES}  # our name -> quantity
# what a unit is multiplied by to become ours
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3},  # to us
    "position": {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "km": 1000.0},
    "heading": {"rad": 1.0, "deg": np.pi / 180.0, "compass": np.pi / 180.0},
    "velocity": {"mps": 1.0, "kmh": 1 / 3.6, "mph": 0.44704, "cmps": 0.01, "ftps": 0.3048},
}
UNITS["size"] = UNITS["position"]
_USUAL = {"time": "s", "position": "m", "heading": "rad", "size": "m", "velocity": "mps"}
_SPELLINGS = {"m/s": "mps", "km/h": "kmh", "kph": "kmh", "kmph": "kmh", "sec": "s", "msec": "ms"}
_SPELLINGS |= {"µs": "us", "feet": "ft", "degrees": "deg", "degree": "deg", "radians": "rad"}
_SPELLINGS |= {"cm/s": "cmps", "ft/s": "ftps", "meters": "m", "metres": "m"}
# columns that a format is known by, and what it says beside their names, as in the TOML file
_LAYOUTS: dict[str, tuple[str, dict[str, Any]]] = {
    "SUMO FCD": (
        "vehicleangle vehiclelane",
        {"reference": "front", "units": {"heading": "compass"}},
    ),
    "NGSIM": (
        "localx localy vlength",
        {
            "reference": "front",
            "units": {"position": "ft", "size": "ft", "time": "ms", "velocity": "ftps"},
            "kinds": {"1": "motorcycle", "2": "car", "3": "truck"},
        },
    ),
    "highD": (  # positions are the upper left corner of the box, y points down
        "precedingxvelocity width height",
        {
            "reference": "corner",
            "columns": {"y": "-y", "vy": "-yVelocity", "length": "width", "width": "height"},
        },
    ),
    "levelXdata": ("xcenter tracklifetime", {"units": {"heading": "deg"}}),
    "Songdo": (
        "orthox localx droneid",
        {
            "units": {"velocity": "kmh"},
            "kinds": {"0": "car", "1": "bus", "2": "truck", "3": "motorcycle"},
        },
    ),
}
_SETTINGS = ("columns", "units", "kinds", "hz", "shift_m", "reference", "header")


@dataclass(frozen=True)
class Column:
    """Where the values of one of our columns come from."""

    name: str  # column of the file; empty where all rows have the same value
    unit: str = ""
    sign: float = 1.0
    constant: str = ""  # the value of all rows

    def factor(self, role: str) -> float:
        """What values are multiplied by to become ours."""
        return self.sign * UNITS.get(QUANTITIES[role], {}).get(self.unit, 1.0)

    @property
    def words(self) -> str:
        """Its name with a minus where the sign is turned, or what all rows have."""
        return f"{'-' * (self.sign < 0)}{self.name}" if self.name else f"={self.constant}"


@dataclass(frozen=True)
class Columns:
    """What is known about the columns of a file."""

    found: Mapping[str, Column]  # by our name
    kinds: Mapping[str, str] = field(default_factory=dict)  # a known category by theirs
    hz: float | None = None  # frames per second, where time is given in frames
    shift: tuple[float, float] = (0.0, 0.0)  # added to x and y [m]
    reference: str = ""  # `front`, `rear`, `corner` or `center`, where it is known
    layout: str = ""  # the format, where it is known

    def unit_factors(self, role: str) -> dict[str, float]:
        """By unit, what the values of a column are multiplied by if they are in that one."""
        units, unit_now = UNITS[QUANTITIES[role]], self.found[role].unit
        return {unit: factor / units[unit_now] for unit, factor in units.items()}


def recognise(names: Sequence[str], overrides: Mapping[str, Any], where: str) -> Columns:
    """What each column is; the `overrides` of the TOML file go before what names tell.

    Raises ConfigError: the TOML file names something that does not exist. ConversionError: a column
    that is needed is missing, or there twice.
    """
    for key in overrides:
        one_of("setting", key, _SETTINGS)
    split = [(*_split_unit(name), name) for name in names]
    words = {word for word, *_ in split}
    layout = next((n for n, (marks, _) in _LAYOUTS.items() if words >= {*marks.split()}), "")
    given = _LAYOUTS[layout][1] if layout else {}
    usual = _USUAL | given.get("units", {})
    found = {}
    for role, known in _NAMES.items():
        quantity, surest = QUANTITIES[role], known.split()
        units = UNITS.get(quantity, {})
        fitting = [s for s in split if s[0] in surest and (not s[1] or s[1] in units)]
        if fitting:
            _, unit, name = min(fitting, key=lambda one: surest.index(one[0]))
            found[role] = Column(name, unit or usual.get(quantity, ""))
    named = {r: n for r, n in given.get("columns", {}).items() if n.lstrip("-") in names}
    found |= _named_columns(named | _table(overrides, "columns"), found, names, usual, where)
    found = {role: column for role, column in found.items() if column.name or column.constant}
    for quantity, unit in _table(overrides, "units").items():
        one_of("unit of", quantity, tuple(UNITS))
        unit = one_of(f"unit of {quantity}", _SPELLINGS.get(unit, unit), UNITS[quantity])
        for role in [r for r in found if QUANTITIES[r] == quantity]:
            found[role] = replace(found[role], unit=unit)
    _require_columns(found, names, where)
    for column in found.values():
        if names.count(column.name) > 1:
            what = f"{where} has {names.count(column.name)} columns {column.name!r}"
            raise ConversionError(what, "give each a name of its own")
    shift = overrides.get("shift_m", (0.0, 0.0))
    if not isinstance(shift, list | tuple) or [_within(v, 1e9) for v in shift] != [True, True]:
        raise ConfigError(f"shift_m is {shift!r}", "shift_m = [x, y] in metres")
    hz = overrides.get("hz", 1.0)
    if not _within(hz, 1e9) or hz <= 0.0:
        raise ConfigError(f"hz is {hz!r}", "hz = 25, or --hz 25")
    reference = str(overrides.get("reference", given.get("reference", "")))
    if reference:
        one_of("reference", reference, ("center", "front", "rear", "corner"))
    told = SAME | given.get("kinds", {}) | _table(overrides, "kinds")
    kinds = {normalise_category(k): normalise_category(v) for k, v in told.items()}
    for known_kind in kinds.values():
        one_of("kind", known_kind, KINDS)
    places = (float(shift[0]), float(shift[1]))
    return Columns(found, kinds, overrides.get("hz"), places, reference, layout)


def _split_unit(name: str) -> tuple[str, str]:
    """The name without case, spaces and unit, and the unit: `("timestamp", "ms")`."""
    words = re.fullmatch(r"(.+?)[\s_\-.]*[\[(_\-.\s]([a-zµ/]+)[\])]?", name.strip().lower())
    if words:
        unit = _SPELLINGS.get(words[2], words[2])
        if any(unit in units for units in UNITS.values()):
            return re.sub(r"[^a-z0-9]", "", words[1]), unit
    return re.sub(r"[^a-z0-9]", "", name.lower()), ""


def _named_columns(
    overrides: Mapping[str, str],
    found: Mapping[str, Column],
    names: Sequence[str],
    units: Mapping[str, str],
    where: str,
) -> dict[str, Column]:
    out = {}
    for role, text in overrides.items():
        one_of("column", role, _NAMES)
        usual = units.get(QUANTITIES[role], "")
        if text.startswith("="):
            out[role] = Column("", usual, constant=text[1:])
            continue
        sign, name = (-1.0, text[1:]) if text.startswith("-") and text not in names else (1.0, text)
        if name and name not in names:
            near = nearest(name, names)
            raise ConfigError(
                f"{where} has no column {name!r}",
                (f"did you mean {near!r}? " if near else "") + f"it has {', '.join(names)}",
            )
        same = found.get(role)
        unit = same.unit if same and same.name == name else _split_unit(name)[1] or usual
        out[role] = Column(name, unit, sign)
    return out


def _require_columns(found: Mapping[str, Column], names: Sequence[str], where: str) -> None:
    lat = [
        name for name in names if _split_unit(name)[0] in ("lat", "latitude", "lon", "longitude")
    ]
    missing = [role for role in ("id", "x", "y", "kind") if role not in found]
    what = [f"no column that is known as {', '.join(map(repr, missing))}"] if missing else []
    if "time" not in found and "frame" not in found:
        what.append("neither a time nor a frame")
        missing.append("time")
    if not what:
        return
    lines = [f"{role} = 'NAME'" for role in missing]
    hint = f"say which they are in a TOML file for --columns: [columns] {', '.join(lines)}"
    if "kind" in missing:
        hint += ", or kind = '=car' if all objects are cars"
    if lat and {"x", "y"} & set(missing):
        hint += (
            f"; {' and '.join(lat)} are degrees: project them to the metric frame of the map"
            " (pyproj), and give x and y in metres"
        )
    raise ConversionError(f"{where} has {' and '.join(what)}; it has {', '.join(names)}", hint)


def _within(value: object, most: float) -> bool:
    return isinstance(value, int | float) and abs(value) <= most


def _table(overrides: Mapping[str, Any], key: str) -> dict[str, str]:
    value = overrides.get(key, {})
    if not isinstance(value, dict) or not all(isinstance(v, str) for v in value.values()):
        raise ConfigError(f"{key} is {value!r}", f"[{key}] with lines NAME = 'TEXT'")
    return value
