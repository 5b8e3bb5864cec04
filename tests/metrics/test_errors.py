"""Input that cannot be scored gives one error that says what and where."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from rollouts import boxes, rollout, states_of, straight_poses
from worlds import straight_road

from shiftsim.errors import ConfigError, DataError, MapError
from shiftsim.metrics import MetricRow, compute_metrics, evaluate, load_metric, measure
from shiftsim.world.build import BlockSpec, EdgeSpec, build_map

LOG = rollout(states_of(straight_poses(20), 10.0))


def edge(name: str, *, y: float = 0.0, connector: bool = False, block: str = "b") -> EdgeSpec:
    return EdgeSpec(
        id=name,
        is_connector=connector,
        polygon=shapely.box(0.0, y - 1.75, 200.0, y + 1.75),
        baseline=np.array([[0.0, y], [200.0, y]]),
        block_id=block,
        speed_limit=15.0,
    )


def road(*edges: EdgeSpec) -> object:
    block = BlockSpec("b", False, shapely.box(0.0, -5.0, 200.0, 5.0))
    return build_map("toy", edges=edges, blocks=[block])


def test_overlapping_lanes_are_named() -> None:
    with pytest.raises(MapError, match="lanes 'a' and 'c' overlap at"):
        compute_metrics(LOG, road(edge("a"), edge("c", y=1.0)))


def test_a_connector_without_neighbours_has_no_speed_limit() -> None:
    with pytest.raises(MapError, match="connector 'a' leads from and to no lane"):
        compute_metrics(LOG, road(edge("a", connector=True)))


def test_a_route_without_roadblock_is_named() -> None:
    with pytest.raises(MapError, match="'a' on the expert's route belongs to no roadblock"):
        compute_metrics(LOG, road(edge("a", block="missing")))


def test_too_short_rollouts_are_refused() -> None:
    short = rollout(states_of(straight_poses(3), 10.0))
    with pytest.raises(DataError, match="has 3 samples; the metrics need 4"):
        compute_metrics(short, straight_road())


def test_a_state_that_is_not_finite_is_located() -> None:
    states = states_of(straight_poses(20), 10.0)
    states[7, 2] = np.nan
    with pytest.raises(DataError, match="ego heading at sample 7 is not finite"):
        compute_metrics(replace(LOG, ego=states), straight_road())


def test_a_track_that_is_not_finite_is_located() -> None:
    tracks = boxes(20, (50.0, 0.0, 0.0))
    tracks.poses[5, 0, 1] = np.nan
    with pytest.raises(DataError, match="track 't0' at sample 5"):
        compute_metrics(replace(LOG, tracks=tracks), straight_road())


def test_arrays_of_different_length_are_refused() -> None:
    with pytest.raises(DataError, match="do not belong together"):
        compute_metrics(replace(LOG, ego=LOG.ego[:-1]), straight_road())


def test_an_unknown_profile_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match="threshold profile 'deeplan' unknown") as error:
        evaluate(measure(LOG, straight_road()), "deeplan")
    assert "deepplan" in error.value.hint


def mean_speed(log: object, road: object) -> float:
    return float(log.ego[:, 3].mean())  # type: ignore[attr-defined]


def test_an_own_metric_stands_beside_the_score_and_leaves_it_alone() -> None:
    plain = compute_metrics(LOG, straight_road())
    own = compute_metrics(LOG, straight_road(), own=[mean_speed])
    assert own.extra == (MetricRow("mean_speed", None, 10.0, "", None, None),)
    assert own.score == plain.score
    assert own.scores == plain.scores


def test_an_own_metric_can_be_named_by_module_and_attribute() -> None:
    result = compute_metrics(LOG, straight_road(), own=["rollouts:with_count"])
    assert result.extra[0].value == 20.0


@pytest.mark.parametrize("spec", ["rollouts", "no_such_module:f", "rollouts:nothing", "os:sep"])
def test_an_own_metric_that_cannot_be_loaded_is_named(spec: str) -> None:
    with pytest.raises(ConfigError, match=spec):
        compute_metrics(LOG, straight_road(), own=[spec])


@pytest.mark.parametrize("spec", ["rollouts", "rollouts:", ":with_count", ""])
def test_an_own_metric_needs_a_module_and_an_attribute(spec: str) -> None:
    with pytest.raises(ConfigError, match="is not of the form module:attribute"):
        load_metric(spec)


def test_an_own_metric_cannot_take_an_official_name() -> None:
    taken = MetricRow("score", 1.0, 1.0, "", None, None)
    with pytest.raises(ConfigError, match="'score' is taken"):
        compute_metrics(LOG, straight_road(), own=[lambda log, road: taken])
