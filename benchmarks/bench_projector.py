"""The twin's projector against independent ones: time, memory, agreement.

The image is one view of a random set-up, 1024² pixels, with a volume of 256³ voxels and 200 balls around the hip.
Volumes are compared with RTK (`pip install itk-rtk`; never required) on a view without distortion, timed in the same
run; without RTK, with samples a tenth of a voxel apart (scipy's map_coordinates) on 300 rays. A mesh is compared with
gVirtualXray (`pip install gvxr`; in Mesa's software renderer), which casts one ray a pixel where we cast several; with
exact lengths in tests/twin/test_meshes.py.
"""

import importlib.util
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates

from benchmarks import gvxr
from benchmarks.harness import Rows, rms
from sightline.frame import Frame
from sightline.imaging.volumes.beam import WEIGHTS, attenuation_per_mm
from sightline.imaging.volumes.rays import Rays, volume_integral
from sightline.imaging.volumes.volume import Volume
from sightline.twin import Scene, draw_setup
from sightline.twin.objects.things import Ball
from sightline.twin.xray.projector import MESH_SUB, mesh_lengths
from sightline.twin.xray.render import pixel_rays, primary

MAX_S, MAX_MB, MAX_SHARE = 0.6, 1000.0, 0.01
MAX_SMALL_S = 0.2  # 256³ voxels to 512²
SOURCE_MM, DETECTOR_MM, FIELD_MM = 620.0, 1000.0, 215.0
SIDE_VOXELS, VOXEL_MM, SIDE_PX, SMALL_PX, BALLS = 256, 0.75, 1024, 512, 200
SOME_RAYS = 300
RUNS = 20

# A separate process, so that its peak memory is that of the image, Python, libraries and compiled code.
_PEAK = """
import resource
from benchmarks.bench_projector import scene_and_rays
from sightline.twin.xray.render import primary
primary(*scene_and_rays())
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark."""
    rows, runs = Rows("projector"), RUNS // 10 if quick else RUNS
    view, scene, rays = scene_and_rays()
    (volume,) = scene.volumes
    image_s, busy_s, (with_balls, without) = _least(lambda: primary(view, scene, rays), runs)
    assert (with_balls < without).any()
    name = f"1024² view of 256³ voxels with 200 balls ({busy_s:.2f} s of processor)"
    rows.number(name, image_s, ".2f", "s", most=MAX_S)
    peak = subprocess.run([sys.executable, "-c", _PEAK], check=True, capture_output=True, text=True)
    rows.number("its peak memory", float(peak.stdout), ".0f", "MB", most=MAX_MB)
    every = volume_integral(rays, volume.values, volume.origin_mm, volume.voxel_mm)
    exact = sum(w * np.exp(-every * mu) for w, mu in zip(WEIGHTS, attenuation_per_mm("bone"), strict=True))
    between = _share(without[rays.inside], np.asarray(exact)[rays.inside])
    rows.number("its volume, cast for every second pixel, against every pixel: rms", 100 * between, ".3f", "%")
    for side_px, most_s in ((SIDE_PX, np.inf), (SMALL_PX, MAX_SMALL_S)):
        _add_volume(rows, volume, side_px, runs, most_s)
    _add_mesh(rows)
    return rows


def scene_and_rays() -> tuple[Any, Scene, Rays]:
    """Return the arguments of `render.primary`: a view, a scene and the rays of the view's pixels."""
    rng = np.random.default_rng(7)
    view = draw_setup(rng, Frame.load("gamma")).views["pa"]
    places = rng.uniform(-60.0, 60.0, (BALLS, 3))
    balls = tuple(Ball((float(x), float(y), float(z)), 1.5, within=None) for x, y, z in places)
    return view, Scene(solids=balls, volumes=(_volume(),)), pixel_rays(view)[0]


def _volume() -> Volume:
    """Return a ball of inhomogeneous bone that nearly fills its cube, with an edge one voxel wide."""
    axis = (np.arange(SIDE_VOXELS, dtype=np.float32) - (SIDE_VOXELS - 1) / 2) * VOXEL_MM
    x, y, z = axis[:, None, None], axis[:, None], axis
    inside = np.clip((90.0 - np.sqrt(x**2 + y**2 + z**2)) / VOXEL_MM + 0.5, 0, 1)
    uneven = 0.2 + 0.1 * np.sin(x / 3) * np.cos(y / 4) + 0.1 * np.sin(z / 5)
    return Volume((inside * uneven).astype(np.float32), np.full(3, axis[0]), np.full(3, VOXEL_MM), within=None)


def _flat_rays(side_px: int) -> Rays:
    """Return the rays to all pixels of a square detector below the volume, from a source above it."""
    at = (np.arange(side_px) - (side_px - 1) / 2) * FIELD_MM / side_px
    x, y = np.meshgrid(at, at)
    points = np.stack([x, y, np.full_like(x, SOURCE_MM - DETECTOR_MM)], axis=-1)
    return Rays(np.array([0.0, 0.0, SOURCE_MM]), points, np.ones((side_px, side_px), dtype=bool))


def _least(program: Callable[[], Any], runs: int) -> tuple[float, float, Any]:
    """Return the smallest wall and processor times of many runs, s, because other load only adds; and the result."""
    result, taken = program(), []  # warm
    for _ in range(runs):
        wall, busy = time.perf_counter(), time.process_time()
        result = program()
        taken.append((time.perf_counter() - wall, time.process_time() - busy))
    wall_s, busy_s = np.min(taken, axis=0)
    return float(wall_s), float(busy_s), result


def _share(ours: np.ndarray, other: np.ndarray) -> float:
    """Return the rms difference over the rms."""
    return rms(ours - other) / rms(other)


def _add_volume(rows: Rows, volume: Volume, side_px: int, runs: int, most_s: float) -> None:
    """Add a volume alone, cast for every pixel of a square, beside RTK where it is installed."""
    rays = _flat_rays(side_px)
    own_s, busy_s, ours = _least(lambda: volume_integral(rays, volume.values, volume.origin_mm, volume.voxel_mm), runs)
    if importlib.util.find_spec("itk") is not None:
        rtk_s, rtk_busy_s, theirs = _least(_rtk(volume, side_px), runs)
        share, peer = _share(ours, theirs), f"RTK {rtk_s:.2f} s ({rtk_busy_s:.2f} s of processor)"
    else:
        v, u = np.random.default_rng(8).integers(0, side_px, (2, SOME_RAYS))
        share = _share(ours[v, u], _sampled(volume, rays.focal, rays.points[v, u]))
        peer = "RTK not installed; finely sampled rays"
    asked = f"<= {MAX_SHARE:.0%}" + ("" if most_s == np.inf else f", {most_s} s")
    value = f"{own_s:.2f} s ({busy_s:.2f} s of processor); {share:.1e}"
    name, met = f"volume alone, every pixel of {side_px}²; rms difference", share <= MAX_SHARE and own_s <= most_s
    rows.add(name, value, asked, met, peer=peer)


def _rtk(volume: Volume, side_px: int) -> Callable[[], np.ndarray]:
    """Return a projection by RTK's Joseph method, on the CPU."""
    import itk
    from itk import RTK

    image = itk.image_from_array(np.ascontiguousarray(volume.values.transpose(2, 1, 0)))
    image.SetSpacing(volume.voxel_mm.tolist())
    image.SetOrigin(volume.origin_mm.tolist())
    kind = itk.Image[itk.F, 3]
    geometry = RTK.ThreeDCircularProjectionGeometry.New()
    geometry.AddProjection(SOURCE_MM, DETECTOR_MM, 0.0)
    pixel = FIELD_MM / side_px
    detector = RTK.ConstantImageSource[kind].New()
    detector.SetOrigin([-(side_px - 1) / 2 * pixel] * 2 + [0.0])
    detector.SetSpacing([pixel, pixel, 1.0])
    detector.SetSize([side_px, side_px, 1])

    def project() -> np.ndarray:
        joseph = RTK.JosephForwardProjectionImageFilter[kind, kind].New()
        joseph.SetGeometry(geometry)
        joseph.SetInput(0, detector.GetOutput())
        joseph.SetInput(1, image)
        joseph.Update()
        return itk.array_from_image(joseph.GetOutput())[0]

    return project


def _sampled(volume: Volume, focal: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return line integrals (N,), mm, from a focal point to points (N, 3), with samples a tenth of a voxel apart."""
    reach = 0.9 * SIDE_VOXELS * VOXEL_MM  # half the cube's diagonal, and more
    s = np.arange(-reach, reach, VOXEL_MM / 10)[:, None]
    integrals = np.empty(len(points))
    for n, way in enumerate((points - focal) / np.linalg.norm(points - focal, axis=1, keepdims=True)):
        at = focal + (s - way @ focal) * way
        integrals[n] = map_coordinates(volume.values, ((at - volume.origin_mm) / volume.voxel_mm).T, order=1).sum()
    return integrals * VOXEL_MM / 10


def _add_mesh(rows: Rows) -> None:
    """Add a torus, cast for every pixel of the small square."""
    ring = trimesh.creation.torus(40.0, 15.0, major_sections=160, minor_sections=64)
    tilt = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    vertices, triangles = np.ascontiguousarray(ring.vertices @ (tilt * np.linalg.det(tilt)).T), np.array(ring.faces)
    rays, pixel = _flat_rays(SMALL_PX), FIELD_MM / SMALL_PX
    shadow = rays.focal + (vertices - rays.focal) * (DETECTOR_MM / (SOURCE_MM - vertices[:, 2:]))
    corners, mesh = shadow[triangles][..., :2], (vertices, triangles.astype(np.int64))
    bounds = np.concatenate([corners.min(axis=1) - pixel, corners.max(axis=1) + pixel], axis=1)
    xi, still = rays.points[..., :2].copy(), np.zeros((2, 3))
    own_s, busy_s, lengths = _least(lambda: mesh_lengths(rays, xi, still, mesh, bounds), 3)
    name = f"mesh of {len(triangles):,} triangles, {MESH_SUB**2} rays a pixel, {SMALL_PX}²"
    value = f"{own_s:.2f} s ({busy_s:.2f} s of processor)"
    if not gvxr.INSTALLED:
        rows.add(name, value, peer="gVirtualXray not installed: pip install gvxr")
        return
    their_s, their_busy_s, theirs = _least(_by_gvxr(vertices, triangles), 3)
    share = _share(np.asarray(lengths).mean(axis=0), theirs)
    peer = f"gVirtualXray, one ray a pixel, {their_s:.2f} s ({their_busy_s:.2f} s of processor)"
    rows.add(f"{name}; rms difference", f"{value}; {share:.1e}", f"<= {MAX_SHARE:.0%}", share <= MAX_SHARE, peer=peer)


def _by_gvxr(vertices: np.ndarray, triangles: np.ndarray) -> Callable[[], np.ndarray]:
    """Return a projection of a mesh to the small square by gVirtualXray, without a display."""
    window = gvxr.Window(np.zeros(2), (SMALL_PX, SMALL_PX), FIELD_MM / SMALL_PX)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    below = np.array([0.0, 0.0, SOURCE_MM - DETECTOR_MM])
    library = gvxr.aimed(np.array([0.0, 0.0, SOURCE_MM]), below, axes, window)
    gvxr.add(library, "ring", vertices, triangles)
    return lambda: 10.0 * np.array(library.computeLBuffer("ring"), dtype=float)  # its first row is the lowest, as ours
