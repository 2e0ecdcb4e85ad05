"""The distributions that simulated set-ups are drawn from, with their sources; pointing and sag of the C-arm.

The benchmarks' scenes depend on them. Tags as in docs/physics.md.
"""

from dataclasses import dataclass
from math import pi, radians
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.frame.patterns import HIDDEN
from sightline.frame.plate import SOURCE_TO_HIP_MM

DEGREE = pi / 180


@dataclass(frozen=True)
class Distortion:
    """Distribution of the distortion of an intensifier; see docs/twin.md, Distortion."""

    pincushion_at_107_mm: tuple[float, float] = (0.03, 0.09)  # uniform [calc]: k1 = share / (107 mm)²
    earth_ut: tuple[float, float] = (18.65, -44.9)  # Loughborough: horizontal, up [calc, IGRF]
    stray_ut: float = 10.0  # s.d. per component, drawn for each exposure [physics.md, Distortion]
    gradient_ut_per_mm: float = 3.0 / 107.5  # [ours] s.d. of a component of the stray gradient: 3 µT from middle to rim
    shift_mm_per_ut: float = 0.055  # [calc] 2.6 mm lateral, 1.0 mm PA; the paper saw 2-3 mm between them
    turn_rad_per_ut: tuple[float, float] = (0.02 * DEGREE, 0.08 * DEGREE)  # log-uniform [physics.md, Distortion]
    turn_fade: tuple[float, float] = (-0.79, 0.23)  # of u², u⁴ [calc on measured dots]
    shift_fade: tuple[float, float] = (-1.41, 0.88)  # of u², u⁴ [calc on measured dots]
    asymmetric_mm: float = 0.4  # rms of a random cubic over the field [calc]
    correlation_mm: tuple[float, float] = (30.0, 60.0)  # uniform; length l of exp(-d²/2l²) [calc]
    beyond_degree5_mm: tuple[float, float] = (0.05, 0.10)  # uniform; expected rms left after a fit of degree 5 [calc]


@dataclass(frozen=True)
class Pose:
    """Distribution of the pose of a C-arm relative to the frame. Angles rad, lengths mm. Values are standard deviations
    of normal distributions unless stated otherwise, and [ours] without a source."""

    source_to_hip_mm: float = SOURCE_TO_HIP_MM
    frame_tilt: float = radians(3.0)  # of the frame against the C-arm's orbit, per axis, the same in both views
    orbit: float = radians(2.0)  # of each view's direction, per axis: views are not exactly 90° apart
    tilt_limit: float = radians(15.0)  # between beam and nominal beam; poses beyond it are drawn again
    in_plane: float = pi  # uniform within +- this: the image may have any rotation
    hip_offset_mm: float = 10.0  # uniform within +- this, per axis: the beam's axis misses the hip
    piercing_mm: float = 4.0  # flex: piercing point, up to 10-16 mm over the orbit [src Daly 2008]
    sdd_mm: float = 3.0  # flex: source and detector 6-8 mm over the orbit [src Daly 2008]
    detector_tilt: float = radians(1.0)  # flex: up to 2.9° [src Daly 2008]
    # Instead, of a flat panel before a solid: 3 mm of the principal point, which has 5 mm with `piercing_mm`. A
    # tilt of 1° would be 18 mm, and the measured piercing points move by 10-16 mm over the whole orbit.
    panel_tilt: float = radians(0.17)
    beads_in_field: float = 1 - HIDDEN  # minimum share of each plate's beads in the field; else drawn again


@dataclass(frozen=True)
class Arm:
    """Distribution of the stance of one C-arm around a frame. Angles rad, uniform within +- the value, per view.

    The ranges are those of an operating room, with a patient on a table between source and intensifier and the other
    leg beside it; values [ours, typical] without a source.
    """

    orbit: float = radians(8.0)  # off the view's own orbit
    tilt: float = radians(6.0)  # about the arm's support, cranial or caudal
    swivel: float = radians(6.0)  # of the whole arm; machines turn by 10-12.5°
    orbit_limits: tuple[float, float] = (radians(-40.0), radians(100.0))  # of the machine
    repeat_mm: float = 0.25  # repeatability at the same orbit, s.d. per axis; an upper bound [src Daly 2008]


@dataclass(frozen=True)
class HardScene:
    """Content of a hard image besides frame and hip [ours]. Counts are drawn uniformly, both ends included."""

    wires: tuple[int, int] = (0, 2)  # guide wires of 2.5 mm through the hip
    screws: tuple[int, int] = (0, 3)  # 4.5 mm, 40 mm long
    nails: tuple[int, int] = (0, 1)  # 11 mm down the shaft
    level: tuple[float, float] = (0.15, 0.5)  # mean of the image's middle over white; above 0.3 much saturates
    tissue_scale: tuple[float, float] = (0.75, 1.15)  # of the body's cross-section; thin bodies leave air in the image
    metal_reach_mm: float = 45.0  # wires and screws lie within this distance of the hip


@dataclass(frozen=True)
class SolidPlace:
    """Place of a solid beside a hip, and where the beams are aimed [ours]."""

    # The middle of the solid from the middle of the wire, mm: lateral, caudal, anterior. It is 80 mm away, caudal
    # of the entry and a little in front: there its shadow falls beside the wire in each view.
    solid_mm: tuple[float, float, float] = (0.0, 76.8, 22.4)
    aim: float = 0.4  # share of the way from the middle of the wire to the solid at which the beams are aimed


# Beside a hip in the field of a 9-inch intensifier, 140 mm: 51 mm away, where a block of 30 mm is in both images.
NEAR_PLACE = SolidPlace((0.0, 48.0, 18.0), 0.45)


@dataclass(frozen=True)
class PlateMount:
    """How a plate is put on a detector, standard deviations: once for all images [ours]."""

    shift_mm: float = 3.0  # per axis across the detector
    stand_off_mm: float = 1.0
    turn: float = radians(5.0)  # in its plane
    tilt: float = radians(0.3)  # per axis: 1 mm over its width


@dataclass(frozen=True)
class HipPlace:
    """Position of a hip: its ideal wire is near `SetUp.hip_mm`, so that both fields can show all of it [ours]."""

    off_centre_sd_mm: float = 4.0  # of the middle of the wire, per axis
    margin_px: float = 60.0  # minimum distance of the wire's ends from the edge of both fields, where required


class Sag(NamedTuple):
    """Deviation of a view's geometry from that of a rigid arm, CFCS.

    `shift_mm` (3,): shift of the detector across the beam. `longer_mm`: change of the distance from source to detector.
    `rotation` (3,): rotation vector of the detector, across the beam, rad.
    """

    shift_mm: np.ndarray
    longer_mm: float
    rotation: np.ndarray


@dataclass(frozen=True)
class IndependentViews:
    """Independent views: a direction and a sag are drawn for each."""

    pose: Pose

    def swing(self, rng: np.random.Generator, beam: np.ndarray) -> np.ndarray | None:
        """Draw a rotation (3, 3) of the intended beam (3,); None if the arm cannot reach it."""
        return Rotation.from_rotvec(rng.normal(0.0, self.pose.orbit, 3)).as_matrix()

    def sag(self, rng: np.random.Generator, beam: np.ndarray, axes: np.ndarray) -> Sag:
        """Draw the sag at a beam (3,); `axes` (2, 3): the image's axes, across the beam."""
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
        """As of `IndependentViews`: orbit about the body (Y), tilt about the arm's support (X), swivel about Z."""
        arm = self.limits
        orbit, tilt, swivel = (rng.uniform(-reach, reach) for reach in (arm.orbit, arm.tilt, arm.swivel))
        rotation = Rotation.from_euler("yxz", [orbit, tilt, swivel]).as_matrix()
        low, high = arm.orbit_limits
        return rotation if low <= orbit_of(rotation @ beam) <= high else None

    def sag(self, rng: np.random.Generator, beam: np.ndarray, axes: np.ndarray) -> Sag:
        """As of `IndependentViews`. The sag is a function of the orbit plus a part that does not repeat."""
        angle = orbit_of(beam)
        along_orbit, along_body, longer, *rotation = self.waves @ np.array([np.cos(angle), np.sin(angle)])
        tangent = np.cross([0.0, 1.0, 0.0], beam)
        tangent /= np.linalg.norm(tangent)
        own = np.stack([tangent, np.cross(beam, tangent)])
        shift = np.array([along_orbit, along_body]) + rng.normal(0.0, self.limits.repeat_mm, 2)
        return Sag(shift @ own, longer + rng.normal(0.0, self.limits.repeat_mm), np.array(rotation) @ own)


Stance: TypeAlias = IndependentViews | OneArm


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
