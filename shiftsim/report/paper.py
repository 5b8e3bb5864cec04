"""The paper's tables from own runs, and its figures: zero-shot generalization, noise robustness."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from shiftsim.report.groups import COLUMNS, DataSet, Group, distinct_sets
from shiftsim.report.statistics import FEW_CLUSTERS, score_interval
from shiftsim.report.tables import Cell, Estimate, Number, Table
from shiftsim.report.words import LONG, NAMES
from shiftsim.sim.noise import NOISE_NAMES

VAL14 = "val14"
INTERVALS = (
    "95 % CI: cluster bootstrap over recordings, 10 000 draws; it says how much the choice "
    "of scenarios matters, not the seeds"
)
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

    def scores(self, traffic: str) -> dict[str, dict[str, float]]:
        """Values of `semantic_shift` under one traffic mode, by planner and column."""
        return {
            planner: dict(zip(self.columns, values, strict=True))
            for planner, values in self.semantic_shift.get(traffic, {}).items()
        }


def called_alike(name: str, listed: Iterable[str]) -> list[str]:
    """Planners of a published table that are called like one of ours: one or none."""
    return [other for other in listed if _letters(other) == _letters(name)]


def _letters(text: str) -> str:
    return "".join(c for c in text.casefold() if c.isalnum())


class _Column(NamedTuple):
    """A column of scores: its heading, its name in the paper, and what makes a group's cell."""

    heading: str
    published: str
    cell: Callable[[Group], Cell]


def semantic_shift(
    groups: Sequence[Group],
    published: Published | None = None,
    *,
    with_published: bool = False,
    allow_partial: bool = False,
) -> list[Table]:
    """Clean scores of all scenarios, per city and per metric: one table per set of scenarios.

    The paper's sites give cities their short names and order. `with_published` shows its scores as
    well, in the same table where the cities are the same; `allow_partial` labelled partial means.
    """
    clean = [group for group in groups if group.noise == "none"]
    others = [group for group in clean if group.data.known != VAL14]
    val14 = [group for group in clean if group.data.known == VAL14]
    out = []
    for data in distinct_sets(others or val14):
        mine = [group for group in clean if group.data.key == data.key]
        compared = val14 if data.known != VAL14 else []
        columns = _columns(data, compared, published, allow_partial)
        notes = [data.rules, *(one.rules for one in distinct_sets(compared)), INTERVALS]
        out.append(_semantic_table(data, mine, columns, notes, published, with_published))
    alike = [one for one in distinct_sets(clean) if published and _is_paper_like(one, published)]
    if published is not None and with_published and not alike:
        out.append(published_semantic(published))
    return out


def _is_paper_like(data: DataSet, published: Published) -> bool:
    """Whether all cities are sites of the paper."""
    return all(published.abbreviation(city) for city in data.cities if city)


def _columns(
    data: DataSet, val14: Sequence[Group], published: Published | None, allow_partial: bool
) -> list[_Column]:
    """Val14 where it was run, too; the set; its cities; the metrics."""
    estimate = partial(Group.estimate, allow_partial=allow_partial)

    def on_val14(group: Group, data: DataSet) -> Cell:
        wanted = (data.key, group.traffic, group.planner)
        same = (g for g in val14 if (g.data.key, g.traffic, g.planner) == wanted)
        found = next(same, None)
        return None if found is None else estimate(found)

    cities = _cities(data, published).items()
    return [
        *(_Column(one.label, VAL14, partial(on_val14, data=one)) for one in distinct_sets(val14)),
        _Column(data.label, "all", estimate),
        _Column("95 % CI", "", score_interval),
        *(_Column(name, name, partial(estimate, where=data.within(city))) for city, name in cities),
        *(_Column(COLUMNS[n], COLUMNS[n], partial(estimate, name=n)) for n in NAMES),
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


def _semantic_table(
    data: DataSet,
    groups: Sequence[Group],
    columns: Sequence[_Column],
    notes: list[str],
    published: Published | None,
    with_published: bool,
) -> Table:
    paper = published if published and with_published and _is_paper_like(data, published) else None
    rows: list[tuple[Cell, ...]] = []
    for traffic in traffics(groups):
        left = paper.scores(traffic) if paper else {}
        for group in (group for group in groups if group.traffic == traffic):
            rows.append((traffic, group.planner, *(column.cell(group) for column in columns)))
            for name in called_alike(group.planner, left):
                rows.append(_published_row(traffic, name, left.pop(name), columns))
        rows += [_published_row(traffic, name, left[name], columns) for name in left]
    notes += _set_notes(data, published)
    notes += [f"{PUBLISHED[1:-1]}: {paper.source}"] if paper else []
    header = ("traffic", "planner", *(column.heading for column in columns))
    title = f"Zero-shot generalization: {data.label}, clean, scores x 100"
    name = f"semantic-shift_{data.name}"
    words = _words(published)
    return Table(name, title, header, tuple(rows), 2, tuple(notes), words=words)


def traffics(groups: Iterable[Group]) -> list[str]:
    """Traffic modes: NR, R, then others."""
    found = {group.traffic for group in groups}
    return sorted(found, key=lambda name: (name not in ("NR", "R"), name))


def _published_row(
    traffic: str, planner: str, values: Mapping[str, float], columns: Sequence[_Column]
) -> tuple[Cell, ...]:
    """A row of the paper under the columns of an own table: `all` stands under the own set."""
    names = (column.published for column in columns)
    cells = (Number(values[name]) if name in values else None for name in names)
    return (traffic, f"{planner} {PUBLISHED}", *cells)


def _set_notes(data: DataSet, published: Published | None) -> list[str]:
    """What a reader must know of a set: few recordings, or that it is not the paper's."""
    notes = []
    if data.num_recordings < FEW_CLUSTERS:
        notes.append(f"few recordings ({data.num_recordings}): intervals are too narrow")
    if published and data.known != VAL14 and not _is_paper_like(data, published):
        notes.append("not a set of the published benchmark")
    elif published and data.known != VAL14:
        notes.append(
            f"own list of {len(data.tokens)} scenarios, not the paper's: the authors' list of "
            f"{published.comparison['scenario count'][-1]} is unpublished"
        )
    return notes


def published_semantic(published: Published) -> Table:
    """The paper's own table."""
    metrics = [name for name in LONG if name in published.columns]
    columns = [*(name for name in published.columns if name not in LONG), *metrics]
    rows: list[tuple[Cell, ...]] = [
        (traffic, f"{planner} {PUBLISHED}", *(Number(values[name]) for name in columns))
        for traffic in published.semantic_shift
        for planner, values in published.scores(traffic).items()
    ]
    header = ("traffic", "planner", *(_SETS.get(name, name) for name in columns))
    notes = (published.source, "Val14 thresholds nuplan, DeepPlan thresholds deepplan")
    title = "Zero-shot generalization as published"
    words = _words(published)
    return Table("semantic-shift_published", title, header, tuple(rows), 2, notes, words=words)


def _words(published: Published | None) -> dict[str, str]:
    """What headings are short for: metrics, and the paper's sites."""
    sites = published.cities if published else {}
    return LONG | {short: names[0] for short, names in sites.items()}


def noise_robustness(
    groups: Sequence[Group], published: Published | None = None, *, allow_partial: bool = False
) -> Table | None:
    """Scores by noise, mean and deviation over the seeds; None where all is clean."""
    found = {group.noise for group in groups}
    if found <= {"none"}:
        return None
    noises = [name for name in NOISE_NAMES if name in found or published is not None]
    noises += sorted(found - set(NOISE_NAMES))
    rows: list[tuple[Cell, ...]] = []
    sets = distinct_sets(groups)
    for data in sets:
        mine = [group for group in groups if group.data.key == data.key]
        cells = {
            (g.traffic, g.planner, g.noise): g.estimate(allow_partial=allow_partial) for g in mine
        }
        for traffic in traffics(mine):
            for planner in dict.fromkeys(g.planner for g in mine if g.traffic == traffic):
                scores = (cells.get((traffic, planner, noise)) for noise in noises)
                rows.append((data.label, traffic, planner, *scores))
    notes = [*(data.rules for data in sets), _seeds_note(groups)]
    if published is not None:
        rows += _published_robustness(published, noises)
        notes.append(f"published: {published.source}")
    header = ("set", "traffic", "planner", *noises)
    title = "Noise robustness: closed-loop score x 100"
    return Table("noise-robustness", title, header, tuple(rows), 3, tuple(notes))


def _seeds_note(groups: Sequence[Group]) -> str:
    counts = sorted({len(group.seeds) for group in groups if group.noise != "none"})
    seeds = " or ".join(map(str, counts))
    if counts == [1]:
        return "one seed: no deviation"
    return f"± sample standard deviation (n − 1) of the mean over {seeds} seeds; clean has none"


def _published_robustness(published: Published, noises: Sequence[str]) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for traffic, sets in published.robustness.items():
        for name, planners in sets.items():
            for planner, values in planners.items():
                cells = {
                    noise: Estimate(cell[0], cell[1] if len(cell) > 1 else None, 1, 1)
                    for noise, cell in zip(published.noises, values, strict=True)
                }
                scores = (cells.get(noise) for noise in noises)
                rows.append((f"{_SETS[name]} {PUBLISHED}", traffic, planner, *scores))
    return rows
