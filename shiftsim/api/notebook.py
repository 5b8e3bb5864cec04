"""What a notebook shows of scenarios, maps and rollouts, which know nothing of pictures.

And what they answer when they are asked for something by another name.
"""

import html
from typing import Any

from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import MissingExtraError, no_attribute
from shiftsim.metrics import MetricResult
from shiftsim.runs.results import Run
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.view.still import overview, svg_of
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import EgoState, Tracks, Trajectory, speeds


def preformatted(text: str) -> str:
    """Text as HTML that keeps its lines."""
    return f"<pre>{html.escape(text)}</pre>"


def _picture_of(thing: Scenario | VectorMap) -> str:
    """A scenario or a map as a picture; as text where matplotlib is missing."""
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


def _missing(self: Any, name: str) -> Any:
    """`__getattr__` of what has no such attribute: says what may be meant."""
    owners = [kind.__name__ for kind in type(self).__mro__]
    # `dir` itself asks for attributes that begin like that
    names = [] if name[0] == "_" else [other for other in dir(self) if other[0] != "_"]
    raise no_attribute(f"{type(self).__name__!r} object", owners, name, names)


setattr(SimulationLog, "_repr_html_", _table_of)  # noqa: B010
for _kind in (Scenario, VectorMap):
    setattr(_kind, "_repr_html_", _picture_of)  # noqa: B010
    setattr(_kind, "plot", overview)  # noqa: B010
for _kind in (
    *(Scenario, ScenarioStore, Observation, SceneInfo, EgoState, Tracks),
    *(SimulationLog, Trajectory, MetricResult, VectorMap, Run),
):
    setattr(_kind, "__getattr__", _missing)  # noqa: B010
