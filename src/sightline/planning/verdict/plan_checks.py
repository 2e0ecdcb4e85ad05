"""Go or no-go: the checks of a planned trajectory against limits."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from sightline.calibration.bead_view import BeadView
from sightline.calibration.lengths import ball_size_check
from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check, Limits, at_most, error_check
from sightline.common.geometry.covariance import ellipsoid_factor
from sightline.planning.points.gaps import CONFIDENCE, Movement
from sightline.planning.points.lines_of_sight import CACHED
from sightline.planning.points.results import MAX_GAP_SIGMA, SpacePoints, Verdict, error_known
from sightline.planning.points.trajectory import Trajectory

# A movement this many standard deviations beyond MAX_GAP_SIGMA is detected with 95 % probability (normal quantile).
_POWER_SIGMA = 1.645
# One point shows a shift of the bone; a second is needed to show a rotation [ours].
MIN_FREE_POINTS = 2
_POINTS = ("entry", "end")


def judge(
    trajectory: Trajectory,
    views: Sequence[CalibratedView],
    limits: Limits | None = None,
    seen: SpacePoints | None = None,
    landmarks: Sequence[str] = (),
) -> Verdict:
    """Return the verdict on drilling along a trajectory: the views' own checks, then the plan's.

    `seen`: entry, end and landmarks, in this order; without it there are no landmarks. `landmarks`: their names, for
    the sentences; by default they are numbered.
    """
    limits, seen = limits or Limits(), seen or trajectory.points
    checks = [check for view in views for check in _named(view)] + _ball_sizes(views)
    named = [f"the {name} point" for name in _POINTS]
    checks += [error_known(trajectory.points), *seen.frame_checks(), *trajectory.points.bead_checks(named)]
    if trajectory.error_stated:
        checks += _errors(trajectory, limits)
    if trajectory.points.joint_covariance_mm2 is not None:
        checks += [*_gaps(seen, landmarks), *_spread(seen), _movement(seen, [view.name for view in views])]
    checks.append(_inside_hull(trajectory, views))
    return Verdict(tuple(checks))


def _ball_sizes(views: Sequence[CalibratedView]) -> list[Check]:
    """Return the check of the frame file's scale by the balls of all images together."""
    sizes = [view.ball_size for view in views if isinstance(view, BeadView) and view.ball_size is not None]
    return [ball_size_check(sizes)] if len(sizes) > 1 else []


@lru_cache(maxsize=CACHED)
def _named(view: CalibratedView) -> tuple[Check, ...]:
    """Return a view's checks, with its name."""
    return tuple(check.of_view(view.name) for check in view.checks)


def _errors(trajectory: Trajectory, limits: Limits) -> list[Check]:
    direction_deg = float(np.rad2deg(trajectory.direction_error_95_rad))
    errors = (
        ("entry_mm", "entry error", "entry point", trajectory.entry_error_95_mm, limits.position_mm, "mm"),
        ("end_mm", "end error", "end point", trajectory.end_error_95_mm, limits.position_mm, "mm"),
        ("direction_rad", "direction error", "direction", direction_deg, float(np.rad2deg(limits.direction_rad)), "°"),
    )
    return [
        error_check(name, what, error_95, limit, unit, advice="" if error_95 <= limit else _advice(trajectory, key))
        for key, name, what, error_95, limit, unit in errors
    ]


def _advice(trajectory: Trajectory, key: str) -> str:
    """Return which source has the largest share of an error, in words."""
    budget = trajectory.budget_rms()
    largest = max(budget, key=lambda source: budget[source][key]).replace("_", " ")
    return f"the largest source is {largest}: reduce it first"


def _gaps(points: SpacePoints, landmarks: Sequence[str]) -> tuple[Check, ...]:
    """Return a check for each point whose gap can be tested; a pick snapped to a curve has none."""
    names = [f"the {name} point" for name in _POINTS]
    names += [f"the {name}" if name else f"landmark {k}" for k, name in enumerate(landmarks, 1)]
    names += [f"landmark {k + 1}" for k in range(len(landmarks), len(points.xyz_mm) - len(_POINTS))]
    return points.gap_checks(names)


def _spread(points: SpacePoints) -> list[Check]:
    """Return the check that the picks are as accurate as stated, from all free points and the head together."""
    count = int(points.gap_tested.sum())
    if points.gap_chi2 is None or count < MIN_FREE_POINTS:
        return []
    freedom = count + points.head_tested if points.movement is None else points.movement.redundancy
    limit = ellipsoid_factor(CONFIDENCE, freedom) ** 2
    times = float(np.sqrt(points.gap_chi2 / freedom))
    states = f"{_gaps_of(points)} together are {times:.1f} times what picks and views explain"
    otherwise = (
        "; the picks are less accurate than stated, or the patient moved: pick all points again, or state a "
        "larger error of the picks, which increases the plan's own error."
    )
    return [at_most("pick spread", points.gap_chi2, limit, "χ²", states, otherwise=otherwise)]


def _gaps_of(points: SpacePoints) -> str:
    """Return what shift and chi-square come from, in words."""
    return f"The gaps of {points.gap_tested.sum()} free points" + " and the head" * points.head_tested


def _movement(points: SpacePoints, views: Sequence[str]) -> Check:
    """Return the check that the bone did not move between the views, from the gaps of all free points."""
    free = int(points.gap_tested.sum())
    if points.movement is not None:
        return _movement_between(points.movement, free, views)
    if free < MIN_FREE_POINTS or points.shift_mm is None or points.shift_sd_mm is None:
        sentence = (
            f"A movement of the patient between the views is not tested: {free} point{' is' if free == 1 else 's are'} "
            f"picked freely in both views (a snapped pick has no gap); pick {MIN_FREE_POINTS} landmarks freely in both."
        )
        return Check("movement", False, None, MAX_GAP_SIGMA, "σ", sentence, missing=True)
    shift, sd = abs(points.shift_mm), points.shift_sd_mm
    passed = shift <= MAX_GAP_SIGMA * sd
    if passed:
        noticed = (MAX_GAP_SIGMA + _POWER_SIGMA) * sd
        sentence = (
            f"{_gaps_of(points)} show a shift of {shift:.2f} mm on average; a movement of "
            f"{noticed:.1f} mm along the common normal of the beams would be detected, one in their plane would not."
        )
    else:
        sentence = (
            f"The bone seems to have moved by {shift:.2f} mm along the common normal of the beams between the views; "
            "acquire one of the images again, with the patient fixed to the frame, or pick again."
        )
    return Check("movement", bool(passed), shift / sd, MAX_GAP_SIGMA, "σ", sentence)


def _movement_between(movement: Movement, free: int, views: Sequence[str]) -> Check:
    """Return the check that the bone did not move between three or more images, from the chi-square of its shifts."""
    images = len(views)
    limit = ellipsoid_factor(CONFIDENCE, 2 * images - 3) ** 2
    if movement.shown.min() < MIN_FREE_POINTS or movement.freedom < 2 * images - 3:
        sentence = (
            f"A movement of the patient between the {images} images is not tested completely: pick {MIN_FREE_POINTS} "
            "landmarks freely in all of them."
        )
        return Check("movement", False, None, limit, "χ²", sentence, missing=True)
    passed = movement.chi2 <= limit
    if passed:
        first, last = movement.noticed_mm[[0, -1], 1]
        sentence = (
            f"The lines of sight of {free} free points show no movement between the {images} images. After the first "
            f"image ({views[0]}) one of {first:.1f} mm across its beam would be detected, before the last image "
            f"({views[-1]}) one of {last:.1f} mm across its beam. A movement along the beam of the last image, before "
            "that image, would not be detected."
        )
    else:
        sentence = (
            f"The bone seems to have moved between the {images} images: the lines of sight of {free} free points "
            "disagree as after a shift. Acquire the images again, with the patient fixed to the frame, or pick again."
        )
    return Check("movement", passed, movement.chi2, limit, "χ²", sentence)


def _inside_hull(trajectory: Trajectory, views: Sequence[CalibratedView]) -> Check:
    """Return the check that entry and end lie within the beads' convex hull.

    For information only with `smooth`, whose stated error grows outside the convex hull.
    """
    outside = [name for name, inside in zip(_POINTS, trajectory.points.inside_hull, strict=True) if not inside]
    extrapolates = all(view.method == "smooth" for view in views)
    limit = len(_POINTS) if extrapolates else 0
    if not outside:
        sentence = "Entry and end point lie within the beads' convex hull in all images."
    else:
        sentence = f"Outside the beads' convex hull in an image: {' and '.join(outside)} point; "
        sentence += (
            "the stated error allows for it."
            if extrapolates
            else "this method's stated error is too small there: use the method 'smooth', or place the frame so that "
            "its beads surround the target."
        )
    return Check("plan inside hull", len(outside) <= limit, float(len(outside)), float(limit), "points", sentence)
