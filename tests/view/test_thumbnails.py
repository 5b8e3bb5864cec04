"""Thumbnails: turned to the direction of travel, in whole units, a few hundred bytes."""

import re
from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario

from shiftsim.view.thumbnails import ASPECT, thumbnails
from shiftsim.world.layers import make_layer


@pytest.fixture(scope="module")
def scenario():
    return cruise_scenario(iterations=100)


def numbers(path):
    return [int(text) for text in re.findall(r"-?\d+", path)]


def test_the_recorded_ego_goes_from_the_origin_to_the_right(scenario):
    expert = scenario.expert[:, :2]

    found = thumbnails(scenario, {"same": (expert, None)})["same"]

    length = np.hypot(*(expert[-1] - expert[0]))
    assert numbers(found["scene"][1]) == pytest.approx([0, 0, 2.0 * length, 0], abs=1)
    assert found["path"] == found["scene"][1]
    assert found["mark"] is None


def test_a_path_to_the_left_goes_up_and_its_mark_lies_on_it(scenario):
    left = scenario.expert[:, :2] + np.array([0.0, 10.0])

    found = thumbnails(scenario, {"left": (left, len(left) - 1)})["left"]

    assert numbers(found["path"])[:2] == [0, -20]
    assert found["mark"][1] == -20


def test_each_window_holds_its_path_and_the_road_is_shared(scenario):
    expert = scenario.expert[:, :2]
    far = expert + np.linspace(0.0, 60.0, len(expert))[:, None] * [0.0, 1.0]

    found = thumbnails(scenario, {"near": (expert, None), "far": (far, None)})

    assert found["near"]["scene"] is found["far"]["scene"]
    near, wide = (np.array(found[name]["view"], float) for name in ("near", "far"))
    assert wide[2] > near[2]
    for view in (near, wide):
        assert view[2] / view[3] == pytest.approx(ASPECT, rel=0.02)
    assert wide[1] <= -120 - 20
    assert len(str(found)) < 1000


def test_a_standing_ego_has_a_picture_of_the_road_around_it():
    standing = cruise_scenario(speed=0.0, iterations=50)

    found = thumbnails(standing, {"still": (standing.expert[:, :2], 3)})["still"]

    assert found["view"][2] == 160
    assert found["mark"] == [0, 0]
    assert re.fullmatch(r"M0 0l0 0", found["path"])


def test_a_rollout_of_one_sample_on_a_map_without_areas_has_a_picture(scenario):
    bare = replace(scenario, map=replace(scenario.map, drivable_areas=make_layer([], [])))

    found = thumbnails(bare, {"short": (scenario.expert[:1, :2], 0)})["short"]

    assert found["scene"][0] == ""
    assert found["path"] == "M0 0l0 0"
