"""From two lattices to labelled beads: name them, fit both plates as one central projection, check, or refuse."""

from dataclasses import dataclass

import numpy as np

from sightline.detection.labelling.growth import Grown, grow
from sightline.detection.labelling.joint import Joint, Model
from sightline.detection.labelling.naming import Naming, name
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import Seed, best_similarity
from sightline.detection.results import Detections
from sightline.errors import LabellingRefusedError, ReconstructionRefusedError

LEAST_BEADS = 8  # of each plate [ours]
MOST_NAMINGS = 4
MARGIN = 6.0  # log odds by which any other reading must cost more: one and a half misjudged sizes [ours]
GATE_M2 = 11.3  # squared distance of a bead from its place and its radius: 99 %, 3 degrees of freedom [ours]
NEAR_M2 = 24.0  # two detections or places as near as this are mistaken for each other [ours]
MEDIAN_M2 = 1.386  # of chi-squared with 2 degrees of freedom
LOG_RADIUS_SD = (0.02, 0.07)  # of a plate's beads, from their scatter, within these limits [ours]
ACCIDENT = 1e-4  # most chance that a false candidate falls into the gate of one hidden bead [ours]
BALL_LIKE = 0.15  # share of false candidates that have the radius of a given bead [ours]
BEND = 4.5  # most standard deviations of the prior that a map may need [ours]
MOST_FITS, SETTLED = 10, 3  # rounds, and rounds after which the noise is no longer estimated
WORST_SD = 0.02  # of the pitch: the scatter of the beads about their places; 2 px at the design distance [ours]
MOST_NOISE = 100.0  # times the stated variance [ours]
PLATE_LOG_RADIUS = 0.075  # by which the two plates' radii may differ, seen through one map [ours]
FOCAL_MM = (300.0, 2000.0)  # of the focal point from the XRII plate; 920 mm at the design distance [ours]
FOCAL_SLOPE = 0.7  # tangent of the beam's angle to the plates: 35° [ours]
EXPLAINED = 0.6  # least share of the ball-like detections that must be beads of the frame [ours]
FINAL = 6
NOT_CENTRAL = (
    "the beads found are not two plates seen from one focal point; is this the frame in the image, "
    "and did it keep still during the exposure?"
)


class Stop(LabellingRefusedError):  # noqa: N818 - the attempt stops, labelling may go on
    """A refusal, with how far the attempt had come: the refusal of the furthest attempt is the one reported.

    At FINAL the beads are explained and the geometry contradicts them: no other attempt is made.
    """

    def __init__(self, stage: int, message: str) -> None:
        super().__init__(message)
        self.stage = stage


@dataclass(frozen=True, eq=False)
class Problem:
    """One image to label: which detections are `usable`, the plates of each view, and what the person said.

    `view`: the view as given, or None; its plates stand first in `couples`. `told`: the person named the lattices.
    """

    detections: Detections
    usable: np.ndarray
    couples: list[tuple[Pattern, Pattern]]
    view: str | None
    told: bool = False


@dataclass(frozen=True, eq=False)
class Solution:
    """A labelled view: detections `rows` are fiducials `ids`."""

    view: str
    ids: tuple[str, ...]
    rows: np.ndarray
    mirrored: bool


def _again(problem: Problem, grown: Grown, pattern: Pattern, places: np.ndarray) -> Grown:
    """The lattice grown once more under the name that was found for it."""
    rows, places = grown.all_rows[places >= 0], places[places >= 0]
    similarity = best_similarity(pattern.xy_mm[places], problem.detections.uv_px[rows])
    return grow(Seed(pattern, similarity, rows, places, 0.0), problem.detections, problem.usable)


def named(problem: Problem, pair: tuple[Grown, Grown]) -> tuple[Grown, Grown]:
    """The two lattices under the one name they can have, XRII first. Raises Stop."""
    for _ in range(MOST_NAMINGS):
        naming = name(pair, problem.couples)
        if naming is None:
            raise Stop(2, "too few neighbouring beads were found to tell the plates apart; show more of both plates")
        if naming.unchanged:
            _check_certain(problem, naming)
            return pair if pair[0].pattern.role == "xrii" else (pair[1], pair[0])
        if problem.told:
            raise Stop(FINAL, "the pixels given for the datum markers contradict the beads' sizes; check their order")
        first, second = (
            _again(problem, g, p, at) for g, p, at in zip(pair, naming.patterns, naming.places, strict=True)
        )
        pair = (first, second)
    raise Stop(2, "the beads found fit no one reading of the frame's plates; is this the frame in the image?")


def _check_certain(problem: Problem, naming: Naming) -> None:
    """Is any other reading clearly worse? A person's word for datums or view decides a tie. Raises Stop."""
    found = naming.patterns[0].view
    margin = naming.margin if problem.view is None else naming.margin_in_view
    if margin < MARGIN and not problem.told:
        raise Stop(
            3,
            "the datum markers that can be seen fit more than one way to label the beads; show more of them, "
            "or give the datum markers' pixels",
        )
    if problem.view not in (None, found):
        raise Stop(FINAL, f"the image shows the {found} view, not {problem.view}; are the two images exchanged?")


def _radius_m2(pair: tuple[Grown, Grown]) -> np.ndarray:
    """(N, P): squared misfit of each detection's log radius with each place, in standard deviations."""
    out = []
    for g in pair:
        log_half = np.log(g.pattern.diameter_mm / 2)
        own = g.log_ratio[g.rows] - log_half[g.places]
        middle = np.median(own)
        sd = np.clip(1.4826 * np.median(np.abs(own - middle)), *LOG_RADIUS_SD)
        out.append(((g.log_ratio[:, None] - log_half - middle) / sd) ** 2)
    return np.concatenate(out, axis=1)


def _assigned(problem: Problem, fit: Joint, radius_m2: np.ndarray, px_per_mm: float) -> np.ndarray:
    """(B, 2) detections on places: within the gates, and alone there: where two might be meant, none is.

    A false candidate in the gate of a hidden bead cannot be told from the bead: where the gate is so wide that this
    is likelier than ACCIDENT, as it is where a place lies far from all beads found, none is taken.
    """
    m2 = ((fit.xy_mm[:, None] - fit.target_mm) ** 2).sum(axis=2) / fit.variance_mm2[:, None] + radius_m2
    near = (m2 < NEAR_M2) & problem.usable[:, None]
    alone = near & (near.sum(axis=0) == 1) & (near.sum(axis=1) == 1)[:, None]
    height, width = problem.detections.image_shape
    unexplained = 1 + problem.usable.sum() - (m2.min(axis=1) < GATE_M2).sum()
    accident = np.pi * GATE_M2 * fit.variance_mm2 * px_per_mm**2 * BALL_LIKE * unexplained / (height * width)
    return np.argwhere(alone & (m2 < GATE_M2) & (accident < ACCIDENT)[:, None])


def _fitted(
    problem: Problem, model: Model, pair: tuple[Grown, Grown], radius_m2: np.ndarray
) -> tuple[np.ndarray, Joint]:
    """The beads that fit one central projection, and the fit. Raises Stop."""
    count, scale = len(pair[0].pattern.ids), pair[0].sheet.similarity.scale
    xrii, source = (np.stack([g.rows, g.places], axis=1) for g in pair)
    source = source[~np.isin(source[:, 0], xrii[:, 0])] + [0, count]
    beads = np.concatenate([xrii, source])
    try:
        focal_mm = model.first_focal_point(*pair)
    except ReconstructionRefusedError:
        raise Stop(4, NOT_CENTRAL) from None
    if not model.shadows.sees(focal_mm):
        raise Stop(4, NOT_CENTRAL)
    fit, factor = model.fit(beads, focal_mm, 1.0), 1.0
    for turn in range(MOST_FITS):
        if turn < SETTLED:  # later the gates have cut the tails off, and the noise would seem to shrink
            factor = float(np.clip(factor * np.median(fit.m2) / MEDIAN_M2, 1.0, MOST_NOISE))
        new = _assigned(problem, fit, radius_m2, scale)
        if turn >= MOST_FITS // 2:  # from here on only fewer, so that it ends
            new = np.array([b for b in new.tolist() if b in beads.tolist()]).reshape(-1, 2)
        enough = min((new[:, 1] < count).sum(), (new[:, 1] >= count).sum()) >= LEAST_BEADS
        if not enough or not model.shadows.sees(fit.focal_point_mm):
            break
        fit = model.fit(new, fit.focal_point_mm, factor)
        if len(new) == len(beads) and (new[np.lexsort(new.T)] == beads[np.lexsort(beads.T)]).all():
            return new, fit
        beads = new
    raise Stop(4, NOT_CENTRAL)


def _check_map(model: Model, fit: Joint, beads: np.ndarray) -> None:
    """Do the beads lie in their places, by a map that an intensifier has? Raises Stop."""
    off = fit.xy_mm[beads[:, 0]] - fit.target_mm[beads[:, 1]]
    scatter = float(np.sqrt((off**2).mean()))
    if scatter > WORST_SD * model.xrii.pitch_mm:
        raise Stop(5, f"the beads miss their places on the XRII plate by {scatter:.2f} mm; check the frame file")
    if fit.bend > BEND:
        raise Stop(5, "the labels would need a distortion that no intensifier has; is this the frame in the image?")


def _check_focal_point(model: Model, fit: Joint, beads: np.ndarray) -> None:
    """Is the focal point where a C-arm can have it, beyond the source plate? Raises Stop."""
    shadows = model.shadows
    away = shadows.normal * np.sign(shadows.height_mm.mean())
    ray = fit.focal_point_mm - model.xrii.plane.to_space(fit.target_mm[beads[:, 1]].mean(axis=0))
    far = float(ray @ away)
    aside = float(np.linalg.norm(ray - far * away))
    if not FOCAL_MM[0] < far < FOCAL_MM[1] or aside > FOCAL_SLOPE * far:
        raise Stop(
            FINAL,
            f"the labels put the focal point {far:.0f} mm from the XRII plate and {aside:.0f} mm aside, where no C-arm "
            "has it; check that the frame file describes the frame in the image",
        )


def _check_explained(beads: np.ndarray, sized: int) -> None:
    """Are most detections that look like beads explained? Raises Stop."""
    if len(beads) < EXPLAINED * sized:
        raise Stop(
            5,
            f"only {100 * len(beads) / sized:.0f} % of what looks like the frame's beads is on one of its places; "
            "check the frame file, or give the datum markers' pixels",
        )


def _check_radii(pair: tuple[Grown, Grown]) -> None:
    """Have the beads of both plates their diameters, seen through one map? Raises Stop."""
    if abs(pair[0].level - pair[1].level) > PLATE_LOG_RADIUS:
        raise Stop(FINAL, "the two plates' bead radii do not fit their diameters; is this the frame in the image?")


def solve(problem: Problem, pair: tuple[Grown, Grown]) -> Solution:
    """Label two lattices. Raises Stop."""
    pair = named(problem, pair)
    radius_m2 = _radius_m2(pair)
    model = Model(pair, problem.detections)
    beads, fit = _fitted(problem, model, pair, radius_m2)
    _check_map(model, fit, beads)
    _check_explained(beads, int((problem.usable & (radius_m2.min(axis=1) < GATE_M2)).sum()))
    _check_radii(pair)
    _check_focal_point(model, fit, beads)
    xrii, source = pair[0].pattern, pair[1].pattern
    ids = xrii.ids + source.ids
    normal_along_beam = model.shadows.height_mm.mean() < 0
    mirrored = pair[0].sheet.similarity.mirror == normal_along_beam
    return Solution(xrii.view, tuple(ids[p] for p in beads[:, 1]), beads[:, 0], bool(mirrored))
