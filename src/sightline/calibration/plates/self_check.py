"""Self-calibration of a frame: its errors, estimated from several images taken with the C-arm in different places.

Every image has its own map and focal point; the errors of the frame are the same in all. With map and focal point
eliminated, each image gives a quadratic form in the errors of its view's balls; the forms add up, and the frame's
tolerances are the prior. The problem is linear but for products of small numbers, which a second pass includes.

Some errors are unobservable with any number of images (gauge freedom): every image is unchanged where space is sheared,
stretched or bent along the beam with the XRII plate fixed, (x, h) -> (x + a h, c h) / (1 + d h), because the focal
points follow, and they and the maps are free. So shifts of a view's plates against each other, in their plane and along
the beam, keep the errors of the tolerances; so do the two views against each other, and the scale of the frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from sightline.calibration.maps.hull import well_conditioned
from sightline.calibration.maps.smooth import DEGREE
from sightline.calibration.plates.beads import Beads, match
from sightline.calibration.plates.joint import JointFit, fit_robustly, pixel_noise_mm2, twice
from sightline.calibration.view import Pencil
from sightline.common.checks import FALSE_ALARM, Check
from sightline.common.fitting import cholesky, monomials, solve_lower
from sightline.common.geometry.covariance import block_diagonal
from sightline.common.geometry.rigid import displacement
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError
from sightline.frame import Frame, Plate

MOTIONS = ("shift 1", "shift 2", "along the beam", "tilt 1", "tilt 2", "twist")


@dataclass(frozen=True, eq=False)
class PlatePair:
    """Motion of a view's source plate against its XRII plate: MOTIONS along and about the XRII plate's axes and normal.

    `moved` (6,): mm and rad; `prior_sd`, `sd` (6,): standard deviations before and after the images.
    """

    view: str
    moved: np.ndarray
    prior_sd: np.ndarray
    sd: np.ndarray


@dataclass(frozen=True, eq=False)
class InPlate:
    """Displacements of M balls against the best-fitting rigid motion of their plate, (M, 3), CFCS, mm."""

    moved_mm: np.ndarray
    prior_sd_mm: np.ndarray
    sd_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of a frame's M balls (M, 3), mm, with their covariances (3M, 3M) before (`prior`) and after the images.

    `sound` (M,) bool: balls that are used to determine their plate's motion.
    """

    moved_mm: np.ndarray
    prior: np.ndarray
    covariance: np.ndarray
    sound: np.ndarray


def plate_pairs(frame: Frame, errors: Errors) -> tuple[PlatePair, ...]:
    """Return the relative motion of the two plates of every view."""
    pairs = []
    for name, view in frame.views.items():
        to_pair = np.zeros((6, errors.moved_mm.size))
        start = frame.rows(name).start
        for sign, plate in ((-1, view.xrii), (1, view.source)):
            rows = slice(start, start + 3 * len(plate.ids))
            to_pair[:, rows] = sign * _motion(plate, view.xrii, errors.sound[rows.start // 3 : rows.stop // 3])
            start = rows.stop
        sds = (_sd(to_pair, covariance) for covariance in (errors.prior, errors.covariance))
        pairs.append(PlatePair(name, to_pair @ errors.moved_mm.ravel(), *sds))
    return tuple(pairs)


def in_plate(frame: Frame, errors: Errors) -> InPlate:
    """Return the displacement of every ball within its plate."""
    rest, start = np.eye(errors.moved_mm.size), 0
    for _, _, plate in frame.named_plates:
        rows = slice(start, start + 3 * len(plate.ids))
        rigid = _rigid(plate, plate)
        rest[rows, rows] -= rigid @ _motion(plate, plate, errors.sound[rows.start // 3 : rows.stop // 3])
        start = rows.stop
    moved = (rest @ errors.moved_mm.ravel()).reshape(-1, 3)
    return InPlate(moved, *(_sd(rest, covariance).reshape(-1, 3) for covariance in (errors.prior, errors.covariance)))


def _sd(rows: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("ij,ij->i", rows @ covariance, rows), 0.0))


def _motion(plate: Plate, axes_of: Plate, sound: np.ndarray) -> np.ndarray:
    """Return (6, 3N): takes the errors of a plate's balls to its rigid motion, using the sound ones."""
    rows = np.repeat(sound, 3)
    motion = np.zeros((6, len(rows)))
    motion[:, rows] = np.linalg.pinv(_rigid(plate, axes_of)[rows])
    return motion


def _rigid(plate: Plate, axes_of: Plate) -> np.ndarray:
    """Return (3N, 6): displacements of a plate's balls by MOTIONS about their mean, along the axes of `axes_of`."""
    axes = axes_of.plane.basis.T
    twists = displacement(plate.xyz_mm - plate.xyz_mm.mean(axis=0)).reshape(-1, 6)
    return np.hstack([twists[:, 3:] @ axes, twists[:, :3] @ axes])


MIN_IMAGES = 4  # [ours] two of each of two views: in one image the map absorbs the frame's errors
# Half the shortest correlation length beyond a cubic of a real tube's map [physics.md, Distortion]: images
# nearer to each other share the errors of their maps, which are treated as independent.
MIN_MOVEMENT_MM = 15.0
FREE_SD_MM = 3.0  # [ours] prior s.d. of a ball that contradicts its tolerance: a third of the densest pitch
# The covariance of detected beads is too small by a factor of 1.09 to 1.39 (docs/benchmarks.md, detection); one image
# does not show it, many together do.
NOISE_MARGIN = 1.25
PASSES = 3  # the second changes 1e-3 of a step, the third nothing (tests)
MAX_MOVED = 12  # [ours] more misplaced balls mean a wrong frame


@dataclass(frozen=True, eq=False)
class SelfCheck:
    """A frame estimated from its own images; M balls in the order of `Frame.error_factor`.

    `frame`: the estimated frame with its covariance. `moved_mm` (M, 3): displacements from the frame file; `in_plate`:
    displacements within each ball's own plate; `pairs`: motions of each view's plates against each other. `sigma` (M,):
    distance of each ball from its prediction by all others and the tolerances, in standard deviations; `misplaced`: ids
    of the balls beyond their tolerance. `images` (M,): number of images in which each ball was used; `focal_points_mm`:
    (K, 3) for the K images of each view.
    """

    frame: Frame
    moved_mm: np.ndarray
    in_plate: InPlate
    pairs: tuple[PlatePair, ...]
    sigma: np.ndarray
    misplaced: tuple[str, ...]
    images: np.ndarray
    focal_points_mm: dict[str, np.ndarray]
    checks: tuple[Check, ...]


@well_conditioned()
def self_check(observations: Sequence[Observations], frame: Frame) -> SelfCheck:
    """Return the errors of a frame, estimated from 4 images or more.

    Raises ObservationsError, FrameError, CalibrationRefusedError.
    """
    frame.refuse_solid("its balls are measured by self_check_solid")
    if len(observations) < MIN_IMAGES:
        raise CalibrationRefusedError(
            f"{len(observations)} images were given; give {MIN_IMAGES} or more for a self-check, with the C-arm moved "
            "between them"
        )
    _refuse_repeats(observations)
    images = _images(observations, frame)
    prior = frame.error_factor
    free: list[int] = []
    sigma = np.zeros(len(prior) // 3)
    while True:
        factor = np.hstack([prior, *(_freed(ball, len(prior)) for ball in free)])
        normal = _estimate(images, factor)
        square = _score(normal)
        square[free] = 0.0
        sigma = np.where(np.isin(np.arange(len(square)), free), sigma, np.sqrt(square))
        worst = int(np.argmax(square))
        if square[worst] <= chdtri(3, FALSE_ALARM / len(square)):
            break
        sigma[worst] = np.sqrt(square[worst])
        free.append(worst)
        if len(free) > MAX_MOVED:
            names = ", ".join(frame.fiducials[ball].id for ball in free[:5])
            raise CalibrationRefusedError(
                f"more than {MAX_MOVED} balls lie beyond their tolerance ({names} first); check that the images show "
                "this frame, and that its stated tolerances are realistic"
            )
    return _result(frame, images, normal, free, sigma)


@dataclass(frozen=True, eq=False)
class _Image:
    """One image: its beads, the `fit` that gives map and noise, `rows` (N,) of its beads among all of the frame.

    `basis` (2N, 20): of the cubic; `factor` (2N, 2N): lower Cholesky factor of the covariance of the map beyond the
    cubic plus that of the pixels.
    """

    beads: Beads
    fit: JointFit
    rows: np.ndarray
    basis: np.ndarray
    factor: np.ndarray

    @staticmethod
    def of(beads: Beads, fit: JointFit) -> "_Image":
        frame = beads.frame
        start = frame.rows(beads.view).start // 3
        at = fit.map.unit(beads.uv_px)
        kernel = fit.learned.kernel(at, at)
        noise = block_diagonal(pixel_noise_mm2(beads, fit.map.jacobian(beads.uv_px), fit.learned.noise_scale))
        return _Image(beads, fit, start + beads.rows, twice(monomials(at, DEGREE)), cholesky(twice(kernel) + noise))


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations summed over the images, and their solution.

    `precision` (3M, 3M) of the frame's errors by the images alone; `pull` (3M,): right-hand side; `square`: of the
    whitened data; `freedom`: number of data minus the parameters of maps and focal points. `errors` (3M,) and
    `covariance` (3M, 3M): the solution with the prior.
    """

    precision: np.ndarray
    pull: np.ndarray
    square: float
    freedom: int
    errors: np.ndarray
    covariance: np.ndarray


def _images(observations: Sequence[Observations], frame: Frame) -> list[_Image]:
    """Return the images with their beads.

    A bead that is an outlier in one image only is left out of it; an outlier in most images has moved, and stays.
    """
    matched = [match(seen, frame, None) for seen in observations]
    fits = [fit_robustly(beads) for beads in matched]
    seen: dict[str, int] = {}
    wrong: dict[str, int] = {}
    for _, residuals in fits:
        for ball, used in zip(residuals.ids, residuals.used, strict=True):
            seen[ball] = seen.get(ball, 0) + 1
            wrong[ball] = wrong.get(ball, 0) + (not used)
    moved = {ball for ball, count in wrong.items() if count > 1 and 2 * count >= seen[ball]}
    images = []
    for beads, (fit, residuals) in zip(matched, fits, strict=True):
        kept = residuals.used | np.array([ball in moved for ball in beads.ids])
        images.append(_Image.of(beads.where(kept), fit))
    return images


def _estimate(images: Sequence[_Image], factor: np.ndarray) -> _Normal:
    """Return the errors with the prior covariance factor @ factor.T, after PASSES Gauss-Newton steps."""
    pencils = [image.fit.pencil for image in images]
    normal, pencils = _step(images, pencils, factor, np.zeros(len(factor)))
    for _ in range(PASSES - 1):
        normal, pencils = _step(images, pencils, factor, normal.errors)
    return normal


def _step(
    images: Sequence[_Image], pencils: Sequence[Pencil], factor: np.ndarray, errors: np.ndarray
) -> tuple[_Normal, list[Pencil]]:
    """Make one Gauss-Newton step from the current errors (3M,) and focal points."""
    precision, pull, square, freedom = np.zeros((len(factor), len(factor))), np.zeros(len(factor)), 0.0, 0
    kept = []
    for image, pencil in zip(images, pencils, strict=True):
        rows = (3 * image.rows[:, None] + np.arange(3)).ravel()
        data, response, back = _eliminated(image, pencil, errors[rows])
        precision[np.ix_(rows, rows)] += response.T @ response
        pull[rows] += response.T @ data
        square, freedom = square + float(data @ data), freedom + len(data) - len(back)
        kept.append((rows, back))
    lower = solve_lower(cholesky(np.eye(factor.shape[1]) + factor.T @ precision @ factor), factor.T)
    covariance = lower.T @ lower
    errors = covariance @ pull
    moved = [
        Pencil(pencil.plane, pencil.pq + (back @ np.append(1.0, errors[rows]))[-3:])
        for pencil, (rows, back) in zip(pencils, kept, strict=True)
    ]
    return _Normal(precision, pull, square, freedom, errors, covariance), moved


def _eliminated(image: _Image, pencil: Pencil, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return whitened data (2N,) and response (2N, 3N) to the beads' errors with cubic and focal point eliminated, and
    the back-substitution (23, 1 + 3N) from (1, errors) to cubic and focal point."""
    xyz = image.beads.xyz_mm + errors.reshape(-1, 3)
    (y, by_point, _), by_pq = pencil.projected(xyz), pencil.by_pq(xyz)
    n = len(xyz)
    response = np.zeros((n, 2, n, 3))
    response[range(n), :, range(n), :] = -by_point
    data = y.ravel() - np.einsum("nai,ni->na", by_point, errors.reshape(-1, 3)).ravel()
    design = np.concatenate([image.basis, -by_pq.reshape(-1, 3)], axis=1)
    white = solve_lower(image.factor, np.column_stack([design, data, response.reshape(2 * n, 3 * n)]))
    q, r = np.linalg.qr(white[:, : design.shape[1]])
    others = white[:, design.shape[1] :]
    along = q.T @ others
    others = others - q @ along
    back = np.linalg.solve(r, along)
    back[:, 1:] *= -1
    return others[:, 0], others[:, 1:], back


def _score(normal: _Normal) -> np.ndarray:
    """Return (M,): each ball's score test for a shift beyond its prior; chi-square with three degrees of freedom."""
    score = normal.pull - normal.precision @ normal.errors
    covariance = normal.precision - normal.precision @ normal.covariance @ normal.precision
    m = len(score) // 3
    blocks = covariance.reshape(m, 3, m, 3)[range(m), :, range(m), :]
    inverse = np.linalg.pinv((blocks + np.swapaxes(blocks, 1, 2)) / 2, rcond=1e-9, hermitian=True)
    return np.maximum(np.einsum("na,nab,nb->n", score.reshape(m, 3), inverse, score.reshape(m, 3)), 0.0)


def _freed(ball: int, size: int) -> np.ndarray:
    """Return (size, 3): additional prior columns of a ball with a free position."""
    columns = np.zeros((size, 3))
    columns[3 * ball : 3 * ball + 3] = FREE_SD_MM * np.eye(3)
    return columns


def _result(
    frame: Frame, images: Sequence[_Image], normal: _Normal, free: Sequence[int], sigma: np.ndarray
) -> SelfCheck:
    balls = frame.fiducials
    moved = normal.errors.reshape(-1, 3)
    sound = ~np.isin(np.arange(len(balls)), free)
    errors = Errors(moved, frame.error_factor @ frame.error_factor.T, normal.covariance, sound)
    within = in_plate(frame, errors)
    count = np.zeros(len(balls), dtype=int)
    for image in images:
        count[image.rows] += 1
    focal = {
        name: np.array([i.fit.pencil.focal_point_mm for i in images if i.beads.view == name]).reshape(-1, 3)
        for name in frame.views
    }
    return SelfCheck(
        frame=measured_frame(frame, moved, normal.covariance),
        moved_mm=moved,
        in_plate=within,
        pairs=plate_pairs(frame, errors),
        sigma=sigma,
        misplaced=tuple(balls[ball].id for ball in free),
        images=count,
        focal_points_mm=focal,
        checks=(_movement(images), _chi_square(normal), _misplaced([balls[b].id for b in free], free, within, count)),
    )


def measured_frame(frame: Frame, moved_mm: np.ndarray, covariance: np.ndarray) -> Frame:
    """Return a frame with its M beads moved by (M, 3) and a covariance (3M, 3M) in place of its tolerances."""
    covariance = (covariance + covariance.T) / 2
    covariance.flags.writeable = False
    measured = frame.with_beads_at((frame.xyz_mm + moved_mm).round(6))
    return replace(measured, tolerances=None, covariance_mm2=covariance)


def _movement(images: Sequence[_Image]) -> Check:
    """Return the check of the distances between each image and its nearest other of the view: their lower quartile."""
    views = [[image for image in images if image.beads.view == name] for name in images[0].beads.frame.views]
    single = [own[0].beads.view for own in views if len(own) == 1]
    nearest = [
        min(_distance_mm(image, other) for other in own if other is not image)
        for own in views
        if len(own) > 1
        for image in own
    ]
    quartile = float(np.quantile(nearest, 0.25)) if nearest else None
    passed = quartile is not None and quartile >= MIN_MOVEMENT_MM
    sentence = (
        "The frame lies in a different place in every image, so their errors are independent."
        if passed
        else "Some images are nearly the same, so they share the errors of their distortion. Move or rotate the C-arm "
        "between images; leave out duplicates."
    )
    if single:
        sentence += f" There is only one image of view {', '.join(single)}."
    return Check("image movement", passed, quartile, MIN_MOVEMENT_MM, "mm", sentence)


def _distance_mm(first: _Image, second: _Image) -> float:
    """Return the rms distance between the common balls of two images, in mm on the reference plane."""
    ids = sorted(set(first.beads.ids) & set(second.beads.ids))
    if not ids:
        return float("inf")
    at = [image.beads.uv_px[[image.beads.ids.index(i) for i in ids]] for image in (first, second)]
    scale = np.sqrt(np.abs(np.linalg.det(first.fit.map.jacobian(first.beads.uv_px))).mean())
    return float(scale * np.sqrt(((at[0] - at[1]) ** 2).sum(axis=1).mean()))


def _chi_square(normal: _Normal) -> Check:
    square = normal.square - float(normal.pull @ normal.errors)
    reduced = square / normal.freedom
    limit = NOISE_MARGIN * float(chdtri(normal.freedom, FALSE_ALARM)) / normal.freedom
    sentence = (
        "All images together agree with the stated noise and tolerances."
        if reduced <= limit
        else "The images disagree by more than noise and tolerances explain: look for a frame that changed between "
        "them, wrong labels, or tolerances that are too small."
    )
    return Check("self-check chi-square", reduced <= limit, reduced, limit, "", sentence)


def _misplaced(names: Sequence[str], free: Sequence[int], within: InPlate, count: np.ndarray) -> Check:
    once = [name for name, ball in zip(names, free, strict=True) if count[ball] < 2]
    misplaced = [
        f"{name} by {np.linalg.norm(within.moved_mm[ball]):.2f} mm (±{within.sd_mm[ball].max():.2f})"
        for name, ball in zip(names, free, strict=True)
    ]
    sentence = (
        f"Beyond their tolerance: {', '.join(misplaced)}. Inspect these balls."
        if misplaced
        else "All balls are within their tolerance."
    )
    if once:
        sentence += f" Acquire another image of {', '.join(once)}: seen in one image only."
    return Check("misplaced balls", not once, float(len(names)), None, "balls", sentence)


def _refuse_repeats(observations: Sequence[Observations]) -> None:
    for k, seen in enumerate(observations):
        for other in observations[:k]:
            shared = set(seen.ids) & set(other.ids) if seen.view == other.view else set()
            if not shared:
                continue
            at = [np.array([o.uv_px[o.ids.index(i)] for i in sorted(shared)]) for o in (seen, other)]
            if np.mean(np.all(at[0] == at[1], axis=1)) > 0.5:
                raise ObservationsError(
                    "one image was given twice; leave out the repetition, which adds no information"
                )
