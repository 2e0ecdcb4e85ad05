"""Shapes that bones are built of, and their signed distances (negative inside). mm, anatomical coordinates.

A shape is a row of numbers, so that one compiled kernel evaluates any bone. Cones (with balls), boxes and plates have
exact distances; ellipsoids and barrels have them to first order.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from sightline.common.kernels import kernel

CONE, BOX, ELLIPSOID, BARREL, PLATE, HALF_SPACE = range(6)
ADD, CUT, KEEP = range(3)
POINTS = {CONE: 2, PLATE: 3}  # among the first numbers of a shape; of the others one
NUMBERS = 17  # of a shape: at most the centre, three axes, three half-lengths, two more
TEXTURE_SD = 1.2  # voxels: about 1 mm, the scale of trabeculae [ours]
TEXTURE_SHAPE = (80, 96, 72)  # voxels; the texture is periodic
BLOCK = 8  # voxels a side of a block that is skipped where no bone is near
STARTS, APART, WIDER = 4, 0.9, 1.2  # it is refined from up to so many, cosine of their angle, ratio to the shortest
AROUND = 8  # directions around the best that a step of the refinement tries
COARSE_MM, FINE_MM = 0.02, 1e-6  # lengths of rays: first, refined
REACH_MM = 300.0  # of this search
HARD, HARD_TEXTURE, SPONGY_TEXTURE = 0.92, 0.03, 0.7  # share of bone in cortex; its textures, as of the femur
PART, JOIN, BLEND, CORTEX, KIND, FIRST = range(6)  # columns of the table of shapes


@dataclass(frozen=True)
class SolidShape:
    """One shape of a part of a bone, joined to the shapes before it.

    `join`: ADD it, CUT it out of them, or KEEP only what lies inside it. `blend_mm`: width over which an added shape
    blends with them. `cortex_mm`: thickness of the cortex where this shape forms the surface. None: as its part.
    """

    kind: int
    numbers: tuple[float, ...]
    join: int = ADD
    blend_mm: float | None = None
    cortex_mm: float | None = None

    def cut(self) -> "SolidShape":
        """Return the shape to be cut out of those before it."""
        return replace(self, join=CUT)

    def keep(self) -> "SolidShape":
        """Return the shape whose inside alone is kept of those before it."""
        return replace(self, join=KEEP)

    def with_cortex(self, cortex_mm: float) -> "SolidShape":
        """Return the shape with a cortex of its own."""
        return replace(self, cortex_mm=cortex_mm)

    def shifted(self, by_mm: ArrayLike) -> "SolidShape":
        """Return the shape moved by (3,)."""
        numbers = np.array(self.numbers)
        points = numbers[: 3 * POINTS.get(self.kind, 1)].reshape(-1, 3)
        points += by_mm
        return replace(self, numbers=tuple(numbers.tolist()))

    def distance_mm(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the signed distances (...) of points (..., 3) from the shape."""
        points = np.ascontiguousarray(xyz_mm, dtype=np.float64)
        row = np.zeros(NUMBERS)
        row[: len(self.numbers)] = self.numbers
        return _distances(points.reshape(-1, 3), self.kind, row).reshape(points.shape[:-1])


def _shape(kind: int, *numbers: ArrayLike) -> SolidShape:
    return SolidShape(kind, tuple(np.concatenate([np.ravel(number) for number in numbers]).astype(float).tolist()))


def cone(
    start_mm: ArrayLike, end_mm: ArrayLike, start_radius_mm: float, end_radius_mm: float | None = None
) -> SolidShape:
    """Return the convex hull of two balls at points (3,); a ball if the points are the same."""
    return _shape(CONE, start_mm, end_mm, start_radius_mm, start_radius_mm if end_radius_mm is None else end_radius_mm)


def ball(centre_mm: ArrayLike, radius_mm: float) -> SolidShape:
    """Return a ball."""
    return cone(centre_mm, centre_mm, radius_mm)


def box(centre_mm: ArrayLike, half_mm: ArrayLike, round_mm: float = 0.0, axes: ArrayLike | None = None) -> SolidShape:
    """Return a cuboid with rounded edges; `half_mm` (3,) includes the rounding. `axes` (3, 3): its axes as rows."""
    return _shape(BOX, centre_mm, np.eye(3) if axes is None else axes, half_mm, round_mm)


def ellipsoid(centre_mm: ArrayLike, half_mm: ArrayLike, axes: ArrayLike | None = None) -> SolidShape:
    """Return an ellipsoid with half-axes (3,) along `axes` (3, 3), its rows."""
    return _shape(ELLIPSOID, centre_mm, np.eye(3) if axes is None else axes, half_mm)


def barrel(
    centre_mm: ArrayLike, half_mm: ArrayLike, round_mm: float, waist: float = 0.0, axes: ArrayLike | None = None
) -> SolidShape:
    """Return an elliptic cylinder along the second of its `axes` (3, 3), with rounded edges, whose width shrinks by the
    share `waist` in the middle."""
    return _shape(BARREL, centre_mm, np.eye(3) if axes is None else axes, half_mm, round_mm, waist)


def plate(a_mm: ArrayLike, b_mm: ArrayLike, c_mm: ArrayLike, half_mm: float) -> SolidShape:
    """Return all points within `half_mm` of a triangle."""
    return _shape(PLATE, a_mm, b_mm, c_mm, half_mm)


def half_space(point_mm: ArrayLike, normal: ArrayLike) -> SolidShape:
    """Return the side of a plane that its unit normal (3,) points away from."""
    return _shape(HALF_SPACE, point_mm, normal)


def texture(rng: np.random.Generator) -> np.ndarray:
    """Draw a periodic texture of unit variance on the scale of trabeculae."""
    tile = gaussian_filter(rng.standard_normal(TEXTURE_SHAPE, dtype=np.float32), TEXTURE_SD, mode="wrap")
    return tile / tile.std()


@kernel()
def blend(a: float, b: float, k: float) -> float:
    """Return the smooth minimum of two distances over a width k."""
    h = max(k - abs(a - b), 0.0) / k
    return min(a, b) - h * h * k / 4


@kernel()
def step(x: float, width: float) -> float:
    """Return a linear ramp from 0 to 1 across `width` around 0: a voxel's partial volume."""
    return min(max(x / width + 0.5, 0.0), 1.0)


@kernel()
def ellipsoid_distance(at: tuple[float, float, float], half: tuple[float, float, float]) -> float:
    """Return the distance from an ellipsoid at the origin with the given half-axes, to first order."""
    k0, k1 = 0.0, 0.0
    for a in range(3):
        k0 += (at[a] / half[a]) ** 2
        k1 += (at[a] / half[a] ** 2) ** 2
    return np.sqrt(k0) * (np.sqrt(k0) - 1) / max(np.sqrt(k1), 1e-9)


@kernel()
def shape_distance(x: float, y: float, z: float, kind: int, n: np.ndarray) -> float:
    """Return the signed distance of a point from a shape of a kind with the numbers `n`."""
    x, y, z = x - n[0], y - n[1], z - n[2]
    if kind == CONE:
        return _cone(x, y, z, n)
    if kind == PLATE:
        return _plate(x, y, z, n)
    if kind == HALF_SPACE:
        return x * n[3] + y * n[4] + z * n[5]
    a = n[3] * x + n[4] * y + n[5] * z
    b = n[6] * x + n[7] * y + n[8] * z
    c = n[9] * x + n[10] * y + n[11] * z
    if kind == ELLIPSOID:
        return ellipsoid_distance((a, b, c), (n[12], n[13], n[14]))
    if kind == BOX:
        return _corner(abs(a) - n[12] + n[15], abs(b) - n[13] + n[15], abs(c) - n[14] + n[15]) - n[15]
    width = 1.0 - n[16] * max(1.0 - (b / n[13]) ** 2, 0.0)
    p, q = a / (n[12] * width), c / (n[14] * width)
    k0, k1 = np.sqrt(p * p + q * q), np.sqrt((p / (n[12] * width)) ** 2 + (q / (n[14] * width)) ** 2)
    radial = k0 * (k0 - 1.0) / k1 if k1 > 1e-9 else -min(n[12], n[14]) * width
    return _corner(radial + n[15], abs(b) - n[13] + n[15], -1e9) - n[15]


@kernel()
def _corner(a: float, b: float, c: float) -> float:
    """Return the distance from the corner of three faces that are perpendicular to each other."""
    outside = np.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2)
    return outside + min(max(a, b, c), 0.0)


@kernel()
def _cone(x: float, y: float, z: float, n: np.ndarray) -> float:
    """Return the distance from the hull of two balls; (x, y, z) from the first [src Quilez, distance functions]."""
    u, v, w, first, second = n[3] - n[0], n[4] - n[1], n[5] - n[2], n[6], n[7]
    length2 = u * u + v * v + w * w
    if length2 == 0.0:
        return np.sqrt(x * x + y * y + z * z) - first
    shrink = first - second
    slope2 = length2 - shrink * shrink
    along = x * u + y * v + z * w
    beyond = along - length2
    across2 = (x * x + y * y + z * z) * length2 - along * along
    across2 = max(across2, 0.0) * length2
    edge = np.sign(shrink) * shrink * shrink * across2
    if np.sign(beyond) * slope2 * beyond * beyond * length2 > edge:
        return np.sqrt(across2 + beyond * beyond * length2) / length2 - second
    if np.sign(along) * slope2 * along * along * length2 < edge:
        return np.sqrt(across2 + along * along * length2) / length2 - first
    return (np.sqrt(across2 * slope2 / length2) + along * shrink) / length2 - first


@kernel()
def _plate(x: float, y: float, z: float, n: np.ndarray) -> float:
    """Return the distance from a thick triangle; (x, y, z) from its first corner [src Ericson, Real-Time Collision
    Detection, 5.1.5]."""
    bx, by, bz = n[3] - n[0], n[4] - n[1], n[5] - n[2]
    cx, cy, cz = n[6] - n[0], n[7] - n[1], n[8] - n[2]
    bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    d1, d2 = x * bx + y * by + z * bz, x * cx + y * cy + z * cz
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = d1 / (d1 - d3), 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    x, y, z = x - v * bx - w * cx, y - v * by - w * cy, z - v * bz - w * cz
    return np.sqrt(x * x + y * y + z * z) - n[9]


@kernel()
def _distances(points: np.ndarray, kind: int, row: np.ndarray) -> np.ndarray:
    distances = np.empty(len(points))
    for k in range(len(points)):
        distances[k] = shape_distance(points[k, 0], points[k, 1], points[k, 2], kind, row)
    return distances


@kernel()
def _parts(x, y, z, table, parts, mirrored, work):  # noqa: PLR0917
    """Fill `out` (P, 3) for a point with the distance from each part without and with its gap, and with its cortex's
    thickness."""
    if mirrored:
        x = abs(x)
    work[:, 0], work[:, 2] = 1e9, 0.0
    for m in range(len(table)):
        k, join = int(table[m, PART]), int(table[m, JOIN])
        distance = shape_distance(x, y, z, int(table[m, KIND]), table[m, FIRST:])
        if join == ADD:
            width = table[m, BLEND]
            new = step(work[k, 0] - distance, max(width, 1e-9))
            work[k, 2] += new * (table[m, CORTEX] - work[k, 2])
            work[k, 0] = blend(work[k, 0], distance, width) if width > 0.0 else min(work[k, 0], distance)
        else:
            signed = -distance if join == CUT else distance
            if signed > work[k, 0]:
                work[k, 2] = table[m, CORTEX]
            work[k, 0] = max(work[k, 0], signed)
    before = 1e9
    for k in range(len(parts)):
        work[k, 1] = max(work[k, 0], parts[k, 0] - before) if parts[k, 0] > 0.0 else work[k, 0]
        before = min(before, work[k, 0])


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
def depths(part, parts_, points, table, parts, mirrored, of, values):  # noqa: PLR0917
    """Fill in the value of the field number `of` at every point."""
    work = np.empty((len(parts), 3))
    for k in range(part, len(points), parts_):
        values[k] = _field(points[k, 0], points[k, 1], points[k, 2], table, parts, mirrored, of, work)


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
def nearest(part, parts_, points, table, parts, mirrored, of, directions, distances):  # noqa: PLR0917
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
        distances[k] = -best if inside else best


@kernel(nogil=True)
def fill(part, parts_, low, voxel, table, parts, mirrored, tile, values):  # noqa: PLR0917
    """Fill in the share of bone at every voxel; the outermost voxels stay empty. Blocks far from bone are skipped."""
    tx, ty, tz = tile.shape
    nx, ny, nz = values.shape
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
                            values[i, j, k] = share
