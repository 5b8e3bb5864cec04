"""The nuplan folder: importer, planners, simulation and metrics against the official stack."""

from pathlib import Path

from shiftsim.verify.nuplan.logs import verify_nuplan_import
from shiftsim.verify.nuplan.metrics import verify_nuplan_metrics
from shiftsim.verify.nuplan.runs import verify_planners, verify_simulation
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes


def verify_nuplan(folder: Path, report: Report, mode: str | None = None) -> None:
    """Compare every table of the folder; of one mode only its runs, but the importer always."""
    scenes = Scenes(folder)
    with report.attempt("importer", folder.name):
        verify_nuplan_import(folder, report)
    for verify in (verify_planners, verify_simulation, verify_nuplan_metrics):
        with report.attempt(verify.__name__, folder.name):
            verify(folder / "expected", report, scenes, mode)
