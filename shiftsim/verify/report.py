"""Collects the comparisons of one verification and prints them.

A *case* is one compared quantity of one thing (an array of one run, say). Everything in a reference
folder is compared, or named: as not covered (counts against `--require-all`) or as informative (a
label, or a value that need not be compared).
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike

from shiftsim.errors import ShiftsimError

ERRORS = (  # what may be raised by content that has not the form of the reference
    *(ShiftsimError, OSError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError),
    shapely.errors.ShapelyError,
)


@dataclass
class Quantity:
    """Tally of one quantity over all cases."""

    cases: int = 0
    mismatches: int = 0
    max_error: float = 0.0
    tolerance: float = 0.0


@dataclass
class Report:
    """All comparisons so far.

    Attributes:
        quantities: Tally by quantity, in the order of first appearance.
        mismatches: One line per case that differs.
        not_covered: Count by description of what should be compared and was not.
        informative: Descriptions of what need not be compared.
        remarks: What else the reader should know of the content.
    """

    quantities: dict[str, Quantity] = field(default_factory=dict)
    mismatches: list[str] = field(default_factory=list)
    not_covered: dict[str, int] = field(default_factory=dict)
    informative: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def compare(
        self,
        quantity: str,
        where: str,
        actual: object,
        expected: object,
        *,
        atol: ArrayLike = 0.0,
        angle: bool = False,
    ) -> bool:
        """Compare one case; returns whether ours is as expected.

        Values are scalars, strings, arrays or lists, also of lists of several lengths. NaN (None in
        references) equals NaN, infinities must agree, other shapes differ; `angle`s [rad] are equal
        up to whole turns. `atol`, of all values or of each, is the absolute tolerance of floats:
        strings, booleans and integers are compared exactly.
        """
        tally = self.quantities.setdefault(quantity, Quantity())
        tally.tolerance = max(tally.tolerance, float(np.max(atol, initial=0.0)))
        ours, theirs = _array(actual), _array(expected)
        if ours.shape != theirs.shape:
            return self.fail(quantity, where, f"shape {ours.shape}, not {theirs.shape}")
        if ours.dtype.kind == "f" and theirs.dtype.kind == "O":
            with suppress(TypeError, ValueError):  # not numbers
                theirs = theirs.astype(np.float64)
        kinds = {ours.dtype.kind, theirs.dtype.kind}
        if kinds <= set("fiub") and "f" in kinds:
            error = _errors(ours.astype(np.float64), theirs.astype(np.float64), angle)
            tally.max_error = max(tally.max_error, float(error.max(initial=0.0)))
            bad = np.atleast_1d(error > np.asarray(atol))
        else:
            bad = np.atleast_1d(ours != theirs)
        if bad.any():
            first = tuple(np.argwhere(bad)[0].tolist())
            got, want = (np.asarray(np.atleast_1d(x)[first]).tolist() for x in (ours, theirs))
            at = f" at {', '.join(map(str, first))}" if ours.ndim else ""
            count = f" ({int(bad.sum())} of {bad.size} values)" if bad.size > 1 else ""
            return self.fail(quantity, where, f"{got!r}, not {want!r}{at}{count}")
        tally.cases += 1
        return True

    def fail(self, quantity: str, where: str, why: str) -> bool:
        """Count one case as differing; False."""
        tally = self.quantities.setdefault(quantity, Quantity())
        tally.cases += 1
        tally.mismatches += 1
        self.mismatches.append(f"{quantity}: {where}: {why}")
        return False

    @contextmanager
    def attempt(self, quantity: str, where: str) -> Iterator[None]:
        """Count one case as differing where the block raises any of `ERRORS`."""
        try:
            yield
        except ERRORS as error:
            self.fail(quantity, where, f"cannot be compared: {type(error).__name__}: {error}")

    def skip(self, what: str, count: int = 1) -> None:
        """Name something that should be compared and is not."""
        self.not_covered[what] = self.not_covered.get(what, 0) + count

    def note(self, what: str) -> None:
        """Name something that need not be compared."""
        if what not in self.informative:
            self.informative.append(what)

    @property
    def num_cases(self) -> int:
        """Cases compared."""
        return sum(tally.cases for tally in self.quantities.values())

    def lines(self, max_mismatches: int = 50) -> list[str]:
        """The report as text; the last line is the summary."""
        more, skipped = len(self.mismatches) - max_mismatches, sum(self.not_covered.values())
        return [
            *(
                f"{name}: {tally.cases - tally.mismatches}/{tally.cases} equal, "
                f"max |Δ| {tally.max_error:.3g} (tolerance {tally.tolerance:.3g})"
                for name, tally in self.quantities.items()
            ),
            *self.remarks,
            *(f"not compared: {what}" for what in self.informative),
            *(f"not covered: {what} ({count})" for what, count in self.not_covered.items()),
            *(f"MISMATCH {line}" for line in self.mismatches[:max_mismatches]),
            *([f"… and {more} more mismatches"] if more > 0 else []),
            f"{self.num_cases} cases covered, {len(self.mismatches)} mismatches, "
            f"{skipped} not covered",
        ]

    def exit_code(self, *, require_all: bool = False) -> int:
        """0 all equal, 1 a mismatch, 2 nothing covered, 3 not all covered and all required."""
        if self.mismatches:
            return 1
        if self.num_cases == 0:
            return 2
        return 3 if require_all and self.not_covered else 0


def _errors(ours: np.ndarray, theirs: np.ndarray, angle: bool) -> np.ndarray:
    """Distances of floats; 0 between NaNs, infinite between a NaN and a number."""
    with np.errstate(invalid="ignore"):
        gap = ours - theirs
        gap = np.abs((gap + np.pi) % (2.0 * np.pi) - np.pi) if angle else np.abs(gap)
    same = (ours == theirs) | (np.isnan(ours) & np.isnan(theirs))
    return np.where(same, 0.0, np.where(np.isnan(gap), np.inf, gap))


def _array(value: Any) -> np.ndarray[Any, Any]:
    try:
        return np.asarray(value)
    except ValueError:  # lists of several lengths
        return np.fromiter(value, np.object_, len(value))
