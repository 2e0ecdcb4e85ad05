"""Second look: once beads are labelled, fit the missing ones where the frame predicts them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from sightline.detection import columns, refine, window
from sightline.detection.detector import bead_fitter, fine_reasons
from sightline.detection.labelling.growth import Field
from sightline.detection.labelling.map_prior import CENTRE_PX, REMAINDER_SD, features, map_covariance
from sightline.detection.labelling.patterns import Pattern, patterns
from sightline.detection.labelling.seeds import best_similarity
from sightline.detection.labelling.solve import MIN_BEADS
from sightline.detection.results import Detections, Observations, RejectedCandidate
from sightline.detection.scale import FACTOR, coarser, coarser_observations, finer_observations, is_fine
from sightline.errors import ObservationsError
from sightline.fitting.kernels import distances
from sightline.fitting.kriging import PlanarKriging
from sightline.fitting.robust import variance_ratio
from sightline.frame import Frame
from sightline.imaging import Radiograph, as_radiograph
from sightline.threads import one_blas_thread

_NEIGHBOURS = 6  # nearest beads of the plate that predict a bead's size and contrast [ours]
_MAX_PREDICTION_SD_PX = 2.0  # with a less certain prediction, the fit may find something else [ours]
# Overlaps are in units of the smaller radius. Beyond _DEEP_OVERLAP, detection finds one bead, or the two bias each
# other: chi-square / 2 of labelled beads is 1.2-4.4 there, 0.8-1.4 where they overlap less [twin].
_DEEP_OVERLAP = 0.4
_MAX_OVERLAP = 1.4  # beyond, two shadows cannot be separated; the fit's own limit is 1.5 [ours]
# Pixels within this margin of an overlap are left out: two balls stop less light than the product of single shadows
# predicts. The margin lowers chi-square / 2 of overlapping beads from 6-10 to 0.5-1.5 [twin].
_MARGIN_PX = 2.5
_MIN_RIM_SHARE = 0.3  # of the rim, not covered by metal or other beads [ours]
_AROUND_PX = -1.0, 4.0  # the ring around a bead, from its rim [ours]
# Largest clipped share of that ring: without the foot of its edge, a rim has a larger error than stated [twin].
_MAX_CLIPPED_SHARE = 0.4
# Limits for accepting a fit: the image must determine it, and it must agree with the frame and the neighbours.
_MAX_SD_PX = 0.5  # as for beads that an image determines (docs/benchmarks.md)
_MAX_M2 = 16.0  # squared Mahalanobis distance from the prediction, whose s.d. is 1.2 times too small at the edge [twin]
_MAX_LOG_SIZE = 0.07  # log radius against the neighbours'; more is a pair of beads, or another object's rim [twin]
_MAX_LOG_CONTRAST = np.log(2.0)  # against the neighbours'; metal around a bead changes the contrast by a half [twin]


@dataclass(frozen=True, eq=False)
class _Expected:
    """The P beads of one plate as predicted by the plate's other beads, in IDCS.

    `uv_px` (P, 2); `variance_px2` (P,) per axis; `radius_px` (P,); `contrast` (P,); `row` (P,): its detection, or -1.
    """

    uv_px: np.ndarray
    variance_px2: np.ndarray
    radius_px: np.ndarray
    contrast: np.ndarray
    row: np.ndarray


def look_again(
    image: Radiograph | np.ndarray | str | Path,
    beads: Detections,
    observations: Observations,
    frame: Frame | str | Path,
    white: float | None = None,
) -> Observations:
    """Return `observations` (of `label`) with beads that `detect` missed, where the image shows them clearly.

    Beads partly under metal or under each other are fitted where the labelled beads of their plate predict them. They
    are accepted only if centre, size and contrast agree with the prediction. Labelled beads with a deep overlap are
    fitted again, both at once, or left out. Fitted beads stand last. Washers are not searched for, nor balls of a
    solid. `image`, `white`: as of `detect`; `frame`: as of `label`.
    Raises ObservationsError where `observations` are not what `label` returned for `beads`.

    >>> image, frame = sl.read_image("out/demo/demo_pa.dcm"), sl.Frame.load("gamma")
    >>> beads = sl.detect(image)
    >>> labelled = sl.label(beads, frame)
    >>> len(sl.look_again(image, beads, labelled, frame)) >= len(labelled) - 2
    True
    """
    image, frame = as_radiograph(image, white), Frame.of(frame)
    if is_fine(beads.radius_px, beads.contrast):
        seen = look_again(image.binned(FACTOR), coarser(beads), coarser_observations(observations), frame)
        return finer_observations(seen, observations.image_shape)
    return look_again_with(lambda: bead_fitter(image, beads), image, beads, observations, frame)


@one_blas_thread
def look_again_with(
    fitter_of_image: Callable[[], refine.BeadFitter],
    image: Radiograph,
    beads: Detections,
    observations: Observations,
    frame: Frame,
) -> Observations:
    """`look_again` with the image's bead fitter, which is made only if a bead is to be fitted."""
    plates = [pattern for pattern in patterns(frame) if pattern.view == observations.view]
    row_of = _rows_of(observations, beads)
    if not plates:
        return observations
    expected = _expected(plates, beads, row_of)
    which = _rows_to_fit(image, plates, expected)
    if len(which) == 0:
        return observations
    fit = _fitted(fitter_of_image(), image, _initial_rows(beads, expected, which), which)
    clear = _clear(fit, expected, which)
    ids = [name for pattern in plates for name in pattern.ids]
    looked_at, good = {ids[i] for i in which}, fit[clear]
    kept = [name for name in observations.ids if name not in looked_at]
    rows = [row_of[name] for name in kept]
    return replace(
        observations,
        ids=(*kept, *(ids[i] for i in which[clear])),
        uv_px=np.concatenate([beads.uv_px[rows], good[:, :2]]),
        covariance_px2=np.concatenate([beads.covariance_px2[rows], columns.centre_covariances(good)]),
        radius_px=np.concatenate([beads.radius_px[rows], good[:, columns.RADIUS]]),
        rejected=_rejected(observations, beads, [row_of[i] for i in observations.ids if i in looked_at], good),
    )


def _rejected(
    observations: Observations, beads: Detections, again: list[int], good: np.ndarray
) -> tuple[RejectedCandidate, ...] | None:
    """Return rejected detections (of `label`, and those fitted `again`) that no fitted bead covers; None if unknown."""
    if observations.rejected is None:
        return None
    hidden = (
        RejectedCandidate(
            tuple(beads.uv_px[row].tolist()), float(beads.radius_px[row]), "another bead hides too much of it"
        )
        for row in again
    )
    every = (*observations.rejected, *hidden)
    places = np.array([one.uv_px for one in every]).reshape(-1, 2)
    covered = np.any(distances(places, good[:, :2]) < good[:, columns.RADIUS], axis=1).tolist()
    return tuple(one for one, taken in zip(every, covered, strict=True) if not taken)


def _rows_of(observations: Observations, beads: Detections) -> dict[str, int]:
    """Return the row of each labelled fiducial's detection. Raises ObservationsError where one has none."""
    rows = {place: row for row, place in enumerate(map(tuple, beads.uv_px.tolist()))}
    try:
        return {i: rows[tuple(uv)] for i, uv in zip(observations.ids, observations.uv_px.tolist(), strict=True)}
    except KeyError:
        raise ObservationsError("these observations are not what `label` returned for these detections") from None


def _expected(plates: list[Pattern], beads: Detections, row_of: dict[str, int]) -> _Expected:
    """Return the predicted beads of all plates of the view, plate after plate. Raises ObservationsError."""
    parts = []
    for pattern in plates:
        row = np.array([row_of.get(name, -1) for name in pattern.ids])
        if np.count_nonzero(row >= 0) < MIN_BEADS:
            raise ObservationsError(
                f"fewer than {MIN_BEADS} beads of the {pattern.role_name} plate are labelled; `label` gives more"
            )
        parts.append((*_predicted(pattern, beads, row), row))
    return _Expected(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _predicted(pattern: Pattern, beads: Detections, row: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return centres, variances, radii and contrasts of a plate's beads, each predicted by all others that were seen.

    The map from plate to image has the form of labelling's inverse map: a polynomial of degree 5 and a smooth
    remainder.
    """
    seen = np.flatnonzero(row >= 0)
    uv, covariance = beads.uv_px[row[seen]], beads.covariance_px2[row[seen]]
    similarity = best_similarity(pattern.xy_mm[seen], uv)
    field = Field.of(beads.uv_px)
    middle, half = field.centre_px, field.radius_px
    laid, measured = (similarity.to_image(pattern.xy_mm) - middle) / half, (uv - middle) / half
    phi = features(laid)[0]
    gap2 = ((laid[:, None] - laid[seen]) ** 2).sum(axis=2)
    kernel = map_covariance(phi, phi[seen], gap2)
    own = (CENTRE_PX**2 + (pattern.bead_sd_mm * similarity.scale) ** 2) / half**2
    noise = np.trace(covariance, axis1=1, axis2=2) / 2 / half**2 + own

    def fitted(factor: float) -> PlanarKriging:
        return PlanarKriging.of(kernel[seen] + np.diag(factor * noise), measured - laid[seen])

    factor = max(1.0, variance_ratio(fitted(1.0).left_out().m2))
    solution = fitted(factor)
    others = solution.left_out()
    place = laid + kernel @ solution.dual
    place[seen] = measured - others.residual
    variance = solution.variances(kernel, (phi**2).sum(axis=1) + REMAINDER_SD**2)
    variance[seen] = others.variance - factor * noise
    gap2[seen, np.arange(len(seen))] = np.inf
    near = np.argsort(gap2, axis=1)[:, :_NEIGHBOURS]
    size = np.median(np.log(beads.radius_px[row[seen]] / pattern.diameter_mm[seen])[near], axis=1)
    contrast = np.median(beads.contrast[row[seen]][near], axis=1)
    return (
        place * half + middle,
        (np.maximum(variance, 0.0) + factor * own) * half**2,
        np.exp(size) * pattern.diameter_mm,
        contrast,
    )


def _rows_to_fit(image: Radiograph, plates: list[Pattern], expected: _Expected) -> np.ndarray:
    """Return the rows of the beads to fit: missing ones and those with a deep overlap, without washers."""
    radius, height_width = expected.radius_px, np.array(image.shape)
    apart = distances(expected.uv_px, expected.uv_px)
    overlap = _overlap(apart, radius[:, None], radius)
    np.fill_diagonal(overlap, 0.0)
    wanted = (expected.row < 0) | (overlap.max(axis=1) > _DEEP_OVERLAP)
    wanted &= (expected.variance_px2 < _MAX_PREDICTION_SD_PX**2) & ~np.concatenate(
        [pattern.washer for pattern in plates]
    )
    nearest = np.rint(expected.uv_px[:, ::-1]).astype(int)
    wanted &= ((nearest >= 0) & (nearest < height_width)).all(axis=1)
    which = np.flatnonzero(wanted)
    return which[image.field_mask[tuple(nearest[which].T)]]


def _initial_rows(beads: Detections, expected: _Expected, which: np.ndarray) -> np.ndarray:
    """Return initial rows of `columns`: the expected beads, then the detections that are none of these."""
    uv, radius, contrast = expected.uv_px.copy(), expected.radius_px.copy(), expected.contrast.copy()
    kept = np.setdiff1d(np.flatnonzero(expected.row >= 0), which)
    row = expected.row[kept]
    uv[kept], radius[kept], contrast[kept] = beads.uv_px[row], beads.radius_px[row], beads.contrast[row]
    return rows_with_others(beads, uv, radius, contrast)[0]


def rows_with_others(
    beads: Detections, uv_px: np.ndarray, radius_px: np.ndarray, contrast: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return initial rows of `columns` for given beads (N,) and after them for the detections that are none of these.

    And (M,) bool: which detections these are.
    """
    apart = distances(beads.uv_px, uv_px)
    other = np.asarray((apart > np.maximum(beads.radius_px[:, None], radius_px)).all(axis=1))
    rows = refine.start(
        np.concatenate([uv_px, beads.uv_px[other]]),
        np.concatenate([radius_px, beads.radius_px[other]]),
        np.concatenate([contrast, beads.contrast[other]]),
    )
    return rows, other


def _fitted(fit: refine.BeadFitter, image: Radiograph, rows: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Fit the rows `which` outside metal and overlaps; status TOO_FEW_PIXELS where too little is left."""
    usable, enough = without_overlaps(image, fit, rows, which)
    out = rows[which]
    out[:, columns.STATUS] = columns.TOO_FEW_PIXELS
    out[enough] = fit.within(usable)(rows, which[enough])
    return out


def without_overlaps(
    image: Radiograph, fit: refine.BeadFitter, rows: np.ndarray, which: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the usable pixels (H, W) outside metal and overlaps of the beads `which` (M,) of `rows`.

    And (M,) bool: whether enough of each bead is left.
    """
    usable = fit.usable.copy()
    return usable, np.array([_clear_covered(image, fit, rows, i, usable) for i in which], dtype=bool)


def _clear_covered(image: Radiograph, fit: refine.BeadFitter, rows: np.ndarray, i: int, usable: np.ndarray) -> bool:
    """Clear metal around bead `i` and its overlaps in `usable`; return whether enough of the bead is left."""
    u, v, radius = rows[i, :3]
    reach = radius + window.BEYOND
    apart = distances(rows[i : i + 1, :2], rows[:, :2])[0]
    near = np.flatnonzero(apart < 1.5 * reach + 4.0 + rows[:, columns.RADIUS])  # the window's corners too
    near = near[np.argsort(apart[near])]  # itself first
    half = int(reach) + 1
    left, top = int(u + 0.5) - half, int(v + 0.5) - half
    light = window.window_light(
        fit.log_image, left, top, half, window.log_level(fit.log_image, fit.usable, rows[i], reach)
    )
    state = window.pixel_states(fit.log_image, fit.usable, rows, near, left, top, 2 * half + 1, np.inf)
    outside = state == window.HIDDEN
    window.hide_metal(state, rows, near, left, top, light)
    state[_hull_of_metal((state == window.HIDDEN) & ~outside)] = window.HIDDEN
    metal = (state == window.HIDDEN) & ~outside
    hidden = cv2.dilate(metal.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    y, x = np.arange(len(state))[:, None] + top, np.arange(len(state)) + left
    from_centre = np.hypot(x - u, y - v)
    overlap = _overlap(apart[near[1:]], radius, rows[near[1:], columns.RADIUS])
    for j in near[1:][overlap > 0]:
        from_other = np.hypot(x - rows[j, 0], y - rows[j, 1])
        hidden |= (from_centre < radius + _MARGIN_PX) & (from_other < rows[j, columns.RADIUS] + _MARGIN_PX)
    height, width = usable.shape
    seen = slice(max(-top, 0), max(height - top, 0)), slice(max(-left, 0), max(width - left, 0))
    there = slice(max(top, 0), top + len(state)), slice(max(left, 0), left + len(state))
    usable[there] &= ~hidden[seen]
    around = (from_centre > radius + _AROUND_PX[0]) & (from_centre < radius + _AROUND_PX[1])
    visible = around[seen] & usable[there]
    clipped = visible & (image.pixels[there] >= image.white)
    rim = window.visible_rim(state, rows, near, left, top)
    foot = np.count_nonzero(clipped) < _MAX_CLIPPED_SHARE * np.count_nonzero(visible)
    return bool(rim > _MIN_RIM_SHARE and foot and overlap.max(initial=0.0) < _MAX_OVERLAP)


def _hull_of_metal(metal: np.ndarray) -> np.ndarray:
    """Return the convex hull (H, W) of what `hide_metal` found, without the margin that `metal` (H, W) has.

    Metal under a bead is not visible: a wire seen on two sides of a bead continues between them.
    """
    side = 2 * window.METAL + 1
    found = cv2.erode(metal.view(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    points = cv2.findNonZero(found)
    if points is not None:
        cv2.fillConvexPoly(found, cv2.convexHull(points), 1)
    return found > 0


def _overlap(apart: np.ndarray, radius: np.ndarray | float, other: np.ndarray) -> np.ndarray:
    """Return the overlap of discs in units of the smaller radius: 0 where they touch, 2 where one is in the other."""
    return (radius + other - apart) / np.minimum(radius, other)


def _clear(fit: np.ndarray, expected: _Expected, which: np.ndarray) -> np.ndarray:
    """Return the fits that are well-determined beads and agree with the prediction of the beads `which`."""
    clear = np.flatnonzero(fine_reasons(fit) == "")
    fit, which = fit[clear], which[clear]
    covariance, off = columns.centre_covariances(fit), fit[:, :2] - expected.uv_px[which]
    total = covariance + expected.variance_px2[which, None, None] * np.eye(2)
    off_m2 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(total), off)
    size = fit[:, columns.RADIUS] / expected.radius_px[which]
    contrast = np.maximum(fit[:, columns.CONTRAST] / expected.contrast[which], 1e-9)
    good = (covariance.max(axis=(1, 2)) < _MAX_SD_PX**2) & (off_m2 < _MAX_M2)
    return clear[good & (abs(np.log(size)) < _MAX_LOG_SIZE) & (abs(np.log(contrast)) < _MAX_LOG_CONTRAST)]
