"""Which planner's network a set of named tensors belongs to, and what is wrong with it.

What a network wants is asked of the network itself, built without memory for its weights.
"""

import importlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, TypeAlias

from shiftsim.errors import CheckpointError
from shiftsim.planners.learned.reader import MISFIT
from shiftsim.planners.table import PUBLISHED

Shapes: TypeAlias = Mapping[str, tuple[int, ...]]

LIKENESS = 0.5  # share of equal names and shapes from which on a file is said to be of a planner
_NAMED = 3  # tensors named in a message


def network_module(planner: str) -> Any:
    """The module with a planner's network; it needs torch."""
    folder = planner.removesuffix("-planner")
    return importlib.import_module(f"shiftsim.planners.learned.{folder}.network")


def empty_state(planner: str, args: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The network's state with names, shapes and types, but without values."""
    import torch

    module = network_module(planner)
    try:
        with torch.device("meta"):
            return module.build_network(args).state_dict()
    except MISFIT as error:
        raise CheckpointError(
            f"no network of {planner} can be built from its args ({type(error).__name__}: {error})",
            hint="use the args.json that was published with the checkpoint",
        ) from error


def shapes_of(state: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Shapes by name."""
    return {name: tuple(tensor.shape) for name, tensor in state.items()}


def most_like(shapes: Shapes) -> str:
    """The planner whose network has most of these names and shapes; empty where none has half."""
    best, name = max((_likeness(shapes, planner), planner) for planner in PUBLISHED)
    return name if best >= LIKENESS else ""


def _likeness(shapes: Shapes, planner: str) -> float:
    wanted = _standard_shapes(planner)
    equal = len(shapes.items() & wanted.items())
    return equal / max(len(shapes), len(wanted))


@lru_cache
def _standard_shapes(planner: str) -> dict[str, tuple[int, ...]]:
    return shapes_of(empty_state(planner))


def differences(shapes: Shapes, wanted: Shapes) -> list[str]:
    """What keeps these tensors from being loaded into a network, in words; empty where nothing."""
    missing = [name for name in wanted if name not in shapes]
    unexpected = [name for name in shapes if name not in wanted]
    wrong = [
        f"{name} is {_dims(shapes[name])}, not {_dims(wanted[name])}"
        for name in wanted
        if name in shapes and shapes[name] != wanted[name]
    ]
    return [
        f"{len(names)} {what}: {_first_of(names)}"
        for names, what in (
            (missing, "missing"),
            (unexpected, "unexpected"),
            (wrong, "of another shape"),
        )
        if names
    ]


def _dims(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape)) or "a scalar"


def _first_of(names: Sequence[str]) -> str:
    rest = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + rest
