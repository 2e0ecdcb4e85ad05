"""What a check shot found, and what speaks for or against the wire."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.calibration.view import CalibratedView
from sightline.checks import Check, Limits, failed
from sightline.geometry.covariance import length_quantile

FEWEST_LANDMARKS = 3  # that tell of a rotation
LARGEST_OUTLIER = 4.0  # standard deviations; eight honest shots had 3.2 at most, one with a tip 1 mm off 4.8 [calc]
LARGEST_RESIDUAL = 2.0  # rms of residuals over what is stated [ours]


@dataclass(frozen=True, eq=False)
class CheckShot:
    """The wire against the plan, in the bone: CFCS of the planning images.

    `entry_mm` (3,): where the wire passes the planned entry, across the planned axis; `tip_mm` (3,). `deviation_mm`
    (5,): of the entry across (2), of the tip across (2) and along (1, positive: too deep), across along the rows of
    `across` (2, 3); `covariance_mm2` (5, 5). `length_mm`: planned, from the entry to where the tip ends. `movement`: of
    the bone against the frame, from planning CFCS to check CFCS. `bow_mm`: largest distance of the centre line from the
    chord; `bow_sigma`: of its terms together, over their standard deviations. `residual_rms`: over what is stated.
    `outlier_sigma`: of the observation that all others contradict most.
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

    @property
    def entry_deviation_mm(self) -> float:
        """Across the planned axis."""
        return float(np.linalg.norm(self.deviation_mm[:2]))

    @property
    def tip_deviation_mm(self) -> float:
        """In all directions."""
        return float(np.linalg.norm(self.deviation_mm[2:]))

    @property
    def angle_rad(self) -> float:
        """Between chord (entry to tip) and planned axis."""
        return float(np.arctan(np.linalg.norm(self._to_direction @ self.deviation_mm)))

    @property
    def entry_error_95_mm(self) -> float:
        """With a probability of 95 % the deviation's vector errs by less."""
        return float(length_quantile(self.covariance_mm2[:2, :2]))

    @property
    def tip_error_95_mm(self) -> float:
        """The same of the tip."""
        return float(length_quantile(self.covariance_mm2[2:, 2:]))

    @property
    def direction_error_95_rad(self) -> float:
        """The same of the chord's direction."""
        return float(length_quantile(self._to_direction @ self.covariance_mm2 @ self._to_direction.T))

    @property
    def _to_direction(self) -> np.ndarray:
        return np.hstack([-np.eye(2), np.eye(2), np.zeros((2, 1))]) / self.length_mm

    @property
    def passed(self) -> bool:
        """True if every check passed."""
        return not failed(self.checks)

    def document(self) -> dict[str, Any]:
        """Everything as JSON types; mm, and degrees where a person reads."""
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


def checks(shot: CheckShot, limits: Limits, views: Sequence[CalibratedView]) -> tuple[Check, ...]:
    """What speaks for or against the wire, the check images' own checks first."""
    return (
        *(replace(check, sentence=f"{view.name}: {check.sentence}") for view in views for check in view.checks),
        *_deviations(shot, limits),
        _error(shot, limits),
        _landmarks(shot),
        _residuals(shot),
        _outlier(shot),
        _bow(shot),
    )


def _deviations(shot: CheckShot, limits: Limits) -> tuple[Check, ...]:
    entry, tip, limit = shot.entry_deviation_mm, shot.tip_deviation_mm, limits.position_mm
    angle, angle_limit, angle_95 = (
        float(np.rad2deg(a)) for a in (shot.angle_rad, limits.direction_rad, shot.direction_error_95_rad)
    )
    at_entry = (
        f"At the entry the wire lies {entry:.2f} mm beside the plan (known to {shot.entry_error_95_mm:.2f} mm, 95 %)."
    )
    at_tip = (
        f"The tip lies {tip:.2f} mm from the planned one, {shot.deviation_mm[4]:+.2f} mm of it along the plan "
        f"(known to {shot.tip_error_95_mm:.2f} mm, 95 %)."
    )
    chord = f"The chord from entry to tip lies at {angle:.2f}° to the plan (known to {angle_95:.2f}°, 95 %)."
    return (
        Check("wire entry", entry <= limit, entry, limit, "mm", at_entry),
        Check("wire tip", tip <= limit, tip, limit, "mm", at_tip),
        Check("wire direction", angle <= angle_limit, angle, angle_limit, "°", chord),
    )


def _error(shot: CheckShot, limits: Limits) -> Check:
    """A deviation within its limit says little where it is not known to that."""
    position = max(shot.entry_error_95_mm, shot.tip_error_95_mm) / limits.position_mm
    share = max(position, shot.direction_error_95_rad / limits.direction_rad)
    sentence = (
        "Entry, tip and direction are known to within their limits."
        if share <= 1.0
        else "Entry, tip or direction is not known to within its limit: find more landmarks again, or bring more beads "
        "into the field."
    )
    return Check("check shot error", share <= 1.0, share, 1.0, "of the limit", sentence)


def _landmarks(shot: CheckShot) -> Check:
    n = shot.landmarks
    sentence = f"{n} landmarks of the bone were found again: "
    if n == 0:
        sentence += (
            "nothing tells whether it moved, and it is taken to be nearly still; find three or more in all images."
        )
    elif n < FEWEST_LANDMARKS:
        sentence += "they tell how it was shifted, not whether it turned; find three or more in all four images."
    else:
        sentence += "its movement against the frame is known."
    passed = n >= FEWEST_LANDMARKS
    return Check("bone landmarks", passed, float(n), float(FEWEST_LANDMARKS), "landmarks", sentence)


def _residuals(shot: CheckShot) -> Check:
    figure, limit = shot.residual_rms, LARGEST_RESIDUAL
    sentence = f"Wire and landmarks fit the four images to {figure:.1f} of what is stated"
    sentence += "." if figure <= limit else ": a landmark, a wire or an image is not what it is taken for."
    return Check("check shot residuals", figure <= limit, figure, limit, "σ", sentence)


def _outlier(shot: CheckShot) -> Check:
    figure, limit = shot.outlier_sigma, LARGEST_OUTLIER
    sentence = f"The observation that all others contradict most is off by {figure:.1f} standard deviations"
    sentence += (
        "."
        if figure <= limit
        else ": a tip, a piece of the wire or a landmark is wrong in one image; look at both, and take the shot again."
    )
    return Check("check shot outlier", figure <= limit, figure, limit, "σ", sentence)


def _bow(shot: CheckShot) -> Check:
    """For information: a bent wire may end where it should."""
    sentence = (
        f"Between entry and tip the wire is bent by up to {shot.bow_mm:.2f} mm, {shot.bow_sigma:.1f} times what "
        "straight ones seem to be."
    )
    return Check("wire bow", True, shot.bow_mm, None, "mm", sentence)
