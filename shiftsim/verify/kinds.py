"""The kinds of reference folders, how each is recognised, and who compares it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from shiftsim.verify.report import Report

Check = Callable[[Path, Report, str | None, Path | None, Path | None], None]


@dataclass(frozen=True)
class Kind:
    """One kind of reference folder.

    Attributes:
        name: What it is called.
        signature: Glob patterns; the folder is of this kind when all of them match something.
        verify: Compares the folder: (folder, report, mode, scenes, maps).
    """

    name: str
    signature: tuple[str, ...]
    verify: Check

    def matches(self, folder: Path) -> bool:
        """Whether a folder is of this kind."""
        return all(any(folder.glob(pattern)) for pattern in self.signature)


def _nuplan(
    folder: Path, report: Report, mode: str | None, scenes: Path | None, maps: Path | None
) -> None:
    from shiftsim.verify.nuplan import verify_nuplan

    verify_nuplan(folder, report, mode)


def _nuplan_format(
    folder: Path, report: Report, mode: str | None, scenes: Path | None, maps: Path | None
) -> None:
    from shiftsim.verify.nuplan_format import verify_nuplan_format

    verify_nuplan_format(folder, report)


def _metric_worlds(
    folder: Path, report: Report, mode: str | None, scenes: Path | None, maps: Path | None
) -> None:
    from shiftsim.verify.metric_worlds import verify_metric_worlds

    verify_metric_worlds(folder, report)


def _dynamics(
    folder: Path, report: Report, mode: str | None, scenes: Path | None, maps: Path | None
) -> None:
    from shiftsim.verify.dynamics import verify_dynamics

    verify_dynamics(folder, report)


KINDS = (
    Kind("nuplan", ("scenes.json", "expected/*.parquet"), _nuplan),
    Kind("nuplan_format", ("devkit_readback.json",), _nuplan_format),
    Kind("metric_worlds", ("metric_world_*.json",), _metric_worlds),
    Kind("dynamics", ("meta.json", "*.npz"), _dynamics),
)
