"""The pdm folder: PDM-Closed and nuPlan's IDM planner, from kernels to closed loops."""

from pathlib import Path

from shiftsim.verify.files import verify_files
from shiftsim.verify.pdm.idm_calls import verify_idm_calls
from shiftsim.verify.pdm.kernels import verify_kernels
from shiftsim.verify.pdm.loops import verify_loops
from shiftsim.verify.pdm.routes import verify_routes
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes


def verify_pdm(
    folder: Path, report: Report, *, mode: str | None = None, scenes: Path | None = None
) -> None:
    """Compare every file of the folder; arguments as for `shiftsim.verify.verify`."""
    known = Scenes(scenes or folder.resolve().parent / "nuplan")

    def with_scenes(path: Path) -> None:
        if not known:
            report.skip(f"{path.name}: the logs and maps of the scenes are not at hand")
        elif path.name == "routes.json":
            verify_routes(path, report, known)
        elif path.name == "idm_calls.json":
            verify_idm_calls(path, report, known)
        else:
            verify_loops(path, report, known, mode)

    parts = dict.fromkeys(("routes.json", "idm_calls.json", "loop"), with_scenes)
    verify_files(folder, report, {"kernels": lambda path: verify_kernels(path, report), **parts})
