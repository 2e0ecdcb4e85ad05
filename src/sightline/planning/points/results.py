"""Results of planning: points in space, and a verdict."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sightline.calibration.bead_checks import handedness_check
from sightline.common.checks import Check, at_least, failed
from sightline.common.geometry.covariance import TWO_SIDED_999, ellipsoid_factor, length_quantile
from sightline.common.show import Plotted, Shown, checks_lines, counted, dataframe, numbers
from sightline.errors import ErrorUnknownError
from sightline.planning.points.gaps import Movement

if TYPE_CHECKING:
    from pandas import DataFrame

State = Literal["go", "no-go", "incomplete"]
# The sources of a point's error; their covariances add up to the total.
BUDGET = ("beads", "map", "focal_point", "frame", "picks")
# Correct pairs of picks exceed this many standard deviations as rarely as any limit (`gaps.CONFIDENCE`).
MAX_GAP_SIGMA = TWO_SIDED_999
# Minimum share of used beads among the eight nearest to a point: 0.88 or more in 20 undisturbed images of the twin,
# 0.62 or less in the middle of a strip of 16 dropped beads [twin]. A hidden bead counts half, since it neither confirms
# nor contradicts the map; so at least three of eight must be used [ours].
MIN_BEADS_NEAR = 0.7
_MAX_POINTS = 6  # of a summary


def error_unknown() -> ErrorUnknownError:
    """Return the exception for an error that is not known."""
    return ErrorUnknownError(
        "a view has no covariance, so the error of its points is unknown; "
        "calibrate both views from their beads, or give the matrix of a view with its covariance"
    )


@dataclass(frozen=True, eq=False, repr=False)
class SpacePoints(Plotted):
    """N points reconstructed from two or more views, CFCS. Look at `checks` before you use them.

    `xyz_mm` (N, 3). `method`: "weighted" or "nearest"; always "nearest" where a view's error is unknown.
    `joint_covariance_mm2` (3N, 3N), or None where a view's error is unknown: the points share focal points, maps and
    frame, so their errors are correlated. `budget_mm2`: the same for each source of BUDGET.

    `gap_mm` (N,): distance between the two lines of sight at their closest approach, of several views the largest.
    `gap_tested` (N,) bool: False where a pick was snapped to an image-matching curve, so that the gap has no meaning.
    `gap_sigma` (N,), masked where not tested: gap over its own standard deviation; for a point seen in V > 2 views the
    standard deviations that are exceeded as rarely as the chi-square of its 2V - 3 redundant residuals. None where a
    view's error is unknown.

    `shift_mm`, `shift_sd_mm`: weighted mean of the tested points' signed gaps along the common normal of their lines of
    sight, and its standard deviation; a patient who moves between the views causes such a shift. None with more than
    two views. `movement`: what more than two views show of such shifts; None with two. `gap_chi2`: chi-square of all
    tested gaps, with as many degrees of freedom as tested points, or `movement.redundancy`. All are None where no point
    is tested or a view's error is unknown. `head_tested`: they include the gap of the drawn head.

    `inside_hull` (N,) bool: within the convex hull of the beads in every view that shows the point. `upright`: whether
    a view shows the frame file's beads not mirrored (`LinesOfSight.upright`); None where no view tells. `beads_near`:
    for each view of the frame the points' `LinesOfSight.beads_near`, (N, 3); -1 where it does not show a point.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> points = sl.reconstruct([pa, lateral], {"pa": [[704, 425]], "lateral": [[439, 358]]})
    >>> points.error_95_mm.round(1)
    array([0.5])
    """

    xyz_mm: np.ndarray
    gap_mm: np.ndarray
    gap_tested: np.ndarray
    gap_sigma: np.ma.MaskedArray | None
    joint_covariance_mm2: np.ndarray | None
    budget_mm2: dict[str, np.ndarray] | None
    inside_hull: np.ndarray
    method: str = "weighted"
    shift_mm: float | None = None
    shift_sd_mm: float | None = None
    gap_chi2: float | None = None
    upright: bool | None = None
    beads_near: dict[str, np.ndarray] | None = None
    movement: Movement | None = None
    head_tested: bool = False

    def __post_init__(self) -> None:
        arrays = [getattr(self, name) for name in ("xyz_mm", "gap_mm", "gap_tested", "inside_hull")]
        arrays += [self.gap_sigma, self.joint_covariance_mm2, *(self.budget_mm2 or {}).values()]
        for array in arrays:
            if array is not None:
                array.flags.writeable = False

    def summary(self) -> str:
        """Return place, error bound and gap of each point, of the first six where there are more."""
        lines = [f"{counted(len(self.xyz_mm), 'point')} in CFCS, method {self.method}"]
        errors, sigma = self.error_95_mm, self.gap_sigma
        for k, (point, gap_mm) in enumerate(zip(self.xyz_mm[:_MAX_POINTS], self.gap_mm, strict=False)):
            error = f"95 % error {errors[k]:.2f} mm" if np.isfinite(errors[k]) else "error unknown"
            apart = f", gap {gap_mm:.2f} mm" if self.gap_tested[k] else ", gap not tested"
            apart += f" ({np.ma.getdata(sigma)[k]:.1f} s.d.)" if sigma is not None and self.gap_tested[k] else ""
            lines.append(f"  {k + 1}: {numbers(point, 2)} mm, {error}{apart}")
        lines += [f"  ... and {len(self.xyz_mm) - _MAX_POINTS} more"] if len(self.xyz_mm) > _MAX_POINTS else []
        passed = not failed(self.checks)
        return "\n".join([*lines, f"  checks: {'all passed' if passed else 'some failed, see .checks'}"])

    @property
    def error_95_mm(self) -> np.ndarray:
        """(N,) with a probability of 95 % the point's error is smaller; NaN where `error_stated` is False."""
        bounds = np.full(len(self.xyz_mm), np.nan)
        if self.error_stated.any():
            bounds[self.error_stated] = length_quantile(self.covariance_mm2[self.error_stated])
        return bounds

    def to_dataframe(self) -> "DataFrame":
        """Return a row for each point: x_mm, y_mm, z_mm, error_95_mm, gap_mm, gap_sigma and inside_hull, with NaN where
        a number is not known. Needs pandas."""
        unknown = np.full(len(self.xyz_mm), np.nan)
        return dataframe(
            {
                **{f"{axis}_mm": self.xyz_mm[:, k] for k, axis in enumerate("xyz")},
                "error_95_mm": self.error_95_mm,
                "gap_mm": self.gap_mm,
                "gap_sigma": unknown if self.gap_sigma is None else np.ma.filled(self.gap_sigma, np.nan),
                "inside_hull": self.inside_hull,
            }
        )

    def _new_axes(self, figure: Any) -> Any:
        return figure.add_subplot(projection="3d")

    def _draw(self, ax: Any) -> None:
        self.draw_named(ax, [str(k + 1) for k in range(len(self.xyz_mm))], counted(len(self.xyz_mm), "point"))

    def draw_named(self, ax: Any, names: Sequence[str], title: str) -> None:
        """Draw the points on axes of three dimensions, each with its name and its error where all are stated."""
        from sightline.common import draw

        known = bool(self.error_stated.all()) and len(self.xyz_mm) > 0
        bounds = ellipsoid_factor(0.95, 3) ** 2 * self.covariance_mm2 if known else None
        draw.space(ax, self.xyz_mm, bounds, names, f"{title}, CFCS")

    def first(self, count: int) -> "SpacePoints":
        """Return the first `count` points with their covariance; shift and chi-square stay those of all points."""
        joint, budget, sigma = self.joint_covariance_mm2, self.budget_mm2, self.gap_sigma
        at = slice(3 * count)
        return replace(
            self,
            xyz_mm=self.xyz_mm[:count],
            gap_mm=self.gap_mm[:count],
            gap_tested=self.gap_tested[:count],
            gap_sigma=None if sigma is None else sigma[:count],
            joint_covariance_mm2=None if joint is None else joint[at, at],
            budget_mm2=None if budget is None else {source: c[at, at] for source, c in budget.items()},
            inside_hull=self.inside_hull[:count],
            beads_near=None if self.beads_near is None else {view: n[:count] for view, n in self.beads_near.items()},
        )

    @property
    def gap_failed(self) -> np.ndarray:
        """(N,) bool: the gap was tested and is larger than the errors of picks and views explain."""
        if self.gap_sigma is None:
            return np.zeros(len(self.xyz_mm), dtype=bool)
        return self.gap_tested & ~(np.ma.getdata(self.gap_sigma) <= MAX_GAP_SIGMA)

    @property
    def error_stated(self) -> np.ndarray:
        """(N,) bool: the covariance is known and the gap does not contradict it."""
        return ~self.gap_failed & (self.joint_covariance_mm2 is not None)

    @property
    def checks(self) -> tuple[Check, ...]:
        """The checks that the error is known, and that each tested gap agrees with it."""
        names = [f"point {k + 1}" for k in range(len(self.xyz_mm))]
        return (error_known(self), *self.frame_checks(), *self.bead_checks(names), *self.gap_checks(names))

    def bead_checks(self, names: Sequence[str]) -> tuple[Check, ...]:
        """Return the check that the beads near the points were used; none without a frame.

        `names`: of the points, for the sentence.
        """
        if not self.beads_near:
            return ()
        shares = {
            (view, name): (int(used), int(hidden), int(shown))
            for view, counts in self.beads_near.items()
            for name, (used, hidden, shown) in zip(names, counts, strict=True)
            if shown >= 0
        }
        return (_beads_near(shares),)

    def frame_checks(self) -> tuple[Check, ...]:
        """Return the check that the frame file is not the frame's mirror image: one upright image suffices."""
        return () if self.upright is None else (handedness_check(self.upright, None),)

    def gap_checks(self, names: Sequence[str]) -> tuple[Check, ...]:
        """Return a check for each point whose gap was tested; `names`: of the points, for the sentences."""
        if self.gap_sigma is None:
            return ()
        columns = names, self.gap_tested, self.gap_failed, np.ma.getdata(self.gap_sigma), self.gap_mm
        return tuple(
            _gap_check(name, bool(failed), float(sigma), gap)
            for name, tested, failed, sigma, gap in zip(*columns, strict=True)
            if tested
        )

    @property
    def covariance_mm2(self) -> np.ndarray:
        """(N, 3, 3) covariance of each point, mm². Raises ErrorUnknownError where a view has no covariance."""
        if self.joint_covariance_mm2 is None:
            raise error_unknown()
        n = len(self.xyz_mm)
        return np.einsum("iaib->iab", self.joint_covariance_mm2.reshape(n, 3, n, 3))


def error_known(points: SpacePoints) -> Check:
    """Return the check that both views state their error."""
    known = points.joint_covariance_mm2 is not None
    sentence = (
        "Both views state their error."
        if known
        else "Error unknown: a view states no covariance, so no point has a known error; calibrate both views from "
        "their beads, or give the matrix of a view with its covariance."
    )
    return Check("error known", known, None, None, "", sentence)


def _beads_near(counts: dict[tuple[str, str], tuple[int, int, int]]) -> Check:
    """Return the check of the worst point; `counts`: by view and point, the beads used, hidden and expected."""
    shares = {place: (used + hidden / 2) / max(shown, 1) for place, (used, hidden, shown) in counts.items()}
    view, name = min(shares, key=lambda place: shares[place])
    (used, hidden, shown), share = counts[view, name], shares[view, name]
    states = f"Of the {shown} beads that the {view} image should show nearest to {name}, {used} are used"
    states += f" and {hidden} hidden" if hidden else ""
    otherwise = (
        ": the calibration there is extrapolated from other beads. Look for torn rows, movement, metal over "
        "the beads, or too few pixels, and acquire the image again."
    )
    return at_least("beads near", share, MIN_BEADS_NEAR, "", states, otherwise=otherwise)


def _gap_check(name: str, failed: bool, sigma: float, gap_mm: float) -> Check:
    sentence = f"The lines of sight of {name} pass {gap_mm:.2f} mm apart, "
    times = max(sigma / MAX_GAP_SIGMA, 1.01)  # of a failure never rounded down to the limit
    sentence += (
        f"{times:.2f} times the limit: the picks show different points, the patient moved between the views, or a view "
        "is wrong; pick again."
        if failed
        else f"{sigma:.1f} standard deviations."
    )
    return Check("gap", not failed, sigma, MAX_GAP_SIGMA, "σ", sentence)


@dataclass(frozen=True, repr=False)
class Verdict(Shown):
    """GO only if every check passed; the decision is a person's."""

    checks: tuple[Check, ...]

    def summary(self) -> str:
        """Return GO, NO-GO or INCOMPLETE, and the checks that failed."""
        return "\n".join([f"Verdict: {self.state.upper()}", *checks_lines(self.checks, 6)])

    @property
    def go(self) -> bool:
        """True if every check passed."""
        return not failed(self.checks)

    @property
    def state(self) -> State:
        """ "go", "no-go", or "incomplete" where only checks with a missing input failed."""
        if self.go:
            return "go"
        return "incomplete" if all(check.missing for check in failed(self.checks)) else "no-go"

    def joined(self, other: "Verdict") -> "Verdict":
        """Return the verdict with another's checks added."""
        return Verdict(self.checks + other.checks)

    @property
    def unmade(self) -> tuple[Check, ...]:
        """The failed checks that could not be made because an input is missing."""
        return tuple(check for check in self.checks if check.missing)

    @property
    def missing(self) -> tuple[str, ...]:
        """The missing inputs, each as a sentence that says what to do."""
        return tuple(check.sentence for check in self.unmade)
