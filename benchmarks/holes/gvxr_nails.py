"""Images of a nail in a femur's shaft whose rays gVirtualXray has cast, for all image chains.

The beam's energies and the attenuation are those of this file. Of the twin are set-up, distortion, blur, glare, noise
and video of the detector, and the nail's mesh. Only the pixels around the nail are drawn; the others are 0.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

from benchmarks.gvxr_projector import Window, path_lengths_mm
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.twin import ViewTruth
from sightline.twin.anatomy.nailed_femur import CORTEX_MM, THIGH_MM, DistalNail
from sightline.twin.xray.render import DOSES, Exposure

# Attenuation at 45, 55, 65 and 80 keV, 1/mm [mem: XCOM, rounded], and the share of each energy behind a thigh [ours].
PER_MM = {
    "titanium": (0.73, 0.435, 0.29, 0.183),
    "steel": (2.10, 1.24, 0.79, 0.47),
    "bone": (0.095, 0.070, 0.058, 0.045),
    "tissue": (0.0245, 0.0218, 0.0203, 0.0187),
}
SHARES = np.array([0.25, 0.30, 0.27, 0.18])
MARGIN_PX = 40  # drawn beyond the strokes
ROD_MM = 4.0  # diameter of what hides a part of the lens
SUBDIVISIONS = 2  # of a ball's mesh

RAYS = 3  # along each side of a pixel: a pixel shows the mean light of its area, which is not that of its mean length
EVEN = ("shaft", "canal", "thigh")  # one ray for each pixel is enough


@dataclass(frozen=True, eq=False)
class Cast:
    """Path lengths (H, W), mm, by material and part, of a lattice of rays; `at` (2, h, w): row and column on it of the
    pixels of a window."""

    lengths_mm: Mapping[str, np.ndarray]
    at: np.ndarray


def cast(view: ViewTruth, nail: DistalNail, frame: Frame, window_px: np.ndarray) -> Cast:
    """Return the path lengths of rays near a window's pixels (h, w, 2) in each material but tissue, and in the thigh.

    "rod": a steel rod along the nail, before the hole, that covers about 30 % of the lens's rim.
    """
    xy = _to_detector(view, window_px)
    pitch = view.chain.pitch_mm / RAYS
    low, high = xy.min(axis=(0, 1)) - RAYS * pitch, xy.max(axis=(0, 1)) + RAYS * pitch
    count = np.ceil((high - low) / pitch).astype(int) + 1
    window = Window(low + (count - 1) / 2 * pitch, (int(count[1]), int(count[0])), pitch)
    meshes = _meshes(view, nail, frame)
    lengths = path_lengths_mm(view, {key: mesh for key, mesh in meshes.items() if key not in EVEN}, window)
    coarse = Window(window.middle_mm, (window.shape[0] // RAYS + 2, window.shape[1] // RAYS + 2), view.chain.pitch_mm)
    each = [(np.arange(n) - (n - 1) / 2) / RAYS + (m - 1) / 2 for n, m in zip(window.shape, coarse.shape, strict=True)]
    between = np.stack(np.meshgrid(*each, indexing="ij"))
    for key, rough in path_lengths_mm(view, {key: meshes[key] for key in EVEN}, coarse).items():
        lengths[key] = map_coordinates(rough, between, order=1)
    return Cast(lengths, np.moveaxis((xy - low) / pitch, -1, 0)[::-1])


def _to_detector(view: ViewTruth, window_px: np.ndarray) -> np.ndarray:
    """Return (h, w, 2), mm, of a window's pixels: a spline through every eighth, since distortion is smooth."""
    u, v = window_px[0, :, 0], window_px[:, 0, 1]
    few = [np.linspace(one[0], one[-1], len(one) // 8 + 4) for one in (u, v)]
    known = view.intensifier.to_detector(np.stack(np.meshgrid(*few), axis=-1))
    return np.stack([RectBivariateSpline(few[1], few[0], known[..., k])(v, u) for k in (0, 1)], axis=-1)


def image(
    view: ViewTruth, rays: Cast, window_px: np.ndarray, rng: np.random.Generator, *, material: str, hidden: bool
) -> Radiograph:
    """Draw the image of a window (h, w, 2); `hidden`: with the rod. The nail is of this material."""
    chain, dose, lengths = view.chain, DOSES["medium"], rays.lengths_mm
    steel = lengths["balls"] + (lengths["rod"] if hidden else 0.0)
    light = np.zeros(steel.shape)
    for k, share in enumerate(SHARES):
        tissue = PER_MM["tissue"][k]
        depth = tissue * lengths["thigh"] + (PER_MM["bone"][k] - tissue) * (lengths["shaft"] - lengths["canal"])
        depth += (PER_MM[material][k] - tissue) * lengths["nail"] + (PER_MM["steel"][k] - tissue) * steel
        light += share * np.exp(-depth)
    primary = map_coordinates(uniform_filter(light, RAYS), rays.at, order=1, mode="nearest")
    arriving = primary + chain.scatter_to_primary * gaussian_filter(primary, 30.0 / chain.pitch_mm)
    wanted = dose.quanta(chain)
    quanta = wanted * arriving / arriving.mean()
    jacobian = view.intensifier.jacobian(np.zeros((1, 2)))[0]
    core_px = chain.core_mm * float(np.sqrt(np.linalg.det(jacobian)))
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


def _meshes(view: ViewTruth, nail: DistalNail, frame: Frame) -> dict[str, trimesh.Trimesh]:
    mesh, along = nail.mesh(), nail.along
    ends = nail.hole_mm + np.array([[-75.0], [75.0]]) * along
    shaft, canal = (trimesh.creation.cylinder(radius, segment=ends, sections=192) for radius in CORTEX_MM)
    thigh = trimesh.creation.cylinder(1.0, height=400.0, sections=192)
    thigh.apply_scale([*THIGH_MM, 1.0])
    thigh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1.0, 0.0, 0.0]))
    thigh.apply_translation(nail.hole_mm)
    beam = nail.hole_mm - view.focal_point_mm
    beam /= np.linalg.norm(beam)
    aside = np.cross(along, beam)
    aside *= np.sign(aside @ np.ones(3)) / np.linalg.norm(aside)
    # A chord at 0.59 of the radius cuts 30 % off a circle's rim.
    at = nail.hole_mm + (0.59 * nail.hole_diameter_mm / 2 + ROD_MM / 2) * aside - 12.0 * beam
    rod = trimesh.creation.cylinder(ROD_MM / 2, segment=at + np.array([[-40.0], [40.0]]) * along, sections=64)
    metal = trimesh.Trimesh(mesh.vertices_mm, mesh.triangles, process=False)
    return {"nail": metal, "shaft": shaft, "canal": canal, "thigh": thigh, "rod": rod, "balls": _balls(frame)}


def _balls(frame: Frame) -> trimesh.Trimesh:
    out = []
    for one in frame.fiducials:
        ball = trimesh.creation.icosphere(SUBDIVISIONS, one.diameter_mm / 2)
        ball.apply_translation(np.asarray(one.xyz_mm))
        out.append(ball)
    return trimesh.util.concatenate(out)
