"""Beads before a clipped background: how much of the foot of a rim is clipped, and what its centre's error is then."""

import numpy as np

from sightline.detection.beads import columns
from sightline.imaging import Radiograph
from sightline.kernels import exact

_AROUND_PX = -1.0, 4.0  # the ring around a bead, from its rim [ours]

# Above this clipped share of the ring, a rim has lost the foot of its edge: radius, blur and background no longer
# separate, and the error of the shadow's profile moves the centre where the background slopes [twin].
WITHOUT_FOOT = 0.2
_PROFILE_SD_PX = 0.03  # of that error, per axis [twin]


def clipped_shares(image: Radiograph, usable: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the clipped share (N,) of the `usable` (H, W) pixels around each bead of `rows` (N, COUNT)."""
    shares = np.zeros(len(rows))
    if image.pixels.max() >= image.white:
        held = usable.view()
        held.flags.writeable = False  # as an image's own masks are: the kernel is compiled once
        _fill_shares(image.pixels, image.white, held, rows, shares)
    return shares


def allow_for_missing_foot(rows: np.ndarray, shares: np.ndarray) -> None:
    """Enlarge the covariances of the centres of `rows` (N, COUNT) whose rims have no foot, by `shares` (N,)."""
    lost = shares > WITHOUT_FOOT
    for column in (columns.CUU, columns.CVV):
        rows[lost, column] += _PROFILE_SD_PX**2


@exact
def _fill_shares(pixels, white, usable, rows, shares):
    height, width = pixels.shape
    for k in range(len(rows)):
        u, v, radius = rows[k, columns.U], rows[k, columns.V], rows[k, columns.RADIUS]
        reach = radius + _AROUND_PX[1]
        inner2, outer2 = np.float32((radius + _AROUND_PX[0]) ** 2), np.float32(reach**2)
        left, right = max(int(u - reach), 0), max(min(int(u + reach) + 2, width), 0)
        seen, count = 0, 0
        for i in range(max(int(v - reach), 0), min(int(v + reach) + 2, height)):
            values, known, dv2 = pixels[i, left:right], usable[i, left:right], np.float32((i - v) ** 2)
            of_row, clipped = np.int32(0), np.int32(0)
            for j in range(len(values)):  # without branches, so that it is vectorised
                du = np.float32(j + left) - np.float32(u)
                r2 = du * du + dv2
                around = (r2 > inner2) & (r2 < outer2) & known[j]
                of_row += np.int32(around)
                clipped += np.int32(around & (values[j] >= white))
            seen += of_row
            count += clipped
        shares[k] = count / max(seen, 1)
