"""Interlaced video: two fields, one after the other, woven into one image."""

from dataclasses import replace

import numpy as np

from sightline.imaging.radiograph import Radiograph

# A line of a whole frame lies as near to the mean of its neighbours as to that of the lines two away, or nearer: in
# structure, and in noise where that is blurred; white noise alone gives 1. Fields between which something moved do not.
# [twin, of every eighth column: PAL at rest 1.025-1.045 with 120 quanta a pixel and 1.042-1.054 with 15; moved by 1 px
# 1.066-1.086 with 120, lost in noise with 15; whole frames, spoilt in 13 ways, 0.994 at most]
MOVED = 1.06


def comb(image: Radiograph) -> float:
    """How far lines lie from the mean of their neighbours, over how far from that of the lines two away; see MOVED.

    Lines that an enlargement repeats are left out: between them structure makes the same steps.
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
    """The image as its first (0, the even lines) or second (1) field shows it: the other's lines are interpolated.

    No line moves, so that a bead's centre is where it was; across the lines the image is half as sharp.
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
