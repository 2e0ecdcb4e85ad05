"""Images of a block beside a hip by gVirtualXray: a projector, a detector and a noise that are not the twin's.

Optional: `pip install gvxr` (2.1; without a GPU, Mesa's software renderer serves). Path lengths through triangle meshes
are gVirtualXray's; attenuation, scatter, counts and blur are computed here. The twin's set-up gives only where source,
panel, balls and hip are.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.twin import ViewTruth

# Attenuation at an effective 52 keV, 1/mm [xraydb tables, rounded]; what a part displaces is subtracted.
STEEL, BONE, TISSUE, PMMA = 1.46, 0.078, 0.0236, 0.0247
QUANTA, SCATTER = 200.0, 0.5  # per pixel, mean of the image's middle; scatter over primary, even [ours]
BLUR_MM, WHITE, LEVEL = 0.15, 65535, 0.3  # s.d. of the panel's blur; mean of the middle over white [ours]
COVER_MM = 3.5  # PMMA over the balls' centres
SUBDIVISIONS = 3  # of a ball's mesh: 1,280 triangles [ours]

Meshes = Mapping[str, tuple[trimesh.Trimesh, float]]


def parts_of(frame: Frame, wire_mm: np.ndarray) -> Meshes:
    """Return the meshes of a block's true balls and PMMA and of a plain hip around a wire (2, 3): entry, end; each with
    its attenuation above what it displaces, 1/mm."""
    assert frame.solid is not None
    balls = [_ball(f.xyz_mm, f.diameter_mm / 2) for f in frame.solid.fiducials]
    xyz = frame.solid.xyz_mm
    low, high = xyz.min(axis=0) - COVER_MM, xyz.max(axis=0) + COVER_MM
    box = trimesh.creation.box(bounds=np.stack([low, high]))
    entry, end = wire_mm
    down = np.array([0.0, np.sign(entry[1] - end[1]), 0.0])
    bone = [
        _ball(tuple(end), 23.0),
        trimesh.creation.cylinder(16.0, segment=np.stack([end, entry]), sections=96),
        trimesh.creation.cylinder(15.0, segment=np.stack([entry - 25.0 * down, entry + 150.0 * down]), sections=96),
    ]
    middle = wire_mm.mean(axis=0)
    body = trimesh.creation.cylinder(1.0, height=500.0, sections=192)
    body.apply_scale([140.0, 105.0, 1.0])
    body.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1.0, 0.0, 0.0]))
    body.apply_translation(middle + np.array([-35.0, 0.0, -5.0]))
    return {
        "balls": (trimesh.util.concatenate(balls), STEEL - PMMA),
        "block": (box, PMMA - TISSUE),
        **{f"bone {k}": (one, 0.5 * (BONE - TISSUE)) for k, one in enumerate(bone)},
        "body": (body, TISSUE),
    }


def image(view: ViewTruth, parts: Meshes, rng: np.random.Generator) -> Radiograph:
    """Draw the image of the parts on the panel of a view."""
    chain, lengths = view.chain, path_lengths_mm(view, {name: mesh for name, (mesh, _) in parts.items()})
    total = np.sum([per_mm * lengths[name] for name, (_, per_mm) in parts.items()], axis=0)
    primary = np.exp(-total)
    quanta = (primary + SCATTER * gaussian_filter(primary, 30.0 / chain.pitch_mm)) / (1 + SCATTER)
    height, width = quanta.shape
    quanta *= QUANTA / quanta[height // 4 : -height // 4, width // 4 : -width // 4].mean()
    seen = gaussian_filter(rng.poisson(quanta).astype(float), BLUR_MM / chain.pitch_mm)
    stored = np.clip(np.rint(seen * LEVEL * WHITE / QUANTA), 0, WHITE).astype(np.uint16)
    return Radiograph(stored, float(WHITE))


def path_lengths_mm(
    view: ViewTruth, meshes: Mapping[str, trimesh.Trimesh], window: "Window | None" = None
) -> dict[str, np.ndarray]:
    """Return the path length (H, W), mm, of rays in each mesh, by gVirtualXray: at a panel's pixels, or in a window."""
    gvxr, window = _gvxr(), window or Window(np.zeros(2), view.chain.shape, view.chain.pitch_mm)
    right, down = view.detector.axes
    height, width = window.shape
    gvxr.setSourcePosition(*view.focal_point_mm.tolist(), "mm")
    gvxr.setDetectorPosition(*view.detector.to_space(window.middle_mm).tolist(), "mm")
    gvxr.setDetectorUpVector(*(-down).tolist())
    gvxr.setDetectorRightVector(*right.tolist())
    gvxr.setDetectorNumberOfPixels(width, height)
    gvxr.setDetectorPixelSize(window.pitch_mm, window.pitch_mm, "mm")
    out = {}
    for label, mesh in meshes.items():
        gvxr.makeTriangularMesh(label, mesh.vertices.ravel().tolist(), mesh.faces.ravel().tolist(), "mm")
        gvxr.addPolygonMeshAsInnerSurface(label)
        lengths_cm = np.array(gvxr.computeLBuffer(label), dtype=float)
        out[label] = 10.0 * lengths_cm[::-1]  # its first row is the lowest
        gvxr.removePolygonMeshesFromXRayRenderer()
        gvxr.removePolygonMeshesFromSceneGraph()
    return out


@dataclass(frozen=True, eq=False)
class Window:
    """A part of a detector's plane: its middle (2,), mm, and its size in samples with the distance `pitch_mm`."""

    middle_mm: np.ndarray
    shape: tuple[int, int]
    pitch_mm: float


@lru_cache(maxsize=1)
def _gvxr() -> Any:
    """Return the library with a context that needs no display."""
    from gvxrPython3 import gvxr

    gvxr.createWindow(-1, 0, "EGL")
    gvxr.usePointSource()
    gvxr.setMonoChromatic(60.0, "keV", 1000)
    return gvxr


def _ball(centre_mm: tuple[float, ...] | np.ndarray, radius_mm: float) -> trimesh.Trimesh:
    out = trimesh.creation.icosphere(SUBDIVISIONS, radius_mm)
    out.apply_translation(np.asarray(centre_mm))
    return out
