"""The result of a check shot: the drilled wire against the plan, and its checks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check, CheckCode, Limits, at_most, failed
from sightline.common.geometry.covariance import length_quantile
from sightline.common.show import Shown, checks_lines, numbers

MIN_LANDMARKS = 3  # fewer do not determine a rotation
MAX_OUTLIER = 4.0  # standard deviations; eight good shots had 3.2 at most, one with a tip 1 mm off 4.8 [calc]
MAX_RESIDUAL = 2.0  # [ours] rms of the residuals over their stated standard deviations: these would be wrong by half


@dataclass(frozen=True, eq=False, repr=False)
class CheckShot(Shown):
    """The drilled wire against the plan, in the CFCS of the planning images, in which the bone is at rest.

    `entry_mm` (3,): the wire at the planned entry's depth; `tip_mm` (3,). `deviation_mm` (5,): of the entry
    perpendicular to the planned axis (2), of the tip perpendicular to it (2) and along it (1, positive: too deep);
    the perpendicular axes are the rows of `across` (2, 3). `covariance_mm2` (5, 5): of the deviation. `length_mm`:
    planned, from the entry to the tip. `movement`: of the bone against the frame, from planning CFCS to check CFCS.
    `landmarks`: how many were found again. `bow_mm`: largest distance of the centre line from its chord; `bow_sigma`:
    rms of its bending terms over their standard deviations. `residual_rms`: rms of the residuals over their stated
    standard deviations. `outlier_sigma`: the largest single residual, in its standard deviations.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> plan = sl.plan([pa, lateral], [[162, 689], [684, 692]], [[818, 366], [378, 276]], side="right")
    >>> shot = sl.check_shot(plan, [pa, lateral], ["check_pa.dcm", "check_lateral.dcm"], "gamma")
    >>> shot.tip_deviation_mm < 3.0
    True
    """

    entry_mm: np.ndarray
    tip_mm: np.ndarray
    deviation_mm: np.ndarray
    covariance_mm2: np.ndarray
    across: np.ndarray
    length_mm: float
    movement: RigidTransform
    landmarks: int
    bow_mm: float
    bow_sigma: float
    residual_rms: float
    outlier_sigma: float
    checks: tuple[Check, ...] = ()

    def summary(self) -> str:
        """Return how far the wire lies from its plan, how well that is known, and the checks that failed."""
        angles = np.rad2deg([self.angle_rad, self.direction_error_95_rad])
        known = "known to {:.2f} mm (95 %)".format
        return "\n".join(
            [
                f"Check shot: {'passed' if self.passed else 'FAILED'}; CFCS of the planning images",
                f"  entry {numbers(self.entry_mm, 2)} mm, {self.entry_deviation_mm:.2f} mm beside the plan, "
                + known(self.entry_error_95_mm),
                f"  tip   {numbers(self.tip_mm, 2)} mm, {self.tip_deviation_mm:.2f} mm from the plan, "
                + known(self.tip_error_95_mm),
                f"  direction {angles[0]:.2f}° from the plan, known to {angles[1]:.2f}° (95 %)",
                *checks_lines(self.checks, 4),
            ]
        )

    @property
    def entry_deviation_mm(self) -> float:
        """Distance of the wire from the planned entry, perpendicular to the planned axis."""
        return float(np.linalg.norm(self.deviation_mm[:2]))

    @property
    def tip_deviation_mm(self) -> float:
        """Distance of the tip from the planned one."""
        return float(np.linalg.norm(self.deviation_mm[2:]))

    def beside(self, along_mm: float) -> tuple[float, float]:
        """Return how far a straight wire lies beside the plan at a distance from the entry, mm, and the 95 % bound of
        that value's error."""
        share = along_mm / (self.length_mm + self.deviation_mm[4])
        across = np.hstack([(1 - share) * np.eye(2), share * np.eye(2), np.zeros((2, 1))])
        covariance = across @ self.covariance_mm2 @ across.T
        return float(np.linalg.norm(across @ self.deviation_mm)), float(length_quantile(covariance))

    @property
    def angle_rad(self) -> float:
        """Angle between the chord (entry to tip) and the planned axis."""
        return float(np.arctan(np.linalg.norm(self._to_direction @ self.deviation_mm)))

    @property
    def entry_error_95_mm(self) -> float:
        """95 % bound of the error of the entry's deviation."""
        return float(length_quantile(self.covariance_mm2[:2, :2]))

    @property
    def tip_error_95_mm(self) -> float:
        """95 % bound of the error of the tip's deviation."""
        return float(length_quantile(self.covariance_mm2[2:, 2:]))

    @property
    def direction_error_95_rad(self) -> float:
        """95 % bound of the error of the chord's direction."""
        return float(length_quantile(self._to_direction @ self.covariance_mm2 @ self._to_direction.T))

    @property
    def _to_direction(self) -> np.ndarray:
        return np.hstack([-np.eye(2), np.eye(2), np.zeros((2, 1))]) / self.length_mm

    @property
    def passed(self) -> bool:
        """True if every check passed."""
        return not failed(self.checks)

    @property
    def at_holes(self) -> bool:
        """True for a drill through a nail, which is judged at both holes instead of at its tip."""
        return any(check.code is CheckCode.WIRE_AT_FAR_HOLE for check in self.checks)

    def document(self) -> dict[str, Any]:
        """Return everything as JSON types: mm, angles in degrees."""
        return {
            "coordinates": "CFCS of the planning images",
            "entry_mm": self.entry_mm.tolist(),
            "tip_mm": self.tip_mm.tolist(),
            "deviation": {
                "entry_mm": self.entry_deviation_mm,
                "tip_mm": self.tip_deviation_mm,
                "tip_across_mm": float(np.linalg.norm(self.deviation_mm[2:4])),
                "tip_along_mm": float(self.deviation_mm[4]),
                "direction_deg": float(np.rad2deg(self.angle_rad)),
            },
            "error_95": {
                "entry_mm": self.entry_error_95_mm,
                "tip_mm": self.tip_error_95_mm,
                "direction_deg": float(np.rad2deg(self.direction_error_95_rad)),
            },
            "bow_mm": self.bow_mm,
            "bow_sigma": self.bow_sigma,
            "landmarks": self.landmarks,
            "bone_moved": self.movement.as_matrix().tolist(),
            "residual_rms": self.residual_rms,
            "passed": self.passed,
            "checks": [vars(check) for check in self.checks],
        }


def checks(
    shot: CheckShot,
    limits: Limits,
    views: Sequence[CalibratedView],
    walls_mm: float | None = None,
    registered: tuple[Check, ...] = (),
) -> tuple[Check, ...]:
    """Return the checks of the drilled wire, the check images' own checks first.

    `walls_mm`: of a drill through a nail, between its walls along the plan; it is judged at both instead of at its tip.
    `registered`: the checks of the registrations that tell the bone's movement, instead of landmarks.
    """
    far_mm = shot.tip_error_95_mm if walls_mm is None else shot.beside(walls_mm)[1]
    return (
        *(check.of_view(view.name) for view in views for check in view.checks),
        *_deviations(shot, limits, walls_mm),
        check_shot_error(max(shot.entry_error_95_mm, far_mm), shot, limits),
        *(registered or (_landmarks(shot),)),
        _residuals(shot),
        _outlier(shot),
        _bow(shot),
    )


def _deviations(shot: CheckShot, limits: Limits, walls_mm: float | None) -> tuple[Check, ...]:
    entry, tip, limit = shot.entry_deviation_mm, shot.tip_deviation_mm, limits.position_mm
    angle, angle_limit, angle_95 = (
        float(np.rad2deg(a)) for a in (shot.angle_rad, limits.direction_rad, shot.direction_error_95_rad)
    )
    at_entry = (
        f"At the entry the wire lies {entry:.2f} mm from the plan (known to {shot.entry_error_95_mm:.2f} mm, 95 %)."
    )
    at_tip = (
        f"The tip lies {tip:.2f} mm from the planned one, {shot.deviation_mm[4]:+.2f} mm of it along the plan "
        f"(known to {shot.tip_error_95_mm:.2f} mm, 95 %)."
    )
    chord = f"The chord from entry to tip lies at {angle:.2f}° to the plan (known to {angle_95:.2f}°, 95 %)."
    tips = [Check("wire tip", tip <= limit, tip, limit, "mm", at_tip)]
    if walls_mm is not None:
        tips = _through(shot, limits, walls_mm)
    return (
        Check("wire entry", entry <= limit, entry, limit, "mm", at_entry),
        *tips,
        Check("wire direction", angle <= angle_limit, angle, angle_limit, "°", chord),
    )


def _through(shot: CheckShot, limits: Limits, walls_mm: float) -> list[Check]:
    """Return the checks of a drill at the far wall of a nail, and of its tip beyond that."""
    (far, error), limit = shot.beside(walls_mm), limits.position_mm
    past, most = shot.length_mm + float(shot.deviation_mm[4]) - walls_mm, limits.beyond_mm + limits.position_mm
    at_far = f"At the far hole the wire lies {far:.2f} mm from the plan (known to {error:.2f} mm, 95 %)."
    at_tip = f"The tip lies {past:.1f} mm beyond the far hole"
    at_tip += "." if 0.0 < past <= most else f"; it must have passed it, and lie at most {most:g} mm beyond it."
    return [
        Check("wire at far hole", far <= limit, far, limit, "mm", at_far),
        Check("wire tip", 0.0 < past <= most, past, most, "mm", at_tip),
    ]


def check_shot_error(position_95_mm: float, shot: CheckShot, limits: Limits) -> Check:
    """Return the check that the deviations are known to within their limits; otherwise passing them means little."""
    share = max(position_95_mm / limits.position_mm, shot.direction_error_95_rad / limits.direction_rad)
    sentence = (
        "Entry, tip and direction are known to within their limits."
        if share <= 1.0
        else "The error of entry, tip or direction is larger than its limit: find more landmarks again, or bring more "
        "beads into the field."
    )
    return Check("check shot error", share <= 1.0, share, 1.0, "of the limit", sentence)


def _landmarks(shot: CheckShot) -> Check:
    n = shot.landmarks
    shows = (
        "its movement against the frame is known."
        if n >= MIN_LANDMARKS
        else "they show a shift of the bone but no rotation; find three or more in all four images."
        if n
        else "a movement of the bone cannot be seen, and it is assumed to be nearly still; find three or more in all "
        "images."
    )
    sentence = f"{n} landmarks of the bone were found again: {shows}"
    return Check("bone landmarks", n >= MIN_LANDMARKS, float(n), float(MIN_LANDMARKS), "landmarks", sentence)


def _residuals(shot: CheckShot) -> Check:
    states = f"The residuals of wire and landmarks in the four images are {shot.residual_rms:.1f} times what is stated"
    otherwise = ": look for a wrong landmark, another wire, or an image that is not of this plan."
    return at_most("check shot residuals", shot.residual_rms, MAX_RESIDUAL, "σ", states, otherwise=otherwise)


def _outlier(shot: CheckShot) -> Check:
    states = f"The largest single residual is {shot.outlier_sigma:.1f} standard deviations"
    otherwise = (
        ": a tip, a piece of the wire or a landmark is wrong in one image; look at both, and take the shot again."
    )
    return at_most("check shot outlier", shot.outlier_sigma, MAX_OUTLIER, "σ", states, otherwise=otherwise)


def _bow(shot: CheckShot) -> Check:
    """Return the bow, for information only: a bent wire may still end at the right place."""
    sentence = (
        f"Between entry and tip the wire is bent by up to {shot.bow_mm:.2f} mm, {shot.bow_sigma:.1f} times the "
        "measurement error of a straight wire."
    )
    return Check("wire bow", True, shot.bow_mm, None, "mm", sentence)
