"""The effective focal point: least-squares intersection of lines (paper, section 4.3, figure 11)."""

import numpy as np

from sightline.errors import CalibrationRefusedError, ReconstructionRefusedError
from sightline.geometry.lines import meeting_point

# The paper used 16 to 25 lines. Four lines leave five degrees of freedom to test three parameters [ours].
MIN_LINES = 4


def focal_point(from_mm: np.ndarray, to_mm: np.ndarray) -> np.ndarray:
    """Return the least-squares intersection (3,) of lines through `from_mm` (N, 3) and `to_mm` (N, 3).

    Raises CalibrationRefusedError for too few or parallel lines.
    """
    if len(from_mm) < MIN_LINES:
        raise CalibrationRefusedError(
            f"only {len(from_mm)} lines of sight run through the beads of both plates (at least {MIN_LINES} are "
            "needed, 16 or more are good): move the frame so that the plates' images overlap"
        )
    try:
        return meeting_point(from_mm, to_mm - from_mm).point_mm
    except ReconstructionRefusedError as refused:
        raise CalibrationRefusedError(f"no focal point: {refused}") from refused


def focal_point_response(
    from_mm: np.ndarray, to_mm: np.ndarray, focal_point_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (N, 3, 3) of `focal_point` by `from_mm` and by `to_mm`, to first order in the distances.

    A line through A and B passes F at A + t (B - A); displacements a of A and b of B move it there by (1 - t) a + t b,
    of which only the component perpendicular to the line counts.
    """
    along = to_mm - from_mm
    length2 = np.einsum("ni,ni->n", along, along)
    across = np.eye(3) - along[:, :, None] * along[:, None, :] / length2[:, None, None]
    t = np.einsum("ni,ni->n", focal_point_mm - from_mm, along) / length2
    gain = np.linalg.solve(across.sum(axis=0), across)
    return (1 - t)[:, None, None] * gain, t[:, None, None] * gain
