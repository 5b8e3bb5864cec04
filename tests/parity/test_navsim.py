"""PDMS and EPDMS against NAVSIM's own scorers, on frames of the reference scenes."""

import json
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from parity_cases import Cases, File, Scenes, name_unknown, read_file

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.metrics import navsim
from shiftsim.metrics.navsim import FrameWorld, Scores
from shiftsim.planners.pdm.scorer import TTC_STEPS
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import HEADING, LAST_AGENT_KIND, AgentKind, LightStatus, TrafficLights

pytestmark = [pytest.mark.golden, pytest.mark.reference("navsim")]

PDM = ("score", "progress_m")
UNSTABLE_BEARING = 1e-7  # rad from dead ahead or dead behind
STATES = 1e-8  # driven states: coordinates near 5e6 are spaced 1e-9
ROUNDED = 1e-6  # differences of signals that are rounded to 8 decimals
BOUNDS = {"ego_progress": 1e-6, "progress_m": 1e-6, "score": 1e-9, "pdm_score": 1e-9}
NAMES = {
    name for rules in navsim.VERSIONS.values() for name in (*rules.multipliers, *rules.weights)
}
TABLES = ("frames.parquet", "arrays.npz", "scores.parquet", "pairs.parquet", "v1_scores.parquet")


class Frame:
    """One frame of the reference, and its scenario with the lights that NAVSIM saw."""

    def __init__(self, row: File, arrays: File, scenes: Scenes) -> None:
        scene, self.iteration = row["scene"][0], int(row["iteration"][0])
        self.name, self.row, self.is_now = (
            f"{scene}/{self.iteration}",
            row,
            row["which"][0] == "now",
        )
        self.arrays = arrays.below(f"{self.name}/")
        self.red = [
            (step, name.removeprefix("red_light_")) for step, name in json.loads(row["red"][0])
        ]
        self.scenario: Scenario = scenes[scene.partition("@")[0]]
        if "@" in scene:
            names, count = tuple(sorted({name for _, name in self.red})), len(self.scenario.time_us)
            status = np.full((count, len(names)), LightStatus.RED, np.int8)
            self.scenario = replace(self.scenario, traffic_lights=TrafficLights(names, status))
        self.key, self.plans = (scene, str(self.iteration)), self.arrays["poses"]

    def world(self, version: str) -> FrameWorld:
        return navsim.frame_world(self.scenario, self.iteration, version)


def frames(folder: Path, scenes: Scenes, cases: Cases) -> Iterator[Frame]:
    """The frames in their order; the files are finished behind them."""
    table, arrays = (read_file(folder / name, cases) for name in TABLES[:2])
    for row in table.groups("scene", "iteration").values():
        yield Frame(row, arrays, scenes)
    table.note("not in a scenario, or of what was not scored", "token", "scene_type")
    table.finish()
    arrays.finish()


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    name_unknown(folder, cases, *TABLES)


def test_second_version(folder: Path, scenes: Scenes, cases: Cases) -> None:
    scores, pairs = (read_file(folder / name, cases) for name in TABLES[2:4])
    by_frame, by_pair = scores.groups("scene", "iteration"), pairs.groups("scene", "now")
    before: Scores | None = None
    for frame in frames(folder, scenes, cases):
        world, rows, where = frame.world("v2"), by_frame[frame.key], frame.name
        cases.compare("candidates", where, frame.arrays["names"], rows["candidate"])
        compare_world(frame, world)
        raw = settled(navsim.score(world, frame.plans, human_filter=False), frame, world)
        found = columns(raw, rows.below("raw_"))
        rows.match(where, {f"raw_{name}": value for name, value in found.items()}, bounds("raw_"))
        compare_others(rows, where, world, raw)
        previous = before if frame.is_now else None
        full = settled(navsim.score(world, frame.plans, previous=previous), frame, world)
        # NAVSIM does not update this column
        ours = {**columns(full, rows), "pdm_score": raw.score}
        indices = {"collision_idx": raw.collision_index, "ttc_idx": raw.ttc_index}
        times = {"start_time": np.full(len(full.score), world.time_us * 1e-6)}
        if previous is None:
            ours["two_frame_extended_comfort"] = np.full(len(full.score), np.nan)
        else:
            compare_pair(by_pair[frame.key], where, full, previous)
        rows.match(where, {**ours, **indices, **times}, BOUNDS)
        before = full
    scores.note("keys", "which")
    scores.finish()
    pairs.finish()


def test_first_version(folder: Path, scenes: Scenes, cases: Cases) -> None:
    scores = read_file(folder / "v1_scores.parquet", cases)
    by_frame = scores.groups("scene", "iteration")
    for frame in frames(folder, scenes, Cases()):
        if frame.key not in by_frame:
            continue
        world, rows, where = frame.world("v1"), by_frame[frame.key], frame.name
        cases.compare("candidates", where, frame.arrays["names"], rows["candidate"])
        full = settled(navsim.score(world, frame.plans), frame, world)
        indices = {"collision_idx": full.collision_index, "ttc_idx": full.ttc_index}
        rows.match(where, {**columns(full, rows), **indices}, BOUNDS)
        reference = world.reference
        other = with_ttc(reference, 1.0 - reference.time_to_collision_within_bound, "v1")
        expected = rows["pdm_score"][0]
        if reference.score[0] != expected == other.score[0]:
            assert is_in_line(reference.states[0], world)
            cases.note(f"ttc of the reference at {where}: an object exactly ahead or behind")
            reference = other
        ours = {name: getattr(reference, name).repeat(len(full.score)) for name in PDM}
        rows.match(where, {f"pdm_{n}": value for n, value in ours.items()}, bounds("pdm_"))
    scores.note("of the files", "max_state_difference_to_v2")
    scores.finish()


def columns(scores: Scores, rows: File) -> dict[str, Any]:
    """What the rows have of scores, by NAVSIM's names."""
    values = {field.name: getattr(scores, field.name) for field in fields(scores)}
    if "pdm_score" in rows and "score" not in rows:
        values["pdm_score"] = scores.score
    return {name: values[name] for name in values if name in rows and values[name] is not None}


def bounds(prefix: str) -> dict[str, float]:
    return {f"{prefix}{name}": bound for name, bound in BOUNDS.items()}


def compare_world(frame: Frame, world: FrameWorld) -> None:
    """Compare all that NAVSIM was given, or made of it before plans were scored."""
    arrays, row, where, around = frame.arrays, frame.row, frame.name, world.around
    before = frame.scenario.iteration_rows[frame.iteration] - 10 * np.arange(3, -1, -1)
    ours: dict[str, Any] = {
        "ego_state": world.ego,
        "past_time_us": frame.scenario.time_us[before],
        "past_states": frame.scenario.ego[before],
        "pdm_simulated": world.reference.states[0],
        "human_simulated": world.human.states[0],
    }
    arrays.match(where, ours, {"past_time_us": 0.0, "": STATES}, quantity="world")
    line = np.array(world.ground.centerline.coords)
    cases = arrays.report
    cases.compare("world centerline", where, line, arrays["centerline[:, :2]"])
    plan = arrays["pdm_trajectory[:41, :3]"]
    cases.compare("world pdm_trajectory", where, world.plan, plan, atol=STATES, angle=True)
    compare_objects(arrays, where, world, frame)
    edges, ground = frame.scenario.map.edges, world.ground
    on_route = sorted(edges.ids[e] for e in np.flatnonzero(ground.lanes.on_route[: len(edges)]))
    types = zip(
        row["drivable_types"][0].split(","), row["drivable_tokens"][0].split(","), strict=True
    )
    cases.compare("world route", where, on_route, sorted(row["route_lane_ids"][0].split(",")))
    cases.compare("world areas", where, areas_by_type(frame.scenario, ground), sorted(types))
    count = len(ground.near_lanes) + len(ground.near_drivable)
    red = np.bincount([step for step, _ in frame.red], minlength=41)
    cases.compare("world lights", where, around.red.sum(axis=1), red)
    row.match(where, {"time_us": [world.time_us], "n_drivable": [count]}, quantity="world")
    row.match(where, {"n_objects": [int(np.isfinite(around.others.centers[:, :, 0]).sum())]})


def areas_by_type(scenario: Scenario, ground: navsim.Ground) -> list[tuple[str, str]]:
    road = scenario.map
    named = [("ROADBLOCK", name) for name in road.blocks.ids]
    named += [("INTERSECTION", name) for name in road.intersections.ids]
    named += [("CARPARK_AREA", name) for name in road.car_parks.ids]
    lanes = [
        ("LANE_CONNECTOR" if road.is_connector(e) else "LANE", road.edges.ids[e])
        for e in ground.near_lanes.tolist()
    ]
    return sorted([*lanes, *(named[area] for area in ground.near_drivable.tolist())])


def compare_objects(arrays: File, where: str, world: FrameWorld, frame: Frame) -> None:
    """Compare the boxes of every step, and kinds and speeds of their first appearance."""
    others, cases, row = world.around.others, arrays.report, frame.scenario.iteration_rows
    rows = row[frame.iteration] + 10 * np.arange(9)
    tracks = frame.scenario.tracks
    seen = [tracks.tokens[n] for n in np.flatnonzero(tracks.valid[rows].any(axis=0)).tolist()]
    step, tokens = arrays["objects_step"], arrays["objects_token"].tolist()
    index = np.array([seen.index(token) for token in tokens])
    at = [
        arrays[f"objects_{name}"] for name in ("x", "y", "heading", "length", "width", "vx", "vy")
    ]
    theirs = boxes_to_corners(np.stack(at[:3], axis=-1), np.stack(at[3:5], axis=-1))
    cases.compare("world boxes", where, others.boxes[step, index], theirs, atol=STATES)
    first = np.unique(index, return_index=True)[1]
    kinds = np.array([AgentKind[name] for name in arrays["objects_type"].tolist()])[first]
    is_agent, speeds = kinds <= LAST_AGENT_KIND, np.hypot(at[5], at[6])[first]
    cases.compare("world agents", where, others.is_agent, is_agent)
    speeds = np.where(is_agent, speeds, 0.0)
    cases.compare("world speeds", where, others.speeds[0], speeds, atol=STATES)


def settled(scores: Scores, frame: Frame, world: FrameWorld) -> Scores:
    """Our scores from the plans, where needed with the time to collision of NAVSIM's states.

    From these everything must be as from our own. The bearing of what is exactly ahead is an arccos
    of a number that may round beyond 1, so that the last bit of a state decides whether it counts.
    """
    states, cases = frame.arrays["simulated"], frame.arrays.report
    cases.compare("states", frame.name, scores.states, states, atol=STATES)
    cases.compare("areas", frame.name, scores.flags, frame.arrays["areas"])
    place = world.ground, world.around, world.version, world.past
    index = navsim.evaluate(states, *place)["ttc_index"]
    for plan in np.flatnonzero(index != scores.ttc_index).tolist():
        assert is_in_line(states[plan], world)
        cases.note(f"ttc at {frame.name}, plan {plan}: an object exactly ahead or behind")
    ttc = np.where(np.isfinite(index), 0.0, 1.0)
    return replace(with_ttc(scores, ttc, world.version), ttc_index=index)


def with_ttc(scores: Scores, ttc: np.ndarray, version: str) -> Scores:
    """Scores with other times to collision."""
    name, weights = "time_to_collision_within_bound", navsim.VERSIONS[version].weights
    total = sum(weight for n, weight in weights.items() if getattr(scores, n) is not None)
    gain = scores.multiplicative_metrics_prod * weights[name] / total
    score = scores.score + gain * (ttc - getattr(scores, name))
    return replace(scores, score=score, **{name: ttc})


def is_in_line(states: np.ndarray, world: FrameWorld) -> bool:
    """Whether anything is exactly ahead of the ego or behind it, from any of its states (T, 11)."""
    around, times = world.around, np.arange(len(states))
    cos, sin = np.cos(states[:, HEADING, None]), np.sin(states[:, HEADING, None])
    for later in TTC_STEPS:
        rows = around.rows[np.minimum(times + later, len(around.rows) - 1)]
        away = around.others.centroids[rows] - states[:, None, :2]
        aside = np.abs(cos * away[..., 1] - sin * away[..., 0])
        if (aside < UNSTABLE_BEARING * np.linalg.norm(away, axis=-1)).any():
            return True
    return False


def beside(reference: Scores, plans: Scores) -> dict[str, Any]:
    """Scores of the reference plan, its progress compared with that of each of the plans (v2)."""
    factor, raw = reference.multiplicative_metrics_prod, reference.progress_m
    most = np.maximum(plans.progress_m * plans.multiplicative_metrics_prod, raw * factor)
    share = np.clip(raw / np.maximum(most, navsim.MIN_PROGRESS), 0.0, 1.0)
    progress = np.where(most > navsim.MIN_PROGRESS, share, 1.0)
    score = reference.score + factor * 5.0 / 14.0 * (progress - reference.ego_progress)
    values = {name: getattr(reference, name) for name in (*NAMES, "multiplicative_metrics_prod")}
    values |= {"ego_progress": progress, "progress_m": raw, "pdm_score": score}
    return {n: np.broadcast_to(v, most.shape) for n, v in values.items() if v is not None}


def compare_others(rows: File, where: str, world: FrameWorld, raw: Scores) -> None:
    """Compare the scores of the reference plan and of what was driven."""
    pdm = beside(world.reference, raw)
    human = {
        name: np.broadcast_to(value, raw.score.shape)
        for name, value in columns(world.human, rows.below("human_")).items()
    }
    for prefix, scores in (("pdm_", pdm), ("human_", human)):
        named = {f"{prefix}{name}": value for name, value in scores.items()}
        rows.match(where, named, bounds(prefix))


def compare_pair(rows: File, where: str, full: Scores, previous: Scores) -> None:
    seconds = (full.time_us - previous.time_us) * 1e-6
    differences = navsim.extended_differences(full.states, previous.states, seconds)
    names = ("rms_acceleration", "rms_jerk", "rms_yaw_rate", "rms_yaw_accel")
    ours: dict[str, Any] = dict(zip(names, differences.T, strict=True))
    ours["two_frame_extended_comfort"] = full.two_frame_extended_comfort
    ours["overlap"] = np.full(len(differences), 41 - round(seconds / 0.1))
    rows.match(where, ours, dict.fromkeys(names, ROUNDED))
    rows.note("keys", "prev", "candidate")
