"""Interlaced video: two fields, recorded one after the other, in one image."""

from dataclasses import replace

import numpy as np

from sightline.common.kernels import kernel
from sightline.imaging.radiograph import Radiograph

# In a progressive frame, a line differs from the mean of its neighbours by no more than from the mean of the lines two
# away; white noise gives a ratio of 1. Movement between two fields gives a larger ratio.
# [twin, every eighth column: PAL at rest 1.025-1.045 with 120 quanta per pixel and 1.042-1.054 with 15; moved by 1 px
# 1.066-1.086 with 120, lost in noise with 15; progressive frames, degraded in 13 ways, 0.994 at most]
MOVED = 1.06


def comb(image: Radiograph) -> float:
    """Return the rms difference of lines from the mean of their neighbours, over that of the lines two away; see MOVED.

    Lines repeated by an enlargement are left out: structure makes the same steps between them.
    """
    pixels, field = image.pixels[:, ::8].astype(np.float32), np.ascontiguousarray(image.field_mask[:, ::8])
    near, far, count = _squares(pixels, field)
    return float(np.sqrt(near / count) / max(np.sqrt(far / count), 1e-6)) if count else 0.0


@kernel(nogil=True, fastmath=True)
def _squares(pixels, field):
    """Return the sums of squares of both differences of `comb`, and the number of pixels that count."""
    near = far = 0.0
    count, half, zero = 0, np.float32(0.5), np.float32(0.0)
    for i in range(2, len(pixels) - 2):
        a, b, c, d, e = pixels[i - 2], pixels[i - 1], pixels[i], pixels[i + 1], pixels[i + 2]
        above, below = field[i - 2], field[i + 2]
        differs_above = differs_below = False
        for j in range(len(c)):
            differs_above |= b[j] != c[j]
            differs_below |= c[j] != d[j]
        if not (differs_above and differs_below):
            continue
        of_near = of_far = zero
        of_row = np.int32(0)
        for j in range(len(c)):  # without branches, so that it is vectorised
            inside = above[j] & below[j]
            x, y = c[j] - half * (b[j] + d[j]), c[j] - half * (a[j] + e[j])
            of_near += x * x if inside else zero
            of_far += y * y if inside else zero
            of_row += np.int32(inside)
        near += of_near
        far += of_far
        count += of_row
    return near, far, count


def field_of(image: Radiograph, which: int) -> Radiograph:
    """Return the image of the first (0, even lines) or second (1) field, with the other field's lines interpolated.

    Lines keep their places, so beads keep their centres; the resolution across the lines is halved.
    """
    pixels = image.pixels.astype(np.float32)
    lines = np.arange(image.shape[0])
    missing = lines[lines % 2 != which]
    above, below = missing - 1, missing + 1
    above[above < 0], below[below >= len(lines)] = below[above < 0], above[below >= len(lines)]
    pixels[missing] = 0.5 * (pixels[above] + pixels[below])
    if image.pixels.dtype != np.float32:
        pixels = np.rint(pixels).astype(image.pixels.dtype)
    return replace(image, pixels=pixels)
