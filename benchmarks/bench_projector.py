"""The twin's projector against independent ones: time, memory, agreement.

The image is one view of a random set-up, 1024² pixels, with a volume of 256³ voxels and 200 balls around the hip.
Volumes are compared with RTK (`pip install itk-rtk`; never required) on a view without distortion, timed in the same
run; without RTK, with samples a tenth of a voxel apart (scipy's map_coordinates) on 300 rays. A mesh is compared with
brute force on 300 rays: the Möller-Trumbore test of every triangle in numpy.
"""

import importlib.util
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from benchmarks.rows import Row
from sightline.frame import Frame
from sightline.twin import Scene, draw_setup
from sightline.twin.beam import WEIGHTS, attenuation_per_mm
from sightline.twin.projector import MESH_SUB, Rays, mesh_lengths, volume_integral
from sightline.twin.render import pixel_rays, primary
from sightline.twin.things import Ball
from sightline.twin.volumes import Volume

REQUIRED_S, REQUIRED_MB, REQUIRED_SHARE = 0.6, 1000.0, 0.01
SOURCE_MM, DETECTOR_MM, FIELD_MM = 620.0, 1000.0, 215.0
SIDE_VOXELS, VOXEL_MM, SIDE_PX, BALLS = 256, 0.75, 1024, 200
SOME_RAYS = 300
RUNS = 20
GROUP = "projector, 256³ voxels to 1024²"

# A separate process, so that its peak memory is that of the image, Python, libraries and compiled code.
_PEAK = """
import resource
from benchmarks.bench_projector import scene_and_rays
from sightline.twin.render import primary
primary(*scene_and_rays())
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    runs = RUNS // 10 if quick else RUNS
    view, scene, rays = scene_and_rays()
    (volume,) = scene.volumes
    image_s, busy_s, (with_balls, without) = _least(lambda: primary(view, scene, rays), runs)
    peak = subprocess.run([sys.executable, "-c", _PEAK], check=True, capture_output=True, text=True)
    every = volume_integral(rays, volume.values, volume.origin_mm, volume.voxel_mm)
    exact = sum(w * np.exp(-every * mu) for w, mu in zip(WEIGHTS, attenuation_per_mm("bone"), strict=True))
    between = _share(without[rays.inside], np.asarray(exact)[rays.inside])
    flat = _flat_rays()
    flat_s, flat_busy_s, ours = _least(
        lambda: volume_integral(flat, volume.values, volume.origin_mm, volume.voxel_mm), runs
    )
    megabytes = float(peak.stdout)
    assert (with_balls < without).any()
    return [
        Row(
            GROUP,
            "image with 200 balls",
            f"{image_s:.2f} s ({busy_s:.2f} s of processor)",
            f"<= {REQUIRED_S} s",
            "",
            image_s <= REQUIRED_S,
        ),
        Row(GROUP, "peak memory", f"{megabytes:.0f} MB", f"< {REQUIRED_MB:.0f} MB", "", megabytes < REQUIRED_MB),
        Row(GROUP, "its volume, cast for every second pixel, against every pixel: rms", f"{between:.3%}"),
        _volume_row(volume, flat, ours, f"{flat_s:.2f} s ({flat_busy_s:.2f} s of processor)", runs),
        _mesh_row(),
    ]


def scene_and_rays():
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


def _flat_rays() -> Rays:
    """Return the rays to all pixels of a square detector below the volume, from a source above it."""
    pixel = FIELD_MM / SIDE_PX
    at = (np.arange(SIDE_PX) - (SIDE_PX - 1) / 2) * pixel
    x, y = np.meshgrid(at, at)
    inside = np.ones((SIDE_PX, SIDE_PX), dtype=bool)
    points = np.stack([x, y, np.full_like(x, SOURCE_MM - DETECTOR_MM)], axis=-1)
    return Rays(np.array([0.0, 0.0, SOURCE_MM]), points, inside)


def _least(program: Callable, runs: int) -> tuple[float, float, Any]:
    """Return the smallest wall and processor times of many runs, s, because other load only adds; and the result."""
    result = program()  # warm
    taken = []
    for _ in range(runs):
        wall, busy = time.perf_counter(), time.process_time()
        result = program()
        taken.append((time.perf_counter() - wall, time.process_time() - busy))
    wall_s, busy_s = np.min(taken, axis=0)
    return float(wall_s), float(busy_s), result


def _share(ours: np.ndarray, other: np.ndarray) -> float:
    """Return the rms difference over the rms."""
    return float(np.sqrt(np.mean((ours - other) ** 2) / np.mean(np.square(other))))


def _volume_row(volume: Volume, rays: Rays, ours: np.ndarray, took: str, runs: int) -> Row:
    name = "volume alone, every pixel of the square"
    if importlib.util.find_spec("itk") is not None:
        rtk_s, rtk_busy_s, theirs = _least(_rtk(volume), runs)
        share, peer = _share(ours, theirs), f"RTK {rtk_s:.2f} s ({rtk_busy_s:.2f} s of processor)"
    else:
        rows, columns = np.random.default_rng(8).integers(0, SIDE_PX, (2, SOME_RAYS))
        share = _share(ours[rows, columns], _sampled(volume, rays.focal, rays.points[rows, columns]))
        peer = "RTK not installed; finely sampled rays"
    value = f"{took}; differs by {share:.1e} rms"
    return Row(GROUP, name, value, f"<= {REQUIRED_SHARE:.0%} rms", peer, share <= REQUIRED_SHARE)


def _rtk(volume: Volume) -> Callable:
    """Return a projection by RTK's Joseph method, on the CPU."""
    import itk
    from itk import RTK

    image = itk.image_from_array(np.ascontiguousarray(volume.values.transpose(2, 1, 0)))
    image.SetSpacing(volume.voxel_mm.tolist())
    image.SetOrigin(volume.origin_mm.tolist())
    kind = itk.Image[itk.F, 3]
    geometry = RTK.ThreeDCircularProjectionGeometry.New()
    geometry.AddProjection(SOURCE_MM, DETECTOR_MM, 0.0)
    pixel = FIELD_MM / SIDE_PX
    detector = RTK.ConstantImageSource[kind].New()
    detector.SetOrigin([-(SIDE_PX - 1) / 2 * pixel] * 2 + [0.0])
    detector.SetSpacing([pixel, pixel, 1.0])
    detector.SetSize([SIDE_PX, SIDE_PX, 1])

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
    s = np.arange(-reach, reach, VOXEL_MM / 10)
    d = (points - focal) / np.linalg.norm(points - focal, axis=1, keepdims=True)
    nearest = -(d @ focal)
    out = np.empty(len(points))
    for n, (way, middle) in enumerate(zip(d, nearest, strict=True)):
        at = focal + (middle + s)[:, None] * way
        out[n] = map_coordinates(volume.values, ((at - volume.origin_mm) / volume.voxel_mm).T, order=1).sum()
    return out * VOXEL_MM / 10


def _mesh_row() -> Row:
    import trimesh

    ring = trimesh.creation.torus(40.0, 15.0, major_sections=160, minor_sections=64)
    tilt = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    vertices, triangles = np.ascontiguousarray(ring.vertices @ (tilt * np.linalg.det(tilt)).T), np.array(ring.faces)
    rays = _flat_rays()
    xi = rays.points[..., :2].copy()
    shadow = rays.focal + (vertices - rays.focal) * (DETECTOR_MM / (SOURCE_MM - vertices[:, 2:]))
    corners = shadow[triangles][..., :2]
    pixel = FIELD_MM / SIDE_PX
    bounds = np.concatenate([corners.min(axis=1) - pixel, corners.max(axis=1) + pixel], axis=1)
    spot = np.zeros((2, 3))
    taken_s, _, ours = _least(lambda: mesh_lengths(rays, xi, spot, (vertices, triangles.astype(np.int64)), bounds), 3)
    rng = np.random.default_rng(4)
    rows, columns = rng.integers(150, SIDE_PX - 150, (2, SOME_RAYS))
    sub = rng.integers(0, MESH_SUB**2, SOME_RAYS)
    offset = (np.stack([sub % MESH_SUB, sub // MESH_SUB], axis=1) + 0.5) / MESH_SUB - 0.5
    towards = rays.points[rows, columns] + pixel * np.pad(offset, ((0, 0), (0, 1)))
    theirs = np.array([_brute_force(vertices[triangles], rays.focal, point) for point in towards])
    share = _share(ours[sub, rows, columns], theirs)
    value = f"{taken_s:.2f} s; differs by {share:.1e} rms"
    return Row(
        GROUP,
        f"mesh of {len(triangles):,} triangles",
        value,
        f"<= {REQUIRED_SHARE:.0%} rms",
        "brute force, numpy",
        share <= REQUIRED_SHARE,
    )


def _brute_force(corners: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Return the length, mm, of a ray within a closed surface of triangles (T, 3, 3), by Möller and Trumbore."""
    d = (end - start) / np.linalg.norm(end - start)
    a, b, c = np.moveaxis(corners, 1, 0)
    p = np.cross(d, c - a)
    det = ((b - a) * p).sum(axis=1)
    s = start - a
    u = (s * p).sum(axis=1) / det
    q = np.cross(s, b - a)
    v = (q @ d) / det
    t = np.sort((((c - a) * q).sum(axis=1) / det)[(u >= 0) & (v >= 0) & (u + v <= 1)])
    return float((t[1::2] - t[::2]).sum()) if len(t) % 2 == 0 else np.nan
