"""The bead: one record, from a candidate's fit to the results of detection."""

from enum import IntEnum

import numpy as np


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
