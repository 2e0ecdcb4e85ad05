"""Second look: once beads are labelled, fit the missing ones where the frame predicts them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from sightline.common.fitting import MAD_TO_SD, PlanarKriging, distances, variance_ratio
from sightline.common.threads import one_blas_thread
from sightline.detection.beads import refine, window
from sightline.detection.beads.bead import (
    SHADOW,
    WITHOUT_FOOT,
    BeadStatus,
    allow_for_missing_foot,
    centre_covariances,
    centres,
    clipped_shares,
)
from sightline.detection.beads.fit import PRIOR_SD
from sightline.detection.beads.shadow import BEAD_RADIUS
from sightline.detection.detector import bead_fitter, fine_reasons
from sightline.detection.labelling.growth import CENTRE_PX, REMAINDER_SD, Field, features, map_covariance
from sightline.detection.labelling.joint import SAME_DISTANCE
from sightline.detection.labelling.patterns import Pattern, patterns
from sightline.detection.labelling.seeds import best_similarity
from sightline.detection.labelling.solve import MIN_BEADS
from sightline.detection.results import (
    FACTOR,
    Detections,
    Observations,
    RejectedCandidate,
    coarser,
    finer,
    is_fine,
)
from sightline.errors import ObservationsError
from sightline.frame import Frame
from sightline.imaging import Radiograph, as_radiograph

SHAPE = ["radius_px", "blur_px", "axial", "diagonal"]  # fields of a bead
_MEAN_ALONE = np.array([False, True, False, False])
# Over a plate, log size and ellipticity follow a quadratic polynomial of the place to 0.002-0.007 [twin]: perspective,
# distortion and oblique rays. The blur is the same everywhere.
_TERMS = 6
# Of the fit of that polynomial [ours]: beads for it, 2.5 for each coefficient, of fewer the mean is taken; a ridge, so
# that its coefficients are determined; times of reweighting.
_ENOUGH, _RIDGE, _REWEIGHTED = 15, 0.01, 8
_FLOOR = np.array([0.003, 0.02, 0.003, 0.003])  # least s.d. of log size, log blur and ellipticities [twin]
_HUBER = 1.5  # s.d. beyond which a bead counts less [Huber 1981: 1 to 2]


def expected_shapes(pattern: Pattern, seen: np.ndarray, beads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shapes (P, 4), fields SHAPE, of all beads of a plate, and their s.d. (P, 4).

    The s.d. of radius and blur are shares of their values. `beads` (M,): fits of the plate's beads `seen` (M,), M >= 3.
    A polynomial of the place is fitted robustly to each field.
    """
    x, y = (2 * (pattern.xy_mm - pattern.xy_mm.mean(axis=0)) / np.ptp(pattern.xy_mm)).T
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)[None].repeat(len(SHAPE), axis=0)
    simple = _MEAN_ALONE | (len(seen) < _ENOUGH)
    design[simple, :, 1:] = 0.0
    values = np.stack([beads[name] for name in SHAPE])
    values[0] /= pattern.diameter_mm[seen]
    values[:2] = np.log(values[:2])
    freedom = len(seen) - np.where(simple, 1, _TERMS)
    known, ridge = design[:, seen], np.diag([0.0, *[_RIDGE] * (_TERMS - 1)])
    normal, coefficients, spread = ridge, values, np.full(len(SHAPE), np.inf)
    rest = np.zeros(values.shape)
    for _ in range(_REWEIGHTED):
        weight = 1.0 / np.maximum(1.0, rest / (_HUBER * spread[:, None]))
        weighted = np.swapaxes(known * weight[:, :, None], 1, 2)
        normal = weighted @ known + ridge
        coefficients = np.linalg.solve(normal, weighted @ values[:, :, None])
        rest = np.abs(values - (known @ coefficients)[:, :, 0])
        spread = np.maximum(MAD_TO_SD * np.median(rest, axis=1) * np.sqrt(len(seen) / freedom), _FLOOR)
    mean = (design @ coefficients)[:, :, 0].T
    leverage = (design * np.swapaxes(np.linalg.solve(normal, np.swapaxes(design, 1, 2)), 1, 2)).sum(axis=2)
    mean[:, :2] = np.exp(mean[:, :2])
    mean[:, 0] *= pattern.diameter_mm
    return mean, (spread[:, None] * np.sqrt(1.0 + leverage)).T


# Deepest overlaps, in units of the smaller radius, at which two shadows can be separated: by their own rims, and where
# other beads say what shape they have [twin].
DEEPEST, DEEPEST_OF_KNOWN_SHAPE = 1.4, 1.9
# Pixels within this margin of an overlap are left out: two balls stop less light than the product of single shadows
# predicts. The margin lowers chi-square / 2 of overlapping beads from 6-10 to 0.8-1.2. In overlaps above 1.2 radii one
# of 70 beads was wrong by 6 s.d. at 1.75 px, none at 2 px; 2.5 px leave fewer of them enough pixels [twin].
_MARGIN_PX = 2.0
_MIN_RIM_SHARE = 0.3  # [ours] of the rim, not covered by metal or other beads: a shorter arc does not give a centre
_MOST_HIDDEN = 0.5  # share of its rim up to which what covers a bead does not matter, however deep the overlap [twin]


def without_overlaps(
    fit: refine.BeadFitter, rows: np.ndarray, which: np.ndarray, deepest: float = DEEPEST
) -> tuple[np.ndarray, np.ndarray]:
    """Return the usable pixels (H, W) outside metal and overlaps of the beads `which` (M,) of `rows`.

    And (M,) bool: whether enough of each bead is left. `deepest`: overlap beyond which it is not.
    """
    usable = fit.scene.usable.copy()
    enough = [_clear_covered(fit, rows, i, usable) < deepest for i in which]
    return usable, np.array(enough, dtype=bool)


def _clear_covered(fit: refine.BeadFitter, rows: np.ndarray, i: int, usable: np.ndarray) -> float:
    """Clear metal around bead `i` and its overlaps in `usable`; return its deepest overlap with a bead that hides more
    than half of its rim.

    Infinite where too little of the bead is left.
    """
    u, v, radius = (float(rows[i][name]) for name in ("u_px", "v_px", "radius_px"))
    reach = radius + window.BEYOND
    apart = distances(centres(rows[i : i + 1]), centres(rows))[0]
    near = np.flatnonzero(apart < 1.5 * reach + 4.0 + rows["radius_px"])  # the window's corners too
    near = near[np.argsort(apart[near])]  # itself first
    half = int(reach) + 1
    left, top = int(u + 0.5) - half, int(v + 0.5) - half
    logs = fit.scene.logs
    level = window.log_level(logs, fit.scene.usable, u, v, radius, reach)
    light = window.window_light(logs, left, top, half, level)
    state = window.pixel_states(logs, fit.scene.usable, rows, near, left, top, 2 * half + 1, np.inf)
    outside = state == window.HIDDEN
    window.hide_metal(state, rows, near, left, top, light)
    state[_hull_of_metal((state == window.HIDDEN) & ~outside)] = window.HIDDEN
    metal = (state == window.HIDDEN) & ~outside
    hidden = cv2.dilate(metal.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    y, x = np.arange(len(state))[:, None] + top, np.arange(len(state)) + left
    from_centre = np.hypot(x - u, y - v)
    overlap = overlap_of(apart[near[1:]], radius, rows["radius_px"][near[1:]])
    for j in near[1:][overlap > 0]:
        from_other = np.hypot(x - rows[j]["u_px"], y - rows[j]["v_px"])
        hidden |= (from_centre < radius + _MARGIN_PX) & (from_other < rows[j]["radius_px"] + _MARGIN_PX)
    height, width = usable.shape
    seen = slice(max(-top, 0), max(height - top, 0)), slice(max(-left, 0), max(width - left, 0))
    there = slice(max(top, 0), top + len(state)), slice(max(left, 0), left + len(state))
    usable[there] &= ~hidden[seen]
    rim = window.visible_rim(state, rows, near, left, top)
    share = hidden_share(apart[near[1:]], radius, rows["radius_px"][near[1:]])
    if rim <= _MIN_RIM_SHARE or share.max(initial=0.0) == 1.0:  # of a rim that is hidden all round, the foot is left
        return np.inf
    return overlap[share > _MOST_HIDDEN].max(initial=0.0)


def _hull_of_metal(metal: np.ndarray) -> np.ndarray:
    """Return the convex hull (H, W) of what `hide_metal` found, without the margin that `metal` (H, W) has.

    Metal under a bead is not visible: a wire seen on two sides of a bead continues between them.
    """
    side = 2 * window.METAL + 1
    core = cv2.erode(metal.view(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    points = cv2.findNonZero(core)
    if points is not None:
        cv2.fillConvexPoly(core, cv2.convexHull(points), 1)
    return core > 0


def hidden_share(apart: np.ndarray, radius: np.ndarray | float, other: np.ndarray) -> np.ndarray:
    """Return the share of a disc's rim that other discs `apart` from it cover, with their margin."""
    cosine = (radius**2 + apart**2 - (other + _MARGIN_PX) ** 2) / (2 * radius * np.maximum(apart, 1e-9))
    return np.arccos(np.clip(cosine, -1.0, 1.0)) / np.pi


def overlap_of(apart: np.ndarray, radius: np.ndarray | float, other: np.ndarray) -> np.ndarray:
    """Return the overlap of discs in units of the smaller radius: 0 where they touch, 2 where one is in the other."""
    return (radius + other - apart) / np.minimum(radius, other)


_ROUNDS = 6  # [ours] of fitting, each further out: across a plate of seven rows
# What a file of detections does not state of their fits.
_NOT_STATED = ["blur_px", "axial", "diagonal", "status", "excess"]
_NEIGHBOURS = 6  # [ours] nearest beads, or more at the same distance, predict size and contrast; farther ones differ
_MAX_PREDICTION_SD_PX = 2.0  # with a less certain prediction, the fit may find something else [ours]
# Overlap beyond which detection finds one bead, or the two bias each other: chi-square / 2 of labelled beads is 1.2-4.4
# there, 0.8-1.4 where they overlap less [twin].
_DEEP_OVERLAP = 0.4
# A bead in a deeper overlap, of whose rim another bead hides more than a share, is fitted with that bead or not at all:
# alone, it takes up the other's shadow. Beads that were wrong by 6 to 17 s.d. had 0.45 of their rims hidden [twin].
_TOGETHER_OVERLAP, _TOGETHER_HIDDEN = 1.6, 0.33
# Residual beyond noise over contrast, above which a labelled bead is fitted again: metal lies in its window. Of beads
# elsewhere one in a thousand has more; those beside metal were wrong by 1.6 times their stated s.d. [twin].
_MAX_EXCESS = 0.03
# Limits for accepting a fit: the image must determine it, and it must agree with the frame and the neighbours.
_MAX_SD_PX = 0.5  # as for beads that an image determines (docs/benchmarks.md)
_MAX_M2 = 16.0  # squared Mahalanobis distance from the prediction, whose s.d. is 1.2 times too small at the edge [twin]
_MAX_LOG_SIZE = 0.07  # log radius against the neighbours'; more is a pair of beads, or another object's rim [twin]
_MAX_LOG_CONTRAST = np.log(2.0)  # against the neighbours'; metal around a bead changes the contrast by a half [twin]
_SAME_PLACE = 0.25  # of the radius: two shadows that are this close are not separated (overlap above 1.75) [ours]
# Share of a fitted bead's rim that another shadow may cover. Without the limit 7 of 116 absent balls, deep in the
# shadow of another, were "found", with 0.86 and more; with it none of 505 [twin].
_MOST_RIM_HIDDEN = 0.8
# Before a clipped background, whose level is unknown, a rim is fitted too small and too faint [twin].
_MIN_LOG_SIZE_WITHOUT_FOOT, _MIN_LOG_CONTRAST_WITHOUT_FOOT = -0.3, -1.5


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

    def start(self) -> np.ndarray:
        """Return the beads (P,) with the initial values of a fit."""
        return refine.start(self.uv_px, self.radius_px, self.contrast)


@one_blas_thread
def look_again(
    image: Radiograph | np.ndarray | str | Path,
    beads: Detections,
    observations: Observations,
    frame: Frame | str | Path,
    white: float | None = None,
) -> Observations:
    """Return `observations` (of `label`) with beads that `detect` missed, where the image shows them clearly.

    Beads partly under metal or each other are fitted where the others of their plate predict them, and accepted if
    centre, size and contrast agree. Before a clipped background, detections too small for labelling are accepted too,
    with a larger covariance. Labelled beads with a deep overlap, or beside metal, are fitted again or left out. Fitted
    beads stand last. Washers and balls of a solid are not searched for. Arguments as of `detect` and `label`.
    Raises ObservationsError where `observations` are not what `label` returned for `beads`.

    >>> image, frame = sl.read_image("out/demo/demo_pa.dcm"), sl.Frame.load("gamma")
    >>> beads = sl.detect(image)
    >>> labelled = sl.label(beads, frame)
    >>> len(sl.look_again(image, beads, labelled, frame)) >= len(labelled) - 2
    True
    """
    image, frame = as_radiograph(image, white), Frame.of(frame)
    if is_fine(beads.radius_px, beads.contrast):
        seen = look_again(image.binned(FACTOR), coarser(beads), coarser(observations), frame)
        return finer(seen, observations.image_shape)
    plates = [pattern for pattern in patterns(frame) if pattern.view == observations.view]
    ids = np.array([name for pattern in plates for name in pattern.ids], dtype=object)
    before = row_of = _rows_of(observations, beads)
    if not plates:
        return observations
    for pattern in _too_few(plates, row_of):
        raise ObservationsError(
            f"fewer than {MIN_BEADS} beads of the {pattern.role_name} plate are labelled; `label` gives more"
        )
    fitter = cache(lambda: bead_fitter(image, beads))  # made only if a bead is to be fitted
    rows = _known_fits(beads, fitter)
    settled, tried = np.zeros(len(ids), dtype=bool), np.zeros(len(ids), dtype=bool)
    for _ in range(_ROUNDS):  # beads found in one round predict those further out in the next
        expected = _expected(plates, rows, row_of)
        which = _rows_to_fit(image, plates, expected, rows, settled)
        if len(which) == 0:
            break
        shares = clipped_shares(image, image.field_mask, expected.start())
        detected = _detected(rows, expected, which[shares[which] > WITHOUT_FOOT])
        row_of = row_of | {ids[k]: row for k, row in detected.items()}
        settled[list(detected)] = True
        which = which[~settled[which]]
        if len(which) == 0:
            continue
        fit, clear = _fitted(fitter(), plates, rows, expected, which, shares)
        tried[which] = settled[which[clear]] = True
        row_of = {name: row for name, row in row_of.items() if name not in ids[which]}
        row_of |= {name: len(rows) + k for k, name in enumerate(ids[which[clear]])}
        rows = np.concatenate([rows, fit[clear]])
        if len(clear) + len(detected) == 0 or _too_few(plates, row_of):
            break
    return observations if row_of == before else _looked(observations, beads, rows, (before, row_of), ids[tried])


def _looked(
    observations: Observations,
    beads: Detections,
    rows: np.ndarray,
    rows_of: tuple[dict[str, int], dict[str, int]],
    tried: np.ndarray,
) -> Observations:
    """Return the observations after the second look; `rows_of`: the row of each bead before and after it."""
    before, row_of = rows_of
    row, new = list(row_of.values()), [row for name, row in row_of.items() if before.get(name) != row]
    return replace(
        observations,
        ids=tuple(row_of),
        uv_px=centres(rows[row]),
        covariance_px2=centre_covariances(rows[row]),
        radius_px=rows["radius_px"][row],
        rejected=_rejected(observations, beads, [before[i] for i in tried if i in before], rows[new]),
    )


def _known_fits(beads: Detections, fitter: Callable[[], refine.BeadFitter]) -> np.ndarray:
    """Return the beads (N,) as fits; what detections do not state is fitted again."""
    rows = refine.start(beads.uv_px, beads.radius_px, beads.contrast)
    rows["uu_px2"], rows["uv_px2"], _, rows["vv_px2"] = beads.covariance_px2.reshape(-1, 4).T
    if beads.shadows is not None and np.array_equal(centres(beads.shadows), beads.uv_px):
        rows[SHADOW] = beads.shadows
    else:
        rows[_NOT_STATED] = fitter()(rows)[_NOT_STATED]
    return rows


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
    places = np.array([candidate.uv_px for candidate in every]).reshape(-1, 2)
    covered = np.any(distances(places, centres(good)) < good["radius_px"], axis=1).tolist()
    return tuple(candidate for candidate, taken in zip(every, covered, strict=True) if not taken)


def _rows_of(observations: Observations, beads: Detections) -> dict[str, int]:
    """Return the row of each labelled fiducial's detection. Raises ObservationsError where one has none."""
    rows = {place: row for row, place in enumerate(map(tuple, beads.uv_px.tolist()))}
    try:
        return {i: rows[tuple(uv)] for i, uv in zip(observations.ids, observations.uv_px.tolist(), strict=True)}
    except KeyError:
        raise ObservationsError("these observations are not what `label` returned for these detections") from None


def _too_few(plates: list[Pattern], row_of: dict[str, int]) -> list[Pattern]:
    """Return the plates with too few labelled beads to predict the others."""
    return [pattern for pattern in plates if sum(name in row_of for name in pattern.ids) < MIN_BEADS]


def _expected(plates: list[Pattern], rows: np.ndarray, row_of: dict[str, int]) -> _Expected:
    """Return the predicted beads of all plates of the view, plate after plate; `rows` (M,): the beads known."""
    parts = []
    for pattern in plates:
        row = np.array([row_of.get(name, -1) for name in pattern.ids])
        parts.append((*_predicted(pattern, rows, row), row))
    return _Expected(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _predicted(pattern: Pattern, rows: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return centres, variances, radii and contrasts of a plate's beads, each predicted by all others that were seen.

    The map from plate to image has the form of labelling's inverse map: a polynomial of degree 5 and a smooth
    remainder.
    """
    seen = np.flatnonzero(row >= 0)
    uv, covariance = centres(rows[row[seen]]), centre_covariances(rows[row[seen]])
    similarity = best_similarity(pattern.xy_mm[seen], uv)
    field = Field.of(centres(rows))
    middle, half = field.centre_px, field.radius_px
    laid, measured = (similarity.to_image(pattern.xy_mm) - middle) / half, (uv - middle) / half
    phi = features(laid)[0]
    gap2 = ((laid[:, None] - laid[seen]) ** 2).sum(axis=2)
    kernel = map_covariance(phi, phi[seen], gap2)
    own = (CENTRE_PX**2 + (pattern.bead_sd_mm * similarity.scale) ** 2) / half**2
    noise = np.trace(covariance, axis1=1, axis2=2) / 2 / half**2 + own

    def fitted(factor: float) -> PlanarKriging:
        return PlanarKriging.of(kernel[seen] + np.diag(factor * noise), measured - laid[seen])

    solution = fitted(1.0)
    others = solution.left_out()
    factor = max(1.0, variance_ratio(others.m2))
    if factor > 1.0:
        solution = fitted(factor)
        others = solution.left_out()
    place = laid + kernel @ solution.dual
    place[seen] = measured - others.residual
    variance = solution.variances(kernel, (phi**2).sum(axis=1) + REMAINDER_SD**2)
    variance[seen] = others.variance - factor * noise
    gap2[seen, np.arange(len(seen))] = np.inf
    near = nearest(gap2)
    size = medians(np.log(rows["radius_px"][row[seen]] / pattern.diameter_mm[seen]), near)
    contrast = medians(rows["contrast"][row[seen]], near)
    return (
        place * half + middle,
        (np.maximum(variance, 0.0) + factor * own) * half**2,
        np.exp(size) * pattern.diameter_mm,
        contrast,
    )


def nearest(squares: np.ndarray) -> np.ndarray:
    """Return (P, M) bool: the _NEIGHBOURS least of each row's squared distances, and all that are as small as the last.

    On a grid there are several, and rounding must not choose among them.
    """
    last = np.partition(squares, _NEIGHBOURS - 1, axis=1)[:, [_NEIGHBOURS - 1]]
    return squares <= (1.0 + SAME_DISTANCE) * last


def medians(values: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Return the median (P,) of those `values` (M,) that each row of `of` (P, M) bool takes."""
    ordered, count, row = (
        np.sort(np.where(of, values, np.inf), axis=1),
        np.count_nonzero(of, axis=1),
        np.arange(len(of)),
    )
    return (ordered[row, (count - 1) // 2] + ordered[row, count // 2]) / 2


def _rows_to_fit(
    image: Radiograph, plates: list[Pattern], expected: _Expected, rows: np.ndarray, settled: np.ndarray
) -> np.ndarray:
    """Return which beads to fit: missing ones, those with a deep overlap, and those that leave a residual in `rows`.

    A detection's fit leaves one where metal that it did not find lies beside the bead. Without washers and those that
    are `settled` (P,).
    """
    radius, height_width = expected.radius_px, np.array(image.shape)
    apart = distances(expected.uv_px, expected.uv_px)
    overlap = overlap_of(apart, radius[:, None], radius)
    np.fill_diagonal(overlap, 0.0)
    wanted = (expected.row < 0) | (overlap.max(axis=1) > _DEEP_OVERLAP)
    wanted |= rows["excess"][expected.row] > _MAX_EXCESS
    wanted &= (
        ~settled
        & (expected.variance_px2 < _MAX_PREDICTION_SD_PX**2)
        & ~np.concatenate([pattern.washer for pattern in plates])
    )
    pixel = np.rint(expected.uv_px[:, ::-1]).astype(int)
    wanted &= ((pixel >= 0) & (pixel < height_width)).all(axis=1)
    which = np.flatnonzero(wanted)
    return which[image.field_mask[tuple(pixel[which].T)]]


def _initial(
    plates: list[Pattern], rows: np.ndarray, expected: _Expected, which: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return beads to begin with: the expected ones, then the known `rows` that are none of these.

    And their prior s.d. (2, N, BEAD_TERMS). The shape of each ball is that of the other balls of its plate.
    """
    known = np.setdiff1d(np.flatnonzero(expected.row >= 0), which)
    own = expected.start()
    own[known] = rows[expected.row[known]]
    initial = np.concatenate([own, rows[_others(rows, own)]])
    prior_sd = np.repeat(PRIOR_SD[:, None], len(initial), axis=1)
    first = 0
    for pattern in plates:
        of_plate = np.arange(first, first + len(pattern.ids))
        first += len(of_plate)
        seen = np.flatnonzero(
            np.isin(of_plate, known) & ~pattern.washer & (own["status"][of_plate] == BeadStatus.FITTED)
        )
        if len(seen) < MIN_BEADS:
            continue
        shape, sd = expected_shapes(pattern, seen, own[of_plate[seen]])
        balls = of_plate[~pattern.washer]
        for name, values in zip(SHAPE, shape[~pattern.washer].T, strict=True):
            initial[name][balls] = values
        prior_sd[:, balls, BEAD_RADIUS:] = np.minimum(prior_sd[:, balls, BEAD_RADIUS:], sd[~pattern.washer])
    return initial, prior_sd


def _detected(rows: np.ndarray, expected: _Expected, which: np.ndarray) -> dict[int, int]:
    """Return the detections, as rows, that show the missing beads `which`, isolated and before a clipped background.

    Labelling does not take them, because their radii are too small.
    """
    left, detected = np.setdiff1d(np.flatnonzero(rows["contrast"] < 0), expected.row), {}
    for k in which[expected.row[which] < 0]:
        total = centre_covariances(rows[left]) + expected.variance_px2[k] * np.eye(2)
        off = centres(rows[left]) - expected.uv_px[k]
        m2 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(total), off)
        size = np.log(rows["radius_px"][left] / expected.radius_px[k])
        alike = np.flatnonzero((m2 < _MAX_M2) & (size > _MIN_LOG_SIZE_WITHOUT_FOOT) & (size < _MAX_LOG_SIZE))
        apart = distances(expected.uv_px[[k]], expected.uv_px)[0] - expected.radius_px
        if len(alike) == 1 and np.partition(apart, 1)[1] > expected.radius_px[k]:
            detected[int(k)] = int(left[alike[0]])
    return detected


def _others(every: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return which rows of `every` are none of the beads `rows`: a bool for each."""
    apart = distances(centres(every), centres(rows))
    return np.asarray((apart > np.maximum(every["radius_px"][:, None], rows["radius_px"])).all(axis=1))


def _fitted(  # noqa: PLR0917
    fitter: refine.BeadFitter,
    plates: list[Pattern],
    rows: np.ndarray,
    expected: _Expected,
    which: np.ndarray,
    shares: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return fits (M,) of the beads `which` (M,) outside metal and overlaps, and which of them are clear.

    `shares` (P,): of the clipped pixels around each bead. Status TOO_FEW_PIXELS where too little is left.
    """
    initial, prior_sd = _initial(plates, rows, expected, which)
    # Before a clipped background, the radius must take up what the fit does not know of the shadow's profile.
    prior_sd[:, np.flatnonzero(shares > WITHOUT_FOOT)] = PRIOR_SD[:, None]
    usable, enough = without_overlaps(fitter, initial, which, DEEPEST_OF_KNOWN_SHAPE)
    fit = initial[which]
    fit["status"] = BeadStatus.TOO_FEW_PIXELS
    fit[enough] = fitter.within(usable)(initial, which[enough], prior_sd)
    allow_for_missing_foot(fit, shares[which])
    return fit, _clear(fit, initial, expected, which, shares[which] > WITHOUT_FOOT)


def _clear(
    fit: np.ndarray, initial: np.ndarray, expected: _Expected, which: np.ndarray, without_foot: np.ndarray
) -> np.ndarray:
    """Return the fits that are well-determined beads and agree with the prediction of the beads `which`.

    Of two fits at one place neither is returned: they describe the same shadow, and which bead's it is stays open.
    `without_foot` (M,) bool: which of them have a clipped background.
    """
    clear, tried = np.flatnonzero(fine_reasons(fit) == ""), which
    fit, which, without_foot = fit[clear], which[clear], without_foot[clear]
    covariance, off = centre_covariances(fit), centres(fit) - expected.uv_px[which]
    total = covariance + expected.variance_px2[which, None, None] * np.eye(2)
    off_m2 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(total), off)
    size = np.log(fit["radius_px"] / initial["radius_px"][which])
    least = np.where(without_foot, _MIN_LOG_SIZE_WITHOUT_FOOT, -_MAX_LOG_SIZE)
    contrast = np.maximum(fit["contrast"] / expected.contrast[which], 1e-9)
    good = (covariance.max(axis=(1, 2)) < _MAX_SD_PX**2) & (off_m2 < _MAX_M2)
    fainter = np.where(without_foot, _MIN_LOG_CONTRAST_WITHOUT_FOOT, -_MAX_LOG_CONTRAST)
    good &= (size > least) & (size < _MAX_LOG_SIZE)
    good &= (np.log(contrast) > fainter) & (np.log(contrast) < _MAX_LOG_CONTRAST)
    good = np.flatnonzero(good)
    same = distances(centres(fit[good]), centres(fit[good])) < _SAME_PLACE * fit["radius_px"][good]
    good = good[same.sum(axis=1) == 1]  # each is at its own place
    good = good[_rim_is_seen(fit[good], initial, which[good])]
    return clear[good][_with_partners(expected, tried, which[good])]


def _rim_is_seen(fit: np.ndarray, initial: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Return (M,) bool: whether enough of the rim of each fitted bead, one of the beads `which` of `initial`, is seen.

    A fit that has moved until another shadow covers nearly all of its rim shows that shadow.
    """
    rows = initial.copy()
    rows[which] = fit
    share = hidden_share(distances(centres(fit), centres(rows)), fit["radius_px"][:, None], rows["radius_px"])
    share[np.arange(len(which)), which] = 0.0
    return np.asarray(share.max(axis=1, initial=0.0) < _MOST_RIM_HIDDEN)


def _with_partners(expected: _Expected, tried: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Return (M,) bool: whether the image also shows what hides much of each of the well fitted beads `good` (M,).

    It does if that is known, or well fitted too. `tried`: all that were fitted.
    """
    radius, known = expected.radius_px, expected.row >= 0
    known[tried] = False
    known[good] = True
    apart, own = distances(expected.uv_px[good], expected.uv_px), radius[good, None]
    needed = overlap_of(apart, own, radius) > _TOGETHER_OVERLAP
    needed &= hidden_share(apart, own, radius) > _TOGETHER_HIDDEN
    needed[np.arange(len(good)), good] = False
    return np.asarray(~(needed & ~known).any(axis=1))
