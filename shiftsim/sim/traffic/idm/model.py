"""Reactive traffic: vehicles follow the lane graph behind whoever is in front (IDM).

Equal to nuPlan's IDM agents, oddities included (nuplan-simulation.md §10): bicycles, late vehicles
and vehicles off the lanes vanish, replayed objects count as standing, gaps are measured between
footprints that reach 1.5 s ahead, and agents react to the ego of the iteration before. Where
nuPlan's simulation fails, this one raises a TrafficError: an agent is outside of the corridor along
its own path (§12 Q13), or starts on a baseline too short to be a path.
"""

from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.sim.traffic.idm.agents import make_fleet, place_agents
from shiftsim.sim.traffic.idm.scene import Scene, forget, make_scene
from shiftsim.sim.traffic.idm.step import Driving
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, VX, VY, AgentKind, Tracks, center_poses

_EGO_SIZE = np.array([PACIFICA.length, PACIFICA.width])


@dataclass(frozen=True, slots=True)
class IdmParameters:
    """Parameters of the reactive traffic; the defaults are nuPlan's.

    Attributes:
        target_speed: Speed on a free road where the map has no limit [m/s].
        min_gap: Gap kept at standstill [m].
        headway: Time gap kept, and how far footprints reach ahead [s].
        accel_max: Largest acceleration [m/s^2].
        decel_max: Comfortable deceleration, positive [m/s^2].
        min_path_length: Path kept ahead at standstill [m].
        radius: Agents farther from the ego than this are removed for good [m].
        open_loop: Kinds that are replayed from the log, in nuPlan's order of observation.
        replay_rest: Whether bicycles, vehicles off the lanes and late ones are replayed as well,
            and agents know the speed of what is replayed. Not in nuPlan.
    """

    target_speed: float = 10.0
    min_gap: float = 1.0
    headway: float = 1.5
    accel_max: float = 1.0
    decel_max: float = 2.0
    min_path_length: float = 20.0
    radius: float = 100.0
    open_loop: tuple[int, ...] = (
        AgentKind.PEDESTRIAN,
        AgentKind.BARRIER,
        AgentKind.CZONE_SIGN,
        AgentKind.TRAFFIC_CONE,
        AgentKind.GENERIC_OBJECT,
    )
    replay_rest: bool = False


OFFICIAL = IdmParameters()
FIXED = IdmParameters(replay_rest=True)


class IdmTraffic:
    """Vehicles follow the road behind whoever is ahead; other kinds are replayed from the log."""

    def __init__(self, parameters: IdmParameters = OFFICIAL) -> None:
        self.parameters = parameters
        self._scene: Scene | None = None

    def start(
        self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray | None = None
    ) -> None:
        """Put the vehicles of iteration 0 on their lanes; clear what is not simulated.

        With `own`, of these tracks only; what others move stays, and is replayed to the agents.
        """
        kinds, parameters = tracks.kinds, self.parameters
        ego = scenario.ego[scenario.iteration_rows[0]]
        foreign = np.zeros(len(kinds), np.bool_)
        if own is not None:
            foreign = ~np.isin(np.arange(len(kinds)), own)
        open_loop = np.isin(kinds, parameters.open_loop) | foreign
        vehicles = np.flatnonzero(tracks.valid[row] & (kinds == AgentKind.VEHICLE) & ~foreign)
        standing = np.flatnonzero(tracks.valid[row] & open_loop)
        poses, sizes = tracks.poses[row], tracks.sizes[row]
        taken = np.concatenate(
            [
                boxes_to_corners(poses[standing], sizes[standing]),
                boxes_to_corners(center_poses(ego[None, :3]), _EGO_SIZE[None]),
            ]
        )
        starts = place_agents(
            scenario.map,
            poses[vehicles],
            sizes[vehicles],
            taken,
            skip_short=parameters.replay_rest,
        )
        placed = [start for start in starts if start is not None]
        agents = vehicles[np.array([start is not None for start in starts], np.bool_)]
        velocity = tracks.velocities[row, agents]
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        speed = np.where(np.isnan(speed), np.hypot(ego[VX], ego[VY]), speed)
        fleet = make_fleet(scenario.map, placed, sizes[agents], speed, parameters.target_speed)
        others = np.ones(len(kinds), np.bool_)
        others[agents] = False
        replayed = others if parameters.replay_rest else open_loop
        driving = Driving(
            parameters.min_gap,
            parameters.headway,
            parameters.accel_max,
            parameters.decel_max,
            parameters.min_path_length,
            parameters.radius,
            mended=parameters.replay_rest,
        )
        self._scene = make_scene(scenario, fleet, placed, agents, np.flatnonzero(replayed), driving)
        forget(tracks, row, ~replayed)
        self._scene.write(tracks, row)

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move the agents; replayed objects and lights are those of the next iteration."""
        if self._scene is None:
            raise ConfigError("traffic was stepped before it was started", hint="call start first")
        self._scene.advance(iteration, ego, tracks, row)

    @property
    def routes(self) -> dict[int, list[int]]:
        """The last edges of each agent's route, oldest first, by track; agents that are left."""
        if self._scene is None:
            return {}
        fleet = self._scene.fleet
        return {
            int(self._scene.agents[a]): fleet.route[a, : fleet.route_size[a]].tolist()
            for a in np.flatnonzero(fleet.alive)
        }

    @property
    def path_speeds(self) -> FloatArray:
        """Speeds along their paths of the agents that are left, in their order [m/s]."""
        if self._scene is None:
            return np.zeros(0)
        fleet = self._scene.fleet
        speeds: FloatArray = fleet.speed[fleet.alive]
        return speeds


class FixedIdmTraffic(IdmTraffic):
    """IDM traffic without the oddities that nuPlan's users complain of; never for benchmarks.

    Bicycles, vehicles off the lanes and late vehicles do not vanish but are replayed from the log,
    and agents know how fast replayed objects move, so that walking pedestrians are no walls.
    """

    def __init__(self) -> None:
        super().__init__(FIXED)
