"""Watching a live image: time per frame, frames a second and latency of `sightline watch`.

Frames are the twin's fluoroscopy (lowest dose, 1024²). What the movement alarm promises is in tests/case/test_watch.py.
"""

import json
import os
import subprocess
import sys
import time

import numpy as np

import sightline as sl
from benchmarks.harness import Rows
from sightline.case.watch.analyser import REST_FRAMES, STALE_S, LiveAnalyser
from sightline.case.watch.live import Watch
from sightline.rehearsal.stream import Shot, SimulatedFluoroscopy

MIN_PER_S = 10.0  # images that are calibrated, overlaid and compared with the rest position
FIRST_SEED = 3
_TIMED = "from benchmarks.bench_watch import timed; timed({})"


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark."""
    rows, seconds = Rows("watching, 1024²"), 3.0 if quick else 10.0
    for threads in (2, 1):  # in a separate process, because their number is fixed when the kernels are loaded
        command = [sys.executable, "-c", _TIMED.format(20 if quick else 90)]
        environment = {**os.environ, "NUMBA_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
        wall, cpu = np.median(json.loads(done.stdout.splitlines()[-1]), axis=0)
        name = f"array to view, overlay and alarm, {threads} thread(s): processor time; by the clock {wall:.0f} ms"
        rows.number(name, cpu, ".0f", "ms", most=1e3 / MIN_PER_S)
    came, taken, latencies = _sustained(seconds)
    name = f"images a second that are calibrated, of {came / seconds:.1f} that come"
    rows.number(name, taken / seconds, ".1f", least=MIN_PER_S)
    rows.number(
        "age of an overlay, median / 95 %", np.quantile(latencies, (0.5, 0.95)), ".0f", "ms", most=1e3 * STALE_S
    )
    return rows


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
