"""Bones built of shapes: their volume, the exact distances that the truth of a procedure needs, what a person would
draw of them on images, and wires that are wrong by a known amount.

Anatomical coordinates: (lateral, caudal, anterior), mm, lateral towards the operated side; the bone states its origin.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sightline.common.geometry.rigid import fibonacci_sphere
from sightline.common.threads import in_parts
from sightline.errors import SetUpError
from sightline.imaging.volumes.meshes import Mesh
from sightline.imaging.volumes.volume import Volume
from sightline.twin.anatomy.femur import NARROWEST, Femur, placed, to_cfcs
from sightline.twin.anatomy.shapes import FIRST, NUMBERS, SolidShape, depths, fill, nearest, texture
from sightline.twin.xray.setup import ViewTruth

DIRECTIONS = 200  # of the search for the nearest point, before it is refined
BOUND = 0.85  # share of a depth that a distance is at least: barrels and ellipsoids are exact to first order only
BORDER_MM = 15.0  # [ours] at most, of a wire's entry from the border that a person draws: farther, it is another border
FIELDS = ("surface", "outline", "cancellous", "gap")


@dataclass(frozen=True)
class BonePart:
    """A piece of bone. `shapes`: joined in their order. `spongy`: share of bone in its cancellous inside.

    `gap_mm`: width of the gap to all earlier parts, which displace this one (a joint, a growth plate); 0: none.
    """

    shapes: tuple[SolidShape, ...]
    spongy: float
    cortex_mm: float
    blend_mm: float = 4.0
    gap_mm: float = 0.0

    def shifted(self, by_mm: ArrayLike) -> "BonePart":
        """Return the part moved by (3,)."""
        return replace(self, shapes=tuple(shape.shifted(by_mm) for shape in self.shapes))


Points: TypeAlias = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class SphereAid:
    """An aid: a sphere that a person fits to a bone's outline."""

    centre_mm: np.ndarray
    radius_mm: float

    def mapped(self, points: Points) -> "SphereAid":
        """Return the sphere after an isometry of points (..., 3)."""
        return replace(self, centre_mm=points(self.centre_mm))


@dataclass(frozen=True)
class LineAid:
    """An aid: a line through two points (2, 3)."""

    ends_mm: np.ndarray

    def mapped(self, points: Points) -> "LineAid":
        """Return the line after an isometry of points (..., 3)."""
        return LineAid(points(self.ends_mm))


@dataclass(frozen=True)
class PlaneAid:
    """An aid: a plane through a point (3,), with a unit normal (3,); it is drawn up to `half_mm` from the point."""

    point_mm: np.ndarray
    normal: np.ndarray
    half_mm: float = 15.0

    def mapped(self, points: Points) -> "PlaneAid":
        """Return the plane after an isometry of points (..., 3)."""
        normal = points(self.point_mm + self.normal) - points(self.point_mm)
        return replace(self, point_mm=points(self.point_mm), normal=normal)


@dataclass(frozen=True)
class TubeAid:
    """An aid: a tube of bone between two ends (2, 3) of its axis.

    Its section holds all points within `round_mm` of a rectangle of the half sides `across_mm` (2, 3), the longer one
    first: vectors perpendicular to each other and to the axis. `oval`: seen end-on, its section is drawn.
    """

    ends_mm: np.ndarray
    across_mm: np.ndarray
    round_mm: float
    oval: bool = False

    def mapped(self, points: Points) -> "TubeAid":
        """Return the tube after an isometry of points (..., 3)."""
        return replace(self, ends_mm=points(self.ends_mm), across_mm=points(self.across_mm) - points(np.zeros(3)))


Aid: TypeAlias = SphereAid | LineAid | PlaneAid | TubeAid


@dataclass(frozen=True, eq=False)
class BoneModel:
    """A bone and the truth of its procedure, anatomical coordinates.

    - `parts`; `low_mm`, `high_mm` (3,): the box that is voxelised; `mirrored`: equal on both sides of the plane x = 0
    - `wires_mm` (n, 2, 3): entry and end of the standard wires
    - `landmarks_mm`: points (3,) that a person can find in both views, by name
    - `aids`: what a person draws on the images, by name
    - `around`: parts of other bones, which images show, but which no distance refers to
    - `metal`: implants in the bone
    - `keep_out`: what no wire may touch besides the bone's surface, by name: shapes with exact distances outside them
    """

    parts: tuple[BonePart, ...]
    low_mm: np.ndarray
    high_mm: np.ndarray
    wires_mm: np.ndarray
    landmarks_mm: Mapping[str, np.ndarray]
    aids: Mapping[str, Aid]
    keep_out: Mapping[str, tuple[SolidShape, ...]] = field(default_factory=dict)
    around: tuple[BonePart, ...] = ()
    metal: tuple[Mesh, ...] = ()
    mirrored: bool = False
    voxel_mm: float = 0.75

    @cached_property
    def _tables(self) -> tuple[np.ndarray, np.ndarray]:
        return _packed(self.parts)

    def distance_mm(self, xyz_mm: np.ndarray, of: str = "surface") -> np.ndarray:
        """Return the signed distances (...) of points (..., 3) from a surface, negative inside it.

        `of`: "surface" of the bone; "outline", the same with the gaps between its parts filled; "cancellous", the inner
        surface of the cortex; "gap", those gaps; or a name in `keep_out`. The error is below 0.1 mm, in 99 % below
        0.01 mm (docs/bones.md). Raises SetUpError for another name.
        """
        points = np.asarray(xyz_mm, dtype=np.float64)
        if of in self.keep_out:
            return np.min([shape.distance_mm(points) for shape in self.keep_out[of]], axis=0)
        if of not in FIELDS:
            raise SetUpError(f"there is no surface {of!r}; there are: {', '.join((*FIELDS, *self.keep_out))}")
        return self._evaluated(nearest, points, of, fibonacci_sphere(DIRECTIONS))

    def depth_mm(self, xyz_mm: np.ndarray, of: str = "surface") -> np.ndarray:
        """Return the value (...) of the field of `of` at points (..., 3): negative inside, zero on the surface.

        Its size is at most about that of `distance_mm`, and it takes a thousandth of the time.
        """
        return self._evaluated(depths, np.asarray(xyz_mm, dtype=np.float64), of)

    def _evaluated(self, kernel: Callable[..., None], points: np.ndarray, of: str, *more: np.ndarray) -> np.ndarray:
        """Return what a kernel of `shapes` finds (...) at points (..., 3)."""
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        values = np.empty(len(flat))
        in_parts(kernel, flat, *self._tables, self.mirrored, FIELDS.index(of), *more, values)
        return values.reshape(points.shape[:-1])

    def clearance_mm(self, wire_mm: np.ndarray, of: str = "outline", from_entry_mm: float = 12.0) -> float:
        """Return the shortest distance of the axis of a wire (2, 3) from a surface: for "outline" the distance by which
        it stays inside (negative where it leaves), for others that by which it stays outside.

        Parts nearer to the entry than `from_entry_mm` are left out, since there the wire passes the surface.
        """
        entry, end = np.asarray(wire_mm, dtype=np.float64)
        length = float(np.linalg.norm(end - entry))
        at = np.linspace(min(from_entry_mm / length, 1.0), 1.0, max(int(length), 2))
        points = entry + at[:, None] * (end - entry)
        if of not in FIELDS:
            return float(self.distance_mm(points, of).min())
        sign = -1.0 if of in {"outline", "surface"} else 1.0
        bound = sign * self.depth_mm(points, of)
        best = np.inf
        for k in np.argsort(bound):
            if bound[k] > 0 and BOUND * bound[k] >= best:
                break
            best = min(best, float(sign * self.distance_mm(points[k], of)))
        return best

    def surface_mm(self, inside_mm: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the last point (3,) of the outline on a ray from a point (3,).

        Raises SetUpError if the ray meets no bone or does not leave it within 200 mm.
        """
        return self._crossing(inside_mm, direction, -1)

    def surface_near(self, start_mm: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the first point (3,) of the outline on a ray from any point (3,); see `surface_mm`."""
        return self._crossing(start_mm, direction, 0)

    def _crossing(self, start_mm: np.ndarray, direction: np.ndarray, which: int) -> np.ndarray:
        start, along = np.asarray(start_mm, dtype=np.float64), np.asarray(direction, dtype=np.float64)
        along = along / np.linalg.norm(along)
        at = np.arange(0.0, 200.0, 0.5)
        inside = self.depth_mm(start + at[:, None] * along, "outline") < 0
        changes = np.flatnonzero(inside[1:] != inside[:-1])
        if inside[-1] or not len(changes):
            raise SetUpError("the ray does not leave the bone; start it inside the bone")
        low, high = at[changes[which]], at[changes[which] + 1]
        before = inside[changes[which]]
        for _ in range(40):
            middle = (low + high) / 2
            same = (self.depth_mm(start + middle * along, "outline") < 0) == before
            low, high = (middle, high) if same else (low, middle)
        return start + low * along

    def wire_through(self, inside_mm: np.ndarray, along: np.ndarray, short_mm: float) -> np.ndarray:
        """Return the wire (2, 3) through a point (3,) inside the bone, along a unit vector (3,): from the outline to
        `short_mm` before it. Raises SetUpError."""
        end = self.surface_mm(inside_mm, along) - short_mm * along
        return np.stack([self.surface_mm(inside_mm, -along), end])

    def with_wire(self, wire_mm: np.ndarray, surfaces: Mapping[str, tuple[float, float, float] | None]) -> "BoneModel":
        """Return the bone with a standard wire (2, 3), and the aids that show where it enters, by name.

        `surfaces`: the beam (3,) of the image that shows the bone's outer border across the wire, which lies outside
        the entry, or None for the surface at the entry itself. A border farther than BORDER_MM is not drawn.
        """
        made = {name: self._surface(wire_mm, beam) for name, beam in surfaces.items()}
        known = {name: aid for name, aid in made.items() if aid is not None}
        return replace(self, wires_mm=wire_mm[None], aids={**self.aids, **known})

    def _surface(self, wire_mm: np.ndarray, beam: tuple[float, float, float] | None) -> PlaneAid | None:
        entry, along = wire_mm[0], (wire_mm[1] - wire_mm[0]) / np.linalg.norm(wire_mm[1] - wire_mm[0])
        if beam is None:
            return PlaneAid(entry, self._normal(entry))
        back, deep = np.arange(0.0, BORDER_MM, 0.25), np.arange(-120.0, 120.0, 1.0)
        on_rays = (entry - back[:, None] * along)[:, None] + deep[:, None] * np.array(beam)
        depth = self.depth_mm(on_rays, "outline")
        beside = np.flatnonzero((depth > 0.0).all(axis=1))
        if not len(beside):
            return None
        first = beside[0]
        return PlaneAid(entry - back[first] * along, self._normal(on_rays[first, depth[first].argmin()]))

    def _normal(self, at_mm: np.ndarray) -> np.ndarray:
        """Return the unit normal (3,) of the outline near a point (3,)."""
        steps = 0.3 * np.eye(3)
        slope = self.depth_mm(at_mm + steps, "outline") - self.depth_mm(at_mm - steps, "outline")
        return slope / np.linalg.norm(slope)

    def volume(self, side: str, origin_mm: np.ndarray, rng: np.random.Generator | None) -> Volume:
        """Return the bone as a volume, CFCS, with its origin at (3,), and a random trabecular texture unless `rng` is
        None."""
        nx, ny, nz = (int(n) for n in np.ceil((self.high_mm - self.low_mm) / self.voxel_mm))
        tile = np.zeros((1, 1, 1), dtype=np.float32) if rng is None else texture(rng)
        values = np.zeros((nx, ny, nz), dtype=np.float32)
        in_parts(fill, self.low_mm, self.voxel_mm, *_packed(self.parts + self.around), self.mirrored, tile, values)
        return placed(values, self.low_mm, self.voxel_mm, side, origin_mm)


def _packed(parts: tuple[BonePart, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the table of shapes (M, FIRST + NUMBERS), and that of parts (P, 2: gap, spongy)."""
    shapes = [(k, part, shape) for k, part in enumerate(parts) for shape in part.shapes]
    table = np.zeros((len(shapes), FIRST + NUMBERS))
    for row, (k, part, shape) in zip(table, shapes, strict=True):
        soft = part.blend_mm if shape.blend_mm is None else shape.blend_mm
        hard = part.cortex_mm if shape.cortex_mm is None else shape.cortex_mm
        row[:FIRST] = k, shape.join, soft, hard, shape.kind
        row[FIRST : FIRST + len(shape.numbers)] = shape.numbers
    return table, np.array([[part.gap_mm, part.spongy] for part in parts])


# Of the search for wrong wires [ours]: how far beyond a wire may end, and aside, to leave a corridor or to reach what
# must not be touched; farther, it is another wire. Step: one that is wrong for a smaller movement only may be missed.
MAX_LONGER_MM, MAX_ASIDE_MM, STEP_MM = 60.0, 80.0, 3.0
FAR, CORTEX = "through the far surface", "out of the cortex"


def wrong_wires(bone: BoneModel, beyond_mm: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return wrong wires (2, 3) by kind, anatomical coordinates, with the entry of the first standard wire.

    - FAR: the end lies `beyond_mm` outside the far surface (of a head: through its joint surface)
    - CORTEX: the axis leaves the bone sideways by `beyond_mm`, towards a drawn direction
    - "into the NAME": the axis passes `beyond_mm` inside something of `BoneModel.keep_out`

    A kind that this bone does not allow is left out: no far surface within MAX_LONGER_MM, or no wire whose end has
    moved by less than MAX_ASIDE_MM. Raises SetUpError if `beyond_mm` is not above zero.
    """
    if not beyond_mm > 0:
        raise SetUpError("a wrong wire needs a distance above zero")
    entry, end = bone.wires_mm[0]
    along = (end - entry) / np.linalg.norm(end - entry)
    wires = {}
    far = bone.surface_near(end, along)
    deeper = smallest_amount(lambda s: float(bone.distance_mm(far + s * along, "outline")), beyond_mm, MAX_ASIDE_MM)
    if np.linalg.norm(far - end) < MAX_LONGER_MM and deeper is not None:
        wires[FAR] = np.stack([entry, far + deeper * along])
    aside = np.linalg.svd(along[None])[2][1:].T @ _unit(rng.standard_normal(2))
    for kind, of, towards in [
        (CORTEX, "outline", aside),
        *((f"into the {name}", name, _towards(bone, name, along)) for name in bone.keep_out),
    ]:
        moved = smallest_amount(
            lambda s, of=of, towards=towards: -bone.clearance_mm(np.stack([entry, end + s * towards]), of),
            beyond_mm,
            MAX_ASIDE_MM,
        )
        if moved is not None:
            wires[kind] = np.stack([entry, end + moved * towards])
    return wires


def _towards(bone: BoneModel, of: str, along: np.ndarray) -> np.ndarray:
    """Return the unit vector (3,), across the wire, towards what is nearest of `of`."""
    entry, end = bone.wires_mm[0]
    at = entry + np.linspace(0, 1, 200)[:, None] * (end - entry)
    nearest = at[bone.distance_mm(at, of).argmin()]
    steps = 0.01 * np.eye(3)
    slope = bone.distance_mm(nearest - steps, of) - bone.distance_mm(nearest + steps, of)
    return _unit(slope - (slope @ along) * along)


def smallest_amount(violation_mm: Callable[[float], float], wanted_mm: float, limit: float) -> float | None:
    """Return the smallest amount at which a violation is as wanted, to 0.001 mm; None up to `limit`."""
    high = next((s for s in np.arange(STEP_MM, limit, STEP_MM) if violation_mm(s) >= wanted_mm), None)
    if high is None:
        return None
    low = high - STEP_MM
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (low, middle) if violation_mm(middle) >= wanted_mm else (middle, high)
    return float(high)


END_ON = np.cos(np.pi / 4)  # an oval tube nearer to the beam than this shows its section, others their borders [ours]
_TOUCHES = 4  # iterations of a border's tangent point; each reduces its error a hundredfold
RIM_ANGLES_RAD = np.radians([100.0, 190.0, 340.0])  # of the clicks on a sphere's rim


def drawn_aids(aids: Mapping[str, Aid], views: Mapping[str, ViewTruth]) -> dict[str, dict[str, np.ndarray]]:
    """Return the true pixels of clicks, (M, 2) by aid and view, of aids in CFCS (`BoneScene.aids`, `hip_aids`).

    The names of the aids are those of procedures' files, with "-" for a space: "growth plate" is "growth-plate".

    - a sphere: three clicks on its rim
    - a line: its ends
    - a plane: the ends of its diameter perpendicular to the beam
    - a tube: two clicks on one border and two on the other; of an oval one seen end-on the ends of the long axis of its
      section, then those of the short one
    """
    return {
        key_of(name): {view.name: view.project(clicked_mm(aid, view.focal_point_mm)) for view in views.values()}
        for name, aid in aids.items()
    }


def key_of(name: str) -> str:
    """Return the key in procedures' files of an aid or a landmark of the twin, by its name."""
    return name.replace(" ", "-")


def hip_aids(femur: Femur, side: str, head_mm: np.ndarray) -> dict[str, Aid]:
    """Return head, neck, shaft and outline of the neck of a hip, CFCS, with its head's centre at (3,)."""
    along = femur.towards_head
    first, second = np.linalg.svd(along[None])[2][1:]
    outline = femur.base_mm + np.outer([0.45, 0.65], femur.neck_length_mm * along)
    aids: dict[str, Aid] = {
        "head": SphereAid(np.zeros(3), femur.head_radius_mm),
        "neck": LineAid(np.stack([femur.base_mm, np.zeros(3)])),
        "shaft": LineAid(femur.base_mm + np.array([[0.0, 15.0, 0.0], [0.0, 50.0, 0.0]])),
        "outline": TubeAid(outline, 1e-6 * np.stack([first, second]), NARROWEST * femur.neck_radius_mm),
    }
    return {name: aid.mapped(lambda at: to_cfcs(at, side, head_mm)) for name, aid in aids.items()}


def clicked_mm(aid: Aid, focal_mm: np.ndarray) -> np.ndarray:
    """Return the points (M, 3), CFCS, that are clicked in an image with its focal point at (3,)."""
    if isinstance(aid, SphereAid):
        ray = aid.centre_mm - focal_mm
        sine = aid.radius_mm / np.linalg.norm(ray)  # tangent rays touch the sphere on a smaller circle, nearer to them
        around = np.stack([np.cos(RIM_ANGLES_RAD), np.sin(RIM_ANGLES_RAD)], axis=1) @ np.linalg.svd(ray[None])[2][1:]
        return aid.centre_mm - sine**2 * ray + aid.radius_mm * np.sqrt(1 - sine**2) * around
    if isinstance(aid, LineAid):
        return aid.ends_mm
    if isinstance(aid, PlaneAid):
        across = _unit(np.cross(aid.normal, aid.point_mm - focal_mm))
        return aid.point_mm + np.outer([-aid.half_mm, aid.half_mm], across)
    along, middle = _unit(aid.ends_mm[1] - aid.ends_mm[0]), aid.ends_mm.mean(axis=0)
    if aid.oval and abs(along @ _unit(middle - focal_mm)) > END_ON:
        half = np.linalg.norm(aid.across_mm, axis=1, keepdims=True)
        axes = aid.across_mm * (1 + aid.round_mm / half)
        return middle + np.concatenate([axes[:1], -axes[:1], axes[1:], -axes[1:]])
    return np.array([_touched(aid, end, focal_mm, way) for way in (1.0, -1.0) for end in aid.ends_mm])


def _touched(tube: TubeAid, at_mm: np.ndarray, focal_mm: np.ndarray, way: float) -> np.ndarray:
    """Return the point (3,) of a tube's section at a point of its axis that a line of sight touches."""
    along, on = tube.ends_mm[1] - tube.ends_mm[0], at_mm
    for _ in range(_TOUCHES):
        outward = way * _unit(np.cross(along, on - focal_mm))
        on = at_mm + np.sign(tube.across_mm @ outward) @ tube.across_mm + tube.round_mm * outward
    return on


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
