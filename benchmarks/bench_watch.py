"""Watching a live image: time per frame, frames a second and latency of `sightline watch`, and the movement alarm.

Frames are the twin's fluoroscopy (lowest dose, 1024²). The alarm is tested on points: random set-ups whose beads have
the noise of that dose, and a C-arm that translates and rotates so that the target's line of sight moves by just the
promised limit.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

import sightline as sl
from benchmarks.harness import Row, Rows, trials
from sightline.calibration.displacement import Rest
from sightline.case.watch.analyser import HOUR, PROMISED_MM, REST_FRAMES, STALE_S, Alarm, LiveAnalyser
from sightline.case.watch.live import Watch
from sightline.detection import Observations
from sightline.rehearsal.stream import Shot, SimulatedFluoroscopy
from sightline.twin import ViewTruth, bead_images, draw_setup

MIN_PER_S = 10.0  # images that are calibrated, overlaid and compared with the rest position
FIRST_SEED = 3
NOISE_PX = 0.12  # of a bead at the lowest dose, median of the twin's beads
TARGETS_MM = np.array([[-20.0, 11.0, -10.0], [22.0, -15.0, 13.0]])
_TIMED = "from benchmarks.bench_watch import timed; timed({})"


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    rows, seconds = Rows("watching, 1024²"), 3.0 if quick else 10.0
    for threads in (2, 1):  # in a separate process, because their number is fixed when the kernels are loaded
        command = [sys.executable, "-c", _TIMED.format(20 if quick else 90)]
        environment = {**os.environ, "NUMBA_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
        wall, cpu = np.median(json.loads(done.stdout.splitlines()[-1]), axis=0)
        name = f"array to view, overlay and alarm, {threads} thread(s); processor time {cpu:.0f} ms"
        rows.number(name, wall, ".0f", "ms", most=1e3 / MIN_PER_S)
    came, taken, latencies = _sustained(seconds)
    name = f"images a second that are calibrated, of {came / seconds:.1f} that come"
    rows.number(name, taken / seconds, ".1f", least=MIN_PER_S)
    rows.number(
        "age of an overlay, median / 95 %", np.quantile(latencies, (0.5, 0.95)), ".0f", "ms", most=1e3 * STALE_S
    )
    return [*rows, *_alarms(quick)]


def timed(runs: int) -> None:
    """Print wall and processor time, ms, of each image of a stream at rest, as JSON."""
    frame = sl.Frame.load("gamma")
    stream = SimulatedFluoroscopy(FIRST_SEED, frame)
    analyser, times = LiveAnalyser(frame, stream.wire, ()), []
    for k in range(REST_FRAMES + 2 + runs):
        image = stream.still[k % len(stream.still)]
        shot = Shot(sl.Radiograph(image.pixels, image.white), k + 1, time.time())
        wall, cpu = time.perf_counter(), time.process_time()
        analyser.look(shot, time.monotonic(), k + 1, 0)
        times.append((1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)))
    print(json.dumps(times[REST_FRAMES + 2 :]))


def _sustained(seconds: float) -> tuple[int, int, list[float]]:
    """Return how many images of a source with 30 a second came, how many were taken, and the latencies, ms."""
    stream, latencies = SimulatedFluoroscopy(FIRST_SEED, sl.Frame.load("gamma")), []
    with Watch(sl.Frame.load("gamma"), stream, stream.wire) as watch:
        first = last = watch.next(0, 60.0)
        started = time.monotonic()
        while time.monotonic() - started < seconds:
            last = watch.next(last.number, 1.0) or last
            latencies.append(1e3 * last.latency_s)
    came = last.number - first.number
    return came, came - (last.dropped - first.dropped), latencies


def _alarms(quick: bool) -> Rows:
    rows = Rows("movement alarm")
    cases, images, set_ups = (100, HOUR // 10, 20) if quick else (1000, HOUR, 50)
    detected = trials(_detected, [(seed, cases // set_ups) for seed in range(set_ups)])
    false = trials(_false_alarms, [(seed, images // set_ups) for seed in range(1000, 1000 + set_ups)])
    right, sd_mm = (np.concatenate(values) for values in zip(*detected, strict=True))
    name = f"shifts of {PROMISED_MM} mm reported with the second image"
    rows.add(name, f"{right.sum():,} of {cases:,}", ">= 99 %", right.mean() >= 0.99)
    alarms, hours, largest = sum(count for count, _ in false), images / HOUR, max(shift for _, shift in false)
    name, peer = f"false alarms in {hours:g} h of images", f"largest shift {largest:.3f} mm"
    rows.add(name, str(alarms), f"<= {hours:g}", alarms <= hours, peer=peer)
    rows.number("noise at the target, 1 s.d., median / largest", [np.median(sd_mm), sd_mm.max()], unit="mm")
    return rows


def _detected(job: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return for each case of a set-up whether the second image raised the alarm, and the noise, mm."""
    seed, cases = job
    rng = np.random.default_rng(seed)
    rest, truth, see = _at_rest(rng)
    seconds = []
    for _ in range(cases):
        alarm, moved = Alarm(len(TARGETS_MM), "rest"), _moved(truth, rng)
        seconds.append([alarm.update(rest.displacement(see(moved))) for _ in range(2)][1])
    return np.array([each.moved and each.able for each in seconds]), np.array([each.sd_mm for each in seconds])


def _false_alarms(job: tuple[int, int]) -> tuple[int, float]:
    """Return the number of alarms among images of a set-up at rest, reset after each, and the largest shift, mm."""
    seed, images = job
    rest, truth, see = _at_rest(np.random.default_rng(seed))
    alarm, alarms, largest = Alarm(len(TARGETS_MM), "rest"), 0, 0.0
    for _ in range(images):
        status = alarm.update(rest.displacement(see(truth)))
        largest = max(largest, status.shift_mm)
        if status.moved:
            alarm, alarms = Alarm(len(TARGETS_MM), "rest"), alarms + 1
    return alarms, largest


def _at_rest(rng: np.random.Generator) -> tuple[Rest, ViewTruth, Callable[[ViewTruth], Observations]]:
    """Return the rest position of a random view, its truth, and a function that simulates observations."""
    frame = sl.Frame.load("gamma")
    setup = draw_setup(rng, frame)
    name = ("pa", "lateral")[int(rng.integers(2))]
    noise = NOISE_PX**2 * np.eye(2)

    def see(truth: ViewTruth) -> Observations:
        ids, uv = bead_images(replace(setup, views={name: truth}), name, rng, NOISE_PX)
        return Observations(name, tuple(ids), uv, np.broadcast_to(noise, (len(ids), 2, 2)))

    truth = setup.views[name]
    still = [see(truth) for _ in range(REST_FRAMES)]
    return Rest.of(sl.calibrate(still[-1], frame), frame, still, TARGETS_MM), truth, see


def _moved(truth: ViewTruth, rng: np.random.Generator) -> ViewTruth:
    """Return the view after a C-arm motion by which the lines of sight at the targets move by PROMISED_MM at most."""
    turn, shift = 1e-3 * rng.standard_normal(3), 0.3 * rng.standard_normal(3)
    about = rng.uniform(-200.0, 200.0, 3)
    beam = TARGETS_MM - truth.focal_point_mm
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    moves = shift + np.cross(turn, TARGETS_MM - about)
    across = moves - np.einsum("ij,ij->i", moves, beam)[:, None] * beam
    size = PROMISED_MM / np.linalg.norm(across, axis=1).max()
    rotation, detector = Rotation.from_rotvec(size * turn).as_matrix(), truth.detector

    def at(place: np.ndarray) -> np.ndarray:
        return about + rotation @ (place - about) + size * shift

    turned = replace(detector, origin_mm=at(detector.origin_mm), axes=detector.axes @ rotation.T)
    return replace(truth, focal_point_mm=at(truth.focal_point_mm), detector=turned)
