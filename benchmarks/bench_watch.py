"""Watching a live image: time per frame, frames a second and latency of `sightline watch`, and the movement alarm.

Frames are the twin's fluoroscopy (lowest dose, 1024²). The alarm is tested on points: random set-ups whose beads have
the noise of that dose, and a C-arm that translates and rotates so that the target's line of sight moves by just the
promised limit. A few rendered sequences are tested too.
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
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.calibration.displacement import Rest
from sightline.case.watch.analyser import HOUR, PROMISED_MM, REST_FRAMES, STALE_S, Alarm, LiveAnalyser
from sightline.case.watch.live import Watch
from sightline.detection import Observations
from sightline.rehearsal.stream import Shot, SimulatedFluoroscopy, shifted
from sightline.twin import DOSES, ViewTruth, bead_images, draw_setup, shown_hip_scene
from sightline.twin.xray.render import expose

REQUIRED_PER_S = 10.0  # images that are calibrated, overlaid and compared with the rest position
SEED = 3
NOISE_PX = 0.12  # of a bead at the lowest dose, median of the twin's beads
TARGETS_MM = np.array([[-20.0, 11.0, -10.0], [22.0, -15.0, 13.0]])
_GROUP = "watching, 1024² at 30/s"
_ALARM = f"movement alarm, {PROMISED_MM} mm at the target"


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    rows = [_time_row(threads, 20 if quick else 90) for threads in (2, 1)]
    return rows + _sustained_rows(3.0 if quick else 10.0) + _alarm_rows(quick)


def _time_row(threads: int, runs: int) -> Row:
    """Measure in a separate process, because the number of threads is fixed when the kernels are loaded."""
    program = f"from benchmarks.bench_watch import timed; timed({runs})"
    environment = {**os.environ, "NUMBA_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}
    ran = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environment)
    wall, cpu = np.median(json.loads(ran.stdout.splitlines()[-1]), axis=0)
    most = 1e3 / REQUIRED_PER_S
    name = f"array to view, overlay and alarm, {threads} thread{'s' * (threads > 1)}"
    return Row(_GROUP, name, f"{wall:.0f} ms (CPU {cpu:.0f})", f"<= {most:.0f} ms", "", wall <= most)


def timed(runs: int) -> None:
    """Print wall and processor time, ms, of each image of a stream at rest, as JSON."""
    frame = sl.Frame.load("gamma")
    stream = SimulatedFluoroscopy(SEED, frame)
    analyser, times = LiveAnalyser(frame, stream.wire, ()), []
    for k in range(REST_FRAMES + 2 + runs):
        image = stream.still[k % len(stream.still)]
        shot = Shot(sl.Radiograph(image.pixels, image.white), k + 1, time.time())
        wall, cpu = time.perf_counter(), time.process_time()
        analyser.look(shot, time.monotonic(), k + 1, 0)
        times.append((1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)))
    print(json.dumps(times[REST_FRAMES + 2 :]))


def _sustained_rows(seconds: float) -> list[Row]:
    """Measure a source with 30 images per second through both threads."""
    stream = SimulatedFluoroscopy(SEED, sl.Frame.load("gamma"))
    latencies = []
    with Watch(sl.Frame.load("gamma"), stream, stream.wire) as watch:
        first = last = watch.next(0, 60.0)
        started = time.monotonic()
        while time.monotonic() - started < seconds:
            last = watch.next(last.number, 1.0) or last
            latencies.append(1e3 * last.latency_s)
    came, dropped = last.number - first.number, last.dropped - first.dropped
    per_s, late_ms = (came - dropped) / seconds, float(np.quantile(latencies, 0.95))
    value = f"{per_s:.1f} of {came / seconds:.1f} a second"
    latency = f"{np.median(latencies):.0f} / {late_ms:.0f} ms"
    stale_ms = 1e3 * STALE_S
    return [
        Row(
            _GROUP,
            "images calibrated, of those that came",
            value,
            f">= {REQUIRED_PER_S:.0f}",
            "",
            per_s >= REQUIRED_PER_S,
        ),
        Row(_GROUP, "age of an overlay, median / 95 %", latency, f"< {stale_ms:.0f} ms", "", late_ms < stale_ms),
    ]


def _alarm_rows(quick: bool) -> list[Row]:
    cases, images, set_ups = (100, HOUR // 10, 20) if quick else (1000, HOUR, 50)
    detected = in_parallel(_detected, [(seed, cases // set_ups) for seed in range(set_ups)])
    false = in_parallel(_false_alarms, [(seed, images // set_ups) for seed in range(1000, 1000 + set_ups)])
    share, sd_mm = (np.concatenate(values) for values in zip(*detected, strict=True))
    alarms, hours, largest = sum(count for count, _ in false), images / HOUR, max(shift for _, shift in false)
    rendered = [_is_rendered_right(seed) for seed in range(2 if quick else 6)]
    reported, noise = f"{100 * share.mean():.1f} %", f"{np.median(sd_mm):.3f} / {sd_mm.max():.3f} mm"
    shift = f"largest shift {largest:.3f} mm"
    right = f"{sum(rendered)} of {len(rendered)} right"
    still = "still without alarm, moved with the second image"
    return [
        Row(_ALARM, f"reported within two images, of {cases} cases", reported, ">= 99 %", "", share.mean() >= 0.99),
        Row(_ALARM, f"false alarms in {hours:g} h of images", f"{alarms}", f"<= {hours:g}", shift, alarms <= hours),
        Row(_ALARM, "noise at the target, 1 s.d., median / largest", noise),
        Row(_ALARM, "rendered sequences", right, "all", still, all(rendered)),
    ]


def _detected(job: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return for each case of a set-up whether the second image raised the alarm, and the noise, mm."""
    seed, cases = job
    rng = np.random.default_rng(seed)
    detected, sd_mm = [], []
    rest, truth, see = _at_rest(rng)
    for _ in range(cases):
        alarm, moved = Alarm(len(TARGETS_MM), "rest"), _moved(truth, rng)
        _, second = (alarm.update(rest.displacement(see(moved))) for _ in range(2))
        detected.append(second.moved and second.able)
        sd_mm.append(second.sd_mm)
    return np.array(detected), np.array(sd_mm)


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
    rotation = Rotation.from_rotvec(size * turn).as_matrix()
    detector = truth.detector
    turned = replace(
        detector,
        origin_mm=about + rotation @ (detector.origin_mm - about) + size * shift,
        axes=detector.axes @ rotation.T,
    )
    return replace(
        truth, focal_point_mm=about + rotation @ (truth.focal_point_mm - about) + size * shift, detector=turned
    )


def _is_rendered_right(seed: int) -> bool:
    """Return whether a rendered sequence is correct: no alarm at rest, an alarm at the second image after a shift."""
    frame, rng = sl.Frame.load("gamma"), np.random.default_rng(seed)
    setup, hip = shown_hip_scene(rng, frame)
    truth = setup.views[("pa", "lateral")[seed % 2]]
    turn = rng.uniform(0.0, 2 * np.pi)
    shift_mm = PROMISED_MM * np.array([np.cos(turn), np.sin(turn)]) @ truth.detector.axes
    still, after = (expose(view, hip.scene, DOSES["low"]) for view in (truth, shifted(truth, shift_mm)))
    analyser = LiveAnalyser(frame, None, ())
    images = [still.read_out(rng) for _ in range(REST_FRAMES + 2)] + [after.read_out(rng) for _ in range(2)]
    shots = [Shot(image, k + 1, time.time()) for k, image in enumerate(images)]
    moved = [analyser.look(shot, time.monotonic(), shot.number, 0).moved for shot in shots]
    return moved == [False] * (len(images) - 1) + [True]
