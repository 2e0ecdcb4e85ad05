"""The bead: one record, from a candidate's fit to the results of detection; its error before a clipped field."""

from enum import IntEnum

import numpy as np

from sightline.common.kernels import kernel
from sightline.imaging import Radiograph


class BeadStatus(IntEnum):
    """How the fit of a bead ended."""

    FITTED, TOO_FEW_PIXELS, WANDERED, SINGULAR = range(4)


# The first four fields are those of a candidate. With blur and ellipticity they are also the initial values of a fit.
# `large`: whether it is a large ball, whose shadow has a flatter middle, 0 to 1; given, not fitted. `uu_px2`, `uv_px2`,
# `vv_px2`: covariance of the centre. `chi2`: per pixel. `excess`: residual beyond noise over contrast. `weakest`: the
# weakest sector's contrast over the whole bead's.
_FIELDS = (
    *("u_px", "v_px", "radius_px", "contrast", "blur_px", "axial", "diagonal", "large"),
    *("uu_px2", "uv_px2", "vv_px2", "contrast_variance", "chi2", "excess", "weakest"),
)
BEAD = np.dtype([*((name, np.float64) for name in _FIELDS), ("status", np.int64)])
SHADOW = ["u_px", "v_px", "blur_px", "axial", "diagonal", "excess"]  # of a fit: what `Detections.shadows` holds


def centres(beads: np.ndarray) -> np.ndarray:
    """Return the centres (N, 2), px."""
    return np.stack([beads["u_px"], beads["v_px"]], axis=1)


def centre_covariances(beads: np.ndarray) -> np.ndarray:
    """Return the covariances (N, 2, 2), px², of the centres."""
    return np.stack([beads[name] for name in ("uu_px2", "uv_px2", "uv_px2", "vv_px2")], axis=1).reshape(-1, 2, 2)


_AROUND_PX = -1.0, 4.0  # the ring around a bead, from its rim [ours]

# Above this clipped share of the ring, a rim has lost the foot of its edge: radius, blur and background no longer
# separate, and the error of the shadow's profile moves the centre where the background slopes [twin].
WITHOUT_FOOT = 0.2
_PROFILE_SD_PX = 0.03  # of that error, per axis [twin]


def clipped_shares(image: Radiograph, usable: np.ndarray, beads: np.ndarray) -> np.ndarray:
    """Return the clipped share (N,) of the `usable` (H, W) pixels around each of `beads` (N,)."""
    shares = np.zeros(len(beads))
    if image.pixels.max() >= image.white:
        # Masks of one type, read-only like an image's own: the kernel is compiled once.
        clipped, known = image.pixels >= image.white, usable.view()
        clipped.flags.writeable = known.flags.writeable = False
        _fill_shares(clipped, known, beads, shares)
    return shares


def allow_for_missing_foot(beads: np.ndarray, shares: np.ndarray) -> None:
    """Enlarge the covariances of the centres of `beads` (N,) whose rims have no foot, by `shares` (N,)."""
    for name in ("uu_px2", "vv_px2"):
        beads[name][shares > WITHOUT_FOOT] += _PROFILE_SD_PX**2


@kernel()
def _fill_shares(clipped, usable, beads, shares):
    height, width = clipped.shape
    for k in range(len(beads)):
        u, v, radius = beads[k].u_px, beads[k].v_px, beads[k].radius_px
        reach = radius + _AROUND_PX[1]
        inner2, outer2 = np.float32((radius + _AROUND_PX[0]) ** 2), np.float32(reach**2)
        left, right = max(int(u - reach), 0), max(min(int(u + reach) + 2, width), 0)
        seen, count = 0, 0
        for i in range(max(int(v - reach), 0), min(int(v + reach) + 2, height)):
            white, known, dv2 = clipped[i, left:right], usable[i, left:right], np.float32((i - v) ** 2)
            of_row, white_in_row = np.int32(0), np.int32(0)
            for j in range(len(white)):  # without branches, so that it is vectorised
                du = np.float32(j + left) - np.float32(u)
                r2 = du * du + dv2
                around = (r2 > inner2) & (r2 < outer2) & known[j]
                of_row += np.int32(around)
                white_in_row += np.int32(around & white[j])
            seen += of_row
            count += white_in_row
        shares[k] = count / max(seen, 1)
