"""Files of a training: its state, and the networks that come out of it."""

from pathlib import Path
from typing import Any

import torch

from shiftsim.errors import CheckpointError
from shiftsim.files import whole_file
from shiftsim.train.learning import State


def read_state(path: Path) -> dict[str, Any]:
    """What a training kept.

    Raises:
        CheckpointError: The file is damaged.
    """
    try:
        kept: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise CheckpointError(
            f"{str(path)!r} cannot be read: {error}", hint="delete it to begin again"
        ) from error
    return kept


def write_state(path: Path, state: dict[str, Any]) -> None:
    """Keep what a training needs to go on."""
    with whole_file(path) as partial:
        torch.save(state, partial)


def write_network(path: Path, state: State) -> None:
    """Write a network as `--checkpoint carl=PATH` reads it."""
    from safetensors.torch import save_file

    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    with whole_file(path) as partial:
        save_file(tensors, partial, {"planner": "carl"})
