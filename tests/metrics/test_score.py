"""The weighing of the metrics, and what is refused before anything is measured."""

from dataclasses import replace

import numpy as np
import pytest
from rollouts import boxes, rollout, states_of, straight_poses
from worlds import straight_road

from shiftsim.errors import DataError
from shiftsim.metrics import compute_metrics
from shiftsim.metrics.score import MULTIPLIERS, WEIGHTS, closed_loop_score

LOG = rollout(states_of(straight_poses(20), 10.0), tracks=boxes(20, (90.0, 0.0, 0.0)))


def test_the_score_is_the_product_times_the_weighted_mean() -> None:
    scores = dict(zip(MULTIPLIERS, (0.5, 0.9, 1.0, 0.5), strict=True))
    scores |= dict(zip(WEIGHTS, (0.1, 0.4, 0.8, 1.0), strict=True))
    mean = (5 * 0.1 + 5 * 0.4 + 4 * 0.8 + 2 * 1.0) / 16
    assert closed_loop_score(scores) == pytest.approx(0.225 * mean, abs=1e-12)
    own = scores | {"own": 0.5, "without": None}
    assert closed_loop_score(own) == pytest.approx(0.225 * (16 * mean + 0.5) / 17, abs=1e-12)


def test_one_metric_of_weight_one_is_the_score() -> None:
    assert closed_loop_score({"own": 0.5}) == 0.5


def test_multipliers_alone_score_nothing() -> None:
    assert closed_loop_score(dict.fromkeys(MULTIPLIERS, 1.0)) == 0.0


@pytest.mark.parametrize(
    ("array", "column"),
    [("poses", n) for n in range(3)]
    + [(name, n) for name in ("sizes", "velocities") for n in (0, 1)],
)
@pytest.mark.parametrize(("value", "sample"), [(np.nan, 7), (np.inf, 19), (1e300, 3)])
def test_every_number_of_a_track_must_be_finite_where_it_is_valid(
    array: str, column: int, value: float, sample: int
) -> None:
    changed = getattr(LOG.tracks, array).copy()
    changed[sample, 0, column] = value
    tracks = replace(LOG.tracks, **{array: changed})
    with pytest.raises(DataError, match=f"track 't0' at sample {sample} has a pose or size"):
        compute_metrics(replace(LOG, tracks=tracks), straight_road())
    valid = LOG.tracks.valid.copy()
    valid[sample, 0] = False
    compute_metrics(replace(LOG, tracks=replace(tracks, valid=valid)), straight_road())


def test_a_box_of_negative_size_is_refused() -> None:
    sizes = LOG.tracks.sizes.copy()
    sizes[4, 0, 1] = -1.0
    with pytest.raises(DataError, match=r"track 't0' at sample 4 .* a negative size"):
        compute_metrics(replace(LOG, tracks=replace(LOG.tracks, sizes=sizes)), straight_road())


def test_the_states_of_the_expert_are_looked_at_too() -> None:
    expert = LOG.expert_ego.copy()
    expert[3, 10] = np.inf
    with pytest.raises(DataError, match="expert yaw_accel at sample 3 is not finite"):
        compute_metrics(replace(LOG, expert_ego=expert), straight_road())
    with pytest.raises(DataError, match="has no expert states"):
        compute_metrics(replace(LOG, expert_ego=expert[:0]), straight_road())


def test_tracks_and_times_must_be_as_many_as_states() -> None:
    with pytest.raises(DataError, match="20 time stamps, 20 ego states and 19 rows of tracks"):
        compute_metrics(replace(LOG, tracks=boxes(19, (90.0, 0.0, 0.0))), straight_road())
    with pytest.raises(DataError, match="19 time stamps"):
        compute_metrics(replace(LOG, time_us=LOG.time_us[1:]), straight_road())


def test_four_samples_are_enough() -> None:
    assert (
        0.0 <= compute_metrics(rollout(states_of(straight_poses(4), 10.0)), straight_road()).score
    )
