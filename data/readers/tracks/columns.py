"""Which column of a file is what, and in which unit: recognised by name, or named in a TOML file.

A column of ours has a name (`ROLES`), the names that others give it, and a quantity, whose unit the
name may end in: `x_m`, `heading_deg`, `timestamp_ms`, `v [km/h]`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from shiftsim.data.readers.codes import KINDS, normalise_category
from shiftsim.errors import ConfigError, ConversionError, nearest, one_of

# our name -> quantity, and names in other files, the surest first
_ROLES = {
    "time": ("time", "time timestamp timestampus t timesteptime globaltime seconds simtime"),
    "frame": ("frame", "frame frameid row framenumber frameindex timestep step"),
    "id": (
        "",
        "trackid track objectid objid agentid vehicleid tracktoken participantid actorid carid id",
    ),
    "kind": (
        "",
        "kind category class agenttype objecttype objectclass vehicleclass vehicletype type label",
    ),
    "x": ("position", "xcenter centerx x positionx posx translationx vehiclex utmx easting"),
    "y": ("position", "ycenter centery y positiony posy translationy vehicley utmy northing"),
    "heading": ("heading", "heading yaw psi orientation hdg theta headingangle vehicleangle angle"),
    "length": ("size", "length vehiclelength len dimensionx l vlength"),
    "width": ("size", "width vehiclewidth dimensiony w vwidth"),
    "vx": ("velocity", "vx xvelocity velocityx velx xspeed speedx"),
    "vy": ("velocity", "vy yvelocity velocityy vely yspeed speedy"),
    "speed": ("velocity", "speed v vel velocity vvel absvelocity vehiclespeed"),
}
ROLES = tuple(_ROLES)
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


@dataclass(frozen=True)
class Column:
    """Where the values of one of our columns come from."""

    name: str  # column of the file; empty where all rows have the same value
    unit: str = ""
    sign: float = 1.0
    constant: str = ""  # the value of all rows

    def factor(self, role: str) -> float:
        """What values are multiplied by to become ours."""
        return self.sign * UNITS.get(_ROLES[role][0], {}).get(self.unit, 1.0)


@dataclass(frozen=True)
class Columns:
    """What is known about the columns of a file."""

    found: Mapping[str, Column]  # by our name
    kinds: Mapping[str, str] = field(default_factory=dict)  # a known category by theirs
    hz: float | None = None  # frames per second, where time is given in frames
    shift: tuple[float, float] = (0.0, 0.0)  # added to x and y [m]
    reference: str = ""  # `front`, `rear` or `center`, where the user gives it

    def unit_factors(self, role: str) -> dict[str, float]:
        """By unit, what the values of a column are multiplied by if they are in that one."""
        units, unit_now = UNITS[_ROLES[role][0]], self.found[role].unit
        return {unit: factor / units[unit_now] for unit, factor in units.items()}


def recognise(names: Sequence[str], overrides: Mapping[str, Any], where: str) -> Columns:
    """What each column is; the `overrides` of the TOML file go before what names tell.

    Raises:
        ConfigError: The TOML file names something that does not exist.
        ConversionError: A column that is needed is missing, or there twice.
    """
    for key in overrides:
        one_of("setting", key, ("columns", "units", "kinds", "hz", "shift_m", "reference"))
    by_name: dict[str, list[tuple[str, str]]] = {}
    for name in names:
        base, unit = _split_unit(name)
        by_name.setdefault(base, []).append((name, unit))
    found = {}
    for role, (quantity, known) in _ROLES.items():
        for word in known.split():
            fitting = [(n, u) for n, u in by_name.get(word, []) if not u or u in UNITS[quantity]]
            if fitting:
                name, unit = fitting[0]
                found[role] = Column(name, unit or _USUAL.get(quantity, ""))
                break
    if "xcenter" in by_name and "tracklifetime" in by_name:  # levelXdata: no units in names
        found = {r: replace(c, unit="deg") if r == "heading" else c for r, c in found.items()}
    found |= _named_columns(overrides.get("columns", {}), found, names, where)
    found = {role: column for role, column in found.items() if column.name or column.constant}
    for quantity, unit in _table(overrides, "units").items():
        one_of("unit of", quantity, tuple(UNITS))
        unit = one_of(f"unit of {quantity}", _SPELLINGS.get(unit, unit), UNITS[quantity])
        for role in [r for r in found if _ROLES[r][0] == quantity]:
            found[role] = replace(found[role], unit=unit)
    _require_columns(found, names, where)
    for column in found.values():
        if names.count(column.name) > 1:
            raise ConversionError(
                f"{where} has {names.count(column.name)} columns {column.name!r}",
                "give each a name of its own",
            )
    shift = overrides.get("shift_m", (0.0, 0.0))
    if len(shift) != 2 or not all(isinstance(v, int | float) for v in shift):
        raise ConfigError(f"shift_m is {shift!r}", "shift_m = [x, y] in metres")
    hz = overrides.get("hz", 1.0)
    if not isinstance(hz, int | float) or not 0.0 < hz < np.inf:
        raise ConfigError(f"hz is {hz!r}", "hz = 25, or --hz 25")
    reference = overrides.get("reference", "")
    if reference:
        one_of("reference", reference, ("center", "front", "rear"))
    kinds = {
        normalise_category(k): normalise_category(v) for k, v in _table(overrides, "kinds").items()
    }
    for known_kind in kinds.values():
        one_of("kind", known_kind, KINDS)
    return Columns(found, kinds, overrides.get("hz"), (float(shift[0]), float(shift[1])), reference)


def _split_unit(name: str) -> tuple[str, str]:
    """The name without case, spaces and unit, and the unit: `("timestamp", "ms")`."""
    words = re.fullmatch(r"(.+?)[\s_\-.]*[\[(_\-.\s]([a-zµ/]+)[\])]?", name.strip().lower())
    if words:
        unit = _SPELLINGS.get(words[2], words[2])
        if any(unit in units for units in UNITS.values()):
            return re.sub(r"[^a-z0-9]", "", words[1]), unit
    return re.sub(r"[^a-z0-9]", "", name.lower()), ""


def _named_columns(
    overrides: Mapping[str, str], found: Mapping[str, Column], names: Sequence[str], where: str
) -> dict[str, Column]:
    out = {}
    for role, text in overrides.items():
        one_of("column", role, ROLES)
        usual = _USUAL.get(_ROLES[role][0], "")
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
    for role in ("id", "x", "y", "kind"):
        if role in found:
            continue
        hint = f"say which it is in a TOML file for --columns: [columns] {role} = 'NAME'"
        if role in ("x", "y") and lat:
            hint = (
                f"{' and '.join(lat)} are degrees: project them to the metric frame of the map"
                " (pyproj), and give x and y in metres"
            )
        if role == "kind":
            hint += ", or kind = '=car' if all objects are cars"
        raise ConversionError(
            f"{where} has no column that is known as {role!r}; it has {', '.join(names)}", hint
        )
    if "time" not in found and "frame" not in found:
        raise ConversionError(
            f"{where} has neither a time nor a frame; it has {', '.join(names)}",
            "say which column it is in a TOML file for --columns: [columns] time = 'NAME'",
        )


def _table(overrides: Mapping[str, Any], key: str) -> dict[str, str]:
    value = overrides.get(key, {})
    if not isinstance(value, dict) or not all(isinstance(v, str) for v in value.values()):
        raise ConfigError(f"{key} is {value!r}", f"[{key}] with lines NAME = 'TEXT'")
    return value
