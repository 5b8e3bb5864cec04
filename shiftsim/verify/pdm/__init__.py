"""The pdm folder: PDM-Closed and nuPlan's IDM planner, from kernels to closed loops."""

from pathlib import Path

from shiftsim.errors import DataError, ShiftsimError
from shiftsim.verify.idm_calls import verify_idm_calls
from shiftsim.verify.nuplan.reading import load_scenes
from shiftsim.verify.pdm.kernels import verify_kernels
from shiftsim.verify.pdm.loops import verify_loops
from shiftsim.verify.pdm.routes import verify_routes
from shiftsim.verify.report import Report
from shiftsim.world.scenario import Scenario

_ERRORS = (ShiftsimError, OSError, KeyError, ValueError, TypeError, IndexError, AttributeError)


def verify_pdm(
    folder: Path, report: Report, *, mode: str | None = None, scenes: Path | None = None
) -> None:
    """Compare every file of the folder.

    Args:
        folder: Folder with `kernels`, `routes.json`, `idm_calls.json` and `loop`, or some of them.
        report: Filled with the comparisons.
        mode: Only closed loops of this challenge (`NR` or `R`).
        scenes: Folder with the logs and maps, by default `nuplan` beside `folder`.
    """
    source = scenes or folder.resolve().parent / "nuplan"
    known = load_scenes(source) if source.is_dir() else {}
    for path in sorted(folder.iterdir()):
        if path.name == "README.md":
            report.note("README.md: description of the folder")
        elif path.name == "kernels" and path.is_dir():
            verify_kernels(path, report)
        elif path.name not in ("routes.json", "idm_calls.json", "loop"):
            report.skip(f"file {path.name}")
        elif not known:
            report.skip(f"{path.name}: the logs and maps of the scenes are not at hand")
        else:
            _verify_with_scenes(path, report, known, source, mode)


def _verify_with_scenes(
    path: Path, report: Report, scenes: dict[str, Scenario], source: Path, mode: str | None
) -> None:
    try:
        if path.name == "routes.json":
            verify_routes(path, report, scenes)
        elif path.name == "idm_calls.json":
            verify_idm_calls(path.parent, report, scenes)
        elif path.is_dir():
            verify_loops(path, report, scenes, source, mode)
        else:
            raise DataError("it is no folder")
    except _ERRORS as error:
        report.fail(path.name, path.name, f"cannot be compared: {type(error).__name__} {error}")
