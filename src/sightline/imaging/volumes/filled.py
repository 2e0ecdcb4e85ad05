"""A mesh as a CT: cortical bone below its surface, cancellous bone within, air outside."""

import numpy as np
from scipy.ndimage import distance_transform_edt

from sightline.common.kernels import kernel
from sightline.errors import UnusableInputError
from sightline.imaging.volumes.beam import TABLE_PER_CM
from sightline.imaging.volumes.ct import AIR_HU, WATER_PER_CM, CtScan
from sightline.imaging.volumes.meshes import Mesh

CORTEX_MM = 3.0  # [ours] of a proximal femur: 5 mm lateral, 1.5 to 3 on the neck, 1 on the head (docs/physics.md)
CORTICAL_HU = round(1000 * (TABLE_PER_CM["bone"][1] / WATER_PER_CM - 1))  # [calc] at 60 keV
CANCELLOUS_HU = 132  # of a normal neck [src] CT series (docs/physics.md)
# Edge of a voxel [ours]: CT has no finer ones, and a pelvis still fits.
MIN_VOXEL_MM, VOXELS = 0.5, 2**24
FINE = 2  # columns across a voxel: its edges are blurred by half of one


def filled(mesh: Mesh, cortex_mm: float = CORTEX_MM) -> CtScan:
    """Return a mesh as a CT in the mesh's coordinates, `cortex_mm` of cortical bone around cancellous bone.

    Voxels of 0.5 mm or, of a large mesh, about 2^24 of them. Raises UnusableInputError.
    """
    if not 0 <= cortex_mm < np.inf:
        raise UnusableInputError(f"the cortex is {cortex_mm:g} mm thick; give zero or more")
    low, high = mesh.vertices_mm.min(axis=0), mesh.vertices_mm.max(axis=0)
    edge = max(MIN_VOXEL_MM, float(np.prod(high - low) / VOXELS) ** (1 / 3))
    shape = tuple(int(n) for n in np.ceil((high - low) / edge) + 3)  # with air around it
    origin = low - edge
    steps = np.zeros(shape)
    _add_columns((mesh.vertices_mm - origin) / edge, mesh.triangles, steps)
    share = np.clip(np.cumsum(steps, axis=2, out=steps), 0.0, 1.0, out=steps)
    # The surface is half an edge nearer than the first centre beyond it if it is flat, less if it is oblique.
    depth = np.asarray(distance_transform_edt(share >= 0.5, sampling=edge)) - edge / 4
    cortical = np.clip((cortex_mm - depth) / edge + 0.5, 0.0, 1.0)
    within = CANCELLOUS_HU + (CORTICAL_HU - CANCELLOUS_HU) * cortical
    hu = np.rint(AIR_HU + share * (within - AIR_HU)).astype(np.int16)
    return CtScan(hu, origin, np.full(3, edge), np.eye(3))


@kernel()
def _add_columns(vertices, triangles, steps):
    """Add to `steps` (nx, ny, nz) the change along z of the share of each voxel that lies inside; `vertices` in voxels.

    A column enters through a triangle that faces down. Each edge is evaluated from its lower to its higher vertex, so
    that no column passes between two triangles or meets both.
    """
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        x0, x1 = (
            min(vertices[a, 0], vertices[b, 0], vertices[c, 0]),
            max(vertices[a, 0], vertices[b, 0], vertices[c, 0]),
        )
        y0, y1 = (
            min(vertices[a, 1], vertices[b, 1], vertices[c, 1]),
            max(vertices[a, 1], vertices[b, 1], vertices[c, 1]),
        )
        # Column m lies at (m + 0.5) / FINE - 0.5.
        for m in range(int((x0 + 0.5) * FINE - 0.5), int((x1 + 0.5) * FINE + 0.5)):
            for n in range(int((y0 + 0.5) * FINE - 0.5), int((y1 + 0.5) * FINE + 0.5)):
                x, y = (m + 0.5) / FINE - 0.5, (n + 0.5) / FINE - 0.5
                ahead, z, weight = 0, 0.0, 0.0
                for k in range(3):
                    i, j, opposite = triangles[t, k], triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
                    p, q = min(i, j), max(i, j)
                    side = (vertices[p, 0] - x) * (vertices[q, 1] - y) - (vertices[p, 1] - y) * (vertices[q, 0] - x)
                    if i < j:
                        ahead += side >= 0.0
                    else:
                        side = -side
                        ahead += side > 0.0
                    z += side * vertices[opposite, 2]
                    weight += side
                if 0 < ahead < 3 or weight == 0.0:
                    continue
                sign = -1.0 if ahead == 3 else 1.0
                height = z / weight + 0.5
                k = int(height)
                share = k + 1 - height
                steps[m // FINE, n // FINE, k] += sign * share / (FINE * FINE)
                steps[m // FINE, n // FINE, k + 1] += sign * (1 - share) / (FINE * FINE)
