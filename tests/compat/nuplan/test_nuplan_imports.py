"""The `nuplan.*` names: what they find, and what is said where they find nothing."""

import importlib
import subprocess
import sys

import places
import pytest
from commands import call

from shiftsim.compat import nuplan
from shiftsim.compat.nuplan import MODULES
from shiftsim.errors import ConfigError, InvalidTrajectoryError, MissingExtraError, PlannerError
from shiftsim.planners.registry import load_planner, planner_fingerprint

if not nuplan.install():
    pytest.skip("nuPlan's devkit is installed", allow_module_level=True)

PLANNERS = places.TESTS / "nuplan_planners.py"


def _python(folder, code):
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )


def test_every_listed_module_can_be_imported():
    assert len(MODULES) > 30
    for module in MODULES:
        found = importlib.import_module(module)
        # as the devkit's modules do that import it themselves
        assert found.StateSE2 is not None


@pytest.mark.parametrize(
    ("module", "names"),
    [
        ("common.actor_state.agent", "Agent OrientedBox PredictedTrajectory TrackedObjectType"),
        ("common.actor_state.ego_state", "EgoState DynamicCarState VehicleParameters"),
        ("common.actor_state.oriented_box", "OrientedBox OrientedBoxPointType in_collision"),
        ("common.actor_state.state_representation", "TimeDuration TimePoint Point2D StateSE2"),
        ("common.actor_state.tracked_objects", "TrackedObjects TrackedObject AGENT_TYPES"),
        ("common.actor_state.tracked_objects_types", "STATIC_OBJECT_TYPES TrackedObjectType"),
        ("common.actor_state.vehicle_parameters", "get_pacifica_parameters BoxParameters"),
        ("common.geometry.compute", "lateral_distance principal_value AngularInterpolator"),
        ("common.geometry.convert", "absolute_to_relative_poses matrix_from_pose"),
        ("common.geometry.transform", "rotate_2d translate_longitudinally_and_laterally"),
        ("common.maps.abstract_map", "AbstractMap SemanticMapLayer MapObject"),
        ("common.maps.abstract_map_objects", "Lane LaneConnector StopLine Intersection"),
        ("common.maps.maps_datatypes", "TrafficLightStatusType LaneConnectorType"),
        ("common.geometry.torch_geometry", "global_state_se2_tensor_to_local"),
        ("common.maps.nuplan_map.utils", "get_distance_between_map_object_and_point"),
        ("planning.metrics.utils.collision_utils", "CollisionType"),
        ("planning.metrics.utils.expert_comparisons", "principal_value"),
        ("planning.metrics.utils.state_extractors", "extract_ego_jerk approximate_derivatives"),
        ("planning.scenario_builder.abstract_scenario", "AbstractScenario"),
        (
            "planning.simulation.observation.idm.utils",
            "path_to_linestring is_agent_ahead is_agent_behind is_track_stopped"
            " create_path_from_se2",
        ),
        ("planning.simulation.occupancy_map.abstract_occupancy_map", "Geometry OccupancyMap"),
        ("planning.simulation.occupancy_map.strtree_occupancy_map", "STRTreeOccupancyMapFactory"),
        ("planning.simulation.path.path", "AbstractPath"),
        (
            "planning.simulation.planner.ml_planner.transform_utils",
            "transform_predictions_to_states _get_fixed_timesteps _se2_vel_acc_to_ego_state"
            " _get_velocity_and_acceleration",
        ),
        ("planning.simulation.planner.utils.breadth_first_search", "BreadthFirstSearch"),
        ("planning.training.modeling.torch_module_wrapper", "TorchModuleWrapper"),
        (
            "planning.training.preprocessing.features.trajectory_utils",
            "convert_absolute_to_relative_poses",
        ),
        ("planning.simulation.observation.observation_type", "CameraChannel Sensors"),
        ("planning.simulation.planner.planner_report", "PlannerReport MLPlannerReport"),
        ("planning.simulation.trajectory.trajectory_sampling", "TrajectorySampling"),
    ],
)
def test_a_class_is_where_the_devkit_has_it(module, names):
    found = importlib.import_module(f"nuplan.{module}")
    assert all(getattr(found, name) is not None for name in names.split())


def test_a_class_is_the_same_wherever_it_is_imported_from():
    from nuplan.common.actor_state.agent import OrientedBox as one
    from nuplan.common.actor_state.oriented_box import OrientedBox as other

    assert one is other


@pytest.mark.parametrize(
    "statement",
    [
        "import nuplan.planning.training.modeling.lightning_module_wrapper",
        "from nuplan.planning.training.modeling import lightning_module_wrapper",
        "from nuplan.common.maps.abstract_map import RasterMap",
        "import nuplan.common.maps.abstract_map.RasterMap",
    ],
)
def test_a_missing_part_is_named_once_and_the_devkit_offered(statement):
    with pytest.raises(MissingExtraError, match=r"'nuplan\.\S+' is not among") as caught:
        exec(statement)
    assert "nuplan-devkit" in caught.value.hint
    assert isinstance(caught.value, ImportError)


def test_a_missing_attribute_is_named_too():
    from nuplan.common.maps import maps_datatypes

    assert not hasattr(maps_datatypes, "PudoType")
    with pytest.raises(AttributeError, match=r"maps_datatypes\.PudoType.*nuplan-devkit"):
        _ = maps_datatypes.PudoType


def test_optional_imports_can_be_caught():
    with pytest.raises(ImportError):
        importlib.import_module("nuplan.submission")


def test_nothing_is_there_before_it_is_asked_for(tmp_path):
    code = "import shiftsim.planners, shiftsim.compat.nuplan, nuplan.common"
    done = _python(tmp_path, code)
    assert "No module named 'nuplan'" in done.stderr


def test_a_folder_of_data_with_the_name_of_the_devkit_does_no_harm(tmp_path):
    (tmp_path / "nuplan/dataset").mkdir(parents=True)
    code = (
        "import nuplan\nfrom shiftsim.compat.nuplan import install\nassert install()\n"
        "from nuplan.common.actor_state.ego_state import EgoState\nprint(EgoState.__module__)\n"
    )
    done = _python(tmp_path, code)
    assert done.stdout.strip() == "shiftsim.compat.nuplan.shims.ego", done.stderr


def test_the_devkit_goes_before_the_shims(tmp_path):
    folder = tmp_path
    for part in ("nuplan", "planning", "simulation", "planner"):
        folder = folder / part
        folder.mkdir()
        (folder / "__init__.py").touch()
    (folder / "abstract_planner.py").write_text("AbstractPlanner = 'the real one'\n")
    code = (
        "from shiftsim.compat.nuplan import install\nassert not install()\n"
        "from nuplan.planning.simulation.planner.abstract_planner import AbstractPlanner\n"
        "print(AbstractPlanner)\n"
    )
    done = _python(tmp_path, code)
    assert done.stdout.strip() == "the real one", done.stderr


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Oracle", "requires_scenario = True"),
        ("Unfinished", r"no method compute_planner_trajectory\(\)"),
        ("Circle", r"no method name\(\)"),
        ("moved_to", "'moved_to' is not a class"),
        ("Nobody", "has no class 'Nobody'"),
    ],
)
def test_what_cannot_drive_is_refused_before_the_run(name, message):
    with pytest.raises(ConfigError, match=message):
        load_planner(f"nuplan:nuplan_planners:{name}")


def test_the_planners_of_a_module_are_named():
    with pytest.raises(ConfigError, match="planner 'nuplan:nuplan_planners:Nobody'") as caught:
        load_planner("nuplan:nuplan_planners:Nobody")
    assert "planners in it: Coast, " in caught.value.hint
    assert "AbstractPlanner" not in caught.value.hint


def test_a_name_of_another_form_is_explained():
    with pytest.raises(ConfigError, match=r"not of the form nuplan:package\.module:Class"):
        load_planner("nuplan:Coast")


def test_a_module_that_needs_more_of_the_devkit_says_so(tmp_path, monkeypatch):
    (tmp_path / "needy.py").write_text("from nuplan.planning.script import builders\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(MissingExtraError, match=r"nuplan\.planning\.script"):
        load_planner("nuplan:needy:Planner")


def test_all_missing_names_are_told_at_once(tmp_path, monkeypatch):
    (tmp_path / "wanting.py").write_text(
        "import wanting_too\n"
        "from nuplan.planning.script import builders\n"
        "from nuplan.common.maps.abstract_map import RasterMap, AbstractMap\n"
        "class Planner(wanting_too.Base): ...\n"
    )
    (tmp_path / "wanting_too.py").write_text(
        "from nuplan.planning.training.callbacks.some import Callback as Base\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    for _ in range(2):  # nothing of the search is left
        with pytest.raises(MissingExtraError) as caught:
            load_planner("nuplan:wanting:Planner")
        assert "'wanting' needs 3 names that are not among shiftsim's shims" in str(caught.value)
        names = (
            "nuplan.common.maps.abstract_map.RasterMap, nuplan.planning.script.builders, "
            "nuplan.planning.training.callbacks.some.Callback"
        )
        assert names in str(caught.value)
        assert not {"wanting", "wanting_too", "nuplan.planning.script"} & set(sys.modules)


def test_only_modules_that_need_torch_import_it(tmp_path):
    code = (
        "import sys\nfrom shiftsim.compat import nuplan as shims\nshims.install()\n"
        "for name in shims.MODULES:\n    'torch' in name or __import__(name)\n"
        "print('torch' in sys.modules)\n"
    )
    assert _python(tmp_path, code).stdout.strip() == "False"


def test_the_command_line_says_what_is_missing(toy, tmp_path):
    (tmp_path / "needy.py").write_text("import nuplan.planning.script\n")
    done = call(tmp_path, "run", "--planner", "nuplan:needy:Planner", "--store", str(toy))
    assert done.returncode == 1
    assert "error: 'nuplan.planning.script' is not among" in done.stderr
    assert "hint: install nuplan-devkit itself" in done.stderr
    assert "Traceback" not in done.stderr


def test_arguments_are_converted_to_what_the_constructor_asks_for():
    planner = load_planner("nuplan:nuplan_planners:Coast", {"horizon": "4"})
    assert planner._planner._sampling.num_poses == 40
    with pytest.raises(ConfigError, match="no argument 'speed'"):
        load_planner("nuplan:nuplan_planners:Coast", {"speed": "4"})


def test_the_fingerprint_holds_the_source_of_the_planner():
    import hashlib

    spec = "nuplan:nuplan_planners:Coast"
    found = planner_fingerprint(spec, {"horizon": "4"})
    assert found["planner"] == spec
    assert found["arguments"] == {"horizon": 4.0}
    assert found["source"] == hashlib.sha256(PLANNERS.read_bytes()).hexdigest()


def test_sensor_data_and_strange_results_are_refused():
    from worlds import cruise_scenario

    from shiftsim.sim.loop import simulate

    scenario = cruise_scenario(iterations=5)
    with pytest.raises(ConfigError, match="wants to observe Sensors"):
        simulate(scenario, load_planner("nuplan:nuplan_planners:WantsImages"))
    with pytest.raises(PlannerError, match="returned list, not an AbstractTrajectory"):
        simulate(scenario, load_planner("nuplan:nuplan_planners:ReturnsAList"))
    with pytest.raises(InvalidTrajectoryError, match="starts at time") as late:
        simulate(scenario, load_planner("nuplan:nuplan_planners:Late"))
    assert "time_point of the last ego state" in late.value.hint
    short = load_planner("nuplan:nuplan_planners:Coast", {"horizon": "0.1"})
    with pytest.raises(InvalidTrajectoryError, match="three poses"):
        simulate(scenario, short)


def test_arguments_for_an_instance_are_refused():
    import nuplan_planners

    with pytest.raises(ConfigError, match="horizon were given for an instance"):
        nuplan.wrap(nuplan_planners.Coast(), horizon=2.0)
