"""The error of a registration: from what is left in the images, and from the views' calibration."""

from collections.abc import Sequence

import numpy as np

from sightline.calibration import CalibratedView, LinesOfSight
from sightline.common.geometry.covariance import joined
from sightline.common.geometry.rigid import displacement
from sightline.from_images.registration.align import Differences
from sightline.from_images.registration.similarity import block_sums

# Residuals next to each other are alike: their windows overlap, and an edge that the model lacks runs through many.
# Blocks of 4 to 36 pixels state the same s.d. to a tenth. They count as independent, yet edges on both sides of a bone
# are off alike, and cancel: _SHARE of the variance is left; 0.36 to 0.40 made chi-squares of poses what they should be
# [gVirtualXray: 77 development scenes].
_BLOCK_PX, _SHARE = 16, 0.5


def of_images(views: Sequence[Differences]) -> np.ndarray:
    """Return the covariance (6, 6) of rotation vector and shift, mm, that the residuals of views show.

    Sandwich estimator: what blocks of pixels pull, over the curvature of the loss. The latter counts residuals beyond
    the loss's inflection as negative. Of few blocks the pulls are shrunk towards a multiple of the information, since
    six numbers are estimated from them.
    """
    curvature, information, pulls, count = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6)), 0
    for view in views:
        first, second = view.loss_by_residual
        each = view.by_pose.reshape(-1, 6)
        curvature += each.T @ (each * second.reshape(-1, 1))
        information += each.T @ (each * first.reshape(-1, 1))
        sums = block_sums(view.by_pose * (first * view.residual)[:, :, None], _BLOCK_PX)
        pulls += sums.T @ sums
        count += np.count_nonzero(sums.any(axis=1))
    alike = np.trace(np.linalg.pinv(information) @ pulls) / 6 * information
    pulls += 6 / (count + 6) * (alike - pulls)
    response = np.linalg.pinv(curvature)
    return _SHARE * response @ pulls @ response.T


def of_calibration(views: Sequence[CalibratedView], centre_mm: np.ndarray, spread_mm: np.ndarray) -> np.ndarray | None:
    """Return the covariance (6, 6), in the same order, that the views' errors cause; None where one is unknown.

    `centre_mm` (3,), `spread_mm` (3, 3): the bone's centre, and as rows its principal axes, a standard deviation long,
    CFCS. The pose follows six points of this spread, each of which stays as near as it can to its lines of sight.
    """
    points = centre_mm + 3**0.5 * np.concatenate([spread_mm, -spread_mm])
    lines, designs, responses = [], [], []
    for view in views:
        uv, seen = view.project_seen(points)
        lines.append(view.lines_of_sight(uv))
        design, response = _followed(lines[-1], points[seen], centre_mm)
        designs.append(design)
        responses.append(response)
    own = [each.total_covariance for each in lines]
    if any(covariance is None for covariance in own):
        return None
    whole = joined([c for c in own if c is not None], lambda i, j: _shared(lines[i], lines[j]))
    gain = np.linalg.pinv(np.concatenate(designs))
    ends = np.cumsum([0, *(len(design) for design in designs)])
    by_error = np.concatenate(
        [gain[:, a:b] @ response for a, b, response in zip(ends, ends[1:], responses, strict=False)], axis=1
    )
    return by_error @ whole @ by_error.T


def _followed(lines: LinesOfSight, points_mm: np.ndarray, centre_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of points (N, 3) from their lines by the pose (3N, 6), and by the errors of the lines
    (3N, 3 + 2N)."""
    focal, count = lines.focal_point_mm, len(points_mm)
    share = np.linalg.norm(points_mm - focal, axis=1) / np.linalg.norm(lines.points_mm - focal, axis=1)
    across = np.eye(3) - lines.directions[:, :, None] * lines.directions[:, None]
    design = (across @ displacement(points_mm - centre_mm)).reshape(-1, 6)
    response = np.zeros((count, 3, 3 + 2 * count))
    response[:, :, :3] = (1 - share)[:, None, None] * across
    for i in range(count):
        response[i, :, 3 + 2 * i : 5 + 2 * i] = share[i] * across[i] @ lines.plane.axes.T
    return design, response.reshape(3 * count, -1)


def _shared(first: LinesOfSight, second: LinesOfSight) -> np.ndarray:
    """Return the covariance of the errors of two views' lines, by what they share."""
    covariance = np.zeros((3 + 2 * len(first.xy_mm), 3 + 2 * len(second.xy_mm)))
    for source in first.sources_shared_with(second):
        covariance += first.shared[source] @ second.shared[source].T
    return covariance
