"""Label two lattices: identify their plates, fit one central projection to both, check, or refuse."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from sightline.common.fitting import MAD_TO_SD, exact_squares, median
from sightline.detection.labelling.growth import LOG_RADIUS, Grown, grow
from sightline.detection.labelling.joint import MIN_BEADS, NEAR_M2, Joint, Model, empty_near
from sightline.detection.labelling.naming import CONTRADICTION, Naming, name, name_alone
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import Seed, best_similarity
from sightline.detection.results import Detections

MAX_SCATTER = 0.02  # [ours] of the pitch, rms of beads about their places, 2 px as designed: wrong labels scatter more
MAX_BEND = 4.5  # [ours] s.d. of the prior that a map may need: wrong labels bend it more than any tube
# Largest log ratio of apparent and stated ball size: -0.02 to 0.03 in 108 images of the twin. Another machine's blur
# gives larger errors, and confusing 3 mm with 1/8 inch balls does no harm (0.06) [twin]
BALL_LOG_SIZE = 0.15
SIZES_WRONG = 2  # tolerated wrong sizes per plate: of 113 balls 2 % are misjudged [twin]
BEYOND_M2, MAX_BEYOND = 9.2, 1  # 99 % of chi-square; by chance, 1 of 90 scenes has one ball there, none has two [twin]
MIN_EXPLAINED = 0.6  # [ours] share of the ball-like detections that must be beads: with fewer, the frame is another one
# Where a focal point may be [ours]: its distance from the XRII plate, 920 mm as designed, and the tangent of its beam's
# angle to the plates' normal, from a tilt of 20° and an off-centre field. Elsewhere the labels are wrong.
FOCAL_MM = (300.0, 2000.0)
FOCAL_SLOPE = 0.45


class Stage(IntEnum):
    """The stage at which an attempt to label an image failed, in the order of the steps."""

    SEEDS = 0  # finding three datum markers
    LATTICES = 1  # finding a second lattice of beads
    NAMES = 2  # naming the plates of the lattices
    UNIQUENESS = 3  # excluding every other labelling
    PROJECTION = 4  # fitting one central projection to both plates
    CHECKS = 5  # checking the fit
    FINAL = 6  # the beads are explained but contradict the geometry: no other attempt is made


class AttemptError(Exception):
    """An attempt to label an image failed, with its stage; the message of the furthest attempt is reported."""

    def __init__(self, stage: Stage, message: str) -> None:
        super().__init__(message)
        self.stage = stage


def check(model: Model, fit: Joint, beads: np.ndarray, pair: tuple[Grown, Grown], ball_like: np.ndarray) -> None:
    """Check the labels of `beads` (B, 2): detection and place. Raises AttemptError.

    `ball_like` (N, 2): whether each detection looks like a bead of the XRII plate, and of the source plate.
    """
    left = ball_like.copy()
    left[beads[:, 0]] = False
    _check_map(model, fit, beads)
    spots = int(ball_like.any(axis=1).sum())
    if len(beads) < MIN_EXPLAINED * spots:
        raise AttemptError(
            Stage.CHECKS,
            f"only {100 * len(beads) / spots:.0f} % of the bead-like spots lie on the frame's places; "
            "check the frame file, or give the datum markers' pixels",
        )
    _check_edge(model, fit, pair, left)
    _check_pattern(pair)
    _check_ball_size(fit, pair)
    _check_focal_point(model, fit, beads)


def _check_map(model: Model, fit: Joint, beads: np.ndarray) -> None:
    """Check that the beads lie at their places, by a map that an intensifier can have."""
    off = fit.xy_mm[beads[:, 0]] - fit.target_mm[beads[:, 1]]
    scatter = float(np.sqrt((off**2).mean()))
    if scatter > MAX_SCATTER * model.xrii.pitch_mm:
        raise AttemptError(
            Stage.CHECKS,
            f"the beads miss their places on the {model.xrii.role_name} plate by {scatter:.2f} mm; check the frame "
            "file",
        )
    if fit.bend > MAX_BEND:
        raise AttemptError(
            Stage.CHECKS, "the labels would need a distortion that no intensifier has; is this the frame in the image?"
        )


def _check_edge(model: Model, fit: Joint, pair: tuple[Grown, Grown], left: np.ndarray) -> None:
    """Check for beads beyond a plate's edge, which show that all labels are shifted by one step of the grid."""
    for plate, own in zip(pair, left.T, strict=True):
        if not own.any():
            continue
        beyond = model.shadows.of_points(plate.pattern.beyond_mm, fit.focal_point_mm)
        off2 = exact_squares(fit.xy_mm[own], beyond) / fit.variance_mm2[own][:, None]
        seen = int((off2 < BEYOND_M2).any(axis=1).sum())
        if seen > MAX_BEYOND:
            raise AttemptError(
                Stage.CHECKS,
                f"{seen} balls are seen beyond the edge of the {plate.pattern.role_name} plate, where its grid would "
                "go on: the labels may be shifted; show more of its datum markers, or give their pixels",
            )


def _check_pattern(pair: tuple[Grown, ...]) -> None:
    """Check the datum markers of each plate: a shifted grid still fits, its pattern of datum markers does not."""
    for plate in pair:
        pattern = plate.pattern
        seen = np.abs(plate.log_ratio[plate.all_rows][:, None] - pattern.log_sizes).argmin(axis=1)
        stated = pattern.size_of[plate.all_places]
        agree = int((pattern.datum[plate.all_places] & (seen == stated)).sum())
        contradict = int((seen != stated).sum())
        if contradict > max(SIZES_WRONG, agree):
            raise AttemptError(
                Stage.FINAL,
                f"the sizes of {contradict} balls contradict the pattern of datum markers of the {pattern.role_name} "
                f"plate and those of {agree} agree; this is another frame than the file describes",
            )


def _check_ball_size(fit: Joint, pair: tuple[Grown, Grown]) -> None:
    """Check the size of each plate's balls against the plate's own grid.

    A tilt shortens the grid by its cosine in one direction, but not the balls.
    """
    for plate in pair:
        pattern = plate.pattern
        ray = fit.focal_point_mm - pattern.xyz_mm[plate.places].mean(axis=0)
        cosine = abs(float(ray @ pattern.plane.normal)) / float(np.linalg.norm(ray))
        larger = plate.level + np.log(cosine) / 2
        if abs(larger) > BALL_LOG_SIZE:
            says = float(np.median(pattern.diameter_mm))
            raise AttemptError(
                Stage.FINAL,
                f"the balls of the {pattern.role_name} plate look {says * np.exp(larger):.2f} mm large, and the "
                f"frame says {says:.2f} mm; is this the frame in the image?",
            )


def _check_focal_point(model: Model, fit: Joint, beads: np.ndarray) -> None:
    """Check that a C-arm can have the focal point there, beyond the source plate."""
    away = model.xrii.plane.normal * model.shadows.side
    ray = fit.focal_point_mm - model.xrii.plane.to_space(fit.target_mm[beads[:, 1]].mean(axis=0))
    far = float(ray @ away)
    aside = float(np.linalg.norm(ray - far * away))
    if not FOCAL_MM[0] < far < FOCAL_MM[1] or aside > FOCAL_SLOPE * far:
        raise AttemptError(
            Stage.FINAL,
            f"the labels put the focal point {far:.0f} mm from the XRII plate and {aside:.0f} mm aside, where no C-arm "
            "has it; check that the frame file describes the frame in the image",
        )


MAX_NAMINGS = 4
MARGIN = 1.5 * CONTRADICTION  # [ours] smallest log odds against any other reading: one misjudged size does not decide
LOG_RADIUS_SD = (0.01, 0.07)  # [ours] limits of the s.d. of a plate's log radii, which few radii estimate badly
# Largest odds that a bead is a false candidate in the place of a hidden one: of 100 beads, once in 1400 images. Density
# of false candidates over log radius: as if all had the balls' size, ±25 % [ours].
MAX_FALSE_ODDS, FALSE_PER_LOG_RADIUS = 7e-6, 2.0
NEIGHBOURS = 8
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
        if naming.places is None:
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
    view = naming.patterns[0].view
    margin = naming.margin if problem.view is None else naming.margin_in_view
    if margin < MARGIN and not problem.given:
        raise AttemptError(
            Stage.UNIQUENESS,
            "the datum markers that can be seen fit more than one way to label the beads; show more of them, "
            "or give the datum markers' pixels",
        )
    if problem.view not in (None, view):
        raise AttemptError(
            Stage.FINAL, f"the image shows the {view} view, not {problem.view}; are the two images exchanged?"
        )


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Agreement of the detections' radii with the places of each plate.

    `m2` (N, P): squared misfit of the log radius over `sd` (P,), the s.d. of a bead's log radius. `alike` (N, plates):
    whether a detection is usable and as large as some ball of the plate.
    """

    m2: np.ndarray
    sd: np.ndarray
    alike: np.ndarray


def _sizes(pair: tuple[Grown, ...], usable: np.ndarray) -> _Sizes:
    count = sum(len(g.pattern.ids) for g in pair)
    m2, sds = np.empty((len(usable), count)), np.empty(count)
    alike, first = np.empty((len(usable), len(pair)), dtype=bool), 0
    for k, g in enumerate(pair):
        own, end = g.log_ratio[g.rows] - g.pattern.log_half[g.places], first + len(g.pattern.ids)
        middle = median(own)
        sds[first:end] = sd = min(max(MAD_TO_SD * median(np.abs(own - middle)), LOG_RADIUS_SD[0]), LOG_RADIUS_SD[1])
        misfit = (g.log_ratio - middle)[:, None] - g.pattern.log_sizes
        alike[:, k] = usable & (np.abs(misfit).min(axis=1) < LOG_RADIUS)
        m2[:, first:end] = ((misfit / sd) ** 2).take(g.pattern.size_of, axis=1)
        first = end
    return _Sizes(m2, sds, alike)


def _certain(problem: LabellingProblem, fit: Joint, sizes: _Sizes, px_per_mm: float) -> np.ndarray:
    """Return (B,) bool: the fit's beads that are very unlikely to be false candidates in the places of hidden beads.

    Such a candidate looks like the bead, so only its odds can be limited. They are the odds that the place is empty
    (from the empty ones among the NEIGHBOURS nearest places), times the density of false candidates in position and log
    radius, over the density of the bead's own image at this distance from its prediction.
    """
    rows, places = fit.beads.T
    hidden = empty_near(fit.target_mm, places, NEIGHBOURS)
    height, width = problem.detections.image_shape
    false_per_px2 = FALSE_PER_LOG_RADIUS * (1 + problem.usable.sum() - len(rows)) / (height * width)
    (x, y), variance_mm2 = (fit.xy_mm[rows] - fit.target_mm[places]).T, fit.variance_mm2[rows]
    volume_px2 = (2 * np.pi) ** 1.5 * variance_mm2 * px_per_mm**2 * sizes.sd[places]
    m2 = (x * x + y * y) / variance_mm2 + sizes.m2[rows, places]
    return hidden / (1 - hidden) * false_per_px2 * volume_px2 * np.exp(m2 / 2) < MAX_FALSE_ODDS


def _fitted(problem: LabellingProblem, model: Model, pair: tuple[Grown, ...], size_m2: np.ndarray) -> Joint:
    """Return the fit of one central projection to the beads that it explains. Raises AttemptError."""
    on = np.full(len(problem.detections), -1)
    for k, grown in reversed(list(enumerate(pair))):
        on[grown.rows] = grown.places + k * len(pair[0].pattern.ids)
    fit = model.settled(on, size_m2, problem.usable)
    if fit is None:
        raise AttemptError(Stage.PROJECTION, NOT_CENTRAL)
    return fit


def solve(problem: LabellingProblem, pair: tuple[Grown, Grown]) -> LabellingSolution:
    """Return the labels of two lattices. Raises AttemptError."""
    pair = identified(problem, pair)
    sizes = _sizes(pair, problem.usable)
    model = Model(pair, problem.detections)
    fit = _fitted(problem, model, pair, sizes.m2)
    beads = fit.beads[_certain(problem, fit, sizes, pair[0].sheet.similarity.scale)]
    xrii, source = pair[0].pattern, pair[1].pattern
    on_xrii = int((beads[:, 1] < len(xrii.ids)).sum())
    if min(on_xrii, len(beads) - on_xrii) < MIN_BEADS:
        raise AttemptError(
            Stage.PROJECTION,
            "too few beads can be distinguished from false candidates; show more of both plates, or expose longer",
        )
    check(model, fit, beads, pair, sizes.alike)
    ids = xrii.ids + source.ids
    normal_along_beam = model.shadows.side < 0
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
        if naming.places is None:
            break
        grown = _again(problem, grown, grown.pattern, naming.places[0])
    else:
        raise AttemptError(Stage.NAMES, "the beads found fit no labelling of the plate on the detector")
    sizes, model = _sizes((grown,), problem.usable), Model((grown,), problem.detections)
    fit = _fitted(problem, model, (grown,), sizes.m2)
    beads = fit.beads[_certain(problem, fit, sizes, grown.sheet.similarity.scale)]
    _check_map(model, fit, beads)
    _check_pattern((grown,))
    return beads, fit
