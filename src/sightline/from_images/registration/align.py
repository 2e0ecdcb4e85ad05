"""Gauss-Newton alignment of a bone's shadows with images, at one resolution."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.cast import shadow_and_derivatives
from sightline.from_images.registration.observed import BoneShot, Observed
from sightline.from_images.registration.similarity import WINDOW, Normalised, block_sums

IMAGE_FLOOR, SHADOW_FLOOR = 0.01, 0.3  # of the local s.d. of attenuation [ours]
FLAT = 0.05  # local s.d. of the shadow's attenuation at which a pixel has half its weight [ours]
_SCALE = 0.7  # of a normalised difference beyond which it counts less [ours]
_UNRELATED = 0.6  # mean loss of two normalised images of white noise
_LEAST_AREA = 0.3  # of a window [ours]
_BLOCK_PX = 16  # of the shifts of edges: a window and its surroundings [ours]
_LEAST_INFORMATION = 0.3  # of a direction in a block, 1/px²: less does not tell a shift [ours]
_GAP_PX = 5  # [ours] between the images of neighbouring points of a cut
_UNIT = np.repeat([1 / 40.0, 1.0], 3)  # a rotation by 1 rad counts like a shift by 40 mm [ours]
_DAMPING, _RIDGE = 1e-3, 1e-9  # of Levenberg and Marquardt's steps
_STOP_MM = 0.003  # [ours] a tenth of the least error
_NOISE = 1e-4  # of the loss, which sampling makes uneven: within it a step counts as no worse [ours]
_TRIES = 6  # [ours] dampings of a step


@dataclass(frozen=True)
class Level:
    """Images of at most `size` pixels a side, voxels of `spacing_mm`, at most `rounds` of Gauss-Newton."""

    size: int
    spacing_mm: float
    rounds: int


# [ours] 32 px find the basin of starts 10° off three times in four, in milliseconds. Errors of poses have a median of
# 0.097 mm at 128 px, 0.078 at 256; 512 px would leave 0.058 mm and take three times as long [gVirtualXray: 77 scenes].
COARSE, MIDDLE, CLOSE, FINE = Level(32, 4.0, 8), Level(64, 2.0, 12), Level(128, 1.0, 40), Level(256, 1.0, 40)


@dataclass(frozen=True, eq=False)
class Differences:
    """Shadow less image at a pose, normalised: `residual` (H, W), `weight` (H, W); derivatives `shadow_by_pose`
    (H, W, 6) of the shadow before it was normalised, by rotation vector about the bone's centre and shift, mm."""

    residual: np.ndarray
    shadow_by_pose: np.ndarray
    weight: np.ndarray
    shadow: Normalised

    @cached_property
    def by_pose(self) -> np.ndarray:
        """(H, W, 6) derivatives of `residual`; a step that is rejected needs none."""
        return self.shadow.derivatives(self.shadow_by_pose)

    @cached_property
    def loss(self) -> float:
        """Sum of the weighted losses (Geman and McClure's)."""
        q = (self.residual / _SCALE) ** 2
        return float((self.weight * q / (1 + q)).sum())

    @cached_property
    def loss_by_residual(self) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) twice: the loss's first derivative over the residual, and its second one; times a constant."""
        q = (self.residual / _SCALE) ** 2
        return self.weight / (1 + q) ** 2, self.weight * (1 - 3 * q) / (1 + q) ** 3

    def edge_shifts_px(self) -> np.ndarray:
        """Return the shifts (N, 2) that would match blocks of the shadow with the image, each in one direction in which
        the block has edges: its length, px, and its information, 1/px²."""
        down, right = np.gradient(self.shadow.values)
        weight, left = self.loss_by_residual[0], self.residual
        products = np.stack([right * right, right * down, down * down, right * left, down * left], axis=-1)
        sums = block_sums(weight[:, :, None] * products, _BLOCK_PX)
        information, vectors = np.linalg.eigh(sums[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
        pulls = np.einsum("nki,nk->ni", vectors, sums[:, 3:])
        certain = information > _LEAST_INFORMATION
        return np.stack([np.abs(pulls[certain] / information[certain]), information[certain]], axis=1)


@dataclass(frozen=True, eq=False)
class BoneFit:
    """A pose, the differences of all views there, and their mean loss, 0 to 1."""

    pose: RigidTransform
    views: Sequence[Differences]

    @cached_property
    def loss(self) -> float:
        """Mean of the weighted losses of all pixels, 0 to 1."""
        weight = sum(float(view.weight.sum()) for view in self.views)
        return sum(view.loss for view in self.views) / weight if weight > 0 else 1.0

    @property
    def evidence(self) -> float:
        """How much less the images differ than unrelated ones, in standard deviations of such a mean, times a constant.

        The loss alone prefers few pixels, which may be alike by chance; its sum prefers bones with more edges.
        """
        return (_UNRELATED - self.loss) * sum(float(view.weight.sum()) for view in self.views) ** 0.5

    def normal_equations(self) -> tuple[np.ndarray, np.ndarray]:
        """Return matrix (6, 6) and right side (6,) of a Gauss-Newton step, in multiples of _UNIT."""
        normal, gradient = np.zeros((6, 6)), np.zeros(6)
        for view in self.views:
            by, first = view.by_pose.reshape(-1, 6) * _UNIT, view.loss_by_residual[0].ravel()
            normal += by.T @ (by * first[:, None])
            gradient += by.T @ (first * view.residual.ravel())
        return normal, gradient


def moved(pose: RigidTransform, step: np.ndarray, centre_mm: np.ndarray) -> RigidTransform:
    """Return a pose rotated by the vector step[:3] about a point (3,), CFCS, and shifted by step[3:], mm."""
    turn = Rotation.from_rotvec(step[:3])
    return RigidTransform.from_components(centre_mm + step[3:] - turn.apply(centre_mm), turn) * pose


def fit_at(shots: Sequence[BoneShot], bone: ScannedBone, level: Level, pose: RigidTransform) -> BoneFit:
    """Return the differences of shadows and images at a pose."""
    return BoneFit(pose, [_differences(seen, bone, level, pose) for seen in _around(shots, bone, level, pose)])


def _around(shots: Sequence[BoneShot], bone: ScannedBone, level: Level, pose: RigidTransform) -> list[Observed]:
    """Return of each image what lies around the bone."""
    corners = pose.apply(bone.corners_mm)
    return [shot.pooled(level.size).around(corners) for shot in shots]


def _differences(seen: Observed, bone: ScannedBone, level: Level, pose: RigidTransform) -> Differences:
    shape = seen.attenuation.shape
    shadow, by_pose = shadow_and_derivatives(seen.rays, bone.at(level.spacing_mm), pose, pose.apply(bone.centre_mm))
    usable = (seen.known & _beside(seen.at(pose.apply(bone.cut_mm)), shape)).astype(np.float64)
    drawn = Normalised.of(shadow.reshape(shape), usable, SHADOW_FLOOR)
    shown = Normalised.of(seen.attenuation, usable, IMAGE_FLOOR)
    weight = usable * drawn.variance / (drawn.variance + FLAT**2) * (drawn.area > _LEAST_AREA * WINDOW**2)
    return Differences(drawn.values - shown.values, by_pose.reshape(*shape, 6), weight, drawn)


def _beside(at: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return (H, W) bool: False within a window of the rim of what the pixels `at` (N, 2), column and row, cover.

    There the model ends and the bone does not. Within, a face that is seen from the front changes nothing.
    """
    covered = np.zeros(shape, dtype=np.uint8)
    covered[at[:, 1], at[:, 0]] = 1
    covered = cv2.morphologyEx(covered, cv2.MORPH_CLOSE, np.ones((_GAP_PX, _GAP_PX)))
    rim = cv2.morphologyEx(covered, cv2.MORPH_GRADIENT, np.ones((2 * (WINDOW // 4) + 3,) * 2))
    return rim == 0


def align(shots: Sequence[BoneShot], bone: ScannedBone, level: Level, pose: RigidTransform) -> BoneFit:
    """Return the fit that Gauss-Newton reaches from a pose."""
    seen = _around(shots, bone, level, pose)
    fit, damping = BoneFit(pose, [_differences(view, bone, level, pose) for view in seen]), _DAMPING
    for _ in range(level.rounds):
        normal, gradient = fit.normal_equations()
        for _ in range(_TRIES):
            step = -np.linalg.solve(normal + (damping * np.diag(normal) + _RIDGE) * np.eye(6), gradient)
            pose = moved(fit.pose, step * _UNIT, fit.pose.apply(bone.centre_mm))
            trial = BoneFit(pose, [_differences(view, bone, level, pose) for view in seen])
            if trial.loss < fit.loss * (1 + _NOISE):
                break
            damping *= 8
        else:
            break
        fit, damping = trial, damping / 5
        if np.abs(step).max() < _STOP_MM:
            break
    return fit
