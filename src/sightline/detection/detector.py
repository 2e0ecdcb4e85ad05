"""Automatic detection: candidates, fits, and the reasons to reject a candidate."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from sightline.common.fitting import distances, median
from sightline.common.threads import at_once, one_blas_thread
from sightline.detection.beads import refine
from sightline.detection.beads.bead import (
    SHADOW,
    BeadStatus,
    allow_for_missing_foot,
    centre_covariances,
    centres,
    clipped_shares,
)
from sightline.detection.beads.candidates import distinct, find_candidates
from sightline.detection.beads.noise import MIN_FIELD_PX, NoiseModel, estimate_noise
from sightline.detection.causes import SpotFault, cause_of
from sightline.detection.log_image import field_and_logs, in_discs
from sightline.detection.results import FACTOR, Detections, RejectedCandidate, finer, is_fine
from sightline.errors import DetectionRefusedError
from sightline.imaging import Radiograph, as_radiograph
from sightline.imaging.defects import interlaced

_MIN_RADIUS_PX, _MAX_RADIUS_PX = 1.7, 27.0  # the promised 2-25 px, and a margin for the fit
MAX_SD_PX = 1.0  # of a bead or a piece of wire: an ordinary click is as certain [physics.md, Picks]
_MIN_CONTRAST_SD = 3.5  # contrast over its s.d.: 1 in 4000 by chance, of candidates that have 4.5 already [calc]
# Largest residual beyond noise over contrast (beads 0.05, rarely 0.11, also on bone edges; anatomy and metal more), and
# smallest contrast of the weakest eighth over that of the whole (beads 0.8 and more, 0.63 at low dose) [twin, ARCADIS].
# _LOOSE holds while spots that are not beads still take part in the fits, _STRICT afterwards.
_STRICT = 0.12, 0.6
_LOOSE = 0.25, 0.2
_WINDOW_PX = 8.0  # beyond both radii: a spot farther away does not influence a bead's fit
_MAX_BLUR = 0.45  # over the radius, of a shape with a rim [ARCADIS: 0.1-0.3; anatomy 0.5-1]
# Limits relative to the other beads of the image, used where there are enough to define what is usual.
_ENOUGH_TO_COMPARE = 8
_BLURRED = 1.5  # times the usual blur: one detector, one blur; beads up to 1.33 at low dose, 1.14 else [twin]
_SMALL = 0.55  # of the usual radius: beads 0.62 and more, grains beside the beads 0.45 and less [twin, ARCADIS]
# Of the usual contrast: one bead in a thousand has less, on dense bone at low dose [twin]. Round textures of bone have
# 0.14 and more [twin], 0.08 in images of hips [measured].
_FAINT = 0.25
_MINORITY = 0.33  # of the beads: no frame has both balls and holes
_COVERED = 0.35  # share of a bead under a burnt-in annotation; more leaves too little rim for a fit [twin]
_WASHER_RIM = 0.68  # of a washer's radius: pixels further in are left out; its hole reaches 0.45-0.55 [DIN 125]

_NOT_ROUND = "not round: some side does not differ from the middle, as on an edge, a wire or a bone contour"
_LARGE_BEADS = (
    "its round spots are too large for an image of so few pixels: show more of the field, or move the frame away from "
    "the X-ray source"
)
_NO_BEADS = (
    "check that this is the image of a frame with beads of a radius from 2 px to a fifteenth of the image's width, "
    "exposed so that they differ from their surroundings"
)
_FIT_REASONS = {
    BeadStatus.TOO_FEW_PIXELS: "too few usable pixels: at the edge of the field, or covered by another bead",
    BeadStatus.WANDERED: SpotFault.NO_DISC,
    BeadStatus.SINGULAR: "no disc at this place: the fit found none",
}


@one_blas_thread
def detect(image: Radiograph | np.ndarray | str | Path, white: float | None = None) -> Detections:
    """Return the beads of one image (dark balls and washers, bright holes) with their covariances.

    `image`: a Radiograph, a file, or an array (H, W), brighter where more X-rays arrived. `white`: the largest value
    that an array's source can store; by default its type's (see `as_radiograph`).
    `rejected` holds candidates that resemble beads; extrema without a rim are dropped without a report.
    Beads have a radius from 2 px to a fifteenth of the image's width. Where they are larger than the 25 px that a fit
    can measure, the image is binned 2 x 2 until they are not; the result is in the image's own pixels.
    Raises DetectionRefusedError where nothing looks like a bead, and where something moved between the two fields of an
    interlaced image; and the errors of `as_radiograph`.

    >>> beads = sl.detect("out/demo/demo_pa.dcm")
    >>> beads.uv_px.shape == (len(beads), 2)
    True
    """
    image = as_radiograph(image, white)
    mask, logs = field_and_logs(image)
    noise, defect = at_once(lambda: estimate_noise(logs, mask), lambda: interlaced(image))
    if defect is not None:
        raise DetectionRefusedError(defect)
    return replace(_detected(image, mask, logs, _known(noise, image, mask)), pixels=image.pixels)


def _detected(image: Radiograph, mask: np.ndarray, logs: np.ndarray, noise: NoiseModel) -> Detections:
    """`detect` without the check for interlacing."""
    spots = find_candidates(logs, mask, noise)
    fine = is_fine(*spots.sizes.T)
    if fine and np.count_nonzero(mask) > MIN_FIELD_PX * FACTOR**2:
        binned = image.binned(FACTOR)
        return finer(_detected(binned, *_prepared(binned)), image.shape)
    rows = refine.start(spots.uv_px, spots.radius_px, spots.response)
    rejected = _rejected(rows[~spots.round], np.full(np.count_nonzero(~spots.round), _NOT_ROUND))
    usable = without_middles(mask, spots.uv_px[spots.washer], spots.radius_px[spots.washer])
    fit = refine.BeadFitter(logs, usable, noise)
    beads, unfit = _fitted(rows[spots.round], fit)
    rejected += unfit
    washer = _at_centres(mask, beads) & ~_at_centres(usable, beads)  # in the middle of one
    reason = _outlier_reasons(beads, washer)
    if image.burnt_in is not None:
        reason[_covered(beads, image.burnt_in) > _COVERED] = "covered by a burnt-in annotation"
    rejected += _rejected(beads[reason != ""], reason[reason != ""])
    beads, washer = beads[reason == ""], washer[reason == ""]
    allow_for_missing_foot(beads, clipped_shares(image, usable, beads))
    if len(beads) == 0:
        why = _LARGE_BEADS if fine else cause_of(image, _discs(beads), rejected) or _NO_BEADS
        raise DetectionRefusedError(f"no bead was found ({len(rejected)} candidates were rejected); {why}")
    return _detections(beads, washer, image, rejected)


def bead_fitter(image: Radiograph, beads: Detections) -> refine.BeadFitter:
    """Return the fitter for more beads of an image. Raises DetectionRefusedError."""
    mask, logs, noise = _prepared(image)
    washer = np.array([kind == "washer" for kind in beads.kind], dtype=bool)
    return refine.BeadFitter(logs, without_middles(mask, beads.uv_px[washer], beads.radius_px[washer]), noise)


def _prepared(image: Radiograph) -> tuple[np.ndarray, np.ndarray, NoiseModel]:
    """Return the mask of the field, the log image and its noise. Raises DetectionRefusedError."""
    mask, logs = field_and_logs(image)
    return mask, logs, _known(estimate_noise(logs, mask), image, mask)


def _known(noise: NoiseModel | None, image: Radiograph, mask: np.ndarray) -> NoiseModel:
    """Return the noise. Raises DetectionRefusedError where none could be measured."""
    if noise is None:
        raise DetectionRefusedError(_no_noise(image, mask))
    return noise


def _no_noise(image: Radiograph, mask: np.ndarray) -> str:
    """Return why no noise can be measured: the field is too small, or too much of it is constant."""
    if np.count_nonzero(mask) < MIN_FIELD_PX:
        return f"the field of view has fewer than {MIN_FIELD_PX} px, too few to measure its noise; give a larger image"
    why = cause_of(image, np.zeros((0, 3)), ())
    if why is not None:
        return why
    levels = len(np.unique(image.pixels[mask]))
    return (
        f"the image's noise cannot be measured: most of its field is constant ({levels} grey levels in all); "
        "export the image as the C-arm stores it, neither windowed nor compressed"
    )


def _fitted(rows: np.ndarray, fit: refine.BeadFitter) -> tuple[np.ndarray, tuple[RejectedCandidate, ...]]:
    """Return the beads among the spots `rows` and the rejected ones; beads near rejected spots are fitted again."""
    first = fit(rows)
    reason = _shape_reasons(first, _LOOSE)
    likely = np.flatnonzero(reason == "")
    reason[likely[_duplicates(first[likely])]] = "lies on a stronger bead"
    rejected = _rejected(first[reason != ""], reason[reason != ""])
    beads, gone = first[reason == ""], rows[reason != ""]
    apart = distances(centres(beads), centres(gone))
    near = apart < beads["radius_px"][:, None] + gone["radius_px"] + _WINDOW_PX
    again = np.flatnonzero(near.any(axis=1))
    beads[again] = fit(beads, again)
    reason = fine_reasons(beads)
    return beads[reason == ""], rejected + _rejected(beads[reason != ""], reason[reason != ""])


def without_middles(mask: np.ndarray, uv_px: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """Return the mask without the middles of washers, whose outer rims are fitted as if they were balls."""
    if len(uv_px) == 0:
        return mask
    return mask & ~in_discs(mask.shape, np.column_stack([uv_px, _WASHER_RIM * radius_px]))


def _shape_reasons(fit: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Return why each fit is not a bead, judged on its own; empty where it may be one."""
    reason = np.full(len(fit), "", dtype=object)
    size = fit["radius_px"]
    excess, weakest = limits
    reason[fit["excess"] > excess] = "not a disc: the fit's residual is too large for its contrast"
    reason[fit["weakest"] < weakest] = _NOT_ROUND
    reason[fit["blur_px"] > _MAX_BLUR * size + 0.1] = SpotFault.NO_RIM
    reason[size < _MIN_RADIUS_PX] = SpotFault.TOO_SMALL
    reason[size > _MAX_RADIUS_PX] = "much larger than most beads"
    for status, why in _FIT_REASONS.items():
        reason[fit["status"] == status] = why
    return reason


def fine_reasons(fit: np.ndarray) -> np.ndarray:
    """Return `_shape_reasons` and the reasons that need the covariance."""
    reason = _shape_reasons(fit, _STRICT)
    reason[np.maximum(fit["uu_px2"], fit["vv_px2"]) > MAX_SD_PX**2] = "its centre is too uncertain"
    reason[np.abs(fit["contrast"]) < _MIN_CONTRAST_SD * np.sqrt(np.abs(fit["contrast_variance"]))] = "lost in noise"
    for status, why in _FIT_REASONS.items():
        reason[fit["status"] == status] = why
    return reason


def _outlier_reasons(beads: np.ndarray, washer: np.ndarray) -> np.ndarray:
    """Return why a bead differs from the others of its image; empty where it does not.

    `washer` (N,) bool: washers are thin, and therefore fainter than balls.
    """
    reason = np.full(len(beads), "", dtype=object)
    dark = beads["contrast"] < 0
    strength = np.abs(beads["contrast"]) * beads["radius_px"]
    few = dark if 2 * strength[dark].sum() < strength.sum() else ~dark
    if np.count_nonzero(few) < _MINORITY * len(beads):
        reason[few] = "dark among bright beads, or bright among dark ones"
    usual = reason == ""
    if np.count_nonzero(usual) >= _ENOUGH_TO_COMPARE:
        reason[usual & (beads["blur_px"] > _BLURRED * median(beads["blur_px"][usual]))] = (
            "its rim is softer than those of the other beads"
        )
        reason[usual & (beads["radius_px"] < _SMALL * median(beads["radius_px"][usual]))] = (
            "much smaller than the other beads"
        )
        contrast = np.abs(beads["contrast"])
        if (solid := usual & ~washer).any():
            reason[solid & (contrast < _FAINT * median(contrast[solid]))] = "much fainter than the other beads"
    return reason


def _at_centres(mask: np.ndarray, beads: np.ndarray) -> np.ndarray:
    """Return (N,) bool: whether a mask (H, W) is true at each bead's centre."""
    u, v = np.clip(np.rint(centres(beads)).astype(int), 0, np.array(mask.shape[::-1]) - 1).T
    return mask[v, u]


def _covered(beads: np.ndarray, written: np.ndarray) -> np.ndarray:
    """Return the share (N,) of each bead's disc, with its rim, that lies under the mask `written` (H, W)."""
    shares = np.zeros(len(beads))
    for i, (u, v, radius) in enumerate(_discs(beads)):
        disc = np.zeros(written.shape, np.uint8)
        cv2.circle(disc, (round(u), round(v)), round(radius) + 1, 1, -1)
        shares[i] = written[disc > 0].mean()
    return shares


def _duplicates(fit: np.ndarray) -> np.ndarray:
    """Return (N,) bool: fits that share a place with a fit that explains more of the image."""
    strength = np.abs(fit["contrast"]) * fit["radius_px"] / (0.05 + fit["excess"])
    order = np.argsort(-strength, kind="stable")
    repeated = np.empty(len(fit), bool)
    repeated[order] = ~distinct(fit[order])
    return repeated


def _rejected(rows: np.ndarray, reasons: np.ndarray) -> tuple[RejectedCandidate, ...]:
    """Return beads with the reasons for which they are rejected."""
    discs = _discs(rows).tolist()
    return tuple(
        RejectedCandidate((u, v), radius, str(why)) for (u, v, radius), why in zip(discs, reasons, strict=True)
    )


def _discs(beads: np.ndarray) -> np.ndarray:
    """Return u, v and radius (N, 3), px."""
    return np.stack([beads["u_px"], beads["v_px"], beads["radius_px"]], axis=1)


def _detections(
    beads: np.ndarray, washer: np.ndarray, image: Radiograph, rejected: tuple[RejectedCandidate, ...]
) -> Detections:
    """Return beads as Detections. `washer` (N,) bool: which of them are washers."""
    return Detections(
        uv_px=centres(beads),
        radius_px=beads["radius_px"],
        covariance_px2=centre_covariances(beads),
        kind=tuple(np.where(washer, "washer", np.where(beads["contrast"] < 0, "ball", "hole")).tolist()),
        contrast=beads["contrast"],
        image_shape=image.shape,
        rejected=rejected,
        shadows=beads[SHADOW],
    )
