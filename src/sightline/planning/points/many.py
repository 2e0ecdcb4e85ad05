"""Points of a whole run, each reconstructed by itself: a million in less than a minute.

`reconstruct` states the joint covariance of its points, which grows with the square of their number. Here each point
has its own covariance only, and neighbours share the part of it that comes from the views.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import gammaincc, ndtri

from sightline.calibration import BeadView, MatrixView
from sightline.calibration.matrix_view import HomographyMap
from sightline.calibration.solids.calibrate_together import adjusted_together
from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check
from sightline.common.threads import one_blas_thread
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.planning.points.gaps import gap_mm
from sightline.planning.points.lines_of_sight import no_lines, refuse_repeated, refuse_two_frames
from sightline.planning.points.picks import PickArrays
from sightline.planning.points.results import MAX_GAP_SIGMA
from sightline.planning.points.solution import Given, Solution, behind, start

# Points in one cube of this side share the covariance of their residuals by the views' errors [ours]: it changes by
# less than 2 % within one on the twin's frames, where beads are 15 mm apart [measured].
CELL_MM = 4.0
BLOCK = 2**15  # points computed at once: some 100 MB [ours]
_TOGETHER = 24  # whose joint covariance is computed at once: time grows with the square of their number [measured]
_FAR = 2**17  # cells; beyond no X-ray set-up reaches

# A larger distance between the lines of sight shows two different points, and is not averaged [ours].
MAX_GAP_MM = 20.0
# X-ray sources nearer to each other than this are in metres [ours]: biplane sources are 300 mm and more apart.
MIN_SOURCES_MM = 20.0
MAX_FAILED = 0.05  # [ours] share of the points whose lines of sight may miss each other: markers that were lost
MAX_MEDIAN_GAP_MM = 1.0  # [ours] where no error is known; distortion, or y counted from below, gives more
_SAMPLE = 200  # points that show whether cameras are exchanged [ours]
_EXCHANGED = 0.2  # ratio of median distances below which exchanged cameras, or y up, explain the points [ours]
_MIN_SAMPLE, _ROWS = 10, 33  # [ours] minimum number of points to distinguish y up from y down; row offsets tried a step
_ALIKE = 2.0  # ratio of median distances below which y up and y down cannot be distinguished [ours]

OK, FEW, OUTSIDE, PARALLEL, BEHIND, APART = range(6)
REASONS = (
    "",
    "seen in fewer than two views",
    "outside the calibrated region",
    "lines of sight nearly parallel",
    "behind an X-ray source",
    f"lines of sight more than {MAX_GAP_MM:.0f} mm apart",
)


@dataclass(frozen=True, eq=False)
class ManyPoints:
    """N points, CFCS, mm. `reason` (N,): index into REASONS; where it is not OK, the other rows hold NaN.

    `covariance_mm2` (N, 3, 3) and `gap_sigma` (N,) are None where a view's error is unknown. `gap_mm` (N,): the
    distance between the lines of sight, the largest of all pairs of views.
    """

    xyz_mm: np.ndarray
    covariance_mm2: np.ndarray | None
    gap_mm: np.ndarray
    gap_sigma: np.ndarray | None
    reason: np.ndarray


class ManySolver:
    """Reconstruction of many points on the same views. Raises what `reconstruct` raises for the views."""

    def __init__(self, views: Sequence[CalibratedView]) -> None:
        refuse_repeated(views)
        refuse_two_frames([no_lines(view) for view in views])
        for one, other in combinations(views, 2):
            apart = float(np.linalg.norm(one.focal_point_mm - other.focal_point_mm))
            if apart < MIN_SOURCES_MM:
                raise ReconstructionRefusedError(
                    f"the X-ray sources of {one.name} and {other.name} are {apart:.2f} mm apart, at least "
                    f"{MIN_SOURCES_MM:.0f} mm are needed: the views are in metres, or one is given twice; state them "
                    "in mm"
                )
        self.views = adjusted_together(views)
        self._cells: dict[int, np.ndarray] = {}

    @property
    def errors_known(self) -> bool:
        """Whether all views state their errors."""
        return all(no_lines(view).covariance is not None for view in self.views)

    @one_blas_thread
    def solve(self, uv_px: np.ndarray, sd_px: np.ndarray) -> ManyPoints:
        """Return N points from their pixels (V, N, 2), NaN where not seen, with standard deviations (V, N) per axis."""
        n, known = uv_px.shape[1], self.errors_known
        covariance, sigma = (np.full((n, 3, 3), np.nan), np.full(n, np.nan)) if known else (None, None)
        found = ManyPoints(np.full((n, 3), np.nan), covariance, np.full(n, np.nan), sigma, np.zeros(n, dtype=np.int8))
        for k in range(0, n, BLOCK):
            rows = np.arange(k, min(k + BLOCK, n))
            self._solve(found, rows, uv_px[:, rows], sd_px[:, rows])
        return found

    def _solve(self, found: ManyPoints, rows: np.ndarray, uv: np.ndarray, sd_px: np.ndarray) -> None:
        """Fill the rows of `found` with the points of pixels (V, n, 2)."""
        for k, view in enumerate(self.views):
            shown = np.flatnonzero(np.isfinite(uv[k, :, 0]))
            far = shown[~_is_near(view, uv[k, shown])]
            uv[k, far], found.reason[rows[far]] = np.nan, OUTSIDE
        few = np.isfinite(uv[..., 0]).sum(axis=0) < 2
        found.reason[rows] = np.where(few, np.maximum(found.reason[rows], FEW), OK)
        while (ok := found.reason[rows] == OK).any():
            rows, uv, sd_px = rows[ok], uv[:, ok], sd_px[:, ok]
            given = self._given(uv, sd_px)
            first, _ = start(given)
            found.reason[rows] = _why_not(given, first)
            if not found.reason[rows].any():
                self._fill(found, rows, given, first)
                return

    def _fill(self, found: ManyPoints, rows: np.ndarray, given: Given, first_mm: np.ndarray) -> None:
        """Fill rows of `found` with the adjusted points of `given`, from those nearest to the lines of sight."""
        own = None if found.covariance_mm2 is None else self._own_mm2(given, first_mm)
        given, method = Given(given.lines, given.picks, own), "nearest" if own is None else "weighted"
        solution = Solution(given, first_mm, method)
        solution = Solution(given, first_mm + solution.step_mm(), method)  # a second one: 1 % of a s.d. [measured]
        found.xyz_mm[rows], found.gap_mm[rows] = solution.xyz_mm, gap_mm(solution)
        if own is not None and found.covariance_mm2 is not None and found.gap_sigma is not None:
            total = own + given.picks_mm2
            found.covariance_mm2[rows] = solution.weights @ total @ np.swapaxes(solution.weights, 1, 2)
            found.gap_sigma[rows] = _sigma(solution)

    def _given(self, uv: np.ndarray, sd_px: np.ndarray) -> Given:
        seen = np.isfinite(uv[..., 0])
        lines = [view.lines_of_sight(uv[k, seen[k]]) for k, view in enumerate(self.views)]
        return Given(lines, PickArrays(uv, sd_px[..., None, None] ** 2 * np.eye(2), np.zeros_like(uv)))

    def _own_mm2(self, given: Given, xyz_mm: np.ndarray) -> np.ndarray:
        """Return (N, 2V, 2V): the residuals' covariances by the views' errors, computed for one point of each cell."""
        seen, picks = given.picks.seen, given.picks
        key = np.clip(np.floor(xyz_mm / CELL_MM), 1 - _FAR, _FAR - 1).astype(np.int64) + _FAR
        code = (key[:, 0] * 2 * _FAR + key[:, 1]) * 2 * _FAR + key[:, 2]
        code = code << len(seen) | (2 ** np.arange(len(seen)) @ seen)
        cells, first, cell = np.unique(code, return_index=True, return_inverse=True)
        new = first[[int(c) not in self._cells for c in cells]]
        for k in range(0, len(new), _TOGETHER):
            at = new[k : k + _TOGETHER]
            some = self._given(picks.uv_px[:, at], np.sqrt(picks.covariance_px2[:, at, 0, 0]))
            own = Solution(some, xyz_mm[at], "nearest").own_mm2()
            assert own is not None  # noqa: S101 - the caller asks
            self._cells.update(zip(code[at].tolist(), own, strict=True))
        return np.array([self._cells[int(c)] for c in cells])[cell]

    @staticmethod
    def _sample(uv_px: np.ndarray) -> np.ndarray:
        """Return some of the points (V, N, 2) that all views show, evenly chosen."""
        shown = np.flatnonzero(np.isfinite(uv_px[..., 0]).all(axis=0))
        return uv_px[:, shown[np.unique(np.linspace(0, len(shown) - 1, min(_SAMPLE, len(shown))).astype(int))]]

    def refuse_exchanged(self, uv_px: np.ndarray) -> None:
        """Raise UnusableInputError where points (V, N, 2) fit only with two cameras exchanged."""
        some = self._sample(uv_px)
        if not (as_given := self._median_gap_mm(some)) > MAX_MEDIAN_GAP_MM:
            return
        for a, b in combinations(range(len(self.views)), 2):
            order = np.arange(len(self.views))
            order[[a, b]] = b, a
            if self._median_gap_mm(some[order]) < _EXCHANGED * min(as_given, MAX_GAP_MM):
                raise UnusableInputError(
                    f"the cameras of views {self.views[a].name} and {self.views[b].name} are exchanged: the lines of "
                    "sight meet only with their columns exchanged; give the views in the order of the file's cameras"
                )

    def refuse_upward(self, uv_px: np.ndarray) -> bool:
        """Return whether the lines of sight of points (V, N, 2) would meet as well with y counted from below.

        Raises UnusableInputError where they meet only then.
        """
        some = self._sample(uv_px)
        if some.shape[1] < _MIN_SAMPLE:
            return False
        down_mm, up_mm = (self._least_gap_mm(some * [1.0, sign]) for sign in (1.0, -1.0))
        if up_mm < _EXCHANGED * down_mm:
            raise UnusableInputError(
                f"y is counted from below: the lines of sight then pass each other at {up_mm:.2f} mm, else at "
                f"{down_mm:.2f} mm; export the points with y down"
            )
        return up_mm < _ALIKE * down_mm

    def _least_gap_mm(self, uv_px: np.ndarray) -> float:
        """Return the smallest median distance between the lines of sight with all images shifted by the same rows."""

        def gap(row: float) -> float:
            moved = uv_px + np.array([0.0, row])
            for k, view in enumerate(self.views):
                moved[k, ~_is_near(view, moved[k])] = np.nan
            met = [each.gap_mm for _, each in self._given(moved, np.ones(moved.shape[:2])).approaches]
            gaps_mm = np.concatenate(met)
            return float(np.median(gaps_mm)) if 2 * len(gaps_mm) >= len(met) * uv_px.shape[1] else np.inf

        best, reach = 0.0, 3.0 * float(np.abs(uv_px[..., 1]).max())
        for _ in range(4):  # to 0.1 px
            best = min((best + reach * np.linspace(-1.0, 1.0, _ROWS)).tolist(), key=gap)
            reach *= 2.0 / (_ROWS - 1)
        return gap(best)

    def _median_gap_mm(self, uv_px: np.ndarray) -> float:
        """Return the median distance between the lines of sight; infinite ones are of points not reconstructed."""
        if not uv_px.shape[1]:
            return 0.0
        found = self.solve(uv_px, np.ones(uv_px.shape[:2]))
        return float(np.median(np.where(found.reason == OK, found.gap_mm, np.inf)))


def gap_check(gap_mm: np.ndarray, gap_sigma: np.ndarray | None, reason: np.ndarray) -> Check:
    """Return the check that lines of sight meet, of all points that two views or more show inside their regions."""
    asked = ~np.isin(reason, (FEW, OUTSIDE))
    wrong = "the points are not of these images (distorted or not), y is counted from below, or a view is wrong."
    if not asked.any():
        return Check("gap", False, None, 100 * MAX_FAILED, "%", "No point is seen in two views within their regions.")
    missed = asked & (reason != OK)
    if gap_sigma is None:
        median = float(np.median(np.where(missed, np.inf, gap_mm)[asked]))
        passed, median = median <= MAX_MEDIAN_GAP_MM, min(median, MAX_GAP_MM)
        sentence = f"The lines of sight pass each other at {median:.2f} mm (median)" + ("." if passed else f": {wrong}")
        return Check("gap", passed, median, MAX_MEDIAN_GAP_MM, "mm", sentence)
    share = float((missed | (np.nan_to_num(gap_sigma) > MAX_GAP_SIGMA))[asked].mean())
    sentence = f"Of {100 * share:.1f} % of the points the lines of sight miss each other by more than their errors"
    passed = share <= MAX_FAILED
    sentence += "." if passed else f": the stated error of the points is too small, {wrong}"
    return Check("gap", passed, 100 * share, 100 * MAX_FAILED, "%", sentence)


def without_distortion(views: Sequence[CalibratedView]) -> bool:
    """Return whether all views take pixels of images without distortion: of panels, or undistorted ones."""
    maps = [view.plane_map for view in views if isinstance(view, BeadView | MatrixView)]
    return all(isinstance(plane_map, HomographyMap) for plane_map in maps)


def _is_near(view: CalibratedView, uv_px: np.ndarray) -> np.ndarray:
    """Return (N,) bool: the pixels in which the view's map may be evaluated; a matrix holds everywhere."""
    return view.hull.is_near(uv_px) if isinstance(view, BeadView) else np.ones(len(uv_px), dtype=bool)


def _why_not(given: Given, xyz_mm: np.ndarray) -> np.ndarray:
    """Return for each point the first reason why it cannot be reconstructed; OK for the others."""
    reason = np.zeros(len(xyz_mm), dtype=np.int8)
    for own, approach in given.approaches:
        reason[own] = np.where(approach.gap_mm > MAX_GAP_MM, APART, reason[own])
    for sight, shown in zip(given.lines, given.picks.seen, strict=True):
        reason[shown] = np.where(behind(sight, xyz_mm[shown]), BEHIND, reason[shown])
    reason[np.isnan(xyz_mm[:, 0])] = PARALLEL
    return reason


def _sigma(solution: Solution) -> np.ndarray:
    """Return (N,): the number of s.d. of a normal distribution exceeded as rarely as the residuals' chi-square."""
    square = np.einsum("ip,ipq,iq->i", solution.xy_mm, solution.information, solution.xy_mm)
    freedom = 2 * solution.picks.seen.sum(axis=0) - 3
    tail = gammaincc(freedom / 2.0, square / 2.0)
    return np.where(tail > 0.0, np.abs(ndtri(np.maximum(tail, np.finfo(float).tiny) / 2.0)), np.sqrt(square))
