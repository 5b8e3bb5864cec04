"""Readers, converters and the scenario store: recordings and maps in, scenarios out."""

from pathlib import Path
from typing import TYPE_CHECKING

from shiftsim.errors import DataError
from shiftsim.files import DEFAULT_STORE, store_path

if TYPE_CHECKING:
    from shiftsim.data.store.reading import ScenarioStore


def open_store(name: str | Path) -> "ScenarioStore":
    """A store by name, path or URL; the demo store is made when it is not there yet.

    Raises:
        DataError: It is not there, damaged or of another version.

    Example:
        ```python
        store = shiftsim.open_store("demo")
        scenario = store["01f13e"]  # a token, or its beginning
        print(len(store), store.cities, scenario)
        ```
    """
    from shiftsim.data.store import reading

    if "://" in str(name):
        return reading.open_store(name)
    path = store_path(str(name))
    if name == DEFAULT_STORE and not path.exists():
        from shiftsim.data.synthetic.store import demo_store

        path = demo_store(path)
    if not path.exists():
        known = sorted(found.name for found in path.parent.glob("*") if found.is_dir())
        raise DataError(
            f"no store {str(name)!r} at {str(path)!r}",
            hint=f"there are: {', '.join(known)}" if known else "make one with `shiftsim convert`",
        )
    return reading.open_store(path)


if __name__ == "data":  # pragma: no cover
    raise ImportError("import it as shiftsim.data")
