"""Go or no-go: the planned trajectory held against limits."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.checks import Check, Limits
from sightline.geometry.covariance import ellipsoid_factor
from sightline.planning.results import LARGEST_GAP_SIGMA, SpacePoints, Verdict, error_known
from sightline.planning.trajectory import Trajectory

# With this many standard deviations beyond LARGEST_GAP_SIGMA a movement is noticed 95 times in 100 (normal quantile).
_NOTICED_SIGMA = 1.645
# One point shows a shift of the bone; it takes another to show that it turned [ours].
LEAST_FREE_POINTS = 2
# Gaps of all free points together are larger once in a thousand honest plans [ours].
_SPREAD = 0.999
_POINTS = ("entry", "end")


def judge(
    trajectory: Trajectory,
    views: Sequence[CalibratedView],
    limits: Limits | None = None,
    seen: SpacePoints | None = None,
) -> Verdict:
    """All that speaks for or against drilling along a trajectory: the views' own checks, then the plan's.

    `seen`: entry, end and landmarks, in this order; without it there are no landmarks."""
    limits, seen = limits or Limits(), seen or trajectory.points
    checks = [replace(check, sentence=f"{view.name}: {check.sentence}") for view in views for check in view.checks]
    named = [f"the {name} point" for name in _POINTS]
    checks += [error_known(trajectory.points), *seen.frame_checks(), *trajectory.points.bead_checks(named)]
    if trajectory.error_stated:
        checks += _errors(trajectory, limits)
    if trajectory.points.joint_covariance_mm2 is not None:
        checks += [*_gaps(seen), *_spread(seen), _movement(seen)]
    checks.append(_inside_hull(trajectory, views))
    # A movement that was not looked for is not one that was found.
    return Verdict(tuple(checks), tuple(c for c in checks if c.name == "movement" and c.figure is None))


def _errors(trajectory: Trajectory, limits: Limits) -> list[Check]:
    direction_deg = float(np.rad2deg(trajectory.direction_error_95_rad))
    figures = (
        ("entry error", "entry point", trajectory.entry_error_95_mm, limits.position_mm, "mm"),
        ("end error", "end point", trajectory.end_error_95_mm, limits.position_mm, "mm"),
        ("direction error", "direction", direction_deg, float(np.rad2deg(limits.direction_rad)), "°"),
    )
    out = []
    for name, what, figure, limit, unit in figures:
        passed = figure <= limit
        sentence = f"With 95 % probability the {what} errs by less than {figure:.2f} {unit} (limit {limit:.2f} {unit})"
        sentence += (
            "." if passed else f"; the largest share is that of the {_largest(trajectory, name)}: reduce that first."
        )
        out.append(Check(name, passed, figure, limit, unit, sentence))
    return out


def _largest(trajectory: Trajectory, check: str) -> str:
    """The source with the largest share, in words."""
    key = {"entry error": "entry_mm", "end error": "end_mm", "direction error": "direction_rad"}[check]
    budget = trajectory.budget_rms()
    return max(budget, key=lambda source: budget[source][key]).replace("_", " ")


def _gaps(points: SpacePoints) -> tuple[Check, ...]:
    """One check for each point whose gap can be tested: a pick snapped to a curve has none."""
    names = [f"the {name} point" for name in _POINTS]
    names += [f"landmark {k + 1}" for k in range(len(points.xyz_mm) - len(names))]
    return points.gap_checks(names)


def _spread(points: SpacePoints) -> list[Check]:
    """Are the picks as sure as they are said to be? All free points together tell more than the gap of each."""
    count = int(points.gap_tested.sum())
    if points.gap_chi2 is None or count < LEAST_FREE_POINTS:
        return []
    limit = ellipsoid_factor(_SPREAD, count) ** 2
    passed = points.gap_chi2 <= limit
    times = float(np.sqrt(points.gap_chi2 / count))
    sentence = f"The gaps of {count} free points together are {times:.1f} times what picks and views explain"
    sentence += (
        "."
        if passed
        else "; the picks are less sure than they are said to be, or the patient moved: pick all points again, or "
        "state a larger error of the picks, with which the plan's own error grows."
    )
    return [Check("pick spread", passed, points.gap_chi2, limit, "χ²", sentence)]


def _movement(points: SpacePoints) -> Check:
    """Did the bone move between the views? Free points tell, as far as their lines of sight then miss each other."""
    free = int(points.gap_tested.sum())
    if free < LEAST_FREE_POINTS or points.shift_mm is None or points.shift_sd_mm is None:
        sentence = (
            f"Whether the patient moved between the views is not tested: {free} points are picked freely in both views "
            f"(a snapped pick has no gap); pick {LEAST_FREE_POINTS} landmarks freely in both, such as the centre of "
            "the femoral head and the lesser trochanter."
        )
        return Check("movement", False, None, LARGEST_GAP_SIGMA, "σ", sentence)
    shift, sd = abs(points.shift_mm), points.shift_sd_mm
    passed = shift <= LARGEST_GAP_SIGMA * sd
    if passed:
        noticed = (LARGEST_GAP_SIGMA + _NOTICED_SIGMA) * sd
        sentence = (
            f"The lines of sight of {free} free points pass {shift:.2f} mm apart in the mean; a movement of "
            f"{noticed:.1f} mm along the common normal of the beams would show, one in their plane would not."
        )
    else:
        sentence = (
            f"The bone seems to have moved by {shift:.2f} mm along the common normal of the beams between the views; "
            "take one of the images again, with the patient fixed to the frame, or pick again."
        )
    return Check("movement", bool(passed), shift / sd, LARGEST_GAP_SIGMA, "σ", sentence)


def _inside_hull(trajectory: Trajectory, views: Sequence[CalibratedView]) -> Check:
    """Outside the beads' hull only `smooth` knows how its error grows; there the figure is for information."""
    outside = [name for name, inside in zip(_POINTS, trajectory.points.inside_hull, strict=True) if not inside]
    extrapolates = all(view.method == "smooth" for view in views)
    limit = len(_POINTS) if extrapolates else 0
    if not outside:
        sentence = "Entry and end point lie within the beads' hull in both images."
    else:
        sentence = f"Outside the beads' hull in an image: {' and '.join(outside)} point; "
        sentence += (
            "the stated error allows for it."
            if extrapolates
            else "this method states no honest error there: use the method 'smooth', or place the frame so that its "
            "beads surround the target."
        )
    return Check("plan inside hull", len(outside) <= limit, float(len(outside)), float(limit), "points", sentence)
