"""Integration trial: the robot inserts wires into the bore of a plastic femur, as in the paper's figure 15.

Each trial is one of the study `fig15`: two radiographs, beads, calibration, picks of 0.5 px, target, the real link, the
physics. Both methods get the same images, picks and robot.
"""

from typing import Any

import numpy as np

from benchmarks.harness import Rows, spread, trials
from sightline.studies.rendered.fig15 import Figure15
from sightline.studies.scenes import PAPER_DEG, PAPER_MM

TRIALS = 60
MAX_MEDIAN_MM, MAX_MEDIAN_DEG = 0.3, 0.2


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark; `quick` inserts 12 wires."""
    rows, results = Rows("insertion"), trials(_trial, range(12 if quick else TRIALS))
    number, of = len(results), ("entry", "angle")
    planned = [[r[m] for r in results if "plan_entry" in r.get(m, {})] for m in ("smooth", "localized")]
    ours, theirs = ([each for each in method if "refused" not in each] for method in planned)
    good, beside = (sum(w["entry"] <= PAPER_MM and w["angle"] <= PAPER_DEG for w in some) for some in (ours, theirs))
    peer = f"localized {beside} of {number}, {number - len(theirs)} not drilled"
    worst = " and ".join(f"{max(w[key] for w in ours):.2f} {unit}" for key, unit in zip(of, ("mm", "°"), strict=True))
    name = f"within {PAPER_MM:g} mm of the entry and {PAPER_DEG}° of the bore (study fig15); largest error"
    value = f"{good} of {number}, {worst}; {number - len(ours)} not drilled"
    rows.add(name, value, "all", good == number, peer=peer)
    middle = [np.median([wire[key] for wire in ours]) for key in of]
    most = [np.quantile([wire[key] for wire in ours], 0.95) for key in of]
    plans = [[np.median([plan[f"plan_{key}"] for plan in method]) for key in of] for method in planned if method]
    peer = ", localized ".join(f"{mm:.3f} mm / {deg:.3f}°" for mm, deg in plans)
    value = "; ".join(f"{mm:.3f} mm / {deg:.3f}°" for mm, deg in (middle, most))
    met = middle[0] <= MAX_MEDIAN_MM and middle[1] <= MAX_MEDIAN_DEG
    asked = f"median {MAX_MEDIAN_MM} mm, {MAX_MEDIAN_DEG}°"
    rows.add(f"entry / direction, of the {len(ours)}: median; 95 %", value, asked, met, peer=f"the plans alone {peer}")
    rows.add("end: error, median / 95 %", spread([wire["end"] for wire in ours], "mm"))
    hits = np.mean([wire[key] <= wire[f"stated_{key}"] for wire in ours for key in ("entry", "end")])
    rows.number("entry and end within their stated 95 % bounds", 100 * hits, ".1f", "%")
    return rows


def _trial(seed: int) -> dict[str, Any]:
    return Figure15().trial(np.random.default_rng([15, seed]))
