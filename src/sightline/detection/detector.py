"""Automatic detection: candidates, fits, and the reasons for which a candidate is no bead."""

import cv2
import numpy as np

from sightline.detection import refine
from sightline.detection.find import find_candidates
from sightline.detection.noise import NoiseModel, estimate_noise
from sightline.detection.results import Detections, Rejected
from sightline.errors import DetectionRefusedError
from sightline.imaging import Radiograph

_SMALLEST_PX, _LARGEST_PX = 1.7, 27.0  # what is promised, 2-25 px, and a margin for the fit
_NOISIEST_PX = 0.75  # a centre less certain than this is of no use; promised is recall below 0.5 px [ours]
_FAINTEST_SD = 5.0  # contrast over its standard deviation: no false bead from noise in 1024² px [calc]
_MISFIT = 0.08  # residual beyond noise over contrast; beads keep 0.02-0.05 on bone, anatomy 0.1 and more [ARCADIS]
_WEAKEST = 0.7  # contrast of the weakest eighth over that of the whole [ARCADIS: 0.90 and more on beads]
_SOFTEST = 0.45  # blur over radius of a shape with a rim [ARCADIS: 0.1-0.3; anatomy 0.5-1]

_NOT_ROUND = "not round: some side does not differ from the middle, as on an edge, a wire or a bone contour"
_FIT_REASONS = {
    refine.TOO_FEW_PIXELS: "too few usable pixels: at the edge of the field, or covered by another bead",
    refine.WANDERED: "no disc at this place: the fit moved away",
    refine.SINGULAR: "no disc at this place: the fit found none",
}


def detect(image: Radiograph) -> Detections:
    """Beads (dark balls and washers, bright holes; radius 2-25 px) of one image, with their covariances.

    Raises DetectionRefusedError where nothing in the image looks like a bead.
    """
    mask = np.ascontiguousarray(image.field_mask)
    log_image = _log_image(image)
    noise = estimate_noise(log_image, mask)
    if noise is None:
        raise DetectionRefusedError(
            "the image has no area of 16x16 px inside its field of view to measure noise in; give a larger image"
        )
    spots = find_candidates(_filled(log_image, mask), _broad_noise(noise, log_image, mask))
    inside = mask[spots.uv_px[:, 1].astype(int), spots.uv_px[:, 0].astype(int)]
    rejected = _rejections(spots.uv_px, spots.radius_px, _NOT_ROUND, ~spots.round & inside & (spots.response < -0.02))
    taken = spots.round & inside
    rows = np.column_stack([spots.uv_px, spots.radius_px, spots.response])[taken]
    coarse = refine.fit_coarsely(log_image, mask, rows, np.empty((0, 3)), noise)
    reason = _coarse_reasons(coarse, noise)
    beads, repeated = _apart(coarse[reason == ""])
    rejected += _rejected(coarse[reason != ""], reason[reason != ""]) + repeated
    fine = refine.fit_finely(log_image, mask, beads, beads[:, : refine.CONTRAST], noise)
    reason = _fine_reasons(fine)
    rejected += _rejected(fine[reason != ""], reason[reason != ""])
    beads = fine[reason == ""]
    if len(beads) == 0:
        raise DetectionRefusedError(
            f"no bead was found ({len(rejected)} candidates were rejected); check that this is the image of a frame "
            "with beads of 2-25 px radius, exposed so that they differ from their surroundings"
        )
    return _detections(beads, image, rejected)


def _log_image(image: Radiograph) -> np.ndarray:
    """Natural logarithm of the pixels; zero counts as half a grey level."""
    pixels = image.pixels
    if pixels.dtype == np.float32:
        floor = max(float(image.white) * 2.0**-16, 1e-30)
        return np.log(np.maximum(pixels, floor))
    table = np.log(np.maximum(np.arange(np.iinfo(pixels.dtype).max + 1), 0.5)).astype(np.float32)
    return table[pixels]


def _filled(log_image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image with what lies outside its field taken from the nearest level of a masked pyramid."""
    height, width = mask.shape
    values: list[np.ndarray] = [np.where(mask, log_image, np.float32(0))]
    weights: list[np.ndarray] = [mask.astype(np.float32)]
    while min(values[-1].shape) > 2:
        shape = (max(values[-1].shape[1] // 2, 1), max(values[-1].shape[0] // 2, 1))
        values.append(cv2.resize(values[-1], shape, interpolation=cv2.INTER_AREA))
        weights.append(cv2.resize(weights[-1], shape, interpolation=cv2.INTER_AREA))
    filled = values[-1] / np.maximum(weights[-1], 1e-6)
    for value, w in zip(values[-2::-1], weights[-2::-1], strict=True):
        coarse = cv2.resize(filled, value.shape[::-1], interpolation=cv2.INTER_LINEAR)
        filled = np.where(w > 0.01, value / np.maximum(w, 0.01), coarse)
    return filled[:height, :width]


def _broad_noise(noise: NoiseModel, log_image: np.ndarray, mask: np.ndarray) -> float:
    """Noise of a broad mean: root of (variance times the sum of the two-dimensional correlation)."""
    typical = float(np.median(log_image[::8, ::8][mask[::8, ::8]]))
    return float(np.sqrt(noise.variance(typical))) * float(1 + 2 * noise.correlation[1:].sum())


def _coarse_reasons(fit: np.ndarray, noise: NoiseModel) -> np.ndarray:
    reason = np.full(len(fit), "", dtype=object)
    contrast = np.maximum(np.abs(fit[:, refine.CONTRAST]), 1e-9)
    excess = np.sqrt(np.maximum(fit[:, refine.MISFIT] ** 2 - 1.3 * fit[:, refine.NOISE], 0)) / contrast
    size = fit[:, refine.RADIUS]
    reason[excess > _MISFIT] = "not a disc: what remains after the fit is too large beside its contrast"
    reason[fit[:, refine.WEAKEST] < _WEAKEST] = _NOT_ROUND
    reason[fit[:, refine.BLUR] > _SOFTEST * size] = "no rim: it fades out like anatomy, not like a bead"
    reason[(size < _SMALLEST_PX) | (size > _LARGEST_PX)] = "its radius is not within 2-25 px"
    for status, why in _FIT_REASONS.items():
        reason[fit[:, refine.STATUS] == status] = why
    return reason


def _fine_reasons(fit: np.ndarray) -> np.ndarray:
    reason = np.full(len(fit), "", dtype=object)
    reason[np.maximum(fit[:, refine.CUU], fit[:, refine.CVV]) > _NOISIEST_PX**2] = "its centre is too uncertain"
    reason[np.abs(fit[:, refine.CONTRAST]) < _FAINTEST_SD * np.sqrt(np.abs(fit[:, refine.CCC]))] = "lost in noise"
    for status, why in _FIT_REASONS.items():
        reason[fit[:, refine.STATUS] == status] = why
    return reason


def _apart(fit: np.ndarray) -> tuple[np.ndarray, tuple[Rejected, ...]]:
    """Of fits that share a place the one with the smallest misfit."""
    order = np.argsort(fit[:, refine.MISFIT] / np.abs(fit[:, refine.CONTRAST]))
    fit = fit[order]
    keep = np.ones(len(fit), bool)
    for i in range(1, len(fit)):
        near = keep[:i] & (np.hypot(*(fit[:i, :2] - fit[i, :2]).T) < np.maximum(fit[:i, 2], fit[i, 2]))
        keep[i] = not near.any()
    why = np.full(np.count_nonzero(~keep), "the same bead was found with a better fit", dtype=object)
    return fit[keep], _rejected(fit[~keep], why)


def _rejections(uv_px: np.ndarray, radius_px: np.ndarray, why: str, which: np.ndarray) -> tuple[Rejected, ...]:
    rows = np.column_stack([uv_px, radius_px])[which].tolist()
    return tuple(Rejected((u, v), radius, why) for u, v, radius in rows)


def _rejected(fit: np.ndarray, reasons: np.ndarray) -> tuple[Rejected, ...]:
    return tuple(Rejected((u, v), r, why) for (u, v, r), why in zip(fit[:, :3].tolist(), reasons, strict=True))


def _detections(beads: np.ndarray, image: Radiograph, rejected: tuple[Rejected, ...]) -> Detections:
    cuu, cuv, cvv = (beads[:, c] for c in (refine.CUU, refine.CUV, refine.CVV))
    return Detections(
        uv_px=beads[:, :2],
        radius_px=beads[:, refine.RADIUS],
        covariance_px2=np.stack([cuu, cuv, cuv, cvv], axis=-1).reshape(-1, 2, 2),
        kind=tuple("ball" if c < 0 else "hole" for c in beads[:, refine.CONTRAST]),
        contrast=beads[:, refine.CONTRAST],
        image_shape=image.shape,
        rejected=rejected,
    )
