"""What the shell offers for a value of an option; nothing heavy is imported for it."""

from collections.abc import Callable, Iterable
from pathlib import Path

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
