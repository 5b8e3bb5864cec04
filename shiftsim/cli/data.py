"""The command that says what data is there, and what a benchmark lacks."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from shiftsim.cli import Debug, Json, plural, show

if TYPE_CHECKING:
    from shiftsim.benchmarks.stock import Missing, Stock


def data(as_json: Json = False, debug: Debug = False) -> None:
    """Stores, maps, splits and checkpoints that are there, and what each benchmark row lacks."""
    from shiftsim.benchmarks.stock import take_stock

    found = take_stock()
    show(found, _lines(found), as_json=as_json)


def _lines(found: "Stock") -> Iterator[str]:
    yield f"stores in {found['store_folder']} (SHIFTSIM_DATA)"
    for store in found["stores"]:
        if store["problem"]:
            yield f" {store['name']:18} {store['problem']}"
        for one in store["sets"]:
            label = f"   is {one['known']}" if one["known"] else ""
            yield f" {one['name']:18} {plural(one['scenarios'], 'scenario')}{label}"
        if store["maps"]:
            yield f" {'':18} maps: {', '.join(store['maps'])}"
    if not found["stores"]:
        yield " none; shiftsim demo makes one"
    yield f"checkpoints in {found['checkpoint_folder']} (SHIFTSIM_CHECKPOINTS)"
    for planner, lack in found["checkpoints"].items():
        yield f" {planner:18} {'missing' if lack else 'ready'}"
    missing: dict[str, Missing] = {}
    yield "benchmark"
    yield f" {'track':15} {'planner':18} {'Val14':16} {'own scenarios':16} planner"
    for row in found["rows"]:
        lacks = [lack["what"] for lack in row["missing"]]
        missing |= {lack["what"]: lack for lack in row["missing"]}
        ready = "missing" if f"planner {row['planner']}" in lacks else "ready"
        own = ", ".join(row["own"]) or "missing"
        reference = row["reference"] or "missing"
        yield f" {row['track']:15} {row['planner']:18} {reference:16} {own:16} {ready}"
    yield "missing" if missing else "nothing is missing"
    for what, gap in missing.items():
        yield f" {what}: {gap['get']} ({gap['page']})"
