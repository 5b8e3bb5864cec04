"""What a notebook shows of scenarios, maps and rollouts, which know nothing of pictures.

And what they answer when they are asked for something by another name.
"""

import html
from collections.abc import Callable, Mapping
from typing import Any

from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import MissingExtraError, nearest
from shiftsim.metrics import MetricResult
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import EgoState, Tracks, Trajectory, speeds


def preformatted(text: str) -> str:
    """Text as HTML that keeps its lines."""
    return f"<pre>{html.escape(text)}</pre>"


def _picture_of(thing: Scenario | VectorMap) -> str:
    """A scenario or a map as a picture; as text where matplotlib is missing."""
    from shiftsim.view.still import overview, svg_of

    try:
        return f"{preformatted(repr(thing))}{svg_of(overview(thing))}"
    except MissingExtraError:
        return preformatted(repr(thing))


def _table_of(log: SimulationLog) -> str:
    """What can be said of a rollout without its map."""
    driven = speeds(log.ego)
    rows = {
        "scenario": log.token,
        "samples": len(log.ego),
        "duration": f"{(log.time_us[-1] - log.time_us[0]) * 1e-6:.1f} s",
        "speed": f"{driven.mean():.1f} m/s on average, {driven.max():.1f} m/s at most",
        "tracks": log.tracks.num_tracks,
        "noise": "yes" if log.noise.any() else "none",
        "planning": f"{log.planning_seconds.mean() * 1e3:.2f} ms per step",
    }
    cells = (f"<tr><th>{name}</th><td>{html.escape(str(v))}</td></tr>" for name, v in rows.items())
    return f"<table>{''.join(cells)}</table>"


for _kind, _shown in (
    (Scenario, _picture_of),
    (VectorMap, _picture_of),
    (SimulationLog, _table_of),
):
    setattr(_kind, "_repr_html_", _shown)  # noqa: B010


def _plot(self: Scenario | VectorMap) -> Any:
    """A matplotlib figure: of a scenario at its first iteration, or of the whole map.

    Raises:
        MissingExtraError: matplotlib is missing.
    """
    from shiftsim.view.still import overview

    return overview(self)


for _kind in (Scenario, VectorMap):
    setattr(_kind, "plot", _plot)  # noqa: B010

# what is asked for by names of other tools: what it is called here
_SYNONYMS: dict[type, str] = {
    Scenario: """agents, objects, boxes: tracks
        id, name: token
        type: scenario_type
        log: log_name
        dt, times: iteration_times
        lights: traffic_lights
        goal: mission_goal
        view: plot(); shiftsim.show(scenario, name=log) replays rollouts
        vector_map: map
        map_name: city
        length: num_iterations
        simulate: shiftsim.simulate(scenario, "idm")""",
    ScenarioStore: """scenarios: iteration, as in `for scenario in store`
        get, load, get_scenario: store[token]
        maps: cities, and map(city)
        types: summary()["type"]
        splits: path / "splits"
        to_pandas: summary().to_pandas()""",
    Observation: """agents, objects: tracks
        time, time_s: time_us
        ego_state: ego
        step: iteration
        map, route: those of the scene that reset(scene) is given""",
    SceneInfo: """vector_map: map
        route_ids, route_roadblock_ids, roadblocks: route
        mission_goal: goal
        scenario: expert, for a planner with `sees_recording = True`
        lanes: route_lanes, or map.edges""",
    EgoState: """position, xy: pose[:2]
        yaw: heading
        rear_axle: pose
        v: speed
        vx: velocity[0]
        steering: steering_angle
        time: time_us""",
    Tracks: """positions, xy: poses[..., :2]
        headings: poses[..., 2]
        ids: tokens
        types, categories: kinds
        mask: valid
        lengths: sizes[..., 0]
        speeds: velocities, whose length it is""",
    SimulationLog: """score, scores, metrics: shiftsim.score(log, scenario)
        plot, show: shiftsim.show(scenario, name=log)
        states: ego
        times: time_us
        agents: tracks
        trajectory: ego; what was planned: plans""",
    Trajectory: """poses: states[:, :3]
        times: time_us
        from_xy: from_poses
        from_states: Trajectory(time_us, states)""",
    MetricResult: """cls, total: score
        metrics: scores, and rows
        violations: rows, each with its violation""",
    VectorMap: """lanes: edges
        roadblocks: blocks
        lane_at: lanes_at(x, y)""",
}


def _words(text: str) -> dict[str, str]:
    """The name here for each name of a list of synonyms."""
    lines = (line.strip().partition(": ") for line in text.splitlines())
    return {name: meant for names, _, meant in lines for name in names.split(", ")}


WORDS: dict[type, dict[str, str]] = {}


def _answer(words: Mapping[str, str]) -> Callable[[Any, str], Any]:
    """`__getattr__` of a class: there is no such attribute, and what may be meant."""

    def __getattr__(self: Any, name: str) -> Any:
        what = f"{type(self).__name__!r} object has no attribute {name!r}"
        if not name.startswith("_"):
            meant = words.get(name) or nearest(name, (n for n in dir(self) if n[0] != "_"))
            what += f"; what you mean may be: {meant}" if meant else ""
        raise AttributeError(what)

    return __getattr__


def answer(kind: type, text: str) -> None:
    """Let objects of a class answer to names of other tools, each with the name here."""
    WORDS[kind] = _words(text)
    setattr(kind, "__getattr__", _answer(WORDS[kind]))  # noqa: B010


for _asked, _text in _SYNONYMS.items():
    answer(_asked, _text)
