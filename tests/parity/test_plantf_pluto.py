"""PlanTF and PLUTO against the official code: networks, features, proposals, brake and plans."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import places
import pytest
from parity_cases import (
    Cases,
    File,
    Scenes,
    change_array,
    change_json,
    ids,
    name_unknown,
    noticed,
    open_scenes,
    read_file,
)
from parity_nets import (
    CODES,
    FILE_COLUMNS,
    INPUTS,
    PLAN,
    PLUTO_INPUTS,
    STATE,
    Loop,
    compare_manifest,
    drive_bound,
    loop_steps,
    make_planner,
    only,
    vector_manifest,
)

torch = pytest.importorskip("torch")

from shiftsim.geometry.polylines import make_path, project_on_polyline  # noqa: E402
from shiftsim.planners.learned.checkpoint import network_module  # noqa: E402
from shiftsim.planners.learned.features import STEP, plan_of_poses  # noqa: E402
from shiftsim.planners.learned.map_features import CROSSWALK  # noqa: E402
from shiftsim.planners.learned.plantf.planner import PlanTF, make_batch  # noqa: E402
from shiftsim.planners.learned.pluto import planner as pluto_planner  # noqa: E402
from shiftsim.planners.learned.pluto import scoring  # noqa: E402
from shiftsim.planners.learned.pluto.planner import Pluto, headings_of  # noqa: E402
from shiftsim.world.state import NUM_STATE, PACIFICA, VX, VY  # noqa: E402

pytestmark = [pytest.mark.golden, pytest.mark.learned, pytest.mark.slow]
plantf, pluto = pytest.mark.reference("plantf"), pytest.mark.reference("pluto")
GOLDEN = places.GOLDEN / "nets"

FEATURE = 5e-5  # m, rad, …: features are stored as 32 bit floats
HEADING = 5e-4  # rad, arctangent of small vectors
VERTEX = 6.561458713137038  # m along the line of refl.npz, by the official code
LAYERS = np.array(["LANE", "LANE_CONNECTOR", "CROSSWALK"])
NEAR_TIE = 1e-4  # between the two best final scores; below it the choice may differ
LINE = 1e-9  # m, rad: reference lines are made by the same operations
SCORED = 1e-8  # what follows from stored proposals and scores
# states in PLUTO's proposals: x, y, heading, velocity, acceleration, steering angle and rate, …
ROLLOUT = [2e-3, 2e-3, 2e-4, *[2e-3] * 8]
POSES = [2e-3, 2e-3, 2e-4]  # m, m, rad

Outputs = Callable[[Any, Any], dict[str, Any]]  # of a network, from its inputs


def likeliest(trajectory: Any, probability: Any) -> Any:
    """(B, 80, 3) poses of the best of trajectories (B, …, 80, C), by logits (B, …)."""
    poses, count = headings_of(trajectory), len(trajectory)
    best = probability.reshape(count, -1).argmax(axis=1)
    return poses.reshape(count, -1, *poses.shape[-2:])[np.arange(count), best]


def plantf_outputs(network: Any, inputs: Any) -> dict[str, Any]:
    with torch.no_grad():
        said = network(inputs)._asdict()
    made = {name: value.numpy() for name, value in said.items()}
    poses = likeliest(made["trajectory"], made["probability"])
    names = ("probability", "prediction", "trajectory")
    return {**{name: made[name] for name in names}, **split(output_trajectory=poses)}


def pluto_outputs(network: Any, batch: Any) -> dict[str, Any]:
    """What the network says of a batch, and poses that the official code makes of that."""
    # the official code masks the agents of a batch in the wrong order (nuPlan rule 307)
    network.planning_decoder.misordered_masks = True
    with torch.no_grad():
        out = network(batch)
        hidden = network.hidden_proj(out.ego)
    made = {name: value.numpy() for name, value in out._asdict().items()}
    present = np.concatenate([batch.position[:, 1:, -1], batch.heading[:, 1:, -1:]], axis=-1)
    predicted = headings_of(made["prediction"]) + present[:, :, None]
    names = ("probability", "prediction", "trajectory", "ref_free_trajectory")
    return {
        **{name: made[name] for name in names},
        "hidden": hidden,
        **split(
            output_trajectory=likeliest(made["trajectory"], made["probability"]),
            candidate_trajectories=headings_of(made["trajectory"]),
            output_prediction=predicted,
            output_ref_free_trajectory=headings_of(made["ref_free_trajectory"]),
        ),
        "output_prediction[..., 3:]": made["prediction"][..., 4:],  # velocities
    }


def split(**poses: Any) -> dict[str, Any]:
    """Places and headings of poses apart, for these have tolerances of their own."""
    parts = {f"{name}[..., :2]": value[..., :2] for name, value in poses.items()}
    return parts | {f"{name}[..., 2]": value[..., 2] for name, value in poses.items()}


LARGE = ("trajectory", "candidate_trajectories")  # closed loops of PLUTO do not store them


def compare_outputs(file: File, where: str, ours: Mapping[str, Any], called: str) -> None:
    variant = called.rpartition("(")[2].rstrip(")")
    headings = [name for name in ours if name.endswith("[..., 2]")]
    atol = {"": drive_bound(variant), "probability": 2e-5, "prediction": 2e-5}
    if called.startswith("pluto"):
        atol = {"": drive_bound(variant)}
    file.match(
        where, ours, {**atol, **dict.fromkeys(headings, HEADING)}, quantity=called, angles=headings
    )


# --- the networks alone, on synthetic inputs as the official code batched them


@plantf
@pytest.mark.files("forward_*.npz")
def test_plantf_forward(path: Path, cases: Cases) -> None:
    compare_forward(path, cases, PlanTF, INPUTS, plantf_outputs)


@pluto
@pytest.mark.files("forward_*.npz")
def test_pluto_forward(path: Path, cases: Cases) -> None:
    compare_forward(path, cases, Pluto, PLUTO_INPUTS, pluto_outputs)


def compare_forward(
    path: Path,
    cases: Cases,
    planner: Any,
    fields: Mapping[str, str | list[str]],
    outputs: Outputs,
) -> None:
    file = read_file(path, cases, path.stem)
    variant, stored = str(file["meta/variant"]), file.below("in/")
    inputs = stored_inputs(stored, planner, fields)
    ours = outputs(make_planner(planner, variant).network, inputs)
    compare_outputs(file.below("out/"), file.name, ours, f"{planner.name} ({variant})")
    codes = {str(fields[field]) for field in CODES if field in fields}
    radius = import_module(planner.__module__).RADIUS  # m, of the features
    compare_inputs(stored, planner.name, radius, {*codes, "map.polygon_road_block_id"})
    file.note("the network does not read them", "in/origin", "in/angle")
    file.note("the network does not read the yaw rate, the last value of in/current_state")
    file.finish()


def stored_inputs(stored: File, planner: Any, fields: Mapping[str, str | list[str]]) -> Any:
    """The inputs of a network that the arrays of a file make up."""
    tensors = {}
    for field, where in fields.items():
        array = np.dstack([stored[n] for n in where]) if isinstance(where, list) else stored[where]
        tensor = torch.from_numpy(np.ascontiguousarray(array))
        tensors[field] = tensor.long() if field in CODES else tensor
    return network_module(planner.name).Inputs(**tensors)


def compare_inputs(stored: File, planner: str, radius: float, codes: set[str]) -> None:
    """Check the arrays of a synthetic input against each other; `codes` are integers.

    The network reads one of two arrays that say the same, or neither. Points beyond `radius` [m]
    are not valid.
    """
    given = {name: stored[name].astype(np.float64) for name in stored}
    ours = {name: np.rint(a) if name in codes else a.copy() for name, a in given.items()}
    for name, array in ours.items():  # padding is zero
        mask = given.get(f"{name.partition('.')[0]}.valid_mask")
        if mask is not None:
            there = mask if array.shape[: mask.ndim] == mask.shape else mask.any(axis=-1)
            array *= there.reshape(*there.shape, *[1] * (array.ndim - there.ndim))
    points, angles = (given[f"map.point_{name}"][:, :, 0] for name in ("position", "orientation"))
    exists = given["map.valid_mask"].any(axis=-1)[..., None]
    ours["map.point_side"] = exists * np.arange(3.0)
    ours["map.polygon_position"], ours["map.polygon_orientation"] = points[:, :, 0], angles[..., 0]
    ours["map.polygon_center"] = np.dstack([points[:, :, 10], angles[..., 10]])
    ours["map.polygon_speed_limit"] *= given["map.polygon_has_speed_limit"]
    ours["map.valid_mask"] = exists * (np.abs(points) < radius).all(axis=-1)
    for part in ("map.point_", "reference_line."):
        if f"{part}vector" in given:
            vectors, steps = given[f"{part}vector"], np.diff(given[f"{part}position"], axis=-2)
            there = given.get(f"{part}valid_mask", np.ones(vectors.shape[:-1]))[..., 1:] > 0.0
            ours[f"{part}vector"][..., :-1, :][there] = steps[there]
            ours[f"{part}orientation"] = np.arctan2(vectors[..., 1], vectors[..., 0])
    names = ("position", "heading", "velocity", "shape")
    position, heading, velocity, shape = (given[f"agent.{name}"] for name in names)
    ours["agent.position"][:, 0, -1] = ours["agent.heading"][:, 0, -1] = 0.0
    ours["agent.shape"][:, 0] = PACIFICA.width, PACIFICA.length
    ours["agent.category"][:, 0], ours["agent.valid_mask"][:, 0] = 0.0, 1.0
    ours["current_state"][:, :3], ours["current_state"][:, 3] = 0.0, velocity[:, 0, -1, 0]
    for name in {"agent.target", "reference_line.future_projection"} & set(ours):
        ours[name] = np.zeros(ours[name].shape)
    # in a synthetic world everything moves as it says
    present = given["agent.valid_mask"] > 0.0
    moved = np.diff(position, axis=2) - velocity[:, :, :-1] * STEP
    aside = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
    gaps = {
        "motion": moved[present[..., 1:] & present[..., :-1]],
        "direction": aside[present],
        "shape": (shape - shape[:, :, -1:])[present],
    }
    called, angles = f"{planner} input", [name for name in ours if "orientation" in name]
    stored.match(stored.name, ours, FEATURE, quantity=called, angles=angles)
    for name, gap in gaps.items():
        stored.report.compare(f"{called} {name}", stored.name, gap, 0.0 * gap, atol=FEATURE)


# --- closed loops


def compare_features(loop: Loop, agents: Any, near: Any, route: Any, more: Any) -> None:
    """Compare what is stored of one iteration that is made before the network.

    `route` are blocks of the corrected route; `more` are the features that differ by planner.
    """
    known = [*loop.road.edges.ids, *loop.road.crosswalks.ids]
    names = {
        "agent_tokens": ["ego", *(loop.tracks.tokens[i] for i in agents.tracks)],
        "map_ids": [known[row] for row in near.objects],
        "map_layers": LAYERS[near.kind],
        "corrected_route_ids": ids(loop.road.blocks, route),
    }
    loop.match(loop.stored, names)
    ours = {
        "origin": loop.seen.history.ego[-1, :2],
        "angle": loop.seen.history.ego[-1, 2],
        **{f"agent.{n}": getattr(agents, n) for n in ("position", "heading", "velocity", "shape")},
        "agent.valid_mask": agents.valid,
        "agent.target": np.zeros((len(agents.valid), 0, 3)),
        "map.point_position": near.points,
        "map.point_vector": near.vectors,
        "map.point_orientation": near.orientations,
        "map.point_side": np.tile(np.arange(3), (len(near.kind), 1)),
        "map.polygon_center": near.centers,
        "map.polygon_position": near.points[:, 0, 0],
        "map.polygon_orientation": near.orientations[:, 0, 0],
        "map.polygon_type": near.kind,
        "map.polygon_on_route": near.on_route,
        "map.polygon_tl_status": near.light,
        "map.polygon_has_speed_limit": near.has_limit,
        "map.polygon_speed_limit": near.limit,
        "map.valid_mask": near.valid,
        **more,
    }
    stored, there = loop.stored.below("feature/"), agents.valid[..., None]
    # the official code moves the zeros of samples that are missing into the frame of the ego
    for name, mask in (("position", there), ("heading", there[..., 0])):
        stored.values[f"agent.{name}"] = stored.values[f"agent.{name}"] * mask
    loop.match(stored, ours, FEATURE)


def compare_network(loop: Loop, outputs: Outputs, batch: Any) -> None:
    """Compare what is stored of the network's outputs for one iteration."""
    stored = loop.stored.below("net/")
    found = {name: value[0] for name, value in outputs(loop.planner.network, batch).items()}
    large = LARGE if loop.name == "pluto" else ()
    ours = {name: value for name, value in found.items() if name.partition("[")[0] not in large}
    compare_outputs(stored, loop.where, ours, f"{loop.name} ({loop.variant})")


def plan(loop: Loop) -> dict[str, Any]:
    return {"trajectory_time_us": loop.answer.time_us, "trajectory": loop.answer.states[:, :7]}


@plantf
@pytest.mark.files("closed_loop_*.npz")
def test_plantf_closed_loop(path: Path, scenes: Scenes, cases: Cases) -> None:
    plans = ("trajectory_time_us", "trajectory")
    for loop in loop_steps(path, PlanTF, scenes, cases, plans):
        loop.match(loop.row, plan(loop), {"trajectory": PLAN})
        # velocities and accelerations from the recorded poses [m/s, m/s^2]
        motion = plan_of_poses(loop.row["trajectory"][1:, :3], loop.seen.history).states[:, 3:7]
        loop.match(loop.row, {"trajectory[:, 3:]": motion}, 1e-5, "recorded")
        if list(loop.stored):
            agents, near, current_state, route = loop.features
            # the official code gives every agent the category of the ego at inference
            category = np.zeros(len(agents.valid), np.int64)
            more = {"current_state": current_state, "agent.category": category}
            compare_features(loop, agents, near, route, more)
            compare_network(loop, plantf_outputs, make_batch([loop.features], "cpu"))


@pluto
@pytest.mark.files("closed_loop_*.npz")
def test_pluto_closed_loop(path: Path, scenes: Scenes, cases: Cases) -> None:
    with np.load(path, allow_pickle=False) as archive:
        if scenes.entries and str(archive["meta/scene"]) not in scenes.entries:
            return compare_without_log(path, cases)
    plans = ("trajectory_time_us", "trajectory", "best_index", "emergency_brake")
    for loop in loop_steps(path, Pluto, scenes, cases, plans):
        compare_choice(loop)
        if "agent_tokens" in loop.stored:  # one of the iterations stored in full
            compare_stored(loop)
        stored, choice, best = loop.stored.below("post/"), loop.planner.choice, loop.row
        best, total = int(best["best_index"]), stored["rule"] + 0.3 * stored["lscore"]
        first, second = np.sort(total)[-2:][::-1] if len(total) > 1 else (np.inf, 0.0)
        if choice.best != best and first - second <= NEAR_TIE:
            what = f"proposal {choice.best} instead of {best}, scores {first:.6f} and {second:.6f}"
            cases.note(f"{loop.name} {loop.where}: near-tie, {what}")
        else:
            ours = {**plan(loop), "best_index": choice.best, "emergency_brake": choice.braked}
            # velocities are derivatives of poses 0.1 s apart
            loop.match(loop.row, ours, {"trajectory": [2e-3, 2e-3, 2e-4, *[1e-2] * 4]})


def compare_without_log(path: Path, cases: Cases) -> None:
    """What follows from the stored arrays alone: outputs of the network, combined scores."""
    file = read_file(path, cases, path.stem)
    called = f"pluto ({file['meta/variant']})"
    network = make_planner(Pluto, str(file["meta/variant"])).network
    for number in range(len(file["out/best_index"])):
        stored, where = file.below(f"it{number:02d}/"), f"{file.name} iteration {number}"
        if "agent_tokens" in stored:  # one of the iterations stored in full
            given = {name: value[None] for name, value in stored.below("feature/").values.items()}
            said = pluto_outputs(
                network, stored_inputs(replace(stored, values=given), Pluto, PLUTO_INPUTS)
            )
            ours = {n: value[0] for n, value in said.items() if n.partition("[")[0] not in LARGE}
            compare_outputs(stored.below("net/"), where, ours, called)
        compare_combined(stored.below("post/"), where)
    cases.note(f"{path.name}: without its log, what is made of that")


def compare_combined(stored: File, where: str) -> None:
    """Compare how the scores of proposals are combined."""
    parts = (stored[name] for name in ("multi", "weighted", "progress"))
    progress, rule = scoring.aggregate(*parts)
    ours = {"weighted[0]": progress, "rule": rule}
    stored.match(where, ours, SCORED, quantity="pluto aggregated")


def compare_choice(loop: Loop) -> None:
    """The proposals, where they are made from the log on, and the scores that are combined."""
    choice, stored = loop.planner.choice, loop.stored.below("post/")
    scores = choice.scores
    ours = {
        "cand": choice.poses,
        "lscore": choice.learned,
        "agents_pred": choice.agents.poses,
        "agents_vel": choice.agents.speeds,
        "rule": scores.rule,
        "multi": scores.factors,
        "weighted": scores.terms,
        "progress": scores.progress,
        "fault_t": scores.fault_times,
        "footprints": scores.flags,
        "speed_limit": scores.speed_limits,
        "rollout": scores.driven,
    }
    atol: Any = {"cand": POSES, "agents_pred": POSES, "rollout": ROLLOUT, "progress": 2e-3}
    atol |= {"lscore": 1e-4, "rule": 1e-4, "weighted": 1e-4, "fault_t": SCORED}
    atol["agents_vel"] = drive_bound(loop.variant)
    loop.match(stored, only(stored, ours), atol)
    compare_combined(stored, loop.where)


def compare_stored(loop: Loop) -> None:
    """Features, raw outputs, and what the scores of the stored proposals are."""
    compare_pluto_features(loop)
    choice, stored = loop.planner.choice, loop.stored.below("post/")
    batch = pluto_planner.make_batch([loop.features], "cpu")
    compare_network(loop, pluto_outputs, batch)
    agents, proposals = choice.agents, np.ascontiguousarray(stored["cand"])
    agents = agents._replace(poses=stored["agents_pred"], speeds=stored["agents_vel"])
    scores = loop.planner.rate(loop.seen, proposals, stored["lscore"], agents).scores
    seen = loop.planner.surroundings
    line = scoring.nearest_line(seen.lines, loop.seen.history.ego[-1])
    tokens = [loop.tracks.tokens[i] for i in seen.agents.tracks]
    loop.match(stored, {"agents_tok": tokens, "baseline": line}, SCORED)
    ours = {
        "rule": scores.rule,
        "multi": scores.factors,
        "weighted": scores.terms,
        "progress": scores.progress,
        "fault_t": scores.fault_times,
        "footprints": scores.flags,
        "speed_limit": scores.speed_limits,
        "rollout": scores.driven,
    }
    loop.match(stored, ours, SCORED, "stored proposals'")


def compare_pluto_features(loop: Loop) -> None:
    """Compare what was made before the network."""
    seen, given, road = loop.planner.surroundings, loop.features, loop.road
    near, lines = seen.road, seen.lines
    blocks = [
        0 if kind == CROSSWALK else int(road.blocks.ids[road.block_of[row]])
        for row, kind in zip(near.objects.tolist(), near.kind.tolist(), strict=True)
    ]
    more = {
        "map.polygon_road_block_id": np.array(blocks, np.int64),
        "current_state": given.current_state,
        "agent.category": given.category,
        "reference_line.position": given.line_points,
        "reference_line.vector": given.line_vectors,
        "reference_line.orientation": given.line_orientations,
        "reference_line.valid_mask": given.line_valid,
        "reference_line.future_projection": np.zeros((len(lines), 8, 2)),
    }
    compare_features(loop, seen.agents, near, loop.planner.route.blocks, more)
    stored = loop.stored.below("reference_line_")
    loop.compare("reference lines", len(lines), len(list(stored)))
    numbered = {str(number): line for number, line in enumerate(lines)}
    loop.match(stored, numbered, LINE, "reference line")
    # the official code takes static objects out of a set: their order means nothing
    theirs, order = loop.stored.below("feature/static_objects."), by_place(given.object_pose)
    ours = {
        "position": given.object_pose[order][:, :2],
        "heading": given.object_pose[order][:, 2],
        "shape": given.object_shape[order],
        "category": given.object_category[order],
        "valid_mask": given.object_valid[order],
    }
    loop.match(theirs.at(by_place(theirs["position"])), ours, FEATURE, "static_objects")


def by_place(poses: Any) -> Any:
    """Order by place, to the centimetre."""
    return np.lexsort(np.rint(np.asarray(poses, np.float64)[:, :2] * 100.0).T[::-1])


@pluto
@pytest.mark.files("refl.npz")
def test_arc_length_at_a_vertex(path: Path, cases: Cases) -> None:
    """The ego lies off the outer side of a bend, its projection is a vertex of the path."""
    file, listed = read_file(path, cases), json.loads((path.parent / "refl.json").read_text())
    line, (x, y) = np.ascontiguousarray(file["line"]), file["xy"]
    cases.compare("pluto line", path.name, line, np.array(listed[2]))
    path = make_path(np.column_stack([line, np.zeros(len(line))]))
    along = project_on_polyline(line, path.progress, 0, len(line), x, y)
    cases.compare("pluto arc length", file.name, along, VERTEX)
    file.finish()


@pluto
@pytest.mark.files("emergency_brake.npz")
def test_emergency_brake(path: Path, cases: Cases) -> None:
    file = read_file(path, cases, path.stem)
    file.match("file", {"columns": list(FILE_COLUMNS)})
    for number, case in enumerate(rows := file.array_rows()):
        ego, time = case.take("ego", NUM_STATE), float(case["fault_time"])
        speed = float(np.hypot(ego[VX], ego[VY]))
        braked, states = scoring.must_brake(speed, time), np.full((81, NUM_STATE), np.nan)
        if braked:
            states = scoring.brake(case["candidate"], ego, time, PACIFICA)
        ours = {"speed": speed, "braked": braked, "states": states}
        case.match(f"case {number}", ours, {"speed": LINE, "": STATE})
    rows[-1].finish()


# --- manifests and files

WEIGHTS = {"total_elements": "", "trainable_parameters": ""}


@plantf
@pytest.mark.files("state_dict.json")
def test_plantf_manifest(path: Path, cases: Cases) -> None:
    compare_manifest(path, cases, PlanTF, lambda made: vector_manifest(made, PlanTF), WEIGHTS)


@pluto
@pytest.mark.files("state_dict.json")
def test_pluto_manifest(path: Path, cases: Cases) -> None:
    compare_manifest(
        path,
        cases,
        Pluto,
        lambda made: vector_manifest(made, Pluto, build_reference_line=True),
        WEIGHTS,
    )


@pytest.mark.reference("plantf", "pluto")
def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    known = ["forward_*.npz", "closed_loop_*.npz", "state_dict.json", "*.db", "*-[0-9]"]
    own = ["emergency_brake.npz", "refl.json", "refl.npz"] if "pluto" in folder.name else []
    name_unknown(folder, cases, *known, *own)


# --- proof that a changed value is noticed


@pytest.mark.parametrize(
    ("test", "file", "name", "index"),
    [
        *(
            (test_plantf_forward, "plantf/forward_b2_drive", name, 0)
            for name in ("out/probability", "in/agent.velocity", "in/map.point_side")
        ),
        *(
            (test_plantf_closed_loop, "plantf/closed_loop_s04_left_turn_drive", name, index)
            for name, index in (
                *(("out/trajectory", 900), ("it00/feature/agent.position", 30)),
                *(("it00/map_ids", 0), ("meta/token", 0), ("it00/net/prediction", 0)),
            )
        ),
        *(
            (test_pluto_forward, "pluto/forward_b1_sparse", name, 0)
            for name in ("out/hidden", "out/output_prediction", "in/reference_line.vector")
        ),
        *((test_emergency_brake, "pluto/emergency_brake", name, 0) for name in ("ego", "states")),
        *(
            (test_pluto_closed_loop, "pluto/closed_loop_s02_curve_objects_drive", name, index)
            for name, index in (
                *(("out/best_index", 0), ("it00/post/rule", 0), ("it00/post/cand", 40)),
                *(("it00/post/baseline", 0), ("it00/feature/static_objects.heading", 0)),
            )
        ),
    ],
)
@pytest.mark.thorough
def test_a_changed_value_is_noticed(
    test: Any, file: str, name: str, index: int, tmp_path: Path, nuplan_reference: Path
) -> None:
    path, cases = tmp_path / f"{Path(file).name}.npz", Cases()
    change_array(GOLDEN / f"{file}.npz", path, name, index, amount=0.05)
    is_loop = test in (test_plantf_closed_loop, test_pluto_closed_loop)
    assert noticed(test, path, *((open_scenes(nuplan_reference),) if is_loop else ()), cases)


@pytest.mark.parametrize(
    ("part", "test"), [("plantf", test_plantf_manifest), ("pluto", test_pluto_manifest)]
)
@pytest.mark.parametrize(
    "keys",
    [
        *(("keys", 3, "shape"), ("keys", 3, "dtype"), ("total_elements",)),
        *(("selfcheck", "norm.bias", 1), ("feature_builder", "radius"), ("checkpoint", "prefix")),
    ],
)
@pytest.mark.thorough
def test_a_changed_manifest_is_noticed(part: str, test: Any, keys: Any, tmp_path: Path) -> None:
    cases = Cases()
    change_json(GOLDEN / part / "state_dict.json", tmp_path / "state_dict.json", *keys)
    assert noticed(test, tmp_path / "state_dict.json", cases)
