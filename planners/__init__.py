"""Planners by name; see `registry`."""

from typing import Any

MOVED = {"load_planner": "registry"}


def __getattr__(name: str) -> Any:
    if name not in MOVED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from shiftsim._moved import moved_name

    return moved_name(name, f"{__name__}.{MOVED[name]}")


if __name__ == "planners":  # pragma: no cover
    raise ImportError("import it as shiftsim.planners")
