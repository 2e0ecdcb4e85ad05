"""Joint adjustment of images of one solid that an arm holds before a C-arm at rest.

The unknowns are the solid's place on the flange, the one camera in the arm's base, the error of each of the arm's
poses, and the errors of the balls. The data are the balls' centres, the arm's poses, and the priors of camera and
balls. A single image leaves the distance of the solid open by a percent; the arm's known motions close it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtri

from sightline.calibration.bead_checks import chi_square_check, tolerance_checks
from sightline.calibration.lengths import CArm
from sightline.calibration.maps.hull import well_conditioned
from sightline.calibration.plates.beads import at_centres
from sightline.calibration.plates.joint import MAX_WRONG_SHARE
from sightline.calibration.solids.adjustment import (
    MIRROR_EVIDENCE,
    SolidAdjustment,
    best_camera,
    descended,
    image_of,
    prior_rows,
    solid_of,
)
from sightline.calibration.solids.calibrate_together import checks_of_camera
from sightline.calibration.solids.images import DetectorPlateImage, SolidBalls, SolidImage
from sightline.calibration.solids.panel_camera import PARAMETERS, PanelCamera
from sightline.common.checks import FALSE_ALARM, Check
from sightline.common.fitting import variance_ratio
from sightline.common.geometry.rigid import adjoint, cross_matrix, displacement
from sightline.common.threads import one_blas_thread
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError
from sightline.frame import Frame

MIN_IMAGES = 8  # [ours] so that two bad ones are found among the rest
MAX_BAD_SHARE = 0.25  # [ours] of the images: more of them are no exceptions
# Rotation between two images, by arm and by the solid's shadows, may differ by this much. An image alone has 0.2°, and
# 0.7° where the C-arm states no distance [measured]; what is missed here is found by the adjustment.
SAME_ROTATION = np.radians(5.0)
_VOTES = 4  # [ours] images whose mirror image is tried: one is enough of most blocks
_DEPTH_WEIGHT = 0.05  # [ours] of a solid's distance against its place across the beam, to begin with
_FOCALS = np.linspace(-1.5, 1.5, 13)  # [ours] in s.d. of the prior: 6 % apart where nothing is known of the C-arm


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Errors of the balls `e` (K,) in s.d.; `mount`: CFCS to flange; `camera`: of points in the base, from
    `HeldImages.origin_mm`; `arm` (N, 6): errors of the arm's poses, twists in flange coordinates, so that a true pose
    is the stated one times exp(arm)."""

    e: np.ndarray
    mount: RigidTransform
    camera: PanelCamera
    arm: np.ndarray

    def moved(self, step: np.ndarray) -> "Unknowns":
        """Return the unknowns changed by `step`, in the order of the columns."""
        mount, camera, arm = self.columns
        return Unknowns(
            self.e + step[: len(self.e)],
            RigidTransform.from_exp_coords(step[mount]) * self.mount,
            self.camera.moved(step[camera]),
            self.arm + step[arm].reshape(-1, 6),
        )

    @property
    def columns(self) -> tuple[slice, slice, slice]:
        """Columns of mount, camera and arm; those of e are the first."""
        ends = np.cumsum([len(self.e), 6, PARAMETERS, self.arm.size]).tolist()
        return slice(ends[0], ends[1]), slice(ends[1], ends[2]), slice(ends[2], ends[3])


@dataclass(frozen=True, eq=False)
class HeldImages:
    """N images of a solid, and the arm's `poses` at them (flange in the base) with the s.d. `sd` (6,) of their errors:
    twists in flange coordinates, rad and mm. The poses' origin is the point `origin_mm` (3,) of the base."""

    solid: SolidBalls
    images: tuple[SolidImage, ...]
    poses: RigidTransform
    sd: np.ndarray
    origin_mm: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def without(self, image: int) -> "HeldImages":
        """Return the others."""
        kept = np.flatnonzero(np.arange(len(self.images)) != image)
        return replace(self, images=tuple(self.images[k] for k in kept), poses=self.poses[kept])


@dataclass(frozen=True, eq=False)
class HeldAdjustment(SolidAdjustment):
    """An adjustment whose `cameras` are all one camera, `at.camera`, seen from the solid in each pose.

    Columns of the design: e, then `Unknowns.columns`. Rows: the balls', image by image; three of the camera's prior;
    six of each pose; K of e.
    """

    held: HeldImages
    at: Unknowns

    def columns_of(self, image: int) -> slice:
        """Return the columns of the camera, which is the same in every image."""
        return self.at.columns[1]

    def pose_left_out(self, image: int) -> tuple[np.ndarray, float]:
        """Return the error (6,) of an image's pose by all other data, and its squared Mahalanobis length."""
        start = sum(each.data for each in self.images) + 3 + 6 * image
        rows = slice(start, start + 6)
        alone = np.linalg.solve(np.eye(6) - self.design[rows] @ self.gain[:, rows], self.residual[rows])
        return -self.held.sd * alone, float(self.residual[rows] @ alone)

    def mount(self) -> tuple[RigidTransform, np.ndarray]:
        """Return where the solid's balls fit its file best, CFCS to flange, with the covariance (6, 6) of its error as
        a spatial twist in flange coordinates.

        A common displacement of the balls against their file belongs to this place: it is the same in any other image
        of the solid, and cancels against points that are located by it.
        """
        solid, at, own = self.solid, self.at, self.at.columns[0]
        three = 3 * solid.count
        common = np.linalg.pinv(displacement(solid.xyz_mm[: solid.count]).reshape(three, 6)) @ solid.factor[:three]
        gain = self.gain[own] + adjoint(at.mount) @ common @ self.gain[: len(at.e)]
        return at.mount * RigidTransform.from_exp_coords(common @ at.e), gain @ gain.T


def linearised(held: HeldImages, at: Unknowns) -> HeldAdjustment:
    """Return residuals (data minus model) and design at given unknowns."""
    mount, own, arm = at.columns
    flange = held.poses * RigidTransform.from_exp_coords(at.arm)
    solid_at, to_base = flange * at.mount, adjoint(flange)
    balls, errors = sum(image.data for image in held.images), len(at.e)
    residual = np.zeros(balls + 3 + at.arm.size + errors)
    design = np.zeros((len(residual), arm.stop))
    turn, cameras, start = at.camera.rotation, [], 0
    for k, image in enumerate(held.images):
        here, rows = solid_at[k], slice(start, start + image.data)
        there = turn @ here.translation
        camera = replace(
            at.camera, rotation=turn @ here.rotation.as_matrix(), translation_mm=there + at.camera.translation_mm
        )
        residual[rows], by_camera, design[rows, :errors] = image.whitened(camera, held.solid, at.e)
        design[rows, own] = by_camera
        design[rows, own.start : own.start + 3] -= by_camera[:, 3:6] @ cross_matrix(there)
        by_base = by_camera[:, 3:6] @ turn @ displacement(here.translation)
        by_base[:, :3] += by_camera[:, :3] @ turn
        design[rows, mount] = by_base @ to_base[k]
        design[rows, arm.start + 6 * k : arm.start + 6 * k + 6] = design[rows, mount]
        cameras.append(camera)
        start += image.data
    residual[start : start + 3], design[start : start + 3, own] = prior_rows(at.camera, held.images[0].prior)
    poses = slice(start + 3, start + 3 + at.arm.size)
    residual[poses], design[poses, arm] = -(at.arm / held.sd).ravel(), np.diag(np.tile(1 / held.sd, len(at.arm)))
    residual[poses.stop :], design[poses.stop :, :errors] = -at.e, np.eye(errors)
    return HeldAdjustment(held.solid, held.images, tuple(cameras), at.e, residual, design, held, at)


def _adjusted(held: HeldImages, start: Unknowns) -> HeldAdjustment:
    """Return the adjustment. Raises CalibrationRefusedError."""
    fit, converged = descended(linearised(held, start), lambda now, step: linearised(held, now.at.moved(step)))
    if not converged:
        raise CalibrationRefusedError(
            "images and poses determine no place of the block on the flange: the adjustment does not converge; check "
            "that the poses are those of the flange in the base, in mm, and each is that of its image"
        )
    return fit


@dataclass(frozen=True)
class BadImage:
    """How far an image contradicts the others: shift of the solid, mm (None: too far to be compared), and rotation,
    rad."""

    shift_mm: float | None
    rotation: float


@dataclass(frozen=True, eq=False)
class HeldCalibration:
    """A solid on an arm's flange, by its images. `names` of the images used; `bad`: those left out; `balls`: ids left
    out, by image; `fit`: the adjustment of those used."""

    names: tuple[str, ...]
    bad: dict[str, BadImage]
    balls: dict[str, list[str]]
    fit: HeldAdjustment
    checks: tuple[Check, ...] = ()

    def deviations(self) -> dict[str, BadImage]:
        """Return by how far each image deviates from the others, those left out last."""
        used = {name: _deviation(self.fit, self.fit.pose_left_out(k)[0]) for k, name in enumerate(self.names)}
        return used | self.bad


def _deviation(fit: HeldAdjustment, twist: np.ndarray) -> BadImage:
    shift = displacement(fit.at.mount.translation) @ twist
    return BadImage(float(np.linalg.norm(shift)), float(np.linalg.norm(twist[:3])))


@one_blas_thread
def calibrate_held(
    observations: Sequence[Observations],
    frame: Frame,
    poses: RigidTransform,
    sd: np.ndarray,
    c_arm: CArm | None = None,
) -> HeldCalibration:
    """Return where an arm holds a solid, from MIN_IMAGES images or more by a C-arm at rest.

    `poses` (N): of the flange in the arm's base at each image; `sd` (6,): s.d. of their errors, a twist in flange
    coordinates, rad and mm. `c_arm`: the known dimensions of the C-arm. Images whose pose contradicts the others, and
    balls, are left out and named. Raises ObservationsError, FrameError, CalibrationRefusedError.
    """
    if frame.solid is None:
        raise CalibrationRefusedError(f"frame {frame.name} has plates: put a block on the arm")
    if len(observations) != len(poses) or len(observations) < MIN_IMAGES:
        raise ObservationsError(f"give {MIN_IMAGES} images or more, each with its pose; got {len(observations)}")
    if len({seen.image_shape for seen in observations}) > 1:
        raise ObservationsError("the images differ in size: they are not those of one C-arm at rest")
    solid, centred = solid_of(frame), [at_centres(seen, frame) for seen in observations]
    images = tuple(image_of(seen, frame, solid, c_arm) for seen in centred)
    with well_conditioned():
        names, balls = [seen.view for seen in observations], [ball.id for ball in frame.fiducials]
        found = _robustly(_Kept(HeldImages(solid, images, poses, sd), names, balls))
    fit = found.fit
    agree = chi_square_check(
        fit.chi_square,
        fit.freedom,
        "Images and poses agree with the stated errors of balls, images and arm.",
        "Images and poses disagree by more than the stated errors of balls, images and arm explain: the arm is less "
        "accurate than stated, or the block's file is of another block.",
    )
    return replace(
        found, checks=(*checks_of_camera(fit, range(len(fit.images)), c_arm), agree, *tolerance_checks(frame))
    )


@dataclass
class _Kept:
    """The images and balls that do not contradict the others, and those left out: `bad` images, and `wrong` balls, by
    image. `names` of the images kept, `balls` of all balls of the frame."""

    held: HeldImages
    names: list[str]
    balls: list[str]
    bad: dict[str, BadImage] = field(default_factory=dict)
    wrong: dict[str, list[str]] = field(default_factory=dict)

    def drop_image(self, image: int, off: BadImage) -> None:
        """Leave out an image. Raises CalibrationRefusedError where too many are."""
        self.bad[self.names.pop(image)] = off
        self.held = self.held.without(image)
        count = len(self.names) + len(self.bad)
        if len(self.bad) > MAX_BAD_SHARE * count:
            raise CalibrationRefusedError(
                f"{len(self.bad)} of {count} images contradict the others ({', '.join(self.bad)}; at most "
                f"{MAX_BAD_SHARE:.0%}). Check that block and C-arm did not move, that each pose is that of its image "
                "and of the flange in the base in mm, by the model of this arm, that the frame file is that of the "
                "block, and how accurate the arm is stated to be"
            )

    def drop_ball(self, image: int, ball: int, limit: int) -> None:
        """Leave out a ball of an image. Raises CalibrationRefusedError where more than `limit` are."""
        images = list(self.held.images)
        self.wrong.setdefault(self.names[image], []).append(self.balls[images[image].rows[ball]])
        images[image] = images[image].without(ball)
        self.held = replace(self.held, images=tuple(images))
        if sum(map(len, self.wrong.values())) > limit or not images[image].enough:
            raise CalibrationRefusedError(
                f"more than {limit} balls contradict the others (in {', '.join(self.wrong)}); check that the frame "
                "file is that of the block in the images, and that it is undamaged"
            )


def _robustly(kept: _Kept) -> HeldCalibration:
    """Return the adjustment without images and balls that contradict the others. Raises CalibrationRefusedError."""
    cameras, last, count = _cameras(kept.held), kept.names[-1], len(kept.names)
    while (worst := _rotated(kept.held.poses, cameras)) is not None:
        cameras.pop(worst[0])
        kept.drop_image(worst[0], BadImage(None, worst[1]))
    kept.held, start = _start(kept.held, cameras)
    total = sum(len(image.rows) for image in kept.held.images)
    of_pose, of_ball = chdtri(6, FALSE_ALARM / count), -2 * np.log(FALSE_ALARM / total)
    while True:
        fit = _adjusted(kept.held, start)
        alone = [fit.pose_left_out(k) for k in range(len(kept.names))]
        shadows = [fit.left_out(k)[1] for k in range(len(kept.names))]
        poses = np.array([square for _, square in alone]) / of_pose
        balls = np.array([each.max() for each in shadows]) / of_ball
        balls /= max(1.0, variance_ratio(np.concatenate(shadows)))
        k, b, start = int(np.argmax(poses)), int(np.argmax(balls)), fit.at
        if max(poses[k], balls[b]) <= 1:
            break
        if poses[k] > balls[b]:
            kept.drop_image(k, _deviation(fit, alone[k][0]))
            start = replace(start, arm=np.delete(start.arm, k, axis=0))
        else:
            kept.drop_ball(b, int(np.argmax(shadows[b])), max(1, int(MAX_WRONG_SHARE * total)))
    if last in kept.bad:
        raise CalibrationRefusedError(
            f"the last image, {last}, contradicts the others: block or C-arm may have moved before it, and the place "
            f"found would hold no longer (images that contradict: {', '.join(kept.bad)}); check that the block is "
            "tight, and take the images again"
        )
    return HeldCalibration(tuple(kept.names), kept.bad, kept.wrong, fit)


def _cameras(held: HeldImages) -> list[PanelCamera]:
    """Return each image's own camera, of the handedness that the first images show. Raises CalibrationRefusedError."""
    first = [image.undistorted() for image in held.images[:_VOTES]]
    plain, mirrored = (
        np.array([best_camera(held.solid, image, mirrored=m)[1] for image in first]) for m in (False, True)
    )
    with np.errstate(invalid="ignore"):
        votes = np.nan_to_num(np.clip(mirrored - plain, -MIRROR_EVIDENCE, MIRROR_EVIDENCE)).sum()
    if isinstance(held.images[0], DetectorPlateImage):  # whose z points towards the source
        votes = -MIRROR_EVIDENCE
    if abs(votes) < MIRROR_EVIDENCE:
        raise CalibrationRefusedError(
            "the images do not tell from which side they show the block: its mirror image fits as well; bring more "
            "balls into the field, or use a larger block"
        )
    images = [image.undistorted() for image in held.images]
    return [best_camera(held.solid, image, mirrored=bool(votes < 0))[0] for image in images]


def _between(rotations: Rotation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pairs of N rotations, i and j (P,), and their rotation vectors (P, 3) from i to j, in axes of i."""
    i, j = np.triu_indices(len(rotations), 1)
    matrices = rotations.as_matrix()
    return i, j, Rotation.from_matrix(np.swapaxes(matrices[i], 1, 2) @ matrices[j]).as_rotvec()


def _rotations(cameras: Sequence[PanelCamera]) -> Rotation:
    return Rotation.from_matrix(np.array([camera.rotation for camera in cameras]))


def _rotated(poses: RigidTransform, cameras: Sequence[PanelCamera]) -> tuple[int, float] | None:
    """Return the image whose rotation disagrees with most others, and by how much; None if none disagrees.

    The angle between two images is the same for arm and solid, however one is fixed to the other.
    """
    i, j, by_arm = _between(poses.rotation)
    by_solid = _between(_rotations(cameras))[2]
    off = np.zeros((len(poses), len(poses)))
    off[i, j] = off[j, i] = np.abs(np.linalg.norm(by_arm, axis=1) - np.linalg.norm(by_solid, axis=1))
    disagree = (off > SAME_ROTATION).sum(axis=1)
    worst = int(np.lexsort((off.sum(axis=1), disagree))[-1])
    return (worst, float(np.median(off[worst]))) if disagree[worst] else None


def _start(held: HeldImages, cameras: Sequence[PanelCamera]) -> tuple[HeldImages, Unknowns]:
    """Return approximate unknowns from each image's own camera: rotations from pairs of images, then places, with the
    best of some focal lengths. The poses' origin is put in the middle of the solid's places.

    There the camera's parameters act alike in all images; elsewhere steps are short (`PanelCamera.moved`).
    """
    seen, prior = _rotations(cameras), held.images[0].prior
    turn = Rotation.align_vectors(_between(held.poses.rotation)[2], _between(seen)[2])[0]
    camera = (seen * (held.poses.rotation * turn).inv()).mean()
    focals_px = prior.focal_px * np.exp(_FOCALS * prior.focal_share)
    at, focal_px, _ = min((_places(held, cameras, camera, focal) for focal in focals_px), key=lambda found: found[2])
    origin = held.poses.apply(at[:3]).mean(axis=0)
    there, centre = at[3:] + camera.apply(origin), np.array(prior.centre_px)
    whole = PanelCamera(camera.as_matrix(), there, focal_px, centre, cameras[0].mirrored)
    mount = RigidTransform.from_components(at[:3] - turn.apply(held.solid.middle_mm), turn)
    no_errors = np.zeros(held.solid.factor.shape[1]), np.zeros((len(cameras), 6))
    centred = RigidTransform.from_translation(-origin) * held.poses
    return replace(held, poses=centred, origin_mm=origin), Unknowns(no_errors[0], mount, whole, no_errors[1])


def _places(
    held: HeldImages, cameras: Sequence[PanelCamera], rotation: Rotation, focal_px: float
) -> tuple[np.ndarray, float, float]:
    """Return the solid's middle on the flange and the base's origin in the camera (6,), mm, the focal length, and the
    sum of squares that it leaves, mm²."""
    homogeneous = np.array([own.matrix for own in cameras]) @ np.append(held.solid.middle_mm, 1.0)
    uv = homogeneous[:, :2] / homogeneous[:, 2:] - held.images[0].prior.centre_px
    weights = np.tile(np.diag([1.0, 1.0, _DEPTH_WEIGHT]), (len(cameras), 1, 1))
    weights[:, :2, 2] = -uv / focal_px * [-1.0 if cameras[0].mirrored else 1.0, 1.0]
    to_camera = weights @ rotation.as_matrix()
    design = np.concatenate([to_camera @ held.poses.rotation.as_matrix(), weights], axis=2).reshape(-1, 6)
    data = -(to_camera @ held.poses.translation[:, :, None])[:, :, 0]
    data[:, 2] += _DEPTH_WEIGHT * homogeneous[:, 2] * focal_px / [own.focal_px for own in cameras]
    data = data.ravel()
    at, *_ = np.linalg.lstsq(design, data, rcond=None)
    return at, focal_px, float(((design @ at - data) ** 2).sum())
