"""OpenDRIVE maps."""

from typing import Any

MOVED = {"read_opendrive": "reading"}


def __getattr__(name: str) -> Any:
    if name not in MOVED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from shiftsim._moved import moved_name

    return moved_name(name, f"{__name__}.{MOVED[name]}")
