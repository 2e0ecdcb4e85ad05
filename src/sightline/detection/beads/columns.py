"""Columns of a bead fit's result, and the values of its status."""

import numpy as np

# Centre, px; radius, px; contrast of log light; blur in the image, px (these five are also the initial values of a
# fit); covariance of the centre, px²; variance of the contrast; chi-square per pixel; residual beyond noise over
# contrast; the weakest sector's contrast over the whole bead's; status; ellipticity along the axes and the diagonals
# (initial values too); whether it is a large ball, whose shadow has a flatter middle: 0 no, 1 yes (given, not fitted).
U, V, RADIUS, CONTRAST, BLUR, CUU, CUV, CVV, CCC, CHI2, EXCESS, WEAKEST, STATUS, AXIAL, DIAGONAL, LARGE = range(16)
COUNT = 16
CENTRE_COVARIANCE = [CUU, CUV, CVV]
# Of a fit: what `Detections.shadows` holds.
SHADOW = [U, V, BLUR, AXIAL, DIAGONAL, EXCESS]
FITTED, TOO_FEW_PIXELS, WANDERED, SINGULAR = 0, 1, 2, 3


def centre_covariances(rows: np.ndarray) -> np.ndarray:
    """Return the covariances (N, 2, 2), px², of the centres of rows (N, COUNT)."""
    return rows[:, [CUU, CUV, CUV, CVV]].reshape(-1, 2, 2)
