"""A parametric pelvis with sacrum for an iliosacral screw. Origin: the middle of the first sacral body (S1).

The sacrum is built along its own axes: lateral, down the sacrum, forwards. It is tilted by the sacral slope.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from math import cos, radians, sin

import numpy as np

from sightline.twin.anatomy.bone_model import BoneModel, BonePart, PlaneAid, TubeAid
from sightline.twin.anatomy.femur import BONE_PER_HU
from sightline.twin.anatomy.shapes import SolidShape, ball, barrel, box, cone, ellipsoid, half_space, plate

PAST_MIDDLE_MM = 8.0  # how far the wire's end lies beyond the middle plane [ours]
CORRIDOR_MM = np.array([36.0, -10.0])  # where the drawn corridor begins and ends, from the middle plane [ours]
LOW_MM, HIGH_MM = np.array([-95.0, -85.0, -80.0]), np.array([132.0, 150.0, 100.0])  # what views show
# Places on a hip bone, anatomical coordinates [ours], with the hip's centre by a pelvic incidence of 52°
# [ours, typical].
HIP = np.array([88.0, 100.0, 33.0])
PSIS, PIIS = np.array([42.0, 6.0, -60.0]), np.array([45.0, 38.0, -42.0])
FRONT, BACK = (
    np.array([5.0, -3.0, 4.0]),
    np.array([-5.0, 10.0, -35.0]),
)  # of the joint, from the sacrum's side
FOSSA = np.array([91.0, -14.0, 30.0])
BRIM, ROOF = np.array([72.0, 45.0, 25.0]), np.array([92.0, 70.0, 38.0])
CREST = np.array([PSIS, [70.0, -45.0, -45.0], [105.0, -72.0, -8.0], [125.0, -50.0, 38.0], [118.0, 8.0, 75.0]])
AIIS, PUBIS, ISCHIUM = np.array([104.0, 45.0, 66.0]), np.array([12.0, 112.0, 86.0]), np.array([66.0, 148.0, 4.0])
LATERAL, MIRROR = np.array([1.0, 0.0, 0.0]), np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Pelvis:
    """A pelvic ring without its femurs. Lengths mm, angles degrees. Sources: docs/bones.md.

    `slope_deg`: of the upper endplate of S1 (sacral slope). `corridor_height_mm`, `corridor_depth_mm`: of the bone
    between ala, first foramen and canal, where it is narrowest. `foramen_mm`: diameter of the first
    anterior foramina. `joint_mm`: width of the sacroiliac joints.
    """

    slope_deg: float = 40.0
    body_width_mm: float = 47.0
    body_depth_mm: float = 28.3
    body_height_mm: float = 28.4
    corridor_height_mm: float = 18.5
    corridor_depth_mm: float = 17.0
    foramen_mm: float = 12.6
    sacrum_width_mm: float = 106.0
    joint_mm: float = 2.0
    cancellous_hu: float = 120.0

    @property
    def axes(self) -> np.ndarray:
        """The sacrum's axes (3, 3) as rows: lateral, down the sacrum, forwards."""
        slope = radians(self.slope_deg)
        return np.array([[1.0, 0.0, 0.0], [0.0, cos(slope), -sin(slope)], [0.0, sin(slope), cos(slope)]])

    def at(self, lateral: float, down: float, forwards: float) -> np.ndarray:
        """Return a point (3,) given along the sacrum's axes."""
        return np.array([lateral, down, forwards]) @ self.axes

    @property
    def corridor_mm(self) -> np.ndarray:
        """Middle (3,) of the narrowest place of the corridor of S1, on the operated side."""
        return self.at(self._foramen_side, self._foramen_down - (self.foramen_mm + self.corridor_height_mm) / 2, -2.0)

    @property
    def _foramen_side(self) -> float:
        return 18.05 + self.foramen_mm / 2  # 36.1 mm between the first two [src Korean sacra]

    @property
    def _foramen_down(self) -> float:
        return self.body_height_mm / 2

    def bone(self) -> BoneModel:
        """Return the bone with the wire through the corridor's middle into the body of S1."""
        foramen, canal = self._foramina()[0], self._canal()
        sacrum = BonePart(
            (*self._sacrum(), *(one.cut() for one in (*self._foramina(), *canal))),
            self.cancellous_hu * BONE_PER_HU,
            1.0,
        )
        ilium = BonePart(self._hip_bone(), self.cancellous_hu * BONE_PER_HU, 1.5, blend_mm=6.0, gap_mm=self.joint_mm)
        half, depth = self.body_height_mm / 2, self.body_depth_mm / 2
        bone = BoneModel(
            parts=(sacrum, ilium),
            low_mm=LOW_MM,
            high_mm=HIGH_MM,
            wires_mm=np.zeros((0, 2, 3)),
            landmarks_mm={},
            aids={
                "upper endplate of S1": PlaneAid(self.at(0.0, -half, 0.0), -self.axes[1]),
                "middle plane": PlaneAid(np.zeros(3), np.array([1.0, 0.0, 0.0])),
                "s1 corridor": self._corridor(),
            },
            keep_out={"canal": canal, "foramen": (foramen,)},
            mirrored=True,
            voxel_mm=0.8,
        )
        along = (self._target - self.corridor_mm) / np.linalg.norm(self._target - self.corridor_mm)
        end = self._target + PAST_MIDDLE_MM / abs(along[0]) * along
        # Each where the surface turns away from the beam of one of the two views.
        landmarks = {
            "promontory": bone.surface_mm(self.at(0.0, 2.0 - half, depth - 2.0), np.array([0.0, -0.74, 0.67])),
            "ala": bone.surface_mm(self.at(self.sacrum_width_mm / 2 - 14.0, 2.0, -6.0), -self.axes[1]),
            "posterior superior iliac spine": bone.surface_mm(PSIS, np.array([0.0, -0.91, -0.42])),
        }
        landmarks |= {f"opposite {name}": at * MIRROR for name, at in landmarks.items() if at[0] > 0}
        wire = np.stack([bone.surface_mm(self.corridor_mm, -along), end])
        return replace(bone, landmarks_mm=landmarks).with_wire(wire, {"entry cortex": None})

    def _corridor(self) -> TubeAid:
        """Return the corridor of S1 from the ala to beyond the wire's end, with its narrowest section."""
        half = np.array([self.corridor_height_mm / 2, self.corridor_depth_mm / 2])
        wide = 0.9 * half.min()
        along = self._target - self.corridor_mm
        ends = self.corridor_mm + np.outer((CORRIDOR_MM - self.corridor_mm[0]) / along[0], along)
        along = along / np.linalg.norm(along)
        across = self.axes[1:] - np.outer(self.axes[1:] @ along, along)
        return TubeAid(ends, (half - wide)[:, None] * across, wide)

    @property
    def _target(self) -> np.ndarray:
        """Where the wire passes the middle plane: in the body, before its middle."""
        return self.at(0.0, -2.0, 1.0)

    def _foramina(self) -> tuple[SolidShape, ...]:
        """Return the foramina of S1 to S3 on one side, wide in front and narrow behind."""
        wide = self.foramen_mm / 2
        x, down = self._foramen_side, self._foramen_down
        places = ((x, down, 0.0, 1.0), (x - 2.5, down + 23.0, -7.0, 0.9), (x - 5.5, down + 43.0, -8.0, 0.75))
        return tuple(
            cone(self.at(a, b, c + 28.0), self.at(a - 1.5, b, c - 40.0), 1.25 * wide * d, 0.6 * wide * d)
            for a, b, c, d in places
        )

    def _canal(self) -> tuple[SolidShape, ...]:
        back = -self.body_depth_mm / 2
        return (
            box(self.at(0.0, -8.0, back - 7.5), [14.5, 32.0, 7.5], 7.0, self.axes),
            cone(self.at(0.0, 20.0, back - 7.5), self.at(0.0, 72.0, back - 3.0), 7.0, 3.5),
        )

    def _sacrum(self) -> tuple[SolidShape, ...]:
        at, half, outer = self.at, self.body_height_mm / 2, self.sacrum_width_mm / 2
        back = -self.body_depth_mm / 2
        bodies = [(half + 12.0, -5.0, 18.0, 11.5, 10.5), (half + 34.0, -8.0, 14.5, 11.5, 8.0)]
        bodies += [(half + 54.0, -7.0, 12.0, 10.5, 6.5), (half + 72.0, -2.0, 9.5, 9.0, 5.5)]
        _, down, forwards = self.axes @ self.corridor_mm
        ala, mass = at(outer - 14.0, 2.0, -6.0), [at(33.0, 28.0, -13.0), at(27.0, 50.0, -13.0), at(15.0, 72.0, -8.0)]
        arch = [
            at(0.0, 2.0, back - 18.0),
            at(0.0, 72.0, back - 9.0),
            at(18.0, 0.0, back - 11.0),
            at(13.0, 70.0, back - 3.0),
        ]
        corridor = [16.0, self.corridor_height_mm / 2, self.corridor_depth_mm / 2]
        return (
            barrel(np.zeros(3), [self.body_width_mm / 2, half, -back], 2.0, 0.06, self.axes),
            *(barrel(at(0.0, a, b), [c, d, e], 2.5, 0.05, self.axes) for a, b, c, d, e in bodies),
            box(at(26.0, down, forwards), corridor, 0.9 * min(corridor[1:]), self.axes),
            cone(at(36.0, -1.0, -3.0), ala, 9.0, 14.0),
            cone(at(37.0, 0.0, 4.0), at(outer - 14.0, 6.0, 5.0), 7.0, 10.0),
            cone(ala, mass[0], 14.0, 10.0),
            cone(mass[0], mass[1], 10.0, 7.0),
            cone(mass[1], mass[2], 7.0, 4.5),
            cone(at(12.0, half + 12.0, -5.0), mass[0], 7.0, 8.0),
            cone(at(10.0, half + 34.0, -8.0), mass[1], 6.0, 6.0),
            plate(arch[0], arch[1], arch[2], 2.2),
            plate(arch[1], arch[2], arch[3], 2.2),
            plate(arch[2], arch[3], at(32.0, 8.0, -16.0), 3.0),
            plate(arch[0], arch[1], at(0.0, 30.0, back - 25.0), 2.2),
            cone(arch[2], at(21.0, -10.0, back - 10.0), 5.0, 5.0),
        )

    def _hip_bone(self) -> tuple[SolidShape, ...]:
        front, back = (one + self.sacrum_width_mm / 2 * LATERAL for one in (FRONT, BACK))
        rim = [*CREST, AIIS, ROOF, BRIM, front, back, PSIS]
        opening = np.array([0.75, 0.5, 0.43])
        return (
            ball(HIP, 30.0),
            half_space(HIP + 8.0 * opening, opening).keep(),
            *(replace(plate(FOSSA, a, b, 3.0), blend_mm=1.5) for a, b in pairwise(rim)),
            *(cone(a, b, 5.5) for a, b in pairwise(CREST)),
            plate(PSIS, PIIS, back, 6.0),
            cone(front, back, 10.0),
            cone(back, PSIS, 10.0, 6.5),
            cone(_by(front, 6.0, -4.0, -4.0), _by(back, 5.0, -4.0, 2.0), 11.0),  # up to the wing's outer surface
            cone(front, BRIM, 8.0, 11.0),
            cone(BRIM, ROOF, 11.0, 16.0),
            cone(AIIS, ROOF, 7.0, 14.0),
            cone(_by(HIP, -8.0, 20.0, -12.0), ISCHIUM, 15.0, 14.0),
            cone(_by(HIP, -16.0, -8.0, 18.0), PUBIS, 9.0, 8.0),
            ellipsoid(PUBIS, [9.5, 18.0, 8.0]),
            cone(_by(PUBIS, 0.0, 10.0, -2.0), _by(ISCHIUM, -8.0, 0.0, 14.0), 7.0),
            ball(HIP, 25.5).cut(),
        )


def _by(point_mm: np.ndarray, *by_mm: float) -> np.ndarray:
    """Return a point (3,) moved by three numbers."""
    return point_mm + np.array(by_mm)


def draw_pelvis(rng: np.random.Generator) -> Pelvis:
    """Draw a pelvis within the ranges of docs/bones.md."""
    return Pelvis(
        slope_deg=rng.uniform(33, 47),
        body_width_mm=rng.uniform(42, 52),
        body_depth_mm=rng.uniform(25, 31.5),
        body_height_mm=rng.uniform(26.2, 30.6),
        corridor_height_mm=rng.uniform(17, 20),
        corridor_depth_mm=rng.uniform(16, 18),
        foramen_mm=rng.uniform(11.5, 13.5),
        sacrum_width_mm=rng.uniform(101, 111),
        joint_mm=rng.uniform(1.5, 3.0),
        cancellous_hu=rng.uniform(80, 180),
    )
