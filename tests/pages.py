"""Reading the pages that replays are."""

import base64
import json
import re
import zlib

import numpy as np

from shiftsim.view.scene import MISSING


def unpack(text, base=None):
    """The fields of a packed section, as codec.js reads them; `base` is the first rollout."""
    return {name: values for name, (values, _) in _unpack(text, base and _unpack(base)).items()}


def _unpack(text, base=None):
    """Values and whole steps of the fields, by name."""
    body = zlib.decompress(base64.b64decode(text))
    end = 4 + int.from_bytes(body[:4], "little")
    out = {}
    for field in json.loads(body[4:end]):
        shape = field["shape"]
        count = int(np.prod(shape))
        size = 4 * count if field["step"] else count
        raw = steps = np.frombuffer(body[end : end + size], np.uint8)
        end += size
        if field["step"]:
            bits = np.ascontiguousarray(raw.reshape(4, count).T).view("<u4")
            signed = (bits >> 1).astype(np.int64) ^ -(bits & 1).astype(np.int64)
            steps = np.moveaxis(signed.reshape(*shape[1:], shape[0]), -1, 0).copy()
            steps[1:] = np.cumsum(steps[1:], axis=0)
            steps = np.cumsum(steps, axis=0)
            if field.get("base"):
                steps += base[field["name"]][1]
            steps = steps.astype(np.int32)
            raw = np.where(steps == MISSING, np.nan, steps * field["step"])
        out[field["name"]] = raw.reshape(shape), steps
    assert end == len(body)
    return out


def sections(page):
    """Text of the data elements of a page, by name."""
    return dict(re.findall(r'<script type="[^"]*" id="data-([^"]*)">(.*?)</script>', page, re.S))
