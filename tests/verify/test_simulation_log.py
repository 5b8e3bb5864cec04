"""Small simulation logs as nuPlan's devkit writes them: driven, played back, with a repeat."""

import lzma
import pickle
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import msgpack
import numpy as np
import places
import pytest
from worlds import cruise_scenario

from shiftsim.runs.rollouts.poses import rollout_of
from shiftsim.sim.dynamics.lqr import track_and_step
from shiftsim.verify.experiment import verify_experiment
from shiftsim.verify.report import Report
from shiftsim.verify.rollouts import origin
from shiftsim.verify.simulation_log import log_source, read_simulation_log
from shiftsim.world.state import NUM_STATE, VX, VY, center_poses

REAL_LOGS = places.REPOSITORY.parent / "shared" / "reference" / "nuplan_real_logs"
STEP = 100_000  # us
NUM_SAMPLES = 30


class Devkit(ModuleType):
    """Stands for the devkit while a log is written: makes a class of any name."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        cls = type(name, (), {"__module__": self.__name__})
        cls.__init__ = lambda self, *arguments: vars(self).update(_arguments=arguments)
        cls.__reduce__ = lambda self: (cls, self._arguments, vars(self))
        setattr(self, name, cls)
        return cls

    def make(self, name: str, *arguments: Any, **attributes: Any) -> Any:
        """An object of a class, which a call with the arguments makes, with attributes."""
        made = getattr(self, name)(*arguments)
        vars(made).update(attributes)
        return made

    def ego(self, state: np.ndarray, time_us: int) -> Any:
        x, y, heading = center_poses(state[:3]).tolist()
        center = self.make("StateSE2", x=x, y=y, heading=heading)
        size = {"_length": 5.176, "_width": 2.297, "_height": 1.777}
        vx, vy, ax, ay, steering, steering_rate, yaw_rate, yaw_accel = state[3:].tolist()
        vectors = {"velocity": (vx, vy), "acceleration": (ax, ay)}
        motion = {
            f"_rear_axle_{name}_2d": self.make("StateVector2D", _x=x, _y=y, _array=None)
            for name, (x, y) in vectors.items()
        }
        motion |= {"_tire_steering_rate": steering_rate, "_rear_axle_to_center_dist": 1.461}
        motion |= {"_angular_velocity": yaw_rate, "_angular_acceleration": yaw_accel}
        return self.make(
            "EgoState",
            _time_point=self.make("TimePoint", time_us=time_us),
            _car_footprint=self.make("CarFootprint", _center=center, **size),
            _dynamic_car_state=self.make("DynamicCarState", **motion),
            _tire_steering_angle=steering,
        )

    def sample(self, number: int, ego: Any, plan: list[Any]) -> Any:
        now = self.make("TimePoint", time_us=number * STEP)
        seen = self.make("DetectionsTracks", tracked_objects=self.make("TrackedObjects"))
        vars(seen.tracked_objects).update(tracked_objects=[])
        return self.make(
            "SimulationHistorySample",
            iteration=self.make("SimulationIteration", index=number, time_point=now),
            ego_state=ego,
            trajectory=self.make("InterpolatedTrajectory", plan),
            observation=seen,
            traffic_light_status=[],
        )

    def log(self, samples: list[Any]) -> Any:
        window = self.make("ScenarioExtractionInfo", scenario_duration=3.0, extraction_offset=0.0)
        vars(window).update(subsample_ratio=0.5)
        vehicle = self.make("VehicleParameters", 2.297, 4.049, 1.127, 1.67, 3.089, "", "", 1.777)
        facts = ["", "", "0123456789abcdef", 0, "unknown", 0, 0, "town", window, vehicle]
        history = self.make("SimulationHistory", data=samples, mission_goal=None)
        return self.make(
            "SimulationLog",
            scenario=self.make("NuPlanScenario", *facts),
            simulation_history=history,
            planner=self.make("SimplePlanner", _compute_trajectory_runtimes=[0.1]),
        )


def plan_from(state: np.ndarray, now: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and states of a plan that veers left at 5 m/s."""
    ahead = 0.5 * np.arange(9)
    states = np.zeros((len(ahead), NUM_STATE))
    states[:, 0] = state[0] + 5.0 * ahead
    states[:, 1], states[:, 2] = state[1] + 0.2 * ahead**2, state[2] + 0.08 * ahead
    states[:, VX] = 5.0
    return now + (ahead * 1e6).astype(np.int64), states


def write_log(folder: Path, monkeypatch: Any, *, driven: bool, repeats: bool = False) -> Path:
    """A log of 30 samples in a result folder of nuPlan's; `repeats` makes the last one a repeat."""
    devkit = Devkit("nuplan")
    monkeypatch.setitem(sys.modules, "nuplan", devkit)
    states, samples = np.zeros((NUM_SAMPLES, NUM_STATE)), []
    states[0, VX] = 5.0
    for row in range(NUM_SAMPLES):
        now = row * STEP
        times, planned = plan_from(states[row], now)
        if driven and row + 1 < NUM_SAMPLES:
            given = states[row], times, planned, 0.0, 0.0
            track_and_step(now, now + STEP, *given, states[row + 1], np.empty(2))
        elif row + 1 < NUM_SAMPLES:  # what was recorded is noisy, and turns without steering
            states[row + 1, :3] = 0.5 * (row + 1), 1e-3 * row**2, 2e-3 * row
            states[row + 1, [VX, VY]] = 5.0, 1e-4
        is_repeat = repeats and row == NUM_SAMPLES - 1
        stamp = now - STEP if is_repeat else now
        plan = [devkit.ego(*one) for one in zip(planned, times.tolist(), strict=True)]
        samples.append(devkit.sample(row, devkit.ego(states[row], stamp), plan))
    path = folder / "closed_loop_nonreactive_agents/simulation_log/SimplePlanner/log.msgpack.xz"
    path.parent.mkdir(parents=True)
    path.write_bytes(lzma.compress(msgpack.packb(pickle.dumps(devkit.log(samples)))))
    return path


def remarks(folder: Path) -> list[str]:
    return verify_experiment(folder, lambda token: None).lines()


def test_a_driven_log_is_said_to_be_driven(tmp_path: Path, monkeypatch: Any) -> None:
    recorded = read_simulation_log(write_log(tmp_path, monkeypatch, driven=True), Report())
    assert len(recorded.ego["x"]) == NUM_SAMPLES
    assert np.abs(recorded.ego["tire_steering_angle"]).max() > 0.0
    assert origin("NR", recorded.ego, recorded.plans) == "driven"
    assert "NR log SimplePlanner: driven: every state follows" in "\n".join(remarks(tmp_path))


def test_states_that_a_plan_is_followed_perfectly_to_are_driven_in_that_mode_only(
    tmp_path: Path, monkeypatch: Any
) -> None:
    path = write_log(tmp_path, monkeypatch, driven=False)
    recorded = read_simulation_log(path, Report())
    assert origin("NR", recorded.ego, recorded.plans) == "played back"
    plans, ego = recorded.plans, recorded.ego
    for row in range(NUM_SAMPLES):
        now = plans["iteration"] == row
        plans.values["time_us"][now] = row * STEP + np.arange(9) * STEP
        for name in ("x", "y", "heading", "vx", "vy", "ax", "ay"):
            ahead = np.minimum(row + np.arange(9), NUM_SAMPLES - 1)
            plans.values[name][now] = ego[name][ahead]
    assert origin("PT", recorded.ego, recorded.plans) == "driven"
    assert origin("NR", recorded.ego, recorded.plans) == "played back"


def test_a_log_that_is_played_back_is_said_to_be_that(tmp_path: Path, monkeypatch: Any) -> None:
    recorded = read_simulation_log(write_log(tmp_path, monkeypatch, driven=False), Report())
    assert recorded.dropped_us is None
    assert origin("NR", recorded.ego, recorded.plans) == "played back"
    assert "played back: its states are the recorded ego" in "\n".join(remarks(tmp_path))
    # one that steers was driven, if not by the tracker that is known here
    recorded.ego.values["tire_steering_angle"][3] = 0.01
    assert origin("NR", recorded.ego, recorded.plans) == "other"


def test_a_last_sample_that_repeats_a_time_is_dropped(tmp_path: Path, monkeypatch: Any) -> None:
    path = write_log(tmp_path, monkeypatch, driven=True, repeats=True)
    recorded = read_simulation_log(path, Report())
    assert recorded.dropped_us == (NUM_SAMPLES - 1) * STEP
    assert len(recorded.ego["x"]) == len(recorded.ego["time_us"]) == NUM_SAMPLES - 1
    assert recorded.plans["iteration"].max() == NUM_SAMPLES - 2
    assert (np.diff(recorded.ego["ego_time_us"]) == STEP).all()
    assert origin("NR", recorded.ego, recorded.plans) == "driven"
    assert "log SimplePlanner: the last sample repeats a time" in "\n".join(remarks(tmp_path))


@pytest.mark.parametrize(
    ("driven", "repeats", "words"),
    [
        (True, False, "simulation log: driven, plans every 0.5 s"),
        (True, True, "driven, plans every 0.5 s, the last sample repeats a time and is dropped"),
        (False, False, "simulation log: played back, plans every 0.5 s"),
    ],
)
def test_a_log_is_a_rollout_to_score(
    tmp_path: Path, monkeypatch: Any, driven: bool, repeats: bool, words: str
) -> None:
    path = write_log(tmp_path, monkeypatch, driven=driven, repeats=repeats)
    source = log_source(tmp_path)
    assert source is not None
    (entry,) = source.entries
    assert entry.task == ("SimplePlanner", "none", 0, "log")
    count = NUM_SAMPLES - repeats
    scenario = cruise_scenario(speed=5.0, start=(0.0, 0.0, 0.0), iterations=count + 1)
    log, remarks = rollout_of(entry.read(), scenario)
    assert any(words in one for one in remarks)
    recorded = read_simulation_log(path, Report())
    np.testing.assert_array_equal(log.ego[:, VX], recorded.ego["vx"])
    np.testing.assert_array_equal(log.time_us, scenario.iteration_times[:-1])
    assert log_source(tmp_path.parent / "none.csv") is None


@pytest.mark.thorough
@pytest.mark.skipif(not REAL_LOGS.is_dir(), reason="needs the genuine logs")
def test_genuine_logs_are_rollouts_to_score() -> None:
    source = log_source(REAL_LOGS)
    assert source is not None
    assert not source.is_whole  # those of unknown scenarios are left out
    for entry in source.entries:
        driven = entry.read()
        assert len(driven.time_us) == len(driven.states) == 149
        assert driven.boxes is not None
        assert driven.remarks == (
            "simulation log: played back, plans every 0.5 s, the last sample repeats a time and "
            "is dropped",
        )


@pytest.mark.thorough
@pytest.mark.skipif(not REAL_LOGS.is_dir(), reason="needs the genuine logs")
def test_genuine_logs_were_played_back(tmp_path: Path) -> None:
    folder = tmp_path / "closed_loop_nonreactive_agents" / "simulation_log" / "SimplePlanner"
    folder.mkdir(parents=True)
    paths = sorted(REAL_LOGS.glob("*.xz"))
    for path in paths:
        (folder / path.name).symlink_to(path)
        recorded = read_simulation_log(path, Report())
        assert recorded.dropped_us
        assert len(recorded.ego["x"]) == 149
        assert not recorded.ego["tire_steering_angle"].any()
    lines = "\n".join(remarks(tmp_path))
    assert lines.count("played back") == lines.count("(dt = 0)") == len(paths) == 4
