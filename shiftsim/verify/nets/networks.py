"""Networks with deterministic weights, and the manifests that say how they are made."""

import json
import re
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from shiftsim.errors import DataError
from shiftsim.planners.learned.checkpoint import load_weights
from shiftsim.planners.learned.deterministic import deterministic_state, keyed_normals, rule_of
from shiftsim.planners.learned.match import network_module
from shiftsim.verify.files import Source
from shiftsim.verify.scenes import Scenes

PROSE = re.compile("")  # any text
FEATURE = 5e-5  # m, rad, …: features are stored as 32 bit floats
OUTPUT = {"base": 2e-5, "drive": 5e-4}  # outputs that the drive weights scale up, by variant


@cache
def make_network(planner: str, variant: str, **args: Any) -> Any:
    """The network of a planner with deterministic weights, ready to be called.

    `variant` is that of the weights, `args` are hyper-parameters that differ from the released.
    """
    if variant not in OUTPUT:
        raise DataError(f"unknown variant {variant!r} of the weights")
    network = network_module(planner).build_network(args or None)
    network.load_state_dict(load_weights(f"deterministic:{variant}", planner).state)
    return network.eval()


def match_meta(file: Source, planner: str, ours: Mapping[str, object]) -> None:
    """Compare the JSON text in the array `meta`."""
    file.report.compare(f"{planner} meta", file.name, ours, json.loads(str(file["meta"])))


def match_case(file: Source, planner: str) -> list[str]:
    """`match_meta` of a forward pass: its name, and the variants of the weights that it has."""
    variants = sorted({name.split(".")[1] for name in file if name.count(".") > 1})
    case = file.name.removeprefix("forward_")
    match_meta(file, planner, {"case": case, "variants": variants})
    return variants


def verify_manifest(
    planner: str,
    counts: Mapping[str, str],  # by field that counts weights: pattern of their names
    make_others: Callable[[Any], Mapping[str, Any]],  # further fields from the network's module
    manifest: Source,
    scenes: Scenes,
) -> None:
    """Compare the manifest `state_dict.json` of a network: names, shapes, types, rules and weights.

    Fields that count, count the trainable weights if they say so. In the others a pattern stands
    for every text that it matches.
    """
    report, module = manifest.report, network_module(planner)
    network = module.build_network(None)
    built = {name: value.detach().numpy() for name, value in network.state_dict().items()}
    parameters = {name for name, _ in network.named_parameters()}
    rules = getattr(module, "RULES", None) or {}
    entries = manifest.each("keys" if "keys" in manifest else "entries")
    names = [str(entry["key" if "key" in entry else "name"]) for entry in entries]
    report.compare(f"{planner} state names", manifest.name, sorted(built), sorted(names))
    for name, entry in zip(names, entries, strict=True):
        if name in built:
            ours = {
                "shape": list(built[name].shape),
                "dtype": str(built[name].dtype),
                "kind": "parameter" if name in parameters else "buffer",
                "ckpt_key": module.PREFIXES[0] + name,
                "rule": rules.get(name) or rule_of(name, built[name].ndim),
                "value": built[name].tolist(),
            }
            ours = {field: value for field, value in ours.items() if field in entry}
            entry.match(name, ours, quantity=f"{planner} state")
    (check,) = manifest.each("selfcheck")
    if "first3_raw_z" in check:
        name, shape = check["name"], built[check["name"]].shape
        first = keyed_normals(name, shape).ravel()[:3]
        check.match(name, {"shape": shape, "first3_raw_z": first}, quantity=f"{planner} selfcheck")
        check.used.add("note")
    else:
        weights = deterministic_state(built, rules)
        for name in check:
            first = weights[name].ravel()[: len(check[name])].astype(float)
            report.compare(f"{planner} selfcheck", name, first, check[name])
    ours = {name: _filled(value, manifest[name]) for name, value in make_others(module).items()}
    for field, pattern in counts.items():
        counted = parameters if "trainable" in field else built
        ours[field] = sum(built[name].size for name in counted if re.match(pattern, name))
    manifest.match(manifest.name, ours, quantity=f"{planner} manifest")
    manifest.used.add("planner")


def _filled(ours: Any, theirs: Any) -> Any:
    """Ours, with their text in place of each pattern that matches it."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return {name: _filled(value, theirs.get(name)) for name, value in ours.items()}
    fits = isinstance(ours, re.Pattern) and isinstance(theirs, str) and ours.match(theirs)
    return theirs if fits else ours
