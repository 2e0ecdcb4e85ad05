"""The integration trial: 300 wires inserted by the robot into the bore of a plastic femur, as the paper's figure 15.

Each trial is one of the study `fig15`: two radiographs, beads, calibration, picks of 0.5 px, target, the real link, the
physics. Both methods get the same images, picks and robot.
"""

from typing import Any

import numpy as np

from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.studies.study_fig15 import LIMIT_DEG, LIMIT_MM, Figure15

TRIALS = 300
MEDIAN_MM, MEDIAN_DEG = 0.3, 0.2


def run(quick: bool) -> list[Row]:
    """The rows of this benchmark; `quick` inserts 12 wires."""
    trials = in_parallel(_trial, range(12 if quick else TRIALS))
    ours, theirs = (_figures(trials, method) for method in ("smooth", "localized"))
    n = len(trials)
    within = f"{ours['within']} of {n}"
    rows = [Row("insertion", f"within {LIMIT_MM:g} mm of the entry and {LIMIT_DEG}° of the bore", within, f"{n} of {n}",
                f"localized {theirs['within']} of {n}", ours["within"] == n)]  # fmt: skip
    for of, unit, limit in (("entry", "mm", MEDIAN_MM), ("angle", "°", MEDIAN_DEG), ("end", "mm", None)):
        asked = "" if limit is None else f"<= {limit} {unit}"
        met = None if limit is None else ours[of][0] <= limit
        rows.append(Row("insertion", f"{of}: error, median", f"{ours[of][0]:.3f} {unit}", asked,
                        f"localized {theirs[of][0]:.3f}", met))  # fmt: skip
        rows.append(
            Row("insertion", f"{of}: error, 95 %", f"{ours[of][1]:.3f} {unit}", "", f"localized {theirs[of][1]:.3f}")
        )
    rows.append(Row("insertion", "entry and end within their stated 95 % bounds", f"{ours['stated']:.1%}"))
    refused = f"{n - ours['drilled']} of {n}"
    rows.append(Row("insertion", "not drilled, with the reason", refused, "", f"localized {n - theirs['drilled']}"))
    return rows


def _trial(seed: int) -> dict[str, Any]:
    return Figure15().trial(np.random.default_rng([15, seed]))


def _figures(trials: list[dict[str, Any]], method: str) -> dict[str, Any]:
    kept = [trial[method] for trial in trials if method in trial and "refused" not in trial[method]]
    out: dict[str, Any] = {"drilled": len(kept)}
    out["within"] = sum(one["entry"] <= LIMIT_MM and one["angle"] <= LIMIT_DEG for one in kept)
    for of in ("entry", "end", "angle"):
        out[of] = np.quantile([one[of] for one in kept], [0.5, 0.95])
    hits = [one[of] <= one[f"stated_{of}"] for one in kept for of in ("entry", "end")]
    out["stated"] = float(np.mean(hits))
    return out
