"""Arrays as compact text for a page: quantised, differenced over time, split into bytes, deflated.

A section is base64 of a zlib stream of: length of the JSON header (uint32, little endian), the
header (a list of fields), and the fields' bytes one after the other. A *quantised* field holds
int32 differences along its first axis as four byte planes, least significant first: neighbouring
samples differ little, so that three of the planes are nearly constant. `codec.js` reads it.
"""

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from shiftsim.kernels import FloatArray

MISSING = -(2**31)  # stands for NaN
_LARGEST = 2**31 - 1


@dataclass(frozen=True, slots=True)
class Quantised:
    """An array to be stored as multiples of a step."""

    values: FloatArray  # (T, …) the values; NaN is kept
    step: float  # resolution, in the unit of the values


def pack(fields: Mapping[str, Quantised | np.ndarray]) -> str:
    """One section: quantised arrays, and byte arrays (bool or uint8) as they are."""
    header = []
    chunks = []
    for name, value in fields.items():
        if isinstance(value, Quantised):
            shape, step = value.values.shape, value.step
            chunks.append(_planes(value))
        else:
            shape, step = value.shape, 0.0
            chunks.append(np.ascontiguousarray(value, np.uint8).tobytes())
        header.append({"name": name, "shape": list(shape), "step": step})
    text = json.dumps(header, separators=(",", ":")).encode()
    body = len(text).to_bytes(4, "little") + text + b"".join(chunks)
    return base64.b64encode(zlib.compress(body, 9)).decode("ascii")


def _planes(field: Quantised) -> bytes:
    missing = np.isnan(field.values)
    scaled = np.rint(np.where(missing, 0.0, field.values) / field.step)
    steps = np.clip(scaled, -_LARGEST, _LARGEST).astype(np.int64)
    steps[missing] = MISSING
    if len(steps) > 1:
        steps[1:] -= steps[:-1].copy()
    wrapped = (steps & 0xFFFFFFFF).astype("<u4")
    return wrapped.reshape(-1, 1).view(np.uint8).T.tobytes()
