"""A nail with two distal holes, and the lower end of a femur around it.

Anatomical coordinates (lateral, caudal, anterior), mm; the origin is the nail's upper distal hole.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.errors import SetUpError
from sightline.imaging.volumes.meshes import Mesh
from sightline.twin.anatomy.bone_model import BoneModel, BonePart, TubeAid
from sightline.twin.anatomy.shapes import cone, ellipsoid

# Sizes [ours, typical].
SPACING_MM = 28.0  # between both holes; makers have 25 to 30 mm
BENT_MM = 100.0  # the length over which the nail bends
REACH_MM = 90.0  # how far the mesh reaches from the first hole, away from the tip
TIP_MM = 14.0  # from the second hole to the tip
CORTEX_MM = (15.0, 7.5)  # outer and inner radius of the femur's shaft (physics.md, Femur), with a reamed canal
THIGH_MM = (80.0, 75.0)  # half-axes of the thigh above the knee
AROUND, STEP_MM = 128, 3.0  # segments of the tube: 2 µm from round; its rings
PLUG = (12, 96)  # rings and segments of a hole
CAUDAL = np.array([0.0, 1.0, 0.0])
CONDYLE_MM = np.array([22.0, 66.0, -8.0])  # middle of the lateral one
CONDYLE_HALF_MM = (17.0, 22.0, 27.0)
FLARE_MM, FLARED_MM = (20.0, 62.0), 24.0  # where the shaft widens towards the knee, and how far
STROKE_MM = (-18.0, SPACING_MM + 10.0)  # ends of the strokes along the nail's edges


@dataclass(frozen=True, eq=False)
class DistalNail:
    """The truth of a nail. `hole_mm` (3,): where the first hole's axis crosses the nail's axis; `along` (3,): the nail
    there, towards its tip; `axis` (3,): the hole's axis, perpendicular to `along`. Diameters mm. `bend`: rotation of
    the nail's axis over 100 mm, rad, towards `bend_angle` from the hole's axis, about the nail.

    Raises SetUpError.
    """

    hole_mm: np.ndarray
    along: np.ndarray
    axis: np.ndarray
    diameter_mm: float = 11.0
    hole_diameter_mm: float = 5.0
    bore_mm: float = 5.0
    bend: float = 0.0
    bend_angle: float = 0.0
    material: str = "titanium"

    def __post_init__(self) -> None:
        if abs(float(self.along @ self.axis)) > 1e-9 or not 0 < self.hole_diameter_mm < self.diameter_mm:
            raise SetUpError("a nail's holes are perpendicular to it, and smaller than the nail")

    @property
    def _bend(self) -> tuple[tuple[float, float], np.ndarray, np.ndarray]:
        """Cosine and sine of the bend's angle, the direction towards which the nail bends, and the axis of the bend."""
        first, second = np.cross(self.axis, self.along), self.axis
        cos, sin = float(np.cos(self.bend_angle)), float(np.sin(self.bend_angle))
        return (cos, sin), cos * second + sin * first, cos * first - sin * second

    @property
    def holes(self) -> np.ndarray:
        """(2, 2, 3): point and direction of each hole's axis, the one away from the tip first."""
        ends = [self.placed(np.array([[0.0, 0.0, s], [0.0, 1.0, s]])) for s in (0.0, SPACING_MM)]
        return np.array([[point, end - point] for point, end in ends])

    def placed(self, own_mm: np.ndarray) -> np.ndarray:
        """Convert coordinates (N, 3) of the straight nail (across the hole, along the hole, along the nail) to CFCS."""
        (cos, sin), towards, still = self._bend
        curvature = max(self.bend, 1e-9) / BENT_MM
        angle = curvature * own_mm[:, 2:]
        middle = np.sin(angle) * self.along + (1 - np.cos(angle)) * towards
        turned = np.cos(angle) * towards - np.sin(angle) * self.along
        x, y = own_mm[:, :1], own_mm[:, 1:2]
        return self.hole_mm + middle / curvature + (cos * x - sin * y) * still + (sin * x + cos * y) * turned

    def inside(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return whether points (N, 3) lie in the nail's metal: within its tube, and in neither hole."""
        (cos, sin), towards, still = self._bend
        radius = BENT_MM / max(self.bend, 1e-9)
        off = xyz_mm - (self.hole_mm + radius * towards)  # from the centre of the bend
        along, inwards = off @ self.along, off @ towards
        s, t, across = radius * np.arctan2(along, -inwards), radius - np.hypot(along, inwards), off @ still
        x, y = cos * across + sin * t, cos * t - sin * across
        rho = np.hypot(x, y)
        tube = (rho < self.diameter_mm / 2) & (rho > self.bore_mm / 2) & (s > -REACH_MM) & (s < SPACING_MM + TIP_MM)
        return tube & (np.hypot(x[:, None], s[:, None] - [0.0, SPACING_MM]).min(axis=1) > self.hole_diameter_mm / 2)

    def mesh(self) -> Mesh:
        """Return the nail as one mesh: its tube, less the material that both holes remove."""
        parts = [_tube(self.diameter_mm / 2, max(self.bore_mm / 2, 0.01))]
        radii = self.hole_diameter_mm / 2, self.diameter_mm / 2, self.bore_mm / 2
        parts += [_plug(*radii, side, s) for s in (0.0, SPACING_MM) for side in (1.0, -1.0)]
        first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
        vertices = np.concatenate([vertices for vertices, _ in parts])
        triangles = np.concatenate([faces + start for (_, faces), start in zip(parts, first, strict=False)])
        return Mesh(self.placed(vertices), triangles, self.material, "tissue")


def draw_nail(rng: np.random.Generator, at_mm: np.ndarray, beam: np.ndarray, *, off_beam: float = 0.1) -> DistalNail:
    """Draw a nail along Y at a point (3,), its holes within `off_beam` rad (about the nail) of a beam (3,).

    Diameters of 10 to 12 mm, holes of 5 mm, bends up to 2°.
    """
    along = Rotation.from_rotvec(rng.uniform(-0.09, 0.09, 3)).apply([0.0, 1.0, 0.0])
    axis = beam - (beam @ along) * along
    axis = Rotation.from_rotvec(rng.uniform(-off_beam, off_beam) * along).apply(axis / np.linalg.norm(axis))
    return DistalNail(
        np.asarray(at_mm, dtype=np.float64),
        along,
        axis,
        diameter_mm=float(rng.choice([10.0, 11.0, 12.0])),
        bend=float(np.deg2rad(rng.uniform(0.0, 2.0))),
        bend_angle=float(rng.uniform(-np.pi, np.pi)),
        material=str(rng.choice(["titanium", "steel"])),
    )


def _tube(outer: float, bore: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a tube: rings along its outside, and back along its bore."""
    s = np.linspace(-REACH_MM, SPACING_MM + TIP_MM, round((REACH_MM + SPACING_MM + TIP_MM) / STEP_MM))
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    rings = [(outer, z) for z in s] + [(bore, z) for z in s[::-1]]
    round_ = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    vertices = np.concatenate([np.column_stack([r * round_, np.full(AROUND, z)]) for r, z in rings])
    return vertices, _grid(len(rings), AROUND, closed=True)


def _plug(radius: float, outer: float, bore: float, side: float, s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what a hole removes from one wall at `s` along the nail: between bore and surface, facing inwards."""
    rings, around = PLUG
    rho = radius * np.sqrt(np.append(1e-6, np.arange(1, rings + 1) / rings))
    angle = 2 * np.pi * np.arange(around) / around
    x, z = rho[:, None] * np.cos(angle), rho[:, None] * np.sin(angle)
    top, low = np.sqrt(outer**2 - x**2), np.sqrt(np.maximum(bore**2 - x**2, 0.0))
    shells = [np.stack([x, side * y, z + s], axis=-1) for y in (top, low)]
    vertices = np.concatenate([shells[0], shells[1][::-1]]).reshape(-1, 3)
    faces = _grid(2 * len(rho), around, closed=True)
    return vertices, faces[:, ::-1] if side > 0 else faces


def _grid(rings: int, around: int, *, closed: bool) -> np.ndarray:
    """Return the triangles (T, 3) between rings of vertices; closed: also between the last and the first."""
    i, j = np.meshgrid(np.arange(rings if closed else rings - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    c, d = (i + 1) % rings * around + j, (i + 1) % rings * around + (j + 1) % around
    return np.concatenate([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)]).reshape(-1, 3)


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
