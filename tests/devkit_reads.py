"""nuPlan's own code reads exported results, in an environment that has it.

    python tests/devkit_reads.py FOLDER

FOLDER is what `shiftsim export results` wrote with --logs and --maps. It needs nuplan-devkit 1.2.2
on the path and what its requirements name; nothing of shiftsim is imported. Every simulation log
is unpickled by the devkit's classes and scored again by its metrics, the means are computed again
by its aggregator, and nuBoard's data class collects the folders.
"""

import math
import sys
import tempfile
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import yaml


def read_logs(folder):
    """Unpickle every log and use what nuBoard and `run_metric.py` use of it."""
    from nuplan.common.actor_state.ego_state import EgoState
    from nuplan.planning.simulation.simulation_log import SimulationLog

    metrics, tables = closed_loop_metrics(), tables_of(folder)
    files = sorted(folder.glob("simulation_log/*/*/*/*/*.msgpack.xz"))
    for file in files:
        log = SimulationLog.load_data(file)
        planner, kind, recording, token = file.parts[-5:-1]
        scenario, history = log.scenario, log.simulation_history
        assert log.planner.name() == planner
        assert (scenario.scenario_type, scenario.log_name, scenario.token) == (
            kind,
            recording,
            token,
        )
        assert len(history) == scenario.get_number_of_iterations() - 1
        assert history.map_api.map_name == scenario.map_api.map_name
        assert history.interval_seconds == history.data[1].iteration.time_s - (
            history.data[0].iteration.time_s
        )
        first, expert = history.data[0].ego_state, scenario.initial_ego_state
        assert (
            math.dist((first.center.x, first.center.y), (expert.center.x, expert.center.y)) < 1e-6
        )
        for index, sample in enumerate(history.data):
            ego = sample.ego_state
            assert isinstance(ego, EgoState)
            assert sample.iteration.index == index
            assert ego.time_us == scenario.get_time_point(index).time_us
            rear = EgoState.build_from_rear_axle(
                ego.rear_axle,
                ego.dynamic_car_state.rear_axle_velocity_2d,
                ego.dynamic_car_state.rear_axle_acceleration_2d,
                ego.tire_steering_angle,
                ego.time_point,
                scenario.ego_vehicle_parameters,
            )
            assert math.dist((rear.center.x, rear.center.y), (ego.center.x, ego.center.y)) < 1e-6
            assert ego.dynamic_car_state.speed >= 0.0
            assert ego.car_footprint.geometry.area > 11.0
            plan = sample.trajectory
            assert plan.start_time == ego.time_point
            assert plan.get_state_at_time(ego.time_point).rear_axle.x == ego.rear_axle.x
            assert plan.duration > 0.0
            recorded = scenario.get_tracked_objects_at_iteration(index).tracked_objects
            for one in sample.observation.tracked_objects:
                assert one.box.geometry.area > 0.0
            if "nonreactive" in str(folder):
                assert_same_objects(sample.observation.tracked_objects, recorded)
            lights = {(s.lane_connector_id, s.status) for s in sample.traffic_light_status}
            wanted = scenario.get_traffic_light_status_at_iteration(index)
            assert lights == {(s.lane_connector_id, s.status) for s in wanted}
        score_again(log, metrics, tables)
    return len(files)


def closed_loop_metrics():
    """The metrics of nuPlan's closed-loop challenges, made from its own configuration."""
    import nuplan.planning.script as script

    place = Path(script.__path__[0]) / "config/common/simulation_metric"
    chosen = yaml.safe_load((place / "simulation_closed_loop_reactive_agents.yaml").read_text())
    made = {}
    for level, names in (pair for group in chosen["defaults"] for pair in group.items()):
        for name in names:
            settings = yaml.safe_load((place / level / f"{name}.yaml").read_text())[name]
            module, _, kind = settings.pop("_target_").rpartition(".")
            settings.pop("_convert_", None)
            parts = settings.pop("required_metrics", {})
            needed = {parameter: made[part] for parameter, part in parts.items()}
            made[name] = getattr(import_module(module), kind)(**settings, **needed)
    return list(made.values())


def tables_of(folder):
    return {path.stem: pd.read_parquet(path) for path in folder.glob("metrics/*.parquet")}


def score_again(log, metrics, tables):
    """Compute every metric of a log, as `run_metric.py` does: the rows are those written."""
    from nuplan.planning.metrics.metric_engine import construct_dataframe

    scenario, planner = log.scenario, log.planner.name()
    key = (scenario.log_name, scenario.scenario_name, scenario.scenario_type, planner)
    found = [one for metric in metrics for one in metric.compute(log.simulation_history, scenario)]
    assert {one.name for one in found} == set(tables)
    for one in found:
        theirs, table = construct_dataframe(*key, one), tables[one.name]
        is_own = (table.scenario_name == scenario.token) & (table.planner_name == planner)
        [ours] = table[is_own].to_dict("records")
        for column, value in theirs.items():
            where = f"{one.name} {' '.join(key)} {column}"
            value = value[0] if isinstance(value, list) else value  # one row
            if is_number(value):
                np.testing.assert_allclose(
                    np.asarray(ours[column], float), np.asarray(value, float), 0, 1e-8, True, where
                )
            else:
                assert ours[column] == value or (is_absent(ours[column]) and value is None), where


def is_number(value):
    return not isinstance(value, str) and value is not None


def is_absent(value):
    return value is None or (isinstance(value, float) and math.isnan(value))


def assert_same_objects(ours, theirs):
    """Replayed objects are those of the recording."""
    found = {one.track_token: one for one in theirs}
    assert {one.track_token for one in ours} == set(found)
    for one in ours:
        other = found[one.track_token]
        assert type(one) is type(other)
        assert one.tracked_object_type == other.tracked_object_type
        assert one.metadata.category_name == other.metadata.category_name
        assert math.dist((one.center.x, one.center.y), (other.center.x, other.center.y)) < 1e-6
        assert (one.box.length, one.box.width) == (other.box.length, other.box.width)


def aggregate(folder):
    """Compute the means again from the metric tables; they must be those written."""
    from nuplan.planning.metrics.aggregator.weighted_average_metric_aggregator import (
        WeightedAverageMetricAggregator,
    )
    from nuplan.planning.metrics.metric_dataframe import MetricStatisticsDataFrame

    frames = [MetricStatisticsDataFrame.load_parquet(p) for p in folder.glob("metrics/*.parquet")]
    weights = {
        "ego_progress_along_expert_route": 5.0,
        "time_to_collision_within_bound": 5.0,
        "speed_limit_compliance": 4.0,
        "ego_is_comfortable": 2.0,
    }
    multiple = [
        "no_ego_at_fault_collisions",
        "drivable_area_compliance",
        "ego_is_making_progress",
        "driving_direction_compliance",
    ]
    with tempfile.TemporaryDirectory() as place:
        aggregator = WeightedAverageMetricAggregator(
            "weighted_average", weights, "means.parquet", Path(place), multiple
        )
        aggregator({frame.metric_statistic_name: frame for frame in frames})
        theirs = pd.read_parquet(Path(place) / "means.parquet")
    [path] = folder.glob("aggregator_metric/*.parquet")
    ours = pd.read_parquet(path)
    key = ["planner_name", "scenario"]
    theirs, ours = (t.sort_values(key).reset_index(drop=True) for t in (theirs, ours))
    assert list(theirs.columns) == list(ours.columns)
    pd.testing.assert_frame_equal(ours, theirs, rtol=0, atol=1e-12)
    return len(ours)


def collect(folder):
    """What nuBoard shows of a folder."""
    from nuplan.planning.nuboard.base.data_class import NuBoardFile
    from nuplan.planning.nuboard.base.experiment_file_data import ExperimentFileData

    [path] = folder.glob("*.nuboard")
    file = NuBoardFile.load_nuboard_file(path)
    file.current_path = path.parent
    data = ExperimentFileData([file])
    assert len(data.available_metric_statistics_names) == 16
    return len(data.simulation_scenario_keys)


def main(folder):
    """Read all experiments in a folder."""
    experiments = sorted({path.parent for path in Path(folder).rglob("*.nuboard")})
    assert experiments, f"no .nuboard in {folder}"
    for path in experiments:
        shown, logs, rows = collect(path), read_logs(path), aggregate(path)
        assert shown == logs
        print(f"{path}: {logs} simulation logs, {rows} rows of scores")


if __name__ == "__main__":
    main(sys.argv[1])
