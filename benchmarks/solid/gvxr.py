"""Block on a flat panel in images of another projector, gVirtualXray, beside the twin's images of the same set-ups.

Each image is detected, labelled, calibrated with the other and planned on, entry and end picked to 0.1 px. The bound
takes the covariances of the balls' centres as detection states them. Optional: `pip install gvxr`.
"""

from importlib.util import find_spec

import numpy as np

import sightline as sl
from benchmarks.gvxr_projector import image, parts_of
from benchmarks.parallel import in_parallel
from benchmarks.rows import Row, finished
from benchmarks.solid.bound import solid_bound
from benchmarks.solid.scenes import PICK_PX, block, c_arms, centre_squares
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.errors import SightlineError
from sightline.imaging import Radiograph
from sightline.studies.scenes import TargetScene
from sightline.twin import SetUp, render, shown_hip_scene

SETUPS = 20  # 40 images, beside the 60 of solid_images
BALL_MM = 0.02
MAX_RATIO = 1.15
TWIN, OTHER = "the twin", "gVirtualXray"

Trial = dict[str, dict[str, np.ndarray]]


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    group = "solid, images of another projector, block60, balls 0.02 mm"
    if find_spec("gvxrPython3") is None:
        return [Row(group, OTHER, "not installed", "", "pip install gvxr")]
    done, rows = finished(group, in_parallel(trial, range(1 if quick else SETUPS)))
    return rows + rows_of(group, done)


def trial(seed: int) -> Trial | str:
    """Return for each projector the errors of `wire` (2,), entry and end, mm, with their `bound` (2,), and of the
    `balls` (N,) the Mahalanobis lengths squared; or the reason of a refusal."""
    rng = np.random.default_rng([13, 7, seed])
    setup, hip = shown_hip_scene(rng, block(BALL_MM))
    parts = parts_of(setup.true_frame, hip.wire_mm)
    noise = PICK_PX * rng.standard_normal((2, 4, 2))
    points = np.concatenate([hip.wire_mm, [hip.lesser_mm, hip.head_mm]])
    images = {
        OTHER: {name: image(view, parts, rng) for name, view in setup.views.items()},
        TWIN: {name: render(setup, name, hip.scene, rng) for name in setup.views},
    }
    try:
        return {name: _planned(setup, one, points, noise) for name, one in images.items()}
    except SightlineError as refusal:
        return str(refusal)


def _planned(
    setup: SetUp, images: dict[str, Radiograph], points: np.ndarray, noise: np.ndarray
) -> dict[str, np.ndarray]:
    seen = {name: sl.label(sl.detect(one), setup.frame, name) for name, one in images.items()}
    scene = TargetScene.of(setup, seen, points)
    views = calibrate_together(list(seen.values()), setup.frame, c_arms(setup))
    uv = scene.target_px + noise
    made = sl.plan(views, uv[:, 0], uv[:, 1], pick_sd_px=PICK_PX, landmarks_uv_px=uv[:, 2:], kind="free-wire")
    wire = np.array([made.trajectory.entry_mm, made.trajectory.end_mm])
    data = scene.seen(np.broadcast_to(PICK_PX**2 * np.eye(2), (2, 2, 2)))
    return {
        "wire": np.linalg.norm(wire - points[:2], axis=1),
        "bound": np.array([np.sqrt(np.trace(solid_bound(setup, data, point))) for point in points[:2]]),
        "balls": np.concatenate([centre_squares(setup, one) for one in seen.values()]),
        "go": np.array([made.verdict.go]),
    }


def rows_of(group: str, done: list[Trial]) -> list[Row]:
    """Return the rows of finished set-ups, each with the twin's value beside it."""
    if not done:
        return []
    each = [{key: np.concatenate([one[name][key] for one in done]) for key in done[0][name]} for name in (OTHER, TWIN)]
    ratios = [_rms(one["wire"] / one["bound"]) for one in each]
    errors = [" / ".join(f"{_rms(one['wire'][k::2]):.3f}" for k in (0, 1)) for one in each]
    centres = [float(np.sqrt(one["balls"].mean() / 2)) for one in each]
    number, balls = f"of {2 * len(done)} entries and ends", len(each[0]["balls"])
    ratio = f"{ratios[0]:.2f}", f"<= {MAX_RATIO}", f"twin {ratios[1]:.2f}"
    go = [int(one["go"].sum()) for one in each]
    return [
        Row(group, f"error of the plan / bound, rms, {number}", *ratio, ratios[0] <= MAX_RATIO),
        Row(group, "error of entry / end, rms", f"{errors[0]} mm", "", f"twin {errors[1]} mm"),
        Row(group, f"centres of {balls} balls: rms normalised error per axis", f"{centres[0]:.2f}", "0.9-1.15",
            f"twin {centres[1]:.2f}", 0.9 <= centres[0] <= 1.15),
        Row(group, "plans that are GO", f"{go[0]} of {len(done)}", "", f"twin {go[1]}"),
    ]  # fmt: skip


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
