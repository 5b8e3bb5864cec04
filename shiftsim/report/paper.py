"""The paper's tables from own runs: zero-shot generalization and noise robustness."""

from collections.abc import Iterable, Sequence

from shiftsim.report.groups import DataSet, Estimate, Group
from shiftsim.report.published import Published
from shiftsim.report.statistics import FEW_CLUSTERS
from shiftsim.report.tables import Cell, Number, Table
from shiftsim.sim.noise import NOISE_NAMES

# the order of the paper's columns
METRICS = {
    "drivable_area_compliance": "DAC",
    "driving_direction_compliance": "DDC",
    "ego_is_comfortable": "EIC",
    "ego_is_making_progress": "EMP",
    "ego_progress_along_expert_route": "PER",
    "no_ego_at_fault_collisions": "NCR",
    "speed_limit_compliance": "SLC",
    "time_to_collision_within_bound": "TTC",
}
VAL14 = "val14"
INTERVALS = (
    "95 % CI: cluster bootstrap over recordings, 10 000 draws; it says how much the choice "
    "of scenarios matters, not the seeds"
)
PUBLISHED = "(published)"
_SETS = {"val14": "Val14", "all": "DeepPlan", "deepplan": "DeepPlan"}


def semantic_shift(
    groups: Sequence[Group],
    published: Published | None = None,
    *,
    beside: bool = False,
    allow_partial: bool = False,
) -> list[Table]:
    """Clean scores of all scenarios, per city and per metric: one table per set of scenarios.

    Args:
        groups: The groups.
        published: Figures of the paper; its sites give cities their short names and order.
        beside: Show its scores as well: in the same table where the cities are the same.
        allow_partial: Show labelled means of incomplete groups.
    """
    clean = [group for group in groups if group.noise == "none"]
    others = [group for group in clean if group.data.known != VAL14]
    val14 = [group for group in clean if group.data.known == VAL14]
    out = []
    for data in distinct_sets(others or val14):
        mine = [group for group in clean if group.data.key == data.key]
        out.append(_semantic_table(data, mine, val14, published, beside, allow_partial))
    alike = [one for one in distinct_sets(clean) if published and _is_paper_like(one, published)]
    if published is not None and beside and not alike:
        out.append(published_semantic(published))
    return out


def distinct_sets(groups: Iterable[Group]) -> list[DataSet]:
    """The data sets of groups, each once."""
    return list({group.data.key: group.data for group in groups}.values())


def _is_paper_like(data: DataSet, published: Published) -> bool:
    """Whether all cities are sites of the paper."""
    return all(published.abbreviation(city) for city in data.cities if city)


def _semantic_table(
    data: DataSet,
    groups: Sequence[Group],
    val14: Sequence[Group],
    published: Published | None,
    beside: bool,
    allow_partial: bool,
) -> Table:
    cities = _cities(data, published)
    with_val14 = bool(val14) and data.known != VAL14
    header = ["traffic", "planner"]
    if with_val14:
        header.append(val14[0].data.label)
    header += [data.label, "95 % CI", *cities.values(), *METRICS.values()]
    rows: list[tuple[Cell, ...]] = []
    paper = published if published and beside and _is_paper_like(data, published) else None
    for traffic in traffics(groups):
        mine = [group for group in groups if group.traffic == traffic]
        left = dict(paper.semantic_shift.get(traffic, {})) if paper else {}
        for group in mine:
            rows.append(_semantic_row(group, val14, with_val14, cities, allow_partial))
            if paper:
                for name in paper.planners(group.planner, left):
                    rows.append(_published_row(paper, traffic, name, header))
                    left.pop(name)
        if paper:
            rows += [_published_row(paper, traffic, name, header) for name in left]
    notes = [data.rules, *([val14[0].data.rules] if with_val14 else []), INTERVALS]
    notes += [_few_note(data), _own_list_note(data, published) if published else ""]
    notes += [f"{PUBLISHED[1:-1]}: {paper.source}"] if paper else []
    return Table(
        f"semantic-shift_{data.name}",
        f"Zero-shot generalization: {data.label}, clean, scores x 100",
        tuple(header),
        tuple(rows),
        2,
        tuple(filter(None, notes)),
    )


def traffics(groups: Iterable[Group]) -> list[str]:
    """Traffic modes: NR, R, then others."""
    found = {group.traffic for group in groups}
    return [name for name in ("NR", "R") if name in found] + sorted(found - {"NR", "R"})


def _cities(data: DataSet, published: Published | None) -> dict[str, str]:
    """Names of the columns by city, in the paper's order."""
    names = sorted({city for city in data.cities if city})
    if len(names) < 2:
        return {}
    if published is None:
        return {name: name for name in names}
    order = list(published.cities)

    def rank(name: str) -> tuple[int, str]:
        short = published.abbreviation(name)
        return (order.index(short) if short else len(order), name)

    return {name: published.abbreviation(name) or name for name in sorted(names, key=rank)}


def _semantic_row(
    group: Group,
    val14: Sequence[Group],
    with_val14: bool,
    cities: dict[str, str],
    allow_partial: bool,
) -> tuple[Cell, ...]:
    row: list[Cell] = [group.traffic, group.planner]
    if with_val14:
        same = (g for g in val14 if (g.traffic, g.planner) == (group.traffic, group.planner))
        found = next(same, None)
        row.append(None if found is None else found.estimate(allow_partial=allow_partial))
    row += [group.estimate(allow_partial=allow_partial), group.interval()]
    for city in cities:
        where = group.data.within(city)
        row.append(group.estimate("cls", where, allow_partial=allow_partial))
    row += [group.estimate(name, allow_partial=allow_partial) for name in METRICS]
    return tuple(row)


def _published_row(
    published: Published, traffic: str, planner: str, header: Sequence[str]
) -> tuple[Cell, ...]:
    """A row of the paper under the columns of an own table: `all` stands under the own set."""
    values = dict(zip(published.columns, published.semantic_shift[traffic][planner], strict=True))
    own = header.index("95 % CI") - 1
    row: list[Cell] = [traffic, f"{planner} {PUBLISHED}"]
    for index, name in enumerate(header[2:], 2):
        key = "all" if index == own else "val14" if index < own else name
        row.append(Number(values[key]) if key in values else None)
    return tuple(row)


def _few_note(data: DataSet) -> str:
    few = data.num_recordings < FEW_CLUSTERS
    return f"few recordings ({data.num_recordings}): intervals are too narrow" if few else ""


def _own_list_note(data: DataSet, published: Published) -> str:
    if data.known == VAL14:
        return ""
    if not _is_paper_like(data, published):
        return "not a set of the published benchmark"
    return (
        f"own list of {len(data.tokens)} scenarios, not the paper's: the authors' list of "
        f"{published.comparison['scenario count'][-1]} is unpublished"
    )


def published_semantic(published: Published) -> Table:
    """The paper's own table."""
    rows: list[tuple[Cell, ...]] = [
        (traffic, f"{planner} {PUBLISHED}", *map(Number, values))
        for traffic, planners in published.semantic_shift.items()
        for planner, values in planners.items()
    ]

    header = ("traffic", "planner", *(_SETS.get(name, name) for name in published.columns))
    return Table(
        "semantic-shift_published",
        "Zero-shot generalization as published",
        header,
        tuple(rows),
        2,
        (published.source, "Val14 thresholds nuplan, DeepPlan thresholds deepplan"),
    )


def noise_robustness(
    groups: Sequence[Group], published: Published | None = None, *, allow_partial: bool = False
) -> Table | None:
    """Scores by noise, mean and deviation over the seeds; None where all is clean.

    Args:
        groups: The groups.
        published: Figures of the paper, to be shown as well.
        allow_partial: Show labelled means of incomplete groups.
    """
    found = {group.noise for group in groups}
    if found <= {"none"}:
        return None
    noises = [name for name in NOISE_NAMES if name in found or published is not None]
    noises += sorted(found - set(NOISE_NAMES))
    rows: list[tuple[Cell, ...]] = []
    sets = distinct_sets(groups)
    for data in sets:
        mine = [group for group in groups if group.data.key == data.key]
        for traffic in traffics(mine):
            here = [group for group in mine if group.traffic == traffic]
            for planner in dict.fromkeys(group.planner for group in here):
                cells = {g.noise: g for g in here if g.planner == planner}
                rows.append(
                    (
                        data.label,
                        traffic,
                        planner,
                        *(
                            cells[n].estimate(allow_partial=allow_partial) if n in cells else None
                            for n in noises
                        ),
                    )
                )
    notes = [*(data.rules for data in sets), _seeds_note(groups)]
    if published is not None:
        rows += _published_robustness(published, noises)
        notes.append(f"published: {published.source}")
    return Table(
        "noise-robustness",
        "Noise robustness: CLS x 100",
        ("set", "traffic", "planner", *noises),
        tuple(rows),
        3,
        tuple(notes),
    )


def _seeds_note(groups: Sequence[Group]) -> str:
    counts = sorted({len(group.seeds) for group in groups if group.noise != "none"})
    seeds = " or ".join(map(str, counts))
    if counts == [1]:
        return "one seed: no deviation"
    return f"± sample standard deviation (n − 1) of the mean over {seeds} seeds; clean has none"


def _published_robustness(published: Published, noises: Sequence[str]) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for traffic in published.robustness:
        for name, planners in published.robustness[traffic].items():
            for planner, values in planners.items():
                cells = dict(zip(published.noises, values, strict=True))
                estimates = (_published_cell(cells.get(noise)) for noise in noises)
                rows.append((f"{_SETS[name]} {PUBLISHED}", traffic, planner, *estimates))
    return rows


def _published_cell(values: tuple[float, ...] | None) -> Estimate | None:
    if values is None:
        return None
    return Estimate(values[0], values[1] if len(values) > 1 else None, 1, 1)
