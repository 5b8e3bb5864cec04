"""What a planner is given cannot be written, and leads to nothing that it must not see."""

import warnings
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from worlds import cruise_scenario

from shiftsim.errors import InvalidTrajectoryError
from shiftsim.kernels import readonly
from shiftsim.planners.basic import ConstantVelocity, LogFuture
from shiftsim.sim.dynamics.lqr import track_and_step
from shiftsim.sim.loop import Rollout, simulate
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.world.map import LAYERS
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command, Tracks, Trajectory

ROWS, STEP = 80, 50_000


@pytest.fixture(scope="module")
def scenario():
    """A cruise in which two vehicles and a light are recorded, the future included."""
    plain = cruise_scenario(start=(50.0, 0.0, 0.0))
    rows = len(plain.time_us)
    poses = np.arange(rows * 6.0).reshape(rows, 2, 3)
    tracks = Tracks(
        np.ones((rows, 2), np.bool_),
        poses,
        np.ones((rows, 2, 2)),
        np.ones((rows, 2, 2)),
        np.zeros(2, np.int64),
        ("a", "b"),
    )
    lights = replace(plain.traffic_lights, connector_ids=("7",), status=np.zeros((rows, 1), "i1"))
    return replace(plain, tracks=tracks, traffic_lights=lights)


def arrays_in(value, name=""):
    """All arrays in dataclasses and tuples, by name."""
    if isinstance(value, np.ndarray):
        yield name, value
    elif is_dataclass(value):
        for item in fields(value):
            yield from arrays_in(getattr(value, item.name), f"{name}.{item.name}")
    elif isinstance(value, tuple):
        for index, item in enumerate(value):
            yield from arrays_in(item, f"{name}[{index}]")


def inputs(scenario):
    seen = Rollout(scenario, ConstantVelocity()).observe()
    return {
        **dict(arrays_in(seen, "seen")),
        **dict(arrays_in(observe_log(scenario, 0, samples=1), "log")),
        **dict(arrays_in(scene_info(scenario, planner=LogFuture()), "scene")),
    }


def test_no_array_that_a_planner_is_given_can_be_written(scenario):
    given = inputs(scenario)
    assert len(given) > 100
    assert {"seen.history.ego", "scene.map.edges.polygons[0]", "scene.expert.ego"} < set(given)
    for name, array in given.items():
        assert not isinstance(array.base, np.ndarray), name
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.setflags(write=True)
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.flags.writeable = True


def test_the_index_of_a_map_cannot_be_written(scenario):
    road = scene_info(scenario).map
    for layer in LAYERS:
        index = getattr(road, layer).index
        assert list(index) == list(getattr(road, layer).ids)
        with pytest.raises(TypeError, match="item assignment"):
            index["new"] = 0
        assert not hasattr(index, "update")


def bases_of(array):
    """Everything that can be reached from an array by `base` and `obj`."""
    out, waiting = [], [array]
    while waiting:
        value = waiting.pop()
        out.append(value)
        if isinstance(value, tuple):
            waiting += value
        waiting += [
            found for name in ("base", "obj") if (found := getattr(value, name, None)) is not None
        ]
    return out


def test_nothing_leads_from_an_observation_to_the_recorded_future(scenario):
    rollout = Rollout(scenario, ConstantVelocity())
    seen = rollout.observe().history.tracks
    recorded = scenario.tracks.poses[scenario.iteration_rows]
    np.testing.assert_array_equal(seen.poses[-1], recorded[0])
    for array in (seen.valid, seen.poses, seen.velocities, seen.sizes):
        for value in bases_of(array):
            if isinstance(value, np.ndarray):
                assert not value.flags.writeable
                assert not np.array_equal(value.reshape(-1)[-6:], recorded.reshape(-1)[-6:])


def test_an_observation_shows_the_rows_up_to_the_present_one(scenario):
    rollout = Rollout(scenario, ConstantVelocity())
    kept = []
    while not rollout.done:
        kept.append(rollout.observe())
        rollout.advance(rollout.planner.plan(kept[-1]))
    log = rollout.log()
    for iteration in (0, 5, 30):
        past = kept[iteration].history
        assert len(past.ego) == len(past.tracks) == 22
        np.testing.assert_array_equal(past.ego[-1], log.ego[iteration])
        np.testing.assert_array_equal(past.tracks.poses[-1], log.tracks.poses[iteration])
        assert kept[iteration].traffic_lights == {"7": 0}


class Subtracts(ConstantVelocity):
    """Moves the tracks to the ego frame in place, as honest planners do."""

    def plan(self, observation):
        poses = observation.tracks.poses
        poses[..., :2] -= observation.ego.pose[:2]
        return super().plan(observation)


class Pushes(ConstantVelocity):
    def plan(self, observation):
        observation.history.ego[-1] = 0.0
        return super().plan(observation)


@pytest.mark.parametrize("planner", [Subtracts(), Pushes()])
def test_a_planner_that_writes_into_what_it_sees_fails_at_once(scenario, planner):
    with pytest.raises(ValueError, match="read-only"):
        simulate(scenario, planner)


class Looks(ConstantVelocity):
    def reset(self, scene):
        self.scene = scene


class LooksAhead(Looks):
    sees_recording = True


def test_the_recording_goes_to_planners_that_declare_it_only(scenario):
    for kind, wanted in ((Looks, type(None)), (LooksAhead, Scenario)):
        planner = kind()
        simulate(scenario, planner)
        assert isinstance(planner.scene.expert, wanted)


def test_every_planner_is_told_the_recording_s_name_and_the_times(scenario):
    scene = scene_info(scenario)
    assert scene.log_name == scenario.log_name
    np.testing.assert_array_equal(scene.times, scenario.iteration_times)


class Spoilt(ConstantVelocity):
    """Returns something else than a plan at iteration 3."""

    def __init__(self, make):
        self.make = make

    def plan(self, observation):
        plan = super().plan(observation)
        return plan if observation.iteration != 3 else self.make(plan)


def poses_of(value):
    def make(plan):
        states = plan.states.copy()
        states[7, 1] = value
        return Trajectory(plan.time_us, states, relative=True)

    return make


def cut(count, factor=1):
    return lambda plan: Trajectory(plan.time_us[:count] * factor, plan.states[:count], True)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda plan: None, r"plan\(\) returned NoneType"),
        (lambda plan: [1.0, 2.0], r"plan\(\) returned list"),
        (poses_of(1e300), "y of state 7 is 1e"),
        (poses_of(-2e9), "y of state 7 is -2"),
        (lambda plan: Command(1e308, 0.0), "acceleration 1e"),
        (lambda plan: Command(0.0, -1e308), "steering_rate -1e"),
        (lambda plan: Command(10**400, 0.0), "acceleration 1000"),
        (cut(2), "2 states over 0.1 s"),
        (cut(81, 125_000), "time 80 of the plan is 1000000000000 us, more than an hour"),
        (cut(2, 2**44 * 5), "time 1 of the plan"),
        (lambda plan: Trajectory([0, 1], plan.states, relative=True), "time_us is list"),
    ],
)
@pytest.mark.parametrize("controller", ["lqr", "perfect"])
def test_a_plan_that_is_none_is_the_planner_s_error_at_its_step(
    scenario, make, message, controller
):
    with pytest.raises(InvalidTrajectoryError, match=f"^iteration 3: .*{message}"):
        simulate(scenario, Spoilt(make), controller=controller)


class Extreme(ConstantVelocity):
    def plan(self, observation):
        return Command(1e9, -1e9)


@pytest.mark.parametrize("planner", [Spoilt(poses_of(1e9)), Extreme()])
def test_the_largest_values_that_are_taken_leave_every_state_finite(scenario, planner):
    assert np.isfinite(simulate(scenario, planner).ego).all()


class Short(ConstantVelocity):
    def __init__(self, poses):
        self.poses = poses

    def plan(self, observation):
        return cut(self.poses)(super().plan(observation))


def test_a_short_plan_runs_and_is_warned_of_once(scenario):
    with pytest.warns(UserWarning, match="less than 1 s ahead") as caught:
        simulate(scenario, Short(3))
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulate(scenario, Short(11))


def test_a_first_plan_that_begins_elsewhere_is_warned_of(scenario):
    def in_the_frame_of_the_ego(plan):
        plan.states[:, :2] += 30.0
        return plan

    with pytest.warns(UserWarning, match="42 m away from the ego: poses are in the map frame"):
        simulate(scenario, Altered(in_the_frame_of_the_ego))


class Altered(ConstantVelocity):
    def __init__(self, alter):
        self.alter = alter

    def plan(self, observation):
        return self.alter(super().plan(observation))


class Mirrors(ConstantVelocity):
    """Returns what it was shown, read-only as it is."""

    def plan(self, observation):
        plan = super().plan(observation)
        seen = observe_log(self.scenario, 0).history
        assert not seen.ego.flags.writeable
        return Trajectory(readonly(plan.time_us), readonly(plan.states), relative=True)


def test_read_only_plans_compile_no_second_kernel(scenario):
    simulate(scenario, ConstantVelocity())
    before = len(track_and_step.signatures)
    planner = Mirrors()
    planner.scenario = scenario
    simulate(scenario, planner)
    assert len(track_and_step.signatures) == before == 1
