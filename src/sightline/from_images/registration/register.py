"""Registration of a bone's CT or mesh to two or more calibrated views."""

from collections.abc import Sequence
from pathlib import Path

from sightline.calibration import BeadView, CalibratedView
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.common.threads import one_blas_thread
from sightline.errors import UnusableInputError
from sightline.from_images.registration import errors
from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.checks import checks
from sightline.from_images.registration.movement import apart
from sightline.from_images.registration.observed import BoneShot
from sightline.from_images.registration.result import BonePose
from sightline.from_images.registration.search import BoneStart, search
from sightline.imaging import Radiograph
from sightline.imaging.volumes import CtScan, filled, read_ct, read_mesh
from sightline.imaging.volumes.filled import CORTEX_MM
from sightline.imaging.volumes.meshes import FILE_TYPES
from sightline.planning.bone.registered import BoneView


def read_volume(path: str | Path, cortex_mm: float | None = None) -> CtScan:
    """Return a CT, or a mesh filled with `cortex_mm` of cortical bone (default: 3) around cancellous bone.

    CT: NIfTI, NRRD or a folder of slices; closed mesh in mm: STL, PLY or OBJ. Raises UnusableInputError.
    """
    if Path(path).suffix.lower().removeprefix(".") in FILE_TYPES:
        return filled(read_mesh(path), CORTEX_MM if cortex_mm is None else cortex_mm)
    if cortex_mm is not None:
        raise UnusableInputError("a CT has its own cortex; leave out --cortex, which is for meshes")
    return read_ct(path)


@one_blas_thread
def register_bone(
    volume: ScannedBone | CtScan | str | Path,
    images: Sequence[Radiograph],
    views: Sequence[CalibratedView | Pinhole],
    start: BoneStart | None = None,
) -> BonePose:
    """Return the pose of a bone in CFCS, from its CT or mesh, two images or more, and the view of each.

    `volume`: a CT that was cropped to the one bone, or the path of a CT or mesh (`read_volume`). `views`: calibrated
    here, or of `read_view`. `start`: about where it lies; without one all rotations are tried, about where the images'
    middles meet. The pose takes the volume's coordinates, mm, to CFCS; it comes with its error, and with the views'
    checks and its own.

    Raises UnusableInputError without bone in the volume, without two images or their own views, where no view shows
    the start, or where the views' lines of sight are nearly parallel.

    >>> import inspect
    >>> list(inspect.signature(sl.register_bone).parameters)
    ['volume', 'images', 'views', 'start']
    """
    seen = [view.view() if isinstance(view, Pinhole) else view for view in views]
    shots, bone = _shots(images, seen), _bone(volume)
    fits = search(shots, bone, start)
    best = fits[0]
    centre, spread = best.pose.apply(bone.centre_mm), best.pose.rotation.apply(bone.spread_mm)
    shown, calibration = errors.of_images(best.views), errors.of_calibration(seen, centre, spread)
    between = apart(shots, bone, best)
    own = checks(shots, bone, fits, between, error_known=calibration is not None)
    return BonePose(
        matrix=best.pose.as_matrix(),
        centre_mm=centre,
        covariance=None if calibration is None else shown + calibration,
        apart=between,
        checks=(*(check.of_view(view.name) for view in seen for check in view.checks), *own),
        views=tuple(
            BoneView(shot.view.name, shot.view.focal_point_mm, shot.image.pixels_sha256, own.as_matrix(), along)
            for shot, own, along in zip(shots, between.poses, between.along_beam_95_mm, strict=True)
        ),
        volume_sha256=bone.sha256,
        bone=bone,
        shots=tuple(shots),
        loss=best.loss,
    )


def _shots(images: Sequence[Radiograph], views: Sequence[CalibratedView]) -> list[BoneShot]:
    if len(images) != len(views) or len(views) < 2:
        raise UnusableInputError(f"give two images or more, and a view for each, not {len(images)} and {len(views)}")
    for image, view in zip(images, views, strict=True):
        if isinstance(view, BeadView) and view.image_shape != image.shape:
            raise UnusableInputError(
                f"view {view.name} is of an image of another size; give each image its own view, in the same order"
            )
    return [BoneShot(image, view) for image, view in zip(images, views, strict=True)]


def _bone(volume: ScannedBone | CtScan | str | Path) -> ScannedBone:
    scan = read_volume(volume) if isinstance(volume, str | Path) else volume
    return ScannedBone.of_ct(scan) if isinstance(scan, CtScan) else scan
