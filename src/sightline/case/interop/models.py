"""Surfaces of a plan, and their files in VTK's legacy format, which 3D Slicer, ParaView and others read."""

import numpy as np

from sightline.case.interop.formats import T_cfcs_wire

Surface = tuple[np.ndarray, list[list[int]]]  # vertices (N, 3), and each face's vertices, anticlockwise from outside
_SIDES = 32  # [ours] of the tube: its edges lie 0.5 % outside the circles
_MAX_TITLE = 255  # VTK's file formats: the second line has at most 256 characters with its end


def frustum(source_mm: np.ndarray, corners_mm: np.ndarray) -> Surface:
    """Return the four sides of the pyramid from the X-ray source (3,) to the corners (4, 3) of an image."""
    return np.vstack([source_mm, corners_mm]), [[0, 1 + (k + 1) % 4, 1 + k] for k in range(4)]


def tube(points_mm: np.ndarray, radii_mm: tuple[float, float]) -> Surface:
    """Return the closed tube between two points (2, 3) that holds a circle of a given radius about each.

    Its sides touch the circles from outside, so that it is nowhere narrower than they are.
    """
    angles = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.column_stack([np.cos(angles), np.sin(angles)]) / np.cos(np.pi / _SIDES)
    across = T_cfcs_wire(points_mm)[:3, :2]
    places = np.vstack([point + radius * ring @ across.T for point, radius in zip(points_mm, radii_mm, strict=True)])
    sides = [[k, (k + 1) % _SIDES, _SIDES + (k + 1) % _SIDES, _SIDES + k] for k in range(_SIDES)]
    return places, [*sides, list(range(_SIDES))[::-1], list(range(_SIDES, 2 * _SIDES))]


def model_bytes(places_lps_mm: np.ndarray, faces: list[list[int]], statement: str) -> bytes:
    """Return a surface as a `.vtk` file; its title states the axes, as 3D Slicer writes them, and the statement."""
    lines = [
        "# vtk DataFile Version 3.0",
        f"SPACE=LPS; mm; {statement}"[:_MAX_TITLE],
        "ASCII",
        "DATASET POLYDATA",
        f"POINTS {len(places_lps_mm)} double",
        *(" ".join(repr(float(x) + 0.0) for x in place) for place in places_lps_mm),
        f"POLYGONS {len(faces)} {sum(map(len, faces)) + len(faces)}",
        *(" ".join(map(str, (len(face), *face))) for face in faces),
    ]
    return ("\n".join(lines) + "\n").encode("ascii", "replace")
