"""A parametric lumbar vertebra for a pedicle screw. Origin: the middle of its body."""

from dataclasses import dataclass, replace
from math import cos, radians, sin

import numpy as np

from sightline.twin.anatomy.bone_model import BoneModel, BonePart, PlaneAid, TubeAid
from sightline.twin.anatomy.femur import BONE_PER_HU
from sightline.twin.anatomy.shapes import barrel, box, cone, plate

SHORT_MM = 8.0  # from the wire's end to the anterior cortex along it [ours]
SHELL_MM = 0.6  # cortex of the body: 0.35 mm, CT shows twice as much [src Silva 1994]
ARCH_MM = 1.6  # cortex of pedicles and arch, which is thicker than the body's [src Odeh 2021; value ours]
DISC_MM = 11.0  # height of a disc [ours, typical]
ISTHMUS_MM = 10.0  # of the pedicle's length that a person draws [ours]
REACH_MM = 95.0  # of the voxels along the spine, with the vertebrae above and below


@dataclass(frozen=True)
class Vertebra:
    """A fourth lumbar vertebra. Lengths mm, angles degrees. Sources: docs/bones.md.

    `pedicle_deg`: angle of the pedicles' axes to the middle plane; they converge forwards.
    """

    body_width_mm: float = 49.0
    body_depth_mm: float = 35.5
    body_height_mm: float = 27.0
    canal_width_mm: float = 24.0
    canal_depth_mm: float = 15.6
    pedicle_width_mm: float = 11.0
    pedicle_height_mm: float = 15.0
    pedicle_deg: float = 12.0
    process_mm: float = 15.0  # of a transverse process beyond the pedicle
    spinous_mm: float = 30.0  # behind the arch
    cancellous_hu: float = 120.0

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
            low_mm=np.array([-process[0] - 5.0, -REACH_MM, tip - 3.0]),
            high_mm=np.array([process[0] + 5.0, REACH_MM, depth + 3.0]),
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


def draw_vertebra(rng: np.random.Generator) -> Vertebra:
    """Draw a vertebra within the ranges of docs/bones.md."""
    return Vertebra(
        body_width_mm=rng.uniform(45, 53),
        body_depth_mm=rng.uniform(32, 39),
        body_height_mm=rng.uniform(24.5, 28.5),
        canal_width_mm=rng.uniform(22, 26),
        canal_depth_mm=rng.uniform(13.5, 17.5),
        pedicle_width_mm=rng.uniform(9, 13),
        pedicle_height_mm=rng.uniform(13.9, 16.7),
        pedicle_deg=rng.uniform(8, 16),
        process_mm=rng.uniform(13, 18),
        spinous_mm=rng.uniform(26, 33),
        cancellous_hu=rng.uniform(80, 180),
    )
