"""Ray-casting: lengths and attenuation along the rays of an image, in compiled kernels whose threads share the rows.

Kernels loop over elements and pass whole arrays with an index, because an array expression takes up to a second to
compile and a row view is reference-counted. Divisions are not checked (`error_model`), so divisors that may be zero are
tested in the code.
"""

import numpy as np

from sightline.common.kernels import kernel
from sightline.common.threads import in_parts
from sightline.imaging.volumes.rays import Rays, towards, within
from sightline.twin.objects.things import COLUMNS

CELL_PX = 16
SUB = 4  # sub-rays per pixel and axis, for balls and rods
MESH_SUB = 2  # for meshes [ours]
MESH_CELL_PX = 32
assert COLUMNS == 9  # noqa: S101 - the kernels below spell the columns out


@kernel()
def _cylinder(o: np.ndarray, d: np.ndarray, shapes: np.ndarray, m: int, radius: float) -> float:
    """Return the length of the ray o + t d, |d| = 1, within a finite cylinder."""
    along, slope, dot, o2 = 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        g = o[a] - shapes[m, a]
        along += g * shapes[m, 3 + a]
        slope += d[a] * shapes[m, 3 + a]
        dot += g * d[a]
        o2 += g * g
    a2 = 1.0 - slope * slope
    b = dot - along * slope
    c = o2 - along * along - radius * radius
    near, far = -1e9, 1e9
    if a2 > 1e-12:
        disc = b * b - a2 * c
        if disc <= 0.0:
            return 0.0
        near, far = (-b - np.sqrt(disc)) / a2, (-b + np.sqrt(disc)) / a2
    elif c > 0.0:
        return 0.0
    half = shapes[m, 8]
    if abs(slope) > 1e-12:
        t0, t1 = (-half - along) / slope, (half - along) / slope
        near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
    elif abs(along) > half:
        return 0.0
    return max(far - near, 0.0)


@kernel()
def chord(o: np.ndarray, d: np.ndarray, shapes: np.ndarray, m: int) -> float:
    """Return the length, mm, of the ray o + t d, |d| = 1, within one of the packed solids (M, 9) of `things.pack`."""
    if shapes[m, 8] >= 0.0:
        outer = _cylinder(o, d, shapes, m, shapes[m, 6])
        return outer - _cylinder(o, d, shapes, m, shapes[m, 7]) if shapes[m, 7] > 0.0 and outer > 0.0 else outer
    b, g2 = 0.0, 0.0
    for a in range(3):
        g = shapes[m, a] - o[a]
        b += g * d[a]
        g2 += g * g
    left = shapes[m, 6] * shapes[m, 6] - (g2 - b * b)
    return 2.0 * np.sqrt(left) if left > 0.0 else 0.0


@kernel()
def _sub_ray(rays, spot, r, c, s, sub, o, d):  # noqa: PLR0917
    """Fill `o` and `d` (3,) with the start and unit direction of a pixel's sub-ray number `s` of sub x sub.

    Each starts at another point of the square focal spot, spanned by `spot` (2, 3). The offset on the spot is the
    offset in the pixel rotated by 90°, so that both blurs have the right size and are uncorrelated.
    """
    focal, points = rays.focal, rays.points
    pu, pv = (s % sub + 0.5) / sub - 0.5, (s // sub + 0.5) / sub - 0.5
    norm = 0.0
    for a in range(3):
        o[a] = focal[a] + pv * spot[0, a] - pu * spot[1, a]
        by_u = 0.5 * (points[r, c + 1, a] - points[r, c - 1, a])
        by_v = 0.5 * (points[r + 1, c, a] - points[r - 1, c, a])
        d[a] = points[r, c, a] + pu * by_u + pv * by_v - o[a]
        norm += d[a] * d[a]
    for a in range(3):
        d[a] /= np.sqrt(norm)


def solid_transmission(
    rays: Rays,
    spot: np.ndarray,
    cells: tuple[np.ndarray, np.ndarray],
    solids: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return the transmission (N, H, W) of sharp solids at N energies, averaged over SUB x SUB rays per pixel.

    `spot` (2, 3): see `_sub_ray`. `cells` (start, index): the solids that may touch each cell of CELL_PX pixels.
    `solids`: shapes (M, 9) and attenuation (M, N).
    """
    shapes, excess = solids
    transmission = np.ones((excess.shape[1], *rays.inside.shape), dtype=np.float32)
    # Upper bound of the distance of a sub-ray from its pixel's ray: half the spot's diagonal plus two pixels.
    h, w = rays.inside.shape
    apart = rays.points[h // 2, w // 2 + 1] - rays.points[h // 2, w // 2]
    reach = np.sqrt((spot * spot).sum()) / 2 + 2 * np.sqrt((apart * apart).sum())
    grown = shapes.copy()
    grown[:, 6] += reach
    grown[:, 7] = 0.0
    grown[:, 8] += np.where(shapes[:, 8] < 0.0, 0.0, reach)
    in_parts(_cast_solids, rays, spot, *cells, shapes, grown, excess, transmission)
    return transmission


@kernel(nogil=True)
def _cast_solids(part, parts, rays, spot, first, index, shapes, grown, excess, transmission):  # noqa: PLR0912, PLR0917
    """Cast sub-rays through `shapes`. `grown` (M, 9): enlarged solids, met by a pixel's ray if any sub-ray meets the
    solid."""
    h, w = rays.inside.shape
    wide = (w + CELL_PX - 1) // CELL_PX
    energies = excess.shape[1]
    o, d, depth, total = np.empty(3), np.empty(3), np.empty(energies), np.empty(energies)
    for r in range(1 + part, h - 1, parts):
        for c in range(1, w - 1):
            cell = (r // CELL_PX) * wide + c // CELL_PX
            if not rays.inside[r, c] or first[cell] == first[cell + 1]:
                continue
            norm = towards(rays, r, c, d)
            for a in range(3):
                d[a] /= norm
            near = False
            for n in range(first[cell], first[cell + 1]):
                near = near or chord(rays.focal, d, grown, index[n]) > 0.0
            if not near:
                continue
            for e in range(energies):
                total[e] = 0.0
            for s in range(SUB * SUB):
                _sub_ray(rays, spot, r, c, s, SUB, o, d)
                for e in range(energies):
                    depth[e] = 0.0
                for n in range(first[cell], first[cell + 1]):
                    length = chord(o, d, shapes, index[n])
                    if length > 0.0:
                        for e in range(energies):
                            depth[e] += length * excess[index[n], e]
                for e in range(energies):
                    total[e] += np.exp(-depth[e])
            for e in range(energies):
                transmission[e, r, c] = total[e] / (SUB * SUB)


def box_length(rays: Rays, centres: np.ndarray, axes: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """Return the lengths (H, W), mm, of the rays in cuboids: centres (M, 3), axes (M, 3, 3), half-lengths (M, 3)."""
    lengths = np.zeros(rays.inside.shape, dtype=np.float32)
    in_parts(_cast_boxes, rays, centres, axes, halves, lengths)
    return lengths


@kernel(nogil=True)
def _cast_boxes(part, parts, rays, centres, axes, halves, lengths):  # noqa: PLR0917
    h, w = rays.inside.shape
    d = np.empty(3)
    for r in range(part, h, parts):
        for c in range(w):
            if not rays.inside[r, c]:
                continue
            norm = towards(rays, r, c, d)
            for m in range(len(centres)):
                span = (0.0, 1.0)
                for a in range(3):
                    start, slope = 0.0, 0.0
                    for b in range(3):
                        start += (rays.focal[b] - centres[m, b]) * axes[m, a, b]
                        slope += d[b] * axes[m, a, b]
                    span = within(span, start, slope, -halves[m, a], halves[m, a])
                near, far = span
                if far > near:
                    lengths[r, c] += (far - near) * norm


# These two are inlined: each call would count the references to its arrays, and a mesh would take 2.5 times as long.
@kernel(inlined=True)
def _side(o: np.ndarray, d: np.ndarray, vertices: np.ndarray, i: int, j: int) -> float:
    """Return d · ((a - o) x (b - o)), whose sign tells the side of the ray o + t d on which the edge from vertex i (a)
    to vertex j (b) passes."""
    ax, ay, az = vertices[i, 0] - o[0], vertices[i, 1] - o[1], vertices[i, 2] - o[2]
    bx, by, bz = vertices[j, 0] - o[0], vertices[j, 1] - o[1], vertices[j, 2] - o[2]
    return d[0] * (ay * bz - az * by) + d[1] * (az * bx - ax * bz) + d[2] * (ax * by - ay * bx)


@kernel(inlined=True)
def _crossing(o: np.ndarray, d: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, m: int) -> float:
    """Return the signed distance to triangle `m` along the ray o + t d, |d| = 1: t where the ray leaves through it, -t
    where it enters, 0 where it misses.

    Each edge is evaluated from its lower to its higher vertex. So both of its triangles get the same result, and no ray
    passes between them or meets both.
    """
    ahead, sides = 0, (0.0, 0.0, 0.0)
    for k in range(3):
        i, j = triangles[m, k], triangles[m, (k + 1) % 3]
        if i < j:
            side = _side(o, d, vertices, i, j)
            ahead += side >= 0.0
        else:
            side = -_side(o, d, vertices, j, i)
            ahead += side > 0.0
        if 0 < ahead < k + 1:
            return 0.0
        sides = sides[1], sides[2], side
    way, weight = 0.0, 0.0
    for k in range(3):
        opposite = triangles[m, (k + 2) % 3]
        along = 0.0
        for a in range(3):
            along += (vertices[opposite, a] - o[a]) * d[a]
        way += sides[k] * along
        weight += sides[k]
    if weight == 0.0:
        return 0.0
    return way / weight if ahead == 3 else -way / weight


def mesh_lengths(
    rays: Rays, xi: np.ndarray, spot: np.ndarray, surface: tuple[np.ndarray, np.ndarray], shadows: np.ndarray
) -> np.ndarray:
    """Return the lengths (MESH_SUB², H, W), mm, of the sub-rays of each pixel within a closed mesh.

    `surface`: vertices (V, 3) and triangles (T, 3), counter-clockwise seen from outside. `xi` (H, W, 2): the points at
    which the rays meet the input plane. `shadows` (T, 4): bounds of xi for the shadow of each triangle, mm.
    """
    lengths = np.zeros((MESH_SUB * MESH_SUB, *rays.inside.shape))
    in_parts(_cast_mesh, rays, xi, spot, *surface, shadows, lengths)
    return lengths


@kernel()
def _fill_sub_rays(rays, spot, pixels, cast):
    """Fill `cast` (rows, columns, MESH_SUB², 2, 3) with starts and directions of the sub-rays of a block of `pixels`:
    first row, last row + 1, first column, last column + 1."""
    r0, r1, c0, c1 = pixels
    for r in range(r0, r1):
        for c in range(c0, c1):
            for s in range(MESH_SUB * MESH_SUB):
                ray = cast[r - r0, c - c0, s]
                _sub_ray(rays, spot, r, c, s, MESH_SUB, ray[0], ray[1])


@kernel(nogil=True)
def _cast_mesh(part, parts, rays, xi, spot, vertices, triangles, shadows, lengths):  # noqa: PLR0917
    h, w = rays.inside.shape
    tall, wide = (h + MESH_CELL_PX - 1) // MESH_CELL_PX, (w + MESH_CELL_PX - 1) // MESH_CELL_PX
    cast = np.empty((MESH_CELL_PX, MESH_CELL_PX, MESH_SUB * MESH_SUB, 2, 3))  # start and direction of every sub-ray
    for cell in range(part, tall * wide, parts):
        r0, c0 = max(cell // wide * MESH_CELL_PX, 1), max(cell % wide * MESH_CELL_PX, 1)
        r1, c1 = min((cell // wide + 1) * MESH_CELL_PX, h - 1), min((cell % wide + 1) * MESH_CELL_PX, w - 1)
        if not rays.inside[r0:r1, c0:c1].any():
            continue
        x0, x1, y0, y1 = np.inf, -np.inf, np.inf, -np.inf
        for r in range(r0, r1):
            for c in range(c0, c1):
                x0, x1 = min(x0, xi[r, c, 0]), max(x1, xi[r, c, 0])
                y0, y1 = min(y0, xi[r, c, 1]), max(y1, xi[r, c, 1])
        empty = True
        for t in range(len(triangles)):
            left, top, right, bottom = shadows[t]
            if left > x1 or right < x0 or top > y1 or bottom < y0:
                continue
            if empty:
                empty = False
                _fill_sub_rays(rays, spot, (r0, r1, c0, c1), cast)
            for r in range(r0, r1):
                for c in range(c0, c1):
                    x, y = xi[r, c, 0], xi[r, c, 1]
                    if x < left or x > right or y < top or y > bottom or not rays.inside[r, c]:
                        continue
                    for s in range(MESH_SUB * MESH_SUB):
                        ray = cast[r - r0, c - c0, s]
                        lengths[s, r, c] += _crossing(ray[0], ray[1], vertices, triangles, t)
