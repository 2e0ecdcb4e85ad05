"""Objects in the beam: balls, rods, plates, a body, metal and drapes; a scene of them; rigid motions. mm, CFCS."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from math import radians
from typing import TypeAlias, TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import SetUpError
from sightline.frame import Fiducial, Frame, Plate, RigidBody
from sightline.frame.drawings.part import COVER_MM, THICKNESS_MM, WASHER_MM
from sightline.imaging.volumes.beam import THREE, excess_per_mm, spectrum
from sightline.imaging.volumes.meshes import Mesh
from sightline.imaging.volumes.volume import Volume

Point: TypeAlias = tuple[float, float, float]
PLATE_RIM_MM = 8.0  # [ours] from the outermost beads to the edge of a plate: room for a clamp
WASHER_HOLE = 0.5  # [ours] of inner to outer diameter: common washers have about this


@dataclass(frozen=True)
class Ball:
    """A ball that displaces the material `within`; None: air."""

    centre_mm: Point
    radius_mm: float
    within: str | None = "pmma"
    material: str = "steel"


@dataclass(frozen=True)
class Rod:
    """A cylinder, or a tube or washer if `hole_mm` > 0, that displaces the material `within`; None: air.

    `axis`: unit vector; `half_mm`: half the length along it; `hole_mm`: radius of the hole.
    """

    centre_mm: Point
    axis: Point
    radius_mm: float
    half_mm: float
    hole_mm: float = 0.0
    within: str | None = "tissue"
    material: str = "steel"


@dataclass(frozen=True, eq=False)
class Box:
    """A cuboid, cast with one ray per pixel. `axes` (3, 3): rows are its own axes; `half_mm` (3,): half its edges."""

    centre_mm: np.ndarray
    axes: np.ndarray
    half_mm: np.ndarray
    material: str = "pmma"
    within: str | None = None


@dataclass(frozen=True)
class SoftTissue:
    """Hip and thigh as an elliptic cylinder along Y. Centre (x, z) and half-axes (x, z), mm: of a slim adult [ours]."""

    centre_mm: tuple[float, float] = (-35.0, -5.0)
    half_mm: tuple[float, float] = (140.0, 105.0)

    def around(self, hip_mm: np.ndarray) -> "SoftTissue":
        """Return the body around a hip at (3,), CFCS, instead of one at the origin."""
        (x, z), (hip_x, _, hip_z) = self.centre_mm, hip_mm
        return replace(self, centre_mm=(float(x + hip_x), float(z + hip_z)))

    def skin_mm(self, ends_mm: np.ndarray) -> np.ndarray:
        """Return the point (3,) at which a line through two points (2, 3) leaves the body, on the side of the first.

        Raises SetUpError if the second point is not inside the body or the line does not leave it.
        """
        first, inner = np.asarray(ends_mm, dtype=np.float64)
        start, step = ((p[[0, 2]] - o) / self.half_mm for p, o in ((inner, self.centre_mm), (first - inner, 0.0)))
        a, b, c = step @ step, step @ start, start @ start - 1
        if not (c < 0 and a > 0):
            raise SetUpError("the line does not leave the body; its second point must lie within it")
        return inner + (first - inner) * (-b + np.sqrt(b * b - a * c)) / a

    def length_mm(self, focal_mm: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
        """Return the length (...,) of tissue, mm, on the rays from a focal point to points (..., 3)."""
        start = (focal_mm[[0, 2]] - self.centre_mm) / np.array(self.half_mm)
        x, y, z = (points_mm[..., k] - focal_mm[k] for k in range(3))  # sums over an axis of two or three are slow
        u, w = x / self.half_mm[0], z / self.half_mm[1]
        a, b, c = u * u + w * w, u * start[0] + w * start[1], (start**2).sum() - 1
        return 2 * np.sqrt(np.maximum(b * b - a * c, 0.0)) / a * np.sqrt(x * x + y * y + z * z)


Solid: TypeAlias = Ball | Rod


@dataclass(frozen=True, eq=False)
class Scene:
    """The objects in the beam; scenes can be added. `tissue`: the body, displaced by objects within "tissue"."""

    solids: tuple[Solid, ...] = ()
    boxes: tuple[Box, ...] = ()
    volumes: tuple[Volume, ...] = ()
    meshes: tuple[Mesh, ...] = ()
    tissue: SoftTissue | None = None

    def __add__(self, other: "Scene") -> "Scene":
        if self.tissue is not None and other.tissue is not None:
            raise SetUpError("two scenes with a body each cannot be added; remove the tissue from one of them")
        parts = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self) if f.name != "tissue"}
        return Scene(**parts, tissue=self.tissue or other.tissue)


def rod_between(
    start_mm: np.ndarray, end_mm: np.ndarray, radius_mm: float, hole_mm: float = 0.0, within: str | None = "tissue"
) -> Rod:
    """Return a steel rod or tube with the centres of its end faces at two points (3,)."""
    start, end = np.asarray(start_mm, dtype=np.float64), np.asarray(end_mm, dtype=np.float64)
    length = float(np.linalg.norm(end - start))
    if not length > 0:
        raise SetUpError("a rod needs two different points")
    (x, y, z), (a, b, c) = ((start + end) / 2).tolist(), ((end - start) / length).tolist()
    return Rod((x, y, z), (a, b, c), radius_mm, length / 2, hole_mm, within)


# Columns of a packed solid.
CENTRE, AXIS, RADIUS, HOLE, HALF = slice(0, 3), slice(3, 6), 6, 7, 8
COLUMNS = 9


def pack(solids: Sequence[Solid], beam: str = THREE) -> tuple[np.ndarray, np.ndarray]:
    """Pack solids into arrays: shapes (M, 9), with a negative half-length for a ball; attenuation (M, N) above that of
    the displaced material, 1/mm, at the N energies of a spectrum."""
    shapes, excess = np.zeros((len(solids), COLUMNS)), np.zeros((len(solids), len(spectrum(beam).weights)))
    for row, solid in enumerate(solids):
        shapes[row, CENTRE], shapes[row, RADIUS] = solid.centre_mm, solid.radius_mm
        excess[row] = excess_per_mm(solid.material, solid.within, beam)
        if isinstance(solid, Rod):
            shapes[row, AXIS], shapes[row, HOLE], shapes[row, HALF] = solid.axis, solid.hole_mm, solid.half_mm
        else:
            shapes[row, HALF] = -1.0
    return shapes, excess


def stations(shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (D, 3) along the axes of packed solids (M, 9), at most half a radius apart (for a ball its centre),
    and the index (D,) of the solid of each."""
    places, owner = [], []
    for m, shape in enumerate(shapes):
        half = max(shape[HALF], 0.0)
        steps = np.linspace(-half, half, 1 + int(np.ceil(4 * half / shape[RADIUS])))
        places.append(shape[CENTRE] + steps[:, None] * shape[AXIS])
        owner.append(np.full(len(steps), m))
    return np.concatenate([np.zeros((0, 3)), *places]), np.concatenate([np.zeros(0, dtype=int), *owner])


def frame_scene(frame: Frame) -> Scene:
    """Return a frame's beads and its plates or solid as a scene, without a plate on the detector."""
    still = replace(frame, detector=None)
    return Scene(solids=frame_solids(still), boxes=frame_boxes(still))


def plate_scene(frame: Frame) -> Scene:
    """Return the plate on the detector alone, where a frame has one; it is placed by `SetUp.frame_in`."""
    if frame.detector is None:
        return Scene()
    beads = tuple(_bead(bead, frame.detector) for bead in frame.detector.fiducials)
    return Scene(solids=beads, boxes=(_plate_box(frame.detector),))


def frame_solids(frame: Frame) -> tuple[Solid, ...]:
    """Return the beads of a frame, in the order of `Frame.fiducials`. Raises SetUpError for a washer in a solid."""
    return tuple(_bead(bead, body) for body in frame.bodies for bead in body.fiducials)


def _bead(bead: Fiducial, body: RigidBody) -> Solid:
    if bead.shape == "ball":
        return Ball(bead.xyz_mm, bead.diameter_mm / 2)
    if not isinstance(body, Plate):
        raise SetUpError(f"the twin cannot place the washer {bead.id!r} in a solid; a solid holds balls")
    x, y, z = (float(c) for c in body.plane.normal)
    hole = WASHER_HOLE * bead.diameter_mm / 2
    return Rod(bead.xyz_mm, (x, y, z), bead.diameter_mm / 2, WASHER_MM / 2, hole_mm=hole, within="pmma")


def frame_boxes(frame: Frame) -> tuple[Box, ...]:
    """Return the PMMA plates or the PMMA solid of a frame, sized to their beads."""
    return tuple(_plate_box(body) if isinstance(body, Plate) else _solid_box(body) for body in frame.bodies)


def _solid_box(solid: RigidBody) -> Box:
    """Return the cuboid around the beads, without pockets, along the axes of CFCS."""
    low, high = solid.xyz_mm.min(axis=0) - COVER_MM, solid.xyz_mm.max(axis=0) + COVER_MM
    return Box((low + high) / 2, np.eye(3), (high - low) / 2)


def _plate_box(plate: Plate) -> Box:
    xy = plate.plane.to_plane(plate.xyz_mm)
    low, high = xy.min(axis=0) - PLATE_RIM_MM, xy.max(axis=0) + PLATE_RIM_MM
    return Box(
        centre_mm=plate.plane.to_space((low + high) / 2),
        axes=plate.plane.basis,
        half_mm=np.array([*(high - low) / 2, THICKNESS_MM / 2]),
    )


Thing = TypeVar("Thing", bound=Ball | Rod | Box | Volume | Mesh | Scene)


@dataclass(frozen=True)
class BoneMotion:
    """Motion of a leg, s.d. per axis: as large as may stay unnoticed between two images [ours]."""

    shift_mm: float = 1.0
    rotation: float = radians(0.5)


def draw_motion(rng: np.random.Generator, about_mm: np.ndarray, spread: BoneMotion | None = None) -> RigidTransform:
    """Draw a small rigid motion in CFCS, with its rotation about a point (3,)."""
    spread = spread or BoneMotion()
    rotation = Rotation.from_rotvec(rng.normal(0.0, spread.rotation, 3))
    about = np.asarray(about_mm)
    shift = about + rng.normal(0.0, spread.shift_mm, 3) - rotation.apply(about)
    return RigidTransform.from_components(shift, rotation)


def moved(thing: Thing, motion: RigidTransform) -> Thing:
    """Return an object, or a scene without moving its body, after a rigid motion: p becomes motion.apply(p)."""
    rotation = motion.rotation.as_matrix()
    match thing:
        case Ball():
            return replace(thing, centre_mm=_point(motion, thing.centre_mm))
        case Rod():
            x, y, z = (float(c) for c in rotation @ thing.axis)
            return replace(thing, centre_mm=_point(motion, thing.centre_mm), axis=(x, y, z))
        case Box():
            return replace(thing, centre_mm=motion.apply(thing.centre_mm), axes=thing.axes @ rotation.T)
        case Volume():
            return replace(thing, origin_mm=motion.apply(thing.origin_mm), axes=thing.axes @ rotation.T)
        case Mesh():
            return replace(thing, vertices_mm=motion.apply(thing.vertices_mm))
        case Scene():
            return replace(
                thing,
                solids=tuple(moved(solid, motion) for solid in thing.solids),
                boxes=tuple(moved(box, motion) for box in thing.boxes),
                volumes=tuple(moved(volume, motion) for volume in thing.volumes),
                meshes=tuple(moved(mesh, motion) for mesh in thing.meshes),
            )


def _point(motion: RigidTransform, at: Point) -> Point:
    x, y, z = (float(c) for c in motion.apply(np.array(at)))
    return x, y, z


WIRE_DIAMETER_MM = 2.5  # [paper]
WIRE_LENGTH_MM = 200.0  # [paper]
# A trocar tip [ours]: its length, in diameters; and the step of its radius from disc to disc, half a pixel or less.
TIP_DIAMETERS, TIP_STEP_MM = 1.5, 0.1
# A sliding hip screw of 135° [paper], and what else lies in a beam: sizes of common makes [ours, typical].
SHANK_DIAMETER_MM = 8.0
THREAD_DIAMETER_MM, THREAD_LENGTH_MM, THREAD_PITCH_MM = 12.5, 22.0, 2.75
BORE_DIAMETER_MM = 3.2  # cannulation
BARREL_DIAMETER_MM, BARREL_LENGTH_MM = 13.0, 38.0
SIDE_PLATE_MM = (6.0, 19.0)  # thickness, width
PLATE_ABOVE_MM = 18.0  # how far the plate extends above the entry point
SCREWS, SCREW_PITCH_MM, FIRST_SCREW_MM = 4, 16.0, 22.0  # four screws [paper]
SCREW_DIAMETER_MM, SCREW_LENGTH_MM = 4.5, 38.0
SHEET_MM = 0.15  # thickness of a sterile drape of polyethylene
FOLD_SHEETS = (2, 8)  # range of the number of sheets in a fold, both included
FOLD_MM = (4.0, 15.0)  # half-width of a fold
RAIL_MM = (10.0, 25.0)  # thickness and height of an operating table's steel rail
GUIDE_MM, GUIDE_LENGTH_MM, GUIDE_PLAY_MM = 10.0, 120.0, 0.2  # outer diameter, length, hole over wire
FOOT_MM, FOOT_THICK_MM = 18.0, 3.0  # the guide's foot on the skin


def guide_wire(
    wire_mm: np.ndarray,
    diameter_mm: float = WIRE_DIAMETER_MM,
    length_mm: float = WIRE_LENGTH_MM,
    within: str | None = "tissue",
) -> Scene:
    """Return a straight steel wire with its tip at the second of two points (2, 3) and its axis through the first."""
    tip, back = _axis(wire_mm)
    discs = int(np.ceil(diameter_mm / 2 / TIP_STEP_MM))
    at = np.append(np.linspace(0.0, TIP_DIAMETERS * diameter_mm, discs + 1), length_mm)
    wide = np.append((np.arange(discs) + 0.5) / discs, 1.0) * diameter_mm / 2
    parts = zip(pairwise(at), wide.tolist(), strict=True)
    return Scene(solids=tuple(rod_between(tip + a * back, tip + b * back, r, within=within) for (a, b), r in parts))


def lag_screw(wire_mm: np.ndarray) -> Scene:
    """Return a cannulated lag screw over a wire (2, 3), its shank reaching to the entry, its thread made of rings."""
    tip, back = _axis(wire_mm)
    outer, inner = THREAD_DIAMETER_MM / 2, SHANK_DIAMETER_MM / 2
    rings = [
        rod_between(tip + a * back, tip + (a + THREAD_PITCH_MM / 4) * back, outer, inner)
        for a in np.arange(0.0, THREAD_LENGTH_MM, THREAD_PITCH_MM)
    ]
    return Scene(solids=(rod_between(tip, wire_mm[0], inner, BORE_DIAMETER_MM / 2), *rings))


def angled_plate(wire_mm: np.ndarray, caudal: np.ndarray) -> Scene:
    """Return the plate on the lateral cortex: barrel around the wire (2, 3), blade along `caudal` (3,), four screws.

    Raises SetUpError if the wire runs along the shaft.
    """
    _, back = _axis(wire_mm)
    down = np.asarray(caudal, dtype=np.float64) / np.linalg.norm(caudal)
    outward = back - (back @ down) * down
    if np.linalg.norm(outward) < 0.1:
        raise SetUpError("the wire runs along the shaft; an angled plate needs an angle")
    outward /= np.linalg.norm(outward)
    entry = np.asarray(wire_mm, dtype=np.float64)[0]
    thick, wide = SIDE_PLATE_MM
    reach = FIRST_SCREW_MM + SCREW_PITCH_MM * (SCREWS - 1) + 10.0
    middle = entry + outward * thick / 2 + down * (reach - PLATE_ABOVE_MM) / 2
    half = np.array([thick, wide, reach + PLATE_ABOVE_MM]) / 2
    blade = Box(middle, np.stack([outward, np.cross(down, outward), down]), half, material="steel", within="tissue")
    inside = entry - BARREL_LENGTH_MM * back
    barrel = rod_between(entry, inside, BARREL_DIAMETER_MM / 2, SHANK_DIAMETER_MM / 2)
    heads = [entry + down * (FIRST_SCREW_MM + SCREW_PITCH_MM * k) for k in range(SCREWS)]
    screws = [rod_between(head, head - SCREW_LENGTH_MM * outward, SCREW_DIAMETER_MM / 2) for head in heads]
    return Scene(solids=(barrel, *screws), boxes=(blade,))


def _axis(wire_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the end point (3,) of a wire (2, 3), and the unit vector (3,) from there to its entry."""
    entry, end = np.asarray(wire_mm, dtype=np.float64)
    length = np.linalg.norm(entry - end)
    if not length > 0:
        raise SetUpError("a wire needs two different points")
    return end, (entry - end) / length


def drape(
    rng: np.random.Generator, at_mm: np.ndarray, normal: np.ndarray, half_mm: float = 150.0, folds: int = 6
) -> Scene:
    """Draw a sheet across `normal` (3,) around a point (3,), with folds of several sheets at random positions and
    angles."""
    third = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    first, second = np.linalg.svd(third[None])[2][1:]
    sheet = Box(np.asarray(at_mm), np.stack([first, second, third]), np.array([half_mm, half_mm, SHEET_MM / 2]))
    boxes = [sheet]
    for _ in range(folds):
        angle = rng.uniform(0, np.pi)
        along = np.cos(angle) * first + np.sin(angle) * second
        thick = SHEET_MM * rng.integers(*FOLD_SHEETS, endpoint=True)
        across = np.cross(third, along)
        centre = sheet.centre_mm + rng.uniform(-half_mm / 2, half_mm / 2) * across + third * (thick + SHEET_MM) / 2
        half = np.array([half_mm, rng.uniform(*FOLD_MM), thick / 2])
        boxes.append(Box(centre, np.stack([along, across, third]), half))
    return Scene(boxes=tuple(Box(b.centre_mm, b.axes, b.half_mm, material="polyethylene") for b in boxes))


def table_rail(at_mm: np.ndarray, length_mm: float = 600.0) -> Scene:
    """Return the steel rail of the operating table along Y, centred at a point (3,), with its flat sides towards ±X."""
    half = np.array([RAIL_MM[0], length_mm, RAIL_MM[1]]) / 2
    return Scene(boxes=(Box(np.asarray(at_mm), np.eye(3), half, material="steel"),))


def drill_guide(wire_mm: np.ndarray, body: SoftTissue, wire_diameter_mm: float = WIRE_DIAMETER_MM) -> Scene:
    """Return a steel tube on the line of a wire (2, 3: entry, end), with its foot on the skin. Raises SetUpError."""
    entry, end = np.asarray(wire_mm, dtype=np.float64)
    back = (entry - end) / np.linalg.norm(entry - end)
    skin, hole = body.skin_mm(wire_mm), (wire_diameter_mm + GUIDE_PLAY_MM) / 2
    tube = rod_between(skin, skin + GUIDE_LENGTH_MM * back, GUIDE_MM / 2, hole, within=None)
    foot = rod_between(skin, skin + FOOT_THICK_MM * back, FOOT_MM / 2, GUIDE_MM / 2, within=None)
    return Scene(solids=(tube, foot))
