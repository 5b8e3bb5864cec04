"""Corrected routes of the learned planners (`route_correction_*.json`)."""

import numpy as np

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.planners.routes import correction
from shiftsim.verify.files import Source
from shiftsim.verify.scenes import Scenes
from shiftsim.world.state import PACIFICA, center_poses

SQUARE = 1.0  # m, half width
NAME = "corrected route"


def _verify_routes(file: Source, scenes: Scenes) -> None:
    """Correct every route of a file again and compare."""
    scenario = scenes[str(file["scene"])]
    road, size = scenario.map, np.array([PACIFICA.length, PACIFICA.width])
    file.match(file.name, {"map": road.name}, quantity=NAME)
    for number, case in enumerate(file.each("cases")):
        where = f"{file.name} {number} ({case['case']})"
        with file.report.attempt(NAME, where):
            rear_axle = np.array(case["rear_axle"], np.float64).reshape(3)
            if case["case"] == "as_logged":
                logged = {"rear_axle": scenario.expert[0, :3], "route": list(scenario.route)}
                case.match(where, logged, 1e-8, quantity=NAME)
            blocks = correction.known_blocks(road, case["route"], "of the file", "route correction")
            footprint = boxes_to_corners(center_poses(rear_axle), size)
            start = correction.find_start(road, blocks, rear_axle, footprint)
            ours = {
                "square_1m": correction.RouteCorrector(road, blocks, SQUARE).at(rear_axle),
                "footprint": correction.correct_route(road, blocks, start),
            }
            ids = {name: [road.blocks.ids[block] for block in ours[name]] for name in ours}
            case.match(where, ids, quantity=NAME)


FILES = {"route_correction_*.json": _verify_routes}
