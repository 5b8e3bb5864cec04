"""PLUTO's network alone, and what the official code derives from its outputs."""

from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.planners.learned.pluto.proposals import headings_of
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nets.common import DERIVED_HEADING, FEATURE, OUTPUT, make_network

NAME = "pluto"
RAW = ("trajectory", "probability", "prediction", "ref_free_trajectory")
# In the features, but read neither by the network nor by what follows it.
UNREAD = ("in/agent.target", "in/map.polygon_road_block_id", "in/origin", "in/angle")
CODES = (
    "agent.category",
    "map.polygon_type",
    "map.polygon_tl_status",
    "map.polygon_road_block_id",
    "static_objects.category",
)
MASKED = {  # group → what says that an entry exists, and what is 0 where it does not
    "agent": ("valid_mask", ("position", "heading", "velocity", "shape")),
    "map": ("polygon_has_speed_limit", ("polygon_speed_limit",)),
    "static_objects": ("valid_mask", ("position", "heading", "shape", "category")),
    "reference_line": ("valid_mask", ("position", "vector", "orientation")),
}
TURN = 2.0 * np.pi


def verify_forward(file: ArrayFile) -> None:
    """Compare a forward pass on stored features, with the official masks of batches."""
    import torch

    variant = str(file["meta/variant"])
    arrays = {name[3:]: file[name] for name in file.arrays if name.startswith("in/")}
    if missing := [name for name in RAW if f"out/{name}" not in file.arrays]:
        raise DataError(f"array 'out/{missing[0]}' is missing")
    inputs = network_inputs(arrays)
    network = make_network(NAME, variant, {"misordered_masks": True})
    with torch.inference_mode():
        outputs = network(inputs)
        ours = {name: getattr(outputs, name).numpy() for name in RAW}
        ours["hidden"] = network.hidden_proj(outputs.ego).numpy()
    position, heading = arrays["agent.position"], arrays["agent.heading"]
    present = np.concatenate([position[:, 1:, -1], heading[:, 1:, -1:]], -1)
    scenes = [
        derived_outputs({name: value[row] for name, value in ours.items()}, present[row])
        for row in range(len(present))
    ]
    ours |= {name: np.stack([scene[name] for scene in scenes]) for name in scenes[0]}
    compare_outputs(file, "out/", ours, variant)
    _compare_redundant(file, arrays)
    file.note("not read by the network", *(name for name in UNREAD if name in file.arrays))
    file.finish()


def network_inputs(arrays: dict[str, Any]) -> Any:
    """A batch for the network, from arrays by the names of the official features."""
    import torch

    from shiftsim.planners.learned.pluto.inputs import Inputs

    def take(name: str) -> Any:
        return torch.from_numpy(np.ascontiguousarray(arrays[name]))

    pose = [take("static_objects.position"), take("static_objects.heading")[..., None]]
    return Inputs(
        position=take("agent.position"),
        heading=take("agent.heading"),
        velocity=take("agent.velocity"),
        shape=take("agent.shape"),
        valid=take("agent.valid_mask"),
        category=take("agent.category").long(),
        current_state=take("current_state"),
        points=take("map.point_position"),
        vectors=take("map.point_vector")[:, :, 0],
        orientations=take("map.point_orientation")[:, :, 0],
        centers=take("map.polygon_center"),
        kind=take("map.polygon_type").long(),
        on_route=take("map.polygon_on_route").long(),
        light=take("map.polygon_tl_status").long(),
        has_limit=take("map.polygon_has_speed_limit"),
        limit=take("map.polygon_speed_limit"),
        point_valid=take("map.valid_mask"),
        object_pose=torch.cat(pose, dim=-1),
        object_shape=take("static_objects.shape"),
        object_category=take("static_objects.category").long(),
        object_valid=take("static_objects.valid_mask"),
        line_points=take("reference_line.position"),
        line_vectors=take("reference_line.vector"),
        line_orientations=take("reference_line.orientation"),
        line_valid=take("reference_line.valid_mask"),
    )


def derived_outputs(raw: dict[str, Any], present: Any) -> dict[str, Any]:
    """What the official network makes of its raw outputs for one scene.

    Args:
        raw: Arrays by the names in `RAW`, without the axis of the batch.
        present: (A, 3) poses of the agents now.
    """
    motion, poses = raw["prediction"], headings_of(raw["trajectory"])
    predicted = headings_of(motion) + present[:, None]
    best = int(raw["probability"].argmax())
    return {
        "output_prediction": np.concatenate([predicted, motion[..., 4:]], -1),
        "output_trajectory": poses.reshape(-1, *poses.shape[2:])[best],
        "output_ref_free_trajectory": headings_of(raw["ref_free_trajectory"]),
        "candidate_trajectories": poses,
    }


def compare_outputs(file: ArrayFile, prefix: str, ours: dict[str, Any], variant: str) -> None:
    """Compare those outputs, raw and derived, that are stored under a prefix."""
    for name, value in ours.items():
        if prefix + name not in file.arrays:
            continue
        where, given = f"{file.name} {prefix}{name}", file[prefix + name]
        if "output" in name or "candidate" in name:
            _compare_poses(file, where, value, given, variant)
        else:
            quantity = f"{NAME} network {variant}"
            file.report.compare(quantity, where, value, given, atol=OUTPUT[variant])


def _compare_poses(file: ArrayFile, where: str, ours: Any, theirs: Any, variant: str) -> None:
    """Compare poses, and velocities behind them; headings agree up to whole turns."""
    quantity = f"{NAME} network {variant}"
    if ours.shape != theirs.shape:
        file.report.compare(quantity, where, ours, theirs)
        return
    others = [column for column in range(ours.shape[-1]) if column != 2]
    mine, given = ours[..., others], theirs[..., others]
    file.report.compare(quantity, where, mine, given, atol=OUTPUT[variant])
    mine, given = ours[..., 2], theirs[..., 2]
    given = given - TURN * np.rint((given - mine) / TURN)
    file.report.compare(f"{quantity} heading", where, mine, given, atol=DERIVED_HEADING)


def _compare_redundant(file: ArrayFile, arrays: dict[str, Any]) -> None:
    """Compare inputs that follow from others; the network reads some of either."""
    points, vectors = arrays["map.point_position"], arrays["map.point_vector"]
    angles, centers = arrays["map.point_orientation"], arrays["map.polygon_center"]
    lines, steps = arrays["reference_line.position"], arrays["reference_line.vector"]
    pairs = arrays["reference_line.valid_mask"][..., 1:, None]
    future = arrays["reference_line.future_projection"]
    padding = ~points.any(axis=(-1, -2, -3))
    sides = np.where(padding[..., None], 0, np.arange(3))
    made = {
        "map.point_vector": (np.diff(points, axis=-2), vectors[..., :-1, :]),
        "map.point_orientation": (np.arctan2(vectors[..., 1], vectors[..., 0]), angles),
        "map.polygon_center": (points[:, :, 0, 10], centers[..., :2]),
        "map.polygon_center orientation": (angles[:, :, 0, 10], centers[..., 2]),
        "map.polygon_position": (points[:, :, 0, 0], arrays["map.polygon_position"]),
        "map.polygon_orientation": (angles[:, :, 0, 0], arrays["map.polygon_orientation"]),
        "map.point_side": (sides, arrays["map.point_side"]),
        "reference_line.vector": (np.diff(lines, axis=-2) * pairs, steps[..., :-1, :] * pairs),
        "reference_line.orientation": (
            np.arctan2(steps[..., 1], steps[..., 0]),
            arrays["reference_line.orientation"],
        ),
        "reference_line.future_projection": (np.zeros(future.shape), future),
    }
    made |= {f"{name} code": (np.rint(arrays[name]), arrays[name]) for name in CODES}
    for group, (mask, names) in MASKED.items():
        for name in names:
            value = arrays[f"{group}.{name}"]
            absent = value[~arrays[f"{group}.{mask}"]]
            made[f"{group}.{name} where absent"] = (np.zeros(absent.shape), absent)
    for name, (mine, given) in made.items():
        if name.endswith("orientation"):
            given = given - TURN * np.rint((given - mine) / TURN)
        where = f"{file.name} in/{name}"
        file.report.compare(f"{NAME} inputs", where, mine, given, atol=FEATURE)
