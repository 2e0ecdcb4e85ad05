"""Patient axes in CFCS: the side decides the direction of +Y (docs/conventions.md)."""

import numpy as np

from sightline.errors import UnusableInputError

# Rows: left, posterior, superior. Columns: CFCS x (lateral), y (caudal for a right hip, cranial for a left one) and z
# (anterior). Both are rotations, not reflections, because lateral and +Y change sign together with the side.
_LPS_CFCS = {
    "right": np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]),
    "left": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}


def R_lps_cfcs(side: str | None) -> np.ndarray:
    """Return the rotation (3, 3) from CFCS to patient LPS; both share the origin. Raises UnusableInputError without a
    side."""
    if side not in _LPS_CFCS:
        raise UnusableInputError(
            "patient axes depend on the side of the hip; add --side right or --side left, as confirmed in the images"
        )
    return _LPS_CFCS[side]
