"""Automatic detection: candidates, fits, and the reasons for which a candidate is no bead."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from sightline.detection import columns, refine
from sightline.detection.causes import NO_RIM, cause_of
from sightline.detection.find import distinct, find_candidates
from sightline.detection.log_image import field_inset, log_image
from sightline.detection.noise import MIN_FIELD_PX, NoiseModel, estimate_noise
from sightline.detection.results import Detections, Rejected
from sightline.detection.scale import FACTOR, finer, is_fine
from sightline.errors import DetectionRefusedError
from sightline.imaging import Radiograph, as_radiograph
from sightline.imaging.defects import interlaced

_SMALLEST_PX, _LARGEST_PX = 1.7, 27.0  # what is promised, 2-25 px, and a margin for the fit
_NOISIEST_PX = 1.0  # a centre less certain than this is of no use; promised is recall below 0.5 px [ours]
_FAINTEST_SD = 3.5  # contrast over its standard deviation; a candidate has a step of 4.5 already [ours]
# Residual beyond noise over contrast (beads 0.05, rarely 0.11, also on bone edges; anatomy and metal more), and
# contrast of the weakest eighth over that of the whole (beads 0.8 and more, 0.63 at low dose) [twin, ARCADIS]:
# once spots that are no beads have no part in a fit any more, and before.
_STRICT = 0.12, 0.6
_LOOSE = 0.25, 0.2
_WINDOW_PX = 8.0  # beyond both radii: a spot that far away has no part in a bead's fit
_SOFTEST = 0.45  # blur over radius of a shape with a rim [ARCADIS: 0.1-0.3; anatomy 0.5-1]
# Against the other beads of the image, where there are enough of them to tell what is usual.
_ENOUGH_TO_COMPARE = 8
_BLURRED = 1.5  # times the usual blur: one detector, one blur; beads up to 1.33 at low dose, 1.14 else [twin]
_SMALL = 0.55  # of the usual radius: beads 0.62 and more, grains beside the beads 0.45 and less [twin, ARCADIS]
# Of the usual contrast: one in a thousand beads has less, on dense bone at low dose [twin]; textures of bone that pass
# for round have 0.14 and more [twin], 0.08 in images of hips [measured].
_FAINT = 0.25
_MINORITY = 0.33  # of the beads: no frame has both balls and holes
_COVERED = 0.35  # of a bead's disc under writing; what is left of its rim no longer holds centre and radius [twin]
_WASHER_RIM = 0.68  # of a washer's radius: what is further in is left out; its hole reaches to 0.45-0.55 [DIN 125]

_NOT_ROUND = "not round: some side does not differ from the middle, as on an edge, a wire or a bone contour"
_TOO_LARGE = "its radius is above 25 px"
_FIT_REASONS = {
    columns.TOO_FEW_PIXELS: "too few usable pixels: at the edge of the field, or covered by another bead",
    columns.WANDERED: "no disc at this place: the fit moved away",
    columns.SINGULAR: "no disc at this place: the fit found none",
}


def detect(image: Radiograph | np.ndarray | str | Path, white: float | None = None) -> Detections:
    """Beads (dark balls and washers, bright holes; radius 2-25 px) of one image, with their covariances.

    `image`: a Radiograph, a file, or an array (H, W), brighter where more X-rays came; `white`: the largest value that
    an array's source can store, its type's unless given (see `as_radiograph`).
    `rejected` holds what came near to being a bead; places without any rim are passed over in silence.
    Raises DetectionRefusedError where nothing in the image looks like a bead, and where something moved between the two
    fields of an interlaced image, which no centre shows; and what `as_radiograph` raises. Where most beads have a
    radius above 15 px they are measured in pixels of twice the side, as often as it takes; the answer is in the image's
    own pixels.
    """
    image = as_radiograph(image, white)
    defect = interlaced(image)
    if defect is not None:
        raise DetectionRefusedError(defect)
    return replace(_detected(image), pixels=image.pixels)


def _detected(image: Radiograph) -> Detections:
    """`detect` without the look at its two fields."""
    mask, logs, noise = _looked_at(image)
    spots = find_candidates(logs, mask, noise)
    rows = refine.start(spots.uv_px, spots.radius_px, spots.response)
    rejected = _rejected(rows[~spots.round], np.full(len(rows), _NOT_ROUND))
    usable = without_middles(mask, spots.uv_px[spots.washer], spots.radius_px[spots.washer])
    fit = refine.BeadFitter(logs, usable, noise)
    beads, unfit = _fitted(rows[spots.round], fit)
    rejected += unfit
    middles = mask & ~usable
    reason = _odd_ones(beads, _on(middles, beads))
    if image.burnt_in is not None:
        reason[_covered(beads, image.burnt_in) > _COVERED] = "covered by writing in the image"
    rejected += _rejected(beads[reason != ""], reason[reason != ""])
    beads = beads[reason == ""]
    if is_fine(np.append(beads[:, columns.RADIUS], [one.radius_px for one in rejected if one.reason == _TOO_LARGE])):
        return finer(_detected(image.binned(FACTOR)), image.shape)
    if len(beads) == 0:
        why = cause_of(image, beads[:, :3], rejected) or (
            "check that this is the image of a frame with beads of 2-25 px radius, exposed so that they differ from "
            "their surroundings"
        )
        raise DetectionRefusedError(f"no bead was found ({len(rejected)} candidates were rejected); {why}")
    return _detections(beads, middles, image, rejected)


def fit_of(image: Radiograph, beads: Detections) -> refine.BeadFitter:
    """The fit to measure more beads of an image with. Raises DetectionRefusedError."""
    mask, logs, noise = _looked_at(image)
    washer = np.array([kind == "washer" for kind in beads.kind], dtype=bool)
    return refine.BeadFitter(logs, without_middles(mask, beads.uv_px[washer], beads.radius_px[washer]), noise)


def _looked_at(image: Radiograph) -> tuple[np.ndarray, np.ndarray, NoiseModel]:
    """Which pixels are in the field, their log intensity, its noise. Raises DetectionRefusedError."""
    mask = field_inset(image)
    logs = log_image(image, mask)
    noise = estimate_noise(logs, mask)
    if noise is None:
        raise DetectionRefusedError(_no_noise(image, mask))
    return mask, logs, noise


def _no_noise(image: Radiograph, mask: np.ndarray) -> str:
    """Why there is no noise to measure: too small a field, or too little of it that is not constant."""
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


def _fitted(rows: np.ndarray, fit: refine.BeadFitter) -> tuple[np.ndarray, tuple[Rejected, ...]]:
    """Beads among the spots `rows`; those whose fit had to do with a spot that is none are fitted again."""
    first = fit(rows)
    reason = _shape_reasons(first, _LOOSE)
    likely = np.flatnonzero(reason == "")
    reason[likely[_repeats(first[likely])]] = "lies on a stronger bead"
    rejected = _rejected(first[reason != ""], reason[reason != ""])
    beads, gone = first[reason == ""], rows[reason != ""]
    apart = np.hypot(*(beads[:, None, c] - gone[None, :, c] for c in (columns.U, columns.V)))
    near = apart < beads[:, None, columns.RADIUS] + gone[None, :, columns.RADIUS] + _WINDOW_PX
    again = np.flatnonzero(near.any(axis=1))
    beads[again] = fit(beads, again)
    reason = fine_reasons(beads)
    return beads[reason == ""], rejected + _rejected(beads[reason != ""], reason[reason != ""])


def without_middles(mask: np.ndarray, uv_px: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """The mask without the middles of washers: of those the outer rim is fitted, as if they were balls."""
    middles = np.zeros(mask.shape, np.uint8)
    for (u, v), radius in zip(uv_px, radius_px, strict=True):
        cv2.circle(middles, (round(16 * u), round(16 * v)), round(16 * _WASHER_RIM * radius), 1, -1, cv2.LINE_8, 4)
    return mask & (middles == 0)


def _shape_reasons(fit: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Why each fit is no bead by itself; empty where it may be one."""
    reason = np.full(len(fit), "", dtype=object)
    size = fit[:, columns.RADIUS]
    excess, weakest = limits
    reason[fit[:, columns.EXCESS] > excess] = "not a disc: what remains after the fit is too large beside its contrast"
    reason[fit[:, columns.WEAKEST] < weakest] = _NOT_ROUND
    reason[fit[:, columns.BLUR] > _SOFTEST * size + 0.1] = f"{NO_RIM}: it fades out like anatomy, not like a bead"
    reason[size < _SMALLEST_PX] = "its radius is below 2 px"
    reason[size > _LARGEST_PX] = _TOO_LARGE
    for status, why in _FIT_REASONS.items():
        reason[fit[:, columns.STATUS] == status] = why
    return reason


def fine_reasons(fit: np.ndarray) -> np.ndarray:
    """`_shape_reasons` and those that need the covariance."""
    reason = _shape_reasons(fit, _STRICT)
    reason[np.maximum(fit[:, columns.CUU], fit[:, columns.CVV]) > _NOISIEST_PX**2] = "its centre is too uncertain"
    reason[np.abs(fit[:, columns.CONTRAST]) < _FAINTEST_SD * np.sqrt(np.abs(fit[:, columns.CCC]))] = "lost in noise"
    for status, why in _FIT_REASONS.items():
        reason[fit[:, columns.STATUS] == status] = why
    return reason


def _odd_ones(beads: np.ndarray, washer: np.ndarray) -> np.ndarray:
    """Why a bead does not belong to the others of its image; empty where it does. `washer` (N,) bool: thin, and
    therefore fainter than balls."""
    reason = np.full(len(beads), "", dtype=object)
    dark = beads[:, columns.CONTRAST] < 0
    strength = np.abs(beads[:, columns.CONTRAST]) * beads[:, columns.RADIUS]
    few = dark if 2 * strength[dark].sum() < strength.sum() else ~dark
    if np.count_nonzero(few) < _MINORITY * len(beads):
        reason[few] = "dark where the other beads are bright, or bright where they are dark"
    usual = reason == ""
    if np.count_nonzero(usual) >= _ENOUGH_TO_COMPARE:
        reason[usual & (beads[:, columns.BLUR] > _BLURRED * np.median(beads[usual, columns.BLUR]))] = (
            "its rim is softer than those of the other beads"
        )
        reason[usual & (beads[:, columns.RADIUS] < _SMALL * np.median(beads[usual, columns.RADIUS]))] = (
            "much smaller than the other beads"
        )
        contrast = np.abs(beads[:, columns.CONTRAST])
        if (solid := usual & ~washer).any():
            reason[solid & (contrast < _FAINT * np.median(contrast[solid]))] = "much fainter than the other beads"
    return reason


def _on(mask: np.ndarray, beads: np.ndarray) -> np.ndarray:
    """(N,) bool: whether a mask (H, W) is true at each bead's centre."""
    u, v = np.clip(np.rint(beads[:, :2]).astype(int), 0, np.array(mask.shape[::-1]) - 1).T
    return mask[v, u]


def _covered(beads: np.ndarray, written: np.ndarray) -> np.ndarray:
    """(N,) how much of each bead's disc, with its rim, lies under `written` (H, W)."""
    shares = np.zeros(len(beads))
    for i, (u, v, radius) in enumerate(beads[:, :3]):
        disc = np.zeros(written.shape, np.uint8)
        cv2.circle(disc, (round(u), round(v)), round(radius) + 1, 1, -1)
        shares[i] = written[disc > 0].mean()
    return shares


def _repeats(fit: np.ndarray) -> np.ndarray:
    """Of fits that share a place all but the one that explains most of the image."""
    strength = np.abs(fit[:, columns.CONTRAST]) * fit[:, columns.RADIUS] / (0.05 + fit[:, columns.EXCESS])
    order = np.argsort(-strength, kind="stable")
    repeated = np.empty(len(fit), bool)
    repeated[order] = ~distinct(fit[order])
    return repeated


def _rejected(rows: np.ndarray, reasons: np.ndarray) -> tuple[Rejected, ...]:
    """What stands in the first three columns, u, v and radius, each with its reason."""
    return tuple(Rejected((u, v), r, str(why)) for (u, v, r), why in zip(rows[:, :3].tolist(), reasons, strict=False))


def _detections(
    beads: np.ndarray, middles: np.ndarray, image: Radiograph, rejected: tuple[Rejected, ...]
) -> Detections:
    """`middles` (H, W): where there are middles of washers."""
    cuu, cuv, cvv = (beads[:, c] for c in (columns.CUU, columns.CUV, columns.CVV))
    return Detections(
        uv_px=beads[:, :2],
        radius_px=beads[:, columns.RADIUS],
        covariance_px2=np.stack([cuu, cuv, cuv, cvv], axis=-1).reshape(-1, 2, 2),
        kind=tuple(
            np.where(_on(middles, beads), "washer", np.where(beads[:, columns.CONTRAST] < 0, "ball", "hole")).tolist()
        ),
        contrast=beads[:, columns.CONTRAST],
        image_shape=image.shape,
        rejected=rejected,
    )
