"""What planning hands on: points in space, and a verdict."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sightline.calibration.checks import handedness_check
from sightline.checks import Check, failed
from sightline.errors import ErrorUnknownError
from sightline.geometry.covariance import TWO_SIDED_999

State = Literal["go", "no-go", "incomplete"]
# Where the error of a point comes from; their covariances add up to the whole.
BUDGET = ("beads", "map", "focal_point", "frame", "picks")
# A gap of this many standard deviations happens once in a thousand honest pairs of picks [ours].
LARGEST_GAP_SIGMA = TWO_SIDED_999
# Share of the eight beads about a point that its view must rest on: in 20 whole images of the twin 0.88 or more, in the
# middle of a strip of 16 dropped beads 0.62 or less [twin]. A hidden bead counts half: nothing contradicts the map
# there, and nothing confirms it; so three of eight must be used [ours].
LEAST_BEADS_NEAR = 0.7


def error_unknown() -> ErrorUnknownError:
    """What is raised where an error is asked for that nobody knows."""
    return ErrorUnknownError(
        "a view has no covariance, so the error of its points is unknown; "
        "calibrate both views from their beads, or give the matrix of a view with its covariance"
    )


@dataclass(frozen=True, eq=False)
class SpacePoints:
    """N points reconstructed from two views, CFCS. Look at `checks` before you use them.

    `xyz_mm` (N, 3). `method`: "weighted" or "nearest"; always "nearest" where a view's error is unknown. `gap_mm` (N,):
    nearest approach of the two lines of sight. `gap_tested` (N,) bool: False where a pick was snapped to an
    image-matching curve, so that the gap says nothing. `gap_sigma` (N,), masked where not tested: gap over its own
    standard deviation; None where a view's error is unknown. `shift_mm`, `shift_sd_mm`: how far the second view's lines
    of sight pass beside the first's along their common normal, in the best mean of all tested points, and its standard
    deviation: what a patient who moves between the views opens. `gap_chi2`: of the gaps of all tested points together,
    with as many degrees of freedom. These three are None where no point is tested or a view's error is unknown.
    `joint_covariance_mm2` (3N, 3N), or None where a view's error is unknown: the points share focal points, maps and
    frame, so their errors are correlated. `budget_mm2`: the same, for each of BUDGET. `inside_hull` (N,): within the
    beads' hull in both views. `upright`: whether a view shows the frame file's beads not mirrored
    (`LinesOfSight.upright`); None where no view says so. `beads_near`: for each view of the frame
    `LinesOfSight.beads_near` of the points, (N, 3).
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

    def __post_init__(self) -> None:
        arrays = [getattr(self, name) for name in ("xyz_mm", "gap_mm", "gap_tested", "inside_hull")]
        arrays += [self.gap_sigma, self.joint_covariance_mm2, *(self.budget_mm2 or {}).values()]
        for array in arrays:
            if array is not None:
                array.flags.writeable = False

    def first(self, count: int) -> "SpacePoints":
        """So many of the points, with their covariance; shift and chi-square stay those of all."""
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
        """(N,) bool: the gap was tested and is larger than picks and views explain."""
        if self.gap_sigma is None:
            return np.zeros(len(self.xyz_mm), dtype=bool)
        return self.gap_tested & ~(np.ma.getdata(self.gap_sigma) <= LARGEST_GAP_SIGMA)

    @property
    def error_stated(self) -> np.ndarray:
        """(N,) bool: the covariance is known and the gap does not contradict it."""
        return ~self.gap_failed & (self.joint_covariance_mm2 is not None)

    @property
    def checks(self) -> tuple[Check, ...]:
        """Is the error known, and does the gap of each point agree with it? A gap that was not tested has no check."""
        names = [f"point {k + 1}" for k in range(len(self.xyz_mm))]
        return (error_known(self), *self.frame_checks(), *self.bead_checks(names), *self.gap_checks(names))

    def bead_checks(self, names: Sequence[str]) -> tuple[Check, ...]:
        """Whether the views rest on the beads near the points, called by these names; none without a frame."""
        if not self.beads_near:
            return ()
        shares = {
            (view, name): (int(used), int(hidden), int(shown))
            for view, counts in self.beads_near.items()
            for name, (used, hidden, shown) in zip(names, counts, strict=True)
        }
        return (_beads_near(shares),)

    def frame_checks(self) -> tuple[Check, ...]:
        """Is the frame file the frame, and not its mirror image? One upright image shows it."""
        return () if self.upright is None else (handedness_check(self.upright, None),)

    def gap_checks(self, names: Sequence[str]) -> tuple[Check, ...]:
        """One for each of the points, called by these names, whose gap was tested."""
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
        """(N, 3, 3). Raises ErrorUnknownError where a view has no covariance."""
        if self.joint_covariance_mm2 is None:
            raise error_unknown()
        n = len(self.xyz_mm)
        return np.einsum("iaib->iab", self.joint_covariance_mm2.reshape(n, 3, n, 3))


def error_known(points: SpacePoints) -> Check:
    """Do both views state their error?"""
    known = points.joint_covariance_mm2 is not None
    sentence = (
        "Both views state their error."
        if known
        else "Error unknown: a view states no covariance, so nothing can be said of the error of any point; "
        "calibrate both views from their beads, or give the matrix of a view with its covariance."
    )
    return Check("error known", known, None, None, "", sentence)


def _beads_near(counts: dict[tuple[str, str], tuple[int, int, int]]) -> Check:
    """`counts`: by view and point, how many beads are used, and how many hidden, of those that should be seen."""
    shares = {place: (used + hidden / 2) / max(shown, 1) for place, (used, hidden, shown) in counts.items()}
    view, name = min(shares, key=lambda place: shares[place])
    (used, hidden, shown), figure = counts[view, name], shares[view, name]
    passed = figure >= LEAST_BEADS_NEAR
    sentence = f"Of the {shown} beads that the {view} image should show nearest to {name}, {used} are used"
    sentence += f" and {hidden} hidden" if hidden else ""
    sentence += (
        "."
        if passed
        else ": what the image does there is a guess from elsewhere. Look for torn rows, movement, or metal over the "
        "beads, and take the image again."
    )
    return Check("beads near", passed, figure, LEAST_BEADS_NEAR, "", sentence)


def _gap_check(name: str, failed: bool, sigma: float, gap_mm: float) -> Check:
    sentence = f"The two lines of sight of {name} pass {gap_mm:.2f} mm apart, {sigma:.1f} standard deviations"
    sentence += (
        "; the picks of the two images are not the same point, the patient moved between the views, or a view is "
        "wrong: pick again. Arrays of picks must be (view, point, (u, v)), in the order of the views."
        if failed
        else "."
    )
    return Check("gap", not failed, sigma, LARGEST_GAP_SIGMA, "σ", sentence)


@dataclass(frozen=True)
class Verdict:
    """GO only if every check passed; a person decides, this says what stands against it.

    `unmade`: those of the checks that could not be made, since something they need is missing; they failed."""

    checks: tuple[Check, ...]
    unmade: tuple[Check, ...] = ()

    @property
    def go(self) -> bool:
        """True if every check passed."""
        return not failed(self.checks)

    @property
    def state(self) -> State:
        """ "incomplete" where nothing stands against the plan but what is missing."""
        if self.go:
            return "go"
        return "incomplete" if all(check in self.unmade for check in failed(self.checks)) else "no-go"

    def joined(self, other: "Verdict") -> "Verdict":
        """With another's checks."""
        return Verdict(self.checks + other.checks, self.unmade + other.unmade)

    @property
    def missing(self) -> tuple[str, ...]:
        """What is missing, each in a sentence that says what to do."""
        return tuple(check.sentence for check in self.unmade)
