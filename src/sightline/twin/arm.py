"""Pointing and sag of a C-arm: independent for each view, or from one arm that orbits, tilts, swivels and sags."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.twin.distributions import Arm, Pose


class Sag(NamedTuple):
    """Deviation of a view's geometry from that of a rigid arm, CFCS.

    `shift_mm` (3,): shift of the detector across the beam. `longer_mm`: change of the distance from source to detector.
    `rotation` (3,): rotation vector of the detector, across the beam, rad.
    """

    shift_mm: np.ndarray
    longer_mm: float
    rotation: np.ndarray


class Stance(Protocol):
    """Distribution of a view's beam direction and of the arm's sag."""

    def swing(self, rng: np.random.Generator, beam: np.ndarray) -> np.ndarray | None:
        """Draw a rotation (3, 3) of the intended beam (3,); None if the arm cannot reach it."""
        ...

    def sag(self, rng: np.random.Generator, beam: np.ndarray, axes: np.ndarray) -> Sag:
        """Draw the sag at a beam (3,); `axes` (2, 3): the image's axes, across the beam."""
        ...


@dataclass(frozen=True)
class IndependentViews:
    """Independent views: a direction and a sag are drawn for each."""

    pose: Pose

    def swing(self, rng: np.random.Generator, beam: np.ndarray) -> np.ndarray | None:
        """See Stance."""
        return Rotation.from_rotvec(rng.normal(0.0, self.pose.orbit, 3)).as_matrix()

    def sag(self, rng: np.random.Generator, beam: np.ndarray, axes: np.ndarray) -> Sag:
        """See Stance."""
        rotation = rng.normal(0.0, self.pose.detector_tilt, 2) @ axes
        longer = rng.normal(0.0, self.pose.sdd_mm)
        return Sag(rng.normal(0.0, self.pose.piercing_mm, 2) @ axes, longer, rotation)


@dataclass(frozen=True, eq=False)
class OneArm:
    """One arm in all its views. It bends in proportion to the components of its weight across and along the beam, which
    vary as the sine and the cosine of the orbit: its sag is `waves` (5, 2) times (cos, sin).

    Rows of `waves`: shift along the orbit and along the body, mm; distance, mm; rotation about both of these, rad.
    """

    limits: Arm
    waves: np.ndarray

    def swing(self, rng: np.random.Generator, beam: np.ndarray) -> np.ndarray | None:
        """See Stance. Orbit about the body (Y), tilt about the arm's support (X), swivel about the vertical (Z)."""
        arm = self.limits
        orbit, tilt, swivel = (rng.uniform(-reach, reach) for reach in (arm.orbit, arm.tilt, arm.swivel))
        rotation = Rotation.from_euler("yxz", [orbit, tilt, swivel]).as_matrix()
        low, high = arm.orbit_limits
        return rotation if low <= orbit_of(rotation @ beam) <= high else None

    def sag(self, rng: np.random.Generator, beam: np.ndarray, axes: np.ndarray) -> Sag:
        """See Stance. The sag is a function of the orbit plus a part that does not repeat."""
        angle = orbit_of(beam)
        along_orbit, along_body, longer, *rotation = self.waves @ np.array([np.cos(angle), np.sin(angle)])
        tangent = np.cross([0.0, 1.0, 0.0], beam)
        tangent /= np.linalg.norm(tangent)
        own = np.stack([tangent, np.cross(beam, tangent)])
        shift = np.array([along_orbit, along_body]) + rng.normal(0.0, self.limits.repeat_mm, 2)
        return Sag(shift @ own, longer + rng.normal(0.0, self.limits.repeat_mm), np.array(rotation) @ own)


def draw_arm(rng: np.random.Generator, limits: Arm, pose: Pose) -> OneArm:
    """Draw an arm whose sag has, at every orbit, the standard deviations of an independent view."""
    sd = [pose.piercing_mm, pose.piercing_mm, pose.sdd_mm, pose.detector_tilt, pose.detector_tilt]
    return OneArm(limits, np.array(sd)[:, None] * rng.standard_normal((5, 2)))


def beam_at(orbit: float) -> np.ndarray:
    """Return the beam (3,), CFCS, at an orbit angle, rad: 0 straight up (PA), 90° along +X (lateral)."""
    return np.array([np.sin(orbit), 0.0, np.cos(orbit)])


def orbit_of(beam: np.ndarray) -> float:
    """Return the orbit angle, rad, of a beam (3,), CFCS, as of `beam_at`."""
    return float(np.arctan2(beam[0], beam[2]))
