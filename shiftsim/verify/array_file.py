"""One npz file of a reference folder, which knows what of it was used."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from shiftsim.errors import DataError
from shiftsim.verify.report import Report

EXACT = 0.0
TOLERANCE = 1e-9  # of floats, unless a comparison names another
PER_FILE = ("_columns", "_order", "_ptr")  # endings of arrays that do not have one row per case


class ArrayFile:
    """The arrays of one file, and which of them were used.

    Attributes:
        name: Name of the file without its ending.
        report: Receives the comparisons.
        arrays: All arrays by name.
        used: Names of the arrays that were read or noted.
    """

    def __init__(self, path: Path, report: Report) -> None:
        self.name = path.stem
        self.report = report
        with np.load(path, allow_pickle=False) as archive:
            self.arrays = {name: archive[name] for name in archive.files}
        self.used: set[str] = set()

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.arrays:
            raise DataError(f"array {name!r} is missing")
        self.used.add(name)
        return self.arrays[name]

    def take(self, name: str, *shape: int) -> np.ndarray:
        """An array of a given shape, contiguous; -1 is any length."""
        array = np.ascontiguousarray(self[name])
        fits = array.ndim == len(shape) and all(
            wanted in (-1, size) for wanted, size in zip(shape, array.shape, strict=True)
        )
        if not fits:
            raise DataError(f"array {name!r} has shape {array.shape}, not {shape}")
        return array

    def num_cases(self, *ragged: str) -> int:
        """Number of cases; every array has one row for each, except those with a ragged prefix."""
        count = len(self["case"])
        prefixes = tuple(f"{prefix}_" for prefix in ragged)
        for name, array in self.arrays.items():
            if name.endswith(PER_FILE) or name.startswith(prefixes):
                continue
            if len(np.atleast_1d(array)) != count:
                raise DataError(f"array {name!r} has shape {array.shape}, not {count} rows")
        return count

    def slices(self, prefix: str) -> Iterator[slice]:
        """Slice of each case in the ragged arrays `<prefix>_*`, which `<prefix>_ptr` delimits."""
        ends = self.take(f"{prefix}_ptr", len(self["case"]) + 1)
        for name, array in self.arrays.items():
            if name.startswith(f"{prefix}_") and not name.endswith(PER_FILE):
                if ends[0] != 0 or ends[-1] != len(array) or (np.diff(ends) < 0).any():
                    raise DataError(f"array '{prefix}_ptr' does not divide {name!r} into cases")
        return (slice(int(first), int(last)) for first, last in pairwise(ends))

    def compare(
        self, quantity: str, case: int, actual: object, expected: object, atol: float = TOLERANCE
    ) -> None:
        """Compare one case of this file."""
        where = f"case {case}"
        self.report.compare(f"{self.name} {quantity}", where, actual, expected, atol=atol)

    def columns(self, array: str, expected: tuple[str, ...]) -> None:
        """Compare the stored names of columns."""
        names = [str(name) for name in self[array]]
        self.report.compare(f"{self.name} {array}", "file", names, list(expected))

    def note(self, what: str, *arrays: str) -> None:
        """Name values that need not be compared."""
        self.used.update(arrays)
        self.report.note(f"{self.name} {', '.join(arrays)}{': ' if arrays else ''}{what}")

    def finish(self) -> None:
        """Name the arrays that nothing used."""
        for name in self.arrays:
            if name not in self.used:
                self.report.skip(f"{self.name}: array {name!r}")
