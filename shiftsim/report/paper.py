"""The paper's tables from own runs, and its figures: zero-shot generalization, noise robustness."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import methodcaller
from typing import NamedTuple

from shiftsim.report.groups import COLUMNS, DataSet, Group, by_set, distinct_sets
from shiftsim.report.statistics import FEW_CLUSTERS, score_interval
from shiftsim.report.tables import Cell, Number, Row, Table
from shiftsim.report.words import LONG, NAMES
from shiftsim.sim.noise import NOISE_NAMES
from shiftsim.sim.perception import drift_order

VAL14 = "val14"
INTERVALS = (
    "95 % CI: cluster bootstrap over recordings, 10 000 draws; it says how much the choice "
    "of scenarios matters, not the seeds"
)
INTERVAL = "95 % CI"
PUBLISHED = "(published)"
_SETS = {"val14": "Val14", "all": "DeepPlan", "deepplan": "DeepPlan"}


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
        plain = _letters(city)
        found = (s for s, names in self.cities.items() if plain in map(_letters, (s, *names)))
        return next(found, "")

    def count(self, city: str) -> int | None:
        """Scenarios that the paper has of a city; None where it has none."""
        return self.scenarios.get(self.abbreviation(city))

    def scores(self, traffic: str) -> dict[str, dict[str, float]]:
        """Values of `semantic_shift` under one traffic mode, by planner and column."""
        return {
            planner: dict(zip(self.columns, values, strict=True))
            for planner, values in self.semantic_shift.get(traffic, {}).items()
        }


def _letters(text: str) -> str:
    return "".join(c for c in text.casefold() if c.isalnum())


class _Column(NamedTuple):
    """A column of scores: its heading, its name in the paper, and what makes a group's cell."""

    heading: str
    published: str
    cell: Callable[[Group], Cell]


def semantic_shift(
    groups: Sequence[Group], published: Published | None = None, *, with_published: bool = False
) -> list[Table]:
    """Clean scores of all scenarios, per city and per metric; a table per set of scenarios."""
    sets = by_set(group for group in groups if group.noise == "none")
    others = [one for one in sets if one[0].known != VAL14]
    val14 = [one for one in sets if one[0].known == VAL14]
    out = []
    for data, mine in others or val14:
        columns = _columns(data, val14 if others else [], published)
        compared = [one.rules for one, _ in val14] if others else []
        notes = [data.rules, *compared, INTERVALS]
        paper = published if published and _is_paper_like(data, published) else None
        if data.num_recordings < FEW_CLUSTERS:
            notes.append(f"few recordings ({data.num_recordings}): intervals are too narrow")
        if paper and data.known != VAL14:
            notes.append(
                f"own list of {len(data.tokens)} scenarios, not the paper's: the authors' list of "
                f"{paper.comparison['scenario count'][-1]} is unpublished"
            )
        elif published and data.known != VAL14:
            notes.append("not a set of the published benchmark")
        if with_published and paper:
            notes.append(f"{PUBLISHED[1:-1]}: {paper.source}")
        rows = _semantic_rows(mine, columns, paper if with_published else None)
        header = ("traffic", "planner", *(column.heading for column in columns))
        title = f"Scores × 100 without noise: {data.label}"
        name = f"semantic-shift_{data.name}"
        best = dict.fromkeys((one for one in header[2:] if one != INTERVAL), max)
        table = Table(name, title, header, rows, 2, notes, words=_words(published), best=best)
        out.append(table)
    alike = [data for data, _ in sets if published and _is_paper_like(data, published)]
    if published is not None and with_published and not alike:
        out.append(published_semantic(published))
    return out


def _is_paper_like(data: DataSet, published: Published) -> bool:
    """Whether all cities are sites of the paper."""
    return all(published.abbreviation(city) for city in data.cities if city)


def _columns(
    data: DataSet, val14: Sequence[tuple[DataSet, list[Group]]], published: Published | None
) -> list[_Column]:
    """Val14 where it was run, too; the set; its cities; the metrics."""

    def of_val14(mine: Sequence[Group]) -> Callable[[Group], Cell]:
        cells = {(g.traffic, g.planner): g.estimate() for g in mine}
        return lambda group: cells.get((group.traffic, group.planner))

    def of_city(city: str) -> Callable[[Group], Cell]:
        return lambda group: group.only(data.within(city)).estimate()

    return [
        *(_Column(one.label, VAL14, of_val14(mine)) for one, mine in val14),
        _Column(data.label, "all", Group.estimate),
        _Column(INTERVAL, "", score_interval),
        *(_Column(name, name, of_city(city)) for city, name in _cities(data, published).items()),
        *(_Column(COLUMNS[n], COLUMNS[n], methodcaller("estimate", n)) for n in NAMES),
    ]


def _cities(data: DataSet, published: Published | None) -> dict[str, str]:
    """Names of the columns by city, in the paper's order; none for a single city."""
    names = sorted({city for city in data.cities if city})
    if len(names) < 2:
        return {}
    shorts = {name: published.abbreviation(name) if published else "" for name in names}
    order = {short: place for place, short in enumerate(published.cities if published else ())}
    names.sort(key=lambda name: order.get(shorts[name], len(order)))
    return {name: shorts[name] or name for name in names}


def _semantic_rows(
    groups: Sequence[Group], columns: Sequence[_Column], paper: Published | None
) -> list[Row]:
    """A row per group, below it the paper's of that planner; last the paper's other planners."""
    rows: list[Row] = []
    for traffic in dict.fromkeys(group.traffic for group in groups):
        left = paper.scores(traffic) if paper else {}
        for group in (group for group in groups if group.traffic == traffic):
            rows.append((traffic, group.planner, *(column.cell(group) for column in columns)))
            for name in [name for name in left if _letters(name) == _letters(group.planner)]:
                rows.append(_published_row(traffic, name, left.pop(name), columns))
        rows += [_published_row(traffic, name, left[name], columns) for name in left]
    return rows


def _published_row(
    traffic: str, planner: str, values: Mapping[str, float], columns: Sequence[_Column]
) -> Row:
    """A row of the paper under the columns of an own table: `all` stands under the own set."""
    names = (column.published for column in columns)
    cells = (Number(values[name]) if name in values else None for name in names)
    return (traffic, f"{planner} {PUBLISHED}", *cells)


def published_semantic(published: Published) -> Table:
    """The paper's own table."""
    sites = (name for name in published.columns if name not in LONG)
    names = [*sites, *(name for name in LONG if name in published.columns)]
    columns = [_Column(_SETS.get(name, name), name, Group.estimate) for name in names]
    rows = [
        _published_row(traffic, planner, values, columns)
        for traffic in published.semantic_shift
        for planner, values in published.scores(traffic).items()
    ]
    header = ("traffic", "planner", *(column.heading for column in columns))
    notes = (published.source, "Val14 thresholds nuplan, DeepPlan thresholds deepplan")
    title = "Zero-shot generalization as published, scores × 100"
    words, best = _words(published), dict.fromkeys(header[2:], max)
    return Table("semantic-shift_published", title, header, rows, 2, notes, words=words, best=best)


def _words(published: Published | None) -> dict[str, str]:
    """What headings are short for: metrics, and the paper's sites."""
    sites = published.cities if published else {}
    return LONG | {short: names[0] for short, names in sites.items()}


def noise_robustness(groups: Sequence[Group], published: Published | None = None) -> Table | None:
    """Scores by noise, mean and deviation over the seeds; None where all is clean."""
    found = {group.noise for group in groups}
    if found <= {"none"}:
        return None
    noises = drift_order([*found, *(NOISE_NAMES if published else ())])
    scores: dict[tuple[str, ...], dict[str, Cell]] = {}
    for data, mine in by_set(groups):
        for group in mine:
            row = scores.setdefault((data.label, group.traffic, group.planner), {})
            row[group.noise] = group.estimate()
    counts = sorted({len(group.seeds) for group in groups if group.noise != "none"})
    seeds = f"the mean over {' or '.join(map(str, counts))} seeds; clean has none"
    deviation = f"± sample standard deviation (n − 1) of {seeds}"
    notes = [data.rules for data in distinct_sets(groups)]
    notes.append("one seed: no deviation" if counts == [1] else deviation)
    if published is not None:
        notes.append(f"published: {published.source}")
        scores |= {
            (f"{_SETS[name]} {PUBLISHED}", traffic, planner): {
                noise: Number(mean, std=std[0] if std else None)
                for noise, (mean, *std) in zip(published.noises, values, strict=True)
            }
            for traffic, sets in published.robustness.items()
            for name, planners in sets.items()
            for planner, values in planners.items()
        }
    rows = [(*labels, *map(row.get, noises)) for labels, row in scores.items()]
    header = ("set", "traffic", "planner", *noises)
    title, best = "Noise robustness: closed-loop score × 100", dict.fromkeys(noises, max)
    return Table("noise-robustness", title, header, rows, 3, notes, best=best)
