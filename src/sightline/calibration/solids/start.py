"""The images of a solid before their adjustment: its balls, what is known of each camera, and where to begin."""

from contextlib import suppress

import numpy as np

from sightline.calibration.maps.hull import refuse_collinear
from sightline.calibration.maps.polynomial import Affine
from sightline.calibration.maps.smooth import FittedSmoothMap
from sightline.calibration.solids.adjustment import iterated
from sightline.calibration.solids.images import MIN_BALLS, SolidBalls, SolidImage
from sightline.calibration.solids.panel_camera import PanelCamera, PanelPrior
from sightline.calibration.solids.plate_image import MIN_PLATE_BALLS, DetectorPlateImage
from sightline.calibration.view_checks.lengths import CArm
from sightline.common.geometry.planes import Plane
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError
from sightline.frame import Frame

# S.d. of what is known of a panel [ours]: the stated source-detector distance changes by 6 to 8 mm over the orbit and
# the piercing point wanders by up to 16 mm where the C-arm flexes (physics.md, C-arm).
DISTANCE_SD_MM = 10.0
CENTRE_SD_MM = 5.0
# Of a panel that states nothing [ours]: image widths between 1/8 and 1/2 of the focal length, about this mean.
FOCAL_WIDTHS, FOCAL_SHARE = 4.0, 0.5
CENTRE_SHARE = CENTRE_SD_MM / 200.0  # of the image's width, for the smallest panels of C-arms
UNKNOWN_NOISE_PX = 0.5  # where none is stated: a careful click (physics.md, Picks)
# Difference of chi-square between an image and its mirror image that decides [ours]: odds of e^12 to 1.
MIRROR_EVIDENCE = 25.0
# Of a plate on the detector: the middle of the beam is this far from its own, per axis [ours]: 5 mm as of a panel, 3 mm
# and 0.3° by which it is put on askew. A C-arm that states no distance has 0.9 to 1.2 m.
PLATE_CENTRE_SD_MM = 8.0
USUAL_DISTANCE_MM, USUAL_SHARE = 1000.0, 0.1
MIN_DEPTH = 0.1  # of the solid's balls about their best plane, rms over their rms distance from the middle [ours]


def solid_of(frame: Frame) -> SolidBalls:
    """Return the balls of a frame with a solid. Raises CalibrationRefusedError for a solid that is nearly flat."""
    assert frame.solid is not None  # noqa: S101 - checked by the caller
    xyz = frame.solid.xyz_mm
    spread = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if spread[2] < MIN_DEPTH * np.linalg.norm(spread):
        raise CalibrationRefusedError(
            f"the balls of frame {frame.name} lie nearly in one plane, which leaves the distance of the X-ray source "
            "open; use a solid whose balls fill a volume"
        )
    radius = np.array([f.diameter_mm for f in frame.fiducials]) / 2
    return SolidBalls(frame.xyz_mm, radius, frame.error_factor, len(xyz))


def image_of(seen: Observations, frame: Frame, solid: SolidBalls, c_arm: CArm | None) -> SolidImage:
    """Return the balls of an image and what is known of its camera.

    Raises ObservationsError, CalibrationRefusedError.
    """
    rows = rows_of(seen, frame)
    of_solid = int((rows < solid.count).sum())
    if of_solid < MIN_BALLS:
        raise CalibrationRefusedError(
            f"view {seen.view} shows {of_solid} balls of the solid; {MIN_BALLS} are needed, 9 or more are good: bring "
            "the whole solid into the field"
        )
    if frame.detector is not None:
        return _on_plate(seen, rows, solid, frame.detector.plane, c_arm)
    if seen.image_shape is None:
        raise CalibrationRefusedError(
            f"the image size of view {seen.view} is not known, and with it where its principal point may be; give "
            "image_shape"
        )
    return SolidImage(seen.uv_px, noise_px2(seen), rows, _prior(seen.image_shape, c_arm))


def _on_plate(
    seen: Observations, rows: np.ndarray, solid: SolidBalls, plane: Plane, c_arm: CArm | None
) -> DetectorPlateImage:
    """Return the balls of an intensifier's image with a plate of a plane, in its own coordinates, on the detector.

    Raises CalibrationRefusedError.
    """
    on, noise = rows >= solid.count, noise_px2(seen)
    if on.sum() < MIN_PLATE_BALLS:
        raise CalibrationRefusedError(
            f"view {seen.view} shows {on.sum()} balls of the plate on the detector; {MIN_PLATE_BALLS} are needed, all "
            "over the image: put the plate in front of the detector, and open the collimator"
        )
    uv, xy = seen.uv_px[on], plane.to_plane(solid.xyz_mm[rows[on]])
    refuse_collinear(uv, f"in the image, the {on.sum()} balls seen of the plate on the detector")
    unit, radius_mm = Affine.fit(uv, xy)
    ball_px2 = solid.error_mm**2 / (radius_mm**2 * abs(np.linalg.det(unit.matrix)))
    start = FittedSmoothMap.fit(uv, xy, float(np.sqrt(np.trace(noise[on].mean(axis=0)) / 2 + ball_px2)))
    distance, share = USUAL_DISTANCE_MM, USUAL_SHARE
    if c_arm is not None:
        distance, share = c_arm.source_detector_mm, DISTANCE_SD_MM / c_arm.source_detector_mm
    middle = np.zeros(3)  # of the detector's input plane
    x, y = plane.to_plane(middle).tolist()
    prior = PanelPrior(distance + float(plane.height_mm(middle)), share, (x, y), PLATE_CENTRE_SD_MM)
    return DetectorPlateImage(seen.uv_px, noise, rows, prior, solid.count, plane, start)


def _prior(shape: tuple[int, int], c_arm: CArm | None) -> PanelPrior:
    height, width = shape
    centre = (width - 1) / 2, (height - 1) / 2
    pixel_mm = None if c_arm is None else c_arm.pixel_mm
    if c_arm is None or pixel_mm is None:
        return PanelPrior(FOCAL_WIDTHS * max(shape), FOCAL_SHARE, centre, CENTRE_SHARE * max(shape))
    distance = c_arm.source_detector_mm
    return PanelPrior(distance / pixel_mm, DISTANCE_SD_MM / distance, centre, CENTRE_SD_MM / pixel_mm)


def first_camera(solid: SolidBalls, seen: SolidImage, view: str) -> PanelCamera:
    """Return an approximate camera, mirrored where the image shows the solid as its mirror image.

    Only perspective tells: without it a mirrored image is the solid seen from the other side. On a plate, whose z
    points towards the source, the camera is always mirrored. Raises CalibrationRefusedError.
    """
    image = seen.undistorted()
    (plain, plain_chi2), (mirrored, mirrored_chi2) = (
        _fitted(solid, image, mirrored=handedness) for handedness in (False, True)
    )
    evidence = mirrored_chi2 - plain_chi2  # for the one that is not mirrored
    if isinstance(seen, DetectorPlateImage):
        if evidence > MIRROR_EVIDENCE:
            raise CalibrationRefusedError(
                f"view {view} shows the solid as its mirror image where the plate's z points towards the X-ray source: "
                "put the plate on the right way round, or correct the file of the one that is mirrored"
            )
        return mirrored
    if not abs(evidence) >= MIRROR_EVIDENCE:  # nor if both diverge
        raise CalibrationRefusedError(
            f"view {view} does not tell from which side it shows the solid: its mirror image fits as well; bring more "
            "balls into the field, or use a larger solid"
        )
    return plain if evidence > 0 else mirrored


def _fitted(solid: SolidBalls, image: SolidImage, *, mirrored: bool) -> tuple[PanelCamera, float]:
    """Return the camera of one handedness that fits an image best, and its chi-square, infinite if there is none.

    Of the wrong handedness the last steps may gain too little to converge: its chi-square is as good as the least.
    """
    start = PanelCamera.orthographic(image.prior, solid.xyz_mm[image.rows], image.uv_px, mirrored=mirrored)
    with suppress(np.linalg.LinAlgError):
        fit, _ = iterated(solid, [image], [start])
        return fit.cameras[0], fit.chi_square
    return start, np.inf


def rows_of(seen: Observations, frame: Frame) -> np.ndarray:
    """Return (N,): the observed balls' indices among the solid's. Raises ObservationsError."""
    place = {f.id: k for k, f in enumerate(frame.fiducials)}
    if unknown := [i for i in seen.ids if i not in place]:
        raise ObservationsError(
            f"frame {frame.name!r} has no fiducial {', '.join(map(repr, unknown[:5]))}; check that the observations "
            "belong to this frame"
        )
    return np.array([place[i] for i in seen.ids])


def noise_px2(seen: Observations) -> np.ndarray:
    """Return (N, 2, 2), px²: the stated covariances, or those of careful clicks."""
    if seen.covariance_px2 is not None:
        return seen.covariance_px2
    return np.broadcast_to(UNKNOWN_NOISE_PX**2 * np.eye(2), (len(seen), 2, 2))
