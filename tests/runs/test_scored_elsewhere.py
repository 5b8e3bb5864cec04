"""What was driven elsewhere gets nuPlan's score, and what cannot be right is named."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import cruise_scenario, standing_tracks

import shiftsim
from shiftsim.cli import main
from shiftsim.errors import ConfigError, DataError
from shiftsim.metrics.comfort import derived_states
from shiftsim.report.explain import explain_lines, select_tasks
from shiftsim.runs.derive import rescore, score_elsewhere
from shiftsim.runs.rollouts.elsewhere import read_source, table_source
from shiftsim.view.build import Gallery
from shiftsim.world.state import AX, AY, VX, VY, YAW_ACCEL, YAW_RATE, AgentKind, center_poses

UTM = (664_430.3, 3_998_750.7, 0.3)
POSES = ("token", "planner", "noise", "seed", "time_us", "x_m", "y_m", "heading_rad")


@pytest.fixture(scope="module")
def scene():
    """A straight drive, one car parked beside it."""
    bare = cruise_scenario(iterations=25, speed=8.0)
    beside = np.array([[40.0, 3.5, 0.0]])
    return replace(bare, tracks=standing_tracks(len(bare.time_us), beside, [AgentKind.VEHICLE]))


def columns_of(scene, **changes):
    """Columns of the recorded drive."""
    poses, times = scene.expert[:, :3], scene.iteration_times
    x, y, heading = np.array(poses).T
    return {"time_us": np.array(times), "x": x, "y": y, "heading": heading, **changes}


def boxes_of(scene, **changes):
    """Columns of the recorded car."""
    times = scene.iteration_times
    same = {"x": 40.0, "y": 3.5, "heading": 0.0, "length": 4.0, "width": 2.0, "vx": 0.0, "vy": 0.0}
    columns = {name: np.full(len(times), value) for name, value in same.items()}
    texts = {"track_token": ["car"] * len(times), "type": ["VEHICLE"] * len(times)}
    return {"time_us": np.array(times), **texts, **columns, **changes}


@pytest.fixture(scope="module")
def part(clean_run):
    """The file of the rollouts of a run."""
    (path,) = (clean_run.path / "rollouts").iterdir()
    return path


# the digits of a run


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_rollouts_of_a_run_get_its_digits(clean_run, part, toy, tmp_path, suffix):
    path = tmp_path / f"poses{suffix}"
    table = pq.read_table(part)
    flat = [name for name in table.column_names if not pa.types.is_list(table[name].type)]
    write = pq.write_table if suffix == ".parquet" else pyarrow.csv.write_csv
    write(table.select(flat), path)
    run = score_elsewhere(
        read_source(path), store=str(toy), recorded=True, out=str(tmp_path / "run"), workers=1
    )
    assert run.scores.equals(clean_run.scores)
    assert run.metrics.equals(clean_run.metrics)
    task = next(iter(run.rollout_places))
    scenario = shiftsim.open_store(toy).read(task.token)
    ours, theirs = run.rollout(task, scenario), clean_run.rollout(task, scenario)
    np.testing.assert_array_equal(ours.ego, theirs.ego)
    np.testing.assert_array_equal(ours.tracks.poses, theirs.tracks.poses)


def test_reactive_rollouts_bring_their_boxes(toy, tmp_path):
    settings = {"store": str(toy), "traffic": "reactive", "workers": 1}
    run = shiftsim.run("constant-velocity", out=str(tmp_path / "run"), **settings)
    source = read_source(run.path / "rollouts")
    assert source.has_boxes
    again = score_elsewhere(
        source, store=str(toy), traffic="reactive", out=str(tmp_path / "again"), workers=1
    )
    assert again.scores.equals(run.scores)


@pytest.mark.thorough
def test_poses_alone_are_scored_and_say_so(clean_run, part, toy, tmp_path):
    pq.write_table(pq.read_table(part, columns=[*POSES]), tmp_path / "poses.parquet")
    source = read_source(tmp_path / "poses.parquet")
    run = score_elsewhere(source, store=str(toy), recorded=True, out=str(tmp_path / "run"))
    ours, theirs = run.scores, clean_run.scores
    for name in ("no_ego_at_fault_collisions", "drivable_area_compliance"):
        assert ours[name].equals(theirs[name])
    run = shiftsim.open_run(run.path)
    for words in (run.table(), *map(str, run.manifest["elsewhere"]["remarks"])):
        assert "poses" in words or "others replayed" in words
    assert "driven elsewhere: poses.parquet; derived from poses: vx, vy, ax, ay" in run.table()
    assert "others replayed from the recording" in run.table()


# what is derived


def test_derived_states_are_those_of_a_circle():
    radius, speed, count = 20.0, 6.0, 60
    angle = speed / radius * 0.1 * np.arange(count)
    center = np.array(UTM[:2])
    xy = center + radius * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    poses = np.column_stack([xy, angle])
    states = derived_states(100_000 * np.arange(count), poses)[2:-2]
    for column, value, tolerance in (  # the chords of a window are shorter than the arc
        (VX, speed, 4e-3),
        (VY, 0.0, 1e-6),
        (AX, 0.0, 1e-6),
        (AY, speed**2 / radius, 4e-3),
        (YAW_RATE, speed / radius, 1e-6),
        (YAW_ACCEL, 0.0, 1e-6),
    ):
        np.testing.assert_allclose(states[:, column], value, atol=tolerance)


@given(accel=st.floats(-3, 3), speed=st.floats(0, 20), heading=st.floats(-3.1, 3.1))
def test_uniform_acceleration_is_derived_to_the_ends(accel, speed, heading):
    time = 0.1 * np.arange(20)
    along = speed * time + 0.5 * accel * time**2
    poses = np.stack([along * np.cos(heading), along * np.sin(heading), 0 * time + heading], axis=1)
    states = derived_states(100_000 * np.arange(20), poses)
    np.testing.assert_allclose(states[:, VX], speed + accel * time, atol=1e-6)
    np.testing.assert_allclose(states[:, AX], accel, atol=1e-5)


def test_an_ego_that_stands_has_no_derived_speed(scene):
    columns = columns_of(scene)
    columns["x"] = columns["x"][0] + 4e-4 * (np.arange(25) % 2)
    found = shiftsim.score_rollout(columns, scene, tracks="recorded")
    assert not found.log.ego[:, [VX, VY]].any()
    assert "speed 0 where the pose moves less than 1 mm" in found.remarks


def test_given_states_are_used_as_they_are(scene):
    given_states = {"vx": np.full(25, 8.1), "ax": np.full(25, 0.5)}
    found = shiftsim.score_rollout(columns_of(scene, **given_states), scene, tracks="recorded")
    assert (found.log.ego[:, VX] == 8.1).all()
    assert (found.log.ego[:, AX] == 0.5).all()
    assert "derived from poses: vy, ay, yaw_rate, yaw_accel" in found.remarks


def test_the_center_is_moved_to_the_rear_axle(scene):
    centers = center_poses(scene.expert[:, :3])
    found = shiftsim.score_rollout(centers, scene, point="center", tracks="recorded")
    np.testing.assert_allclose(found.log.ego[:, :3], scene.expert[:-1, :3], atol=1e-9)


# time


@pytest.mark.parametrize("rate", [20, 25, 50, 100])
def test_other_rates_are_sampled_or_interpolated(scene, rate):
    times = np.arange(0.0, 2.401, 1.0 / rate)
    start = scene.expert[0]
    poses = {"time_s": times, "x": start[0] + 8.0 * times, "y": 0 * times, "heading": 0 * times}
    found = shiftsim.score_rollout(poses, scene, tracks="recorded")
    np.testing.assert_allclose(found.log.ego[:, :3], scene.expert[:-1, :3], atol=1e-9)
    assert ("poses interpolated to the iterations" in found.remarks) == (rate == 25)


@given(offset=st.integers(-25_000, 25_000))
def test_a_rollout_out_of_step_is_interpolated_and_says_so(offset):
    scene = cruise_scenario(iterations=25, speed=8.0)
    columns = columns_of(scene, time_us=scene.iteration_times + offset)
    columns["x"] = columns["x"] + 8.0 * offset * 1e-6
    found = shiftsim.score_rollout(columns, scene, tracks="recorded")
    near = 0.0 if abs(offset) > 1_000 else 8.0 * 1e-3
    np.testing.assert_allclose(found.log.ego[:, 0], scene.expert[:-1, 0], atol=near + 1e-6)
    assert ("poses interpolated to the iterations" in found.remarks) == (abs(offset) > 1_000)


def test_headings_are_interpolated_the_short_way(scene):
    heading = np.where(np.arange(25) % 2, -3.1, 3.1)
    columns = columns_of(scene, heading=heading, time_us=scene.iteration_times + 20_000)
    turned = replace(scene, ego=scene.ego + np.array([0, 0, np.pi, *[0] * 8]))
    found = shiftsim.score_rollout(columns, turned, tracks="recorded")
    assert (np.abs(found.log.ego[:, 2]) > 3.0).all()


def test_what_is_longer_is_cut_and_what_is_shorter_needs_a_word(scene):
    times = np.arange(40) * 0.1
    poses = {"time_s": times, "x": 10 + 8 * times, "y": 0 * times, "heading": 0 * times}
    found = shiftsim.score_rollout(poses, scene, tracks="recorded")
    assert len(found.log.ego) == 24
    assert "cut at the end of the scenario" in found.remarks
    short = {name: values[:12] for name, values in poses.items()}
    with pytest.raises(
        DataError, match=r"row 11: the last sample is 1\.1 s after iteration 0, the"
    ):
        shiftsim.score_rollout(short, scene, tracks="recorded")
    found = shiftsim.score_rollout(short, scene, tracks="recorded", partial=True)
    assert len(found.log.ego) == 12
    assert len(found.log.expert_ego) == 13
    assert found.scores["ego_progress_along_expert_route"] > 0.9
    assert any(words.startswith("partial") for words in found.remarks)


# what cannot be right


def repeated(columns):
    times = columns["time_us"].copy()
    times[7] = times[6]
    return {"time_us": times}


def backwards(columns):
    return {name: values[::-1] for name, values in columns.items()}


def without_samples(columns):
    return {name: np.delete(values, [8, 9]) for name, values in columns.items()}


def jumping(columns):
    return {"x": columns["x"] + np.where(np.arange(25) > 9, 12.0, 0.0)}


def spinning(columns):
    return {"heading": columns["heading"] + 2.0 * (np.arange(25) > 9)}


def with_a_hole(columns):
    return {"x": np.where(np.arange(25) == 3, np.nan, columns["x"])}


def with_half_a_column(columns):
    return {"vx": np.where(np.arange(25) < 3, np.nan, 8.0)}


BAD = {
    "repeated": (repeated, r"row 7: its time, \d+ us, is not after that of the row before, \d+ us"),
    "backwards": (backwards, r"row 1: its time, \d+ us, is not after"),
    "gap": (without_samples, r"row 8: 0\.300 s after the row before"),
    "jump": (jumping, r"row 10: 12\.80 m and 0\.00 rad from the row before, in 0\.10 s"),
    "spin": (spinning, r"row 10: 0\.80 m and 2\.00 rad from the row before"),
    "hole": (with_a_hole, r"row 3: x is missing or not finite"),
    "half a column": (with_half_a_column, r"row 0: vx is missing or not finite"),
    "degrees": (lambda c: {"heading": c["heading"] + 90.0}, r"row 0: heading 90, .* degrees\?"),
    "other map": (
        lambda c: {"x": c["x"] + 500.0},
        r"row 0: \(510, 0\) at iteration 0, the re.* 500 m",
    ),
    "center": (
        lambda c: {"x": c["x"] + 1.461},
        r"row 0: .* 1\.461 m ahead of the .*: it is of the c",
    ),
    "map velocity": (lambda c: {"vx": 0 * c["x"] + 28.8}, r"row 0: vx is 28\.8 m/s, but .* 8 m/s"),
    "no acceleration": (
        lambda c: {"x": c["x"] - 4.0 * (0.1 * np.arange(25)) ** 2, "ax": 0 * c["x"]},
        r"row 0: ax is 0 m/s², but the positions move by -8 m/s² along .* for 8 samples",
    ),
    "no mild acceleration": (
        lambda c: {"x": c["x"] + 0.5 * (0.1 * np.arange(25)) ** 2, "ax": 0 * c["x"]},
        r"row 0: ax is 0 m/s², but the positions move by 1 m/s²",
    ),
    "unit g": (
        lambda c: {"x": c["x"] + 1.5 * (0.1 * np.arange(25)) ** 2, "ax": np.linspace(0.3, 0.4, 25)},
        r"row 0: ax is 0\.3 m/s², but the positions move by 3 m/s²",
    ),
    "other times": (
        lambda c: {"time_us": c["time_us"] - 10**10},
        r"row 24: .* before the scenario",
    ),
    "out of step": (
        lambda c: {"time_us": c["time_us"] + 45_000},
        r"within 25 ms of iteration 0, .* 45",
    ),
    "few": (lambda c: {name: values[:3] for name, values in c.items()}, r"3 samples; .* need 4"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_right_is_named_with_row_and_number(scene, name):
    change, words = BAD[name]
    columns = columns_of(scene)
    with pytest.raises(DataError, match=words) as caught:
        shiftsim.score_rollout({**columns, **change(columns)}, scene, tracks="recorded")
    assert caught.value.hint


def test_positions_of_single_precision_are_refused():
    scene = cruise_scenario(iterations=25, start=UTM)
    assert shiftsim.score_rollout(scene.expert[:, :3], scene).log.ego[0, VX] > 0.0
    poses = scene.expert[:, :3].astype(np.float32)
    with pytest.raises(DataError, match=r"row 0: x is 664430\.3\d+, .* steps of 0\.0625 m"):
        shiftsim.score_rollout(poses, scene)
    poses = np.column_stack([scene.expert[:, 0], poses[:, 1], poses[:, 2]])
    with pytest.raises(DataError, match=r"row 0: y is 3998750\.75, .* steps of 0\.25 m"):
        shiftsim.score_rollout(poses, scene)


def test_small_headings_in_degrees_are_those_of_the_recording():
    scene = cruise_scenario(iterations=25, start=(10.0, 0.0, 0.05))
    columns = columns_of(scene)
    columns["heading"] = np.degrees(columns["heading"])
    with pytest.raises(
        DataError, match=r"row 0: heading 2\.865, in degrees the recorded one, 0\.05"
    ):
        shiftsim.score_rollout(columns, scene)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda h: h + np.pi,
            r"heading 4\.342, backwards the recorded one, 1\.2 rad",
        ),
        (lambda h: -h, r"heading -1\.2, counted clockwise the recorded one, 1\.2 rad"),
        (
            lambda h: np.pi / 2 - h,
            r"heading 0\.3708, of a compass the recorded one, 1\.2 rad",
        ),
        (lambda h: 0.0 * h, r"heading 0, not the recorded one, 1\.2 rad, at iteration 0"),
    ],
)
def test_a_start_that_is_turned_is_refused_with_its_cause(change, words):
    scene = cruise_scenario(iterations=25, start=(10.0, 0.0, 1.2))
    for first in (0, scene.iteration_times[0]):  # times from 0 on, and time stamps
        columns = columns_of(scene, time_us=scene.iteration_times - first)
        columns["heading"] = columns["heading"] + 0.3
        assert shiftsim.score_rollout(columns_of(scene) | {"heading": columns["heading"]}, scene)
        columns["heading"] = change(columns["heading"] - 0.3)
        with pytest.raises(DataError, match=f"row 0: {words}"):
            shiftsim.score_rollout(columns, scene)


@pytest.mark.parametrize("controller", ["perfect", "lqr"])
def test_states_of_our_own_simulator_are_accepted(toy, tmp_path, controller):
    class Stops:
        """Brakes by 8 m/s², with a plan of poses alone."""

        def reset(self, scene):
            self.speed = None

        def plan(self, observation):
            x, y, heading = observation.ego.pose
            self.speed = max(0.0, (self.speed or observation.ego.speed) - 0.8)
            along = self.speed * 0.1 * np.arange(81)
            poses = [x + along * np.cos(heading), y + along * np.sin(heading), 0 * along + heading]
            plan = shiftsim.Trajectory.from_poses(0.1 * np.arange(81), np.transpose(poses))
            plan.states[:, VX] += 2.0  # which perfect tracking takes as it is
            return plan

    settings = {
        "store": str(toy),
        "workers": 1,
        "noise": "ou-high" if controller == "lqr" else "none",
    }
    run = shiftsim.run(Stops(), controller=controller, out=str(tmp_path / "run"), **settings)
    source = read_source(run.path / "rollouts")
    again = score_elsewhere(
        source, store=str(toy), recorded=True, out=str(tmp_path / "again"), workers=1
    )
    assert again.scores["cls"].equals(run.scores["cls"])


def test_the_rear_axle_is_not_taken_for_the_center(scene):
    with pytest.raises(
        DataError, match=r"1\.461 m behind the recorded .* of the rear axle"
    ) as caught:
        shiftsim.score_rollout(columns_of(scene), scene, point="center")
    assert caught.value.hint == "say so: --point rear_axle"


def test_times_from_zero_begin_at_the_recorded_pose(scene):
    columns = columns_of(scene)
    columns["time_us"] = columns["time_us"] - columns["time_us"][0]
    assert shiftsim.score_rollout(columns, scene).log.time_us[0] == scene.iteration_times[0]
    columns["x"] = columns["x"] + 0.3
    with pytest.raises(DataError, match=r"row 0: time 0, but 0\.30 m and 0\.000 rad from the rec"):
        shiftsim.score_rollout(columns, scene)


# the others


def test_without_others_their_metrics_and_the_score_are_undefined(scene):
    found = shiftsim.score_rollout(columns_of(scene), scene)
    assert found.score is None
    assert np.isnan(found.result.score)
    undefined = {name for name, score in found.scores.items() if score is None}
    assert {"no_ego_at_fault_collisions", "time_to_collision_within_bound"} < undefined
    assert found.scores["ego_is_comfortable"] == 1.0
    assert not {row.metric for row in found.result.rows} & {"no_ego_at_fault_collisions"}


def test_own_boxes_are_hit(scene):
    ahead = boxes_of(scene, y=np.zeros(25), x=np.full(25, 25.0))
    found = shiftsim.score_rollout(columns_of(scene), scene, tracks=ahead)
    assert found.score == 0.0
    assert found.scores["no_ego_at_fault_collisions"] == 0.0
    assert found.log.tracks.tokens == ("car",)
    beside = shiftsim.score_rollout(columns_of(scene), scene, tracks=boxes_of(scene))
    assert beside.score == shiftsim.score_rollout(columns_of(scene), scene, tracks="recorded").score


def test_velocities_of_others_are_derived_where_they_lack(scene):
    boxes = boxes_of(scene, x=40.0 + 0.3 * np.arange(25))
    del boxes["vx"], boxes["vy"]
    found = shiftsim.score_rollout(columns_of(scene), scene, tracks=boxes)
    np.testing.assert_allclose(found.log.tracks.velocities[:, 0], [[3.0, 0.0]] * 24, atol=1e-9)
    assert "velocities of others derived from their positions" in found.remarks


def test_boxes_out_of_step_are_interpolated(scene):
    boxes = boxes_of(scene, x=40.0 + 0.3 * np.arange(25) + 0.06)
    boxes["time_us"] = boxes["time_us"] + 20_000
    found = shiftsim.score_rollout(columns_of(scene), scene, tracks=boxes)
    np.testing.assert_allclose(found.log.tracks.poses[:, 0, 0], 40.0 + 0.3 * np.arange(24))
    assert "boxes of others interpolated to the iterations" in found.remarks


def test_new_tokens_in_every_sample_are_said(scene):
    boxes = boxes_of(scene, track_token=[f"{n}" for n in range(25)])
    found = shiftsim.score_rollout(columns_of(scene), scene, tracks=boxes)
    assert "tracks last one sample: each contact counts anew" in found.remarks


def of_rows(boxes, keep):
    return {name: np.array(values)[keep] for name, values in boxes.items()}


BAD_BOXES = {
    "ego": (lambda b, c: {"x": c["x"], "y": c["y"]}, r"track 'car' is on the ego, .* 24 of 24 sam"),
    "type": (lambda b, c: {"type": ["TRUCK"] * 25}, r"tracks, row 0: type 'TRUCK' is none of VEH"),
    "types": (lambda b, c: {"type": ["VEHICLE", *["BARRIER"] * 24]}, r"row 1: its track changes"),
    "size": (lambda b, c: {"length": np.zeros(25)}, r"row 0: length and width must be above 0"),
    "hole": (lambda b, c: {"x": np.full(25, np.nan)}, r"row 0: a number is missing"),
    "degrees": (
        lambda b, c: {"heading": np.full(25, -15.6)},
        r"tracks 'heading', row 0: -15\.6 is",
    ),
    "long": (lambda b, c: {"length": np.full(25, 450.0)}, r"tracks 'length', row 0: 450 is beyond"),
    "far": (
        lambda b, c: {"x": b["x"] + 1000.0},
        r"tracks: the nearest box is 1012 m from the ego, the nearest recorded one 12\.\d+ m",
    ),
    "single precision": (
        lambda b, c: {"x": (b["x"] + 4e5 + 0.3 * np.arange(25)).astype(np.float32)},
        r"tracks: x is 400040, and in all rows of single precision, which has steps of 0\.03125 m",
    ),
    "end": (
        lambda b, c: of_rows(b, slice(9)),
        r"tracks: no boxes of others at iteration 9, \d+ us, .* recording of '.*' has 1",
    ),
    "twice": (lambda b, c: of_rows(b, [*range(25), 4]), r"row 25: its track is there twice at one"),
}


@pytest.mark.parametrize("name", BAD_BOXES)
def test_boxes_that_cannot_be_right_are_named(scene, name):
    change, words = BAD_BOXES[name]
    boxes, columns = boxes_of(scene), columns_of(scene)
    with pytest.raises(DataError, match=words):
        shiftsim.score_rollout(columns, scene, tracks={**boxes, **change(boxes, columns)})


@pytest.mark.parametrize("are_poses_from_zero", [False, True])
def test_boxes_may_have_the_other_kind_of_times(scene, are_poses_from_zero):
    columns, boxes = columns_of(scene), boxes_of(scene)
    times = columns if are_poses_from_zero else boxes
    times["time_s"] = (times.pop("time_us") - scene.iteration_times[0]) * 1e-6
    found = shiftsim.score_rollout(columns, scene, tracks=boxes)
    np.testing.assert_array_equal(found.log.tracks.poses[:, 0], [[40.0, 3.5, 0.0]] * 24)


def test_the_ego_is_left_out_by_its_type(scene):
    boxes, columns = boxes_of(scene), columns_of(scene)
    two = {name: [*boxes[name], *boxes[name]] for name in boxes}
    two["type"], two["track_token"] = ["EGO"] * 25 + ["VEHICLE"] * 25, ["ego"] * 25 + ["car"] * 25
    two["x"], two["y"] = [*columns["x"], *boxes["x"]], [*columns["y"], *boxes["y"]]
    assert shiftsim.score_rollout(columns, scene, tracks=two).log.tracks.tokens == ("car",)


# tables and runs


def test_planning_times_are_times_or_lack(scene):
    columns = columns_of(scene, seconds=np.full(25, 0.1))
    assert (shiftsim.score_rollout(columns, scene).log.planning_seconds == 0.1).all()
    columns["seconds"] = np.full(25, np.nan)  # as beside a file that has them
    assert not shiftsim.score_rollout(columns, scene).log.planning_seconds.any()
    for row, value in ((4, -1.0), (5, np.inf), (6, np.nan)):
        columns["seconds"] = np.where(np.arange(25) == row, value, 0.1)
        with pytest.raises(
            DataError, match=rf"poses.*seconds.*|poses, row {row}: seconds"
        ) as caught:
            shiftsim.score_rollout(columns, scene)
        assert f"row {row}" in str(caught.value)


def test_columns_that_lack_or_are_not_used_are_named(scene):
    columns = columns_of(scene)
    found = shiftsim.score_rollout({**columns, "z": columns["x"]}, scene)
    assert "columns not used: z" in found.remarks
    boxes = boxes_of(scene, height=np.ones(25))
    found = shiftsim.score_rollout(columns, scene, tracks=boxes)
    assert "columns not used: height" in found.remarks
    del columns["heading"]
    with pytest.raises(DataError, match="poses: column 'heading' is missing"):
        shiftsim.score_rollout(columns, scene)
    with pytest.raises(DataError, match="column 'x' is there twice"):
        shiftsim.score_rollout(columns_of(scene, x_m=columns["x"]), scene)
    with pytest.raises(DataError, match="column 'x' is no double"):
        shiftsim.score_rollout(columns_of(scene, x=["far"] * 25), scene)
    with pytest.raises(DataError, match=r"poses: no table: .* expected length 25 but got length 9"):
        shiftsim.score_rollout(columns_of(scene, x=columns["x"][:9]), scene)
    with pytest.raises(ValueError, match=r"poses \(K, 3\)"):
        shiftsim.score_rollout(np.zeros((5, 2)), scene)


def written(folder, store, change=lambda table: table, name="mine.parquet", first=0):
    """The recorded drives of a store as poses of a planner."""
    tables = []
    for scenario in [*shiftsim.open_store(store)][first:]:
        columns = {"token": [scenario.token] * scenario.num_iterations, **columns_of(scenario)}
        tables.append(pa.table(columns))
    path = folder / name
    pq.write_table(change(pa.concat_tables(tables)), path)
    return path


def test_unknown_scenarios_are_refused_with_the_nearest(toy, tmp_path):
    def rename(table):
        tokens = [name.replace("0001cafe", "0001cafd") for name in table["token"].to_pylist()]
        return table.set_column(0, "token", pa.array(tokens))

    source = read_source(written(tmp_path, toy, rename))
    with pytest.raises(DataError, match="store 'toy' has no scenario '0001cafd'") as caught:
        score_elsewhere(source, store=str(toy), out=str(tmp_path / "run"))
    assert "did you mean '0001cafe'" in caught.value.hint


def test_the_table_says_which_point_it_is_of(toy, tmp_path):
    path = written(tmp_path, toy, lambda t: t.replace_schema_metadata({"point": "center"}))
    source = read_source(path)
    assert source.point == "center"
    with pytest.raises(ConfigError, match=r"--point rear_axle, but mine\.parquet says center"):
        score_elsewhere(source, store=str(toy), point="rear_axle")
    out = tmp_path / "run"
    with pytest.raises(DataError, match=r"of the rear axle; 3 other rollouts fail as well"):
        score_elsewhere(source, store=str(toy), out=str(out), workers=1)
    assert not out.exists()


def test_one_rollout_that_ends_early_fails_alone(toy, tmp_path):
    source = read_source(written(tmp_path, toy, lambda table: table.slice(0, len(table) - 5)))
    settings = {"store": str(toy), "recorded": True, "workers": 1}
    run = score_elsewhere(source, out=str(tmp_path / "run"), **settings)
    assert run.tasks["status"].to_pylist() == ["ok"] * 3 + ["failed"]
    assert "the scenario lasts" in run.tasks["error"][3].as_py()
    run = score_elsewhere(source, out=str(tmp_path / "all"), partial_rollouts=True, **settings)
    assert run.is_complete
    assert any("partial" in one and "(1 of 4 rollouts)" in one for one in remarks_of(run))
    scenario = shiftsim.open_store(toy).read("0003cafe")
    task = next(task for task in run.rollout_places if task.token == scenario.token)
    assert len(run.rollout(task, scenario).ego) == 20


def remarks_of(run):
    return run.manifest["elsewhere"]["remarks"]


def test_a_run_without_others_is_shown_everywhere(toy, tmp_path):
    run = score_elsewhere(
        read_source(written(tmp_path, toy)), store=str(toy), out=str(tmp_path / "run"), workers=1
    )
    run = shiftsim.open_run(run.path)
    assert run.scores["cls"].null_count == 4
    row = next(line for line in run.table().splitlines() if line.lstrip().startswith("mine"))
    assert row.split()[2:4] == ["undefined", "–"]
    text = "\n".join(explain_lines(select_tasks(run, "0001cafe")[0]))
    assert "CLS undefined" in text
    assert "undefined without the others: no at-fault collision (NCR), time to collision" in text
    assert len(str(run.view("0001cafe")._repr_html_())) > 1000
    again = rescore(run, thresholds="deepplan", out=str(tmp_path / "again"), workers=1)
    assert again.scores["cls"].null_count == 4
    assert remarks_of(again) == remarks_of(run)


def test_that_it_was_driven_elsewhere_stands_wherever_a_run_is_shown(toy, tmp_path):
    path, out = written(tmp_path, toy), tmp_path / "run"
    run = shiftsim.score_files(path, store=str(toy), tracks="recorded", workers=1, out=str(out))
    said = "driven elsewhere: mine.parquet; derived from poses: vx, vy, ax, ay, yaw_rate, yaw_accel"
    [task] = select_tasks(run, "0001cafe")
    settings = Gallery([run], shiftsim.open_store(toy)).settings_words("0001cafe")
    assert "controller elsewhere" in settings
    for words in (run.table(), "\n".join(explain_lines(task)), str(run.diff(run)), settings):
        assert said in words


def test_own_boxes_come_back_from_a_run(toy, tmp_path):
    boxes = []
    for scenario in shiftsim.open_store(toy):
        times = scenario.iteration_times
        same = {"token": scenario.token, "track_token": "other", "type": "BICYCLE", "x": 45.0}
        same |= {"y": 6.0, "heading": 1.0, "length": 1.8, "width": 0.8}
        columns = {name: [value] * len(times) for name, value in same.items()}
        boxes.append(pa.table({"time_us": times, **columns}))
    pq.write_table(pa.concat_tables(boxes), tmp_path / "boxes.parquet")
    source = read_source(written(tmp_path, toy), str(tmp_path / "boxes.parquet"))
    run = score_elsewhere(source, store=str(toy), out=str(tmp_path / "run"), workers=1)
    scenario = shiftsim.open_store(toy).read("0001cafe")
    task = next(task for task in run.rollout_places if task.token == scenario.token)
    tracks = run.rollout(task, scenario).tracks
    assert tracks.tokens == ("other",)
    assert tracks.kinds.tolist() == [AgentKind.BICYCLE]
    assert (tracks.poses[:, 0] == [45.0, 6.0, 1.0]).all()
    again = rescore(run, thresholds="nuplan", out=str(tmp_path / "again"), workers=1)
    assert again.scores.equals(run.scores)


@pytest.fixture
def call(capsys, toy):
    """Exit code, output and errors of a command on the toy store."""

    def run(*words):
        with pytest.raises(SystemExit) as left:
            main([*map(str, words), "--store", str(toy)])
        printed = capsys.readouterr()
        return left.value.code, printed.out, printed.err

    return run


def test_the_command_scores_a_table(toy, tmp_path, call):
    path = written(tmp_path, toy)
    words = ("score", path, "--tracks", "recorded", "--out", tmp_path / "run", "--workers", 1)
    code, out, err = call(*words)
    assert code == 0, err
    assert "driven elsewhere: mine.parquet; derived from poses" in out
    code, out, _ = call("score", tmp_path / "run", "--out", tmp_path / "again", "--workers", 1)
    assert code == 0
    assert "driven elsewhere: mine.parquet" in out
    code, _, err = call("score", tmp_path / "run", "--tracks", "recorded")
    assert code == 1
    assert "is a run, and not driven elsewhere" in err
    code, _, err = call("score", tmp_path / "nothing.csv")
    assert code == 2
    assert "nothing.csv' is no readable table" in err


def test_several_rollouts_of_a_scenario_are_kept_apart(scene):
    columns = columns_of(scene)
    table = pa.table(
        {"token": [scene.token] * 50, "seed": [1] * 25 + [0] * 25}
        | {name: np.concatenate([values, values]) for name, values in columns.items()}
    )
    order = np.random.default_rng(0).permutation(50)
    order = order[np.argsort(np.concatenate([columns["time_us"]] * 2)[order], kind="stable")]
    source = table_source(table.take(pa.array(order)), "mixed.csv")
    assert [entry.task.seed for entry in source.entries] == [0, 1]
    for entry in source.entries:
        assert entry.task.planner == "mixed"
        np.testing.assert_array_equal(entry.read().time_us, columns["time_us"])
