"""Integration trial: the robot inserts 300 wires into the bore of a plastic femur, as in the paper's figure 15.

Each trial is one of the study `fig15`: two radiographs, beads, calibration, picks of 0.5 px, target, the real link, the
physics. Both methods get the same images, picks and robot.
"""

from typing import Any

import numpy as np

from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.studies.fig15 import LIMIT_DEG, LIMIT_MM, Figure15

TRIALS = 300
MEDIAN_MM, MEDIAN_DEG = 0.3, 0.2


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark; `quick` inserts 12 wires."""
    trials = in_parallel(_trial, range(12 if quick else TRIALS))
    n = len(trials)
    ours, theirs = (_drilled(trials, method) for method in ("smooth", "localized"))
    good, beside = (
        sum(one["entry"] <= LIMIT_MM and one["angle"] <= LIMIT_DEG for one in some) for some in (ours, theirs)
    )
    required = f"within {LIMIT_MM:g} mm of the entry and {LIMIT_DEG}° of the bore"
    rows = [Row("insertion", required, f"{good} of {n}", f"{n} of {n}", f"localized {beside} of {n}", good == n)]
    for of, unit, limit in (("entry", "mm", MEDIAN_MM), ("angle", "°", MEDIAN_DEG)):
        middle, most = _quantiles(ours, of)
        met = middle <= limit
        rows.append(Row("insertion", f"{of}: error, median", f"{middle:.3f} {unit}", f"<= {limit} {unit}", "", met))
        rows.append(Row("insertion", f"{of}: error, 95 %", f"{most:.3f} {unit}"))
        plans = [_quantiles(_planned(trials, method), f"plan_{of}")[0] for method in ("smooth", "localized")]
        value, peer = (f"{value:.3f} {unit}" for value in plans)
        rows.append(Row("insertion", f"{of}: error of the plan alone, median", value, "", f"localized {peer}"))
    middle, most = _quantiles(ours, "end")
    rows.append(Row("insertion", "end: error, median / 95 %", f"{middle:.3f} / {most:.3f} mm"))
    hits = [one[of] <= one[f"stated_{of}"] for one in ours for of in ("entry", "end")]
    rows.append(Row("insertion", "entry and end within their stated 95 % bounds", f"{np.mean(hits):.1%}"))
    refused = f"{n - len(ours)} of {n}"
    return [*rows, Row("insertion", "not drilled, with the reason", refused, "", f"localized {n - len(theirs)} of {n}")]


def _trial(seed: int) -> dict[str, Any]:
    return Figure15().trial(np.random.default_rng([15, seed]))


def _planned(trials: list[dict[str, Any]], method: str) -> list[dict[str, Any]]:
    return [trial[method] for trial in trials if "plan_entry" in trial.get(method, {})]


def _drilled(trials: list[dict[str, Any]], method: str) -> list[dict[str, Any]]:
    return [one for one in _planned(trials, method) if "refused" not in one]


def _quantiles(of_trials: list[dict[str, Any]], of: str) -> tuple[float, float]:
    """Return the median and the 95 % quantile; NaN without trials."""
    values = [one[of] for one in of_trials] or [np.nan]
    return float(np.median(values)), float(np.quantile(values, 0.95))
