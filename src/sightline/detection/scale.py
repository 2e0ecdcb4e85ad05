"""Conversions for images with very fine pixels, whose beads are measured in the 2 x 2 binned image."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sightline.common.fitting import quantiles
from sightline.detection.beads.bead import centres
from sightline.detection.results import Detections, Observations, RejectedCandidate

FACTOR = 2
_USUAL_RADIUS_PX = 14.0  # largest median of the beads; datum balls, 5/3 as large, then have 24 px [ours]
# Where some are larger than this, they are binned too, unless the smallest tenth would become hard to fit. Fits of
# discs above 23 px do not always converge [twin].
_LARGE_PX, _SMALL_PX = 22.0, 6.0  # [ours]
# Spots with less than this share of the strong spots' contrast are texture or noise: 0.2-0.35 at low dose on pixels
# of 0.1 mm, beads 0.5 and more [twin]. A few strong or large spots may be metal or anatomy.
_FAINT, _SOME = 0.45, 5
_EXACT = 2.0**32  # steps per px: with this rounding, coordinates are bit-identical in both scales


def is_fine(radius_px: np.ndarray, contrast: np.ndarray) -> bool:
    """Return whether spots of these radii and contrasts (N,) are so large that the image should be binned."""
    if len(radius_px) == 0:
        return False
    strength = np.abs(contrast)
    strong = np.sort(radius_px[strength >= _FAINT * np.sort(strength)[-_SOME:][0]])
    small, usual = quantiles(strong, (0.1, 0.5))
    return bool(usual > _USUAL_RADIUS_PX or (strong[-_SOME:][0] > _LARGE_PX and small > _SMALL_PX))


def finer(beads: Detections, image_shape: tuple[int, int]) -> Detections:
    """Convert beads of the binned image to the image itself."""
    return replace(
        beads,
        uv_px=_finer_uv(beads.uv_px),
        radius_px=beads.radius_px * FACTOR,
        covariance_px2=beads.covariance_px2 * FACTOR**2,
        image_shape=image_shape,
        rejected=_scaled(beads.rejected, _finer_uv, FACTOR),
        shadows=_scaled_shadows(beads.shadows, _finer_uv, FACTOR),
    )


def coarser(beads: Detections) -> Detections:
    """Convert beads of an image to the binned image."""
    return replace(
        beads,
        uv_px=_coarser_uv(beads.uv_px),
        radius_px=beads.radius_px / FACTOR,
        covariance_px2=beads.covariance_px2 / FACTOR**2,
        image_shape=(beads.image_shape[0] // FACTOR, beads.image_shape[1] // FACTOR),
        shadows=_scaled_shadows(beads.shadows, _coarser_uv, 1 / FACTOR),
    )


def finer_observations(seen: Observations, image_shape: tuple[int, int] | None) -> Observations:
    """Convert observations in the binned image to the image itself."""
    covariance = None if seen.covariance_px2 is None else seen.covariance_px2 * FACTOR**2
    return replace(
        seen,
        uv_px=_finer_uv(seen.uv_px),
        covariance_px2=covariance,
        image_shape=image_shape,
        radius_px=None if seen.radius_px is None else seen.radius_px * FACTOR,
        rejected=None if seen.rejected is None else _scaled(seen.rejected, _finer_uv, FACTOR),
    )


def coarser_observations(seen: Observations) -> Observations:
    """Convert observations in an image to the binned image."""
    covariance = None if seen.covariance_px2 is None else seen.covariance_px2 / FACTOR**2
    return replace(
        seen,
        uv_px=_coarser_uv(seen.uv_px),
        covariance_px2=covariance,
        radius_px=None if seen.radius_px is None else seen.radius_px / FACTOR,
        rejected=None if seen.rejected is None else _scaled(seen.rejected, _coarser_uv, 1 / FACTOR),
    )


def _scaled_shadows(
    shadows: np.ndarray | None, to_other: Callable[[np.ndarray], np.ndarray], factor: float
) -> np.ndarray | None:
    if shadows is None:
        return None
    scaled = shadows.copy()
    scaled["u_px"], scaled["v_px"] = to_other(centres(shadows)).T
    scaled["blur_px"] *= factor
    return scaled


def _scaled(
    rejected: tuple[RejectedCandidate, ...], to_other: Callable[[np.ndarray], np.ndarray], factor: float
) -> tuple[RejectedCandidate, ...]:
    return tuple(
        replace(one, uv_px=tuple(to_other(np.array(one.uv_px)).tolist()), radius_px=one.radius_px * factor)
        for one in rejected
    )


def _finer_uv(uv_px: np.ndarray) -> np.ndarray:
    """Convert coordinates: pixel (0, 0) of the binned image is centred between pixels 0 and 1 of the image."""
    return (np.rint(uv_px * _EXACT) / _EXACT + 0.5) * FACTOR - 0.5


def _coarser_uv(uv_px: np.ndarray) -> np.ndarray:
    return (uv_px + 0.5) / FACTOR - 0.5
