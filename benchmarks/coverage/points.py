"""Coverage of the stated error ellipsoids in independent set-ups, with one target each.

Each set-up has its own frame errors; every bead has its own, correctly stated covariance. Dose (bead noise), tolerances
and the way of picking are distributed evenly; targets lie inside and outside the beads' convex hulls. Each class of
tolerance has 2,000 set-ups, so that a share of 50 % has a s.d. of 1.1 %, well below the required ±3 %.
"""

from dataclasses import replace
from itertools import product

import numpy as np
from scipy.stats import chi2

from benchmarks.parallel import in_parallel
from benchmarks.rows import Row
from sightline.frame import Frame
from sightline.studies.coverage import PICKS, UNEVEN, outcome
from sightline.studies.scenes import FAR_MM, FRAMES, draw_scene
from sightline.studies.study import Values

SETUPS = 6000
DOSES = {"beads 0.05 px": 0.05, "beads 0.1 px": 0.1, "beads 0.3 px": 0.3}
CLASSES = tuple(product(DOSES, FRAMES, PICKS))
REQUIRED = {0.50: 0.03, 0.95: 0.02, 0.99: 0.02}
FIRST_SEED = 10_000  # different set-ups from bench_accuracy


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark."""
    number = SETUPS // 10 if quick else SETUPS
    drawn = in_parallel(trial, range(FIRST_SEED, FIRST_SEED + number))
    outcomes = [one for one in drawn if one is not None]
    groups = ["all", "inside the hull", "outside the hull", *DOSES, *FRAMES, *PICKS]
    rows = [row for group in groups for row in _rows(group, [came for groups, came in outcomes if group in groups])]
    return [*rows, Row("honesty, all", "targets refused", f"{number - len(outcomes)} of {number}")]


def trial(seed: int) -> tuple[tuple[str, ...], Values] | None:
    """Return the groups and the result of one set-up; None where the target is refused."""
    dose, frame, picks = CLASSES[seed % len(CLASSES)]
    told = replace(Frame.load("gamma"), tolerances=FRAMES[frame])
    rng = np.random.default_rng(seed)
    scene = draw_scene(rng, told, DOSES[dose], targets=1, reach_mm=FAR_MM, uneven=UNEVEN)
    came = outcome(scene, np.random.default_rng([seed, 1]).standard_normal((2, 2)), picks, "smooth")
    if came is None:
        return None
    return ("all", "inside the hull" if came["inside"] else "outside the hull", dose, frame, picks), came


def _rows(group: str, outcomes: list[Values]) -> list[Row]:
    name, n = f"honesty, {group}", len(outcomes)
    if n == 0:
        return [Row(name, "targets", "none", "some", "", False)]
    squares = np.array([o["square"] for o in outcomes])
    rows = []
    for stated, required in REQUIRED.items():
        share = float(np.mean(squares <= chi2.ppf(stated, 3)))
        scatter = np.sqrt(stated * (1 - stated) / n)
        rows.append(
            Row(
                name,
                f"the stated {stated:.0%} ellipsoid covers",
                f"{share:.1%} of {n} (scatter {scatter:.1%})",
                f"{stated:.0%} ± {required:.0%}",
                "",
                bool(abs(share - stated) <= required),
            )
        )
    volume = float(np.median([o["volume"] for o in outcomes]))
    required = "<= 1.5" if group == "all" else ""
    met = volume <= 1.5 if group == "all" else None
    return [*rows, Row(name, "median volume over the bound's", f"{volume:.2f}", required, "", met)]
