"""How the arm of a C-arm points and bends: each view by itself, or one arm that orbits, tilts, swivels and sags."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.twin.distributions import Arm, Pose


class Sag(NamedTuple):
    """How a view's geometry departs from a stiff arm's, CFCS: the detector's shift across the beam (3,) mm, the change
    of distance from source to detector, mm, and the detector's turn, a rotation vector (3,) across the beam, rad."""

    shift_mm: np.ndarray
    longer_mm: float
    turn: np.ndarray


class Stance(Protocol):
    """What decides where a view's beam points and how far the arm sags there."""

    def swing(self, rng: np.random.Generator, beam: np.ndarray) -> np.ndarray | None:
        """(3, 3): a rotation of the beam (3,) that was intended; None where the arm does not go."""
        ...

    def sag(self, rng: np.random.Generator, beam: np.ndarray, axes: np.ndarray) -> Sag:
        """At a beam (3,); `axes` (2, 3): across it, those of the image."""
        ...


@dataclass(frozen=True)
class EachAlone:
    """Views that know nothing of each other: a direction and a sag drawn for each."""

    pose: Pose

    def swing(self, rng: np.random.Generator, beam: np.ndarray) -> np.ndarray | None:
        """See Stance."""
        return Rotation.from_rotvec(rng.normal(0.0, self.pose.orbit, 3)).as_matrix()

    def sag(self, rng: np.random.Generator, beam: np.ndarray, axes: np.ndarray) -> Sag:
        """See Stance."""
        turn = rng.normal(0.0, self.pose.detector_tilt, 2) @ axes
        longer = rng.normal(0.0, self.pose.sdd_mm)
        return Sag(rng.normal(0.0, self.pose.piercing_mm, 2) @ axes, longer, turn)


@dataclass(frozen=True, eq=False)
class OneArm:
    """One arm in all its views. A light arm bends in proportion to its weight across and along the beam, which go as
    the sine and the cosine of the orbit: `waves` (5, 2) times (cos, sin) is its sag.

    Rows of `waves`: shift along the orbit and along the body, mm; distance, mm; turn about both of these, rad.
    """

    limits: Arm
    waves: np.ndarray

    def swing(self, rng: np.random.Generator, beam: np.ndarray) -> np.ndarray | None:
        """See Stance. Orbit about the body (Y), tilt about the arm's support (X), swivel about the vertical (Z)."""
        arm = self.limits
        orbit, tilt, swivel = (rng.uniform(-reach, reach) for reach in (arm.orbit, arm.tilt, arm.swivel))
        turn = Rotation.from_euler("yxz", [orbit, tilt, swivel]).as_matrix()
        low, high = arm.orbit_limits
        return turn if low <= orbit_of(turn @ beam) <= high else None

    def sag(self, rng: np.random.Generator, beam: np.ndarray, axes: np.ndarray) -> Sag:
        """See Stance: a function of the orbit, and what does not repeat."""
        angle = orbit_of(beam)
        along_orbit, along_body, longer, *turn = self.waves @ np.array([np.cos(angle), np.sin(angle)])
        tangent = np.cross([0.0, 1.0, 0.0], beam)
        tangent /= np.linalg.norm(tangent)
        own = np.stack([tangent, np.cross(beam, tangent)])
        shift = np.array([along_orbit, along_body]) + rng.normal(0.0, self.limits.repeat_mm, 2)
        return Sag(shift @ own, longer + rng.normal(0.0, self.limits.repeat_mm), np.array(turn) @ own)


def draw_arm(rng: np.random.Generator, limits: Arm, pose: Pose) -> OneArm:
    """An arm whose sag has, at every orbit, the standard deviations of a pose drawn alone."""
    sd = [pose.piercing_mm, pose.piercing_mm, pose.sdd_mm, pose.detector_tilt, pose.detector_tilt]
    return OneArm(limits, np.array(sd)[:, None] * rng.standard_normal((5, 2)))


def orbit_of(beam: np.ndarray) -> float:
    """rad: orbit of a beam (3,), CFCS: 0 straight up (PA), 90° along +X (lateral)."""
    return float(np.arctan2(beam[0], beam[2]))
