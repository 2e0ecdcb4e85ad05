"""The lower end of a femur with an intramedullary nail, whose two distal holes are to be drilled through.

Anatomical coordinates (lateral, caudal, anterior), mm; the origin is the nail's upper distal hole.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.twin.bones import BoneModel, BonePart, TubeAid
from sightline.twin.nails import CORTEX_MM, SPACING_MM, TIP_MM, DistalNail
from sightline.twin.shapes import cone, ellipsoid

CAUDAL = np.array([0.0, 1.0, 0.0])
CONDYLE_MM = np.array([22.0, 66.0, -8.0])  # middle of the lateral one [ours]
CONDYLE_HALF_MM = (17.0, 22.0, 27.0)  # [ours]
FLARE_MM, FLARED_MM = (20.0, 62.0), 24.0  # where the shaft widens towards the knee, and how far [ours]
STROKE_MM = (-18.0, SPACING_MM + 10.0)  # ends of the strokes along the nail's edges [ours]


@dataclass(frozen=True)
class NailedFemur:
    """The dimensions. `along_rad` (2,): rotation of the nail about the lateral and the anterior axis; `roll_rad`: of
    its holes about it, from medial; the bend as of `DistalNail`."""

    diameter_mm: float
    material: str
    along_rad: tuple[float, float]
    roll_rad: float
    bend_rad: float
    bend_angle_rad: float
    cancellous: float

    @property
    def nail(self) -> DistalNail:
        """The nail; its holes run from lateral to medial."""
        about_x, about_z = self.along_rad
        along = Rotation.from_rotvec([about_x, 0.0, about_z]).apply(CAUDAL)
        medial = np.array([-1.0, 0.0, 0.0])
        axis = medial - (medial @ along) * along
        axis = Rotation.from_rotvec(self.roll_rad * along).apply(axis / np.linalg.norm(axis))
        return DistalNail(
            np.zeros(3),
            along,
            axis,
            diameter_mm=self.diameter_mm,
            bend=self.bend_rad,
            bend_angle=self.bend_angle_rad,
            material=self.material,
        )

    def bone(self) -> BoneModel:
        """Return the bone with the nail; the wires run through the distal hole, then through the other."""
        nail = self.nail
        outer, canal = CORTEX_MM
        shaft = (
            cone(-110.0 * CAUDAL, FLARE_MM[0] * CAUDAL, outer),
            cone(FLARE_MM[0] * CAUDAL, FLARE_MM[1] * CAUDAL, outer, FLARED_MM),
        )
        condyles = tuple(ellipsoid(CONDYLE_MM * [side, 1.0, 1.0], CONDYLE_HALF_MM) for side in (1.0, -1.0))
        reamed = cone(-120.0 * CAUDAL, (SPACING_MM + TIP_MM) * nail.along, canal).with_cortex(0.0).cut()
        bone = BonePart((*shaft, *condyles, reamed), self.cancellous, 3.0, blend_mm=8.0)
        half = self.diameter_mm / 2
        wires = np.array([[point - half * axis, point + half * axis] for point, axis in nail.holes[::-1]])
        tip = nail.placed(np.array([[0.0, 0.0, SPACING_MM + TIP_MM]]))[0]
        stroke = nail.placed(np.column_stack([np.zeros((2, 2)), STROKE_MM]))
        made = BoneModel(
            parts=(bone,),
            low_mm=np.array([-48.0, -90.0, -48.0]),
            high_mm=np.array([48.0, 98.0, 48.0]),
            wires_mm=wires,
            aids={"nail": TubeAid(stroke, 1e-6 * np.linalg.svd(nail.along[None])[2][1:], half)},
            landmarks_mm={"nail tip": tip},
            metal=(nail.mesh(),),
        )
        lateral = np.array([1.0, 0.0, 0.0])
        epicondyles = {
            "lateral epicondyle": made.surface_mm(CONDYLE_MM, lateral),
            "medial epicondyle": made.surface_mm(CONDYLE_MM * [-1.0, 1.0, 1.0], -lateral),
        }
        return replace(made, landmarks_mm={**made.landmarks_mm, **epicondyles})


def draw_nailed_femur(rng: np.random.Generator) -> NailedFemur:
    """Draw a nail of 10 to 12 mm that is bent by up to 2°, as `draw_nail` does."""
    x, z = rng.uniform(-0.05, 0.05, 2)
    return NailedFemur(
        diameter_mm=float(rng.choice([10.0, 11.0, 12.0])),
        material=str(rng.choice(["titanium", "steel"])),
        along_rad=(float(x), float(z)),
        roll_rad=float(rng.uniform(-0.05, 0.05)),
        bend_rad=float(np.deg2rad(rng.uniform(0.0, 2.0))),
        bend_angle_rad=float(rng.uniform(-np.pi, np.pi)),
        cancellous=float(rng.uniform(0.12, 0.25)),
    )
