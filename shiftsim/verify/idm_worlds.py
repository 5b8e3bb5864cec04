"""Reactive traffic in small worlds: 100 steps of nuPlan's IDM agents (`idm_world_*.json`)."""

from dataclasses import replace

import numpy as np

from shiftsim.errors import DataError
from shiftsim.sim.traffic.idm.agents import order_observed
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.verify.files import Source
from shiftsim.verify.worlds import EGO_COLUMNS, ego_states, read_map, read_scenario
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VY, AgentKind, LightStatus, TrafficLights

TOLERANCE = 1e-6  # m, rad, m/s
NUMBERS = ("x", "y", "heading", "vx", "vy", "path_speed")  # of a vehicle
COLUMNS = ["token", *NUMBERS, "route_edge_ids"]


def compare_idm_world(world: Source, name: str) -> None:
    """Compare the vehicles of one world after every step, their routes and their order."""
    world.note("label", "world")
    report, scenario, expected = world.report, _make_scenario(world), world.each("expected")[0]
    tracks = scenario.tracks.rows(np.arange(scenario.num_iterations))  # a copy, to be driven
    traffic = IdmTraffic()
    traffic.start(scenario, tracks, 0)
    order = order_observed(tracks.kinds, tracks.valid[0]).tolist()
    ours = {"vehicle_columns": COLUMNS, "order_frame0": [tracks.tokens[i] for i in order]}
    expected.match(name, ours, quantity="idm_world")
    frames, is_vehicle = expected["vehicles"], tracks.kinds == AgentKind.VEHICLE
    report.compare("idm_world frames", name, scenario.num_iterations, len(frames))
    for iteration, rows in enumerate(frames[: scenario.num_iterations]):
        if iteration:
            traffic.step(iteration - 1, scenario.ego[iteration - 1], tracks, iteration)
        where, index = f"{name} {iteration}", np.array(list(traffic.routes), np.int64)
        vehicles = np.flatnonzero(tracks.valid[iteration] & is_vehicle)
        report.compare("idm_world tracks", where, vehicles, index)
        values = np.array(rows, np.object_).reshape(-1, len(COLUMNS)).T
        theirs = Source("idm_world", "column", dict(zip(COLUMNS, values, strict=True)), report)
        theirs.match(where, {"token": [tracks.tokens[i] for i in index.tolist()]})
        numbers = [tracks.poses[iteration, index], tracks.velocities[iteration, index]]
        columns = np.column_stack([*numbers, traffic.path_speeds]).T
        theirs.match(where, dict(zip(NUMBERS, columns, strict=True)), TOLERANCE)
        ids = scenario.map.edges.ids
        if len(index) != len(rows):
            raise DataError(f"idm_world: {len(rows)} vehicles, of ours {len(index)}")
        for row, route in enumerate(traffic.routes.values()):
            ours = {"route_edge_ids": [ids[edge] for edge in route]}
            theirs.at(row).match(f"{where} vehicle {row}", ours)


def _make_scenario(world: Source) -> Scenario:
    road = read_map(world, "has_traffic_lights", "stop_lines")
    columns = zip(EGO_COLUMNS[: VY + 1], np.transpose(world["ego"]), strict=True)
    out, lights = read_scenario(world, road, ego_states(dict(columns))), world["lights"]
    ids = tuple(sorted({name for row in lights for name in row}))
    if lost := set(ids) - set(road.edges.ids):
        raise DataError(f"lights are on lanes that the map does not have: {sorted(lost)}")
    if len(lights) != out.num_iterations:
        raise DataError(f"{len(lights)} lists of lights for {out.num_iterations} time stamps")
    status = [[LightStatus[row.get(name, "ABSENT")] for name in ids] for row in lights]
    return replace(out, traffic_lights=TrafficLights(ids, np.array(status, np.int8)))
