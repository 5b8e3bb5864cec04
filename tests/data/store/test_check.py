"""A store that is spoilt in one way: the check names the scenario, the value, the limit."""

import dataclasses

import numpy as np
import pytest
import shapely
from stores import write_toy_store
from worlds import cruise_scenario, standing_tracks, straight_road

import shiftsim
from shiftsim.cli import main
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store import recordings as stored
from shiftsim.data.store.check import survey_store
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import MapError
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.state import AgentKind

LONG = 40  # iterations


def _moving(rows, speed=6.0, told=1.0, turned=0.0):
    """A car along the left lane; its velocity and heading may say something else."""
    poses = np.tile([[20.0, 3.5, turned]], (1, 1))
    tracks = standing_tracks(rows, poses, [AgentKind.VEHICLE])
    tracks.poses[:, 0, 0] += speed * 0.05 * np.arange(rows)
    tracks.velocities[:, 0] = [speed * told, 0.0]
    return tracks


def _write(path, *, road=None, scene=None, tracks=None, states=None, **changed):
    """One scenario on a straight road, some of it changed."""
    scene = scene or cruise_scenario(iterations=LONG)
    rows = len(scene.time_us)
    with StoreWriter(path) as writer:
        writer.add_map(road or straight_road())
        parts = _moving(rows) if tracks is None else tracks
        writer.add_recording(
            Recording("log", "straight", scene.time_us, parts, scene.traffic_lights)
        )
        writer.add_ego(EgoTrace("log", "ego", 0, scene.ego if states is None else states))
        window = Window(
            token="cafe",
            scenario_type="toy",
            log_name="log",
            ego="ego",
            first_row=0,
            last_row=rows,
            iteration_rows=scene.iteration_rows,
            row_step=2,
            route=scene.route,
            mission_goal=scene.mission_goal,
            mapping=scene.mapping,
        )
        writer.add_window(dataclasses.replace(window, **changed))
    return path


def _only(path):
    (problem,) = survey_store(path).problems
    assert problem.remedy
    return problem


def test_a_sound_store_has_no_problem_and_a_row_per_recording(tmp_path):
    report = survey_store(_write(tmp_path / "s"))
    assert report.problems == []
    (row,) = report.recordings
    assert (row.recording, row.scenarios, row.tracks, row.errors) == ("log", 1, 1, 0)


def test_no_scenario_at_all_is_an_error(tmp_path):
    with StoreWriter(tmp_path / "s") as writer:
        writer.add_map(straight_road())
    problem = _only(tmp_path / "s")
    assert problem.is_error
    assert "no scenarios, need at least 1" in problem.what


def test_repeated_boxes_are_an_error(tmp_path, monkeypatch):
    make = stored.tracks_table

    def twice(tracks, rows):
        table = make(tracks, rows)
        more = table.slice(3, 2 if rows.start == 0 else 0)
        return stored.pa.concat_tables([table, more]).combine_chunks()

    monkeypatch.setattr(stored, "tracks_table", twice)
    problem = _only(_write(tmp_path / "s"))
    assert (problem.is_error, problem.kind, problem.recording) == (True, "repeated rows", "log")
    assert "has two boxes in row 3 (2 such boxes)" in problem.what


@pytest.mark.parametrize("told", [0.0, 0.85, 1.2, 3.6, -1.0])
def test_a_velocity_of_a_track_that_contradicts_its_places_is_an_error(tmp_path, told):
    scene = cruise_scenario(iterations=LONG)
    problem = _only(_write(tmp_path / "s", tracks=_moving(len(scene.time_us), told=told)))
    assert (problem.is_error, problem.kind) == (True, "velocity")
    assert f"by {abs(told - 1.0):.0%}, at most 10%" in problem.what


def test_velocities_within_a_tenth_are_fine(tmp_path):
    scene = cruise_scenario(iterations=LONG)
    assert (
        survey_store(_write(tmp_path / "s", tracks=_moving(len(scene.time_us), told=1.09))).problems
        == []
    )


def test_a_velocity_that_is_wrong_at_the_ends_only_is_fine(tmp_path):
    tracks = _moving(len(cruise_scenario(iterations=LONG).time_us))
    tracks.velocities[:20] = tracks.velocities[-20:] = 0.0
    assert survey_store(_write(tmp_path / "s", tracks=tracks)).problems == []


def test_a_velocity_of_the_ego_that_contradicts_its_places_is_an_error(tmp_path):
    scene = cruise_scenario(iterations=LONG)
    states = scene.ego.copy()
    states[:, 3] *= 1.5
    problem = _only(_write(tmp_path / "s", states=states))
    assert (problem.is_error, problem.where) == (True, "recording log, ego ego")
    assert "by 50%" in problem.what


def test_headings_that_are_not_those_of_the_motion_are_an_error(tmp_path):
    tracks = _moving(len(cruise_scenario(iterations=LONG).time_us), turned=np.pi / 2)
    problem = _only(_write(tmp_path / "s", tracks=tracks))
    assert (problem.is_error, problem.kind) == (True, "heading")


def test_a_scenario_under_three_seconds_is_an_error(tmp_path):
    scene = cruise_scenario(iterations=30)
    problem = _only(_write(tmp_path / "s", scene=scene, mapping=(2.9, 0.0, 0.5)))
    assert (problem.is_error, problem.where) == (True, "scenario cafe")
    assert "it is 2.9 s long, need at least 3 s" in problem.what
    assert survey_store(_write(tmp_path / "t", scene=cruise_scenario(iterations=31))).problems == []


@pytest.mark.parametrize(
    ("wanted", "what"), [(3.9, "it lasts 3.9 s"), (15.0, "the log ended before the scenario did")]
)
def test_a_short_scenario_is_cut_off_only_where_its_log_ended_early(wanted, what, tmp_path):
    _write(tmp_path / "s", is_short=True, mapping=(wanted, 0.0, 0.5))
    problem = _only(tmp_path / "s")
    assert what in problem.what
    assert not problem.is_error


def test_an_ego_beside_the_map_is_an_error(tmp_path):
    scene = cruise_scenario(iterations=LONG, start=(10.0, 40.0, 0.0))
    problem = _only(_write(tmp_path / "s", scene=scene))
    assert (problem.is_error, problem.kind) == (True, "off the map")
    assert "34.8 m beside lanes" in problem.what


def test_an_ego_that_leaves_the_map_at_last_is_unusual(tmp_path):
    scene = cruise_scenario(iterations=LONG, future_rows=0, start=(420.0 - 29.3, 0.0, 0.0))
    problem = _only(_write(tmp_path / "s", scene=scene))
    assert (problem.is_error, problem.kind) == (False, "off the map")


def test_a_route_that_does_not_connect_is_an_error(tmp_path):
    problem = _only(_write(tmp_path / "s", route=("1", "3")))
    assert (problem.is_error, problem.where) == (True, "scenario cafe")
    assert "roadblock 2 of 2 of the route, '3', does not follow '1'" in problem.what


def test_a_route_of_one_roadblock_is_unusual(tmp_path):
    problem = _only(_write(tmp_path / "s", route=("1",)))
    assert (problem.is_error, problem.kind) == (False, "route")
    assert "the route has 1 roadblock" in problem.what


def _crossing_lanes(low, high):
    """Two lanes without neighbours; the second reaches from y = low to y = high over the first."""
    edges, blocks = [], []
    shapes = {
        "a": (shapely.box(0, -1.75, 420, 1.75), np.array([[0.0, 0.0], [420.0, 0.0]])),
        "b": (shapely.box(60, low, 70, high), np.array([[65.0, low], [65.0, high]])),
    }
    for number, (name, (polygon, line)) in enumerate(shapes.items()):
        edges.append(
            EdgeSpec(
                id=name,
                is_connector=False,
                polygon=polygon,
                baseline=line,
                block_id=str(number),
                incoming=[],
                outgoing=[],
                left=line,
                right=line,
                lane_index=0,
            )
        )
        blocks.append(BlockSpec(str(number), False, polygon, [], []))
    areas = [AreaSpec("90", shapely.union_all([shape for shape, _ in shapes.values()]))]
    return build_map("straight", edges=edges, blocks=blocks, drivable_areas=areas)


def test_lanes_that_overlap_under_the_ego_are_an_error_and_its_task_fails(tmp_path):
    scene = cruise_scenario(iterations=LONG, start=(62.0, 0.0, 0.0))
    path = _write(tmp_path / "s", road=_crossing_lanes(-10, 10), scene=scene, route=("0",))
    problems = {problem.where: problem for problem in survey_store(path).problems}
    found = problems["scenario cafe"]
    assert (found.is_error, found.kind) == (True, "lanes overlap")
    assert "lanes 'a' and 'b' overlap at (" in found.what
    assert "its tasks will fail" in found.what
    assert not problems["map straight"].is_error
    scenario = shiftsim.open_store(str(path)).read("cafe")
    from shiftsim.planners.registry import load_planner

    log = shiftsim.simulate(scenario, load_planner("log-future"))
    with pytest.raises(MapError, match="lanes 'a' and 'b' overlap"):
        shiftsim.score(log, scenario.map)


def test_lanes_that_overlap_elsewhere_on_the_route_are_an_error(tmp_path):
    road = _crossing_lanes(1.0, 10.0)
    scene = cruise_scenario(iterations=LONG, speed=0.0, start=(10.0, 0.0, 0.0))
    found = survey_store(_write(tmp_path / "s", road=road, scene=scene, route=("0",))).problems
    assert [p.is_error for p in found if p.where == "scenario cafe"] == [False, True]
    assert "on the route overlap by 7.5 m²" in found[-1].what


def test_the_command_shows_remedies_and_a_table(tmp_path, capsys):
    write_toy_store(tmp_path / "toy", iterations=LONG)
    with pytest.raises(SystemExit) as end:
        main(["check", str(tmp_path / "toy")])
    out = capsys.readouterr().out
    assert end.value.code == 0, out
    assert "recording  length s  tracks  scenarios" in out
    _write(tmp_path / "s", route=("1", "3"))
    with pytest.raises(SystemExit) as end:
        main(["check", str(tmp_path / "s")])
    out = capsys.readouterr().out
    assert end.value.code == 2
    assert "does not follow '1' (correct the route in shiftsim inspect, or" in out
    assert "route 1" in out.splitlines()[-2]
