"""Rollouts on disk, and the task that names one.

`files` says what a row holds and how many rollouts share files; `branches` drives others from one.
"""

from pathlib import Path
from typing import NamedTuple

from shiftsim.errors import DataError


class Task(NamedTuple):
    """One rollout to be made; also its key in every table, and the order of their rows."""

    planner: str  # planner name as in tables
    noise: str  # noise name
    seed: int  # seed of the noise; 0 without noise
    token: str  # scenario

    @property
    def words(self) -> str:
        """All but the scenario, as "idm ou-high seed 1"; clean ones have no seed."""
        seed = "" if self.noise == "none" else f" seed {self.seed}"
        return f"{self.planner} {self.noise}{seed}"


def damaged(path: Path, what: str) -> DataError:
    """The error that a file of a run cannot be read."""
    return DataError(f"{str(path)!r} cannot be read: {what}", hint="make the run again")
