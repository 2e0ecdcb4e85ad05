"""A second look: once beads are told apart, the frame says where the others must be; they are fitted there."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sightline.detection import columns, refine, window
from sightline.detection.detector import fine_reasons, fit_of
from sightline.detection.labelling.growth import Field
from sightline.detection.labelling.map_prior import CENTRE_PX, REMAINDER_SD, features, map_covariance
from sightline.detection.labelling.patterns import Pattern, patterns
from sightline.detection.labelling.seeds import best_similarity
from sightline.detection.labelling.solve import LEAST_BEADS
from sightline.detection.results import Detections, Observations, Rejected
from sightline.detection.scale import FACTOR, coarser, coarser_observations, finer_observations, is_fine
from sightline.errors import ObservationsError
from sightline.fitting.kriging import PlanarKriging
from sightline.fitting.robust import variance_ratio
from sightline.frame import Frame
from sightline.imaging import Radiograph

_NEIGHBOURS = 6  # beads of its plate that say how large and how dark a bead is [ours]
_VAGUEST_PX = 2.0  # s.d. of a prediction beyond which a fit may find something else [ours]
# Of the smaller radius: two shadows that overlap by more are one to detection, or pull at each other: chi-square
# / 2 of labelled beads is 1.2-4.4 there, 0.8-1.4 where they overlap less [twin].
_DEEP = 0.4
_ONE = 1.4  # of it: shadows that overlap by more are not told apart, the fit's own limit is 1.5 [ours]
# About the place where two shadows overlap no pixel counts: two balls take less of the light than a product of single
# shadows says. With this margin, px, chi-square / 2 of overlapping beads falls from 6-10 to 0.5-1.5 [twin].
_MARGIN_PX = 2.5
_RIM_SEEN = 0.3  # least share of the rim that metal and other beads must leave [ours]
_AROUND_PX = -1.0, 4.0  # from the rim: what surrounds a bead [ours]
_CLIPPED = 0.4  # most of what is visible of that: without its foot a rim is misjudged by more than is stated [twin]
# What may be taken: centre, light and size must be told by the image, and be what the frame and the neighbours say.
_NOISIEST_PX = 0.5  # as a bead counts that an image determines (docs/benchmarks.md)
_OFF_M2 = 16.0  # squared distance from the prediction, whose s.d. is 1.2 times as large at the field's edge [twin]
_OFF_SIZE = 0.07  # log radius beside its neighbours; more is a pair, or a rim that is not all its own [twin]
_OFF_CONTRAST = np.log(2.0)  # log of the contrast beside theirs; metal about a bead changes it by a half [twin]


@dataclass(frozen=True, eq=False)
class _Expected:
    """The P beads of one plate as the plate's other beads tell them, IDCS.

    `uv_px` (P, 2); `variance_px2` (P,) per axis; `radius_px` (P,); `contrast` (P,); `row` (P,): its detection, or -1.
    """

    uv_px: np.ndarray
    variance_px2: np.ndarray
    radius_px: np.ndarray
    contrast: np.ndarray
    row: np.ndarray


def look_again(image: Radiograph, beads: Detections, observations: Observations, frame: Frame) -> Observations:
    """`observations` (of `label`) with the beads that `detect` missed, where the image shows them clearly.

    Beads half under metal or under each other are sought where the labelled beads of their plate put them, and taken
    only if centre, size and contrast are what those say. Labelled beads that another one overlaps deeply are fitted
    anew, both at once, or left out. What was fitted stands last. Washers are not looked for.
    Raises ObservationsError where `observations` are not those that `label` made of `beads`.
    """
    if is_fine(beads.radius_px):
        seen = look_again(image.binned(FACTOR), coarser(beads), coarser_observations(observations), frame)
        return finer_observations(seen, observations.image_shape)
    return look_again_with(lambda: fit_of(image, beads), image, beads, observations, frame)


def look_again_with(
    fit_of_image: Callable[[], refine.BeadFitter],
    image: Radiograph,
    beads: Detections,
    observations: Observations,
    frame: Frame,
) -> Observations:
    """`look_again` with the image's own fit, which is asked for only where there is something to look at."""
    plates = [pattern for pattern in patterns(frame) if pattern.view == observations.view]
    row_of = _rows_of(observations, beads)
    expected = _expected(plates, beads, row_of)
    which = _to_look_at(image, plates, expected)
    if len(which) == 0:
        return observations
    fit = _fitted(fit_of_image(), image, _start(beads, expected, which), which)
    clear = _clear(fit, expected, which)
    ids = [name for pattern in plates for name in pattern.ids]
    looked_at, good = {ids[i] for i in which}, fit[clear]
    kept = [name for name in observations.ids if name not in looked_at]
    rows = [row_of[name] for name in kept]
    return replace(
        observations,
        ids=(*kept, *(ids[i] for i in which[clear])),
        uv_px=np.concatenate([beads.uv_px[rows], good[:, :2]]),
        covariance_px2=np.concatenate([beads.covariance_px2[rows], _covariance(good)]),
        radius_px=np.concatenate([beads.radius_px[rows], good[:, columns.RADIUS]]),
        rejected=_rejected(observations, beads, [row_of[i] for i in observations.ids if i in looked_at], good),
    )


def _rejected(
    observations: Observations, beads: Detections, again: list[int], good: np.ndarray
) -> tuple[Rejected, ...] | None:
    """Of `label`, and of the detections fitted `again`: those that no bead of the fit covers. None as it came."""
    if observations.rejected is None:
        return None
    hidden = (
        Rejected(tuple(beads.uv_px[row].tolist()), float(beads.radius_px[row]), "another bead hides too much of it")
        for row in again
    )
    every = (*observations.rejected, *hidden)
    places = np.array([one.uv_px for one in every]).reshape(-1, 2)
    covered = np.any(_apart(places, good[:, :2]) < good[:, columns.RADIUS], axis=1).tolist()
    return tuple(one for one, taken in zip(every, covered, strict=True) if not taken)


def _rows_of(observations: Observations, beads: Detections) -> dict[str, int]:
    """Which detection each labelled fiducial is. Raises ObservationsError where one is none."""
    rows = {place: row for row, place in enumerate(map(tuple, beads.uv_px.tolist()))}
    try:
        return {i: rows[tuple(uv)] for i, uv in zip(observations.ids, observations.uv_px.tolist(), strict=True)}
    except KeyError:
        raise ObservationsError("these observations are not what `label` made of these detections") from None


def _expected(plates: list[Pattern], beads: Detections, row_of: dict[str, int]) -> _Expected:
    """Of all plates of the view, one after the other. Raises ObservationsError."""
    parts = []
    for pattern in plates:
        row = np.array([row_of.get(name, -1) for name in pattern.ids])
        if np.count_nonzero(row >= 0) < LEAST_BEADS:
            raise ObservationsError(
                f"fewer than {LEAST_BEADS} beads of the {pattern.role_name} plate are labelled; `label` gives more"
            )
        parts.append((*_on_plate(pattern, beads, row), row))
    return _Expected(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _on_plate(pattern: Pattern, beads: Detections, row: np.ndarray) -> tuple[np.ndarray, ...]:
    """Places, variances, radii and contrasts of a plate's beads (P,), each by all others that were seen.

    The map from plate to image is labelling's, the other way round: a polynomial to degree 5 and a smooth remainder.
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


def _to_look_at(image: Radiograph, plates: list[Pattern], expected: _Expected) -> np.ndarray:
    """Rows of the beads to fit: those that are missing, and those that another one overlaps deeply. Washers are not."""
    radius, height_width = expected.radius_px, np.array(image.shape)
    apart = _apart(expected.uv_px, expected.uv_px)
    overlap = _overlap(apart, radius[:, None], radius)
    np.fill_diagonal(overlap, 0.0)
    wanted = (expected.row < 0) | (overlap.max(axis=1) > _DEEP)
    wanted &= (expected.variance_px2 < _VAGUEST_PX**2) & ~np.concatenate([pattern.washer for pattern in plates])
    nearest = np.rint(expected.uv_px[:, ::-1]).astype(int)
    wanted &= ((nearest >= 0) & (nearest < height_width)).all(axis=1)
    which = np.flatnonzero(wanted)
    return which[image.field_mask[tuple(nearest[which].T)]]


def _start(beads: Detections, expected: _Expected, which: np.ndarray) -> np.ndarray:
    """Rows of `columns` from which to fit: the expected beads, and after them the detections that are none of these."""
    uv, radius, contrast = expected.uv_px.copy(), expected.radius_px.copy(), expected.contrast.copy()
    kept = np.setdiff1d(np.flatnonzero(expected.row >= 0), which)
    row = expected.row[kept]
    uv[kept], radius[kept], contrast[kept] = beads.uv_px[row], beads.radius_px[row], beads.contrast[row]
    apart = _apart(beads.uv_px, uv)
    other = (apart > np.maximum(beads.radius_px[:, None], radius)).all(axis=1)
    return refine.start(
        np.concatenate([uv, beads.uv_px[other]]),
        np.concatenate([radius, beads.radius_px[other]]),
        np.concatenate([contrast, beads.contrast[other]]),
    )


def _fitted(fit: refine.BeadFitter, image: Radiograph, rows: np.ndarray, which: np.ndarray) -> np.ndarray:
    """The rows `which` fitted to what metal and overlapping shadows leave of them; TOO_FEW_PIXELS if that is little."""
    usable, enough = without_overlaps(image, fit, rows, which)
    out = rows[which]
    out[:, columns.STATUS] = columns.TOO_FEW_PIXELS
    out[enough] = fit.within(usable)(rows, which[enough])
    return out


def without_overlaps(
    image: Radiograph, fit: refine.BeadFitter, rows: np.ndarray, which: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) bool: the pixels that count where the beads `which` (M,) of `rows` are not under metal and under each
    other; and (M,) bool: of which beads enough is left."""
    usable = fit.usable.copy()
    return usable, np.array([_hide(image, fit, rows, i, usable) for i in which], dtype=bool)


def _hide(image: Radiograph, fit: refine.BeadFitter, rows: np.ndarray, i: int, usable: np.ndarray) -> bool:
    """Take metal about bead `i`, and where others overlap it, from `usable`; whether enough is left of it."""
    u, v, radius = rows[i, :3]
    reach = radius + window.BEYOND
    apart = _apart(rows[i : i + 1, :2], rows[:, :2])[0]
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
    state[_under((state == window.HIDDEN) & ~outside)] = window.HIDDEN
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
    foot = np.count_nonzero(clipped) < _CLIPPED * np.count_nonzero(visible)
    return bool(rim > _RIM_SEEN and foot and overlap.max(initial=0.0) < _ONE)


def _under(metal: np.ndarray) -> np.ndarray:
    """(H, W) bool: the convex hull of what `hide_metal` found, without the margin that `metal` (H, W) has about it.

    Under a bead, metal does not show: a wire seen on two sides of it runs on between them.
    """
    side = 2 * window.METAL + 1
    found = cv2.erode(metal.view(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    points = cv2.findNonZero(found)
    if points is not None:
        cv2.fillConvexPoly(found, cv2.convexHull(points), 1)
    return found > 0


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, M) distances of points (N, 2) and (M, 2)."""
    return np.hypot(a[:, 0, None] - b[:, 0], a[:, 1, None] - b[:, 1])


def _overlap(apart: np.ndarray, radius: np.ndarray | float, other: np.ndarray) -> np.ndarray:
    """Of two discs, in units of the smaller radius; 0 where they touch, 2 where one lies deep in the other."""
    return (radius + other - apart) / np.minimum(radius, other)


def _clear(fit: np.ndarray, expected: _Expected, which: np.ndarray) -> np.ndarray:
    """Which of the fits are beads by themselves, well determined, and what is expected of the beads `which`."""
    clear = np.flatnonzero(fine_reasons(fit) == "")
    fit, which = fit[clear], which[clear]
    covariance, off = _covariance(fit), fit[:, :2] - expected.uv_px[which]
    total = covariance + expected.variance_px2[which, None, None] * np.eye(2)
    off_m2 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(total), off)
    size = fit[:, columns.RADIUS] / expected.radius_px[which]
    contrast = np.maximum(fit[:, columns.CONTRAST] / expected.contrast[which], 1e-9)
    good = (covariance.max(axis=(1, 2)) < _NOISIEST_PX**2) & (off_m2 < _OFF_M2)
    return clear[good & (abs(np.log(size)) < _OFF_SIZE) & (abs(np.log(contrast)) < _OFF_CONTRAST)]


def _covariance(fit: np.ndarray) -> np.ndarray:
    return fit[:, [columns.CUU, columns.CUV, columns.CUV, columns.CVV]].reshape(-1, 2, 2)
