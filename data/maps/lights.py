"""Traffic lights of a recording: their states, however a data set tells them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shiftsim.kernels import IntArray
from shiftsim.world.state import LightStatus, TrafficLights


@dataclass(frozen=True)
class LightStates:
    """States of lights over time; each holds until the next one."""

    names: tuple[str, ...]  # L names, as in `LanePiece.light`
    time_us: IntArray  # (G,) ascending [us]
    status: IntArray  # (G, L) LightStatus codes, -1 not listed


class Cycle(NamedTuple):
    """What a light shows again and again, in time steps."""

    status: Sequence[LightStatus]
    lengths: Sequence[float]  # of each status; at least 0, not all 0
    offset: float  # step at which it begins


def states_of_cycles(
    cycles: Mapping[str, Cycle], steps: IntArray, step_s: float
) -> LightStates | None:
    """States of lights (by name) with fixed cycles, a row per step; None where there is none."""
    if not cycles:
        return None
    columns = []
    for status, lengths, offset in cycles.values():
        index = np.searchsorted(np.cumsum(lengths), (steps - offset) % sum(lengths), side="right")
        columns.append(np.array(status, np.int64)[index])
    time_us = np.rint(steps * step_s * 1e6).astype(np.int64)
    return LightStates(tuple(cycles), time_us, np.stack(columns, axis=1))


def states_of_lists(
    time_us: IntArray,  # (G,) times [us]
    row: IntArray,  # (A,) for each listed light, the index of its time
    lights: IntArray,  # (A,) numbers of the listed lights
    codes: IntArray,  # (A,) what they show
    meaning: Mapping[int, LightStatus],  # that of codes; others are unknown
) -> LightStates:
    """States of lights that are listed anew at each time."""
    names, column = np.unique(lights, return_inverse=True)
    table = np.full((len(time_us), len(names)), LightStatus.ABSENT, np.int64)
    table[row, column] = [meaning.get(code, LightStatus.UNKNOWN) for code in codes.tolist()]
    order = np.argsort(time_us, kind="stable")
    return LightStates(tuple(map(str, names.tolist())), time_us[order], table[order])


def light_rows(states: LightStates, lights: Mapping[str, str], time_us: IntArray) -> TrafficLights:
    """Status of connectors at some times, by the name of the light that each has, if any."""
    column = {name: i for i, name in enumerate(states.names)}
    known = {connector: column[name] for connector, name in lights.items() if name in column}
    at = np.searchsorted(states.time_us, time_us, side="right") - 1
    status = states.status[np.maximum(at, 0)][:, list(known.values())]
    status[at < 0] = LightStatus.ABSENT
    return TrafficLights(tuple(known), status.astype(np.int8))
