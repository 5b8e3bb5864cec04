"""What of a benchmark is there: stores, maps, checkpoints and rollouts; and what is missing.

Data is a plain value, for `shiftsim data --json`; nothing is converted, downloaded or made.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from shiftsim.benchmarks import INTERPLAN_THRESHOLDS, TRACKS, Track, known_sets, load_track
from shiftsim.data.store.reading import ScenarioStore, open_store
from shiftsim.errors import ShiftsimError
from shiftsim.files import checkpoint_folder, store_path
from shiftsim.planners.registry import PLANNERS, readiness
from shiftsim.report.groups import TRAFFIC, Group, distinct_sets, token_digest
from shiftsim.report.tables import Cell, Number, Table
from shiftsim.runs.scenarios import find_split
from shiftsim.sim.perception import has_seeds

_PAGE = "docs/data.md"
OWN = "own scenarios"  # what a track drives besides its published list
_REMEDIES = {  # of what a track drives: how to make it
    "val14": "shiftsim convert nuplan LOGS MAPS --store val14 --filter val14_split.yaml",
    OWN: "shiftsim convert dsc3d DOWNLOAD --store dsc3d",
}


Row: TypeAlias = dict[str, Any]


def list_available_data() -> Row:
    """Look through the folders of stores and of checkpoints.

    Returns:
        `store_folder` and `stores`: each with `name`, `path`, `maps` (cities), `problem` (why it
        cannot be opened) and `sets` (the whole store first, then splits: `name`, `scenarios`, and
        the `known` list that it is); `checkpoint_folder` and `checkpoints`: what a planner lacks,
        or empty; `rows`: a `planner` of a `track`, the set that is its published list (`reference`,
        "–" where it has none), sets of `own` scenarios, and what is `missing`: `what`, the command
        to `get` it, and the `page` of the documentation.
    """
    folder = store_path("demo").parent
    stores = [_store(path.parent) for path in sorted(folder.glob("*/store.json"))]
    learned = {name: entry for name, entry in PLANNERS.items() if entry.checkpoint}
    return {
        "store_folder": str(folder),
        "stores": stores,
        "checkpoint_folder": str(checkpoint_folder()),
        "checkpoints": {name: readiness(entry) for name, entry in learned.items()},
        "rows": [row for track in TRACKS for row in _rows(track, stores)],
    }


def _store(path: Path) -> Row:
    found: Row = {"name": path.name, "path": str(path), "maps": [], "sets": [], "problem": ""}
    try:
        store = open_store(path)
        found["maps"], found["sets"] = list(store.cities), list(_sets(store))
    except ShiftsimError as error:
        found["problem"] = error.message
    return found


def _sets(store: ScenarioStore) -> Iterator[Row]:
    """The whole store, and its splits as far as it has all of their scenarios."""
    digests = {known.sha256: known.name for known in known_sets()}
    names = ["", *(file.stem for file in sorted(store.path.glob("splits/*.toml")))]
    for name in names:
        tokens = find_split(name, store.path, store.tokens).tokens
        if all(token in store for token in tokens):
            known = digests.get(token_digest(tokens), "")
            full = f"{store.path.name}:{name}" if name else store.path.name
            yield {"name": full, "scenarios": len(tokens), "known": known}


def _rows(track: str, stores: list[Row]) -> Iterator[Row]:
    wanted = load_track(track)
    sets = [one for store in stores for one in store["sets"]]
    listed = wanted.reference
    reference = [one["name"] for one in sets if listed and one["known"] == listed.name]
    own = [] if wanted.towns else [one["name"] for one in sets if not one["known"]]
    for planner in wanted.planners:
        missing = []
        if listed and not reference:
            label = f"{listed.label} ({listed.count} scenarios)"
            missing.append(dict(what=label, get=_REMEDIES[listed.name], page=_PAGE))
        if not own and not wanted.towns:
            missing.append(dict(what=OWN, get=_REMEDIES[OWN], page=_PAGE))
        entry, page = PLANNERS[planner], "docs/learned_planners.md"
        if (lack := readiness(entry)) and (file := entry.checkpoint):
            get = f"{lack}; it is {file.file} of the project {file.project}"
            missing.append(dict(what=f"planner {planner}", get=get, page=page))
        first = reference[0] if reference else "" if listed else "–"
        yield {
            "track": track,
            "planner": planner,
            "reference": first,
            "own": own,
            "missing": missing,
        }


def coverage(track: Track, groups: Sequence[Group]) -> Table:
    """Rollouts finished of those that the track's score needs, by set of scenarios and planner."""
    inside = [group for group in groups if _belongs(group, track)]
    sets: dict[str, tuple[str, int]] = {}
    for data in distinct_sets(inside):  # one for each length of windows, all of which count
        label = data.label.removesuffix(f", {''.join(data.classes)}")
        sets[data.name] = (label, data.whole)
    if listed := track.reference:
        sets.setdefault(listed.name, (listed.label, listed.count))
    rows: list[tuple[Cell, ...]] = []
    for name, (label, whole) in sets.items():
        for planner in dict.fromkeys(group.planner for group in inside):
            mine = [g for g in inside if (g.data.name, g.planner) == (name, planner)]
            done = sum(_finished(group, track) for group in mine)
            expected = whole * track.rollouts_per_scenario
            if any(group.data.is_interplan for group in mine):  # for reactive traffic only
                expected //= len(track.traffic)
            verdict = "complete" if done == expected else f"partial ({done}/{expected})"
            counts = (Number(done, 0), Number(expected, 0))
            rows.append((label, planner, *counts, verdict if done else "not run"))
    missing = [name for name in track.planners if name not in {g.planner for g in inside}]
    rules = [f"own scenarios under thresholds {track.own_thresholds}"]
    rules += [f"{listed.label} under {listed.thresholds}"] if listed else []
    if drawn := track.drawn:
        rules.append(f"recorded, and with {drawn.count} edits of each of {', '.join(drawn.kinds)}")
    notes = [
        f"contract: traffic {', '.join(track.traffic)} × noise {', '.join(track.noise)} × seeds "
        f"{', '.join(map(str, track.seeds))} on all scenarios; {', '.join(rules)}",
        f"scores that are not complete are not the benchmark's; own scenarios: {track.own_note}",
    ]
    notes += [f"planners of the track that are not here: {', '.join(missing)}"] if missing else []
    header = ("set", "planner", "rollouts", "of", "verdict")
    title = f"Coverage of the track {track.name}"
    return Table("coverage", title, header, tuple(rows), 2, tuple(notes))


def _belongs(group: Group, track: Track) -> bool:
    """Whether a group is part of the contract."""
    listed, rules = track.reference, track.own_thresholds
    if listed and group.data.known == listed.name:
        rules = listed.thresholds
    elif group.data.is_interplan:
        rules = INTERPLAN_THRESHOLDS
    modes = [TRAFFIC[name] for name in track.traffic]
    return (
        group.traffic in modes
        and group.noise in track.noise
        and group.data.thresholds == rules
        and group.data.controller == "lqr"
    )


def _finished(group: Group, track: Track) -> int:
    wanted = track.seeds if has_seeds(group.noise) else (0,)
    rows = [i for i, seed in enumerate(group.seeds) if seed in wanted]
    return int(np.isfinite(group.values[rows, :, 0]).sum())
