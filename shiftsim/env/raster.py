"""CaRL's observation, and the picture of an episode, which is made of the same raster."""

from typing import Any

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import ArrayLike

from shiftsim.env.episode import Episode, Observer, as_command
from shiftsim.kernels import BoolArray
from shiftsim.planners.learned.carl import view
from shiftsim.planners.learned.carl.planner import draw, measure
from shiftsim.planners.learned.carl.raster import Raster
from shiftsim.planners.learned.carl.roads import make_roads
from shiftsim.planners.learned.map_features import LightLookup
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.map import PerMap
from shiftsim.world.state import LightStatus

LARGEST = 1e4  # of a measurement, in its unit; none comes near
SHAPE = (len(view.CHANNELS), view.SIZE, view.SIZE)
_COLOURS = {  # red, green, blue by channel; what is drawn first lies below
    view.DRIVABLE: (216, 216, 220),
    view.ROUTE: (185, 210, 190),
    view.BOUNDARIES: (150, 150, 150),
    view.LIGHTS: (190, 60, 60),
    view.VEHICLES: (70, 95, 130),
    view.PEDESTRIANS: (168, 121, 30),
    view.EGO: (180, 40, 120),
}

_roads = PerMap(make_roads)  # of all environments of a process


class RasterBuilder:
    """CaRL's raster in one scenario. The route is drawn as the scenario gives it."""

    def __init__(self, scene: SceneInfo) -> None:
        """Rasterize the map."""
        self._roads = _roads(scene.map)
        self._on_route: BoolArray = np.zeros(len(scene.map.blocks), np.bool_)
        self._on_route[scene.route_blocks] = True
        self._lights = LightLookup(scene.map, LightStatus.ABSENT)

    def draw(self, observation: Observation) -> Raster:
        """The raster (9, 256, 256) of an observation."""
        ego, tracks = observation.history.ego[-1].copy(), observation.history.tracks
        raster, status = np.zeros(SHAPE, np.uint8), self._lights.at(observation.lights)
        draw(raster, self._roads, ego, tracks, -1, self._on_route, status)
        return raster


def raster_observation(
    scene: SceneInfo, observation: Observation, action: ArrayLike = (0.0, 0.0)
) -> dict[str, Any]:
    """What a policy of `observation="raster"` sees; `action` (2,) is the last one.

    All but the `value_measurements`, which only a critic reads.
    """
    last = np.asarray(action, np.float32)
    return {
        "raster": scene.once(RasterBuilder).draw(observation),
        "measurements": measure(observation.history.ego[-1], last).astype(np.float32),
    }


class RasterObserver(Observer):
    """CaRL's raster and measurements, and what only its critic sees."""

    space: Space[Any] = spaces.Dict(
        {
            "raster": spaces.Box(0, 255, SHAPE, np.uint8),
            "measurements": spaces.Box(-LARGEST, LARGEST, (10,)),
            # shares of time and way that are left, comfort and time to collision
            "value_measurements": spaces.Box(0.0, 1.0, (4,)),
        }
    )

    def look(self, episode: Episode) -> dict[str, Any]:
        """The present raster and measurements."""
        observation, terms = episode.observe(), episode.terms
        seen = raster_observation(episode.scene, observation, as_command(episode.action))
        if terms is not None:  # a planner that is not shown the recording has none
            time_left = 1.0 - observation.iteration / len(episode.scene.times)
            critic = [time_left, 1.0 - terms.completion, terms.comfort, terms.ttc]
            seen["value_measurements"] = np.array(critic, np.float32)
        return seen


def picture_of(episode: Episode) -> np.ndarray:
    """(256, 256, 3) uint8, driving to the right, left is up."""
    raster = episode.scene.once(RasterBuilder).draw(episode.observe())
    picture = np.full((view.SIZE, view.SIZE, 3), 245, np.uint8)
    for channel, colour in _COLOURS.items():
        picture[raster[channel, ::-1] > 0] = colour
    return picture
