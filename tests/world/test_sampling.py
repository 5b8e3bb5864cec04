"""Edits drawn at random."""

import numpy as np
import pytest
from worlds import cruise_scenario

from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.rings import convex_intersect
from shiftsim.world.edits.apply import apply_edit
from shiftsim.world.edits.draft import EGO_SIZE
from shiftsim.world.edits.sampling import GRADES, KINDS, braking, sample_edits
from shiftsim.world.edits.spec import make_edit
from shiftsim.world.state import center_poses

SCENES = {str(speed): cruise_scenario(speed=float(speed)) for speed in (3, 8, 12)}


@pytest.mark.parametrize("kind", KINDS)
def test_samples_can_be_applied_and_leave_the_ego_free(kind):
    tables = list(sample_edits(kind, 40, 1, list(SCENES), SCENES.__getitem__))
    assert len({table["name"] for table in tables}) == 40
    assert {table["type"].removeprefix(f"{kind}_") for table in tables} <= set(GRADES)
    for table in tables:
        made = apply_edit(SCENES[table["tokens"][0]], make_edit(table, "sample"))
        row = made.iteration_rows[0]
        ego = boxes_to_corners(center_poses(made.ego[row : row + 1, :3])[0], EGO_SIZE)
        boxes = boxes_to_corners(made.tracks.poses[row], made.tracks.sizes[row])
        assert len(boxes) >= 1
        assert not any(convex_intersect(ego, box) for box in np.ascontiguousarray(boxes))


def test_the_same_seed_gives_the_same_edits():
    one, same, other = (
        list(sample_edits("parked", 5, seed, list(SCENES), SCENES.__getitem__))
        for seed in (1, 1, 2)
    )
    assert one == same != other


def test_braking_is_that_of_a_stop_after_a_moment():
    # 10 m/s: 5 m of reaction, 1 m left before it, 12.5 m at 4 m/s^2
    assert braking(10.0, 18.5) == pytest.approx(4.0)
    assert braking(10.0, 5.0) == np.inf
    assert braking(0.0, 0.0) == 0.0


def test_where_nothing_fits_there_is_an_error():
    standing = cruise_scenario(speed=0.0)
    with pytest.raises(ConfigError, match="no plausible works was found"):
        list(sample_edits("works", 1, 0, ["a"], lambda token: standing))
