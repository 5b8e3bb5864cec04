"""Commands that work on a whole store: filter, stats, export nuplan."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shiftsim.cli.common import Debug, Json, Quiet, plural, progress_bar, say, say_json
from shiftsim.cli.running import Workers, worker_count

if TYPE_CHECKING:
    from shiftsim.filtering import Verdicts

_EXPORT = typer.Typer(help="Write scenarios in the formats of others.")
_PARTIAL = 3

Store = Annotated[str, typer.Argument(metavar="STORE", help="Store, by name or folder.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("filter")(filter_scenarios)


def filter_scenarios(
    store: Store,
    min_path: Annotated[float | None, typer.Option(help="Shortest path [m]. [5]")] = None,
    min_progress: Annotated[
        float | None, typer.Option(help="Least share of it along the route. [0.5]")
    ] = None,
    thresholds: Annotated[
        str | None, typer.Option(help="nuplan or deepplan. [deepplan]", show_default=False)
    ] = None,
    workers: Workers = None,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Drive every scenario as recorded; drop those with a collision, off the road or standing.

    Dropped scenarios stay in the store and are listed; runs over the whole store leave them out.
    An interrupted filter goes on when it is started again.
    """
    from shiftsim.filtering import FilterConfig, filter_store
    from shiftsim.runner import open_named_store

    given: dict[str, Any] = {
        "thresholds": thresholds,
        "min_path_m": min_path,
        "min_progress_share": min_progress,
    }
    config = FilterConfig(**{name: value for name, value in given.items() if value is not None})
    folder = open_named_store(store).path
    with progress_bar(quiet=quiet or as_json) as advance:
        found = filter_store(
            folder,
            config,
            workers=worker_count(workers),
            on_progress=lambda done, total: advance(done, total, ""),
        )
    if as_json:
        say_json({"config": found.config, "counts": found.counts(), "verdicts": found.rows})
    else:
        _show_verdicts(found, thresholds=config.thresholds)
    if found.counts()["failed"]:
        raise typer.Exit(_PARTIAL)


def _show_verdicts(found: "Verdicts", *, thresholds: str) -> None:
    for row in found.rejected:
        details = [f"{row[n]:.1f} m {what}" for n, what in _DETAILS.items() if row[n] is not None]
        if row["partner_token"] is not None:
            details.insert(0, f"track {row['partner_token']} at {row['first_violation_s']:.1f} s")
        tail = f"  ({', '.join(details)})" if details else ""
        say(f" {row['verdict']}: {row['token']}  {row['reason']}{tail}")
    counts = found.counts()
    say(
        f" {counts['accepted']} of {plural(len(found.rows), 'scenario')} accepted, "
        f"{counts['dropped']} dropped, {counts['failed']} failed"
        f"   thresholds {thresholds} → {found.path}"
    )


_DETAILS = {"path_m": "path", "progress_m": "along the route", "max_outside_m": "off the road"}
