"""Has pyarrow look for pandas when somebody imports it, not at its first array.

That takes half a second of every command where pandas is installed, which shiftsim does not use.
"""

import sys
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

import pyarrow as pa


class _Pandas:
    """Tells pyarrow of pandas when that is imported after all."""

    is_hidden = True  # while pyarrow looks for it

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> Any:
        """How pandas is imported, and pyarrow told of it; None for any other module."""
        if name != "pandas":
            return None
        if cls.is_hidden:
            raise ModuleNotFoundError("No module named 'pandas'", name=name)
        sys.meta_path.remove(cls)
        spec = find_spec("pandas")
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def exec_module(module: Any) -> None:
                execute(module)
                with suppress(ImportError):  # too old for pyarrow
                    _ = pa.lib._pandas_api.version  # looks again

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def defer_pandas() -> None:
    """From now on pyarrow imports pandas only where it must, and knows it when it is imported."""
    if "pandas" in sys.modules:
        return
    sys.meta_path.insert(0, _Pandas)
    pa.array([0])  # pyarrow looks, and finds none
    _Pandas.is_hidden = False
