"""Estimate the accuracy of a wire with your frame: `python frame_accuracy.py [FRAME [SET_UPS]]`.

For each frame it draws set-ups of the digital twin, each with its own C-arm pose, distortion and frame errors. Both
ends of a 97 mm wire are picked, and their errors are compared with the stated 95 % bound. With a frame file, its
tolerances are used; without one, a table for those of docs/your-first-frame.md is printed.
"""

import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np

import sightline as sl
from sightline.detection import Observations
from sightline.frame import Frame, Tolerances
from sightline.studies.scenes import VIEWS, WIRE_ENDS_MM, draw_showing
from sightline.twin import SetUp, bead_images

BEAD_PX = 0.1
PICKS = {"careful clicks": 0.5, "located ends": 0.1}  # px, one standard deviation
# One standard deviation each, of ball, plate (shift, tilt) and arm (shift, tilt) [ours].
MADE_BY = {
    "printed, not measured": Tolerances(0.15, 0.3, 1.5e-3, 0.5, 3e-3),
    "printed, plates placed with a calliper": Tolerances(0.1, 0.1, 0.7e-3, 0.15, 1e-3),
    "workshop: milled bores, dowelled arms": Tolerances(),
    "measured by a CMM, 0.05 mm of drift": Tolerances(0.006, 0.05, 0.2e-3, 0.0, 0.0),
    "measured by a CMM, 0.01 mm of drift": Tolerances(0.006, 0.01, 0.04e-3, 0.0, 0.0),
}


def main(named: str = "", set_ups: str = "200") -> None:
    """Print error and bound of the ends of a wire, for one frame or for all of `MADE_BY`."""
    gamma = Frame.load("gamma")
    if named:
        frames = {named: Frame.load(named)}
    else:
        frames = {name: replace(gamma, tolerances=sd) for name, sd in MADE_BY.items()}
    print(f"{set_ups} set-ups each, mm: error (median, 95 %) and stated 95 % bound (median); share within the bound")
    for name, frame in frames.items():
        print(name)
        found = [ends_of(frame, np.random.default_rng([1, seed])) for seed in range(int(set_ups))]
        for what in PICKS:
            ends = np.array([one[what] for one in found if what in one])
            error, bound = ends[..., 0].ravel(), ends[..., 1].ravel()
            print(
                f"  {what:15s} error {np.median(error):.2f}, {np.quantile(error, 0.95):.2f}   bound "
                f"{np.median(bound):.2f}   within it {np.mean(error <= bound):.0%}   refused {len(found) - len(ends)}"
            )


def ends_of(frame: Frame, rng: np.random.Generator) -> dict[str, list[tuple[float, float]]]:
    """Return error and stated 95 % bound of entry and end, mm, for each kind of pick that was not refused."""
    setup = draw_showing(rng, frame, WIRE_ENDS_MM)
    views = [sl.calibrate(seen(setup, name, rng), frame) for name in VIEWS]
    pixels = np.array([setup.views[name].project(WIRE_ENDS_MM) for name in VIEWS])
    noise = rng.standard_normal(pixels.shape)
    found = {}
    for what, sd_px in PICKS.items():
        picks = pixels + sd_px * noise
        wire = sl.plan(views, picks[:, 0], picks[:, 1], pick_sd_px=sd_px, procedure="free-wire").trajectory
        errors = np.linalg.norm([wire.entry_mm - WIRE_ENDS_MM[0], wire.end_mm - WIRE_ENDS_MM[1]], axis=1)
        with suppress(sl.SightlineError):  # no error is stated where the lines of sight do not intersect
            found[what] = list(zip(errors.tolist(), (wire.entry_error_95_mm, wire.end_error_95_mm), strict=True))
    return found


def seen(setup: SetUp, view: str, rng: np.random.Generator) -> Observations:
    """Return the beads of a view as measured: labelled, each with its covariance."""
    ids, uv_px = bead_images(setup, view, rng, BEAD_PX)
    return Observations(view, ids, uv_px, np.broadcast_to(BEAD_PX**2 * np.eye(2), (len(ids), 2, 2)))


if __name__ == "__main__":
    main(*sys.argv[1:])
