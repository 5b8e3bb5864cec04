"""The first convolution of CaRL's network over the drawn pixels of a raster.

About one pixel in twenty is drawn. Rows are read eight pixels at a time, which a word of 64 bits
holds, and words that are zero are passed over.
"""

import numpy as np
from numpy.typing import NDArray

from shiftsim.kernels import kernel
from shiftsim.planners.learned.carl.raster import Raster

_BYTES = 8  # pixels in a word
_SCALE = np.float32(1.0 / 255.0)
_AFTER = np.uint64(0xFFFFFF)  # those of the next word that the last window in a word reaches


@kernel
def convolve_drawn(
    picture: Raster,
    words: NDArray[np.uint64],
    weight: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Add the convolution of width 5 and stride 2 of a raster, divided by 255, without padding.

    Args:
        picture: (C, N, N) the raster; N is a multiple of 8.
        words: (C, N, N / 8) the same memory.
        weight: (C, 5, 5, 8) weights by channel, row, column and channel made.
        out: ((N - 5) // 2 + 1, as many, 8) what it is added to.
    """
    channels, height, width = words.shape
    size = len(out)
    row = np.zeros(_BYTES * width + 4, np.float32)
    for channel in range(channels):
        for y in range(height):
            drawn = np.uint64(0)
            for word in range(width):
                drawn |= words[channel, y, word]
            if drawn == 0:
                continue
            for x in range(_BYTES * width):
                row[x] = np.float32(picture[channel, y, x]) * _SCALE
            for target in range(max(0, (y - 3) // 2), min(y // 2 + 1, size)):
                line = y - 2 * target
                for word in range(width):
                    after = words[channel, y, word + 1] & _AFTER if word + 1 < width else 0
                    if words[channel, y, word] == 0 and after == 0:
                        continue
                    for x in range(4 * word, min(4 * word + 4, size)):
                        v0, v1, v2 = row[2 * x], row[2 * x + 1], row[2 * x + 2]
                        v3, v4 = row[2 * x + 3], row[2 * x + 4]
                        if v0 + v1 + v2 + v3 + v4 == 0.0:
                            continue
                        for made in range(8):
                            out[target, x, made] += (
                                v0 * weight[channel, line, 0, made]
                                + v1 * weight[channel, line, 1, made]
                                + v2 * weight[channel, line, 2, made]
                                + v3 * weight[channel, line, 3, made]
                                + v4 * weight[channel, line, 4, made]
                            )
