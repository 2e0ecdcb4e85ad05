"""Reconstruction of points from picks in two views: closest approach (the paper) or covariance-weighted."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from sightline.calibration.view import CalibratedView, LinesOfSight
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.geometry.lines import NearestApproach, nearest_approach
from sightline.planning.line_residuals import (
    LineResiduals,
    covariance_by_source,
    pick_covariance_mm2,
    refuse_two_frames,
)
from sightline.planning.picks import DEFAULT_PICK_SD_PX
from sightline.planning.results import SpacePoints

Method = Literal["weighted", "nearest"]

# Below this angle the error along the lines of sight is more than ten times that across them [ours].
MIN_ANGLE_RAD = np.deg2rad(5.0)
# Two X-ray sources nearer than this belong to one exposure given twice [ours].
MIN_BASELINE_MM = 1.0
_ITERATIONS = 2  # enough: only the weights change with the points, and only a little


def reconstruct(
    views: Sequence[CalibratedView],
    uv_px: np.ndarray | Mapping[str, np.ndarray],
    uv_covariance_px2: np.ndarray | Mapping[str, np.ndarray] | None = None,
    method: Method = "weighted",
    across_px: np.ndarray | None = None,
) -> SpacePoints:
    """Return the points seen at pixels `uv_px` (2, N, 2) of two views, with their joint covariance, CFCS.

    The axes of `uv_px` are view, point and (u, v). For two points, (point, view, (u, v)) has the same shape: to rule
    out confusion pass the pixels by the views' names, `{"pa": (N, 2), "lateral": (N, 2)}`. `uv_covariance_px2`
    (2, N, 2, 2), or by the views' names: of the picks; by default 0.5 px per axis, a careful click. `across_px`
    (2, N, 2): for a pick snapped to an image-matching curve the direction across the curve, in which it measures
    nothing; zero for a free pick (see `Pick`).

    `method`: "nearest", the middle of the closest approach of both lines of sight (the paper, eqs 1 and 2), or
    "weighted", the maximum-likelihood point given the covariance of both lines of sight and the picks. Where a view's
    error is unknown there are no weights: "nearest" is used, and the result's `method` says so. Each point is computed
    from its own picks only, so a bad pick moves no other point; the points' errors are still correlated. Look at the
    result's `checks`. Raises UnusableInputError, ReconstructionRefusedError, OutsideRegionError.

    >>> pa, lateral = sl.load("out/demo/views.json")
    >>> points = sl.reconstruct([pa, lateral], {"pa": [[704, 425]], "lateral": [[439, 358]]})
    >>> points.xyz_mm.round()
    array([[-22., -26.,   4.]])
    """
    if method not in ("weighted", "nearest"):
        raise UnusableInputError(f"unknown method {method!r}; choose 'weighted' or 'nearest'")
    first, second = _two_views(views)
    uv_covariance_px2 = None if uv_covariance_px2 is None else _by_view(views, uv_covariance_px2, "covariances")
    uv, covariance, across = _picks(_by_view(views, uv_px, "picks"), uv_covariance_px2, across_px)
    lines = first.lines_of_sight(uv[0]), second.lines_of_sight(uv[1])
    solution = solve(lines, covariance, across, method)
    budget, gaps = solution.budget_mm2(), solution.gap_covariance_mm2()
    gap_mm = _approach(lines).gap_mm
    tested = ~np.any(across != 0.0, axis=(0, 2))
    shift, shift_sd, chi2 = (None, None, None) if gaps is None or not tested.any() else _all_gaps(lines, gaps, tested)
    return SpacePoints(
        xyz_mm=solution.xyz_mm,
        gap_mm=gap_mm,
        gap_tested=tested,
        gap_sigma=None if gaps is None else np.ma.masked_array(gap_mm / np.sqrt(np.diag(gaps)), mask=~tested),
        joint_covariance_mm2=None if budget is None else np.sum(list(budget.values()), axis=0),
        budget_mm2=budget,
        inside_hull=lines[0].inside_hull & lines[1].inside_hull,
        method=solution.method,
        shift_mm=shift,
        shift_sd_mm=shift_sd,
        gap_chi2=chi2,
        upright=_upright(lines),
        beads_near={one.view: one.beads_near for one in lines if one.beads_near is not None} or None,
    )


def solve(
    lines: tuple[LinesOfSight, LinesOfSight], covariance_px2: np.ndarray, across_px: np.ndarray, method: Method
) -> "Solution":
    """Return the points of N pairs of lines of sight; arguments and errors are those of `reconstruct`."""
    refuse_two_frames(lines)
    _refuse_parallel(*lines)
    xyz = _approach(lines).middle_mm
    _refuse_behind(lines, xyz)
    used: Method = "nearest" if any(one.covariance is None for one in lines) else method
    solution = Solution(lines, (covariance_px2, across_px), xyz, used)
    for _ in range(_ITERATIONS if used == "weighted" else 0):
        xyz = xyz + solution.step_mm()
        solution = Solution(lines, (covariance_px2, across_px), xyz, used)
    return solution


def _upright(lines: tuple[LinesOfSight, LinesOfSight]) -> bool | None:
    known = [one.upright for one in lines if one.upright is not None]
    return any(known) if known else None


def _approach(lines: tuple[LinesOfSight, LinesOfSight]) -> NearestApproach:
    first, second = lines
    return nearest_approach(first.focal_point_mm, first.directions, second.focal_point_mm, second.directions)


class Solution:
    """The problem linearised at given points: residuals of both views, their covariance, and the weights for X."""

    def __init__(
        self,
        lines: tuple[LinesOfSight, LinesOfSight],
        picks: tuple[np.ndarray, np.ndarray],
        xyz_mm: np.ndarray,
        method: Method,
    ) -> None:
        covariance_px2, across_px = picks
        self.xyz_mm, self.method = xyz_mm, method
        self.residuals = LineResiduals.at(lines[0], xyz_mm), LineResiduals.at(lines[1], xyz_mm)
        self.covariances = _covariances(self.residuals, covariance_px2)
        if method == "weighted" and self.covariances is not None:
            information = _inverse(_own(self.covariances))
        else:
            information = _distance_form(self.residuals)
        information = _without_direction(information, lines, across_px)
        to_point = np.concatenate([r.to_point for r in self.residuals], axis=1)
        normal = np.swapaxes(to_point, 1, 2) @ information
        self.weights = np.linalg.solve(normal @ to_point, normal)  # (N, 3, 4): step of X = weights @ residuals

    def step_mm(self) -> np.ndarray:
        """Return the Gauss-Newton step (N, 3)."""
        return np.einsum("iaj,ij->ia", self.weights, np.hstack([r.xy_mm for r in self.residuals]))

    @property
    def response(self) -> tuple[np.ndarray, np.ndarray]:
        """For each view (3N, 3 + 2N): derivative of the points by its focal point and the xy of its lines."""
        n = len(self.weights)
        first, second = (
            np.einsum("iap,ipz->iaz", self.weights[:, :, 2 * k : 2 * k + 2], r.to_line.reshape(n, 2, -1))
            for k, r in enumerate(self.residuals)
        )
        return first.reshape(3 * n, -1), second.reshape(3 * n, -1)

    def budget_mm2(self) -> dict[str, np.ndarray] | None:
        """Return the covariance (3N, 3N) of the points for each source of BUDGET; None where an error is unknown."""
        if self.covariances is None:
            return None
        n = len(self.weights)
        out = {}
        for source, covariance in self.covariances.items():
            half = (self.weights @ covariance.reshape(n, 4, 4 * n)).reshape(3 * n, n, 4)
            out[source] = (self.weights @ half.transpose(1, 2, 0)).reshape(3 * n, 3 * n)
        return out

    def gap_covariance_mm2(self) -> np.ndarray | None:
        """Return the covariance (N, N) of the signed distances between the lines; None where an error is unknown."""
        if self.covariances is None:
            return None
        common = _common_normals(self.residuals[0].lines, self.residuals[1].lines)
        signed = zip((1.0, -1.0), self.residuals, strict=True)
        to_gap = np.hstack([s * r.reach[:, None] * (common @ r.lines.plane.axes.T) for s, r in signed])
        return np.einsum("ip,ipjq,jq->ij", to_gap, np.sum(list(self.covariances.values()), axis=0), to_gap)


def _common_normals(first: LinesOfSight, second: LinesOfSight) -> np.ndarray:
    """Return (N, 3): unit vectors perpendicular to both lines of sight of each point."""
    common = np.cross(first.directions, second.directions)
    return common / np.linalg.norm(common, axis=1, keepdims=True)


def _all_gaps(
    lines: tuple[LinesOfSight, LinesOfSight], covariance_mm2: np.ndarray, tested: np.ndarray
) -> tuple[float, float, float]:
    """Return the weighted mean of the tested points' signed gaps, mm, its standard deviation, and their chi-square.

    Raises ReconstructionRefusedError for a singular covariance.
    """
    normals = _common_normals(*lines)[tested]
    signed = normals @ (lines[1].focal_point_mm - lines[0].focal_point_mm)
    information = _inverse(covariance_mm2[np.ix_(tested, tested)])
    weights = information.sum(axis=0)
    mean, sd = float(weights @ signed / weights.sum()), float(1.0 / np.sqrt(weights.sum()))
    return mean, sd, float(signed @ information @ signed)


def _covariances(
    residuals: tuple[LineResiduals, LineResiduals], pick_covariance_px2: np.ndarray
) -> dict[str, np.ndarray] | None:
    """Return (N, 4, N, 4) for each source of BUDGET: a point's two residuals in the first view, then in the second."""
    by_source = covariance_by_source(*residuals)
    if by_source is None:
        return None
    n = len(pick_covariance_px2[0])
    out = {
        source: c.reshape(2, n, 2, 2, n, 2).transpose(1, 0, 2, 4, 3, 5).reshape(n, 4, n, 4)
        for source, c in by_source.items()
    }
    picks = np.zeros((n, 2, 2, n, 2, 2))
    for k, (r, covariance_px2) in enumerate(zip(residuals, pick_covariance_px2, strict=True)):
        picks[range(n), k, :, range(n), k, :] = pick_covariance_mm2(r.lines, covariance_px2)
    return out | {"picks": picks.reshape(n, 4, n, 4)}


def _own(covariances: dict[str, np.ndarray]) -> np.ndarray:
    """Return (N, 4, 4): the total covariance of each point's own residuals."""
    return np.einsum("ipiq->ipq", np.sum(list(covariances.values()), axis=0))


def _inverse(covariance: np.ndarray) -> np.ndarray:
    """Return the inverse of covariances. Raises ReconstructionRefusedError where they are singular."""
    try:
        return np.linalg.inv(covariance)
    except np.linalg.LinAlgError:
        raise ReconstructionRefusedError(
            "give every pick a covariance above zero: the joint covariance of picks and views is singular, so some "
            "input is stated without error"
        ) from None


def _distance_form(residuals: tuple[LineResiduals, LineResiduals]) -> np.ndarray:
    """Return (N, 4, 4): the quadratic form of the residuals equal to X's summed squared distance from both lines."""
    out = np.zeros((len(residuals[0].reach), 4, 4))
    for k, r in enumerate(residuals):
        axes, along = r.lines.plane.axes, r.lines.directions @ r.lines.plane.axes.T
        across = axes @ axes.T - along[:, :, None] * along[:, None, :]
        out[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = r.reach[:, None, None] ** 2 * across
    return out


def _without_direction(
    information: np.ndarray, lines: tuple[LinesOfSight, LinesOfSight], across_px: np.ndarray
) -> np.ndarray:
    """Return the information (N, 4, 4) in the limit of infinite variance along the directions `across_px` (2, N, 2)."""
    for k, (one, across) in enumerate(zip(lines, across_px, strict=True)):
        direction = np.zeros((len(information), 4))
        direction[:, 2 * k : 2 * k + 2] = np.einsum("ijk,ik->ij", one.jacobian, across)
        carried = np.einsum("ipq,iq->ip", information, direction)
        weight = np.einsum("ip,ip->i", direction, carried)
        weight = np.divide(1.0, weight, out=np.zeros_like(weight), where=weight > 0.0)
        information = information - weight[:, None, None] * carried[:, :, None] * carried[:, None, :]
    return information


def _two_views(views: Sequence[CalibratedView]) -> tuple[CalibratedView, CalibratedView]:
    """Return the two views. Raises ReconstructionRefusedError where both are the same exposure."""
    if len(views) != 2:
        raise UnusableInputError(f"{len(views)} views given; give exactly two to reconstruct a point")
    first, second = views
    baseline = float(np.linalg.norm(first.focal_point_mm - second.focal_point_mm))
    if first is second or baseline < MIN_BASELINE_MM:
        raise ReconstructionRefusedError(
            f"one view is given twice ({first.name!r} and {second.name!r}, X-ray sources {baseline:.1f} mm apart); "
            "give two images taken from different directions"
        )
    return first, second


def _by_view(views: Sequence[CalibratedView], given: np.ndarray | Mapping[str, np.ndarray], what: str) -> np.ndarray:
    """Return values given by the views' names as an array in the views' order; arrays unchanged.

    Raises UnusableInputError.
    """
    if not isinstance(given, Mapping):
        return given
    names = [view.name for view in views]
    if len(set(names)) < len(names) or set(given) != set(names):
        raise UnusableInputError(
            f"the {what} are given for {', '.join(map(repr, given))}, the views are {', '.join(map(repr, names))}; "
            "give an entry for each view, and views of different names"
        )
    shapes = {np.shape(given[name]) for name in names}
    if len(shapes) > 1:
        raise UnusableInputError(f"the {what} have different shapes in the two views; give the same points in both")
    return np.array([given[name] for name in names], dtype=np.float64)


def _picks(
    uv_px: np.ndarray, covariance_px2: np.ndarray | None, across_px: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return picks, their covariances and unmeasured directions as checked arrays. Raises UnusableInputError."""
    uv = np.asarray(uv_px, dtype=np.float64)
    if uv.ndim != 3 or uv.shape[0] != 2 or uv.shape[2] != 2 or uv.shape[1] == 0:
        raise UnusableInputError(f"picks have the shape {uv.shape}; give (2, N, 2): two views, N points, (u, v)")
    n = uv.shape[1]
    if covariance_px2 is None:
        covariance_px2 = np.broadcast_to(DEFAULT_PICK_SD_PX**2 * np.eye(2), (2, n, 2, 2))
    covariance = np.asarray(covariance_px2, dtype=np.float64)
    across = np.zeros((2, n, 2)) if across_px is None else np.asarray(across_px, dtype=np.float64)
    for name, array, shape in (("covariances", covariance, (2, n, 2, 2)), ("free directions", across, (2, n, 2))):
        if array.shape != shape:
            raise UnusableInputError(f"the picks' {name} have the shape {array.shape}; give {shape}")
    if not all(np.isfinite(a).all() for a in (uv, covariance, across)):
        raise UnusableInputError("picks or their covariances are not finite; give each pick a pixel in both images")
    if not np.allclose(covariance, np.swapaxes(covariance, -1, -2)) or not _positive(covariance):
        raise UnusableInputError(
            "a pick's covariance is not symmetric and positive semi-definite; give a 2x2 covariance in px²"
        )
    if np.any(np.any(across[0] != 0.0, axis=1) & np.any(across[1] != 0.0, axis=1)):
        raise UnusableInputError(
            "a point is snapped in both views; pick it freely in one view and snap it to that pick's curve in the other"
        )
    # The variance across a snapped pick's curve is not used; a value above zero keeps the matrices regular.
    size = np.trace(covariance, axis1=-2, axis2=-1)[..., None, None]
    return uv, covariance + size * across[..., :, None] * across[..., None, :], across


def _positive(covariance: np.ndarray) -> bool:
    """Whether no variance is below zero, up to rounding (a snapped pick's covariance is singular)."""
    values = np.linalg.eigvalsh(covariance)
    return bool((values[..., 0] >= -1e-9 * np.abs(values[..., 1])).all())


def _refuse_parallel(first: LinesOfSight, second: LinesOfSight) -> None:
    """Raise ReconstructionRefusedError for lines of sight too nearly parallel to determine a point."""
    sine = np.linalg.norm(np.cross(first.directions, second.directions), axis=1).min()
    if sine < np.sin(MIN_ANGLE_RAD):
        raise ReconstructionRefusedError(
            f"two lines of sight are nearly parallel ({np.rad2deg(np.arcsin(sine)):.1f}°; at least "
            f"{np.rad2deg(MIN_ANGLE_RAD):.0f}° is needed); acquire the second image from another direction"
        )


def _refuse_behind(lines: tuple[LinesOfSight, LinesOfSight], xyz_mm: np.ndarray) -> None:
    """Raise ReconstructionRefusedError for points behind an X-ray source, which no ray reaches."""
    for one in lines:
        along = np.einsum("ia,ia->i", xyz_mm - one.focal_point_mm, one.directions)
        if along.min() <= 0.0:
            raise ReconstructionRefusedError(
                f"the lines of sight intersect behind the X-ray source of view {one.view!r}; check that the picks of "
                "both images show the same points, and that the images belong to these views"
            )
