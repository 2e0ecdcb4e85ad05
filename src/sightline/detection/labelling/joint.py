"""Both plates of a view at once: one smooth map, one focal point, and each bead predicted by all the others."""

from dataclasses import dataclass

import numpy as np

from sightline.detection.labelling.growth import Grown, features
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.results import Detections
from sightline.geometry.lines import meeting_point

# What is left beyond degree 5, as shares of half the image: 0.11-0.13 mm rms and 30-60 mm of 107 (physics.md).
REMAINDER_SD, REMAINDER_LENGTH = 0.0013, 0.4
FOCAL_STEP_MM = 500.0  # prior on the first guess of the focal point: wide [ours]


@dataclass(frozen=True, eq=False)
class Joint:
    """A fit of both plates to beads (B, 2) of detection and place; source places follow the XRII ones.

    For all detections: `xy_mm` (N, 2) on the XRII plate, predicted without the detection itself; `variance_mm2` (N,)
    of that, with its own noise. `target_mm` (P, 2): where the places lie, source ones seen from `focal_point_mm`.
    `m2` (B,): squared distance of each bead from its place in standard deviations, by all others. `bend`: the
    largest coefficient of the map, in standard deviations of its prior: how unlike an image intensifier's it is.
    """

    focal_point_mm: np.ndarray
    xy_mm: np.ndarray
    variance_mm2: np.ndarray
    target_mm: np.ndarray
    m2: np.ndarray
    bend: float


def first_focal_point(pair: tuple[Grown, Grown]) -> np.ndarray:
    """(3,) where the lines meet from the source beads through their images on the XRII plate."""
    xrii, source = pair
    seen = xrii.pattern.plane.to_space(xrii.xy_mm[source.rows])
    through = source.pattern.xyz_mm[source.places]
    return meeting_point(through, through - seen).point_mm


def _source_targets(xrii: Pattern, source: Pattern, focal_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S, 2) source fiducials projected onto the XRII plate, and (S, 2, 3) the derivative by the focal point."""
    plane = xrii.plane
    f, y = plane.height_mm(focal_mm), plane.height_mm(source.xyz_mm)
    share = y / (y - f)  # of the focal point in the projected point
    aside = plane.to_plane(focal_mm) - plane.to_plane(source.xyz_mm)
    by_height = (y / (y - f) ** 2)[:, None] * aside
    at = plane.central_projection(focal_mm, source.xyz_mm)
    return at, share[:, None, None] * plane.axes + by_height[:, :, None] * plane.normal


def fit(
    pair: tuple[Grown, Grown], beads: np.ndarray, detections: Detections, focal_mm: np.ndarray, factor: float
) -> Joint:
    """One Gauss-Newton step from `focal_mm`; `factor` scales the stated noise variance. `pair`: XRII and source.

    A Gaussian process per axis (polynomial to degree 5, and a smooth remainder); the focal point couples the axes by
    three numbers, so that its part of the inverse covariance is of rank three.
    """
    xrii, source, sheet = pair[0].pattern, pair[1].pattern, pair[0].sheet
    rows, places = beads.T
    targets, by_focal = _source_targets(xrii, source, focal_mm)
    place_mm = np.concatenate([xrii.xy_mm, targets])
    w = sheet.w(detections.uv_px)
    y = (place_mm[places] - sheet.centre_mm) / sheet.unit_mm - w[rows]
    phi = features(w)[0]
    gap = ((w[:, None] - w[None][:, rows]) ** 2).sum(axis=2)
    kernel = phi @ phi[rows].T + REMAINDER_SD**2 * np.exp(-gap / (2 * REMAINDER_LENGTH**2))
    noise = factor * sheet.noise(detections.covariance_px2)
    inverse = np.linalg.inv(kernel[rows] + np.diag(noise[rows]))

    slope = np.zeros((2, len(rows), 3))
    of_source = places >= len(xrii.ids)
    slope[:, of_source] = by_focal[places[of_source] - len(xrii.ids)].transpose(1, 0, 2)
    slope *= FOCAL_STEP_MM / sheet.unit_mm
    pull = inverse @ slope
    small = np.linalg.inv(np.eye(3) + (slope.transpose(0, 2, 1) @ pull).sum(axis=0))
    turned = pull @ small
    weights = inverse @ y - (turned @ (pull.transpose(0, 2, 1) @ y.T[:, :, None]).sum(axis=0))[:, :, 0].T
    focal = focal_mm - FOCAL_STEP_MM * (slope.transpose(0, 2, 1) @ weights.T[:, :, None]).sum(axis=0)[:, 0]

    at = w + kernel @ weights
    variance = (phi**2).sum(axis=1) + REMAINDER_SD**2 + noise - ((kernel @ inverse) * kernel).sum(axis=1)
    variance += ((kernel @ turned) * (kernel @ pull)).sum(axis=(0, 2)) / 2
    spread = np.linalg.inv(np.diag(inverse)[:, None, None] * np.eye(2) - np.einsum("anj,bnj->nab", turned, pull))
    left_out = (spread @ weights[:, :, None])[:, :, 0]
    bend = float(np.abs(phi[rows].T @ weights).max())
    place_mm = np.concatenate([xrii.xy_mm, _source_targets(xrii, source, focal)[0]])
    at = at * sheet.unit_mm + sheet.centre_mm
    at[rows] = place_mm[places] - left_out * sheet.unit_mm
    variance[rows] = np.trace(spread, axis1=1, axis2=2) / 2
    return Joint(focal, at, variance * sheet.unit_mm**2, place_mm, (left_out * weights).sum(axis=1), bend)
