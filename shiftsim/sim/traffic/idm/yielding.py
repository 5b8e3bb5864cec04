"""How reactive agents of interPlan treat the ego: some yield to where it will be within 3 s.

Edited scenarios may ask for it (docs/edits.md); nuPlan's agents only see the ego's box, and for
them the footprint `ego ahead`, which follows that of the ego, is never present.
"""

import random

import numpy as np

from shiftsim.kernels import BoolArray, kernel
from shiftsim.sim.traffic.idm.gaps import ring_gap
from shiftsim.sim.traffic.idm.paths import add_curve, set_box
from shiftsim.sim.traffic.idm.scene import Scene, Yielding
from shiftsim.world.events import ASSERTIVE, DEFAULT, MIXED, OFF
from shiftsim.world.layers import contains
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.state import PACIFICA

LOOK_AHEAD = 3.0  # s, at constant velocity
_TIMES = np.arange(0, LOOK_AHEAD + 0.1, 0.1)  # as interPlan samples it; the last one counts
_REACH = float(_TIMES[-1])  # s
_LENGTH, _WIDTH = PACIFICA.length, PACIFICA.width
_TOUCH = 1e-6  # m


def make_yielding(
    road: VectorMap, policy: int, cautious: BoolArray, seed: int, num_steps: int
) -> Yielding:
    """What agents, of which some are `cautious` (A,), make of the ego."""
    draws = [0]
    if policy == MIXED:
        coin = random.Random(seed)
        draws = [coin.randint(0, 1) for _ in range(max(1, num_steps * len(cautious)))]
    return Yielding(
        policy=policy,
        cautious=cautious,
        edges=road.edges.polygons,
        block_of=road.block_of,
        draws=np.array(draws, np.int64),
        num_drawn=np.zeros(1, np.int64),
        ego_block=np.full(1, NONE, np.int64),
    )


@kernel
def place_ego_ahead(scene: Scene, x: float, y: float, heading: float, vx: float, vy: float) -> None:
    """Put the footprint of where the ego will be: a straight corridor with square ends.

    The ego's centre is at x, y [m], its velocity vx, vy is in its own frame [m/s].
    """
    footprints = scene.footprints
    if scene.yielding.policy == OFF:
        return
    place = len(scene.agents) + 1
    set_box(footprints, place, x, y, heading, _LENGTH, _WIDTH)
    cos, sin = np.cos(heading), np.sin(heading)
    half, reach = 0.5 * _LENGTH, 0.5 * _WIDTH
    line = np.empty((4, 2))
    line[0, 0], line[0, 1] = x - (half + reach) * cos, y - (half + reach) * sin
    line[1, 0], line[1, 1] = x, y
    line[2, 0], line[2, 1] = x + half * cos, y + half * sin
    dx, dy = _REACH * (vx * cos - vy * sin), _REACH * (vx * sin + vy * cos)
    far = np.sqrt(dx * dx + dy * dy)
    count = 3
    if far > 1e-6:  # else the front is where it is
        line[3, 0] = line[2, 0] + dx + reach * dx / far
        line[3, 1] = line[2, 1] + dy + reach * dy / far
        count = 4
    else:
        line[2, 0] += reach * cos
        line[2, 1] += reach * sin
    curve, bounds = footprints.curve[place], footprints.bounds[place]
    footprints.curve_size[place] = add_curve(line[:count], reach, curve, bounds)


@kernel
def ignores_ego_ahead(scene: Scene, agent: int) -> bool:
    """Whether an agent, in whose corridor the ego will be, does not mind.

    nuPlan rule 703: in its own lane never; in its own roadblock by the policy, unless the ego is
    behind; elsewhere all yield but for the default policy and those that the ego drives into.
    """
    yielding, fleet, footprints = scene.yielding, scene.fleet, scene.footprints
    ego, ahead = len(scene.agents), len(scene.agents) + 1
    ego_x = 0.5 * (footprints.box[ego, 0, 0] + footprints.box[ego, 2, 0])
    ego_y = 0.5 * (footprints.box[ego, 0, 1] + footprints.box[ego, 2, 1])
    x, y, heading = fleet.pose[agent, 0], fleet.pose[agent, 1], fleet.pose[agent, 2]
    lane = -1
    for segment in range(fleet.route_size[agent]):
        if contains(yielding.edges, fleet.route[agent, segment], x, y):
            lane = fleet.route[agent, segment]
            break
    if lane >= 0 and contains(yielding.edges, lane, ego_x, ego_y):
        return True
    if lane >= 0 and yielding.block_of[lane] == yielding.ego_block[0]:
        if (ego_x - x) * np.cos(heading) + (ego_y - y) * np.sin(heading) < 0.0:
            return True
        if yielding.policy == MIXED:
            drawn = yielding.num_drawn[0] % len(yielding.draws)
            yielding.num_drawn[0] += 1
            return yielding.draws[drawn] == 1
        return yielding.policy == ASSERTIVE
    if yielding.policy == DEFAULT:
        return True
    box = footprints.box[agent]
    curve = footprints.curve[ahead, : footprints.curve_size[ahead]]
    if ring_gap(curve, box, _TOUCH) == 0.0:
        return True
    return ring_gap(footprints.box[ahead], box, _TOUCH) == 0.0
