"""What is found out about a table of tracks: errors and warnings, each with a remedy."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from shiftsim.kernels import FloatArray

FAST = 2.0  # m/s, above which a direction of motion is sure


class Finding(NamedTuple):
    """Something that is wrong, or unusual, with a table."""

    what: str  # value and limit
    remedy: str


@dataclass
class Diagnostics:
    """What was found out about a table."""

    errors: list[Finding] = field(default_factory=list)  # what cannot be right
    warnings: list[Finding] = field(default_factory=list)  # what is unusual
    figures: dict[str, float] = field(default_factory=dict)  # numbers behind it

    def error(self, what: str, remedy: str) -> None:
        """Add something that cannot be right."""
        self.errors.append(Finding(what, remedy))

    def warn(self, what: str, remedy: str) -> None:
        """Add something that is unusual."""
        self.warnings.append(Finding(what, remedy))


def best_guess(
    guesses: Mapping[str, FloatArray], errors_of: Callable[[FloatArray], FloatArray]
) -> tuple[str, dict[str, float]]:
    """The guess whose values have the least median error, and that error of every guess."""
    errors = {guess: float(np.median(errors_of(values))) for guess, values in guesses.items()}
    return min(errors, key=lambda guess: errors[guess]), errors
