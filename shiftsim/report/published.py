"""Figures of the published benchmark, to be shown beside own ones."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Published:
    """Numbers copied from the paper; scores are times 100."""

    source: str  # where they are from
    # names of each site by its abbreviation, in the paper's order
    cities: Mapping[str, Sequence[str]]
    scenarios: Mapping[str, int]  # scenarios of each site, by abbreviation
    columns: Sequence[str]  # columns of `semantic_shift`: sets, sites, metrics
    semantic_shift: Mapping[str, Mapping[str, Sequence[float]]]  # values by traffic and planner
    noises: Sequence[str]  # columns of `robustness`
    # by traffic, set and planner: mean and deviation of each noise
    robustness: Mapping[str, Mapping[str, Mapping[str, Sequence[Sequence[float]]]]]
    sets: Sequence[str]  # columns of `comparison`
    comparison: Mapping[str, Sequence[str]]  # properties of the data sets, by name of the property

    def abbreviation(self, city: str) -> str:
        """The paper's abbreviation of a city; empty for other cities."""
        plain = _plain(city)
        found = (s for s, names in self.cities.items() if plain in map(_plain, (s, *names)))
        return next(found, "")

    def scores(self, traffic: str) -> dict[str, dict[str, float]]:
        """Values of `semantic_shift` under one traffic mode, by planner and column."""
        return {
            planner: dict(zip(self.columns, values, strict=True))
            for planner, values in self.semantic_shift.get(traffic, {}).items()
        }


def called_alike(name: str, listed: Iterable[str]) -> list[str]:
    """Planners of a published table that are called like one of ours: one or none."""
    return [other for other in listed if _plain(other) == _plain(name)]


def _plain(text: str) -> str:
    return "".join(c for c in text.casefold() if c.isalnum())
