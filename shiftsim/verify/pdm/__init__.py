"""The pdm folder: PDM-Closed and nuPlan's IDM planner, from kernels to closed loops."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from shiftsim.verify.calls import verify_idm_calls, verify_routes
from shiftsim.verify.files import verify_files
from shiftsim.verify.nuplan.metrics import verify_nuplan_metrics
from shiftsim.verify.nuplan.runs import verify_simulation
from shiftsim.verify.pdm.kernels import verify_kernels
from shiftsim.verify.pdm.steps import verify_calls
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes


def verify_pdm(
    folder: Path, report: Report, *, mode: str | None = None, scenes: Path | None = None
) -> None:
    """Compare every file of the folder; arguments as for `shiftsim.verify.verify`."""
    known = Scenes(scenes or folder.resolve().parent / "nuplan")
    parts: dict[str, Callable[[Path], object]] = {
        "routes.json": partial(verify_routes, report=report, scenes=known),
        "idm_calls.json": partial(verify_idm_calls, report=report, scenes=known),
        "loop": partial(_verify_loops, report=report, scenes=known, mode=mode),
    }
    if not known:
        lack = "the logs and maps of the scenes are not at hand"
        parts = dict.fromkeys(parts, lambda path: report.skip(f"{path.name}: {lack}"))
    kernels = partial(verify_kernels, report=report)
    verify_files(folder, report, {"kernels": kernels, **parts})


def _verify_loops(folder: Path, report: Report, scenes: Scenes, mode: str | None) -> None:
    """Compare every run (of one mode) of the `loop` folder: its calls, then driven freely."""
    verify_calls(folder, report, scenes, mode)
    logged = scenes.folder / "expected"
    verify_nuplan_metrics(folder, report, scenes, mode, logged=logged)
    verify_simulation(folder, report, scenes, mode, logged=logged)
