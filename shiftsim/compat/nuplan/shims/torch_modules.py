"""What planners with networks import of the devkit: networks, and poses as tensors."""

from abc import abstractmethod

import torch

from shiftsim.compat.nuplan.shims.planning import (
    AbstractFeatureBuilder,
    AbstractTargetBuilder,
    FeaturesType,
    TargetsType,
    TrajectorySampling,
)


class TorchModuleWrapper(torch.nn.Module):
    """A network with what makes its inputs and its targets."""

    def __init__(
        self,
        future_trajectory_sampling: TrajectorySampling,
        feature_builders: list[AbstractFeatureBuilder],
        target_builders: list[AbstractTargetBuilder],
    ) -> None:
        super().__init__()
        self.future_trajectory_sampling = future_trajectory_sampling
        self.feature_builders, self.target_builders = feature_builders, target_builders

    def get_list_of_required_feature(self) -> list[AbstractFeatureBuilder]:
        return self.feature_builders

    def get_list_of_computed_target(self) -> list[AbstractTargetBuilder]:
        return self.target_builders

    @abstractmethod
    def forward(self, features: FeaturesType) -> TargetsType:
        """From features to targets."""


# nuplan.common.geometry.torch_geometry


def state_se2_tensor_to_transform_matrix_batch(
    input_data: torch.Tensor, precision: torch.dtype | None = None
) -> torch.Tensor:
    """(N, 3, 3) transforms of poses (N, 3)."""
    x, y, heading = _shaped(input_data, 2, 3).to(precision or input_data.dtype).unbind(1)
    cos, sin, zero = torch.cos(heading), torch.sin(heading), torch.zeros_like(x)
    entries = (cos, -sin, x, sin, cos, y, zero, zero, torch.ones_like(x))
    return torch.stack(entries, 1).reshape(-1, 3, 3)


def state_se2_tensor_to_transform_matrix(
    input_data: torch.Tensor, precision: torch.dtype | None = None
) -> torch.Tensor:
    """(3, 3) transform of a pose (3,)."""
    pose = _shaped(input_data, 1, 3)
    return state_se2_tensor_to_transform_matrix_batch(pose[None], precision)[0]


def transform_matrix_to_state_se2_tensor_batch(input_data: torch.Tensor) -> torch.Tensor:
    """(N, 3) poses of transforms (N, 3, 3)."""
    matrix = _shaped(input_data, 3, 3)
    heading = torch.atan2(matrix[:, 1, 0], matrix[:, 0, 0])
    return torch.cat([matrix[:, :2, 2], heading[:, None]], 1)


def global_state_se2_tensor_to_local(
    global_states: torch.Tensor, local_state: torch.Tensor, precision: torch.dtype | None = None
) -> torch.Tensor:
    """(N, 3) poses in the frame of a pose (3,)."""
    kind = _kind(global_states, local_state, precision)
    inverse = torch.linalg.inv(state_se2_tensor_to_transform_matrix(local_state, kind))
    states = state_se2_tensor_to_transform_matrix_batch(global_states, kind)
    return transform_matrix_to_state_se2_tensor_batch(inverse @ states)


def coordinates_to_local_frame(
    coords: torch.Tensor, anchor_state: torch.Tensor, precision: torch.dtype | None = None
) -> torch.Tensor:
    """(N, 2) points in the frame of a pose (3,)."""
    kind = _kind(coords, anchor_state, precision)
    if not len(_shaped(coords, 2, 2)):
        return coords
    inverse = torch.linalg.inv(state_se2_tensor_to_transform_matrix(anchor_state, kind))
    return coords.to(kind) @ inverse[:2, :2].T + inverse[:2, 2]


def vector_set_coordinates_to_local_frame(
    coords: torch.Tensor,
    avails: torch.Tensor,
    anchor_state: torch.Tensor,
    output_precision: torch.dtype | None = torch.float32,
) -> torch.Tensor:
    """(M, K, 2) points in the frame of a pose (3,), 0 where they are not available (M, K)."""
    if _shaped(coords, 3, 2).shape[:2] != avails.shape:
        raise ValueError(f"points {tuple(coords.shape)}, availability {tuple(avails.shape)}")
    flat = coords.double().reshape(-1, 2)
    moved = coordinates_to_local_frame(flat, anchor_state.double()).reshape(coords.shape)
    return torch.where(avails[..., None], moved, 0.0).to(output_precision)


def _shaped(tensor: torch.Tensor, dimensions: int, last: int) -> torch.Tensor:
    if tensor.dim() != dimensions or tensor.shape[-1] != last:
        what = f"of {dimensions} dimensions, {last} in the last"
        raise ValueError(f"a tensor {what}, is needed, not {tuple(tensor.shape)}")
    return tensor


def _kind(tensor: torch.Tensor, anchor: torch.Tensor, precision: torch.dtype | None) -> torch.dtype:
    if precision is None and tensor.dtype != anchor.dtype:
        raise ValueError(f"{tensor.dtype} and {anchor.dtype} need a precision")
    return precision or tensor.dtype
