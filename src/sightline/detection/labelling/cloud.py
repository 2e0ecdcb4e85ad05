"""`label_cloud`: assign detections to the balls of a solid by geometry alone, or refuse."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.detection.labelling.cloud_match import Labelling, converge
from sightline.detection.labelling.cloud_search import Problem, Search, promising
from sightline.detection.labelling.growth import grow
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import find_seeds
from sightline.detection.labelling.solve import AttemptError, LabellingProblem, Stage, solve_alone
from sightline.detection.results import Detections
from sightline.errors import LabellingRefusedError, UnusableInputError
from sightline.frame.solid_shape import in_words

MIN_MATCHED = 6  # balls: twelve coordinates for nine unknowns of a camera
MAX_BALL_SD_MM = 0.5  # of a coordinate: of 80 scenes none was labelled wrongly with 0.5 mm, one with 1 mm [calc]
MAX_CHANCE = 1e-6  # of a match by chance, and of the second-best labelling
# Triples of balls tried, 1 to 5 s, and on detections left over after a match; triples that look for other labellings,
# of up to MANY detections and of more. More take longer than a person waits [ours].
FIRST, LEFT_OVER = 5e6, 2e5
BASES, MANY, MANY_BASES = 6, 40, 4
CLEAR = 0.6  # [ours] share of balls with a detection in their gate from which a hypothesis is fitted before all others
KEPT, FITTED = 8, 2  # hypotheses kept and fitted of a chunk of triples
MISSED = 0.25  # share of matched detections, at least 3, that another labelling may lack
MAX_OTHERS = 6  # other labellings compared
SAME_TURN = np.cos(np.radians(5))  # [ours] of two hypotheses that converge to the same labelling, which saves a fit


@dataclass(frozen=True, eq=False)
class CloudMatch:
    """Balls labelled in one image: detection `rows[i]` shows ball `balls[i]`.

    `T_camera_cloud` takes the balls' coordinates to the camera's: origin in the focal point, x to the right, y down, z
    along the beam. `focal_px`; `principal_px` (2,). If `mirrored`, the camera belongs to the mirror image (u becomes
    W - 1 - u). `rms_sd`: of the residuals in standard deviations, 1 where the
    stated errors hold. `chance`: upper bound of the expected number of labellings as good among false detections.
    `second`: odds for the second-best labelling, 0 where none was found. `unclear`: rows that may show two balls, or
    one of two that may show the same ball.
    """

    rows: np.ndarray
    balls: np.ndarray
    T_camera_cloud: RigidTransform
    focal_px: float
    principal_px: np.ndarray
    mirrored: bool
    rms_sd: float
    chance: float
    second: float
    unclear: np.ndarray


def label_cloud(
    detections: Detections,
    xyz_mm: np.ndarray,
    diameter_mm: np.ndarray,
    focal_px: tuple[float, float],
    ball_sd_mm: float = 0.05,
) -> CloudMatch:
    """Return which detections show which balls of a solid, by geometry alone.

    The image is that of a pinhole camera with square pixels in any pose, or its mirror image; its focal length lies
    between the two of `focal_px` (95 %), its principal point near the image's middle. `xyz_mm` (M, 3), M from 6 to 200;
    `diameter_mm` (M,); `ball_sd_mm`: error of each coordinate. The chance of a match is computed for false detections
    spread evenly over the image.
    Raises LabellingRefusedError where the labels are not certain; UnusableInputError for fewer than six balls and for
    balls known too roughly.
    """
    if len(xyz_mm) < MIN_MATCHED:
        raise UnusableInputError(f"a solid of {len(xyz_mm)} balls cannot be labelled; give it {MIN_MATCHED} or more")
    if ball_sd_mm > MAX_BALL_SD_MM:
        raise UnusableInputError(
            f"balls known to {ball_sd_mm:g} mm cannot be labelled by geometry; measure them to {MAX_BALL_SD_MM:g} mm"
        )
    usable = np.array([kind != "hole" for kind in detections.kind], dtype=bool) & (detections.radius_px > 0)
    rows = np.flatnonzero(usable)
    if len(rows) < MIN_MATCHED:
        raise LabellingRefusedError(
            f"{len(rows)} beads were found, and {MIN_MATCHED} of the solid are needed; check that it is in the field "
            "and the exposure is not too low or too high"
        )
    problem = Problem.of(detections, rows, xyz_mm, diameter_mm, focal_px, ball_sd_mm)
    best, second = _unique(problem, _found(problem))
    _check_alone(problem, best)
    camera = best.fit.camera
    return CloudMatch(
        rows=rows[best.rows],
        balls=best.balls,
        T_camera_cloud=best.T_camera_cloud,
        focal_px=float(np.exp(camera.numbers[3])),
        principal_px=camera.numbers[4:],
        mirrored=best.mirrored,
        rms_sd=float(np.sqrt(best.fit.chi2 / (2 * len(best.rows) - 6))),
        chance=float(np.exp(-best.evidence)),
        second=second,
        unclear=rows[best.unclear],
    )


def _found(problem: Problem) -> Labelling:
    """Return a labelling that chance excludes. Raises LabellingRefusedError."""
    best = _first(problem, FIRST)
    if best is None:
        raise LabellingRefusedError(
            f"no {MIN_MATCHED} of the {len(problem.uv_px)} beads found lie as balls of this solid can; check that the "
            "frame file is that of the solid in the image, and show more of its balls"
        )
    if not _is_certain(best):
        chance = min(1.0, np.exp(-best.evidence))
        raise LabellingRefusedError(
            f"the best match has {len(best.rows)} balls of the solid and a probability of {chance:.1g} to be chance; "
            f"{MIN_MATCHED} balls and {MAX_CHANCE:g} are needed: show more of its balls, and fewer other round objects"
        )
    return best


def _is_certain(labelling: Labelling) -> bool:
    return len(labelling.rows) >= MIN_MATCHED and labelling.evidence > -np.log(MAX_CHANCE)


def _first(problem: Problem, most: float) -> Labelling | None:
    """Return the first labelling found that chance excludes, or else the most likely one, or None."""
    if len(problem.uv_px) < MIN_MATCHED:
        return None
    search = Search.of(problem)
    best = None
    enough = max(MIN_MATCHED, int(CLEAR * min(len(problem.xyz_mm), len(problem.uv_px))))
    triples = promising(problem, np.arange(len(problem.uv_px)), most)
    for hypotheses in search.chunks(triples, MIN_MATCHED - 1, enough, KEPT):
        for start in hypotheses[:FITTED]:
            labelling = converge(problem, start, search.gate_px)
            if labelling is not None and (best is None or labelling.log_likelihood > best.log_likelihood):
                best = labelling
        if best is not None and _is_certain(best):
            return best
    return best


def _unique(problem: Problem, best: Labelling) -> tuple[Labelling, float]:
    """Return the best labelling, and the odds of the second best. Raises LabellingRefusedError where they are high."""
    others = list(_others(problem, best))
    if not others:
        return best, 0.0
    best, second = sorted([best, *others], key=lambda labelling: -labelling.log_likelihood)[:2]
    odds = float(np.exp(second.log_likelihood - best.log_likelihood))
    if odds < MAX_CHANCE and _is_certain(best):
        return best, odds
    if np.array_equal(second.rows, best.rows) and np.array_equal(second.balls, best.balls):
        raise LabellingRefusedError(
            "the balls seen fit the image and its mirror image; show more of the solid's balls, such that they do not "
            "lie near one plane"
        )
    turn = in_words(second.matrix.T @ best.matrix)
    raise LabellingRefusedError(
        f"the image shows the solid as it is, or {turn}: the odds are {odds:.1g}, the limit is {MAX_CHANCE:g}; show "
        "more of its balls, and check with 'sightline frame check' that it is not symmetric"
    )


def _others(problem: Problem, best: Labelling) -> Iterator[Labelling]:
    """Yield labellings that contradict `best` and explain nearly as many detections.

    Another labelling explains most of the same detections, so some of the triples tried consist of these.
    """
    n = len(best.rows)
    search, known, tried = Search.of(problem), [best], [best.matrix]
    for hypotheses in search.chunks(
        _bases(problem, best), max(MIN_MATCHED - 1, n - max(3, int(MISSED * n))), None, 4 * KEPT
    ):
        for start in hypotheses:
            if any((start.matrix * labelling).sum() > start.scale * (1 + 2 * SAME_TURN) for labelling in tried):
                continue
            tried.append(start.matrix / start.scale)
            labelling = converge(problem, start, search.gate_px)
            if (
                labelling is None
                or len(labelling.rows) < MIN_MATCHED
                or any(labelling.is_same(other) for other in known)
            ):
                continue
            known.append(labelling)
            yield labelling
            if len(known) > MAX_OTHERS:
                return


def _bases(problem: Problem, best: Labelling) -> np.ndarray:
    """Return triples (T, 3) of matched detections; no two share a side, and each detection is in two at most."""
    bases: list[list[int]] = []
    uses, sides = np.zeros(len(problem.uv_px), int), set[frozenset[int]]()
    for triple in promising(problem, best.rows, np.inf).tolist():
        mine = {frozenset(pair) for pair in combinations(triple, 2)}
        if uses[triple].max() < 2 and not mine & sides:
            bases.append(triple)
            uses[triple] += 1
            sides |= mine
            if len(bases) == (BASES if len(best.rows) <= MANY else MANY_BASES):
                break
    return np.array(bases, dtype=np.int64).reshape(-1, 3)


def _check_alone(problem: Problem, best: Labelling) -> None:
    """Check that the detections left over show no second solid. Raises LabellingRefusedError."""
    left = problem.without(best.rows)
    if len(left.uv_px) < len(problem.xyz_mm) / 3:
        return
    other = _first(left, LEFT_OVER)
    if other is not None and _is_certain(other):
        raise LabellingRefusedError(
            f"two solids of this kind are in the image: {len(best.rows)} beads show one, {len(other.rows)} another; "
            "remove one of them, or cut a picture of two images in two"
        )


MIN_BEADS = 12  # what the calibration needs
FOCAL_MM = (850.0, 1300.0)  # [ours] from the X-ray source to the plate, 95 %: C-arms have 0.9 to 1.2 m


@dataclass(frozen=True, eq=False)
class LabelledPlate:
    """A plate's beads: detections `rows` are its fiducials `ids`; `mirrored`: the image shows them as a mirror image.

    `xy_mm` (N, 2): all N detections on the plate's plane; `variance_mm2` (N,): of each coordinate there; `px_per_mm`.
    """

    pattern: Pattern
    rows: np.ndarray
    ids: tuple[str, ...]
    mirrored: bool
    xy_mm: np.ndarray
    variance_mm2: np.ndarray
    px_per_mm: float

    @property
    def focal_px(self) -> tuple[float, float]:
        """Limits of the focal length of the undistorted image."""
        low, high = (self.px_per_mm * mm for mm in FOCAL_MM)
        return low, high

    def undistorted(self, detections: Detections) -> tuple[Detections, np.ndarray]:
        """Return the other detections as a panel in the plate's plane shows them, seen from the source, and their rows.

        The plate's z points towards the source, so that its x, y and the beam are left-handed: u is -x.
        """
        rows = np.delete(np.arange(len(detections)), self.rows)
        middle = self.pattern.plane.to_plane(np.zeros(3))
        half = self.px_per_mm * np.abs(self.pattern.xy_mm - middle).max()
        size = 2 * int(np.ceil(half)) + 1
        uv = (size - 1) / 2 + self.px_per_mm * (self.xy_mm[rows] - middle) * [-1.0, 1.0]
        variance = self.px_per_mm**2 * self.variance_mm2[rows]
        return (
            replace(
                detections,
                uv_px=uv,
                radius_px=detections.radius_px[rows],
                covariance_px2=variance[:, None, None] * np.eye(2),
                kind=tuple(detections.kind[k] for k in rows),
                contrast=detections.contrast[rows],
                image_shape=(size, size),
                rejected=(),
                pixels=None,
            ),
            rows,
        )


def label_plate(detections: Detections, usable: np.ndarray, pattern: Pattern) -> LabelledPlate:
    """Return the labels of the plate on the detector. Raises LabellingRefusedError."""
    problem = LabellingProblem(detections, usable, [], None)
    failure = AttemptError(
        Stage.SEEDS,
        "no datum markers of the plate on the detector are found among the beads; check that the plate is on the "
        "detector, or use the frame without it ('block30', not 'block30+detector-plate')",
    )
    for seed in find_seeds(detections, [pattern], usable):
        grown = grow(seed, detections, usable)
        if len(grown) < MIN_BEADS:
            continue
        try:
            beads, fit = solve_alone(problem, grown)
        except AttemptError as error:
            failure = max(failure, error, key=lambda attempt: attempt.stage)
            continue
        if len(beads) >= MIN_BEADS:
            similarity = grown.sheet.similarity
            ids = tuple(pattern.ids[place] for place in beads[:, 1])
            return LabelledPlate(
                pattern, beads[:, 0], ids, not similarity.mirror, fit.xy_mm, fit.variance_mm2, similarity.scale
            )
        few = f"{len(beads)} beads of the plate on the detector are labelled; {MIN_BEADS} are needed: show more of it"
        failure = AttemptError(Stage.CHECKS, few)
    raise LabellingRefusedError(str(failure))
