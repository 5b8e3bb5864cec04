"""Diffusion Planner's network without any reuse: what the adapter's speed is measured against.

The encoder runs once, over all rows, used or not; every call of the sampler computes the whole
decoder, as the official code does.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from shiftsim.planners.nets import diffusion_encoder as encoder
from shiftsim.planners.nets.diffusion_sampler import SCHEDULE, sample


def plain_sample(network: Any, inputs: Mapping[str, Tensor], noise: Tensor) -> Tensor:
    """Trajectories as `DiffusionNetwork.forward` returns them."""
    scene = network.normalise(inputs)
    tokens = plain_encode(network.encoder["encoder"], scene)
    current, absent = network.present(scene)
    dit = network.dit[0]

    def call(x: Tensor, number: int) -> Tensor:
        route = dit.route_encoder(scene["route_lanes"])
        time = SCHEDULE.call_times[number : number + 1]
        return dit(x, dit.prepare(tokens, route, absent, time), 0)

    return network.denormalise(sample(call, current, noise)[:, :, 1:])


def plain_encode(net: Any, scene: Mapping[str, Tensor]) -> Tensor:
    """Tokens as `SceneEncoder` returns them."""
    agents, objects, lanes = (
        scene[name] for name in ("neighbor_agents_past", "static_objects", "lanes")
    )
    batch = len(agents)
    used = [
        (agents[..., :8] != 0).any(-1).any(-1),
        (objects != 0).any(-1),
        (lanes[..., :8] != 0).any(-1).any(-1),
    ]
    limit, known = scene["lanes_speed_limit"], scene["lanes_has_speed_limit"]
    agents, objects, lanes, limit, known = (
        part.flatten(0, 1) for part in (agents, objects, lanes, limit, known)
    )
    tokens = [
        net.neighbor_encoder(agents) + net.pos_emb(encoder._positions(agents[:, -1], 0)),
        net.static_encoder(objects) + net.pos_emb(encoder._positions(objects, 1)),
        net.lane_encoder(lanes, limit, known)
        + net.pos_emb(encoder._lane_positions(lanes[:, encoder.MIDDLE])),
    ]
    x = torch.cat([part.view(batch, -1, part.shape[-1]) for part in tokens], dim=1)
    valid = torch.cat(used, dim=1)
    x = x * valid[..., None]
    valid[:, 0] = True
    mask = torch.zeros_like(valid, dtype=x.dtype).masked_fill(~valid, float("-inf"))
    return net.fusion(x, mask[:, None, None, :])
