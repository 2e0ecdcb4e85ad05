"""Bones built of shapes: their volume, and the exact distances that the truth of a procedure needs.

Anatomical coordinates: (lateral, caudal, anterior), mm, lateral towards the operated side; the bone states its origin.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sightline.common.kernels import kernel
from sightline.common.threads import in_parts
from sightline.errors import SetUpError
from sightline.twin.anatomy.femur import placed
from sightline.twin.anatomy.shapes import ADD, CUT, NUMBERS, SolidShape, blend, shape_distance, step, texture
from sightline.twin.objects.meshes import Mesh
from sightline.twin.objects.volumes import Volume

BLOCK = 8  # voxels a side of a block that is skipped where no bone is near
DIRECTIONS = 200  # of the search for the nearest point, before it is refined
STARTS, APART, WIDER = 4, 0.9, 1.2  # it is refined from up to so many, cosine of their angle, ratio to the shortest
AROUND = 8  # directions around the best that a step of the refinement tries
COARSE_MM, FINE_MM = 0.02, 1e-6  # lengths of rays: first, refined
REACH_MM = 300.0  # of this search
BOUND = 0.85  # share of a depth that a distance is at least: barrels and ellipsoids are exact to first order only
BORDER_MM = 15.0  # of the entry of a wire from the border that a person draws, along the wire, at most [ours]
HARD, HARD_TEXTURE, SPONGY_TEXTURE = 0.92, 0.03, 0.7  # share of bone in cortex; its textures, as of the femur
FIELDS = ("surface", "outline", "cancellous", "gap")
PART, JOIN, BLEND, CORTEX, KIND, FIRST = range(6)  # columns of the table of shapes


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
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        out = np.empty(len(flat))
        in_parts(_nearest, flat, *self._tables, self.mirrored, FIELDS.index(of), _directions(), out)
        return out.reshape(points.shape[:-1])

    def depth_mm(self, xyz_mm: np.ndarray, of: str = "surface") -> np.ndarray:
        """Return the value (...) of the field of `of` at points (..., 3): negative inside, zero on the surface.

        Its size is at most about that of `distance_mm`, and it takes a thousandth of the time.
        """
        points = np.asarray(xyz_mm, dtype=np.float64)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        out = np.empty(len(flat))
        in_parts(_depths, flat, *self._tables, self.mirrored, FIELDS.index(of), out)
        return out.reshape(points.shape[:-1])

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
        known = {name: one for name, one in made.items() if one is not None}
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
        in_parts(_fill, self.low_mm, self.voxel_mm, *_packed(self.parts + self.around), self.mirrored, tile, values)
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


def _directions() -> np.ndarray:
    """Return unit vectors (DIRECTIONS, 3) spread evenly over the sphere."""
    k = np.arange(DIRECTIONS) + 0.5
    z, turn = 1 - 2 * k / DIRECTIONS, np.pi * (1 + 5**0.5) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)


@kernel()
def _parts(x, y, z, table, parts, mirrored, out):  # noqa: PLR0917
    """Fill `out` (P, 3) for a point with the distance from each part without and with its gap, and with its cortex's
    thickness."""
    if mirrored:
        x = abs(x)
    out[:, 0], out[:, 2] = 1e9, 0.0
    for m in range(len(table)):
        k, join = int(table[m, PART]), int(table[m, JOIN])
        distance = shape_distance(x, y, z, int(table[m, KIND]), table[m, FIRST:])
        if join == ADD:
            width = table[m, BLEND]
            new = step(out[k, 0] - distance, max(width, 1e-9))
            out[k, 2] += new * (table[m, CORTEX] - out[k, 2])
            out[k, 0] = blend(out[k, 0], distance, width) if width > 0.0 else min(out[k, 0], distance)
        else:
            signed = -distance if join == CUT else distance
            if signed > out[k, 0]:
                out[k, 2] = table[m, CORTEX]
            out[k, 0] = max(out[k, 0], signed)
    before = 1e9
    for k in range(len(parts)):
        out[k, 1] = max(out[k, 0], parts[k, 0] - before) if parts[k, 0] > 0.0 else out[k, 0]
        before = min(before, out[k, 0])


@kernel()
def _field(x, y, z, table, parts, mirrored, of, work):  # noqa: PLR0917
    """Return the field number `of` in FIELDS at a point; `work` (P, 3) is overwritten."""
    _parts(x, y, z, table, parts, mirrored, work)
    surface, outline, cancellous = 1e9, 1e9, 1e9
    for k in range(len(parts)):
        outline = min(outline, work[k, 0])
        surface = min(surface, work[k, 1])
        cancellous = min(cancellous, work[k, 1] + work[k, 2])
    if of == 0:
        return surface
    if of == 1:
        return outline
    if of == 2:
        return cancellous
    return max(outline, -surface)


@kernel(nogil=True)
def _depths(part, parts_, points, table, parts, mirrored, of, out):  # noqa: PLR0917
    work = np.empty((len(parts), 3))
    for k in range(part, len(points), parts_):
        out[k] = _field(points[k, 0], points[k, 1], points[k, 2], table, parts, mirrored, of, work)


@kernel()
def _ray(p, d, limit, fine, inside, table, parts, mirrored, of, work):  # noqa: PLR0917
    """Return the length of a ray from p along d to the surface, to `fine`, or `limit` if it is longer."""
    at, near, far = 0.0, 0.0, -1.0
    while near < limit and not 0.0 <= far - near < fine:
        value = _field(p[0] + at * d[0], p[1] + at * d[1], p[2] + at * d[2], table, parts, mirrored, of, work)
        if (value < 0.0) == inside:
            near = at
        else:
            far = at
        at = near + max(0.8 * abs(value), 0.02) if far < 0.0 else (near + far) / 2
    return min(far, limit) if far >= 0.0 else limit


@kernel()
def _refined(p, best_d, best, inside, table, parts, mirrored, of, work):  # noqa: PLR0917
    """Return the length of the shortest ray found around the direction `best_d` (3,), at most `best`; `best_d` is
    overwritten with its direction."""
    d, first, second = np.empty(3), np.empty(3), np.empty(3)
    angle = 0.2
    while angle > 2e-4:
        before, least = best, np.argmin(np.abs(best_d))
        for a in range(3):
            first[a] = (1.0 if a == least else 0.0) - best_d[least] * best_d[a]
        first /= np.sqrt(first[0] * first[0] + first[1] * first[1] + first[2] * first[2])
        for a in range(3):
            second[a] = best_d[(a + 1) % 3] * first[(a + 2) % 3] - best_d[(a + 2) % 3] * first[(a + 1) % 3]
        for k in range(AROUND):
            turn = 2.0 * np.pi * k / AROUND
            d[:] = best_d + angle * (np.cos(turn) * first + np.sin(turn) * second)
            d /= np.sqrt(1.0 + angle * angle)
            length = _ray(p, d, best, FINE_MM, inside, table, parts, mirrored, of, work)
            if length < best:
                best = length
                best_d[:] = d
                break
        if best > before - 1e-7:
            angle *= 0.5
    return best


@kernel(nogil=True)
def _nearest(part, parts_, points, table, parts, mirrored, of, directions, out):  # noqa: PLR0917
    """Fill in the signed distance of every point: the shortest ray to the surface, refined around the best of the
    directions and around the best of those that are far from it."""
    work, d, lengths = np.empty((len(parts), 3)), np.empty(3), np.empty(len(directions))
    for k in range(part, len(points), parts_):
        p, best = points[k], REACH_MM
        inside = _field(p[0], p[1], p[2], table, parts, mirrored, of, work) < 0.0
        for n in range(len(directions)):
            limit = min(WIDER * best + 0.5, REACH_MM)
            lengths[n] = _ray(p, directions[n], limit, COARSE_MM, inside, table, parts, mirrored, of, work)
            best = min(best, lengths[n])
        for _ in range(STARTS):
            n = np.argmin(lengths)
            if lengths[n] >= min(WIDER * best + 0.5, REACH_MM):
                break
            d[:] = directions[n]
            best = min(best, _refined(p, d, lengths[n] + COARSE_MM, inside, table, parts, mirrored, of, work))
            for m in range(len(directions)):
                if directions[m] @ directions[n] > APART:
                    lengths[m] = REACH_MM
        out[k] = -best if inside else best


@kernel(nogil=True)
def _fill(part, parts_, low, voxel, table, parts, mirrored, tile, out):  # noqa: PLR0917
    """Fill in the share of bone at every voxel; the outermost voxels stay empty. Blocks far from bone are skipped."""
    tx, ty, tz = tile.shape
    nx, ny, nz = out.shape
    work = np.empty((len(parts), 3))
    far = 1.3 * voxel * BLOCK  # half the diagonal of a block is 0.87 of its side
    for i0 in range(1 + BLOCK * part, nx - 1, BLOCK * parts_):
        for j0 in range(1, ny - 1, BLOCK):
            for k0 in range(1, nz - 1, BLOCK):
                half = voxel * (BLOCK - 1) / 2
                x, y, z = low[0] + voxel * i0 + half, low[1] + voxel * j0 + half, low[2] + voxel * k0 + half
                if _field(x, y, z, table, parts, mirrored, 0, work) > far:
                    continue
                for i in range(i0, min(i0 + BLOCK, nx - 1)):
                    for j in range(j0, min(j0 + BLOCK, ny - 1)):
                        for k in range(k0, min(k0 + BLOCK, nz - 1)):
                            x, y, z = low[0] + voxel * i, low[1] + voxel * j, low[2] + voxel * k
                            _parts(x, y, z, table, parts, mirrored, work)
                            share, grain = 0.0, float(tile[i % tx, j % ty, k % tz])
                            for m in range(len(parts)):
                                within = step(-work[m, 1], voxel)
                                hard = within - step(-work[m, 1] - work[m, 2], voxel)
                                soft = max(parts[m, 1] * (1.0 + SPONGY_TEXTURE * grain), 0.0)
                                share = max(share, soft * (within - hard) + (HARD + HARD_TEXTURE * grain) * hard)
                            out[i, j, k] = share
