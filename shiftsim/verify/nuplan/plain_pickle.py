"""Pickles read without running anything that is in them.

Of what a pickle names only that which is known is there; something inert stands for the rest.
"""

import pickle
import zipfile
from collections.abc import Callable
from io import BytesIO
from pickletools import genops
from typing import Any

_NUMBERED = ("PUT", "LONG_BINPUT")  # a pickle's reader makes room for all up to a number
BROKEN = (  # what reading a damaged file raises
    *(ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError),
    *(pickle.UnpicklingError, zipfile.BadZipFile, EOFError, ImportError, MemoryError),
)


class Inert(dict[Any, Any]):
    """In the place of an object of a foreign class: takes everything, does nothing."""

    def __new__(cls, *_args: object, **_named: object) -> "Inert":
        """Another one, whatever it is made with."""
        return dict.__new__(cls)

    def __init__(self, *_args: object, **_named: object) -> None:
        super().__init__()

    def __call__(self, *_args: object, **_named: object) -> "Inert":
        """Another one, as what is in its place may be called."""
        return Inert()

    def _ignore(self, _anything: object) -> None:
        pass

    __setstate__ = append = extend = add = _ignore
    __hash__ = object.__hash__  # type: ignore[assignment]  # keys of a dict must be hashable
    __eq__ = object.__eq__


class PlainReader(pickle.Unpickler):
    """Reads a pickle; of what it names only that which is known is there, the rest is inert.

    Nothing that the file names is imported, and nothing is called but what is known.
    """

    def __init__(self, content: bytes, known: Callable[[str, str], Any]) -> None:
        """`known` gives what a module and a name stand for, None where they are foreign.

        Raises:
            ValueError: The pickle is cut short, or asks for memory that its size does not explain.
        """
        for operation, argument, _ in genops(content):
            if operation.name in _NUMBERED and int(argument or 0) > len(content):
                raise ValueError(f"object number {argument} in a pickle of {len(content)} bytes")
        super().__init__(BytesIO(content), encoding="utf-8")
        self.foreign: set[str] = set()
        self._known = known

    def find_class(self, module: str, name: str) -> Any:
        """What a name in the file stands for: something known, or something inert."""
        known = self._known(module, name)
        if known is None:
            self.foreign.add(f"{module}.{name}")
            return type("Inert", (Inert,), {})
        return known
