"""The benchmark as data: its tracks, its lists of scenarios, and the published figures.

`load_track("state-drift")` says what a complete result covers; `bench` runs it.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from shiftsim.errors import one_of
from shiftsim.report.groups import KnownSet
from shiftsim.report.paper import Published
from shiftsim.sim.perception import has_seeds

TRACKS = ("semantic-shift", "state-drift", "sensor-drift", "edits", "finding")
INTERPLAN_THRESHOLDS = "nuplan"  # of its edits, whatever the track's own
_HERE = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Drawn:
    """The edits of a track, drawn over the scenarios that are driven."""

    kinds: tuple[str, ...]  # of `sampling.KINDS`
    count: int  # of each kind, as many of each grade
    seed: int  # of all draws


@dataclass(frozen=True, slots=True)
class Towns:
    """Towns that a track generates."""

    domain: str
    towns: int
    seed: int


@dataclass(frozen=True, slots=True)
class Track:
    """What a complete result of a track covers."""

    name: str  # on the command line
    title: str  # of its table
    planners: tuple[str, ...]  # those that the paper compares
    traffic: tuple[str, ...]  # traffic modes, one run each
    noise: tuple[str, ...]  # noise models
    seeds: tuple[int, ...]  # seeds of the noise
    reference: KnownSet | None  # the published list that is driven besides one's own scenarios
    own_thresholds: str  # threshold profile of one's own scenarios
    own_note: str  # what scores on one's own scenarios are, and are not
    drawn: Drawn | None  # what is drawn over one's own scenarios and driven, too
    towns: tuple[Towns, ...]  # that are driven in place of one's own scenarios

    @property
    def rollouts_per_scenario(self) -> int:
        """Rollouts of one planner on one scenario."""
        noisy = sum(map(has_seeds, self.noise))
        return len(self.traffic) * (len(self.noise) - noisy + noisy * len(self.seeds))


def load_track(name: str) -> Track:
    """A track by its name; a ConfigError where there is none."""
    one_of("track", name, TRACKS)
    table = _read(name.replace("-", "_"))
    sets, drawn = table["sets"], table.get("drawn")
    known = {one.name: one for one in known_sets()}
    return Track(
        name=name,
        title=table["title"],
        **{one: tuple(table[one]) for one in ("planners", "traffic", "noise", "seeds")},
        reference=known[sets["reference"]] if "reference" in sets else None,
        own_thresholds=sets["own_thresholds"],
        own_note=sets["own_note"],
        drawn=Drawn(**drawn | {"kinds": tuple(drawn["kinds"])}) if drawn else None,
        towns=tuple(Towns(**values) for values in table.get("towns", ())),
    )


@cache
def known_sets() -> tuple[KnownSet, ...]:
    """The lists of scenarios that are known, small ones before those that hold them."""
    columns = ("label", "thresholds", "count", "sha256")
    out = []
    for name, table in _read("sets").items():
        values = {column: table[column] for column in columns}
        out.append(KnownSet(name=name, tokens=tuple(table.get("tokens", ())), **values))
    return tuple(out)


@cache
def published() -> Published:
    """The figures of the paper."""
    table = _read("published")
    shift, noise = table["semantic_shift"], table["noise_robustness"]
    return Published(
        source=table["source"],
        cities=table["cities"],
        scenarios=table["scenarios"],
        columns=shift["columns"],
        semantic_shift=_tables(shift),
        noises=noise["columns"],
        robustness=_tables(noise),
        sets=table["comparison"]["columns"],
        comparison=table["comparison"]["rows"],
    )


def _tables(table: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in table.items() if isinstance(value, dict)}


def _read(name: str) -> dict[str, Any]:
    return tomllib.loads((_HERE / f"{name}.toml").read_text("utf-8"))


if __name__ == "benchmarks":  # pragma: no cover
    raise ImportError("import it as shiftsim.benchmarks")
