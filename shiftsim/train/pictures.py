"""CaRL's rasters as they are kept: most pixels are empty, so that a raster takes some kilobytes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.planners.learned.carl.raster import Raster
from shiftsim.planners.learned.carl.view import CHANNELS, SIZE

_SHAPE = (len(CHANNELS), SIZE, SIZE)
_CODEC = pa.Codec("zstd", 3)


def packed(raster: Raster) -> bytes:
    """A raster (9, 256, 256) as it is kept."""
    content: bytes = _CODEC.compress(np.ascontiguousarray(raster), asbytes=True)
    return content


def unpacked(content: Any) -> Raster:
    """The raster (9, 256, 256) of `packed`, not to be written."""
    size = len(CHANNELS) * SIZE * SIZE
    return np.frombuffer(_CODEC.decompress(content, size), np.uint8).reshape(_SHAPE)


def stack_rasters(rasters: Sequence[Raster], mirrored: Sequence[bool]) -> Raster:
    """(B, 9, 256, 256) of rasters, some of them in the mirror; rows are left and right."""
    return np.stack(
        [
            raster[:, ::-1] if is_mirrored else raster
            for raster, is_mirrored in zip(rasters, mirrored, strict=True)
        ]
    )
