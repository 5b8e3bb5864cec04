"""Networks with deterministic weights, and the manifests that say how they are made."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from typing import Any

from shiftsim.planners.learned.checkpoint import load_network
from shiftsim.planners.learned.deterministic import deterministic_state, keyed_normals, rule_of
from shiftsim.planners.learned.match import network_module
from shiftsim.verify.files import Source
from shiftsim.verify.scenes import Scenes
from shiftsim.verify.tables import Table


@cache
def make_network(planner: str, variant: str) -> Any:
    """The network of a planner with a variant of the deterministic weights, ready to be called."""
    return load_network(f"deterministic:{variant}", planner)


def match_meta(file: Source, planner: str, **ours: object) -> None:
    """Compare the JSON text in the array `meta`."""
    file.report.compare(f"{planner} meta", file.name, ours, json.loads(str(file["meta"])))


def match_case(file: Source, planner: str) -> list[str]:
    """`match_meta` of a forward pass: its name, and the variants of the weights that it has."""
    variants = sorted({name.split(".")[1] for name in file if name.count(".") > 1})
    match_meta(file, planner, case=file.name.removeprefix("forward_"), variants=variants)
    return variants


def verify_manifest(
    planner: str, tables: Mapping[str, Table], file: Source, scenes: Scenes, /, **names: Any
) -> None:
    """Compare `state_dict.json`: names, shapes, types, rules and weights, and the other fields.

    Section `manifest` of the tables has these, among `names`; `weights` has by field which weights
    it counts, as a pattern of their names: the trainable ones if it says so.
    """
    report, module = file.report, network_module(planner)
    network, rules = module.build_network(), getattr(module, "RULES", {})
    built = {name: value.detach().numpy() for name, value in network.state_dict().items()}
    trained = {name for name, _ in network.named_parameters()}
    entries = file.each("keys" if "keys" in file else "entries")
    listed = [str(entry["key" if "key" in entry else "name"]) for entry in entries]
    report.compare(f"{planner} state names", file.name, sorted(built), sorted(listed))
    for name, entry in zip(listed, entries, strict=True):
        if name not in built:
            continue
        ours = {
            "shape": list(built[name].shape),
            "dtype": str(built[name].dtype),
            "kind": "parameter" if name in trained else "buffer",
            "ckpt_key": module.PREFIXES[0] + name,
            "rule": rules.get(name) or rule_of(name, built[name].ndim),
            "value": built[name].tolist(),
        }
        ours = {field: value for field, value in ours.items() if field in entry}
        entry.match(name, ours, quantity=f"{planner} state")
    (check,) = file.each("selfcheck")
    if "first3_raw_z" in check:
        where, shape = check["name"], built[check["name"]].shape
        firsts = {"shape": shape, "first3_raw_z": keyed_normals(where, shape).ravel()[:3]}
        check.used.add("note")
    else:
        where, weights = "selfcheck", deterministic_state(built, rules)
        firsts = {name: weights[name].ravel()[:3].astype(float) for name in check}
    check.match(where, firsts, quantity=f"{planner} selfcheck")
    heads = {
        layer: {"C": len(head.gain), **{name: list(v) for name, v in asdict(head).items()}}
        for layer, head in getattr(module, "DRIVE_HEADS", {}).items()
    }
    scales, called = getattr(module, "DRIVE_SCALES", {}), f"{planner} manifest"
    names |= {"network": module, "heads": heads, "scales": scales}
    tables["manifest"].match(file, file.name, called, **names)
    counts = {}
    for field, pattern in tables["weights"].rows.items():
        counted = trained if "trainable" in field else built
        counts[field] = sum(built[name].size for name in counted if re.match(pattern, name))
    file.match(file.name, counts, quantity=called)
    file.used.add("planner")
