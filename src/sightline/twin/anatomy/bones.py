"""Parametric bones of procedures: a pelvis, a lumbar vertebra, and a growing femur whose head has slipped.

Origins: the middle of the first sacral body (S1), of the vertebra's body, of the slipped head.
"""

from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from math import cos, radians, sin
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.twin.anatomy.bone_model import BoneModel, BonePart, LineAid, PlaneAid, SphereAid, TubeAid
from sightline.twin.anatomy.femur import BONE_PER_HU, SHORT_MM, neck_axis
from sightline.twin.anatomy.shapes import SolidShape, ball, barrel, box, cone, ellipsoid, half_space, plate

# Sizes and places without a source here or in docs/bones.md are [ours, typical].
PAST_MIDDLE_MM = 8.0  # how far the wire's end lies beyond the middle plane
CORRIDOR_MM = np.array([36.0, -10.0])  # where the drawn corridor begins and ends, from the middle plane
PELVIS_LOW_MM, PELVIS_HIGH_MM = np.array([-95.0, -85.0, -80.0]), np.array([132.0, 150.0, 100.0])  # what views show
# Places on a hip bone, anatomical coordinates, with the hip's centre by a pelvic incidence of 52°.
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


def drawn(middle: float, low: float, high: float) -> float:
    """Return the field of a dimension: its default, and the range that `draw` takes it from (docs/bones.md)."""
    return field(default=middle, metadata={"range": (low, high)})


Bone = TypeVar("Bone", "Pelvis", "Vertebra", "GrowingFemur")


def draw(rng: np.random.Generator, bone: type[Bone]) -> Bone:
    """Draw the dimensions of a bone within their ranges."""
    ranges = {dimension.name: dimension.metadata.get("range") for dimension in fields(bone)}
    return bone(**{name: rng.uniform(*range_) for name, range_ in ranges.items() if range_ is not None})


@dataclass(frozen=True)
class Pelvis:
    """A pelvic ring without its femurs. Lengths mm, angles degrees, with their ranges. Sources: docs/bones.md.

    `slope_deg`: of the upper endplate of S1 (sacral slope). `corridor_height_mm`, `corridor_depth_mm`: of the bone
    between ala, first foramen and canal, where it is narrowest. `foramen_mm`: diameter of the first
    anterior foramina. `joint_mm`: width of the sacroiliac joints.
    """

    slope_deg: float = drawn(40.0, 33, 47)
    body_width_mm: float = drawn(47.0, 42, 52)
    body_depth_mm: float = drawn(28.3, 25, 31.5)
    body_height_mm: float = drawn(28.4, 26.2, 30.6)
    corridor_height_mm: float = drawn(18.5, 17, 20)
    corridor_depth_mm: float = drawn(17.0, 16, 18)
    foramen_mm: float = drawn(12.6, 11.5, 13.5)
    sacrum_width_mm: float = drawn(106.0, 101, 111)
    joint_mm: float = drawn(2.0, 1.5, 3.0)
    cancellous_hu: float = drawn(120.0, 80, 180)

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
            (*self._sacrum(), *(shape.cut() for shape in (*self._foramina(), *canal))),
            self.cancellous_hu * BONE_PER_HU,
            1.0,
        )
        ilium = BonePart(self._hip_bone(), self.cancellous_hu * BONE_PER_HU, 1.5, blend_mm=6.0, gap_mm=self.joint_mm)
        half, depth = self.body_height_mm / 2, self.body_depth_mm / 2
        bone = BoneModel(
            parts=(sacrum, ilium),
            low_mm=PELVIS_LOW_MM,
            high_mm=PELVIS_HIGH_MM,
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
        front, back = (at + self.sacrum_width_mm / 2 * LATERAL for at in (FRONT, BACK))
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
            cone(
                _moved_by(front, 6.0, -4.0, -4.0), _moved_by(back, 5.0, -4.0, 2.0), 11.0
            ),  # up to the wing's outer surface
            cone(front, BRIM, 8.0, 11.0),
            cone(BRIM, ROOF, 11.0, 16.0),
            cone(AIIS, ROOF, 7.0, 14.0),
            cone(_moved_by(HIP, -8.0, 20.0, -12.0), ISCHIUM, 15.0, 14.0),
            cone(_moved_by(HIP, -16.0, -8.0, 18.0), PUBIS, 9.0, 8.0),
            ellipsoid(PUBIS, [9.5, 18.0, 8.0]),
            cone(_moved_by(PUBIS, 0.0, 10.0, -2.0), _moved_by(ISCHIUM, -8.0, 0.0, 14.0), 7.0),
            ball(HIP, 25.5).cut(),
        )


def _moved_by(point_mm: np.ndarray, *by_mm: float) -> np.ndarray:
    """Return a point (3,) moved by three numbers."""
    return point_mm + np.array(by_mm)


SHELL_MM = 0.6  # cortex of the body: 0.35 mm, CT shows twice as much [src Silva 1994]
ARCH_MM = 1.6  # cortex of pedicles and arch, which is thicker than the body's [src Odeh 2021]
DISC_MM = 11.0  # height of a disc
ISTHMUS_MM = 10.0  # of the pedicle's length that a person draws
SPINE_REACH_MM = 95.0  # of the voxels along the spine, with the vertebrae above and below


@dataclass(frozen=True)
class Vertebra:
    """A fourth lumbar vertebra. Lengths mm, angles degrees, with their ranges. Sources: docs/bones.md.

    `pedicle_deg`: angle of the pedicles' axes to the middle plane; they converge forwards.
    """

    body_width_mm: float = drawn(49.0, 45, 53)
    body_depth_mm: float = drawn(35.5, 32, 39)
    body_height_mm: float = drawn(27.0, 24.5, 28.5)
    canal_width_mm: float = drawn(24.0, 22, 26)
    canal_depth_mm: float = drawn(15.6, 13.5, 17.5)
    pedicle_width_mm: float = drawn(11.0, 9, 13)
    pedicle_height_mm: float = drawn(15.0, 13.9, 16.7)
    pedicle_deg: float = drawn(12.0, 8, 16)
    process_mm: float = drawn(15.0, 13, 18)  # of a transverse process beyond the pedicle
    spinous_mm: float = drawn(30.0, 26, 33)  # behind the arch
    cancellous_hu: float = drawn(120.0, 80, 180)

    @property
    def pedicle_mm(self) -> np.ndarray:
        """Middle (3,) of the pedicle's narrowest place, on the operated side."""
        x = (self.canal_width_mm + self.pedicle_width_mm) / 2
        return np.array([x, 2.0 + (self.pedicle_height_mm - self.body_height_mm) / 2, -self.body_depth_mm / 2 - 2.5])

    @property
    def along(self) -> np.ndarray:
        """Unit vector (3,) along the pedicle, forwards, on the operated side."""
        return np.array([-sin(radians(self.pedicle_deg)), 0.0, cos(radians(self.pedicle_deg))])

    def _pedicle(self) -> TubeAid:
        """Return the drawn part of the pedicle, about its narrowest place."""
        half, wide = ISTHMUS_MM / 2 * self.along, 0.98 * self.pedicle_width_mm / 2
        sides = [[0.0, self.pedicle_height_mm / 2 - wide, 0.0], (self.pedicle_width_mm / 2 - wide) * self._across]
        return TubeAid(np.stack([self.pedicle_mm - half, self.pedicle_mm + half]), np.array(sides), wide, oval=True)

    @property
    def _across(self) -> np.ndarray:
        """Unit vector (3,) across the pedicle, in the plane of the endplates."""
        return np.array([self.along[2], 0.0, -self.along[0]])

    def bone(self) -> BoneModel:
        """Return the bone with the wire along the pedicle's axis, up to SHORT_MM from the anterior cortex."""
        width, height, depth = self.body_width_mm / 2, self.body_height_mm / 2, self.body_depth_mm / 2
        canal = box(
            [0.0, 0.0, -depth - self.canal_depth_mm / 2],
            [self.canal_width_mm / 2, 60.0, self.canal_depth_mm / 2],
            0.48 * self.canal_depth_mm,
        )
        side, roof = -depth - 0.6 * self.canal_depth_mm, -depth - self.canal_depth_mm - 3.0
        tip = roof - self.spinous_mm
        x, y, z = self.pedicle_mm
        upper, lower = np.array([x + 1.0, y - 14.0, side - 5.0]), np.array([x - 3.5, height + 14.0, roof + 1.0])
        process = np.array([x + self.pedicle_width_mm / 2 + self.process_mm - 3.0, y, z - 13.0])
        spine = np.array([0.0, height + 6.0, tip + 3.5])
        arch = (
            box(
                self.pedicle_mm,
                [self.pedicle_width_mm / 2, self.pedicle_height_mm / 2, 16.0],
                0.98 * self.pedicle_width_mm / 2,
                np.stack([self._across, [0.0, 1.0, 0.0], self.along]),
            ),
            plate([x - 1.0, y, side], [x - 2.5, height, side], [0.0, height + 3.0, roof], 3.2),
            plate([x - 1.0, y, side], [0.0, height + 3.0, roof], [0.0, -2.0, roof], 3.2),
            cone([x, y + 3.0, side - 3.0], upper, 6.0, 5.0),
            cone([x - 4.0, height - 2.0, roof + 3.0], lower, 5.5, 4.5),
            cone([x + 1.0, y, z - 9.0], process, 5.0, 3.0),
            plate([0.0, 0.0, roof], [0.0, height + 3.0, roof], [0.0, 4.0, tip + 3.5], 3.0),
            plate([0.0, height + 3.0, roof], [0.0, 4.0, tip + 3.5], spine, 3.0),
            cone([0.0, 4.0, tip + 3.5], spine, 3.5),
        )
        body = barrel([0.0, 0.0, 0.0], [width, height, depth], 2.0, 0.1)
        part = BonePart(
            (*arch, body.with_cortex(SHELL_MM), canal.cut()),
            spongy=self.cancellous_hu * BONE_PER_HU,
            cortex_mm=ARCH_MM,
        )
        bone = BoneModel(
            parts=(part,),
            around=tuple(part.shifted([0.0, level * (2 * height + DISC_MM), 0.0]) for level in (-2, -1, 1, 2)),
            low_mm=np.array([-process[0] - 5.0, -SPINE_REACH_MM, tip - 3.0]),
            high_mm=np.array([process[0] + 5.0, SPINE_REACH_MM, depth + 3.0]),
            wires_mm=np.zeros((0, 2, 3)),
            landmarks_mm={},
            aids={
                "upper endplate": PlaneAid(np.array([0.0, -height, 0.0]), np.array([0.0, -1.0, 0.0])),
                "lower endplate": PlaneAid(np.array([0.0, height, 0.0]), np.array([0.0, 1.0, 0.0])),
                "middle plane": PlaneAid(np.zeros(3), np.array([1.0, 0.0, 0.0])),
                "front": PlaneAid(np.array([0.0, 0.0, depth]), np.array([0.0, 0.0, 1.0])),
                "pedicle": self._pedicle(),
            },
            keep_out={"canal": (canal,)},
            mirrored=True,
        )
        bone = _with_landmarks(bone, spine, upper, lower, process)
        wire = bone.wire_through(self.pedicle_mm, self.along, SHORT_MM)
        return bone.with_wire(wire, {"entry cortex": (1.0, 0.0, 0.0)})


def _with_landmarks(
    bone: BoneModel, spine: np.ndarray, upper: np.ndarray, lower: np.ndarray, process: np.ndarray
) -> BoneModel:
    """Return the bone with the tips of its processes, near the given points (3,), as landmarks."""
    landmarks = {
        "spinous process": bone.surface_mm(spine, np.array([0.0, 1.0, 0.0])),
        "superior articular process": bone.surface_mm(upper, np.array([0.0, -1.0, 0.0])),
        "inferior articular process": bone.surface_mm(lower, np.array([0.0, 1.0, 0.0])),
        "transverse process": bone.surface_mm(process, np.array([1.0, 0.0, 0.0])),
    }
    landmarks |= {f"opposite {name}": at * [-1.0, 1.0, 1.0] for name, at in landmarks.items() if at[0] > 0}
    return replace(bone, landmarks_mm=landmarks)


HEAD_SHORT_MM = 5.0  # from the wire's end to the head's surface
DOME_MM = 24.0  # radius of the growth plate: 30° and a third of its width, the limits of a mild slip, agree [calc]
OVERLAP_MM = 0.5  # of neck and head where the growth plate displaces the neck
JOINT_MM = 3.5  # between head and socket, as of the adult's
GREATER_MM, LESSER_MM = np.array([6.0, -10.0, -5.0]), np.array([-10.0, 28.0, -10.0])  # from the base of the neck
CAUDAL = np.array([0.0, 1.0, 0.0])
FEMUR_LOW_MM, FEMUR_HIGH_MM = np.array([-75.0, -75.0, -50.0]), np.array([75.0, 110.0, 45.0])


@dataclass(frozen=True)
class GrowingFemur:
    """A proximal femur of an adolescent. Lengths mm, angles degrees, with their ranges. Sources: docs/bones.md.

    `slip_deg`: rotation of the head on the neck; `slip_towards_deg`: its direction across the neck, from posterior
    (0) to inferior (90). `physis_mm`: width of the growth plate.
    """

    head_radius_mm: float = drawn(22.0, 20.5, 25.0)
    neck_radius_mm: float = drawn(14.5, 13.0, 16.5)
    neck_length_mm: float = drawn(46.0, 42, 49)
    neck_shaft_deg: float = drawn(130.0, 126, 135)
    anteversion_deg: float = drawn(13.0, 9, 17)
    shaft_radius_mm: float = 13.0
    canal_radius_mm: float = 6.0
    physis_mm: float = drawn(2.0, 1.5, 3.0)
    slip_deg: float = drawn(25.0, 10, 45)
    slip_towards_deg: float = drawn(30.0, 0, 50)
    cancellous_hu: float = drawn(250.0, 200, 300)

    @property
    def along_neck(self) -> np.ndarray:
        """Unit vector (3,) along the neck towards the head before it slipped."""
        return neck_axis(self.neck_shaft_deg, self.anteversion_deg)

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
            low_mm=FEMUR_LOW_MM,
            high_mm=FEMUR_HIGH_MM,
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
        wire = bone.wire_through(np.zeros(3), along, HEAD_SHORT_MM)
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
