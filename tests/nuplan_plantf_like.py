"""A planner that imports what PlanTF's public sources import, and calls it."""

import numpy as np
import torch
from nuplan.common.actor_state.vehicle_parameters import get_pacifica_parameters
from nuplan.common.geometry.torch_geometry import global_state_se2_tensor_to_local
from nuplan.common.maps.abstract_map import AbstractMap, PolygonMapObject
from nuplan.planning.scenario_builder.abstract_scenario import AbstractScenario
from nuplan.planning.simulation.observation.observation_type import DetectionsTracks, Observation
from nuplan.planning.simulation.planner.abstract_planner import (
    AbstractPlanner,
    PlannerInitialization,
    PlannerInput,
    PlannerReport,
)
from nuplan.planning.simulation.planner.ml_planner.transform_utils import (
    _get_fixed_timesteps,
    _get_velocity_and_acceleration,
    _se2_vel_acc_to_ego_state,
    transform_predictions_to_states,
)
from nuplan.planning.simulation.planner.planner_report import MLPlannerReport
from nuplan.planning.simulation.trajectory.interpolated_trajectory import InterpolatedTrajectory
from nuplan.planning.simulation.trajectory.trajectory_sampling import TrajectorySampling
from nuplan.planning.training.modeling.torch_module_wrapper import TorchModuleWrapper
from nuplan.planning.training.preprocessing.feature_builders.abstract_feature_builder import (
    AbstractFeatureBuilder,
)
from nuplan.planning.training.preprocessing.features.abstract_model_feature import (
    AbstractModelFeature,
)
from nuplan.planning.training.preprocessing.features.trajectory_utils import (
    convert_absolute_to_relative_poses,
)
from nuplan.planning.training.preprocessing.target_builders.ego_trajectory_target_builder import (
    EgoTrajectoryTargetBuilder,
)

ASKED = (get_pacifica_parameters, AbstractMap, PolygonMapObject, AbstractScenario, Observation)
ASKED += (PlannerInitialization, PlannerReport, AbstractModelFeature)
ASKED += (_get_fixed_timesteps, _get_velocity_and_acceleration, _se2_vel_acc_to_ego_state)


class History(AbstractFeatureBuilder):
    """The way so far."""

    def build(self, states):
        poses = [state.rear_axle for state in states]
        relative = torch.from_numpy(convert_absolute_to_relative_poses(poses[-1], poses))
        # the present pose is the origin already
        return {"poses": global_state_se2_tensor_to_local(relative, torch.zeros(3))}


class Network(TorchModuleWrapper):
    """Goes on as fast as it came."""

    def __init__(self):
        sampling = TrajectorySampling(num_poses=80, interval_length=0.1)
        super().__init__(sampling, [History()], [EgoTrajectoryTargetBuilder(sampling)])

    def forward(self, features):
        step = -features["poses"][-2, :1]
        ahead = step * torch.arange(1, self.future_trajectory_sampling.num_poses + 1)
        zero = torch.zeros_like(ahead)
        return {"trajectory": torch.stack([ahead, zero, zero], 1)}


class PlanTfLike(AbstractPlanner):
    """Drives with a network."""

    def __init__(self):
        self._network = Network()

    def name(self):
        return type(self).__name__

    def observation_type(self):
        return DetectionsTracks

    def initialize(self, initialization):
        self._network.eval()

    def compute_planner_trajectory(self, current_input: PlannerInput):
        states = current_input.history.ego_states
        (builder,) = self._network.get_list_of_required_feature()
        with torch.no_grad():
            plan = self._network(builder.build(states))["trajectory"].numpy()
        plan = plan.astype(np.float64)
        return InterpolatedTrajectory(
            transform_predictions_to_states(plan, current_input.history.ego_states, 8.0, 0.1)
        )

    def generate_planner_report(self, clear_stats=True):
        report = super().generate_planner_report(clear_stats)
        return MLPlannerReport(report.compute_trajectory_runtimes, [], [])
