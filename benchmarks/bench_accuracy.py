"""Γ frame, image to 3-D: `smooth` against `localized`, a polynomial, OpenCV and the bound, on random set-ups.

Set-ups have four targets each, surrounded by the beads of both plates. Beads and targets are measured to 0.1 px.
The metric of a method is the largest error of the four targets, compared over the set-ups in which both methods give a
result (`localized` refuses targets whose containing triangle is a sliver).

`localized` is the paper's method, which reconstructs the point of closest approach. Rendered pairs are in `coverage`.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.harness import Rows, columns, rms, spread, trials
from sightline.frame import Frame
from sightline.studies.bound import bound
from sightline.studies.methods import errors
from sightline.studies.scenes import BEADS_20UM, EXACT, WHOLE, draw_scene

SETUPS = 100
BEAD_PX = 0.1
OPENCV = "OpenCV 14"
FRAMES = {
    "no frame errors": EXACT,
    "balls 0.02 mm": BEADS_20UM,
    "default tolerances of balls, plates and arms": WHOLE,
}
MIN_GAINS = {"no frame errors": {"localized": 8.0, OPENCV: 3.0}, "balls 0.02 mm": {"localized": 4.0, OPENCV: 3.0}}


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark."""
    rows, number = Rows("accuracy"), SETUPS // 10 if quick else SETUPS
    cases = [(frame, 0.1) for frame in FRAMES] + [("balls 0.02 mm", 0.5), ("balls 0.02 mm", 1.0)]
    for frame, pick_px in cases:
        each = columns(trials(partial(_errors, frame, pick_px), range(number)))
        largest = {name: values.max(axis=1) for name, values in each.items()}
        named = frame if pick_px == 0.1 else f"{frame}, picks of {pick_px} px"
        names = [name for name in largest if name != "smooth"]
        own, peers = _spread(largest["smooth"]), [f"{name} {_spread(largest[name])}" for name in names]
        rows.add(f"largest of four targets, median / 95 %, {named}", own, peer=", ".join(peers))
        for peer in (name for name in names if name != "bound"):
            both = np.isfinite(largest[peer]) & np.isfinite(largest["smooth"])
            gain, refused = np.median(largest[peer][both]) / np.median(largest["smooth"][both]), (~both).sum()
            least = MIN_GAINS.get(frame, {}).get(peer, -np.inf) if pick_px == 0.1 else -np.inf
            told = f"{peer} refuses {refused} of {number}"
            rows.number(f"smooth more accurate than {peer}, {named}", gain, ".1f", "times", least=least, peer=told)
        rows.number(f"rms (error / bound), {named}", rms(each["smooth"] / each["bound"]), most=1.25)
    return rows


def _spread(values: np.ndarray) -> str:
    return spread(values[np.isfinite(values)], "mm")


def _errors(frame: str, pick_px: float, seed: int) -> dict[str, np.ndarray]:
    """Return each method's errors at the four targets, mm, infinite where it refuses; and the bounds."""
    told = replace(Frame.load("gamma"), tolerances=FRAMES[frame])
    scene = draw_scene(np.random.default_rng(seed), told, BEAD_PX, targets=4)
    uv = scene.target_px + pick_px * np.random.default_rng([seed, 1]).standard_normal(scene.target_px.shape)
    mm = {}
    for name in ("smooth", "localized", *(("polynomial 5", OPENCV) if pick_px == 0.1 else ())):
        error = errors(scene, name, [(uv, pick_px)])[0]
        mm[name] = np.full(len(scene.target_mm), np.inf) if error is None else error
    seen = scene.seen(np.broadcast_to(pick_px**2 * np.eye(2), (2, 2, 2)))
    bounds = [bound(scene.setup, seen, target) for target in scene.target_mm]
    return mm | {"bound": np.sqrt(np.trace(bounds, axis1=1, axis2=2))}
