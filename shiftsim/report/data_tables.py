"""What the scenarios are like: own data described, and beside the published sets."""

from collections.abc import Collection, Mapping, Sequence

from shiftsim.data.store.statistics import ALL, StoreStats, store_stats
from shiftsim.errors import DataError
from shiftsim.report.groups import DataSet, Group, distinct_sets
from shiftsim.report.published import Published
from shiftsim.report.tables import Cell, Number, Table
from shiftsim.runs.results import Run
from shiftsim.runs.scenarios import open_run_store

_COLUMNS = {
    "vehicles_t0": "vehicles t0",
    "pedestrians_t0": "pedestrians t0",
    "bicycles_t0": "bicycles t0",
    "vehicles": "vehicles",
    "pedestrians": "pedestrians",
    "bicycles": "bicycles",
    "interactions": "close agents",
    "mean_speed_mps": "mean speed",
    "path_m": "path",
}


def own_statistics(groups: Sequence[Group]) -> dict[str, StoreStats | str]:
    """Statistics of every data set by its label, or why there are none."""
    runs = {group.data.key: group.run for group in reversed(groups)}
    return {data.label: _statistics(runs[data.key], data) for data in distinct_sets(groups)}


def _statistics(run: Run, data: DataSet) -> StoreStats | str:
    try:
        store = open_run_store(run)
        held = set(store.tokens)
        return store_stats(store, [token for token in data.tokens if token in held])
    except DataError as error:
        return error.message


def data_statistics(found: Mapping[str, StoreStats | str]) -> Table | None:
    """Means per scenario by city; None where no store could be read."""
    rows: list[tuple[Cell, ...]] = []
    notes = [
        "means per scenario; t0: present at iteration 0, else at any iteration; close agents: "
        "mean number near the ego's path within 3 s; m, m/s"
    ]
    for label, stats in found.items():
        if isinstance(stats, str):
            notes.append(f"{label}: {stats}")
            continue
        for city, row in stats.groups("city").items():
            numbers = (Number(row[name], 1) if name in row else None for name in _COLUMNS)
            rows.append((label, city, Number(row["scenarios"], 0), *numbers))
    if not rows:
        return None
    header = ("set", "city", "scenarios", *_COLUMNS.values())
    return Table("data-statistics", "The scenarios", header, tuple(rows), 2, tuple(notes))


def benchmark_comparison(
    published: Published, found: Mapping[str, StoreStats | str], edited: Collection[str] = ()
) -> Table:
    """The paper's comparison of benchmarks, with own sets beside; `edited` are those of edits."""
    own = {label: stats for label, stats in found.items() if isinstance(stats, StoreStats)}
    rows: list[tuple[Cell, ...]] = [
        (name, *values, *(_property(name, stats, k in edited) for k, stats in own.items()))
        for name, values in published.comparison.items()
    ]
    notes = (
        f"nuPlan, interPlan, DeepPlan: {published.source}",
        "own sets: measured from the store; interaction density: mean number of agents near "
        "the ego's path within 3 s",
        *(["edited: made of recorded scenarios, as interPlan's are"] if edited else []),
    )
    header = (
        "property",
        *published.sets,
        *(f"{label} ({_kind(label in edited)})" for label in own),
    )
    title = "Benchmarks compared"
    return Table("benchmark-comparison", title, header, tuple(rows), len(header), notes)


def _kind(is_edited: bool) -> str:
    return "own, edited" if is_edited else "own"


def _property(name: str, stats: StoreStats, is_edited: bool) -> str:
    groups = stats.groups("city")
    if name == "semantic shift" and is_edited:
        return "scenario"
    if name == "scenario count":
        return f"{groups[ALL]['scenarios']:.0f}"
    if name == "geographic coverage":
        return ", ".join(city for city in groups if city != ALL)
    if name == "interaction density":
        return f"{groups[ALL]['interactions']:.1f}"
    return "–"
