"""Patient axes from CFCS: the side tells which way +Y points (docs/conventions.md)."""

import numpy as np

from sightline.errors import UnusableInputError

# Rows: left, posterior, superior, of CFCS x (lateral), y (caudal for a right hip, cranial for a left one) and z
# (anterior). Both are turns, no mirror images: with the side, lateral and +Y change sign together.
_LPS_CFCS = {
    "right": np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]),
    "left": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}


def R_lps_cfcs(side: str | None) -> np.ndarray:
    """(3, 3): CFCS to patient LPS; the origin stays that of CFCS. Raises UnusableInputError without a side."""
    if side not in _LPS_CFCS:
        raise UnusableInputError(
            "patient axes depend on the side of the hip; add --side right or --side left, as confirmed in the images"
        )
    return _LPS_CFCS[side]
