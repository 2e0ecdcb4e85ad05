"""Undistorting whole runs of 1024²: processor time of `sightline undistort --map`, beside a plain loop of OpenCV.

Both read, resample with cubic interpolation and write. Ours is that of two threads, and syncs each file to the disk.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from pydicom import dcmread

import sightline as sl
from benchmarks.harness import Rows
from sightline.calibration.maps.grid import GridMap
from sightline.case.interop.undistorted import UndistortedRun, undistort_runs
from sightline.imaging import write_dicom

SIDE, LEAST, CORES = 1024, 25.0, 2  # px; frames a second on so many cores [ours]: as fast as a cine run was taken
FFV1 = cv2.VideoWriter.fourcc(*"FFV1")
GREY = [cv2.VIDEOWRITER_PROP_IS_COLOR, 0]


def run(quick: bool) -> Rows:
    """Return a row for each kind of file."""
    rows = Rows("undistorting, 1024²")
    index = np.stack(np.meshgrid(*2 * (np.arange(-9, 10),)), axis=-1).reshape(-1, 2)
    off = 50.0 * index
    grid = GridMap(
        511.5 + off * (1 + 1e-7 * np.square(off).sum(axis=1, keepdims=True)), index, False, 10.0, (SIDE, SIDE), "ball"
    )
    uv = grid.sources()
    for name, make, frames in (
        ("video, 8 bit", _video, 150),
        ("TIFF, 16 bit", _tiff, 1000),
        ("PNG, 16 bit", _png, 150),
        ("DICOM, 16 bit", _dicom, 1000),
    ):
        count = 40 if quick else frames
        with tempfile.TemporaryDirectory() as place:
            path, plain = make(Path(place), _frames(8), count)
            work = UndistortedRun.of(path, 1)
            wall, cpu = time.perf_counter(), time.process_time()
            undistort_runs([work], grid, Path(place) / "out", lambda: None)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            peer, started = "", (time.perf_counter(), time.process_time())
            if plain is not None:
                plain(uv)
                took, used = time.perf_counter() - started[0], time.process_time() - started[1]
                peer = f"OpenCV {1e3 * used / count:.0f} ms, by the clock {count / took:.0f} a second"
        metric = f"{name}, {count} frames: processor time of one; by the clock {count / wall:.0f} a second"
        rows.number(metric, 1e3 * cpu / count, ".0f", "ms", most=CORES * 1e3 / LEAST, peer=peer)
    return rows


def _frames(count: int) -> list[np.ndarray]:
    """Smooth shapes with noise, 12 bits in uint16."""
    rng = np.random.default_rng(2)
    shapes = cv2.GaussianBlur(rng.normal(2000, 20000, (SIDE, SIDE)), (0, 0), 20)
    return [np.clip(shapes + rng.normal(0, 30, shapes.shape), 0, 4095).astype(np.uint16) for _ in range(count)]


Made = tuple[Path, Callable[[np.ndarray], None] | None]


def _folder(place: Path, frames: list[np.ndarray], count: int, suffix: str) -> Made:
    (place / "in").mkdir()
    files = [place / "in" / f"{k:05d}{suffix}" for k in range(count)]
    for k, file in enumerate(files):
        cv2.imwrite(str(file), frames[k % len(frames)])

    def plain(uv: np.ndarray) -> None:
        for file in files:
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(place / f"plain{suffix}"), cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_CUBIC))

    return place / "in", plain


def _tiff(place: Path, frames: list[np.ndarray], count: int) -> Made:
    return _folder(place, frames, count, ".tif")


def _png(place: Path, frames: list[np.ndarray], count: int) -> Made:
    return _folder(place, frames, count, ".png")


def _dicom(place: Path, frames: list[np.ndarray], count: int) -> Made:
    file = write_dicom(sl.Radiograph(frames[0], 4095.0), place / "run.dcm")
    header = dcmread(file)
    header.NumberOfFrames = count
    header.PixelData = b"".join(frames[k % len(frames)].tobytes() for k in range(count))
    header.save_as(file)
    return file, None  # OpenCV reads no DICOM


def _video(place: Path, frames: list[np.ndarray], count: int) -> Made:
    file = place / "run.avi"
    writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, FFV1, LEAST, (SIDE, SIDE), GREY)
    for k in range(count):
        writer.write((frames[k % len(frames)] >> 4).astype(np.uint8))
    writer.release()

    def plain(uv: np.ndarray) -> None:
        capture = cv2.VideoCapture(str(file))
        again = cv2.VideoWriter(str(place / "plain.avi"), cv2.CAP_FFMPEG, FFV1, LEAST, (SIDE, SIDE), GREY)
        for _ in range(count):
            again.write(cv2.remap(capture.read()[1][..., 0], uv[..., 0], uv[..., 1], cv2.INTER_CUBIC))
        again.release()

    return file, plain
