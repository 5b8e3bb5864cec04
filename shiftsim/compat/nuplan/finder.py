"""Makes `import nuplan…` find the stand-ins, and says clearly what they do not have."""

import importlib.util
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from shiftsim.errors import MissingExtraError

_SOURCES = ("geometry", "transforms", "boxes", "objects", "ego", "map_types", "planning")
# module: the names that can be imported from it: its own, then those it imports itself
_TABLE = """
nuplan.common.actor_state.agent: Agent AgentState AgentTemporalState OrientedBox PredictedTrajectory
    SceneObjectMetadata StateVector2D TimePoint TrackedObjectType
nuplan.common.actor_state.agent_state: AgentState OrientedBox SceneObject SceneObjectMetadata
    StateSE2 StateVector2D TrackedObjectType
nuplan.common.actor_state.agent_temporal_state: AgentTemporalState PredictedTrajectory TimePoint
    Waypoint
nuplan.common.actor_state.car_footprint: CarFootprint OrientedBox OrientedBoxPointType Point2D
    StateSE2 VehicleParameters translate_longitudinally
nuplan.common.actor_state.dynamic_car_state: DynamicCarState get_velocity_shifted
    get_acceleration_shifted StateVector2D
nuplan.common.actor_state.ego_state: EgoState AgentState CarFootprint DynamicCarState
    InterpolatableState SceneObjectMetadata SplitState StateSE2 StateVector2D TimePoint
    TrackedObjectType VehicleParameters Waypoint get_acceleration_shifted get_velocity_shifted
nuplan.common.actor_state.oriented_box: OrientedBox OrientedBoxPointType Dimension in_collision
    collision_by_radius_check Point2D StateSE2 translate_longitudinally_and_laterally
nuplan.common.actor_state.scene_object: SceneObject SceneObjectMetadata OrientedBox StateSE2
    TrackedObjectType
nuplan.common.actor_state.state_representation: TimeDuration TimePoint Point2D StateSE2
    ProgressStateSE2 TemporalStateSE2 StateVector2D
nuplan.common.actor_state.static_object: StaticObject OrientedBox SceneObject SceneObjectMetadata
    StateVector2D TrackedObjectType
nuplan.common.actor_state.tracked_objects: TrackedObjects TrackedObject AGENT_TYPES Agent
    AgentTemporalState OrientedBox STATIC_OBJECT_TYPES SceneObject SceneObjectMetadata StaticObject
    TrackedObjectType
nuplan.common.actor_state.tracked_objects_types: TrackedObjectType AGENT_TYPES STATIC_OBJECT_TYPES
nuplan.common.actor_state.vehicle_parameters: BoxParameters VehicleParameters
    get_pacifica_parameters
nuplan.common.actor_state.waypoint: Waypoint InterpolatableState OrientedBox SplitState StateSE2
    StateVector2D TimePoint
nuplan.common.geometry.compute: lateral_distance longitudinal_distance compute_distance
    principal_value AngularInterpolator Dimension OrientedBox Point2D StateSE2
    get_pacifica_parameters translate_laterally translate_longitudinally
nuplan.common.geometry.convert: pose_from_matrix matrix_from_pose absolute_to_relative_poses
    relative_to_absolute_poses numpy_array_to_absolute_pose numpy_array_to_absolute_velocity
    vector_2d_from_magnitude_angle StateSE2 StateVector2D
nuplan.common.geometry.transform: rotate_2d translate rotate rotate_angle transform
    translate_longitudinally translate_laterally translate_longitudinally_and_laterally Point2D
    StateSE2
nuplan.common.maps.abstract_map: AbstractMap MapObject PolygonMapObject Intersection Lane
    LaneConnector Point2D RoadBlockGraphEdgeMapObject SemanticMapLayer StopLine
nuplan.common.maps.abstract_map_objects: AbstractMapObject PolygonMapObject PolylineMapObject
    GraphEdgeMapObject LaneGraphEdgeMapObject Lane LaneConnector RoadBlockGraphEdgeMapObject
    StopLine Intersection IntersectionType LaneConnectorType Point2D StateSE2 StopLineType
nuplan.common.maps.maps_datatypes: SemanticMapLayer LaneConnectorType StopLineType IntersectionType
    TrafficLightStatusType TrafficLightStatusData
nuplan.common.utils.interpolatable_state: InterpolatableState SplitState TimePoint
nuplan.common.utils.split_state: SplitState
nuplan.planning.simulation.controller.motion_model.kinematic_bicycle: KinematicBicycleModel
    DynamicCarState EgoState StateSE2 StateVector2D TimePoint VehicleParameters principal_value
nuplan.planning.simulation.history.simulation_history_buffer: SimulationHistoryBuffer
    DetectionsTracks EgoState Observation Sensors
nuplan.planning.simulation.observation.observation_type: CameraChannel LidarChannel Observation
    Sensors DetectionsTracks TrackedObjects
nuplan.planning.simulation.planner.abstract_planner: AbstractPlanner PlannerInitialization
    PlannerInput AbstractMap AbstractTrajectory Observation PlannerReport SimulationHistoryBuffer
    SimulationIteration StateSE2 TrafficLightStatusData
nuplan.planning.simulation.planner.planner_report: PlannerReport MLPlannerReport
nuplan.planning.simulation.simulation_time_controller.simulation_iteration: SimulationIteration
    TimePoint
nuplan.planning.simulation.trajectory.abstract_trajectory: AbstractTrajectory TimePoint
nuplan.planning.simulation.trajectory.interpolated_trajectory: InterpolatedTrajectory
    AbstractTrajectory AngularInterpolator InterpolatableState SplitState TimePoint
nuplan.planning.simulation.trajectory.predicted_trajectory: PredictedTrajectory AbstractTrajectory
    EgoState InterpolatedTrajectory Waypoint
nuplan.planning.simulation.trajectory.trajectory_sampling: TrajectorySampling
"""
MODULES = dict(re.findall(r"^(\S+): (.*(?:\n .*)*)", _TABLE, re.MULTILINE))
_PACKAGES = {name[:end] for name in MODULES for end, sign in enumerate(name) if sign == "."}

_HINT = "install nuplan-devkit itself, which is then used instead, or leave that import out"


class StandInFinder(MetaPathFinder, Loader):
    """Finds the modules of `MODULES`. Nothing else of that name exists once it is installed.

    Every module says that it is a package: then `from module import name` with a name that it does
    not have comes here, and ends with one clear error instead of Python's own.
    """

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """A spec for a stand-in, or None for modules of others.

        Raises:
            MissingExtraError: There is no stand-in for this part of the devkit.
        """
        if name.partition(".")[0] != "nuplan":
            return None
        if name in MODULES or name in _PACKAGES:
            return ModuleSpec(name, self, is_package=True)
        raise MissingExtraError(_missing(name), hint=_HINT)

    def create_module(self, spec: ModuleSpec) -> None:
        """The ordinary kind of module."""

    def exec_module(self, module: ModuleType) -> None:
        """Put the names into a module."""
        if wanted := MODULES.get(module.__name__, "").split():
            known: dict[str, Any] = {}
            for source in _SOURCES:
                known |= vars(import_module(f"shiftsim.compat.nuplan.stand_ins.{source}"))
            vars(module).update((name, known[name]) for name in wanted)

        def missing(name: str) -> Any:
            raise AttributeError(f"{_missing(f'{module.__name__}.{name}')}; {_HINT}")

        vars(module)["__getattr__"] = missing


def install() -> bool:
    """Make `import nuplan…` work in this process; call it before importing a planner's module.

    Returns whether the stand-ins are used: false where nuPlan's devkit is there.
    """
    if any(isinstance(finder, StandInFinder) for finder in sys.meta_path):
        return True
    try:
        if (
            importlib.util.find_spec("nuplan.planning.simulation.planner.abstract_planner")
            is not None
        ):
            return False
    except ModuleNotFoundError:
        pass
    # a folder named nuplan, of data for instance, counts as an empty package: drop it
    for name in [name for name in sys.modules if name.partition(".")[0] == "nuplan"]:
        del sys.modules[name]
    sys.meta_path.insert(0, StandInFinder())
    return True


def _missing(name: str) -> str:
    return f"{name!r} is not among shiftsim's stand-ins for nuPlan's devkit"
