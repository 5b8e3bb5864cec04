"""The nuplan folder: importer, planners, simulation and metrics against the official stack."""

from collections.abc import Callable
from pathlib import Path

from shiftsim.errors import ShiftsimError
from shiftsim.verify.nuplan.metrics import verify_nuplan_metrics
from shiftsim.verify.nuplan.planners import verify_planners
from shiftsim.verify.nuplan.reactive import verify_nuplan_reactive
from shiftsim.verify.nuplan.reading import load_scenes, verify_nuplan_import
from shiftsim.verify.nuplan.simulation import verify_simulation
from shiftsim.verify.report import Report


def verify_nuplan(folder: Path, report: Report, mode: str | None = None) -> None:
    """Compare every table of the folder.

    Args:
        folder: Folder with `scenes.json`, `logs`, `maps` and `expected`.
        report: Filled with the comparisons.
        mode: Only runs of this challenge (`NR`, `R`, `PT`); the importer is compared always.
    """
    scenes = load_scenes(folder)
    maps = {scene.city: scene.map for scene in scenes.values()}
    parts: dict[str, Callable[[], None]] = {
        "importer": lambda: verify_nuplan_import(folder, report),
        "planners": lambda: verify_planners(folder, report, scenes, mode),
        "reactive traffic": lambda: verify_nuplan_reactive(folder, report, scenes),
        "simulation": lambda: verify_simulation(folder, report, scenes, mode),
        "metrics": lambda: verify_nuplan_metrics(folder, report, maps, mode),
    }
    if mode not in (None, "R"):
        del parts["reactive traffic"]
    for name, verify in parts.items():
        try:
            verify()
        except ShiftsimError as error:  # nuPlan got through, so this is a difference
            report.fail(name, str(folder), str(error))
