"""The effective focal point: least-squares meeting point of lines (paper, section 4.3, figure 11)."""

import numpy as np

from sightline.errors import CalibrationRefusedError, ReconstructionRefusedError
from sightline.geometry.lines import meeting_point

# The paper used 16 to 25 lines. Four leave five numbers to test three by [ours].
MIN_LINES = 4


def focal_point(from_mm: np.ndarray, to_mm: np.ndarray) -> np.ndarray:
    """(3,) where lines through `from_mm` (N, 3) and `to_mm` (N, 3) meet best.

    Raises CalibrationRefusedError on too few lines or parallel ones.
    """
    if len(from_mm) < MIN_LINES:
        raise CalibrationRefusedError(
            f"only {len(from_mm)} lines of sight can be made through the beads of both plates; at least "
            f"{MIN_LINES} are needed, 16 or more are good: see that the plates' images overlap"
        )
    try:
        return meeting_point(from_mm, to_mm - from_mm).point_mm
    except ReconstructionRefusedError as refused:
        raise CalibrationRefusedError(f"no focal point: {refused}") from refused


def focal_point_response(
    from_mm: np.ndarray, to_mm: np.ndarray, focal_point_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (N, 3, 3) of `focal_point` by `from_mm` and by `to_mm`, to first order in the lines' misses.

    A line through A and B passes F at A + t (B - A); where A moves by a and B by b it moves there by
    (1 - t) a + t b, of which only the part across the line counts.
    """
    way = to_mm - from_mm
    length2 = np.einsum("ni,ni->n", way, way)
    across = np.eye(3) - way[:, :, None] * way[:, None, :] / length2[:, None, None]
    t = np.einsum("ni,ni->n", focal_point_mm - from_mm, way) / length2
    pull = np.linalg.solve(across.sum(axis=0), across)
    return (1 - t)[:, None, None] * pull, t[:, None, None] * pull
