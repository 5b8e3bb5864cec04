"""Reactive traffic in small worlds: 100 steps of nuPlan's IDM agents (`idm_world_*.json`)."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from shiftsim.errors import DataError
from shiftsim.sim.traffic.idm.agents import order_observed
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.verify.files import Source, read_fields
from shiftsim.verify.report import Report
from shiftsim.verify.worlds import EGO_COLUMNS, ego_states, make_scenario, read_map, read_objects
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VY, AgentKind, LightStatus, Tracks, TrafficLights

TOLERANCE = 1e-6  # m, rad, m/s
VEHICLE_COLUMNS = ("token", "x", "y", "heading", "vx", "vy", "path_speed", "route_edge_ids")


def verify_idm_world(path: Path, report: Report) -> None:
    """Compare the vehicles of one world after every step, their routes and their order."""
    with report.attempt("idm_world", path.name):
        world, name = read_fields(path, report, "idm_world"), path.stem
        world.note("label", "world")
        scenario, expected = _make_scenario(world), world.each("expected")[0]
        tracks = scenario.tracks.rows(np.arange(scenario.num_iterations))  # a copy, to be driven
        traffic = IdmTraffic()
        traffic.start(scenario, tracks, 0)
        order = order_observed(tracks.kinds, tracks.valid[0])
        ours = {
            "vehicle_columns": list(VEHICLE_COLUMNS),
            "order_frame0": [tracks.tokens[i] for i in order.tolist()],
        }
        expected.match(name, ours, quantity="idm_world")
        frames = expected["vehicles"]
        report.compare("idm_world frames", name, scenario.num_iterations, len(frames))
        for iteration, rows in enumerate(frames[: scenario.num_iterations]):
            if iteration:
                traffic.step(iteration - 1, scenario.ego[iteration - 1], tracks, iteration)
            columns = dict(zip(VEHICLE_COLUMNS, zip(*rows, strict=True), strict=True))
            theirs = Source("idm_world", "column", columns, report)
            _compare_vehicles(f"{name} {iteration}", traffic, scenario, tracks, iteration, theirs)
        world.finish()


def _compare_vehicles(
    where: str,
    traffic: IdmTraffic,
    scenario: Scenario,
    tracks: Tracks,
    iteration: int,
    theirs: Source,
) -> None:
    routes = traffic.routes
    index = np.array(list(routes), np.int64)
    vehicles = np.flatnonzero(tracks.valid[iteration] & (tracks.kinds == AgentKind.VEHICLE))
    theirs.report.compare("idm_world tracks", where, vehicles, index)
    ids = scenario.map.edges.ids
    numbers = [tracks.poses[iteration, index], tracks.velocities[iteration, index]]
    columns = np.column_stack([*numbers, traffic.path_speeds]).T
    ours = dict(zip(VEHICLE_COLUMNS[1:7], columns, strict=True))
    theirs.match(where, {"token": [tracks.tokens[i] for i in index.tolist()]})
    theirs.match(where, ours, TOLERANCE)
    lists = {"route_edge_ids": [[ids[edge] for edge in route] for route in routes.values()]}
    theirs.match_rows(lists, where=f"{where} vehicle")


def _make_scenario(world: Source) -> Scenario:
    road = read_map(world, "has_traffic_lights", "stop_lines", stop_lines=world["stop_lines"])
    time_us = np.array(world["time_us"], np.int64)
    frames = np.transpose(world["ego"])
    things = world.each("objects")
    counts = {len(world["lights"]), frames.shape[1], *(len(thing["frames"]) for thing in things)}
    if counts != {len(time_us)}:
        raise DataError(f"{sorted(counts)} frames for {len(time_us)} time stamps")
    ego = ego_states(dict(zip(EGO_COLUMNS[: VY + 1], frames, strict=True)))
    tracks = read_objects(sorted(things, key=lambda o: AgentKind[o["type"]]), len(time_us))
    out = make_scenario(str(world.values["world"]), road, time_us, ego, tracks)
    ids = tuple(sorted({name for row in world["lights"] for name in row}))
    status = [[LightStatus[row.get(name, "ABSENT")] for name in ids] for row in world["lights"]]
    return replace(out, traffic_lights=TrafficLights(ids, np.array(status, np.int8)))
