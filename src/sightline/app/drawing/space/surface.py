"""The outer surface of a bone in a volume, with few enough triangles for a browser; for display, not measurement."""

import numpy as np
from scipy.ndimage import binary_fill_holes, gaussian_filter

from sightline.twin.objects.volumes import Volume

CELL_MM = 3.0  # [ours] some 10,000 triangles of a proximal femur
BONE_SHARE = 0.03  # [calc] below the 0.041 of osteoporotic spongiosa: 99 HU less noise, with nothing around it
SMOOTHING_CELLS = 0.7  # [ours] smooths the steps between cells
# [calc] a cell touched by bone counts as bone, on average half a cell too far out; there a smoothed step is 0.76.
LEVEL = 0.76


def outer_surface(volume: Volume) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) mm, CFCS, and triangles (T, 3), counter-clockwise seen from outside. Empty without
    bone."""
    step = max(round(CELL_MM / float(volume.voxel_mm.mean())), 1)
    shape = [n // step for n in volume.values.shape]
    blocks = volume.values[tuple(slice(n * step) for n in shape)]
    means = blocks.reshape(shape[0], step, shape[1], step, shape[2], step).mean(axis=(1, 3, 5))
    # Filled slice by slice along the shaft: the canal is open where the volume ends.
    filled = means > BONE_SHARE
    for section in np.moveaxis(filled, 1, 0):
        binary_fill_holes(section, output=section)
    field = gaussian_filter(np.pad(filled.astype(np.float32), 2), SMOOTHING_CELLS) - LEVEL
    vertices, triangles = surface_net(field)
    at = (vertices - 2.0) * step + (step - 1) / 2  # in voxels
    return volume.origin_mm + (at * volume.voxel_mm) @ volume.axes, triangles


def surface_net(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the zero surface of a field (nx, ny, nz): vertices (V, 3) in cells, triangles (T, 3) facing the negative
    side.

    Each crossed cell has a vertex at the mean of the crossings of its edges; each crossed edge has a quadrilateral
    (Gibson, Constrained Elastic Surface Nets, 1998). The field must be negative at its border.
    """
    inside = field > 0
    cells = tuple(n - 1 for n in field.shape)
    total, count = np.zeros((*cells, 3)), np.zeros(cells, dtype=np.int64)
    edges = [_crossings(field, inside, axis) for axis in range(3)]
    around = [[np.array(corner) for corner in _around(axis)] for axis in range(3)]
    for (at, crossing, _), corners in zip(edges, around, strict=True):
        for corner in corners:
            cell = tuple((at - corner).T)
            np.add.at(total, cell, crossing)
            np.add.at(count, cell, 1)
    number = np.cumsum(count.reshape(-1) > 0).reshape(cells) - 1
    quads = [
        np.where(rising[:, None], ring[:, ::-1], ring)
        for (at, _, rising), corners in zip(edges, around, strict=True)
        for ring in [np.stack([number[tuple((at - corner).T)] for corner in corners], axis=1)]
    ]
    all_quads = np.concatenate(quads)
    triangles = np.concatenate([all_quads[:, [0, 1, 2]], all_quads[:, [0, 2, 3]]])
    crossed = count > 0
    return total[crossed] / count[crossed][:, None], triangles


def _crossings(field: np.ndarray, inside: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the crossed edges along an axis: first nodes (E, 3), crossing points (E, 3), and whether the field
    rises."""
    first, second = (np.take(inside, range(s, s + inside.shape[axis] - 1), axis) for s in (0, 1))
    at = np.argwhere(first != second)
    ahead = at + np.eye(3, dtype=np.int64)[axis]
    low, high = field[tuple(at.T)], field[tuple(ahead.T)]
    where = at + np.eye(3)[axis] * (low / (low - high))[:, None]
    return at, where, high > low


def _around(axis: int) -> list[list[int]]:
    """Return the four cells around an edge, in order about the axis, as offsets back from its first node."""
    b, c = (axis + 1) % 3, (axis + 2) % 3
    ring = []
    for step_b, step_c in ((0, 0), (1, 0), (1, 1), (0, 1)):
        step = [0, 0, 0]
        step[b], step[c] = step_b, step_c
        ring.append(step)
    return ring
