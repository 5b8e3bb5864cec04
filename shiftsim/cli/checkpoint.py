"""Commands that look into checkpoints of learned planners, and convert them."""

from pathlib import Path
from typing import Annotated

import typer

from shiftsim.cli.common import Debug, Json, say, say_json

Source = Annotated[
    str,
    typer.Argument(
        metavar="PATH", help="File, folder that holds one, or name in SHIFTSIM_CHECKPOINTS."
    ),
]
_CHECKPOINT = typer.Typer(help="Checkpoints of learned planners: what is in one; convert it.")


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    _CHECKPOINT.command("inspect")(inspect)
    _CHECKPOINT.command("convert")(convert)
    app.add_typer(_CHECKPOINT, name="checkpoint", no_args_is_help=True)


def inspect(path: Source, as_json: Json = False, debug: Debug = False) -> None:
    """Which planner a checkpoint is for, whether it loads, its hash, and what was left out."""
    from shiftsim.planners.learned.convert import inspect_checkpoint

    found = inspect_checkpoint(path)
    if as_json:
        say_json(found.to_dict())
        return
    for line in found.lines():
        say(line)


def convert(
    path: Source,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write: ….safetensors")],
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Write the weights that the planner loads, and nothing else, to a safetensors file."""
    from shiftsim.planners.learned.convert import convert_checkpoint

    made = convert_checkpoint(path, out)
    if as_json:
        say_json(made.to_dict())
        return
    for line in made.lines():
        say(line)
