"""Arrays that a kernel takes as one: what Python hands over at every step."""

from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox


class Held:
    """Arrays and numbers in nested tuples, which a kernel takes as one: `contents` gives them.

    An array costs a third of a microsecond per call to hand over; this costs as much as a few. The
    arrays stay the same memory: what is written into them, kernels see. Numbers are as they were
    when it was made.
    """

    __slots__ = ("_memory", "_value", "address", "kind")

    def __init__(self, value: tuple[Any, ...]) -> None:
        """Hold what a kernel would take, arrays and numbers of eight bytes."""
        self._value = value  # keeps the arrays alive
        self._memory = np.array(list(_words(value)), np.int64)
        self.kind = _HeldType(numba.typeof(value))  # type: ignore[no-untyped-call]
        self.address = self._memory.ctypes.data

    def __reduce__(self) -> Any:
        return Held, (self._value,)  # a copy holds copies


def _words(value: Any) -> Iterator[int]:
    """What compiled code sees of a value, in words; nobody owns the arrays there."""
    if isinstance(value, tuple):
        for part in value:
            yield from _words(part)
    elif isinstance(value, np.ndarray):
        yield from (0, 0, value.size, value.itemsize, value.ctypes.data)
        yield from (*value.shape, *value.strides)
    elif isinstance(value, float):
        yield int(np.float64(value).view(np.int64))
    elif type(value) is int:
        yield value
    else:
        raise TypeError(f"cannot be held: {type(value).__name__}")


class _HeldType(numba.types.Type):
    def __init__(self, of: Any) -> None:
        super().__init__(f"Held({of})")
        self.of = of

    @property
    def key(self) -> Any:
        return self.of

    def __hash__(self) -> int:
        return hash(self.name)  # every call asks for it, and strings remember theirs


register_model(_HeldType)(models.OpaqueModel)


@typeof_impl.register(Held)
def _typeof_held(value: Held, _: Any) -> Any:
    return value.kind


@unbox(_HeldType)  # type: ignore[no-untyped-call]
def _unbox_held(_: Any, value: Any, c: Any) -> Any:
    number = c.pyapi.object_getattr_string(value, "address")
    address = c.pyapi.long_as_longlong(number)
    c.pyapi.decref(number)
    pointer = c.builder.inttoptr(address, c.pyapi.voidptr)
    return NativeValue(pointer)  # type: ignore[no-untyped-call]


def _contents(_: Any, held: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = context.get_value_type(signature.return_type).as_pointer()
        return builder.load(builder.bitcast(arguments[0], pointer))

    return held.of(held), codegen


contents: Any = intrinsic(_contents)  # in a kernel, what is held
