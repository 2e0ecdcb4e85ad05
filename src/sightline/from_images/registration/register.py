"""Registration of a bone to two or more calibrated views."""

from collections.abc import Sequence

from sightline.calibration import CalibratedView
from sightline.common.threads import one_blas_thread
from sightline.errors import UnusableInputError
from sightline.from_images.registration import errors
from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.checks import checks
from sightline.from_images.registration.movement import apart
from sightline.from_images.registration.observed import BoneShot
from sightline.from_images.registration.result import BonePose
from sightline.from_images.registration.search import BoneStart, search, started
from sightline.imaging import Radiograph


@one_blas_thread
def register_bone(
    bone: ScannedBone, images: Sequence[Radiograph], views: Sequence[CalibratedView], start: BoneStart | None = None
) -> BonePose:
    """Return the pose of a bone in CFCS from two images or more and the view of each, with its error and checks.

    Without a `start` all rotations are tried, about where the images' middles meet. Raises UnusableInputError without
    two images, where no view shows the start, or where the views' lines of sight are nearly parallel.
    """
    if len(images) != len(views) or len(views) < 2:
        raise UnusableInputError(f"give two images or more, and a view for each, not {len(images)} and {len(views)}")
    shots = [BoneShot(image, view) for image, view in zip(images, views, strict=True)]
    fits = search(shots, bone, started(shots, bone, start))
    best = fits[0]
    centre, spread = best.pose.apply(bone.centre_mm), best.pose.rotation.apply(bone.spread_mm)
    shown, calibration = errors.of_images(best.views), errors.of_calibration(views, centre, spread)
    between = apart(shots, bone, best)
    return BonePose(
        pose=best.pose,
        centre_mm=centre,
        covariance=None if calibration is None else shown + calibration,
        apart=between,
        checks=tuple(checks(shots, bone, fits, between, error_known=calibration is not None)),
        bone=bone,
        shots=tuple(shots),
        loss=best.loss,
    )
