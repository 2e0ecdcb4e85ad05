"""Checks of the frame file's lengths: by the focal length of a view in pixels, and by the size of the balls.

A calibration determines the distance from source to plate in the frame file's lengths and, independently of any length,
the solid angle of a pixel. The inverse root of that solid angle is the source-detector distance in pixels; times the
pixel size it is the C-arm's distance, whatever the scale of the frame file. The two are therefore checked separately:
the focal length against distance and pixel size shows a plate that has shifted along the beam; the distance to the
plate, which must be smaller than that to the detector, shows a frame file of a wrong scale.

The ball diameters are the only length of the file that a single image can measure. A wrong scale of the file's
coordinates shows in no residual, since it scales the focal point's distance as well. The shadow of a ball does not
scale with it: seen from the focal point, a ball of radius r at the distance L fills the solid angle pi (r / L)^2, which
the area of its shadow in pixels measures.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.maps.hull import Hull
from sightline.calibration.plates.joint import JointFit
from sightline.calibration.view import PlaneMap
from sightline.common.checks import Check, at_most
from sightline.common.fitting import MAD_TO_SD, MEDIAN_SD, median
from sightline.common.geometry.covariance import TWO_SIDED_999, response
from sightline.common.geometry.lines import unit
from sightline.common.geometry.planes import Plane
from sightline.errors import UnusableInputError
from sightline.frame import Fiducial

# As a C-arm orbits, the source-detector distance changes by 6 to 8 mm of 1000 (physics.md, C-arm): the allowed maximum.
MAX_FLEX = 0.008
# S.d. of that distance from image to image: 3 of 1000 mm (physics.md, C-arm).
_FLEX_SD = 0.003
# Largest log ratio of pixel sizes over an image of a flat panel [measured on the twin: flat panels 0.6 % at most,
# intensifiers 6 to 19 %]. An intensifier's own magnification changes from image to image by 0.8 %, s.d.
_MAX_PANEL_SPREAD = 0.02
# From the focal spot to the hip, and so to any plate behind it: at least 300 mm to the skin with a mobile C-arm
# (21 CFR 1020.32(g)) plus half of a slim hip's depth [ours].
MIN_SOURCE_PLATE_MM = 400.0
# Half the side of the square of pixels whose solid angle is measured, in radii of the beads' convex hull [ours]: its
# corners lie inside at 0.7, where the map does not extrapolate; a smaller square measures the angle less well.
_HALF_SIDE = 0.5
# What balls that the file states rightly look larger, log, in an image without blur by movement. Their rim's profile is
# that of one energy, so a softer beam makes them larger: 3 % at 60 kVp behind 10 cm of tissue; a harder one smaller:
# 2 % at 120 kVp behind 30 cm and 0.3 mm of copper [calc, Kramers spectra]. The mean and its s.d. from machine to
# machine [ours] hold that range within three s.d.; from image to image of one machine: 0.2 to 0.5 % [twin]. Measured at
# 70 kVp, three doses, 0.7 to 2 times the blur: 1.0 ± 0.5 %, -1.0 to 1.9 %, in 108 images of the twin; -0.2 to -0.7 % in
# 4 of gVirtualXray with a harder beam.
_LOOKS, _MACHINE_SD, _IMAGE_SD = 0.006, 0.008, 0.005
# Compression and a display's curve enlarge: by 3.4 and 4.3 % with a gamma of 2.2 [twin]. A logarithmic curve makes
# balls smaller by up to 2.3 % [twin], blur of many pixels by up to 12 % [gVirtualXray]; neither is allowed for.
_MAX_LARGER = 0.06
_MIN_BALLS = 8  # [ours] for a median that two wrong radii do not move by more than its error


def pixel_solid_angle(plane_map: PlaneMap, plane: Plane, focal_point_mm: np.ndarray, uv_px: np.ndarray) -> np.ndarray:
    """Return (N,) the solid angle, seen from the focal point, of the pixels (N, 2).

    It is det(dxy/duv) cos(a) / P² for a ray that meets the plane at the distance P and the angle a to its normal.
    """
    xy, slopes = plane_map.linearised(uv_px)
    rays = plane.to_space(xy) - focal_point_mm
    distance = np.linalg.norm(rays, axis=1)
    return np.abs(np.linalg.det(slopes)) * np.abs(rays @ plane.normal) / distance**3


@dataclass(frozen=True, eq=False)
class FocalLength:
    """The focal length of a view: `value_px` at the image's middle, `low_px` to `high_px` over the used beads.

    The range is corrected for the beads' obliquity: on a flat panel it is nearly one number, on an intensifier as wide
    as its distortion. `plate_mm`: distance from the source to the plate along the middle's ray; `plate_sd_mm`: its
    standard deviation. `variance`: of log `value_px`, without the frame's errors; `frame_response` (K,): of log
    `value_px` to the unit-variance errors of the frame.
    """

    value_px: float
    low_px: float
    high_px: float
    variance: float
    frame_response: np.ndarray
    plate_mm: float
    plate_sd_mm: float

    @staticmethod
    def of(fit: JointFit, middle_px: np.ndarray) -> "FocalLength":
        """Return the focal length of a smooth fit at a pixel (2,)."""
        plane, focal = fit.beads.plane, fit.pencil.focal_point_mm
        radius = Hull.of(fit.beads.uv_px).radius_px
        corners = middle_px + _HALF_SIDE * radius * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        uv = np.concatenate([corners, middle_px[None]])

        def values(z: np.ndarray) -> np.ndarray:
            """Return (K, 2), log focal length and distance to the plate, for (K, 13): focal point and five points."""
            rays = plane.to_space(z[:, 3:].reshape(len(z), -1, 2)) - z[:, None, :3]
            length = np.linalg.norm(rays, axis=2)
            unit = rays[:, :4] / length[:, :4, None]
            solid = np.linalg.norm(np.cross(unit[:, 2] - unit[:, 0], unit[:, 3] - unit[:, 1]), axis=1) / 2
            return np.stack([np.log(2 * _HALF_SIDE * radius) - np.log(solid) / 2, length[:, 4]], axis=1)

        value, by = response(values, np.concatenate([focal, fit.map.to_plane(uv).ravel()]))
        errors = fit.line_errors(uv)
        of_frame = errors.shared()["frame"]
        own = by @ (np.sum(list(errors.by_source().values()), axis=0) - of_frame @ of_frame.T) @ by.T
        frame = by @ of_frame
        low, high = _over_beads(fit, middle_px)
        sd = float(np.sqrt(own[1, 1] + frame[1] @ frame[1]))
        return FocalLength(float(np.exp(value[0])), low, high, float(own[0, 0]), frame[0], float(value[1]), sd)

    @property
    def is_of_a_panel(self) -> bool:
        """Whether all pixels have one size, as those of a flat panel do."""
        return bool(np.log(self.high_px / self.low_px) < _MAX_PANEL_SPREAD)

    @property
    def sd(self) -> float:
        """Standard deviation of log `value_px`, the frame's errors included."""
        return float(np.sqrt(self.variance + self.frame_response @ self.frame_response))


@dataclass(frozen=True)
class CArm:
    """Known dimensions of a C-arm, mm: focal spot to detector, and pixel size on the detector, or None.

    Raises UnusableInputError for lengths that are not positive.

    >>> view = sl.calibrate_image("out/demo/demo_pa.dcm", "gamma", c_arm=sl.CArm(1000.0))
    >>> view.checks[-1].name
    'source distance'
    """

    source_detector_mm: float
    pixel_mm: float | None = None

    def __post_init__(self) -> None:
        pixel_mm = 1.0 if self.pixel_mm is None else self.pixel_mm
        if not (0.0 < self.source_detector_mm < np.inf and 0.0 < pixel_mm < np.inf):
            raise UnusableInputError(
                f"source-detector distance {self.source_detector_mm} mm, pixel {self.pixel_mm} mm; give lengths above "
                "zero"
            )

    def checks(self, length: FocalLength) -> list[Check]:
        """Return the checks of the distance to the plate and, where the pixel size is known, of the focal length."""
        checks = [self._plate(length)]
        return checks if self.pixel_mm is None else [*checks, self._focal_length(length, self.pixel_mm)]

    def _plate(self, length: FocalLength) -> Check:
        sid, margin = self.source_detector_mm, TWO_SIDED_999 * length.plate_sd_mm
        high, low = (1 + MAX_FLEX) * sid + margin, MIN_SOURCE_PLATE_MM - margin
        distance = length.plate_mm
        passed = low <= distance <= high
        sentence = (
            f"By the frame file the XRII plate is {distance:.0f} mm from the X-ray source; the detector is "
            f"{sid:.0f} mm from it"
        )
        sentence += (
            "."
            if passed
            else ", but the plate cannot lie behind the detector. The file's scale is larger than the frame's, or the "
            "source-detector distance is wrong: measure the frame, or give the distance with --sid."
            if distance > high
            else f", but below {MIN_SOURCE_PLATE_MM:.0f} mm no hip fits between source and plate. The file's scale is "
            "smaller than the frame's: measure the frame."
        )
        return Check("source distance", bool(passed), distance, float(high if distance >= low else low), "mm", sentence)

    def _focal_length(self, length: FocalLength, pixel_mm: float) -> Check:
        sid = self.source_detector_mm
        low, value, high = (pixel_mm * px for px in (length.low_px, length.value_px, length.high_px))
        beyond = float(max(np.log(sid / max(high, value)), np.log(min(low, value) / sid), 0.0))
        limit = MAX_FLEX + TWO_SIDED_999 * length.sd
        passed = beyond <= limit
        sentence = (
            f"Focal length times pixel size is {value:.0f} mm ({low:.0f} to {high:.0f} over the image), the "
            f"source-detector distance {sid:.0f} mm"
        )
        sentence += (
            f"; a difference of up to {100 * limit:.1f} % may be flex of the C-arm."
            if passed
            else ": the distance between the plates differs from the frame file, or distance or pixel size are wrong: "
            "measure the frame, or give --sid and --pixel."
        )
        return Check("focal length", passed, 100 * beyond, 100 * limit, "%", sentence)


def steady_check(length: FocalLength, before: Sequence[FocalLength]) -> Check:
    """Return the check that a flat panel's focal length is that of earlier images of the same view and C-arm.

    It shows plates that moved against each other since; an error common to all the images, such as a wrong frame file,
    does not show.
    """
    changes = np.array([np.log(length.value_px / earlier.value_px) for earlier in before])
    variances = [
        length.variance
        + earlier.variance
        + ((length.frame_response - earlier.frame_response) ** 2).sum()
        + 2 * _FLEX_SD**2
        for earlier in before
    ]
    limits = TWO_SIDED_999 * np.sqrt(variances)
    worst = int(np.argmax(np.abs(changes) / limits))
    change, limit = 100 * float(abs(changes[worst])), 100 * float(limits[worst])
    states = (
        f"The focal length differs by {change:.2f} % from that of an earlier image of this view; {limit:.1f} % may be "
        "flex"
    )
    otherwise = (
        ". A plate has moved against the other since, or this is another C-arm or magnification: inspect the "
        "frame and measure it; with another C-arm begin a new case."
    )
    return at_most("focal length before", change, limit, "%", states, otherwise=otherwise)


def _over_beads(fit: JointFit, middle_px: np.ndarray) -> tuple[float, float]:
    """Return the smallest and the largest local focal length over the beads.

    The solid angle of a flat panel's pixel, at the angle t to its normal, is smaller by cos³ t.
    """
    plane, focal = fit.beads.plane, fit.pencil.focal_point_mm
    uv = np.concatenate([middle_px[None], fit.beads.uv_px])
    rays = unit(plane.to_space(fit.map.to_plane(uv)) - focal)
    local = np.sqrt((rays @ rays[0]) ** 3 / pixel_solid_angle(fit.map, plane, focal, uv))
    return float(local.min()), float(local.max())


@dataclass(frozen=True)
class BallSize:
    """How much larger the balls of an image look than the frame file says, natural log: `larger`, the median, and its
    s.d. `sd` by their scatter."""

    larger: float
    sd: float

    @staticmethod
    def of(radius_px: np.ndarray, mm_per_px: np.ndarray, fiducials: Sequence[Fiducial]) -> "BallSize | None":
        """Return the size by shadows of the radii (N,); `mm_per_px` (N,): at each fiducial, across its ray. None with
        too few balls."""
        ball = np.array([one.shape == "ball" for one in fiducials], dtype=bool)
        if ball.sum() < _MIN_BALLS:
            return None
        radius_mm = np.array([one.diameter_mm for one in fiducials]) / 2
        larger = np.log(radius_px * mm_per_px / radius_mm)[ball]
        usual = median(larger)
        return BallSize(usual, float(MEDIAN_SD * MAD_TO_SD * median(np.abs(larger - usual)) / np.sqrt(len(larger))))


def ball_size_check(sizes: Sequence[BallSize]) -> Check:
    """Return the check of the balls in one image, or in several of one frame together.

    In sharp images only compression and display curves differ without limit, and they enlarge. Balls that look smaller
    in all images are therefore the better evidence.
    """
    count = len(sizes)
    usual = float(np.mean([size.larger for size in sizes]))
    variance = sum(size.sd**2 for size in sizes) / count**2
    low = _LOOKS - TWO_SIDED_999 * float(np.sqrt(_MACHINE_SD**2 + _IMAGE_SD**2 / count + variance))
    high = _MAX_LARGER + TWO_SIDED_999 * float(np.sqrt(variance))
    passed = low <= usual <= high
    where = "The" if count == 1 else f"In {count} images together the"
    way, limit, reason = ("smaller", low, "the beam's energy") if usual < 0 else ("larger", high, "blur")
    shown, allowed = (abs(100 * np.expm1(value)) for value in (usual, limit))
    sentence = f"{where} balls look {shown:.1f} % {way} than the frame file says; up to {allowed:.1f} % may be {reason}"
    sentence += (
        ", so a smaller error of the file's scale does not show here."
        if passed
        else ". If the image is sharp, the scale of the file's coordinates is wrong, and with it every length, or its "
        "diameters are: measure both, and correct the file. If it is blurred, take it again."
    )
    return Check("ball size", passed, 100 * usual, 100 * limit, "%", sentence)
