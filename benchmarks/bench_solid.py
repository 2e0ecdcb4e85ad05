"""Solids of balls beside Γ, OpenCV and the bound: points, images, and bad input.

Beads and picks have errors of 0.1 px. OpenCV is `calibrateCamera` with 0, 5 or 14 distortion parameters; with 0 it is
the bundle adjustment by which XMALab calibrates with its cube. A Γ frame of default tolerances stands in the same
beams, with the same errors of its picks. Coverage of the stated ellipsoids is by angle between the views, error of the
balls, and share of hidden balls. On an intensifier with a plate on its detector `block40` stands where a 9-inch field
shows it and a whole wire.

Images are those of a rehearsal: a hip with the block beside it, whose whole ideal wire both images show; the twin's,
and gVirtualXray's of the same set-ups (`pip install gvxr`). Each is detected, labelled, calibrated with the other and
planned on, entry and end picked to 0.1 px. Times are processor times of one process, block and Γ in turns.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from scipy.stats import chi2

import sightline as sl
from benchmarks import gvxr, solid_faults
from benchmarks.harness import Row, Rows, columns, finished, mahalanobis2, rms, times_ms, trials
from benchmarks.scenes.blocks import (
    BEAD_PX,
    PICK_PX,
    block,
    centre_squares,
    gamma_in,
    pick_covariance,
    solid_bound,
)
from sightline.detection import Observations
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.studies.methods import METHODS, REFUSALS
from sightline.studies.scenes import TargetScene, calibrated_views, draw_scene
from sightline.twin import SetUp, render, shown_hip_scene
from sightline.twin.xray.distributions import beam_at
from sightline.twin.xray.presets import preset
from sightline.twin.xray.setup import Variation
from sightline.twin.xray.tubes import FlatPanel

BALLS_MM = (0.02, 0.05, 0.1)
SETUPS, PLATE_SETUPS = 100, 100  # for each error of the balls; on an intensifier
MAX_RATIO, MAX_PLATE_RATIO, MAX_RMS_MM, MIN_GAIN, MIN_PLATE_GAIN = 1.15, 1.2, 0.056, 4.0, 3.0
OPENCV = ("OpenCV 0", "OpenCV 5", "OpenCV 14")
ON_PLATE = "block40+detector-plate"

COVERED = 2500  # set-ups
STRATA = tuple(product((30.0, 60.0, 90.0), BALLS_MM, (0.0, 0.2, 0.4)))  # angle between views, balls, share hidden
LIMITS = {0.50: 0.02, 0.95: 0.01, 0.99: 0.005}
FIRST_SEED = 20_000  # other set-ups than those of the errors

IMAGED, PLATES_IMAGED, CAST = 15, 6, 20  # set-ups with images of the twin; on an intensifier; of gVirtualXray
BLOCK_RANGE, PLATE_RANGE = (0.9, 1.15), (0.8, 1.2)  # of normalised errors
SIZES, RUNS, MAX_SLOWER = (1024, 1536), 20, 1.2


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    share = 10 if quick else 1
    return [
        *_errors(SETUPS // share),
        *_coverage(COVERED // share),
        *_images(IMAGED // share),
        *_cast(CAST // share),
        *_times(RUNS // share),
        *solid_faults.run(quick),
        *_on_plate(PLATE_SETUPS // share, PLATES_IMAGED // share),
    ]


def _errors(number: int) -> Rows:
    rows = Rows("solid")
    each = [columns(trials(partial(_error, "block60", ball), range(number))) for ball in BALLS_MM]
    own, bounds, gamma = ([rms(errors[name]) for errors in each] for name in ("block", "bound", "Γ"))
    ratios = [rms(errors["block"] / errors["bound"]) for errors in each]
    gains = np.divide(gamma, own)
    name = f"block60, target 80 mm away, balls 0.02 / 0.05 / 0.1 mm, {number} set-ups each: rms (error / bound)"
    rows.number(name, ratios, most=MAX_RATIO)
    rows.add("block60: error, rms", f"{_texts(own)} mm", f"<= {MAX_RMS_MM} mm at 0.02 mm", own[0] <= MAX_RMS_MM,
             peer=f"bound {_texts(bounds)} mm")  # fmt: skip
    name = "more accurate than Γ of default tolerances in the same beams, rms, points"
    value, peer = " / ".join(f"{gain:.1f}" for gain in gains), f"Γ {_texts(gamma)} mm"
    rows.add(name, f"{value} times", f">= {MIN_GAIN:g} at 0.02 mm", gains[0] >= MIN_GAIN, peer=peer)
    median = {
        name: [np.median(errors[name][np.isfinite(errors[name])]) for errors in each] for name in ("block", *OPENCV)
    }
    mine = median.pop("block")
    peer = ", ".join(f"{name} {_texts(values)}" for name, values in median.items())
    met = all(np.less(mine, theirs).all() for theirs in median.values())
    rows.add("error, median", f"{_texts(mine)} mm", "better", met, peer=f"{peer} mm")
    return rows


def _texts(values: Any) -> str:
    return " / ".join(f"{value:.3f}" for value in values)


def _error(frame: str, ball: float, seed: int) -> dict[str, float]:
    """Return the error, mm, of a target by each method, infinite where it refuses; the bound and the stated error; and
    the squared Mahalanobis length of the block's error."""
    known = block(ball, frame)
    rng = np.random.default_rng([seed, round(1000 * ball)] if frame == "block60" else [13, 7, seed])
    scene = draw_scene(rng, known, BEAD_PX, targets=1, reach_mm=0.0)
    beside = gamma_in(scene.setup, rng)
    noise, covariance = PICK_PX * rng.standard_normal((2, 1, 2)), pick_covariance(2, 1)
    uv, target = scene.target_px + noise, scene.target_mm[0]
    point = sl.reconstruct(calibrated_views(scene.setup, scene.observations), uv, covariance)
    gamma = sl.reconstruct(calibrated_views(beside.setup, beside.observations), beside.target_px + noise, covariance)
    mm = {
        "block": float(np.linalg.norm(point.xyz_mm - target)),
        "Γ": float(np.linalg.norm(gamma.xyz_mm)),
        "bound": float(np.sqrt(np.trace(solid_bound(scene.setup, scene.seen(covariance[:, 0]), target)))),
        "stated": float(np.sqrt(np.trace(point.covariance_mm2[0]))),
        "square": float(mahalanobis2(point.xyz_mm[0] - target, point.covariance_mm2[0])),
    }
    if frame == "block60":
        for name in OPENCV:
            try:
                xyz = METHODS[name](scene)(uv, PICK_PX)
                mm[name] = float(np.linalg.norm(xyz - target))
            except REFUSALS:
                mm[name] = np.inf
    return mm


def _coverage(number: int) -> Rows:
    rows, (kept, refused) = Rows("solid"), finished(trials(_covered, range(FIRST_SEED, FIRST_SEED + number)))
    rows.covers(f"coverage, {refused} refused", [square for square, _ in kept], LIMITS)
    for name in sorted({name for _, strata in kept for name in strata}):
        squares = [square for square, strata in kept if name in strata]
        limits = {p: 0.01 + 3 * np.sqrt(p * (1 - p) / len(squares)) for p in LIMITS}
        rows.covers(f"coverage, {name}", squares, limits)
    return rows


def _covered(seed: int) -> tuple[float, tuple[str, ...]]:
    """Return the squared Mahalanobis length of the error of one target, and the strata of its set-up."""
    angle, ball, hidden = STRATA[seed % len(STRATA)]
    rng = np.random.default_rng(seed)
    views = {"pa": beam_at(0.0), "lateral": beam_at(np.radians(angle))}
    scene = draw_scene(rng, block(ball), BEAD_PX, targets=1, views=views)
    seen = {name: _fewer(rng, beads, hidden) for name, beads in scene.observations.items()}
    uv = scene.target_px + PICK_PX * rng.standard_normal(scene.target_px.shape)
    point = sl.reconstruct(calibrated_views(scene.setup, seen), uv, pick_covariance(2, 1))
    strata = (f"views {angle:g}° apart", f"balls {ball:g} mm", f"{hidden:.0%} of the balls hidden")
    return float(mahalanobis2(point.xyz_mm[0] - scene.target_mm[0], point.covariance_mm2[0])), strata


def _fewer(rng: np.random.Generator, seen: Observations, hidden: float) -> Observations:
    """Return the observations of one image with a share of the balls hidden at random."""
    assert seen.covariance_px2 is not None
    kept = np.sort(rng.permutation(len(seen))[round(hidden * len(seen)) :])
    ids = tuple(seen.ids[k] for k in kept)
    return replace(seen, ids=ids, uv_px=seen.uv_px[kept], covariance_px2=seen.covariance_px2[kept])


def _labelled(setup: SetUp, images: dict[str, Radiograph]) -> dict[str, Observations]:
    return {name: sl.label(sl.detect(image), setup.frame, name) for name, image in images.items()}


def _located(frame: str, stream: int, seed: int) -> dict[str, Any]:
    """Return of a rehearsal's images the errors (2,), mm, of entry and end, and the squared Mahalanobis lengths of
    these and of the centres of the balls; how many balls each image has, and whether a check failed."""
    rng = np.random.default_rng([13, stream, seed])
    setup, hip = shown_hip_scene(rng, block(0.02, frame))
    seen = _labelled(setup, {name: render(setup, name, hip.scene, rng) for name in setup.views})
    views = calibrated_views(setup, seen)
    uv = np.stack([view.project(hip.wire_mm) for view in setup.views.values()])
    points = sl.reconstruct(views, uv + PICK_PX * rng.standard_normal(uv.shape), pick_covariance(2, 2))
    off = points.xyz_mm - hip.wire_mm
    own = [sum(name in setup.frame.xyz_mm_by_id for name in beads.ids) for beads in seen.values()]
    centres = [] if setup.frame.detector is not None else [centre_squares(setup, beads) for beads in seen.values()]
    return {
        "error": np.linalg.norm(off, axis=1),
        "wire": mahalanobis2(off, points.covariance_mm2),
        "balls": np.concatenate([np.zeros(0), *centres]),
        "labelled": min(own),
        "failed": any(not check.passed for view in views for check in view.checks),
    }


def _add_located(rows: Rows, done: list[dict[str, Any]], limits: tuple[float, float], name: str) -> None:
    error, wire = (np.stack([each[key] for each in done]) for key in ("error", "wire"))
    values = [rms(np.sqrt(wire / 3))]
    balls = np.concatenate([each["balls"] for each in done])
    if len(balls):
        values.append(rms(np.sqrt(balls / 2)))
    what = f"{wire.size} entries and ends" + (f" / {len(balls)} centres of balls" if len(balls) else "")
    rows.number(f"{name}: normalised error per axis, rms, of {what}", values, ".2f", least=limits[0], most=limits[1])
    value = " / ".join(f"{np.median(mm):.3f} ({mm.max():.3f})" for mm in error.T)
    entries, ends = (wire <= chi2.ppf(0.95, 3)).sum(axis=0)
    peer = f"within the stated 95 %: {entries} and {ends} of {len(done)}"
    rows.add("the same: error of entry / end, median (most)", f"{value} mm", peer=peer)


def _images(number: int) -> Rows:
    rows, (done, refused) = Rows("solid"), finished(trials(partial(_located, "block60", 5), range(number)))
    if done:
        _add_located(rows, done, BLOCK_RANGE, f"rendered images, {refused} refused")
    return rows


def _on_plate(number: int, imaged: int) -> Rows:
    rows, each = Rows("solid, intensifier"), columns(trials(partial(_error, ON_PLATE, 0.02), range(number)))
    name = f"{ON_PLATE} on 9in-1k, target 51 mm away, balls 0.02 mm, {number} set-ups: rms of error / bound"
    rows.number(name, rms(each["block"] / each["bound"]), most=MAX_PLATE_RATIO)
    own, gamma = rms(each["block"]), rms(each["Γ"])
    rows.number("error, rms", own, unit="mm",
                peer=f"bound {rms(each['bound']):.3f}, stated {rms(each['stated']):.3f} mm")  # fmt: skip
    name = "more accurate than Γ of default tolerances in the same beams, rms, points"
    rows.number(name, gamma / own, ".1f", "times", least=MIN_PLATE_GAIN, peer=f"Γ {gamma:.3f} mm")
    rows.covers("points", each["square"], {p: 0.005 + 3 * np.sqrt(p * (1 - p) / number) for p in LIMITS})
    done, refused = finished(trials(partial(_located, ON_PLATE, 8), range(imaged)))
    if done:
        _add_located(rows, done, PLATE_RANGE, f"rendered images, {refused} refused")
        rows.add("rendered images: balls labelled, fewest of 83", str(min(each["labelled"] for each in done)))
        rows.none("pairs with a failed check", sum(each["failed"] for each in done), str(len(done)))
    return rows


def _cast(number: int) -> Rows:
    rows = Rows("solid")
    if not gvxr.INSTALLED:
        rows.add("images of another projector, gVirtualXray", "not installed", peer="pip install gvxr")
        return rows
    done, refused = finished(trials(_planned_on_both, range(max(number, 1))))
    if not done:
        return rows
    other, twin = ({key: np.concatenate([d[k][key] for d in done]) for key in done[0][k]} for k in (0, 1))
    name = f"images of another projector, gVirtualXray, {len(done)} set-ups, {refused} refused: rms of error / bound"
    ratio, beside = (rms(each["wire"] / each["bound"]) for each in (other, twin))
    rows.number(name, ratio, ".2f", most=MAX_RATIO, peer=f"the twin's images of the same set-ups {beside:.2f}")
    own, beside = ([rms(each["wire"][k::2]) for k in (0, 1)] for each in (other, twin))
    rows.number("the same: error of entry / end, rms", own, unit="mm", peer=f"twin {_texts(beside)} mm")
    own, beside = (rms(np.sqrt(each["balls"] / 2)) for each in (other, twin))
    name, (low, high) = f"the same: centres of {len(other['balls'])} balls, normalised error per axis, rms", BLOCK_RANGE
    rows.number(name, own, ".2f", least=low, most=high, peer=f"twin {beside:.2f} of {len(twin['balls'])}")
    return rows


def _planned_on_both(seed: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return for images of gVirtualXray and of the twin the errors of entry and end, mm, with their bounds, and the
    squared Mahalanobis lengths of those of the balls."""
    rng = np.random.default_rng([13, 7, seed])
    setup, hip = shown_hip_scene(rng, block(0.02))
    parts = gvxr.hip_parts(setup.true_frame, hip.wire_mm)
    noise = PICK_PX * rng.standard_normal((2, 4, 2))
    points = np.concatenate([hip.wire_mm, [hip.lesser_mm, hip.head_mm]])
    cast = {name: gvxr.panel_image(view, parts, rng) for name, view in setup.views.items()}
    rendered = {name: render(setup, name, hip.scene, rng) for name in setup.views}
    return _planned(setup, cast, points, noise), _planned(setup, rendered, points, noise)


def _planned(
    setup: SetUp, images: dict[str, Radiograph], points: np.ndarray, noise: np.ndarray
) -> dict[str, np.ndarray]:
    seen = _labelled(setup, images)
    scene = TargetScene.of(setup, seen, points)
    views, uv = calibrated_views(setup, seen), scene.target_px + noise
    made = sl.plan(views, uv[:, 0], uv[:, 1], pick_sd_px=PICK_PX, landmarks_uv_px=uv[:, 2:], procedure="free-wire")
    wire, data = np.array([made.trajectory.entry_mm, made.trajectory.end_mm]), scene.seen(pick_covariance(2, 1)[:, 0])
    return {
        "wire": np.linalg.norm(wire - points[:2], axis=1),
        "bound": np.array([np.sqrt(np.trace(solid_bound(setup, data, point))) for point in points[:2]]),
        "balls": np.concatenate([centre_squares(setup, beads) for beads in seen.values()]),
    }


def _times(runs: int) -> Rows:
    """Return the times from two images to a calibrated pair, of block and Γ in turns."""
    rows, panel, own, gamma = Rows("solid"), preset("flat-panel"), [], []
    for size in SIZES:
        chain = replace(panel, shape=(size, size), mask_px=panel.mask_px * size / panel.shape[0])
        programs: dict[str, Callable[[], object]] = {}
        for name, frame in (("block", block(0.02)), ("Γ", Frame.load("gamma"))):
            rng = np.random.default_rng(1)
            setup, hip = shown_hip_scene(rng, frame, chain=chain.name, variation=Variation(tube=FlatPanel(chain)))
            images = {name: render(setup, name, hip.scene, rng) for name in setup.views}
            programs[name] = partial(_calibrated_pair, setup, images)
        taken = times_ms(programs, runs, time.process_time)
        own.append(float(np.median(taken["block"])))
        gamma.append(float(np.median(taken["Γ"])))
    name = f"two images of {' / '.join(f'{size}²' for size in SIZES)} to a calibrated pair, processor time, {runs} runs"
    shares = np.divide(own, gamma)
    value = f"{own[0]:.0f} / {own[1]:.0f} ms, {shares[0]:.2f} / {shares[1]:.2f} of Γ"
    peer = f"Γ on the same panel {gamma[0]:.0f} / {gamma[1]:.0f} ms"
    rows.add(name, value, f"<= {MAX_SLOWER} of Γ", shares.max() <= MAX_SLOWER, peer=peer)
    return rows


def _calibrated_pair(setup: SetUp, images: dict[str, Radiograph]) -> object:
    return calibrated_views(setup, _labelled(setup, images))
