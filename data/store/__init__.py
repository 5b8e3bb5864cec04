"""Scenario stores: Parquet files with scenarios and maps."""

from typing import Any

MOVED = {"StoreWriter": "writing", "open_store": "reading"}


def __getattr__(name: str) -> Any:
    if name not in MOVED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from shiftsim._moved import moved_name

    return moved_name(name, f"{__name__}.{MOVED[name]}")
