"""The nuplan folder: importer, planners, simulation and metrics against the official stack."""

from pathlib import Path

from shiftsim.errors import DataError
from shiftsim.verify.files import Groups
from shiftsim.verify.nuplan.logs import verify_nuplan_import
from shiftsim.verify.nuplan.metrics import verify_nuplan_metrics
from shiftsim.verify.nuplan.runs import verify_planners, verify_simulation
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes


def verify_nuplan(folder: Path, report: Report, mode: str | None = None) -> None:
    """Compare every table of the folder; of one mode only its runs, but the importer always.

    Raises:
        DataError: Traffic lights contradict themselves.
    """
    key = ("scene", "iteration", "lane_connector_id")
    lights = Groups(folder / "expected" / "traffic_lights.parquet", Report(), key)
    if any(rows.num_rows > 1 for rows in lights.values()):
        raise DataError(
            f"{folder}: not a folder of kind nuplan, a traffic light has two states at once",
            hint="shiftsim reads one state per light and iteration, the last one in the log",
        )
    scenes = Scenes(folder)
    with report.attempt("importer", folder.name):
        verify_nuplan_import(folder, report)
    for verify in (verify_planners, verify_simulation, verify_nuplan_metrics):
        with report.attempt(verify.__name__, folder.name):
            verify(folder / "expected", report, scenes, mode)
