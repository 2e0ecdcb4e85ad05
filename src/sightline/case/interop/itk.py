"""ITK text transforms (`.tfm`), and the wire's pose. A file's name says what it maps: `lps_from_cfcs` maps CFCS to LPS.

3D Slicer uses a transform file in the opposite direction: it places objects by the inverse of the mapping in the file.
"""

import numpy as np

from sightline.case.interop.plan_file import PlanFile
from sightline.errors import UnusableInputError


def transform_bytes(matrix: np.ndarray, comment: str) -> bytes:
    """Return the `AffineTransform_double_3_3` file of a matrix (4, 4) that maps points of one frame to another."""
    numbers = [*matrix[:3, :3].ravel(), *matrix[:3, 3]]
    lines = (
        "#Insight Transform File V1.0",
        f"#{comment}".replace("\n", " "),
        "#Transform 0",
        "Transform: AffineTransform_double_3_3",
        "Parameters: " + " ".join(repr(float(x)) for x in numbers),
        "FixedParameters: 0 0 0",
    )
    return ("\n".join(lines) + "\n").encode("ascii", "replace")


def T_lps_cfcs(side: str | None) -> np.ndarray:
    """Return the transform (4, 4) from CFCS to patient LPS, mm. Raises UnusableInputError without a side."""
    out = np.eye(4)
    out[:3, :3] = R_lps_cfcs(side)
    return out


def T_cfcs_wire(points_mm: np.ndarray) -> np.ndarray:
    """Return the wire's pose (4, 4): origin at its end point (the tip), +z from entry to end.

    The rotation about z is arbitrary: x is perpendicular to the CFCS axis at the largest angle to the wire.
    """
    along = (points_mm[1] - points_mm[0]) / np.linalg.norm(points_mm[1] - points_mm[0])
    helper = np.eye(3)[np.argmin(np.abs(along))]
    across = np.cross(helper, along)
    across /= np.linalg.norm(across)
    out = np.eye(4)
    out[:3] = np.column_stack([across, np.cross(along, across), along, points_mm[1]])
    return out


def write(plan: PlanFile, side: str | None) -> dict[str, bytes]:
    """Return the transforms of CFCS and of the wire to LPS, as ITK applies them to points, mm."""
    to_lps = T_lps_cfcs(side)
    wire = to_lps @ T_cfcs_wire(plan.points_mm)
    said = f"mm; {side} hip; {plan.statement}"
    return {
        "lps_from_cfcs.tfm": transform_bytes(to_lps, f"calibration frame (CFCS) to patient LPS, {said}"),
        "lps_from_wire.tfm": transform_bytes(wire, f"wire (origin at the tip, +z towards it) to patient LPS, {said}"),
    }


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
