"""Diffusion Planner's network without any reuse: what the adapter's speed is measured against.

Written with torch's own attention: the encoder runs once, over all rows, used or not; every call of
the sampler computes the whole decoder.
"""

import copy
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from shiftsim.planners.learned.diffusion.network import encoder
from shiftsim.planners.learned.diffusion.network.sampler import SCHEDULE, sample


def plain_network(network: Any) -> Any:
    """A copy whose weights lie in memory as torch makes them."""
    made = copy.deepcopy(network)
    for parameter in made.parameters():
        parameter.data = parameter.data.contiguous()
    return made


def plain_sample(network: Any, inputs: Mapping[str, Tensor], noise: Tensor) -> Tensor:
    """Trajectories as `DiffusionNetwork.forward` returns them."""
    scene = network.normalise(inputs)
    tokens = plain_encode(network.encoder["encoder"], scene)
    current, absent = network.present(scene)
    dit = network.dit[0]

    def call(x: Tensor, number: int) -> Tensor:
        time = SCHEDULE.call_times[number : number + 1]
        return _decode(dit, x, time, scene["route_lanes"], tokens, absent)

    return network.denormalise(sample(call, current, noise)[:, :, 1:])


def _decode(
    dit: Any, x: Tensor, time: Tensor, route: Tensor, tokens: Tensor, absent: Tensor
) -> Tensor:
    kinds = torch.cat([dit.agent_embedding.weight[:1]] + [dit.agent_embedding.weight[1:]] * 10)
    x = _mlp(dit.preproj, x) + kinds
    y = _route(dit.route_encoder, route) + dit.t_embedder(time)
    for block in dit.blocks:
        shift1, scale1, gate1, shift2, scale2, gate2 = block.adaLN_modulation(y)[:, None].chunk(
            6, dim=-1
        )
        z = block.norm1(x) * (1 + scale1) + shift1
        x = x + gate1 * _attend(block.attn, z, z, absent)
        x = x + gate2 * _mlp(block.mlp1, block.norm2(x) * (1 + scale2) + shift2)
        x = _attend(block.cross_attn, block.norm3(x), tokens, None)
        x = _mlp(block.mlp2, block.norm4(x))
    last = dit.final_layer
    shift, scale = last.adaLN_modulation(y)[:, None].chunk(2, dim=-1)
    return last.proj(last.norm_final(x) * (1 + scale) + shift)


def _route(net: Any, route: Tensor) -> Tensor:
    points = route[..., :4].flatten(1, 2)
    x = _mlp(net.channel_pre_project, points).transpose(1, 2)
    x = _mlp(net.token_pre_project, x).transpose(1, 2)
    x = _mlp(net.emb_project, net.norm(_mix(net.Mixer, x).mean(dim=1)))
    return x * (points != 0).any(-1).any(-1, keepdim=True)


def _attend(net: Any, query: Tensor, keys: Tensor, unseen: Tensor | None) -> Tensor:
    """What `torch.nn.MultiheadAttention` computes."""
    query, keys = query.transpose(0, 1), keys.transpose(0, 1)
    out, _ = functional.multi_head_attention_forward(
        query,
        keys,
        keys,
        net.out_proj.in_features,
        net.num_heads,
        net.in_proj_weight,
        net.in_proj_bias,
        None,
        None,
        False,
        0.0,
        net.out_proj.weight,
        net.out_proj.bias,
        training=False,
        key_padding_mask=unseen,
    )
    return out.transpose(0, 1)


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
        _agents(net.neighbor_encoder, agents) + net.pos_emb(encoder._positions(agents[:, -1], 0)),
        _mlp(net.static_encoder.projection, objects) + net.pos_emb(encoder._positions(objects, 1)),
        _lanes(net.lane_encoder, lanes, limit, known)
        + net.pos_emb(encoder._lane_positions(lanes[:, encoder.MIDDLE])),
    ]
    x = torch.cat([part.view(batch, -1, part.shape[-1]) for part in tokens], dim=1)
    valid = torch.cat(used, dim=1)
    x = x * valid[..., None]
    valid[:, 0] = True
    for block in net.fusion.blocks:
        x = x + _attend(block.attn, block.norm1(x), x, ~valid)
        x = x + _mlp(block.mlp, block.norm2(x))
    return net.fusion.norm(x)


def _agents(net: Any, agents: Tensor) -> Tensor:
    present = (agents[..., :8] != 0).any(-1, keepdim=True)
    x = _mean(net, torch.cat([agents[..., :8], present], dim=-1))
    return _mlp(net.emb_project, net.norm(x + net.type_emb(agents[:, -1, 8:])))


def _lanes(net: Any, lanes: Tensor, limit: Tensor, known: Tensor) -> Tensor:
    speed = torch.where(known, net.speed_limit_emb(limit), net.unknown_speed_emb.weight)
    x = _mean(net, lanes[..., :8]) + speed + net.traffic_emb(lanes[:, 0, 8:])
    return _mlp(net.emb_project, net.norm(x))


def _mean(net: Any, x: Tensor) -> Tensor:
    x = _mlp(net.channel_pre_project, x).transpose(1, 2)
    x = _mlp(net.token_pre_project, x).transpose(1, 2)
    for block in net.blocks:
        x = _mix(block, x)
    return x.mean(dim=1)


def _mix(block: Any, x: Tensor) -> Tensor:
    x = x + _mlp(block.tokens_mlp, block.norm1(x).transpose(1, 2)).transpose(1, 2)
    return x + _mlp(block.channels_mlp, block.norm2(x))


def _mlp(net: Any, x: Tensor) -> Tensor:
    return net.fc2(functional.gelu(net.fc1(x), approximate=net.approximate))
