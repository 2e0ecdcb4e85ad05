"""Hold our cameras against Autoscoper's on its sample data, or on any folder of MayaCam 2 files.

    python tools/compare_mayacam.py FOLDER

A clone of github.com/BrownBiomechanics/Autoscoper has `sample_data`; nothing is fetched here. For each two files that
differ in the last number of their names: our pixels of points where the beams cross against those of Autoscoper's
camera (Camera.cpp, RadRenderer.cl), which reads the file and our export of it; and the points again from its pixels.
Tables of points as XMALab exports them are read.
"""

import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import sightline as sl
from sightline.calibration.exchange.formats import write_view
from sightline.calibration.exchange.point_table import read_points
from sightline.common.geometry.lines import nearest_approach
from sightline.errors import SightlineError
from sightline.planning.points.many import ManySolver

HALF_MM, POINTS = 40.0, 500  # of a cube, and in it
HALF_PIXEL = np.array([0.0, 1.0])  # Autoscoper's texels, from the image's corner, less our pixels (docs/interop.md)


def autoscoper(file: Path, xyz: np.ndarray) -> np.ndarray:
    """Return the texels (N, 2), from the top-left corner, in which Autoscoper sees points (N, 3)."""
    lines = file.read_text().splitlines()
    width, height = (float(x) for x in lines[1].split(","))
    k, rotation = (np.array([line.split(",") for line in lines[at : at + 3]], dtype=float) for at in (4, 9))
    x, y, z = rotation @ xyz.T + np.array(lines[14:17], dtype=float)[:, None]
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], height - 1 - k[1, 2]
    plane = -(2 * cx - width) / fx, -(2 * cy - height) / fy, 2 * width / fx, 2 * height / fy
    u, v = 2 * x / z, -2 * y / z  # the ray (u, v, -2), x right, y up
    return np.column_stack([((u - plane[0]) / plane[2] + 0.5) * width, (0.5 - (v - plane[1]) / plane[3]) * height])


def compare(files: list[Path], rng: np.random.Generator) -> None:
    """Print the differences for two cameras."""
    cameras = [sl.read_view(file, name=f"cam{k}") for k, file in enumerate(files, 1)]
    views = [camera.view() for camera in cameras]
    beams = [v.lines_of_sight(c.camera_matrix[None, :2, 2]) for v, c in zip(views, cameras, strict=True)]
    sources = [beam.focal_point_mm for beam in beams]
    crossing = nearest_approach(sources[0], beams[0].directions, sources[1], beams[1].directions).middle_mm
    xyz = crossing + rng.uniform(-HALF_MM, HALF_MM, (POINTS, 3))
    seen = np.array([autoscoper(file, xyz) for file in files])
    with TemporaryDirectory() as place:
        exported = Path(place) / "camera.txt"
        for camera, view, file, theirs in zip(cameras, views, files, seen, strict=True):
            exported.write_bytes(next(iter(write_view(camera, "mayacam2").values())))
            off, back = theirs - view.project(xyz) - HALF_PIXEL, autoscoper(exported, xyz) - theirs
            print(f"{file.name}: read within {np.abs(off).max():.1e} px, exported within {np.abs(back).max():.1e} px")
    found = ManySolver(views).solve(seen - HALF_PIXEL, np.full((2, POINTS), 0.5))
    print(f"  {(found.reason == 0).sum()} of {POINTS} points, within {np.nanmax(np.abs(found.xyz_mm - xyz)):.1e} mm")


def main(folder: Path) -> None:
    """Print a line for each camera, pair and table of a folder."""
    trials: dict[str, list[Path]] = {}
    for file in sorted(folder.rglob("*.txt")):
        if file.read_bytes().startswith(b"image size"):
            trials.setdefault(re.sub(r"\d+(?=\D*$)", "", str(file)), []).append(file)
    for files in trials.values():
        if len(files) == 2:
            compare(files, np.random.default_rng(1))
    for file in sorted(folder.rglob("*.csv")):
        try:
            table = read_points(file, ["cam1", "cam2"])
            print(f"{file.name}: {len(table.names)} points in {len(set(table.frames.tolist()))} frames")
        except SightlineError as error:
            print(f"{file.name}: refused, {error}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
