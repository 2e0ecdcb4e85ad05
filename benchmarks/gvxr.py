"""Images of a frame beside a hip or a bone, and of a nail in a femur's shaft, whose rays gVirtualXray has cast.

Optional: `pip install gvxr` (2.1; without a GPU, Mesa's software renderer serves). Path lengths through triangle meshes
are gVirtualXray's; energies and attenuation are those of this file. Beside a hip scatter, counts and blur are computed
here; the places of source, detector, balls and hip are the twin's, and an intensifier's distortion. Of a nail's image
the nail's mesh and the detector's distortion, blur, glare, noise and video are the twin's. Only the pixels around the
nail are drawn; the others are 0.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter
from trimesh.creation import cylinder

from sightline.frame import Fiducial, Frame
from sightline.imaging import Radiograph
from sightline.twin import ViewTruth
from sightline.twin.anatomy.nailed_femur import CORTEX_MM, THIGH_MM, DistalNail
from sightline.twin.xray.render import DOSES, Exposure

INSTALLED = find_spec("gvxrPython3") is not None
# Attenuation at 45, 55, 65 and 80 keV, 1/mm [mem: XCOM, rounded], and the share of each energy behind a thigh [ours].
PER_MM = {
    "titanium": np.array([0.73, 0.435, 0.29, 0.183]),
    "steel": np.array([2.10, 1.24, 0.79, 0.47]),
    "bone": np.array([0.095, 0.070, 0.058, 0.045]),
    "tissue": np.array([0.0245, 0.0218, 0.0203, 0.0187]),
    "fat": np.array([0.0212, 0.0195, 0.0184, 0.0171]),
    "pmma": np.array([0.0262, 0.0237, 0.0223, 0.0208]),
}
SHARES = np.array([0.25, 0.30, 0.27, 0.18])
QUANTA, SCATTER = 200.0, 0.5  # per pixel, mean of the image's middle; scatter over primary, even [ours]
BLUR_MM, WHITE, LEVEL = 0.15, 65535, 0.3  # s.d. of the panel's blur; mean of the middle over white [ours]
SCATTER_MM = 30.0  # s.d. of the scatter's spread
COVER_MM = 3.5  # PMMA over the balls' centres
MARGIN_PX = 40  # drawn beyond the strokes
ROD_MM = 4.0  # diameter of what hides a part of the lens
RAYS = 3  # along each side of a pixel: a pixel shows the mean light of its area, which is not that of its mean length

Meshes = Mapping[str, trimesh.Trimesh]
Parts = Mapping[str, tuple[trimesh.Trimesh, np.ndarray]]  # with the attenuation above what a part displaces, 1/mm


@dataclass(frozen=True, eq=False)
class Window:
    """A part of a detector's plane: its middle (2,), mm, and its size in samples with the distance `pitch_mm`."""

    middle_mm: np.ndarray
    shape: tuple[int, int]
    pitch_mm: float


@lru_cache(maxsize=1)
def library() -> Any:
    """Return gVirtualXray with a context that needs no display."""
    from gvxrPython3 import gvxr

    gvxr.createWindow(-1, 0, "EGL")
    gvxr.usePointSource()
    gvxr.setMonoChromatic(60.0, "keV", 1000)
    return gvxr


def aimed(focal_mm: np.ndarray, middle_mm: np.ndarray, axes: np.ndarray, window: Window) -> Any:
    """Return gVirtualXray with a source, and a detector with its middle (3,) and axes (2, 3): right, down."""
    gvxr = library()
    gvxr.setSourcePosition(*focal_mm.tolist(), "mm")
    gvxr.setDetectorPosition(*middle_mm.tolist(), "mm")
    gvxr.setDetectorUpVector(*(-axes[1]).tolist())
    gvxr.setDetectorRightVector(*axes[0].tolist())
    gvxr.setDetectorNumberOfPixels(*window.shape[::-1])
    gvxr.setDetectorPixelSize(window.pitch_mm, window.pitch_mm, "mm")
    return gvxr


def add(gvxr: Any, label: str, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Add a mesh."""
    gvxr.makeTriangularMesh(label, vertices.ravel().tolist(), triangles.ravel().tolist(), "mm")
    gvxr.addPolygonMeshAsInnerSurface(label)


def path_lengths_mm(view: ViewTruth, meshes: Meshes, window: Window | None = None) -> dict[str, np.ndarray]:
    """Return the path length (H, W), mm, of rays in each mesh: at a panel's pixels, or in a window."""
    window = window or Window(np.zeros(2), view.chain.shape, view.chain.pitch_mm)
    gvxr = aimed(view.focal_point_mm, view.detector.to_space(window.middle_mm), view.detector.axes, window)
    lengths = {}
    for label, mesh in meshes.items():
        add(gvxr, label, mesh.vertices, mesh.faces)
        lengths[label] = 10.0 * np.array(gvxr.computeLBuffer(label), dtype=float)[::-1]  # its first row is the lowest
        gvxr.removePolygonMeshesFromXRayRenderer()
        gvxr.removePolygonMeshesFromSceneGraph()
    return lengths


def balls(fiducials: Iterable[Fiducial], subdivisions: int) -> trimesh.Trimesh:
    """Return the mesh of a frame's balls."""
    return trimesh.util.concatenate([_ball(f.xyz_mm, f.diameter_mm / 2, subdivisions) for f in fiducials])


def _ball(centre_mm: Any, radius_mm: float, subdivisions: int = 3) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions, radius_mm)
    ball.apply_translation(np.asarray(centre_mm))
    return ball


def above(material: str, displaced: str = "tissue") -> np.ndarray:
    """Return the attenuation of a material above that of what it displaces, 1/mm, at each energy."""
    return PER_MM[material] - PER_MM[displaced]


def _light(lengths: Mapping[str, np.ndarray], attenuation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the share (H, W) of the light that passes path lengths (H, W), mm."""
    energies = zip(SHARES, np.array(list(attenuation.values())).T, strict=True)
    return sum(
        share * np.exp(-sum(per_mm * lengths[key] for key, per_mm in zip(attenuation, each, strict=True)))
        for share, each in energies
    )


def ellipse(half_mm: tuple[float, float], height_mm: float, at_mm: np.ndarray) -> trimesh.Trimesh:
    """Return a cylinder along CFCS y with an elliptical section."""
    body = cylinder(1.0, height=height_mm, sections=192)
    body.apply_scale([*half_mm, 1.0])
    body.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1.0, 0.0, 0.0]))
    body.apply_translation(at_mm)
    return body


def hip_parts(frame: Frame, wire_mm: np.ndarray) -> Parts:
    """Return a frame's true balls, a block's PMMA, and a plain hip around a wire (2, 3): entry, end."""
    entry, end = wire_mm
    down = np.array([0.0, np.sign(entry[1] - end[1]), 0.0])
    bone = [
        _ball(end, 23.0),
        cylinder(16.0, segment=np.stack([end, entry]), sections=96),
        cylinder(15.0, segment=np.stack([entry - 25.0 * down, entry + 150.0 * down]), sections=96),
    ]
    body = ellipse((140.0, 105.0), 500.0, wire_mm.mean(axis=0) + np.array([-35.0, 0.0, -5.0]))
    return {
        **frame_parts(frame),
        **{f"bone {k}": (mesh, 0.5 * above("bone")) for k, mesh in enumerate(bone)},
        "body": (body, PER_MM["tissue"]),
    }


def frame_parts(frame: Frame) -> Parts:
    """Return a frame's true balls, and a block's PMMA."""
    if frame.solid is None:
        return {"balls": (balls(frame.fiducials, 3), PER_MM["steel"])}
    xyz = frame.solid.xyz_mm
    bounds = np.stack([xyz.min(axis=0) - COVER_MM, xyz.max(axis=0) + COVER_MM])
    return {
        "balls": (balls(frame.solid.fiducials, 3), above("steel", "pmma")),
        "block": (trimesh.creation.box(bounds=bounds), above("pmma")),
    }


def panel_image(view: ViewTruth, parts: Parts, rng: np.random.Generator, quanta: float = QUANTA) -> Radiograph:
    """Draw the image of the parts on the panel of a view. `quanta`: per pixel, mean of the image's middle."""
    lengths = path_lengths_mm(view, {name: mesh for name, (mesh, _) in parts.items()})
    return _stored(_light(lengths, {name: per_mm for name, (_, per_mm) in parts.items()}), view, rng, quanta)


def intensifier_image(view: ViewTruth, parts: Parts, rng: np.random.Generator, quanta: float = QUANTA) -> Radiograph:
    """Draw the image of the parts on an intensifier, through the view's distortion; `quanta` as of `panel_image`."""
    height, width = view.chain.shape
    uv = np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), axis=-1)
    field = view.in_field(uv)
    xy, pitch = view.intensifier.to_detector(uv[field]), view.chain.pitch_mm / 2
    low, high = xy.min(axis=0) - RAYS * pitch, xy.max(axis=0) + RAYS * pitch
    count = np.ceil((high - low) / pitch).astype(int) + 1
    window = Window(low + (count - 1) / 2 * pitch, (int(count[1]), int(count[0])), pitch)
    lengths = path_lengths_mm(view, {name: mesh for name, (mesh, _) in parts.items()}, window)
    light = uniform_filter(_light(lengths, {name: per_mm for name, (_, per_mm) in parts.items()}), 2)
    primary = np.zeros(view.chain.shape)
    # The mean of two samples lies half a sample before the second.
    primary[field] = map_coordinates(light, ((xy - low) / pitch + 0.5).T[::-1], order=1, mode="nearest")
    return _stored(primary, view, rng, quanta, field)


def _stored(
    primary: np.ndarray,
    view: ViewTruth,
    rng: np.random.Generator,
    wanted: float,
    field: np.ndarray | None = None,
) -> Radiograph:
    """Return the image of the light (H, W) that arrives without scatter; black outside the `field`, (H, W) bool."""
    pitch = view.chain.pitch_mm
    quanta = (primary + SCATTER * gaussian_filter(primary, SCATTER_MM / pitch)) / (1 + SCATTER)
    quanta = quanta if field is None else quanta * field
    height, width = quanta.shape
    quanta *= wanted / quanta[height // 4 : -height // 4, width // 4 : -width // 4].mean()
    seen = gaussian_filter(rng.poisson(quanta).astype(float), BLUR_MM / pitch)
    stored = np.clip(np.rint(seen * LEVEL * WHITE / wanted), 0, WHITE).astype(np.uint16)
    return Radiograph(stored, float(WHITE))


@dataclass(frozen=True, eq=False)
class Cast:
    """Path lengths (H, W), mm, by part, of a lattice of rays; `at` (2, h, w): row and column on it of the pixels of a
    window; `attenuation` of each part above what it displaces."""

    lengths_mm: Mapping[str, np.ndarray]
    at: np.ndarray
    attenuation: Mapping[str, np.ndarray]


def cast_nail(view: ViewTruth, nail: DistalNail, frame: Frame, window_px: np.ndarray) -> Cast:
    """Return the path lengths of rays near a window's pixels (h, w, 2).

    "rod": a steel rod along the nail, before the hole, that covers about 30 % of the lens's rim.
    """
    xy, pitch = view.intensifier.to_detector(window_px), view.chain.pitch_mm / RAYS
    low, high = xy.min(axis=(0, 1)) - RAYS * pitch, xy.max(axis=(0, 1)) + RAYS * pitch
    count = np.ceil((high - low) / pitch).astype(int) + 1
    window = Window(low + (count - 1) / 2 * pitch, (int(count[1]), int(count[0])), pitch)
    parts = _nail_parts(view, nail, frame)
    lengths = path_lengths_mm(view, {key: mesh for key, (mesh, _) in parts.items()}, window)
    at = np.moveaxis((xy - low) / pitch, -1, 0)[::-1]
    return Cast(lengths, at, {key: per_mm for key, (_, per_mm) in parts.items()})


def _nail_parts(view: ViewTruth, nail: DistalNail, frame: Frame) -> Parts:
    mesh, along = nail.mesh(), nail.along
    ends = nail.hole_mm + np.array([[-75.0], [75.0]]) * along
    shaft, canal = (cylinder(radius, segment=ends, sections=192) for radius in CORTEX_MM)
    beam = nail.hole_mm - view.focal_point_mm
    beam /= np.linalg.norm(beam)
    aside = np.cross(along, beam)
    aside *= np.sign(aside @ np.ones(3)) / np.linalg.norm(aside)
    # A chord at 0.59 of the radius cuts 30 % off a circle's rim.
    at = nail.hole_mm + (0.59 * nail.hole_diameter_mm / 2 + ROD_MM / 2) * aside - 12.0 * beam
    rod = cylinder(ROD_MM / 2, segment=at + np.array([[-40.0], [40.0]]) * along, sections=64)
    return {
        "nail": (trimesh.Trimesh(mesh.vertices_mm, mesh.triangles, process=False), above(nail.material)),
        "shaft": (shaft, above("bone")),
        "canal": (canal, -above("bone")),
        "thigh": (ellipse(THIGH_MM, 400.0, nail.hole_mm), PER_MM["tissue"]),
        "rod": (rod, above("steel")),
        "balls": (balls(frame.fiducials, 2), above("steel")),
    }


def nail_image(
    view: ViewTruth, rays: Cast, window_px: np.ndarray, rng: np.random.Generator, *, hidden: bool
) -> Radiograph:
    """Draw the image of a window (h, w, 2); `hidden`: with the rod."""
    chain, dose = view.chain, DOSES["medium"]
    shown = {key: per_mm for key, per_mm in rays.attenuation.items() if hidden or key != "rod"}
    light = uniform_filter(_light(rays.lengths_mm, shown), RAYS)
    primary = map_coordinates(light, rays.at, order=1, mode="nearest")
    arriving = primary + chain.scatter_to_primary * gaussian_filter(primary, SCATTER_MM / chain.pitch_mm)
    wanted = dose.quanta(chain)
    quanta = wanted * arriving / arriving.mean()
    core_px = chain.core_mm * float(np.sqrt(np.linalg.det(view.intensifier.jacobian(np.zeros((1, 2)))[0])))
    field = np.ones(quanta.shape, dtype=bool)
    drawn = Exposure(chain, quanta, quanta, field, core_px, dose.level * chain.white / wanted).read_out(rng)
    whole = np.zeros(chain.shape, dtype=drawn.pixels.dtype)
    (left, top), (h, w) = window_px[0, 0].astype(int), quanta.shape
    whole[top : top + h, left : left + w] = drawn.pixels
    return Radiograph(whole, drawn.white)


def window_px(view: ViewTruth, strokes_px: np.ndarray) -> np.ndarray:
    """Return the pixels (h, w, 2) around strokes (..., 2), within the image."""
    at, size = strokes_px.reshape(-1, 2), np.array(view.chain.shape[::-1])
    low = np.clip(np.floor(at.min(axis=0) - MARGIN_PX), 0, size - 1).astype(int)
    high = np.clip(np.ceil(at.max(axis=0) + MARGIN_PX), 0, size - 1).astype(int)
    u, v = (np.arange(a, b + 1, dtype=float) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(u, v), axis=-1)
