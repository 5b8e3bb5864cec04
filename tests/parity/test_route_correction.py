"""Routes as the learned planners correct them, against the official code."""

from pathlib import Path

import numpy as np
import places
import pytest
from parity_cases import Cases, Scenes, change_json, ids, name_unknown, noticed, read_file

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.planners.routes import correction
from shiftsim.world.state import PACIFICA, center_poses

pytestmark = [pytest.mark.golden, pytest.mark.reference("route_correction")]
SQUARE = 1.0  # m, half width
LOGGED = 1e-8  # m, rad


@pytest.mark.files("route_correction_*.json")
def test_corrections(path: Path, scenes: Scenes, cases: Cases) -> None:
    """Every route of a file, by what is looked for around the rear axle."""
    file = read_file(path, cases, path.stem)
    if (scene := file["scene"]) not in scenes.entries:
        cases.skip(f"{path.name}: scene {scene}, which is not at hand")
        return
    scenario, called = scenes[scene], "corrected route"
    road, size = scenario.map, np.array([PACIFICA.length, PACIFICA.width])
    file.match(file.name, {"map": road.name}, quantity=called)
    for number, case in enumerate(file.each("cases")):
        where = f"{file.name} {number} ({case['case']})"
        rear_axle = np.array(case["rear_axle"], np.float64).reshape(3)
        if case["case"] == "as_logged":
            logged = {"rear_axle": scenario.expert[0, :3], "route": scenario.route}
            case.match(where, logged, LOGGED, quantity=called)
        blocks = correction.known_blocks(road, case["route"], "of the file", "route correction")
        square = correction.RouteCorrector(road, blocks, SQUARE).at(rear_axle)
        corners = boxes_to_corners(center_poses(rear_axle), size)
        start = correction.find_start(road, blocks, rear_axle, corners)
        footprint = correction.correct_route(road, blocks, start)
        ours = {"square_1m": ids(road.blocks, square), "footprint": ids(road.blocks, footprint)}
        case.match(where, ours, quantity=called)
    file.finish()


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    name_unknown(folder, cases, "route_correction_*.json")


@pytest.mark.parametrize("name", ["square_1m", "footprint"])
def test_a_changed_route_is_noticed(name: str, tmp_path: Path, nuplan_reference: Path) -> None:
    path, cases = tmp_path / "route_correction_s04_left_turn.json", Cases()
    change_json(places.GOLDEN / "nets/route_correction" / path.name, path, "cases", 0, name)
    assert noticed(test_corrections, path, Scenes(nuplan_reference), cases)
