"""What speaks for a bone's pose, and what against it: fit, rivals, field, agreement of the views."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtri
from scipy.stats import qmc

from sightline.common.checks import FALSE_ALARM, Check, at_most
from sightline.from_images.registration.align import FINE, MIDDLE, BoneFit, fit_at, moved
from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.movement import Apart
from sightline.from_images.registration.observed import BoneShot

# Loss at the pose over the least of the bone moved elsewhere. Right poses have 0.3 to 0.8, wrong ones and other bones
# 0.95 to 1.1 [gVirtualXray].
MAX_LOSS_SHARE = 0.88
_ELSEWHERE, _SHIFT_MM, _TURN_RAD = 12, 8.0, np.deg2rad(8.0)  # [ours] beyond any right pose, and still over the bone
# Loss of the next best pose over that of the best. Beside a right pose it is 1.1 and more, 1.05 where the image shows a
# second bone of the same shape, such as the next vertebra; beside wrong ones 1.01 to 1.077 [gVirtualXray].
MIN_RIVAL_SHARE = 1.08
# Three quarters of all edges lie at most so far from those of the image: a length, and a share of the largest side of
# a voxel. With voxels of 1 mm right bones have up to 0.27 mm, beside metal and in images of an intensifier; another
# person's, and one of which a part moved by 3 mm, 0.33 mm and more. With 2 mm right ones have 0.35, a mirrored one
# 0.45 [gVirtualXray].
MAX_EDGE_MM, MAX_EDGE_VOXELS, _EDGES = 0.2, 0.1, 0.75
MIN_IN_FIELD = 0.2  # of the bone, in each view [ours]: the head of a femur is 0.3 of a scan of 140 mm


def checks(
    shots: Sequence[BoneShot], bone: ScannedBone, fits: Sequence[BoneFit], apart: Apart, error_known: bool
) -> list[Check]:
    """Return the checks of the first of the `fits`, best first; `apart`: of its views."""
    best = fits[0]
    return [
        _fit(shots, bone, best),
        _shape(shots, bone, best),
        _rival(fits),
        *(_in_field(shot, bone, best.pose) for shot in shots),
        _movement(apart),
        Check("error known", error_known, None, None, "", _KNOWN if error_known else _UNKNOWN),
    ]


_KNOWN = "All views state their errors."
_UNKNOWN = (
    "A view has no covariance, so the error of the bone's pose is unknown: calibrate the views from their beads, or "
    "give their matrices with a covariance."
)


def _fit(shots: Sequence[BoneShot], bone: ScannedBone, best: BoneFit) -> Check:
    centre = best.pose.apply(bone.centre_mm)
    ways = 2 * qmc.Halton(6, scramble=False).random(_ELSEWHERE + 1)[1:] - 1
    ways[:, :3] *= _TURN_RAD / np.linalg.norm(ways[:, :3], axis=1, keepdims=True)
    ways[:, 3:] *= _SHIFT_MM / np.linalg.norm(ways[:, 3:], axis=1, keepdims=True)
    poses = [best.pose, *(moved(best.pose, way, centre) for way in ways)]
    here, *elsewhere = (fit_at(shots, bone, MIDDLE, pose).loss for pose in poses)
    share = here / min(elsewhere)
    return at_most(
        "bone fit", share, MAX_LOSS_SHARE, "",
        f"The bone's shadows differ from the images {share:.2f} times as much as those of the bone moved by 8 mm",
        otherwise=": nothing fits. Check that CT or mesh are of this bone and this side, in mm and Hounsfield units, "
        "that each image has its own view, and give a start.",
    )  # fmt: skip


def _shape(shots: Sequence[BoneShot], bone: ScannedBone, best: BoneFit) -> Check:
    """Return the check that the shadows have the outlines that the images show."""
    centre, shifts = best.pose.apply(bone.centre_mm), []
    for shot, view in zip(shots, best.views, strict=True):
        found = view.edge_shifts_px()
        shifts.append(found * [shot.pooled(FINE.size).mm_per_px(centre), 1.0])
    every = np.concatenate(shifts)
    length, information = every[np.argsort(every[:, 0])].T
    share = np.cumsum(information) / information.sum() if len(information) else np.zeros(0)
    figure = float(length[np.searchsorted(share, _EDGES)]) if len(share) else float("inf")
    limit = MAX_EDGE_MM + MAX_EDGE_VOXELS * float(bone.volume.voxel_mm.max())
    return at_most(
        "bone shape", figure, limit, "mm",
        f"Three quarters of the edges of the bone's shadow lie within {figure:.2f} mm of those in the images",
        otherwise=": it has another shape. Is it another person's, another side's, or in other units, did a fragment "
        "move, or is the segmentation too wide?",
    )  # fmt: skip


def _rival(fits: Sequence[BoneFit]) -> Check:
    """Return the check that no other pose fits as well."""
    if len(fits) < 2:
        return Check("bone elsewhere", True, None, None, "", "No other pose was found to fit.")
    share = fits[1].loss / fits[0].loss
    passed = share >= MIN_RIVAL_SHARE
    sentence = f"The next pose that fits differs {share:.2f} times as much"
    advice = ": the two cannot be distinguished. Give a start, or points clicked in both views." if not passed else "."
    return Check("bone elsewhere", passed, share, MIN_RIVAL_SHARE, "", sentence + advice, is_minimum=True)


def _in_field(shot: BoneShot, bone: ScannedBone, pose: RigidTransform) -> Check:
    share = shot.share_seen(pose.apply(bone.points_mm))
    passed = share >= MIN_IN_FIELD
    sentence = f"{100 * share:.0f} % of the bone lie in the field"
    advice = (
        ": too little. Centre the C-arm on the bone, or crop the CT to what the image shows." if not passed else "."
    )
    return Check(
        "bone in field", passed, 100 * share, 100 * MIN_IN_FIELD, "%", sentence + advice, is_minimum=True
    ).of_view(shot.view.name)


def _movement(apart: Apart) -> Check:
    """Return the check that all views show the bone at one place."""
    limit = float(np.sqrt(chdtri(apart.freedom, FALSE_ALARM)))
    shift = f"; a shift of {limit / apart.sigma_per_mm:.0f} mm along a beam may not be noticed"
    return at_most(
        "bone movement", apart.sigma, limit, "s.d.",
        f"The bone's poses in the single views differ by {apart.sigma:.1f} standard deviations"
        + (shift if apart.sigma <= limit else ""),
        otherwise=": it moved between the images, or CT or mesh have another size. Take both images again "
        "without moving patient or frame.",
    )  # fmt: skip
