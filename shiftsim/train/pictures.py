"""CaRL's rasters as they are kept, and as the network is trained on them.

Most pixels are empty, so that a raster is kept in some kilobytes. For the network the pixels of
2 x 2 blocks lie one after another: the first convolution, of 5 x 5 pixels and stride 2, then is one
of 3 x 3 blocks and stride 1, which processors compute several times faster.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from shiftsim.kernels import kernel
from shiftsim.planners.learned.carl.raster import Raster
from shiftsim.planners.learned.carl.view import CHANNELS, SIZE

NUM_USED, BLOCKS = 8, SIZE // 2  # channels without stop signs, which are never drawn
_EMPTY = 4
_SHAPE = (len(CHANNELS), SIZE, SIZE)
_CODEC = pa.Codec("zstd", 3)
# bfloat16 bits of the values 0 to 255, divided by 255; rounded to nearest
_BITS = ((np.arange(256, dtype=np.float32) / 255.0).view(np.uint32) + 0x8000 >> 16).astype(np.int16)

Blocks = NDArray[np.int16]  # bits of bfloat16


def packed(raster: Raster) -> bytes:
    """A raster (9, 256, 256) as it is kept."""
    content: bytes = _CODEC.compress(np.ascontiguousarray(raster), asbytes=True)
    return content


def unpacked(content: Any) -> Raster:
    """The raster (9, 256, 256) of `packed`, not to be written."""
    size = len(CHANNELS) * SIZE * SIZE
    return np.frombuffer(_CODEC.decompress(content, size), np.uint8).reshape(_SHAPE)


def blocks_of(rasters: Sequence[Raster], mirrored: Sequence[bool]) -> Blocks:
    """(B, 128, 128, 32) bits of bfloat16: rows and columns of blocks, 4 pixels x 8 channels."""
    out = np.zeros((len(rasters), BLOCKS, BLOCKS, 4 * NUM_USED), np.int16)
    for raster, is_mirrored, row in zip(rasters, mirrored, out, strict=True):
        _sort(raster, raster.view(np.uint64), is_mirrored, _BITS, row)
    return out


@kernel
def _sort(
    raster: Raster, words: NDArray[np.uint64], mirrored: bool, bits: Blocks, out: Blocks
) -> None:
    """Write the pixels that are not empty into zeros; rows are left and right."""
    place = 0
    for channel in range(len(raster)):
        if channel == _EMPTY:
            continue
        for row in range(raster.shape[1]):
            line = raster.shape[1] - 1 - row if mirrored else row
            for word in range(words.shape[2]):
                if words[channel, row, word] == 0:
                    continue
                for column in range(8 * word, 8 * word + 8):
                    value = raster[channel, row, column]
                    if value:
                        within = (line % 2 * 2 + column % 2) * 8 + place
                        out[line // 2, column // 2, within] = bits[value]
        place += 1
