"""Interlaced video: two fields, recorded one after the other, in one image."""

from dataclasses import replace

import numpy as np

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
    pixels, field = image.pixels[:, ::8].astype(np.float32), image.field_mask[:, ::8]
    repeated = (pixels[1:] == pixels[:-1]).all(axis=1)
    inside = field[:-4] & field[4:] & ~(repeated[1:-2] | repeated[2:-1])[:, None]
    middle = pixels[2:-2]
    near, far = middle - 0.5 * (pixels[1:-3] + pixels[3:-1]), middle - 0.5 * (pixels[:-4] + pixels[4:])
    if not inside.any():
        return 0.0
    a, b = (float(np.sqrt(np.mean(values[inside] ** 2))) for values in (near, far))
    return a / max(b, 1e-6)


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
