"""Edited scenarios against interPlan's own classes: codes, builds, traffic and closed loops.

The windows of this folder are 20 s long; interPlan's own are 30 s.
"""

import json
import random
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import places
import pytest
from parity_cases import Cases, File, Scenes, name_unknown, open_scenes, read_file

from shiftsim.edits.density import safe_speed
from shiftsim.edits.interplan import codes
from shiftsim.edits.interplan.build import HISTORY, SORTS, InterplanEditor
from shiftsim.edits.spec import MANNERS, make_edit
from shiftsim.errors import ConfigError, DataError, ShiftsimError
from shiftsim.metrics import compute_metrics
from shiftsim.metrics.interplan import (
    LaneChanges,
    add_interplan,
    driven_lanes,
    final_score,
    interplan_score,
    role_of,
)
from shiftsim.planners.idm import Idm
from shiftsim.sim.loop import simulate
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.sim.traffic.mixed import Scripted, share_walked
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind

pytestmark = [pytest.mark.golden, pytest.mark.reference("scenario_edits")]
GOLDEN = places.GOLDEN / "scenario_edits"

WINDOW = (20.0, 0.0, 0.5)  # s, s, share of the rows
FORMULA, POSE, METRIC = 1e-12, 1e-6, 1e-6
_ACCELERATIONS = {"accel_max": 1.0, "decel_max": 2.0}  # m/s^2, of interPlan's settings
_WEIGHTS = {
    "ego_progress_along_expert_route": 5.0,
    "time_to_collision_within_bound": 5.0,
    "lane_changes_to_goal": 4.0,
    "speed_limit_compliance": 4.0,
    "ego_is_comfortable": 2.0,
}
_BEHAVIORS = ("DEFAULT", "STOPPED", "CAUTIOUS", None)
_CLASSES = {AgentKind.VEHICLE: "ModifiedAgent", AgentKind.TRAFFIC_CONE: "StaticObject"}
_FAILURES = {  # what interPlan raises, and what our message says
    "AssertionError: Could not find a path": "no lanes lead to the goal",
}


@pytest.fixture
def windows(scenes_folder: Path) -> Scenes:
    """The scenes, in windows of this length."""
    return open_scenes(scenes_folder, mapping=WINDOW)


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    name_unknown(folder, cases, "tokens.json", "build.json", "traffic.json", "metrics.json")


@pytest.mark.files("tokens.json")
def test_tokens(path: Path, cases: Cases) -> None:
    part = read_file(path, cases)
    part.note("where the values are from", "note")
    compare_tokens(part)
    part.finish()


@pytest.mark.files("build.json", "traffic.json", "metrics.json")
def test_edits(path: Path, windows: Scenes, cases: Cases) -> None:
    """What the codes of interPlan build, how its agents move, and closed loops of the IDM."""
    part, details = read_file(path, cases), details_of(path.parent)
    part.note("where the values are from", "note")
    for case in part.each("cases"):
        scene = case["scene"]
        if "details" in case:
            case.used.add("details")
        where = f"{scene} {case['code']}"
        COMPARE[path.stem](case, where, windows[scene], details.get(scene, {}))
    part.finish()


def details_of(folder: Path) -> dict[str, Any]:
    """Details of the edits by scene, as the builds list them."""
    listed = json.loads((folder / "build.json").read_text())["cases"]
    return {case["scene"]: case.get("details") or {} for case in listed}


def compare_tokens(part: File) -> None:
    for case in part.each("parse"):
        code, where = case["code"], f"code {case['code']!r}"
        try:
            changes = codes.parse_code(code)
        except ConfigError as error:
            known = "KeyError" if "unknown" in error.message else "IndexError"
            case.match(where, {"error": known})
            continue
        ours = {"name": code_name(changes), "edits_agents": codes.edits_agents(changes)}
        case.match(where, ours)
        part.report.compare("tokens parse dict", where, items(changes), items(case["dict"]))
    names = [f"{token}-{code}" for token, found in part["preprocess"].items() for code in found]
    grouped = codes.group_names(names)
    part.report.compare("tokens preprocess", "names", items(grouped), items(part["preprocess"]))
    for case in part.each("random"):
        draws = random.Random(case["token"])
        ours = {
            "sample_of_6": draws.sample(range(6), 6),
            "randrange_10_33": draws.randrange(10, 33),
            "gauss_025_005": draws.gauss(0.25, 0.05),
            "gauss_0_1": draws.gauss(0, 1),
            "hex": format(draws.randrange(16**16), "=16x"),
            "randint": draws.randint(100, 1000),
        }
        case.match(case["token"], ours, FORMULA)
    for case in part.each("aggregation"):
        kind = case["scenario_type"]
        sorts = SORTS.get(kind, "")
        scores = dict.fromkeys((*_WEIGHTS, *_MULTIPLIERS), 1.0) | case["metrics_not_one"]
        case.match(kind, {"score": interplan_score(scores, sorts)}, FORMULA)
    for case in part.each("final"):
        types, weights = case["types"], case["weights"]
        given = [1.0 if weights == "default" else weights[name] for name, _, _ in types]
        final = final_score([(count, score) for _, count, score in types], given)
        case.match(f"weights {weights}", {"final": final}, FORMULA)
    for case in part.each("lane_change_score"):
        lanes = LaneChanges(case["initial"], case["final"])
        try:
            score: Any = lanes.score
        except DataError:
            score = "TypeError"
        case.match(f"{lanes.initial} to {lanes.final}", {"score": score}, FORMULA)
    for case in part.each("spawn_speed"):
        used = safe_speed(case["lead"], case["distance"], case["reaction"])
        case.match(f"lead {case['lead']}", {"used": used}, FORMULA)
        case.note("speed before it is limited to half the distance", "safe")
    for case in part.each("first_car_speed"):
        speed = min(float(np.sqrt(2.0 / 3.0 * case["distance_to_end"])), _LIMIT)
        case.match(f"{case['distance_to_end']} m", {"speed": speed}, FORMULA)
    for case in part.each("pedestrian_fraction"):
        share = share_walked(case["iteration"], case["activation"], case["iterations"])
        case.match(f"iteration {case['iteration']}", {"fraction": share}, FORMULA)
    part.note("hashes of lists that are not part of this package", "lists")
    part.note("follows from the published list, which is not here", "behavior_in_force_interplan10")


_LIMIT = 10.0  # m/s, speed limit of the reference
_MULTIPLIERS = (
    "no_ego_at_fault_collisions",
    "drivable_area_compliance",
    "ego_is_making_progress",
    "driving_direction_compliance",
)


def items(table: Mapping[str, Any]) -> list[str]:
    return sorted(f"{name}={value!r}" for name, value in table.items())


def apply_edit(
    scenario: Scenario, code: str, details: Mapping[str, Any], manner: str = ""
) -> tuple[InterplanEditor, Scenario]:
    edit = make_edit({"name": code, "code": code, "details": details}, f"code {code}")
    editor = InterplanEditor(scenario, edit, driven_lanes)
    edited = editor.result()
    if manner and edited.script:
        index = MANNERS.index(manner.lower())
        edited = replace(edited, script=replace(edited.script, yielding=index))
    return editor, edited


def compare_build(case: File, where: str, scenario: Scenario, details: Any) -> None:
    if "error" in case:
        theirs = case["error"]
        expected = [ours for text, ours in _FAILURES.items() if theirs.startswith(text)]
        case.match(where, {"token": scenario.token})
        try:
            apply_edit(scenario, case["code"], details)
        except ShiftsimError as error:
            fits = bool(expected) and expected[0] in error.message
            case.report.compare("build error", where, fits, True)
            return
        case.report.fail("build error", where, f"no error, not {theirs!r}")
        return
    editor, edited = apply_edit(scenario, case["code"], details)
    ids = scenario.map.edges.ids
    agents = codes.edits_agents(editor.changes)
    name = f"{scenario.token}-{code_name(editor.changes)}"
    ours = {
        "token": scenario.token,
        "scenario_name": name,
        "scenario_type": edited.scenario_type,
        "iterations": edited.num_iterations,
        "route": list(edited.route),
        "lanes": [ids[lane] for lane in editor.plan.lanes],
        "ego_lane": ids[editor.ego_edge] if agents else None,
    }
    case.match(where, ours)
    changes = items({**_ACCELERATIONS, **editor.changes})
    case.report.compare("build modification", where, changes, items(case["modification"]))
    numbers = {
        "goal": edited.mission_goal,
        "initial_ego": edited.expert[0, :5],
        "modified_initial_ego_speed": editor.ego_speed if agents else None,
    }
    case.match(where, numbers, POSE)
    compare_objects(case, where, edited, editor)
    line = case.each("expert_line")[0]
    plan = editor.plan.line
    line.match(where, {"n": len(plan), "first": plan[0], "last": plan[-1]}, POSE)
    states = case["expert_states"]
    centers = editor.plan.centers[[int(i) for i in states]]
    case.report.compare("build expert_states", where, centers, list(states.values()), atol=POSE)
    if agents:
        for number, (theirs, walker) in enumerate(
            zip(case.each("pedestrians"), editor.crossings, strict=True)
        ):
            length = float(np.hypot(*(walker.end - walker.start[:2])))
            walk = {"start": walker.start, "length": length}
            theirs.match(f"{where} pedestrian {number}", walk, POSE)
            theirs.match(f"{where} pedestrian {number}", {"activation": walker.iteration or None})


def compare_objects(case: File, where: str, edited: Scenario, editor: InterplanEditor) -> None:
    """Objects at iteration 0; where only the goal is changed, also those of the log."""
    row, tracks = int(edited.iteration_rows[0]), edited.tracks
    there = np.flatnonzero(tracks.valid[row]).tolist()
    place = {tracks.tokens[i]: i for i in there}
    behaviors = {vehicle.token: vehicle.behavior for vehicle in editor.vehicles}
    objects = case.each("objects0")
    theirs = [thing["token"] for thing in objects]
    case.report.compare("build objects0 tokens", where, sorted(place), sorted(theirs))
    for thing in objects:
        token = thing["token"]
        if token not in place:
            continue
        track = place[token]
        kind = AgentKind(int(tracks.kinds[track]))
        behavior = _BEHAVIORS[behaviors[token]] if token in behaviors else None
        is_logged = kind <= LAST_AGENT_KIND and behavior is None
        label = {
            "type": kind.name,
            "behavior": behavior,
            "cls": "Agent" if is_logged else _CLASSES.get(kind, "StaticObject"),
        }
        thing.match(f"{where} {token}", label)
        box = [*tracks.poses[row, track], *tracks.sizes[row, track]]
        moves = np.nan_to_num(tracks.velocities[row, track])
        names = ("x", "y", "heading", "length", "width", "vx", "vy")
        numbers = dict(zip(names, [*box, *moves], strict=True))
        thing.match(f"{where} {token}", numbers, POSE, angles=("heading",))


def compare_traffic(case: File, where: str, scenario: Scenario, details: Any) -> None:
    """Agents beside the logged ego, and where they were before."""
    editor, edited = apply_edit(scenario, case["code"], details, case["behavior"])
    where = f"{where} {case['behavior']}"
    case.match(where, {"past_frames": HISTORY})
    tokens = [vehicle.token for vehicle in editor.vehicles]
    columns = [edited.tracks.tokens.index(token) for token in tokens]
    rows = edited.iteration_rows[0] - edited.row_step * np.array([HISTORY, 1])
    assert rows[0] >= 0
    for name, poses in zip(("past_first", "past_last"), edited.tracks.poses[rows], strict=True):
        theirs, poses = case[name], poses[columns]
        case.report.compare(f"traffic {name}", where, tokens, [row[0] for row in theirs])
        numbers = np.array([row[1:] for row in theirs]).reshape(-1, 3)
        case.report.compare(f"traffic {name} poses", where, poses, numbers, atol=POSE)
    tracks, traffic = edited.tracks.rows(edited.iteration_rows), Scripted(IdmTraffic())
    traffic.start(edited, tracks, 0)
    ego, done = edited.ego[edited.iteration_rows].copy(), 0
    ego[1:] = scenario.expert[1:]
    for row in case.each("rows"):
        iteration = row["iteration"]
        for step in range(done, iteration):
            traffic.step(step, ego[step], tracks, step + 1)
        done = max(done, iteration)
        there = np.flatnonzero(tracks.valid[iteration]).tolist()
        place = {tracks.tokens[i]: i for i in there}
        objects = row["objects"]
        at, theirs = f"{where} {iteration}", [thing[0] for thing in objects]
        if not case.report.compare("traffic tokens", at, sorted(place), sorted(theirs)):
            continue
        index = [place[token] for token in theirs]
        kinds = [AgentKind(kind).name for kind in tracks.kinds[index].tolist()]
        case.report.compare("traffic types", at, kinds, [thing[1] for thing in objects])
        values = [tracks.poses, tracks.sizes, np.nan_to_num(tracks.velocities)]
        ours = np.concatenate([value[iteration, index] for value in values], axis=1)
        numbers = np.array([thing[2:] for thing in objects]).reshape(-1, 7)
        case.report.compare("traffic objects", at, ours, numbers, atol=POSE)


def compare_metrics(case: File, where: str, scenario: Scenario, details: Any) -> None:
    """A closed loop of the IDM planner: where it drove, metrics and score."""
    _, edited = apply_edit(scenario, case["code"], details, case["behavior"])
    if edited.script is None:
        raise DataError("an edited scenario without a script")
    log = simulate(edited, Idm(), traffic="reactive")
    result = add_interplan(compute_metrics(log, edited.map), log, edited.map, edited.script)
    case.match(where, {"scenario_type": edited.scenario_type, "samples": len(log.ego)})
    states = [row for row in case["ego"] if row[0] < len(log.ego)]
    ours = log.ego[[row[0] for row in states], :4]
    case.report.compare("metrics ego", where, ours, [row[1:] for row in states], atol=POSE)
    metrics = case.each("metrics")[0]
    scores = {name: score for name, score in result.scores.items() if name != _OWN}
    metrics.match(where, scores, METRIC)
    case.match(where, {"score": result.score}, METRIC)
    known = {(item.metric, item.name): item.value for item in result.statistics}
    for part in case.each("statistics"):
        for metric in part:
            for name, value in part[metric].items():
                label = f"metrics statistics {name}"
                own = known.get((metric, name), np.nan)
                case.report.compare(label, where, own, float(value), atol=METRIC)
    sorts = edited.script.sorts
    multipliers = [name for name in result.scores if role_of(name, sorts)[0] == "multiplier"]
    case.report.compare(
        "metrics multipliers", where, sorted(multipliers), sorted(case["multipliers"])
    )
    weights = {**_WEIGHTS, "default": 1.0}
    case.report.compare("metrics weights", where, items(weights), items(case["weights"]))


_OWN = "corners_in_drivable_area"  # a metric without a score that the reference leaves out


COMPARE = {"build": compare_build, "traffic": compare_traffic, "metrics": compare_metrics}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("tokens", lambda d: d["lane_change_score"][8].update(score=0.6)),
        ("build", lambda d: d["cases"][0]["objects0"][1].update(x=0.0)),
        ("traffic", lambda d: d["cases"][0]["rows"][2]["objects"][0].__setitem__(1, "BICYCLE")),
        (
            "metrics",
            lambda d: d["cases"][0]["statistics"]["lane_changes_to_goal"].update(
                did_ego_got_to_goal_lane=0.0
            ),
        ),
    ],
)
def test_a_changed_value_is_noticed(
    name: str, change: Any, tmp_path: Path, nuplan_reference: Path
) -> None:
    cases = Cases()
    for path in GOLDEN.glob("*.json"):
        content = json.loads(path.read_text())
        if path.stem == name:
            change(content)
        if path.stem in ("traffic", "metrics"):
            content["cases"] = content["cases"][:1]
        (tmp_path / path.name).write_text(json.dumps(content))
    path = tmp_path / f"{name}.json"
    if name == "tokens":
        test_tokens(path, cases)
    else:
        test_edits(path, open_scenes(nuplan_reference, mapping=WINDOW), cases)
    assert len(cases.mismatches) == 1
    assert cases.mismatches[0].startswith(name)


def code_name(changes: Mapping[str, Any]) -> str:
    """The canonical code: letters in the order a, d, g, o; a special scenario alone."""
    if (number := changes.get("special_scenario")) is not None:
        return f"s{number}"
    return "".join(
        f"{letter}{changes[name]}" for letter, name in codes.LETTERS.items() if name in changes
    )
