"""The focal length of a view in pixels, and what a C-arm's known distance says of it.

A calibration determines, in the frame's own lengths, how far the source is from the plate; and, without any length, the
solid angle of a pixel. Its inverse root is the distance from source to detector in pixels: times the size of a pixel it
is the C-arm's distance, whatever the scale of the frame file. So the two are compared apart: the focal length with
distance and pixel size tells a plate that has shifted along the beam, the distance to the plate a frame of another
scale, as it must be smaller than that to the detector.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.hull import Hull
from sightline.calibration.joint import JointFit
from sightline.calibration.view import PlaneMap
from sightline.checks import Check
from sightline.errors import UnusableInputError
from sightline.geometry.covariance import TWO_SIDED_999, response
from sightline.geometry.planes import Plane

# As a C-arm orbits, source and detector part by 6 to 8 mm of 1000 (physics.md, C-arm): the most that is allowed.
MAX_FLEX = 0.008
# What one image's distance differs by from the next, s.d.: 3 of 1000 mm (physics.md, C-arm).
_FLEX_SD = 0.003
# An image whose pixels differ by more in size is an intensifier's, whose own magnification changes from image to image
# by 0.8 %, s.d. [measured on the twin; flat panels differ by 0.6 % at most, intensifiers by 6 to 19 %].
_MAX_PANEL_SPREAD = 0.02
# From the focal spot to the hip, and so to any plate behind it: 300 mm to the skin of a patient of a mobile C-arm
# (21 CFR 1020.32(g)), and half of a slim hip's depth [ours].
MIN_SOURCE_PLATE_MM = 400.0
# Half the side of the square of pixels whose solid angle is taken, in radii of the beads' hull [ours].
_REACH = 0.5


def pixel_solid_angle(plane_map: PlaneMap, plane: Plane, focal_point_mm: np.ndarray, uv_px: np.ndarray) -> np.ndarray:
    """(N,) solid angle, seen from the focal point, of the pixels (N, 2).

    A pixel whose ray meets the plane at the distance P, at the angle a to its normal, fills det(dxy/duv) cos(a) / P².
    """
    xy, slopes = plane_map.linearised(uv_px)
    rays = plane.to_space(xy) - focal_point_mm
    distance = np.linalg.norm(rays, axis=1)
    return np.abs(np.linalg.det(slopes)) * np.abs(rays @ plane.normal) / distance**3


@dataclass(frozen=True, eq=False)
class FocalLength:
    """`value_px` at a pixel, the image's middle, and between `low_px` and `high_px` over the used beads,
    once their obliquity to the middle is allowed for: on a flat panel nearly one number, on an intensifier as far apart
    as its distortion makes them.

    `plate_mm`: from the source to the plate along the ray of the middle; `plate_sd_mm`. `variance`: of log `value_px`,
    without the frame's errors; `frame_response` (K,): of log `value_px` to the unit-variance errors of the frame.
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
        """Of a smooth map at a pixel (2,)."""
        plane, focal = fit.beads.plane, fit.pencil.focal_point_mm
        radius = Hull.of(fit.beads.uv_px).radius_px
        corners = middle_px + _REACH * radius * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        uv = np.concatenate([corners, middle_px[None]])

        def values(z: np.ndarray) -> np.ndarray:
            """(K, 2) of (K, 13): log focal length, and distance to the plate."""
            rays = plane.to_space(z[:, 3:].reshape(len(z), -1, 2)) - z[:, None, :3]
            length = np.linalg.norm(rays, axis=2)
            unit = rays[:, :4] / length[:, :4, None]
            solid = np.linalg.norm(np.cross(unit[:, 2] - unit[:, 0], unit[:, 3] - unit[:, 1]), axis=1) / 2
            return np.stack([np.log(2 * _REACH * radius) - np.log(solid) / 2, length[:, 4]], axis=1)

        value, by = response(values, np.concatenate([focal, fit.map.to_plane(uv).ravel()]))
        errors = fit.line_errors(uv)
        own, frame = by @ (errors.noise + errors.misfit) @ by.T, by @ errors.frame_factor
        low, high = _over_beads(fit, middle_px)
        sd = float(np.sqrt(own[1, 1] + frame[1] @ frame[1]))
        return FocalLength(float(np.exp(value[0])), low, high, float(own[0, 0]), frame[0], float(value[1]), sd)

    @property
    def is_of_a_panel(self) -> bool:
        """Whether all pixels are of one size, as etched ones are."""
        return bool(np.log(self.high_px / self.low_px) < _MAX_PANEL_SPREAD)

    @property
    def sd(self) -> float:
        """Of log `value_px`."""
        return float(np.sqrt(self.variance + self.frame_response @ self.frame_response))


@dataclass(frozen=True)
class CArm:
    """What is known of a C-arm: from focal spot to detector, mm, and the size of a pixel on the detector, mm, or None.

    Raises UnusableInputError for lengths that are not positive.
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

    def checks(self, found: FocalLength) -> list[Check]:
        """Of the distance to the plate, and of the focal length where the size of a pixel is known."""
        out = [self._plate(found)]
        return out if self.pixel_mm is None else [*out, self._focal_length(found, self.pixel_mm)]

    def _plate(self, found: FocalLength) -> Check:
        sid, spare = self.source_detector_mm, TWO_SIDED_999 * found.plate_sd_mm
        high, low = (1 + MAX_FLEX) * sid + spare, MIN_SOURCE_PLATE_MM - spare
        figure = found.plate_mm
        passed = low <= figure <= high
        sentence = (
            f"By the frame file the XRII plate is {figure:.0f} mm from the X-ray source, the detector {sid:.0f} mm"
        )
        sentence += (
            "."
            if passed
            else ": the plate cannot lie behind the detector. The file is of a larger scale than the frame, or the "
            "source-detector distance is not this one: measure the frame, or give the distance with --sid."
            if figure > high
            else f": below {MIN_SOURCE_PLATE_MM:.0f} mm no hip fits between them. The file's scale is smaller than the "
            "frame's: measure the frame."
        )
        return Check("source distance", bool(passed), figure, float(high if figure >= low else low), "mm", sentence)

    def _focal_length(self, found: FocalLength, pixel_mm: float) -> Check:
        sid = self.source_detector_mm
        low, value, high = (pixel_mm * px for px in (found.low_px, found.value_px, found.high_px))
        beyond = float(max(np.log(sid / max(high, value)), np.log(min(low, value) / sid), 0.0))
        limit = MAX_FLEX + TWO_SIDED_999 * found.sd
        passed = beyond <= limit
        sentence = (
            f"Focal length times pixel size is {value:.0f} mm ({low:.0f} to {high:.0f} over the image), the "
            f"source-detector distance {sid:.0f} mm"
        )
        sentence += (
            f"; up to {100 * limit:.1f} % beyond may be flex of the C-arm."
            if passed
            else ": the plates are not as far apart as the frame file says, or distance or pixel size are not these: "
            "measure the frame, or give --sid and --pixel."
        )
        return Check("focal length", passed, 100 * beyond, 100 * limit, "%", sentence)


def steady_check(found: FocalLength, before: Sequence[FocalLength]) -> Check:
    """Whether the focal length of a flat panel's image is that of earlier ones of the same view and C-arm: plates of a
    frame that was hit or moved on its arm change it. Nothing that both have in common shows, such as a wrong file."""
    changes = np.array([np.log(found.value_px / one.value_px) for one in before])
    variances = [
        found.variance + one.variance + ((found.frame_response - one.frame_response) ** 2).sum() + 2 * _FLEX_SD**2
        for one in before
    ]
    limits = TWO_SIDED_999 * np.sqrt(variances)
    worst = int(np.argmax(np.abs(changes) / limits))
    figure, limit = 100 * float(abs(changes[worst])), 100 * float(limits[worst])
    passed = figure <= limit
    sentence = (
        f"The focal length is {figure:.2f} % from that of an earlier image of this view; {limit:.1f} % may be flex"
    )
    sentence += (
        "."
        if passed
        else ". A plate has moved against the other since, or the C-arm is another one or magnifies otherwise: look at "
        "the frame, and measure it; with another C-arm begin a new case."
    )
    return Check("focal length before", passed, figure, limit, "%", sentence)


def _over_beads(fit: JointFit, middle_px: np.ndarray) -> tuple[float, float]:
    """Least and greatest local focal length. A flat panel's pixel, seen at the angle t to its normal, looks smaller by
    cos³ t."""
    plane, focal = fit.beads.plane, fit.pencil.focal_point_mm
    uv = np.concatenate([middle_px[None], fit.beads.uv_px])
    rays = plane.to_space(fit.map.to_plane(uv)) - focal
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    local = np.sqrt((rays @ rays[0]) ** 3 / pixel_solid_angle(fit.map, plane, focal, uv))
    return float(local.min()), float(local.max())
