"""Time from an array to a calibrated view, of detection against the image's size, and of a dragged point's curve.

The images are the demo's. Each program runs warm, with default settings; its time is the median of many runs that
alternate with the others', so that load on the machine affects all equally. A peer's parameters are the fastest of a
small grid that find 95 % of the beads in the field; where none does, those with the highest recall.

Against size: balls of one radius in pixels on an even background, with Poisson noise and a detector's blur. Costs are
processor time of all threads, the smallest of several runs.

The app must draw the curve of a dragged point within 50 ms of the pointer event, including the browser's share. Its
views are calibrated by `smooth` from the beads of one random set-up. No peer does this.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

import sightline as sl
from benchmarks import blobs
from benchmarks.harness import Row, Rows, time_ms, times_ms
from sightline.frame import Frame
from sightline.planning import corridor, kind, matching_curve, plan
from sightline.studies.scenes import WHOLE, draw_scene

MAX_MS, MAX_MB, MAX_FIRST_S = 33.0, 200.0, 1.5
MAX_BLAS_RATIO = 1.1  # of the slower over the faster environment: the noise of two processes
MAX_DIFFERENCE = 1e-9  # relative, of a view's numbers on another processor
MIN_RECALL = 0.95
FOUND_PX = 2.0  # a bead counts as found if a blob lies within this distance of its measured centre
RUNS = 60

SIDES = (512, 724, 1024, 1448, 2048, 2896, 4096)
SIDE, COUNT = 1024, 100  # from which the exponent is taken; beads
RADIUS_PX, DEPTH, QUANTA, BLUR_PX, WHITE = 7.0, 3.0, 2000.0, 0.9, 4095.0
MAX_EXPONENT = 1.1  # of the cost over the pixels from 1024² on: linear, with a tenth for the machine's caches
SIZE_RUNS = 8

CURVE_MS, PLAN_MS, CORRIDOR_MS = 5.0, 15.0, 3.0
PLAN_RUNS = 300
LINE_MM = np.array([[31.0, 24.0, -9.0], [-22.0, -26.0, 11.0]])
LANDMARKS_MM = np.array([[-21.3, -17.9, 4.4], [12.2, 30.1, -16.8]])

# A separate process: its peak memory, MB, and processor time, s, are those of the first view with Python, libraries and
# compiled code. Then the smallest processor time, ms, of a view in all threads, and the view's numbers as hexadecimals.
# Arguments: a DICOM file, or an array's file with its white level; the number of runs.
_PROCESS = """
import resource, sys, time
import numpy as np
import sightline as sl
frame = sl.Frame.load("gamma")
path, white = sys.argv[1], sys.argv[3]
image = sl.Radiograph(np.load(path), float(white)) if path.endswith(".npy") else sl.read_image(path)

def view():
    return sl.calibrate(sl.label(sl.detect(sl.Radiograph(image.pixels, image.white)), frame), frame)

first = view()
begun = time.process_time()
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
taken = []
for _ in range(int(sys.argv[2])):
    started = time.process_time()
    view()
    taken.append(1e3 * (time.process_time() - started))
errors = first.posterior.line_errors(first.residuals.uv_px[:5])
numbers = (first.focal_point_mm, first.residuals.uv_px, np.diagonal(errors.noise), np.diagonal(errors.misfit))
every = [peak, begun, min(taken), *np.concatenate([n.ravel() for n in numbers])]
print(*(float(x).hex() for x in every))
"""
# What differs between the processes, beside the image's form.
_ENVIRONMENTS = {
    "array": {},
    "DICOM": {},
    "one thread of linear algebra": {"OPENBLAS_NUM_THREADS": "1"},
    **{f"{count} threads": {"NUMBA_NUM_THREADS": str(count)} for count in (1, 2, 3, 4)},
    "another processor": {"OPENBLAS_CORETYPE": "Haswell"},  # kernels of linear algebra; ours would take minutes
}


@dataclass(frozen=True, eq=False)
class _Image:
    """A demo image, and the beads in it: `bead_px` (N, 2), `radius_px` (N,)."""

    radiograph: sl.Radiograph
    bead_px: np.ndarray
    radius_px: np.ndarray

    @property
    def fresh(self) -> sl.Radiograph:
        """The image without what is known of it already."""
        return sl.Radiograph(self.radiograph.pixels, self.radiograph.white)


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    return _view(RUNS // 10 if quick else RUNS, quick) + _size(quick) + _planning(PLAN_RUNS // (10 if quick else 1))


def _view(runs: int, quick: bool) -> Rows:
    rows, demo = Rows("speed"), "from sightline.cli import main; main()"
    with TemporaryDirectory() as name:
        folder = Path(name) / "demo"
        subprocess.run([sys.executable, "-c", demo, "demo", "--out", str(folder), "--quiet"], check=True)
        images = [_read(folder, name) for name in ("pa", "lateral")]
        processes = _processes(folder / "demo_pa.dcm", 1 if quick else 3, runs)
    frame = sl.Frame.load("gamma")
    finders = {name: _fastest(grid, images) for name, grid in _peers().items()}

    def each(stage: Callable[[_Image], object]) -> Callable[[], object]:
        return lambda: [stage(image) for image in images]

    beads = {id(image): sl.detect(image.fresh) for image in images}
    seen = {key: sl.label(detections, frame) for key, detections in beads.items()}
    known = {id(image): image.fresh for image in images}
    programs = {
        "whole": each(lambda image: sl.calibrate(sl.label(sl.detect(image.fresh), frame), frame)),
        "field": each(lambda image: image.fresh.field_mask),
        "detect": each(lambda image: sl.detect(known[id(image)])),
        "label": each(lambda image: sl.label(beads[id(image)], frame)),
        "calibrate": each(lambda image: sl.calibrate(seen[id(image)], frame)),
        **{
            name: each(lambda image, find=find: find(image.radiograph.pixels, float(image.radiograph.pixels.max())))
            for name, (find, _) in finders.items()
        },
    }
    ms = {name: float(np.median(taken)) / len(images) for name, taken in times_ms(programs, runs).items()}
    peers = ", ".join(f"{name} {ms[name]:.0f} ms (recall {recall:.2f})" for name, (_, recall) in finders.items())
    name = "array to calibrated view, demo images 1024² by the clock"
    rows.number(name, ms["whole"], ".1f", "ms", most=MAX_MS, peer=f"only finding blobs: {peers}")
    stages = [ms[stage] for stage in ("field", "detect", "label", "calibrate")]
    rows.number("of which field of view / detect / label / calibrate", stages, ".1f", "ms")
    _add_processes(rows, processes)
    return rows


def _read(folder: Path, name: str) -> _Image:
    """Return a demo image; the labelled beads serve as truth, because all of them are beads."""
    seen, detected = (
        json.loads((folder / f"{what}.json").read_text())[name] for what in ("observations", "detections")
    )
    uv = np.array(seen["uv_px"])
    near = np.linalg.norm(uv[:, None] - np.array(detected["uv_px"])[None], axis=2).argmin(axis=1)
    return _Image(sl.read_image(folder / f"demo_{name}.dcm"), uv, np.array(detected["radius_px"])[near])


def _processes(image: Path, rounds: int, runs: int) -> dict[str, np.ndarray]:
    """Return what `_PROCESS` prints (rounds, N) in all environments, which alternate; the image is an array but for
    "DICOM"."""
    ours = "PYTHONDONTWRITEBYTECODE"  # an installed package has its bytecode
    free = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS") and name != ours}
    read, array = sl.read_image(image), image.with_suffix(".npy")
    np.save(array, read.pixels)
    printed: dict[str, list[list[float]]] = {name: [] for name in _ENVIRONMENTS}
    for _, (name, changed) in product(range(rounds), _ENVIRONMENTS.items()):
        command = [sys.executable, "-c", _PROCESS, str(image if name == "DICOM" else array), str(runs), str(read.white)]
        done = subprocess.run(command, check=True, capture_output=True, text=True, env={**free, **changed})
        printed[name].append([*map(float.fromhex, done.stdout.split())])
    return {name: np.array(values) for name, values in printed.items()}


def _add_processes(rows: Rows, processes: dict[str, np.ndarray]) -> None:
    """Add the smallest of each processor time, and the largest peak."""

    def difference(name: str) -> float:
        """Return the largest relative difference of a view's numbers from those of the first process."""
        usual = processes["array"][0, 3:]
        return float(np.max(np.abs(processes[name][:, 3:] - usual) / np.maximum(np.abs(usual), np.finfo(float).tiny)))

    fixed, free = (processes[name][:, 2].min() for name in ("one thread of linear algebra", "array"))
    blas, counts = difference("one thread of linear algebra"), max(difference(f"{n} threads") for n in (1, 2, 3, 4))
    value = f"{fixed:.1f} / {free:.1f} ms, {'OTHER bits' if blas else 'the same bits'}"
    met = not blas and max(fixed, free) <= MAX_BLAS_RATIO * min(fixed, free)
    name = "processor time of a view, with / without OPENBLAS_NUM_THREADS=1"
    rows.add(name, value, f"<= {MAX_BLAS_RATIO:g} x, the same bits", met)
    other = difference("another processor")
    name = "largest relative difference of a view with 1 to 4 threads; with OpenBLAS's kernels of another processor"
    value = f"{f'{counts:.1g}' if counts else 'none: the same bits'}; {other:.1g}"
    rows.add(name, value, f"the same bits; < {MAX_DIFFERENCE:g}", not counts and other < MAX_DIFFERENCE)
    first, dicom = (processes[name][:, 1].min() for name in ("array", "DICOM"))
    name = "processor time of a new process with its first view, kernels compiled: of an array; of a DICOM file"
    rows.add(name, f"{first:.2f} s; {dicom:.2f} s", f"<= {MAX_FIRST_S:g} s", first <= MAX_FIRST_S)
    peak, with_dicom = (processes[name][:, 0].max() for name in ("array", "DICOM"))
    name = "peak memory of the process: an array; a DICOM file"
    rows.add(name, f"{peak:.0f} MB; {with_dicom:.0f} MB", f"< {MAX_MB:.0f} MB", peak < MAX_MB)


def _peers() -> dict[str, list[blobs.Finder]]:
    """Return finders of blobs by name, with parameters of a small grid."""
    options = {"minThreshold": 10, "maxThreshold": 220, "minRepeatability": 2, "minDistBetweenBlobs": 5,
               "filterByArea": True, "minArea": 60, "maxArea": 1500, "filterByCircularity": True, "minCircularity": 0.7,
               "filterByConvexity": True, "filterByInertia": False}  # fmt: skip
    grid, diameters = product((20, 10, 5, 3, 2), (0.9, 0.8)), product((19, 23, 27), (64.0, 40.0), (13, 19))
    return {
        "SimpleBlobDetector": [blobs.opencv(**options, thresholdStep=step, minConvexity=least) for step, least in grid],
        "trackpy.locate": [blobs.trackpy(size, percentile=share, separation=by) for size, share, by in diameters],
    }


def _recall(find: blobs.Finder, images: list[_Image]) -> float:
    hits = []
    for image in images:
        spots = find(image.radiograph.pixels, float(image.radiograph.pixels.max())).reshape(1, -1, 2)
        distance = np.linalg.norm(image.bead_px[:, None] - spots, axis=2).min(axis=1, initial=np.inf)
        hits.append(distance < np.maximum(FOUND_PX, 0.3 * image.radius_px))
    return float(np.concatenate(hits).mean())


def _fastest(finders: list[blobs.Finder], images: list[_Image]) -> tuple[blobs.Finder, float]:
    """Return the fastest finder with enough recall, else the one with the highest, and its recall."""
    recall = [_recall(find, images) for find in finders]
    enough = [k for k, share in enumerate(recall) if share >= MIN_RECALL]
    pixels = images[0].radiograph.pixels
    taken = {k: time_ms(lambda k=k: finders[k](pixels, float(pixels.max())), 1)[0] for k in enough}
    best = min(enough, key=lambda k: taken[k]) if enough else int(np.argmax(recall))
    return finders[best], recall[best]


def _size(quick: bool) -> Rows:
    rows, (sides, runs) = Rows("speed against size"), (SIDES[:3], 2) if quick else (SIDES, SIZE_RUNS)
    by_side = np.array([_cost_ms(side, COUNT, runs) for side in sides])
    name = f"detect, {COUNT} beads on {' / '.join(map(str, sides))} px squared"
    rows.number(name, by_side, ".0f", "ms")
    if not quick:
        large = np.array(sides) >= SIDE
        exponent = np.polyfit(2 * np.log(np.array(sides)[large]), np.log(by_side[large]), 1)[0]
        name = f"exponent of the cost over the pixels, from {SIDE} px squared on"
        rows.number(name, exponent, ".2f", most=MAX_EXPONENT)
    return rows


def _cost_ms(side: int, count: int, runs: int) -> float:
    """Return the smallest processor time of `detect`, ms, over `runs` runs."""
    image = _grid_image(side, count)
    return float(time_ms(lambda: sl.detect(sl.Radiograph(image.pixels, image.white)), runs, time.process_time).min())


def _grid_image(side: int, count: int) -> sl.Radiograph:
    """Return an image of `side` x `side` pixels with `count` balls at random places of a grid."""
    rng = np.random.default_rng([side, count])
    grid = int(np.ceil(np.sqrt(count)))
    pitch = side / grid
    places = rng.permutation(grid * grid)[:count]
    middle = np.stack([places % grid, places // grid], axis=1) * pitch + pitch / 2
    reach = int(RADIUS_PX) + 2
    light = np.full((side, side), QUANTA, np.float32)
    for u, v in middle + rng.uniform(-2, 2, middle.shape):
        left, top = int(u) - reach, int(v) - reach
        y, x = np.mgrid[top : top + 2 * reach + 1, left : left + 2 * reach + 1]
        chord = np.sqrt(np.clip(1 - ((x - u) ** 2 + (y - v) ** 2) / RADIUS_PX**2, 0, None))
        light[y, x] *= 0.3 + 0.7 * np.exp(-DEPTH * chord)
    noisy = cv2.GaussianBlur(rng.poisson(light).astype(np.float32), (0, 0), BLUR_PX) * (0.6 * WHITE / QUANTA)
    return sl.Radiograph(np.clip(np.rint(noisy), 0, WHITE).astype(np.uint16), WHITE)


def _planning(runs: int) -> Rows:
    rows, told = Rows("planning"), replace(Frame.load("gamma"), tolerances=WHOLE)
    scene = draw_scene(np.random.default_rng(3), told, 0.1, targets=4)
    views = [sl.calibrate(seen, told) for seen in scene.observations.values()]
    uv, landmarks = (np.array([view.project(points) for view in views]) for points in (LINE_MM, LANDMARKS_MM))
    rng, free = np.random.default_rng(4), partial(plan, views, procedure=kind("free-wire"))
    made = free(uv[:, 0], uv[:, 1])

    def dragged() -> np.ndarray:
        return uv + rng.uniform(-15.0, 15.0, 2) * np.array([1.0, 0.0])[:, None, None]

    def planned() -> object:
        at = dragged()
        return free(at[:, 0], at[:, 1], snapped=True, landmarks_uv_px=landmarks)

    cases: dict[str, tuple[Callable[[], object], float]] = {
        "curve of a dragged point in the other view, one thread": (
            lambda: matching_curve(views[0], dragged()[0, 0], views[1]).half_width_px,
            CURVE_MS,
        ),
        "plan of two snapped points and two landmarks, the same": (planned, PLAN_MS),
        "corridor of the wire in a view, the same": (lambda: corridor(views[0], made.trajectory), CORRIDOR_MS),
    }
    for name, (call, most) in cases.items():
        ms = time_ms(call, runs, time.thread_time)
        value = f"{ms.min():.1f}; {np.median(ms):.1f}; {np.quantile(ms, 0.95):.1f} ms"
        rows.add(f"{name}: least; median; 95 %", value, f"median <= {most:g} ms", np.median(ms) <= most)
    return rows
