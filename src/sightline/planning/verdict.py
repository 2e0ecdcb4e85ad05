"""Go or no-go: the planned trajectory held against limits."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.checks import Check
from sightline.planning.results import Verdict
from sightline.planning.trajectory import Trajectory

# A gap of this many standard deviations happens once in a thousand honest pairs of picks [ours].
LARGEST_GAP_SIGMA = 3.29
_POINTS = ("entry", "end")


@dataclass(frozen=True)
class Limits:
    """What the predicted 95 % errors must stay below. Defaults: what the paper reached with its robot [paper]."""

    position_mm: float = 1.0
    direction_rad: float = float(np.deg2rad(0.6))


def judge(trajectory: Trajectory, views: Sequence[CalibratedView], limits: Limits | None = None) -> Verdict:
    """All that speaks for or against drilling along a trajectory: the views' own checks, then the plan's."""
    limits = limits or Limits()
    checks = [replace(check, sentence=f"{view.name}: {check.sentence}") for view in views for check in view.checks]
    checks.append(_error_known(trajectory))
    if trajectory.points.joint_covariance_mm2 is not None:
        checks += [*_errors(trajectory, limits), *_gaps(trajectory)]
    checks.append(_inside_hull(trajectory, views))
    return Verdict(tuple(checks))


def _error_known(trajectory: Trajectory) -> Check:
    known = trajectory.points.joint_covariance_mm2 is not None
    sentence = (
        "Both views state their error."
        if known
        else "Error unknown: a view states no covariance, so nothing can be said of the trajectory's error; "
        "calibrate both views from their beads, or give the matrix of a view with its covariance."
    )
    return Check("error known", known, None, None, "", sentence)


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


def _gaps(trajectory: Trajectory) -> list[Check]:
    """One check for each point whose gap can be tested: a pick snapped to a curve has none."""
    points = trajectory.points
    assert points.gap_sigma is not None  # noqa: S101 - asked only where the errors are known
    out = []
    for name, tested, sigma, gap in zip(_POINTS, points.gap_tested, points.gap_sigma, points.gap_mm, strict=True):
        if not tested:
            continue
        passed = bool(sigma <= LARGEST_GAP_SIGMA)
        sentence = (
            f"The two lines of sight of the {name} point pass {gap:.2f} mm apart, {sigma:.1f} standard deviations"
        )
        sentence += (
            "." if passed else "; the picks of the two images are not the same point, or a view is wrong: pick again."
        )
        out.append(Check("gap", passed, float(sigma), LARGEST_GAP_SIGMA, "σ", sentence))
    return out


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
