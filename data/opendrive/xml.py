"""Numbers and counts from the XML of an OpenDRIVE file."""

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.errors import ConversionError

CUBIC = ("a", "b", "c", "d")
_LEADING_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)")


@dataclass
class Reader:
    """Reads attributes of one file and keeps count of what was wrong.

    Attributes:
        source: Name of the file.
        place: Road or junction at hand, for messages.
        warnings: Count by kind.
        counts: Records by kind.
    """

    source: str
    place: str = "header"
    warnings: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)

    def error(self, what: str, mend: str) -> ConversionError:
        """An error that names file and place."""
        return ConversionError(f"{self.source}, {self.place}: {what}", mend)

    def warn(self, kind: str) -> None:
        """Count one thing that was mended or left out."""
        self.warnings[kind] += 1

    def number(self, element: Any, name: str, default: float = 0.0) -> float:
        """An attribute as a number; may be NaN or infinite where the file says so."""
        text = element.get(name)
        if text is None:
            return default
        try:
            return float(text)
        except ValueError:
            return self._rescue(element, name, text)

    def _rescue(self, element: Any, name: str, text: str) -> float:
        found = _LEADING_NUMBER.match(text.replace(",", ".", 1))
        if found is None:
            raise self.error(
                f"{element.tag} (line {element.sourceline}) has {name}={text[:40]!r}",
                "write a number with a decimal point there",
            )
        self.warn("badly written number")
        return float(found[1])

    def integer(self, element: Any, name: str) -> int | None:
        """An attribute as an integer; None where it is missing or not one."""
        try:
            return int(element.get(name))
        except (TypeError, ValueError):
            return None

    def cubics(self, elements: list[Any], key: str) -> FloatArray:
        """(n, 5) rows s, a, b, c, d by s; records with NaN or infinity are left out."""
        rows = np.array(
            [[self.number(e, key), *(self.number(e, k) for k in CUBIC)] for e in elements],
            np.float64,
        ).reshape(-1, 5)
        finite = np.isfinite(rows).all(axis=1)
        if not finite.all():
            self.warnings["polynomial record that is not finite, left out"] += int((~finite).sum())
            rows = rows[finite]
        if len(rows) > 1 and (np.diff(rows[:, 0]) < 0).any():
            self.warn("records out of order")
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
        return rows
