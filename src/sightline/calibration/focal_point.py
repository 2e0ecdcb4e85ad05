"""The effective focal point: least-squares meeting point of lines (paper, section 4.3, figure 11)."""

import numpy as np

from sightline.errors import CalibrationRefusedError

# The paper used 16 to 25 lines. Four leave five numbers to test three by [ours].
FEWEST_LINES = 4
# Below this the lines are as good as parallel: their meeting point is not determined [ours].
SMALLEST_SPREAD_RAD = 5e-3


def meeting_point(from_mm: np.ndarray, to_mm: np.ndarray) -> np.ndarray:
    """(3,) the point with the least sum of squared distances from lines through `from_mm` (N, 3) and `to_mm` (N, 3).

    Raises CalibrationRefusedError on too few lines or parallel ones.
    """
    if len(from_mm) < FEWEST_LINES:
        raise CalibrationRefusedError(
            f"only {len(from_mm)} lines of sight can be made through the beads of both plates; at least "
            f"{FEWEST_LINES} are needed, 16 or more are good: see that the plates' images overlap"
        )
    across, direction = _across(from_mm, to_mm)
    spread = np.linalg.svd(direction - direction.mean(axis=0), compute_uv=False)[0] / np.sqrt(len(direction))
    if spread < SMALLEST_SPREAD_RAD:
        raise CalibrationRefusedError(
            f"the lines of sight through the beads are nearly parallel ({spread:.4f} rad); use beads farther apart"
        )
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, from_mm))


def meeting_point_response(
    from_mm: np.ndarray, to_mm: np.ndarray, focal_point_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (N, 3, 3) of the meeting point by `from_mm` and by `to_mm`, to first order in the lines' misses.

    A line through A and B passes F at A + t (B - A); where A moves by a and B by b it moves there by
    (1 - t) a + t b, of which only the part across the line counts.
    """
    across, direction = _across(from_mm, to_mm)
    length = np.linalg.norm(to_mm - from_mm, axis=1)
    t = np.einsum("ni,ni->n", focal_point_mm - from_mm, direction) / length
    pull = np.linalg.solve(across.sum(axis=0), across)
    return (1 - t)[:, None, None] * pull, t[:, None, None] * pull


def _across(from_mm: np.ndarray, to_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projectors (N, 3, 3) across the lines, and their directions (N, 3)."""
    direction = to_mm - from_mm
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return np.eye(3) - direction[:, :, None] * direction[:, None, :], direction
