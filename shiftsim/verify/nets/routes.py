"""Corrected routes of the learned planners (`route_correction_*.json`)."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.planners.routes.correction import (
    RouteCorrector,
    correct_route,
    find_start,
    known_blocks,
)
from shiftsim.verify.nets.common import ERRORS, Scenes
from shiftsim.verify.nuplan.reading import read_json
from shiftsim.verify.report import Report
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, center_poses

SQUARE = 1.0  # m, half width
_CASE = {"case", "rear_axle", "route"}
_RESULTS = ("square_1m", "footprint")


def verify_routes(folder: Path, report: Report, scenes: Scenes) -> None:
    """Correct every route again and compare.

    Args:
        folder: Folder of the files.
        report: Receives the comparisons.
        scenes: The scenes; cases of other scenes are named as not covered.
    """
    for path in sorted(folder.iterdir()):
        if path.suffix == ".md":
            report.note(f"route_correction/{path.name}: description of the folder")
        elif not (path.name.startswith("route_correction_") and path.suffix == ".json"):
            report.skip(f"file route_correction/{path.name}")
        else:
            try:
                _verify_file(path, report, scenes)
            except ERRORS as error:
                report.fail("corrected route", path.name, f"cannot be compared: {error!r}")


def _verify_file(path: Path, report: Report, scenes: Scenes) -> None:
    content = read_json(path)
    scene, cases = str(content["scene"]), content["cases"]
    for extra in sorted(set(content) - {"scene", "map", "cases"}):
        report.skip(f"{path.name}: field {extra!r}")
    if scene not in scenes:
        report.skip(f"{path.name}: scene {scene}, which is not at hand", len(cases))
        return
    scenario = scenes[scene]
    report.compare("corrected route map", path.name, scenario.map.name, content["map"])
    for number, case in enumerate(cases):
        where = f"{path.name} {number} ({case.get('case')})"
        for extra in sorted(set(case) - _CASE - set(_RESULTS)):
            report.skip(f"{path.name}: field {extra!r} of a case")
        try:
            _verify_case(case, where, report, scenario)
        except ERRORS as error:
            report.fail("corrected route", where, f"cannot be compared: {error!r}")


def _verify_case(case: dict[str, Any], where: str, report: Report, scenario: Scenario) -> None:
    rear_axle = np.array(case["rear_axle"], np.float64)
    if rear_axle.shape != (3,):
        raise DataError("the rear axle is not x, y, heading")
    if case["case"] == "as_logged":
        logged = scenario.expert[0, :3]
        report.compare("corrected route pose", where, logged, rear_axle, atol=1e-8)
        report.compare("corrected route input", where, list(scenario.route), case["route"])
    ours = corrected(scenario.map, case["route"], rear_axle)
    for name in _RESULTS:
        if name in case:
            report.compare(f"corrected route {name}", where, ours[name], case[name])
        else:
            report.fail(f"corrected route {name}", where, f"no field {name!r}")


def corrected(road: VectorMap, route: list[str], rear_axle: np.ndarray) -> dict[str, list[str]]:
    """A route corrected in every way that the files hold."""
    blocks = known_blocks(road, route, "of the file", "route correction")
    size = np.array([PACIFICA.length, PACIFICA.width])
    footprint = boxes_to_corners(center_poses(rear_axle), size)
    results = {
        "square_1m": RouteCorrector(road, blocks, SQUARE).at(rear_axle),
        "footprint": correct_route(road, blocks, find_start(road, blocks, rear_axle, footprint)),
    }
    return {name: [road.blocks.ids[b] for b in found] for name, found in results.items()}
