"""Both plates of a view at once: one smooth map, one focal point, and each bead predicted by all the others."""

from dataclasses import dataclass

import numpy as np

from sightline.detection.labelling.growth import Grown, features
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.results import Detections

# What is left beyond degree 5, as shares of half the image: 0.11-0.13 mm rms and 30-60 mm of 107 (physics.md).
REMAINDER_SD, REMAINDER_LENGTH = 0.0013, 0.4
FOCAL_STEP_MM = 500.0  # prior on the first guess of the focal point: wide [ours]


@dataclass(frozen=True, eq=False)
class Joint:
    """A fit of both plates. `beads` (B, 2): detection, place (source places follow the XRII ones).

    For all detections: `xy_mm` (N, 2) on the XRII plate, predicted without the detection itself; `variance_mm2` (N,)
    of that, with its own noise. `target_mm` (P, 2): where the places lie, source ones seen from `focal_point_mm`.
    `m2` (B,): squared distance of each bead from its place in standard deviations, by all others.
    """

    focal_point_mm: np.ndarray
    xy_mm: np.ndarray
    variance_mm2: np.ndarray
    target_mm: np.ndarray
    m2: np.ndarray


def meeting_point(through_mm: np.ndarray, to_mm: np.ndarray) -> np.ndarray:
    """(3,) least-squares meeting point of lines through pairs of points (N, 3)."""
    d = to_mm - through_mm
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    return np.linalg.solve(across.sum(axis=0), (across @ through_mm[:, :, None]).sum(axis=0)[:, 0])


def _source_targets(xrii: Pattern, source: Pattern, focal_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S, 2) source fiducials projected onto the XRII plate, and (S, 2, 3) the derivative by the focal point."""
    plane = xrii.plane
    f, y = plane.height_mm(focal_mm), plane.height_mm(source.xyz_mm)
    share = y / (y - f)  # of the focal point in the projected point
    at = plane.to_plane(focal_mm) * share[:, None] + plane.to_plane(source.xyz_mm) * (1 - share)[:, None]
    by_height = (y / (y - f) ** 2)[:, None] * (plane.to_plane(focal_mm) - plane.to_plane(source.xyz_mm))
    return at, share[:, None, None] * plane.axes + by_height[:, :, None] * plane.normal


def fit(
    pair: tuple[Grown, Grown], beads: np.ndarray, detections: Detections, focal_mm: np.ndarray, factor: float
) -> Joint:
    """One Gauss-Newton step from `focal_mm`; `factor` scales the stated noise variance. `pair`: XRII and source."""
    xrii, source = pair[0].pattern, pair[1].pattern
    sheet = pair[0].sheet
    targets, by_focal = _source_targets(xrii, source, focal_mm)
    place_mm = np.concatenate([xrii.xy_mm, targets])
    w = sheet.w(detections.uv_px)
    rows, places = beads.T
    y = ((place_mm[places] - sheet.centre_mm) / sheet.unit_mm - w[rows]).T.ravel()
    phi = features(w)[0]
    gap = ((w[:, None] - w[None][:, rows]) ** 2).sum(axis=2)
    kernel = phi @ phi[rows].T + REMAINDER_SD**2 * np.exp(-gap / (2 * REMAINDER_LENGTH**2))
    noise = factor * sheet.noise(detections.covariance_px2)
    n = len(rows)
    slope = np.zeros((2, n, 3))
    of_source = places >= len(xrii.ids)
    slope[:, of_source] = by_focal[places[of_source] - len(xrii.ids)].transpose(1, 0, 2) / sheet.unit_mm
    slope = slope.reshape(2 * n, 3) * FOCAL_STEP_MM
    total = slope @ slope.T
    own = kernel[rows] + np.diag(noise[rows])
    total[:n, :n] += own
    total[n:, n:] += own
    inverse = np.linalg.inv(total)
    weights = inverse @ y
    focal = focal_mm - FOCAL_STEP_MM * (slope.T @ weights)
    at = w + (kernel @ weights.reshape(2, n).T)
    variance = (phi**2).sum(axis=1) + REMAINDER_SD**2 + noise
    variance -= np.einsum("ij,jk,ik->i", kernel, (inverse[:n, :n] + inverse[n:, n:]) / 2, kernel)
    i = np.arange(n)
    block = np.stack([[inverse[i, i], inverse[i, n + i]], [inverse[n + i, i], inverse[n + i, n + i]]]).transpose(
        2, 0, 1
    )
    spread = np.linalg.inv(block)
    both = weights.reshape(2, n).T
    left_out = (spread @ both[:, :, None])[:, :, 0]
    m2 = (left_out * both).sum(axis=1)
    targets, _ = _source_targets(xrii, source, focal)
    place_mm = np.concatenate([xrii.xy_mm, targets])
    at = at * sheet.unit_mm + sheet.centre_mm
    at[rows] = place_mm[places] - left_out * sheet.unit_mm
    variance[rows] = np.trace(spread, axis1=1, axis2=2) / 2
    return Joint(focal, at, variance * sheet.unit_mm**2, place_mm, m2)
