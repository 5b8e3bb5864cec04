"""Runs made of other runs: `score`, `merge`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from shiftsim import cli
from shiftsim.cli import Debug, Json, Quiet, output_kept, progress_bar
from shiftsim.cli.running import leave_with


@cli.with_settings(
    "thresholds",
    "metrics",
    "store",
    "out",
    "workers",
    "allow_partial",
    store="Store. [the one of the run]",
)
def score(
    source: Annotated[Path, typer.Argument(metavar="RUN", help="A run with stored rollouts.")],
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Score stored rollouts again, under another threshold profile, without simulating."""
    from shiftsim.runs.derive import rescore
    from shiftsim.runs.results import open_run

    run = open_run(source)
    allow_partial = settings.pop("allow_partial", False)
    with output_kept(), progress_bar(quiet=quiet or as_json) as advance:
        finished = rescore(
            run,
            **{"thresholds": run.manifest["config"]["thresholds"], **settings},
            on_progress=lambda progress: advance(progress.done, progress.total, ""),
            argv=sys.argv,
        )
    leave_with(finished, allow_partial=allow_partial, as_json=as_json)


def merge(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN…", help="The shards of one run.")],
    out: Annotated[
        str | None, typer.Option(help="Run folder. [that of the shards without number]")
    ] = None,
    allow_partial: Annotated[
        bool, typer.Option("--allow-partial", help="Accept missing shards; labelled so.")
    ] = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Join runs made with --shard: the same tables as without."""
    from shiftsim.runs.derive import merge_runs
    from shiftsim.runs.results import open_run

    merged = merge_runs([open_run(path) for path in runs], out=out, allow_partial=allow_partial)
    leave_with(merged, allow_partial=allow_partial, as_json=as_json)
