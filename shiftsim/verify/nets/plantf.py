"""PlanTF: network on synthetic inputs, and closed loops from the log to the trajectory."""

from functools import partial

import numpy as np

from shiftsim.planners.learned.plan_states import plan_of_poses
from shiftsim.planners.learned.plantf.planner import MAX_AGENTS, RADIUS, PlanTF, make_batch
from shiftsim.verify.nets.loops import PLAN_COLUMNS, PLANS, POSITION, Loop, verify_loop
from shiftsim.verify.nets.networks import make_network
from shiftsim.verify.nets.vectors import (
    compare_features,
    compare_outputs,
    derived_outputs,
    run_network,
    verify_forward,
    verify_vector_manifest,
)

NAME = PlanTF.name
MOTION = 1e-5  # m/s, m/s^2: derivatives of the recorded poses


def _compare(loop: Loop) -> None:
    """Compare features, raw outputs and plan of one iteration."""
    loop.compare_plan(POSITION)
    theirs = loop.recorded("trajectory")
    again = plan_of_poses(theirs[1:, :3], loop.seen.history).states[:, 3:PLAN_COLUMNS]
    loop.compare("motion of the recorded plan", again, theirs[:, 3:], MOTION)
    if not list(loop.stored):
        return
    features, variant = loop.features, loop.variant
    others = {
        "current_state": features.current_state,
        # the official code gives every agent the category of the ego at inference
        "agent.category": np.zeros(len(features.agents.valid), np.int64),
    }
    compare_features(loop, features.agents, features.road, features.route, others)
    raw = run_network(NAME, make_network(NAME, variant), make_batch([features], "cpu"))
    ours = {name: value[0] for name, value in raw.items()}
    ours |= derived_outputs(ours, None)
    compare_outputs(loop.stored.below("net/"), loop.where, NAME, variant, ours)


FILES = {
    "state_dict.json": partial(
        verify_vector_manifest, planner=NAME, radius=RADIUS, max_agents=MAX_AGENTS
    ),
    "forward_*.npz": partial(verify_forward, planner=NAME, radius=RADIUS),
    "closed_loop_*.npz": partial(verify_loop, make=PlanTF, compare=_compare, recorded=PLANS),
}
