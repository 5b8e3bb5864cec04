"""The nuplan folder: importer, planners, simulation and metrics against the official stack."""

from pathlib import Path

from shiftsim.verify.nuplan_import import load_scenes, verify_nuplan_import
from shiftsim.verify.nuplan_metrics import verify_nuplan_metrics
from shiftsim.verify.nuplan_planners import verify_planners
from shiftsim.verify.nuplan_reactive import verify_nuplan_reactive
from shiftsim.verify.nuplan_simulation import verify_simulation
from shiftsim.verify.report import Report


def verify_nuplan(folder: Path, report: Report, mode: str | None = None) -> None:
    """Compare every table of the folder.

    Args:
        folder: Folder with `scenes.json`, `logs`, `maps` and `expected`.
        report: Filled with the comparisons.
        mode: Only runs of this challenge (`NR`, `R`, `PT`); the importer is compared always.
    """
    scenes = load_scenes(folder)
    verify_nuplan_import(folder, report)
    verify_planners(folder, report, scenes, mode)
    if mode in (None, "R"):
        verify_nuplan_reactive(folder, report, scenes)
    verify_simulation(folder, report, scenes, mode)
    verify_nuplan_metrics(folder, report, {s.city: s.map for s in scenes.values()}, mode)
