"""Small stores to run planners on."""

from dataclasses import replace

import numpy as np
from worlds import cruise_scenario, standing_tracks, straight_road

from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store.writing import StoreWriter
from shiftsim.world.state import AgentKind

ITERATIONS = 25


def write_toy_store(path, *, count=4, iterations=ITERATIONS, first=0):
    """`count` scenarios on a straight road; the ego meets a parked car in every second one."""
    with StoreWriter(path) as writer:
        writer.add_map(straight_road())
        for number in range(first, first + count):
            _add(writer, number, iterations)
    return path


def _add(writer, number, iterations):
    bare = cruise_scenario(speed=6.0 + number % 50, iterations=iterations)
    rows = len(bare.time_us)
    poses = np.array([[60.0 if number % 2 else 30.0, 0.0 if number % 2 else 3.5, 0.0]])
    scene = replace(bare, tracks=standing_tracks(rows, poses, [AgentKind.VEHICLE]))
    log = f"log-{number}"
    writer.add_recording(
        Recording(log, "straight", scene.time_us, scene.tracks, scene.traffic_lights)
    )
    writer.add_ego(EgoTrace(log, "ego", 0, scene.ego))
    writer.add_window(
        Window(
            token=f"{number:04x}cafe",
            scenario_type="parked" if number % 2 else "free",
            log_name=log,
            ego="ego",
            first_row=0,
            last_row=rows,
            iteration_rows=scene.iteration_rows,
            row_step=2,
            route=scene.route,
            mission_goal=scene.mission_goal,
            mapping=scene.mapping,
        )
    )
