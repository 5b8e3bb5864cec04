"""Codes of interPlan, such as `dhgsom`: a letter with one character each, read from left to right.

Letters are a (share of vehicles kept), d (density), g (goal), o (policy of the agents) and s
(special scenario, whose number may have two digits). Later ones overwrite earlier ones.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from shiftsim.edits.spec import MANNERS
from shiftsim.errors import ConfigError

LETTERS = {
    "a": "amount_of_agents",
    "d": "density",
    "g": "goal",
    "o": "observation",
    "s": "special_scenario",
}
DENSITIES = {"l": "low", "m": "medium", "h": "high"}
COMMANDS = {"l": "left", "r": "right", "s": "straight"}
POLICIES = {"a": "assertive", "c": "cautious", "m": "mixed"}
_EDITS_AGENTS = ("density", "amount_of_agents", "special_scenario")
DETAILS = "modification_details_dictionary"


def parse_code(code: str) -> dict[str, Any]:
    """What a code asks for, by the long name of its letters; else a ConfigError."""
    out: dict[str, Any] = {}
    at = 0
    while at < len(code):
        letter, value = code[at], code[at + 1 : at + 2]
        if letter == "s" and code[at + 2 : at + 3].isdigit():
            value, at = code[at + 1 : at + 3], at + 1
        if not value:
            raise ConfigError(f"code {code!r}: letter {letter!r} has no value")
        if letter not in LETTERS:
            what = f"code {code!r}: letter {letter!r} unknown"
            raise ConfigError(what, f"there are: {', '.join(LETTERS)}")
        if letter == "a" and not value.isdigit():
            raise ConfigError(f"code {code!r}: share {value!r} is no digit")
        out[LETTERS[letter]] = int(value) if letter == "a" else value
        at += 2
    return out


def edits_agents(changes: Mapping[str, Any]) -> bool:
    """Whether agents are changed, and not the goal alone."""
    return any(name in changes for name in _EDITS_AGENTS)


def changes_of(code: str, details: Mapping[str, Any]) -> dict[str, Any]:
    """What a code asks for; that of a special scenario, if any, replaces all. Or a ConfigError."""
    changes = parse_code(code)
    number = changes.get("special_scenario")
    if number is None:
        return changes
    config = special_of(changes, details).get("config")
    return parse_code(f"{config}s{number}") if config else changes


def special_of(changes: Mapping[str, Any], details: Mapping[str, Any]) -> Mapping[str, Any]:
    """The description of a special scenario, or a ConfigError; empty where it is none."""
    number = changes.get("special_scenario")
    if number is None:
        return {}
    known = details.get("special_scenario") or {}
    if number not in known:
        what = f"special scenario {number!r} is not described in the modifications"
        raise ConfigError(what, f"there are: {', '.join(known) or 'none'}")
    return known[number]


def scenario_type(changes: Mapping[str, Any], details: Mapping[str, Any]) -> str:
    """Type of the scenario that a code makes."""
    kind = special_of(changes, details).get("type")
    if kind:
        return str(kind)
    if density := changes.get("density"):
        if density not in DENSITIES:
            raise ConfigError(f"density {density!r} is not one of {', '.join(DENSITIES)}")
        return f"{DENSITIES[density]}_traffic_density"
    return "standard_modified_nuplan_scenario"


def group_names(names: Iterable[str]) -> dict[str, list[str]]:
    """Codes by token, of names such as `2d62c3139aa95007-s0`, all or none of them with codes."""
    listed = list(names)
    if len({"-" in name for name in listed}) > 1:
        raise ConfigError("some names have codes and others have none", "all or none need one")
    out: dict[str, list[str]] = {}
    for name in listed:
        token, _, code = name.partition("-")
        out.setdefault(token, []).append(code.split("-")[0])
    return out


def manners_in_force(names: Iterable[str], details: Mapping[str, Any]) -> dict[str, str]:
    """How agents treat the ego in each scenario of a list, by name.

    nuPlan rule 704: without the letter `o` it is that of the scenario before it, in the order of
    tokens; at first it is assertive.
    """
    out: dict[str, str] = {}
    mode = MANNERS[0]
    for token, codes in sorted(group_names(names).items()):
        for code in codes:
            changes = changes_of(code, details.get(token) or {})
            mode = POLICIES.get(changes.get("observation", ""), mode)
            out[f"{token}-{code}"] = mode
    return out


def import_names(
    names: Mapping[str, Any], modifications: Mapping[str, Any], window: float = 30.0
) -> dict[str, Any]:
    """The table of an `edits.toml` for a list of interPlan's names; `window` [s], 0 as recorded."""
    listed, details = names.get("scenario_tokens"), modifications.get(DETAILS)
    if not isinstance(listed, list) or not isinstance(details, dict):
        raise ConfigError(
            f"the first file lists no scenario_tokens, or the second one has no {DETAILS}",
            hint="name interPlan's filter first, then its interPlan_modifications.yaml",
        )
    details = {str(token): found or {} for token, found in details.items()}
    edits: list[dict[str, Any]] = []
    for name, policy in manners_in_force(map(str, listed), details).items():
        token, _, code = name.partition("-")
        edit: dict[str, Any] = {"name": code, "tokens": [token], "code": code, "agents": policy}
        if window:
            edit["window_s"] = window
        if found := _used(details.get(token, {}), code):
            edit["details"] = found
        edits.append(edit)
    return {"format": 1, "profile": "interplan", "edit": edits}


def _used(details: Mapping[str, Any], code: str) -> dict[str, Any]:
    """What the details of a token say that a code reads."""
    number = parse_code(code).get("special_scenario")
    out = {}
    for name in ("goal", "roadblock_locations_to_spawn_agents", "extra_agents_to_spawn"):
        if name in details:
            out[name] = details[name]
    if number is not None:
        out["special_scenario"] = {number: special_of({"special_scenario": number}, details)}
    return out
