"""What kernels are handed as one: the arrays and numbers that were given."""

import copy
import pickle
from typing import NamedTuple

import numpy as np
import pytest

from shiftsim.arrays import FloatArray, Held, IntArray, contents, lean_kernel


class Inner(NamedTuple):
    """Arrays of several kinds."""

    flags: np.ndarray
    table: FloatArray
    scale: float


class Outer(NamedTuple):
    """Tuples within tuples."""

    inner: Inner
    places: IntArray
    number: int


@lean_kernel
def mark(held: Held, row: int) -> float:
    """Read and write what is held."""
    outer = contents(held)
    inner = outer.inner
    total = 0.0
    for column in range(inner.table.shape[1]):
        total += inner.scale * inner.table[row, column]
        inner.table[row, column] = -1.0
    inner.flags[row] = True
    outer.places[0] += outer.number
    return total


def outer(dtype: type = np.float64) -> Outer:
    table = np.arange(12.0).reshape(4, 3).astype(dtype)
    return Outer(Inner(np.zeros(4, np.bool_), table, 0.5), np.array([5, 6]), 7)


def test_kernels_see_what_is_held_and_write_into_it() -> None:
    value = outer()
    held = Held(value)
    assert mark(held, 2) == 0.5 * (6 + 7 + 8)
    assert value.inner.table[2].tolist() == [-1, -1, -1]
    assert value.inner.table[1].tolist() == [3, 4, 5]
    assert value.inner.flags.tolist() == [False, False, True, False]
    assert value.places.tolist() == [12, 6]


def test_what_is_held_stays_alive() -> None:
    held = Held(outer())
    np.full((4, 3), 9.0)  # would take the place of arrays that are gone
    assert mark(held, 1) == 0.5 * (3 + 4 + 5)


def test_copies_hold_copies() -> None:
    value = outer()
    held = Held(value)
    for twin in (copy.deepcopy(held), pickle.loads(pickle.dumps(held))):
        assert mark(twin, 2) == 0.5 * (6 + 7 + 8)
    assert value.inner.table[2].tolist() == [6, 7, 8]
    assert mark(held, 2) == 0.5 * (6 + 7 + 8)


def test_parts_of_larger_arrays_are_seen_with_their_strides() -> None:
    wide = np.arange(24.0).reshape(4, 6)
    value = outer()
    value = value._replace(inner=value.inner._replace(table=wide[:, ::2]))
    assert mark(Held(value), 1) == 0.5 * (6 + 8 + 10)
    assert wide[1].tolist() == [-1, 7, -1, 9, -1, 11]


def test_other_types_are_other_kinds() -> None:
    assert Held(outer()).kind == Held(outer()).kind
    assert Held(outer()).kind != Held(outer(np.float32)).kind


@pytest.mark.parametrize("value", [True, "text", None, np.float32(1.0)])
def test_what_is_no_array_nor_number_of_eight_bytes_cannot_be_held(value: object) -> None:
    with pytest.raises(TypeError, match="cannot be held"):
        Held((np.zeros(3), value))
