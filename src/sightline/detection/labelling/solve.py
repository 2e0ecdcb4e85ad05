"""Label two lattices: identify their plates, fit one central projection to both, check, or refuse."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import KDTree

from sightline.detection.labelling.checks import AttemptError, Stage, check, check_alone
from sightline.detection.labelling.growth import LOG_RADIUS, Grown, grow
from sightline.detection.labelling.joint import Joint, Model
from sightline.detection.labelling.naming import Naming, name, name_alone
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import Seed, best_similarity
from sightline.detection.results import Detections
from sightline.errors import ReconstructionRefusedError
from sightline.fitting.kernels import exact_squares
from sightline.fitting.robust import MAD_TO_SD, median, variance_ratio

MIN_BEADS = 8  # of each plate [ours]
MAX_NAMINGS = 4
MARGIN = 6.0  # smallest log odds against any other reading: one and a half misjudged sizes [ours]
GATE_M2 = 11.3  # squared Mahalanobis distance in place and radius: 99 %, 3 degrees of freedom [ours]
NEAR_M2 = 24.0  # detections or places as near as this can be confused with each other [ours]
LOG_RADIUS_SD = (0.01, 0.07)  # limits of the s.d. of a plate's log radii, estimated from their scatter [ours]
MAX_FALSE_ODDS = 7e-6  # that a bead is a false candidate in the place of a hidden one [ours]
FALSE_PER_LOG_RADIUS = 2.0  # density of false candidates over log radius, at the balls' size [ours]
NEIGHBOURS = 8
MAX_FITS, NOISE_FITS = 10, 3  # iterations, and those in which the noise is estimated
SAME_NOISE = 0.1  # relative change of the noise that needs no further fit [ours]
MAX_NOISE = 100.0  # times the stated variance [ours]; rendered images have up to 3.5; 1 would lose 7 % of the beads
NOT_CENTRAL = (
    "the beads found are not two plates seen from one focal point; is this the frame in the image, "
    "and did it keep still during the exposure?"
)


@dataclass(frozen=True, eq=False)
class LabellingProblem:
    """One image to label: its detections, which of them are `usable`, and the plates of each view, `couples`.

    `view`: the view that the caller gave, or None; its plates stand first in `couples`. `given`: the caller gave datum
    markers.
    """

    detections: Detections
    usable: np.ndarray
    couples: list[tuple[Pattern, Pattern]]
    view: str | None
    given: bool = False


@dataclass(frozen=True, eq=False)
class LabellingSolution:
    """A labelled view: detections `rows` are fiducials `ids`.

    `on_place` (N,) bool: detections that lie where a fiducial is expected.
    """

    view: str
    ids: tuple[str, ...]
    rows: np.ndarray
    mirrored: bool
    on_place: np.ndarray


def _again(problem: LabellingProblem, grown: Grown, pattern: Pattern, places: np.ndarray) -> Grown:
    """Return the lattice grown again as the plate that was identified."""
    rows, places = grown.all_rows[places >= 0], places[places >= 0]
    similarity = best_similarity(pattern.xy_mm[places], problem.detections.uv_px[rows])
    return grow(Seed(pattern, similarity, rows, places, 0.0), problem.detections, problem.usable)


def identified(problem: LabellingProblem, pair: tuple[Grown, Grown]) -> tuple[Grown, Grown]:
    """Return the two lattices with their plates identified, XRII first. Raises AttemptError."""
    for _ in range(MAX_NAMINGS):
        naming = name(pair, problem.couples)
        if naming is None:
            raise AttemptError(
                Stage.NAMES, "too few neighbouring beads were found to distinguish the plates; show more of both plates"
            )
        if naming.unchanged:
            _check_certain(problem, naming)
            return pair if pair[0].pattern.role == "xrii" else (pair[1], pair[0])
        if problem.given:
            raise AttemptError(
                Stage.FINAL, "the pixels given for the datum markers contradict the beads' sizes; check their order"
            )
        first, second = (
            _again(problem, g, p, at) for g, p, at in zip(pair, naming.patterns, naming.places, strict=True)
        )
        pair = (first, second)
    raise AttemptError(
        Stage.NAMES, "the beads found fit no single labelling of the frame's plates; is this the frame in the image?"
    )


def _check_certain(problem: LabellingProblem, naming: Naming) -> None:
    """Check that every other reading is clearly worse; given datums or view decide a tie. Raises AttemptError."""
    found = naming.patterns[0].view
    margin = naming.margin if problem.view is None else naming.margin_in_view
    if margin < MARGIN and not problem.given:
        raise AttemptError(
            Stage.UNIQUENESS,
            "the datum markers that can be seen fit more than one way to label the beads; show more of them, "
            "or give the datum markers' pixels",
        )
    if problem.view not in (None, found):
        raise AttemptError(
            Stage.FINAL, f"the image shows the {found} view, not {problem.view}; are the two images exchanged?"
        )


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Agreement of radii and places: `misfit` (N, P) of the log radius, `sd` (P,) of a bead's log radius."""

    misfit: np.ndarray
    sd: np.ndarray

    @property
    def m2(self) -> np.ndarray:
        """Squared misfit (N, P) in standard deviations."""
        return (self.misfit / self.sd) ** 2


def _sizes(pair: tuple[Grown, ...]) -> _Sizes:
    misfits, sds = [], []
    for g in pair:
        log_half = g.pattern.log_half
        own = g.log_ratio[g.rows] - log_half[g.places]
        middle = median(own)
        sd = np.clip(MAD_TO_SD * median(np.abs(own - middle)), *LOG_RADIUS_SD)
        misfits.append(g.log_ratio[:, None] - log_half - middle)
        sds.append(np.full(len(log_half), sd))
    return _Sizes(np.concatenate(misfits, axis=1), np.concatenate(sds))


@njit(cache=True, error_model="numpy")
def _match(xy, variance, target, size_m2, usable):
    """Return the place (N,) of each usable detection within the gate, or -1 where there is none or several."""
    on, rivals = np.empty(len(xy), np.int64), np.empty(len(target), np.int64)
    for p in range(len(target)):
        rivals[p] = 0
    for n in range(len(xy)):
        on[n], near = -1, 0
        for p in range(len(target) if usable[n] else 0):
            m2 = ((xy[n, 0] - target[p, 0]) ** 2 + (xy[n, 1] - target[p, 1]) ** 2) / variance[n]
            if m2 < NEAR_M2 and m2 + size_m2[n, p] < NEAR_M2:
                near += 1
                rivals[p] += 1
                if m2 + size_m2[n, p] < GATE_M2:
                    on[n] = p
        if near > 1:
            on[n] = -1
    for n in range(len(xy)):
        if on[n] >= 0 and rivals[on[n]] > 1:
            on[n] = -1
    return on


def _beads(on: np.ndarray) -> np.ndarray:
    """Return pairs (B, 2) of detection and place from the place (N,) of each detection, or -1."""
    rows = np.flatnonzero(on >= 0)
    return np.stack([rows, on[rows]], axis=1)


def _certain(problem: LabellingProblem, fit: Joint, sizes: _Sizes, beads: np.ndarray, px_per_mm: float) -> np.ndarray:
    """Return (B,) bool: beads that are very unlikely to be false candidates in the places of hidden beads.

    Such a candidate looks like the bead, so only its odds can be limited. They are the odds that the place is empty
    (from the empty ones among the NEIGHBOURS nearest places), times the density of false candidates in position and log
    radius, over the density of the bead's own image at this distance from its prediction.
    """
    rows, places = beads.T
    empty = np.ones(len(fit.target_mm))
    empty[places] = 0.0
    nearest = KDTree(fit.target_mm).query(fit.target_mm[places], k=NEIGHBOURS + 1)[1]
    hidden = (empty[nearest].sum(axis=1) + 1) / (NEIGHBOURS + 2)
    height, width = problem.detections.image_shape
    false_per_px2 = FALSE_PER_LOG_RADIUS * (1 + problem.usable.sum() - len(beads)) / (height * width)
    volume_px2 = (2 * np.pi) ** 1.5 * fit.variance_mm2[rows] * px_per_mm**2 * sizes.sd[places]
    off2 = ((fit.xy_mm[rows] - fit.target_mm[places]) ** 2).sum(axis=1)
    m2 = off2 / fit.variance_mm2[rows] + sizes.m2[rows, places]
    return hidden / (1 - hidden) * false_per_px2 * volume_px2 * np.exp(m2 / 2) < MAX_FALSE_ODDS


def _fitted(
    problem: LabellingProblem, model: Model, pair: tuple[Grown, Grown], sizes: _Sizes
) -> tuple[np.ndarray, Joint]:
    """Return the beads that fit one central projection, and the fit. Raises AttemptError."""
    try:
        focal_mm = model.first_focal_point(*pair)
    except ReconstructionRefusedError:
        raise AttemptError(Stage.PROJECTION, NOT_CENTRAL) from None
    if not model.shadows.sees(focal_mm):
        raise AttemptError(Stage.PROJECTION, NOT_CENTRAL)
    return _matched(problem, model, pair, sizes, focal_mm)


def _fewest(pair: tuple[Grown, ...], beads: np.ndarray) -> int:
    """Return the smaller number of beads of one plate among `beads` (B, 2) of detection and place."""
    of_first = int((beads[:, 1] < len(pair[0].pattern.ids)).sum())
    return of_first if len(pair) == 1 else min(of_first, len(beads) - of_first)


def _matched(
    problem: LabellingProblem, model: Model, pair: tuple[Grown, ...], sizes: _Sizes, focal_mm: np.ndarray
) -> tuple[np.ndarray, Joint]:
    """Return the beads that fit, from a focal point, and the fit. Raises AttemptError."""
    size_m2 = sizes.m2
    on = np.full(len(problem.detections), -1)
    for k, grown in reversed(list(enumerate(pair))):
        on[grown.rows] = grown.places + k * len(pair[0].pattern.ids)
    beads = _beads(on)
    fit, factor = model.fit(beads, focal_mm, 1.0), 1.0
    for iteration in range(MAX_FITS):
        before = factor
        if iteration < NOISE_FITS:  # later, gating has cut off the tails, and the noise would be underestimated
            factor = float(np.clip(factor * variance_ratio(fit.m2), 1.0, MAX_NOISE))
        variance_mm2 = fit.variance_mm2 * (factor / before)
        new = _match(fit.xy_mm, variance_mm2, fit.target_mm, size_m2, problem.usable)
        if iteration >= NOISE_FITS:  # from here beads are only removed, so the loop terminates
            new[new != on] = -1
        if iteration and (new == on).all() and abs(factor - before) < SAME_NOISE * before:
            return beads, fit
        beads, on = _beads(new), new
        if _fewest(pair, beads) < MIN_BEADS or not model.shadows.sees(fit.focal_point_mm):
            break
        fit = model.fit(beads, fit.focal_point_mm, factor)
    raise AttemptError(Stage.PROJECTION, NOT_CENTRAL)


def solve(problem: LabellingProblem, pair: tuple[Grown, Grown]) -> LabellingSolution:
    """Return the labels of two lattices. Raises AttemptError."""
    pair = identified(problem, pair)
    sizes = _sizes(pair)
    model = Model(pair, problem.detections)
    beads, fit = _fitted(problem, model, pair, sizes)
    beads = beads[_certain(problem, fit, sizes, beads, pair[0].sheet.similarity.scale)]
    xrii, source = pair[0].pattern, pair[1].pattern
    if _fewest(pair, beads) < MIN_BEADS:
        raise AttemptError(
            Stage.PROJECTION,
            "too few beads can be distinguished from false candidates; show more of both plates, or expose longer",
        )
    misfit = np.split(np.abs(sizes.misfit), [len(xrii.ids)], axis=1)
    ball_like = np.stack([problem.usable & (one.min(axis=1) < LOG_RADIUS) for one in misfit], axis=1)
    check(model, fit, beads, pair, ball_like)
    ids = xrii.ids + source.ids
    normal_along_beam = model.shadows.height_mm.mean() < 0
    mirrored = pair[0].sheet.similarity.mirror == normal_along_beam
    on_place = exact_squares(fit.xy_mm, fit.target_mm).min(axis=1) / fit.variance_mm2 < NEAR_M2
    return LabellingSolution(xrii.view, tuple(ids[p] for p in beads[:, 1]), beads[:, 0], bool(mirrored), on_place)


def solve_alone(problem: LabellingProblem, grown: Grown) -> tuple[np.ndarray, Joint]:
    """Return the beads (B, 2), detection and place, of a plate alone, and their fit. Raises AttemptError."""
    for _ in range(MAX_NAMINGS):
        naming = name_alone(grown)
        if naming is None or naming.margin < MARGIN:
            raise AttemptError(
                Stage.UNIQUENESS,
                "the datum markers that can be seen fit more than one way to label the plate on the detector; show "
                "more of them",
            )
        if naming.unchanged:
            break
        grown = _again(problem, grown, grown.pattern, naming.places[0])
    else:
        raise AttemptError(Stage.NAMES, "the beads found fit no labelling of the plate on the detector")
    sizes, model = _sizes((grown,)), Model((grown,), problem.detections)
    beads, fit = _matched(problem, model, (grown,), sizes, np.zeros(3))
    beads = beads[_certain(problem, fit, sizes, beads, grown.sheet.similarity.scale)]
    check_alone(model, fit, beads, grown)
    return beads, fit
