"""Block from rendered images on a flat panel: errors over their stated values, and the time to a calibrated pair.

Set-ups are those of a rehearsal: a hip with the block beside it, whose whole ideal wire both images show. Entry and end
are picked to 0.1 px, as stated. Times are processor times of one process, block and Γ in turns on the same panel.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

import sightline as sl
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row, finished
from benchmarks.solid.scenes import PICK_PX, block, c_arms, centre_squares, pick_covariance, squares_of
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.detection import Observations
from sightline.errors import SightlineError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.twin import SetUp, render, shown_hip_scene
from sightline.twin.xray.presets import preset
from sightline.twin.xray.setup import Variation
from sightline.twin.xray.tubes import FlatPanel

SETUPS = 30
BALL_MM = 0.02
NORMALISED = (0.9, 1.15)
SIZES = (1024, 1536)
RUNS = 20
MAX_SLOWER = 1.2


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    number, runs = (SETUPS // 10, RUNS // 10) if quick else (SETUPS, RUNS)
    return _rows_of_errors(in_parallel(errors, range(number))) + [_row_of_times(size, runs) for size in SIZES]


def errors(seed: int) -> dict[str, np.ndarray] | str:
    """Return of one set-up the squared Mahalanobis lengths of the errors of `wire` (2,) and `balls` (N,), and the
    `error` (2,), mm; or the reason of a refusal."""
    rng = np.random.default_rng([13, 5, seed])
    frame = block(BALL_MM)
    setup, hip = shown_hip_scene(rng, frame)
    try:
        seen = []
        for name in setup.views:
            seen.append(sl.label(sl.detect(render(setup, name, hip.scene, rng)), frame, name))
        views = calibrate_together(seen, frame, c_arms(setup))
        uv = np.stack([view.project(hip.wire_mm) for view in setup.views.values()])
        found = sl.reconstruct(views, uv + PICK_PX * rng.standard_normal(uv.shape), pick_covariance(2, 2))
    except SightlineError as error:
        return str(error)
    off = found.xyz_mm - hip.wire_mm
    return {
        "wire": squares_of(off, found.covariance_mm2),
        "balls": np.concatenate([centre_squares(setup, one) for one in seen]),
        "error": np.linalg.norm(off, axis=1),
    }


def _rows_of_errors(trials: list[dict[str, np.ndarray] | str]) -> list[Row]:
    group = "solid, rendered images, block60, balls 0.02 mm"
    done, rows = finished(group, trials)
    if not done:
        return rows
    low, high = NORMALISED
    for name, number in (("wire", 3), ("balls", 2)):
        squares = np.concatenate([trial[name] for trial in done])
        value = float(np.sqrt(squares.mean() / number))
        what = {"wire": "entries and ends", "balls": "centres of balls"}[name]
        text, met = f"{value:.2f} of {len(squares)}", low <= value <= high
        rows.append(Row(group, f"{what}: rms normalised error per axis", text, f"{low}-{high}", "", met))
    within = np.stack([trial["wire"] for trial in done]) <= chi2.ppf(0.95, 3)
    each = np.stack([trial["error"] for trial in done])
    for k, name in enumerate(("entry", "end")):
        held = f"{within[:, k].sum()} of {len(done)} within the stated 95 % ellipsoid"
        value = f"{np.median(each[:, k]):.3f} / {each[:, k].max():.3f} mm"
        rows.append(Row(group, f"{name}: error, median / most", value, "", held))
    return rows


def _row_of_times(size: int, runs: int) -> Row:
    """Return the row of the times from two images of `size` squared to a calibrated pair."""
    panel = preset("flat-panel")
    chain = replace(panel, shape=(size, size), mask_px=panel.mask_px * size / panel.shape[0])
    pairs = [_rendered(frame, chain.name, FlatPanel(chain)) for frame in (block(BALL_MM), Frame.load("gamma"))]
    programs: list[Callable[[], object]] = [lambda: _solid_pair(*pairs[0]), lambda: _plates_pair(*pairs[1])]
    ms: list[list[float]] = [[], []]
    for _ in range(runs + 2):
        for program, taken in zip(programs, ms, strict=True):
            started = time.process_time()
            program()
            taken.append(1e3 * (time.process_time() - started))
    own, gamma = (float(np.median(taken[2:])) for taken in ms)  # two to warm up
    return Row(
        "solid, time",
        f"two images of {size}² to a calibrated pair, processor time, median",
        f"{own:.0f} ms, {own / gamma:.2f} of Γ",
        f"<= {MAX_SLOWER} of Γ",
        f"Γ {gamma:.0f} ms",
        own <= MAX_SLOWER * gamma,
    )


def _rendered(frame: Frame, chain: str, panel: FlatPanel) -> tuple[SetUp, list[Radiograph]]:
    rng = np.random.default_rng(1)
    setup, hip = shown_hip_scene(rng, frame, chain=chain, variation=Variation(tube=panel))
    return setup, [render(setup, name, hip.scene, rng) for name in setup.views]


def _labelled(setup: SetUp, images: list[Radiograph]) -> list[Observations]:
    return [sl.label(sl.detect(image), setup.frame, name) for image, name in zip(images, setup.views, strict=True)]


def _solid_pair(setup: SetUp, images: list[Radiograph]) -> object:
    return calibrate_together(_labelled(setup, images), setup.frame, c_arms(setup))


def _plates_pair(setup: SetUp, images: list[Radiograph]) -> object:
    arms = c_arms(setup)
    return [sl.calibrate(o, setup.frame, c_arm=a) for o, a in zip(_labelled(setup, images), arms, strict=True)]
