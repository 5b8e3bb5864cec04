"""Edits drawn at random."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario

from shiftsim.edits.apply import apply_edit
from shiftsim.edits.builder import EGO_SIZE
from shiftsim.edits.sampling import GRADES, KINDS, graded, sample_edits
from shiftsim.edits.spec import make_edit
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.rings import convex_intersect
from shiftsim.world.state import center_poses

SCENES = {str(speed): cruise_scenario(speed=float(speed)) for speed in (3, 8, 12)}


def by_token(edited):
    """A grade that depends on the scenario alone."""
    return {"3": "easy", "8": "medium", "12": "hard"}[edited.token.partition("-")[0]]


def drawn(kind, count, seed, grade=by_token, **options):
    return list(sample_edits(kind, count, seed, list(SCENES), read, grade, **options))


def read(token):
    return SCENES[token]


@pytest.fixture(autouse=True)
def named(monkeypatch):
    for token, scene in SCENES.items():
        monkeypatch.setitem(SCENES, token, replace(scene, token=token))


@pytest.mark.parametrize("kind", KINDS)
def test_samples_can_be_applied_and_leave_the_ego_free(kind):
    tables = drawn(kind, 40, 1)
    assert [table["name"] for table in tables] == [f"{kind}{number}" for number in range(40)]
    for table in tables:
        [token] = table["tokens"]
        made = apply_edit(SCENES[token], make_edit(table, "sample"))
        assert made.scenario_type == f"{kind}_{by_token(made)}"
        row = made.iteration_rows[0]
        ego = boxes_to_corners(center_poses(made.ego[row : row + 1, :3])[0], EGO_SIZE)
        boxes = boxes_to_corners(made.tracks.poses[row], made.tracks.sizes[row])
        assert len(boxes) >= 1
        assert not any(convex_intersect(ego, box) for box in np.ascontiguousarray(boxes))


def test_the_same_seed_gives_the_same_edits():
    one, same, other = (drawn("parked", 5, seed) for seed in (1, 1, 2))
    assert one == same != other


def test_there_are_as_many_of_every_difficulty_where_that_is_asked_for():
    types = Counter(table["type"] for table in drawn("works", 12, 1, even=True))
    assert types == {f"works_{grade}": 4 for grade in GRADES}


def test_what_is_not_graded_is_drawn_anew():
    tables = drawn("parked", 6, 1, lambda edited: by_token(edited).replace("hard", ""))
    assert {graded(table["type"]) for table in tables} == {("parked", "easy"), ("parked", "medium")}


def test_where_nothing_fits_there_is_an_error():
    with pytest.raises(ConfigError, match="no plausible works was found"):
        drawn("works", 1, 0, lambda edited: "")


def test_a_type_without_a_grade_is_a_kind():
    assert graded("jaywalker_hard") == ("jaywalker", "hard")
    assert graded("starting_left_turn") == ("starting_left_turn", "")
    assert graded("hard") == ("hard", "")
