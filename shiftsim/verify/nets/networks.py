"""Networks with deterministic weights, and the manifests that say how they are made."""

import json
import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from shiftsim.errors import DataError
from shiftsim.planners.learned.checkpoint import load_weights
from shiftsim.planners.learned.deterministic import deterministic_state, keyed_normals, rule_of
from shiftsim.planners.learned.match import network_module
from shiftsim.verify.files import Source

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


def verify_manifest(
    manifest: Source, planner: str, counts: Mapping[str, str], others: Mapping[str, Any]
) -> None:
    """Compare the manifest of a network: names, shapes, types, rules and weights.

    Args:
        manifest: The file `state_dict.json`.
        planner: Name of the planner.
        counts: By field that is the size of all weights, or of the trainable ones if it says so:
            pattern of their names.
        others: Further fields: our value, a function that makes it from theirs, or None for a text
            that need not be compared.
    """
    report, module = manifest.report, network_module(planner)
    network = module.build_network(None)
    built = {name: value.detach().numpy() for name, value in network.state_dict().items()}
    rules = getattr(module, "RULES", None) or {}
    entries = manifest.each("keys" if "keys" in manifest else "entries")
    names = [str(entry["key" if "key" in entry else "name"]) for entry in entries]
    report.compare(f"{planner} state names", manifest.name, sorted(built), sorted(names))
    parameters = {name for name, _ in network.named_parameters()}
    for name, entry in zip(names, entries, strict=True):
        if name not in built:
            continue
        ours = {
            "shape": list(built[name].shape),
            "dtype": str(built[name].dtype),
            "kind": "parameter" if name in parameters else "buffer",
            "ckpt_key": module.PREFIXES[0] + name,
            "rule": rules.get(name) or rule_of(name, built[name].ndim),
            "value": built[name].tolist(),
        }
        stored = {field: value for field, value in ours.items() if field in entry}
        entry.match(name, stored, quantity=f"{planner} state")
    (check,) = manifest.each("selfcheck")
    if "first3_raw_z" in check:
        name = check["name"]
        shape = built[name].shape
        first = keyed_normals(name, shape).ravel()[:3]
        check.match(name, {"shape": shape, "first3_raw_z": first}, quantity=f"{planner} selfcheck")
        check.used.add("note")
    else:
        weights = deterministic_state(built, rules)
        for name in check:
            first = weights[name].ravel()[: len(check[name])].astype(float)
            report.compare(f"{planner} selfcheck", name, first, check[name])
    sizes = {field: 0 for field in counts}
    for field, pattern in counts.items():
        some = parameters if "trainable" in field else built
        sizes[field] = sum(built[name].size for name in some if re.match(pattern, name))
    made = {name: ours(manifest[name]) if callable(ours) else ours for name, ours in others.items()}
    for name in [name for name, ours in made.items() if ours is None]:
        manifest.note("description", name)
        del made[name]
    manifest.match(manifest.name, sizes | made, quantity=f"{planner} manifest")
    manifest.used.add("planner")
