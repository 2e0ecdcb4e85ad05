"""A parametric growing femur whose head has slipped on its growth plate, for a pin or screw. Origin: the middle of the
head, where it has slipped to.

The growth plate is part of a sphere about a point on the neck's axis. The head slips by a rotation about this point, so
the plate keeps its width, and slip angle and displacement belong together.
"""

from dataclasses import dataclass, replace
from math import cos, radians, sin

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.twin.anatomy.bone_model import BoneModel, BonePart, LineAid, PlaneAid, SphereAid
from sightline.twin.anatomy.femur import BONE_PER_HU
from sightline.twin.anatomy.shapes import ball, cone, ellipsoid, half_space

SHORT_MM = 5.0  # from the wire's end to the head's surface [ours, typical]
DOME_MM = 24.0  # radius of the growth plate: 30° and a third of its width, the limits of a mild slip, agree [calc]
OVERLAP_MM = 0.5  # of neck and head where the growth plate displaces the neck [ours]
JOINT_MM = 3.5  # between head and socket, as of the adult's
GREATER_MM, LESSER_MM = np.array([6.0, -10.0, -5.0]), np.array([-10.0, 28.0, -10.0])  # from the base of the neck
CAUDAL = np.array([0.0, 1.0, 0.0])
LOW_MM, HIGH_MM = np.array([-75.0, -75.0, -50.0]), np.array([75.0, 110.0, 45.0])


@dataclass(frozen=True)
class GrowingFemur:
    """A proximal femur of an adolescent. Lengths mm, angles degrees. Sources: docs/bones.md.

    `slip_deg`: rotation of the head on the neck; `slip_towards_deg`: its direction across the neck, from posterior
    (0) to inferior (90). `physis_mm`: width of the growth plate.
    """

    head_radius_mm: float = 22.0
    neck_radius_mm: float = 14.5
    neck_length_mm: float = 46.0
    neck_shaft_deg: float = 130.0
    anteversion_deg: float = 13.0
    shaft_radius_mm: float = 13.0
    canal_radius_mm: float = 6.0
    physis_mm: float = 2.0
    slip_deg: float = 25.0
    slip_towards_deg: float = 30.0
    cancellous_hu: float = 250.0

    @property
    def along_neck(self) -> np.ndarray:
        """Unit vector (3,) along the neck towards the head before it slipped."""
        across, version = sin(radians(self.neck_shaft_deg)), radians(self.anteversion_deg)
        return np.array([-across * cos(version), cos(radians(self.neck_shaft_deg)), across * sin(version)])

    @property
    def along(self) -> np.ndarray:
        """Unit vector (3,) perpendicular to the growth plate of the slipped head, through its middle."""
        neck = self.along_neck
        posterior = np.array([0.0, 0.0, -1.0]) + neck[2] * neck
        posterior /= np.linalg.norm(posterior)
        inferior = CAUDAL - neck[1] * neck
        inferior -= (inferior @ posterior) * posterior
        towards = radians(self.slip_towards_deg)
        across = cos(towards) * posterior + sin(towards) * inferior / np.linalg.norm(inferior)
        return Rotation.from_rotvec(radians(self.slip_deg) * np.cross(neck, across)).apply(neck)

    def bone(self) -> BoneModel:
        """Return the bone with the wire through the middle of the head, perpendicular to its growth plate."""
        neck, along, radius = self.along_neck, self.along, self.head_radius_mm
        below = 0.95 * radius  # from the middle of the head to that of the dome
        dome = -below * along
        intact = dome + below * neck  # the middle of the head before it slipped
        base = intact - self.neck_length_mm * neck
        head = BonePart(
            (ball(np.zeros(3), radius), ball(dome, DOME_MM).cut()), 1.3 * self.cancellous_hu * BONE_PER_HU, 1.0
        )
        canal = cone(base + 45.0 * CAUDAL, base + 300.0 * CAUDAL, self.canal_radius_mm)
        metaphysis = BonePart(
            (
                cone(intact - 22.0 * neck, intact - 3.0 * neck, self.neck_radius_mm, 0.9 * radius),
                ball(dome, DOME_MM + OVERLAP_MM).keep(),
                replace(cone(base, intact - 22.0 * neck, self.neck_radius_mm + 3.0, self.neck_radius_mm), blend_mm=8.0),
                replace(
                    cone(base, base + 250.0 * CAUDAL, self.shaft_radius_mm + 3.0, self.shaft_radius_mm),
                    blend_mm=14.0,
                    cortex_mm=4.0,
                ),
                replace(ellipsoid(base + GREATER_MM, [10.0, 20.0, 14.0]), blend_mm=10.0),
                replace(ellipsoid(base + LESSER_MM, [7.5, 10.0, 7.5]), blend_mm=8.0),
                canal.with_cortex(0.0).cut(),
            ),
            self.cancellous_hu * BONE_PER_HU,
            1.5,
            gap_mm=self.physis_mm,
        )
        greater, lesser = base + GREATER_MM, base + LESSER_MM
        rim = (DOME_MM**2 - radius**2 - below**2) / (2 * below)  # of the growth plate, along the wire
        wide = np.sqrt(radius**2 - rim**2)
        upwards = along[1] * along - CAUDAL
        upwards /= np.linalg.norm(upwards)
        bone = BoneModel(
            parts=(head, metaphysis),
            around=(_socket(radius, 0.8 * self.cancellous_hu * BONE_PER_HU),),
            low_mm=LOW_MM,
            high_mm=HIGH_MM,
            wires_mm=np.zeros((0, 2, 3)),
            landmarks_mm={},
            aids={
                "head": SphereAid(np.zeros(3), radius),
                "growth plate": PlaneAid(rim * along, along, float(wide)),  # through its edges: it is a dome
                "neck": LineAid(np.stack([base, intact])),
                "shaft": LineAid(np.stack([base + 10.0 * CAUDAL, base + 40.0 * CAUDAL])),
            },
        )
        landmarks = {
            "head centre": np.zeros(3),
            "growth plate, upper edge": rim * along + wide * upwards,
            "growth plate, lower edge": rim * along - wide * upwards,
            "greater trochanter": bone.surface_mm(greater, -CAUDAL),
            "lesser trochanter": bone.surface_mm(lesser, np.array([-1.0, 0.0, -1.0])),
        }
        surfaces = {"entry cortex": (0.0, 0.0, 1.0), "entry cortex lateral": (1.0, 0.0, 0.0)}
        wire = bone.wire_through(np.zeros(3), along, SHORT_MM)
        return replace(bone, landmarks_mm=landmarks).with_wire(wire, surfaces)


def _socket(head_mm: float, spongy: float) -> BonePart:
    """Return the socket around a head of this radius, with the ilium, pubis and ischium that bear it."""
    tilt = np.array([[0.945, 0.327, 0.0], [-0.327, 0.945, 0.0], [0.0, 0.0, 1.0]])
    shapes = (
        ball(np.zeros(3), head_mm + JOINT_MM + 3.0),
        half_space(np.zeros(3), np.array([0.72, 0.69, 0.0])).keep(),
        replace(ellipsoid([-24.0, -46.0, -2.0], [13.0, 54.0, 22.0], tilt), blend_mm=12.0),
        replace(cone([-34.0, 8.0, 8.0], [-80.0, 14.0, 26.0], 10.0, 8.0), blend_mm=10.0),
        replace(cone([-32.0, 20.0, -12.0], [-36.0, 75.0, -20.0], 11.0, 10.0), blend_mm=10.0),
        ball(np.zeros(3), head_mm + JOINT_MM).cut(),
    )
    return BonePart(shapes, spongy, 1.5)


def draw_growing_femur(rng: np.random.Generator) -> GrowingFemur:
    """Draw a slipped head within the ranges of docs/bones.md."""
    return GrowingFemur(
        head_radius_mm=rng.uniform(20.5, 25.0),
        neck_radius_mm=rng.uniform(13.0, 16.5),
        neck_length_mm=rng.uniform(42, 49),
        neck_shaft_deg=rng.uniform(126, 135),
        anteversion_deg=rng.uniform(9, 17),
        physis_mm=rng.uniform(1.5, 3.0),
        slip_deg=rng.uniform(10, 45),
        slip_towards_deg=rng.uniform(0, 50),
        cancellous_hu=rng.uniform(200, 300),
    )
