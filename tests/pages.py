"""Reading the pages that replays are."""

import base64
import json
import re
import zlib

import numpy as np

from shiftsim.view.scene import MISSING


def unpack(text):
    """The fields of a packed section, as codec.js reads them."""
    body = zlib.decompress(base64.b64decode(text))
    end = 4 + int.from_bytes(body[:4], "little")
    out = {}
    for field in json.loads(body[4:end]):
        count = int(np.prod(field["shape"]))
        size = 4 * count if field["step"] else count
        raw = np.frombuffer(body[end : end + size], np.uint8)
        end += size
        if field["step"]:
            whole = np.ascontiguousarray(raw.reshape(4, count).T).view("<u4")
            steps = whole.reshape(field["shape"]).astype(np.int64)
            summed = np.cumsum(steps, axis=0) & 0xFFFFFFFF
            signed = summed.astype(np.uint32).view(np.int32)
            raw = np.where(signed == MISSING, np.nan, signed * field["step"])
        out[field["name"]] = raw.reshape(field["shape"])
    assert end == len(body)
    return out


def sections(page):
    """Text of the data elements of a page, by name."""
    return dict(re.findall(r'<script type="[^"]*" id="data-([^"]*)">(.*?)</script>', page, re.S))
