"""Watching a live image: time per frame against a blob detector on the same frames, latency, and the movement alarm.

Frames are the twin's fluoroscopy (lowest dose, 1024²). The programs alternate frame by frame, so that load on the
machine affects all equally. The alarm is tested on points: random set-ups whose beads have the noise of that dose, and
a C-arm that translates and rotates so that the target's line of sight moves by just the promised limit. A few rendered
sequences are tested too.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import sightline as sl
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.calibration.displacement import Rest
from sightline.case.watch.alarm import HOUR, PROMISED_MM, Alarm
from sightline.case.watch.analyser import REST_FRAMES, LiveAnalyser
from sightline.case.watch.follow import Follower
from sightline.case.watch.live import Watch
from sightline.detection import Observations
from sightline.planning.points.line_residuals import LineResiduals
from sightline.rehearsal.stream import IMAGES_PER_S, Shot, SimulatedFluoroscopy, shifted
from sightline.twin import DOSES, ViewTruth, bead_images, draw_setup, shown_hip_scene
from sightline.twin.render import expose

REQUIRED_TRACKING_MS, REQUIRED_COLD_MS, REQUIRED_LATENCY_MS, REQUIRED_APART_MM, REQUIRED_COVARIANCE = (
    6.0,
    100.0,
    100.0,
    0.01,
    0.05,
)
TWO_VIEWS_PER_S = 60.0  # images of each of two live views that two cores must keep up with
SEED = 3
NOISE_PX = 0.12  # of a bead at the lowest dose, median of the twin's beads
TARGETS_MM = np.array([[-20.0, 11.0, -10.0], [22.0, -15.0, 13.0]])
_GROUP = "watching, 1024² at 30/s"
_ALARM = f"movement alarm, {PROMISED_MM} mm at the target"


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    times = {threads: _timed(threads, 20 if quick else 90) for threads in (2, 1)}
    two = times[2]
    whole = "array to calibrated view"
    rows = [_time_row(f"{whole}, tracking, two cores", two, "tracking", REQUIRED_TRACKING_MS)]
    rows.append(_time_row(f"{whole}, cold, two cores", two, "cold", REQUIRED_COLD_MS))
    rows.append(_time_row("tracking with overlay and alarm, two cores", two, "all"))
    rows.append(_time_row("tracking, one core", times[1], "tracking", REQUIRED_TRACKING_MS))
    rows += [_time_row(f"{name}, one core", times[1], name) for name in ("cold", "all")]
    rows.append(_sustained_cpu_row(times[1]["live"]))
    blobs = two["blobs"]["wall_ms"]
    rows.append(Row(_GROUP, "SimpleBlobDetector, blobs only", f"{blobs:.1f} ms", "", "the peer itself"))
    ratio = two["tracking"]["wall_ms"] / blobs
    rows.append(Row(_GROUP, "tracking over SimpleBlobDetector", f"{ratio:.2f}", "<= 1", "blobs only", ratio <= 1))
    return rows + _agreement_rows(quick) + _sustained_rows(quick) + _alarm_rows(quick)


def _time_row(name: str, times: dict[str, dict[str, float]], which: str, required_ms: float | None = None) -> Row:
    one = times[which]
    value = f"{one['wall_ms']:.1f} ms (best {one['best_ms']:.1f}, CPU {one['cpu_ms']:.1f})"
    required = "" if required_ms is None else f"<= {required_ms:.0f} ms"
    peer = f"SimpleBlobDetector {times['blobs']['wall_ms']:.1f} ms"
    return Row(_GROUP, name, value, required, peer, None if required_ms is None else one["wall_ms"] <= required_ms)


def _sustained_cpu_row(live: dict[str, float]) -> Row:
    """Return the row of the processor time of all images of a view, with their searches for new beads."""
    most = 1e3 / TWO_VIEWS_PER_S
    return Row(
        _GROUP,
        f"overlay and alarm, all images of a view at {TWO_VIEWS_PER_S:.0f} a second, processor time, mean",
        f"{live['mean_ms']:.1f} ms (longest {live['longest_ms']:.0f})",
        f"<= {most:.1f} ms: a view for each core",
        "",
        live["mean_ms"] <= most,
    )


def _timed(threads: int, runs: int) -> dict[str, dict[str, float]]:
    """Return times of a separate process, because the number of threads is fixed when the kernels are loaded."""
    program = f"from benchmarks.bench_watch import timed; timed({runs})"
    environment = {**os.environ, "NUMBA_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}
    ran = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environment)
    return json.loads(ran.stdout.splitlines()[-1])


def timed(runs: int) -> None:
    """Print times per frame as JSON: tracking, cold, with overlay and alarm, a blob detector, in alternation."""
    frame = sl.Frame.load("gamma")
    stream = SimulatedFluoroscopy(SEED, frame)
    analyser, follower = LiveAnalyser(frame, stream.wire, ()), Follower(frame)
    detector = cv2.SimpleBlobDetector.create(_blob_options())
    grey = [cv2.convertScaleAbs(one.pixels, alpha=255.0 / float(one.pixels.max())) for one in stream.still]
    programs: dict[str, Callable[[int], object]] = {
        "tracking": lambda k: follower.update(_shot(stream, k).image, k / IMAGES_PER_S),
        "cold": lambda k: Follower(frame).update(_shot(stream, k).image, time.time()),
        "all": lambda k: analyser.look(_shot(stream, k, k / IMAGES_PER_S), time.monotonic(), k + 1, 0),
        "blobs": lambda k: detector.detect(grey[k % len(grey)]),
    }
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in programs}
    for k in range(REST_FRAMES + 2 + runs):
        for name, program in programs.items():
            wall, cpu = time.perf_counter(), time.process_time()
            program(k)
            if k >= REST_FRAMES + 2:
                taken[name].append((1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)))
    out = {}
    for name, values in taken.items():
        wall, cpu = np.array(values).T
        out[name] = {"wall_ms": np.median(wall), "best_ms": wall.min(), "cpu_ms": np.median(cpu)}
    out["live"] = _live(stream, frame, 2 * runs)
    print(json.dumps(out))


def _live(stream: SimulatedFluoroscopy, frame: sl.Frame, runs: int) -> dict[str, float]:
    """Return the processor time of every image of a stream, stamped TWO_VIEWS_PER_S a second, once it is at rest."""
    analyser, taken = LiveAnalyser(frame, stream.wire, ()), []
    for k in range(REST_FRAMES + 2 + runs):
        shot, started = _shot(stream, k, k / TWO_VIEWS_PER_S), time.process_time()
        analyser.look(shot, time.monotonic(), k + 1, 0)
        taken.append(1e3 * (time.process_time() - started))
    after = taken[REST_FRAMES + 2 :]
    return {"mean_ms": float(np.mean(after)), "longest_ms": max(after)}


def _shot(stream: SimulatedFluoroscopy, k: int, stamped_s: float | None = None) -> Shot:
    images = stream.still
    at_s = time.time() if stamped_s is None else stamped_s
    return Shot(sl.Radiograph(images[k % len(images)].pixels, images[0].white), k + 1, at_s)


def _blob_options() -> cv2.SimpleBlobDetector.Params:
    """Return the coarsest and therefore fastest options of bench_speed's grid."""
    options = cv2.SimpleBlobDetector.Params()
    options.thresholdStep, options.minThreshold, options.maxThreshold = 20, 10, 220
    options.minRepeatability, options.minDistBetweenBlobs = 2, 5
    options.filterByArea, options.minArea, options.maxArea = True, 60, 1500
    options.filterByCircularity, options.minCircularity = True, 0.7
    options.filterByConvexity, options.minConvexity = True, 0.9
    options.filterByInertia = False
    return options


def _agreement_rows(quick: bool) -> list[Row]:
    """Compare tracked views with views of the same images calibrated independently."""
    frame = sl.Frame.load("gamma")
    apart, ratios = [], []
    for seed in range(SEED, SEED + (1 if quick else 3)):
        stream = SimulatedFluoroscopy(seed, frame)
        analyser = LiveAnalyser(frame, stream.wire, ())
        targets = np.stack([stream.wire.entry_mm, stream.wire.end_mm])
        for k in range(12):
            tracked = analyser.look(_shot(stream, k), time.monotonic(), k + 1, 0).view
            cold = LiveAnalyser(frame, None, ()).look(_shot(stream, k), time.monotonic(), 1, 0).view
            assert tracked is not None
            assert cold is not None
            uv = cold.project(targets)
            (warm_mm, warm), (cold_mm, alone) = (_at_targets(view, uv, targets) for view in (tracked, cold))
            apart.append(np.hypot(*(warm_mm - cold_mm).T).mean())
            ratios.append(np.abs(np.diag(warm) / np.diag(alone) - 1).max())
    mean, worst = float(np.mean(apart)), float(np.max(ratios))
    return [
        Row(
            _GROUP,
            "lines of sight at the target, tracked less cold, mean",
            f"{mean:.4f} mm",
            f"< {REQUIRED_APART_MM} mm",
            "",
            mean < REQUIRED_APART_MM,
        ),
        Row(
            _GROUP,
            "their variances, tracked over cold, worst",
            f"{100 * worst:.1f} % off",
            f"<= {100 * REQUIRED_COVARIANCE:.0f} %",
            "",
            worst <= REQUIRED_COVARIANCE,
        ),
    ]


def _at_targets(view: sl.CalibratedView, uv_px: np.ndarray, targets_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where lines of sight pass the targets, (N, 2) mm, and their covariance there."""
    lines = view.lines_of_sight(uv_px)
    at = LineResiduals.at(lines, targets_mm)
    whole = np.sum(list((lines.covariance or {}).values()), axis=0)
    return at.reach[:, None] * at.xy_mm, at.to_line @ whole @ at.to_line.T


def _sustained_rows(quick: bool) -> list[Row]:
    """Measure a source with 30 images per second through both threads."""
    frame, seconds = sl.Frame.load("gamma"), 3.0 if quick else 10.0
    stream = SimulatedFluoroscopy(SEED, frame)
    latencies, last = [], None
    with Watch(frame, stream, stream.wire) as watch:
        watch.next(0, 60.0)
        started = time.monotonic()
        first = last = watch.latest()
        while time.monotonic() - started < seconds:
            last = watch.next(last.number, 1.0) or last
            latencies.append(1e3 * last.latency_s)
    came, dropped = last.number - first.number, last.dropped - first.dropped
    late = float(np.quantile(latencies, 0.95))
    return [
        Row(
            _GROUP,
            "frames worked on, of those that came",
            f"{(came - dropped) / seconds:.1f} of {came / seconds:.1f} a second",
        ),
        Row(
            _GROUP,
            "latency from frame to overlay, median / 95 %",
            f"{np.median(latencies):.0f} / {late:.0f} ms",
            f"< {REQUIRED_LATENCY_MS:.0f} ms",
            "",
            late < REQUIRED_LATENCY_MS,
        ),
    ]


def _alarm_rows(quick: bool) -> list[Row]:
    cases, frames = (100, HOUR // 10) if quick else (1000, HOUR)
    set_ups = 20 if quick else 50
    found = in_parallel(_found, [(seed, cases // set_ups) for seed in range(set_ups)])
    false = in_parallel(_false, [(seed, frames // set_ups) for seed in range(1000, 1000 + set_ups)])
    share, hours = float(np.mean(np.concatenate([f for f, _ in found]))), frames / HOUR
    spread = np.concatenate([sd for _, sd in found])
    alarms, largest = sum(count for count, _ in false), max(size for _, size in false)
    rendered = [_rendered(seed) for seed in range(2 if quick else 6)]
    return [
        Row(
            _ALARM,
            f"reported within two images, of {cases} cases",
            f"{100 * share:.1f} %",
            ">= 99 %",
            "",
            share >= 0.99,
        ),
        Row(
            _ALARM,
            f"false alarms in {hours:g} h of images",
            f"{alarms}",
            f"<= {hours:g}",
            f"largest shift {largest:.3f} mm",
            alarms <= hours,
        ),
        Row(
            _ALARM, "noise at the target, 1 s.d., median / largest", f"{np.median(spread):.3f} / {spread.max():.3f} mm"
        ),
        Row(
            _ALARM,
            f"rendered sequences, of {len(rendered)}",
            f"{sum(rendered)} right",
            f"{len(rendered)}",
            "still without alarm, moved with the second image",
            all(rendered),
        ),
    ]


def _found(job: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return for each case of a set-up whether the second image raised the alarm, and the noise, mm."""
    seed, cases = job
    rng = np.random.default_rng(seed)
    found, spread = [], []
    rest, truth, see = _at_rest(rng)
    for _ in range(cases):
        alarm = Alarm(len(TARGETS_MM), "rest")
        moved = _moved(truth, rng)
        said = [alarm.update(rest.displacement(see(moved))) for _ in range(2)]
        found.append(said[-1].moved and said[-1].able)
        spread.append(said[-1].sd_mm)
    return np.array(found), np.array(spread)


def _false(job: tuple[int, int]) -> tuple[int, float]:
    """Return the number of alarms among images of a set-up at rest, reset after each, and the largest shift, mm."""
    seed, frames = job
    rest, truth, see = _at_rest(np.random.default_rng(seed))
    alarm, alarms, largest = Alarm(len(TARGETS_MM), "rest"), 0, 0.0
    for _ in range(frames):
        said = alarm.update(rest.displacement(see(truth)))
        largest = max(largest, said.shift_mm)
        if said.moved:
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


def _rendered(seed: int) -> bool:
    """Return whether a rendered sequence is correct: no alarm at rest, an alarm at the second image after a shift."""
    frame, rng = sl.Frame.load("gamma"), np.random.default_rng(seed)
    setup, hip = shown_hip_scene(rng, frame)
    truth = setup.views[("pa", "lateral")[seed % 2]]
    turn = rng.uniform(0.0, 2 * np.pi)
    moved = shifted(truth, PROMISED_MM * np.array([np.cos(turn), np.sin(turn)]) @ truth.detector.axes)
    still, after = (expose(one, hip.scene, DOSES["low"]) for one in (truth, moved))
    analyser = LiveAnalyser(frame, None, ())
    images = [still.read_out(rng) for _ in range(REST_FRAMES + 2)] + [after.read_out(rng) for _ in range(2)]
    said = [
        analyser.look(Shot(one, k + 1, time.time()), time.monotonic(), k + 1, 0).moved for k, one in enumerate(images)
    ]
    return said == [False] * (len(images) - 1) + [True]
