"""Values of options: what the shell offers, and what is made of what was typed.

Nothing heavy is imported for either.
"""

import os
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, get_args

import typer

NOISES = ("none", "awgn-low", "awgn-mid", "awgn-high", "ou-low", "ou-mid", "ou-high", "all")
Complete = Callable[[typer.Context, str], list[str]]


def among(*choices: str) -> Complete:
    """Offers those of a few values that begin with what is typed."""
    return lambda ctx, incomplete: _beginning(incomplete, choices)


def planners(ctx: typer.Context, incomplete: str) -> list[str]:
    """Planners that come with shiftsim."""
    from shiftsim.planners.table import PLANNERS

    return _beginning(incomplete, PLANNERS)


def stores(ctx: typer.Context, incomplete: str) -> list[str]:
    """Stores below `SHIFTSIM_DATA`, and those in the current folder."""
    from shiftsim.files import store_path

    found = [*store_path("any").parent.glob("*/store.json"), *Path().glob("*/store.json")]
    return _beginning(incomplete, (path.parent.name for path in found))


def splits(ctx: typer.Context, incomplete: str) -> list[str]:
    """Splits of the store that is named on the line, and files in the current folder."""
    from shiftsim.files import store_path
    from shiftsim.runs.config import DEFAULT_STORE

    folder = store_path(ctx.params.get("store") or DEFAULT_STORE)
    own = (path.stem for path in (folder / "splits").glob("*.toml"))
    files = (path.name for path in Path().glob("*.t[ox][mt]*") if path.suffix in (".toml", ".txt"))
    return _beginning(incomplete, (folder.name, *own, *files))


def checkpoints(ctx: typer.Context, incomplete: str) -> list[str]:
    """`official` and `shiftsim`, weights in the folder of checkpoints, and files."""
    from shiftsim.files import checkpoint_folder

    names = (path.name for path in checkpoint_folder().glob("*"))
    files = (
        path.name for kind in ("pth", "ckpt", "safetensors") for path in Path().glob(f"*.{kind}")
    )
    return _beginning(incomplete, ("official", "shiftsim", *names, *files))


def _beginning(incomplete: str, choices: Iterable[str]) -> list[str]:
    return sorted({choice for choice in choices if choice.startswith(incomplete)})


# by setting of a run; those with fixed choices offer them anyway
BY_SETTING: dict[str, Complete] = {
    "planners": planners,
    "noise": among(*NOISES),
    "store": stores,
    "split": splits,
    "checkpoints": checkpoints,
    "traffic": among("nonreactive", "reactive", "constant-velocity"),
    "thresholds": among("nuplan", "deepplan"),
}


def with_plain_values(command: Any) -> Any:
    """A command, or several, whose options make texts and numbers of what was typed themselves."""
    all_options = command.get_params

    def get_params(context: Any) -> list[Any]:
        options: list[Any] = all_options(context)
        for option in options:
            if "process_value" not in vars(option):
                option.process_value = partial(_plain_value, option, option.process_value)
        return options

    command.get_params = get_params
    for inner in getattr(command, "commands", {}).values():
        with_plain_values(inner)
    return command


def _plain_value(option: Any, convert: Callable[[Any, Any], Any], context: Any, value: Any) -> Any:
    """What an option gets, without typer where that is plain.

    Newer versions of typer have pydantic look at every value, even where none was given, and to
    import pydantic is a tenth of a short command.
    """
    about = getattr(option, "type_descriptor", None)  # of older versions of typer none
    if about is None or about.is_ranged:
        return convert(context, value)
    if value is None and not option.required:
        nothing = () if option.multiple or option.nargs == -1 else None
        return option.callback(context, option, nothing) if option.callback else nothing
    make = _MAKE.get(get_args(about.annotation)[0] if about.is_list else about.annotation)
    if make is not None and value is not None and option.callback is None:
        try:
            return [make(item) for item in value] if about.is_list else make(value)
        except ValueError:
            pass  # typer says what is wrong with it
    return convert(context, value)


def _readable(path: str | Path) -> Path:
    if os.path.exists(path) and not os.access(path, os.R_OK):
        raise ValueError(path)
    return Path(path)


_MAKE: dict[Any, Callable[[Any], Any]] = {str: str, int: int, float: float, Path: _readable}
