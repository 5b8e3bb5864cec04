"""Recorded single calls of nuPlan's IDM planner, repeated from the logs (`idm_calls.json`)."""

from functools import partial

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.planners.idm import STEP_US, STEPS, Idm
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.verify.files import Source
from shiftsim.verify.tables import read_tables, verify_cases
from shiftsim.verify.worlds import object_columns
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LightStatus

TABLES = read_tables(__file__)


def _compare(call: Source, where: str, scenario: Scenario) -> None:
    first, iteration = call["first_call_iteration"], call["iteration"]
    if not all(0 <= index < scenario.num_iterations for index in (first, iteration)):
        raise DataError("no such iteration")
    planner, road = Idm(), scenario.map
    planner.reset(scene_info(scenario))
    planner.plan(observe_log(scenario, first, samples=1))
    seen = observe_log(scenario, iteration, samples=1)
    centers, speeds = planner.roll_out(seen)
    reds = [name for name, status in seen.lights.listed(0) if status == LightStatus.RED]
    TABLES["inputs"].match(call, where, scenario=scenario, seen=seen, reds=sorted(reds))
    tracks, things = (
        seen.tracks,
        sorted(call.each("objects"), key=lambda thing: str(thing["token"])),
    )
    index = sorted(np.flatnonzero(tracks.valid[0]).tolist(), key=tracks.tokens.__getitem__)
    columns = object_columns(tracks, np.zeros(len(index), np.int64), np.array(index, np.int64))
    listed = {name: [thing[name] for thing in things] for name in TABLES["objects"].rows}
    theirs = Source(call.name, "field", listed, call.report)
    kinds = [kind.lower() for kind in columns["type"]]
    TABLES["objects"].match(theirs, where, columns=columns, kinds=kinds)
    path = planner.path
    assert path is not None
    heading = wrap_angle(float(path.driven.heading[-1]))
    end = [path.end, *path.driven.xy[-1].tolist(), heading]
    TABLES["plan"].match(call, where, road=road, planner=planner, end=end)
    rows = np.array(call["trajectory"], np.float64)
    plan = {"plan time": rows[:, 0].astype(np.int64), "plan": rows[:, 1:]}
    ours = {"times": seen.time_us + STEP_US * np.arange(STEPS + 1)}
    ours["states"] = np.column_stack([centers, speeds])
    TABLES["trajectory"].match(Source(call.name, "column", plan, call.report), where, **ours)


verify_idm_calls = partial(verify_cases, _compare)
