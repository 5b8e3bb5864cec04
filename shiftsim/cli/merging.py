"""The command that joins the shards of a run."""

from pathlib import Path
from typing import Annotated

import typer

from shiftsim.cli.common import Debug, Json


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
    from shiftsim.cli.running import leave_with
    from shiftsim.runs.merge import merge_runs
    from shiftsim.runs.results import open_run

    merged = merge_runs(
        [open_run(path) for path in runs],
        out=out,
        allow_partial=allow_partial,
    )
    leave_with(merged, allow_partial=allow_partial, as_json=as_json)
