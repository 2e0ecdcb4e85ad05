"""The least-squares solution of N points from their lines of sight in two or more views."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from sightline.calibration.view import SOURCES, LinesOfSight
from sightline.common.geometry.lines import NearestApproach, cross, nearest_approach
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.planning.points.lines_of_sight import (
    LineResiduals,
    covariance_of_residuals,
    joint_covariance,
    pick_covariance_mm2,
    refuse_two_frames,
)
from sightline.planning.points.picks import PickArrays

Method = Literal["weighted", "nearest"]

# Below this angle the error along the lines of sight is more than ten times that across them [ours].
MIN_ANGLE_RAD = np.deg2rad(5.0)
_ITERATIONS = 2  # enough: only the weights change with the points, and only a little


def solve(lines: Sequence[LinesOfSight], picks: PickArrays, method: Method) -> "Solution":
    """Return N points from their lines of sight in V views: `lines` of each view are those of its finite `picks`.

    Each point is seen in two views or more; the picks' covariances are above zero in all directions
    (`PickArrays.regular`). Raises UnusableInputError for an unknown method, ReconstructionRefusedError.
    """
    if method not in get_args(Method):
        raise UnusableInputError(f"unknown method {method!r}; choose 'weighted' or 'nearest'")
    refuse_two_frames(lines)
    given = Given(lines, picks)
    xyz, sine = start(given)
    _refuse_parallel(float(sine.min()))
    _refuse_behind(lines, picks.seen, xyz)
    used: Method = "nearest" if any(sight.covariance is None for sight in lines) else method
    solution = Solution(given, xyz, used)
    # Of two lines the start is already the nearest point.
    for _ in range(_ITERATIONS if used == "weighted" or (picks.seen.sum(axis=0) > 2).any() else 0):
        solution = Solution(given, solution.xyz_mm + solution.step_mm(), used)
    return solution


@dataclass(frozen=True, eq=False)
class Given:
    """Lines and picks, and what follows from them wherever the points are.

    A point has 2V residuals (view, axis); those of a view that does not show it are zero, with no weight.
    `own_mm2` (N, 2V, 2V): covariance of each point's residuals by the views' errors, where it is known beforehand.
    """

    lines: Sequence[LinesOfSight]
    picks: PickArrays
    own_mm2: np.ndarray | None = None

    @cached_property
    def size(self) -> tuple[int, int]:
        """Number of points, and of the residuals of each."""
        return self.picks.uv_px.shape[1], 2 * len(self.lines)

    @cached_property
    def by_source(self) -> np.ndarray | None:
        """(4, Z, Z): `joint_covariance` of the lines for each of SOURCES; None where a view's error is unknown."""
        return joint_covariance(self.lines, [(source,) for source in SOURCES])

    @cached_property
    def total(self) -> np.ndarray | None:
        """(Z, Z): the sum of `by_source`."""
        return None if self.by_source is None else self.by_source.sum(axis=0)

    @cached_property
    def pairs(self) -> list[tuple[int, int, np.ndarray, np.ndarray]]:
        """For each pair of views (i, j) the directions (2, N, 3) of both lines of each point, and the sine (N,) of
        their angle; NaN and -1 where not both show the point."""
        seen = self.picks.seen
        directions = np.full((*seen.shape, 3), np.nan)
        for k, sight in enumerate(self.lines):
            directions[k, seen[k]] = sight.directions
        pairs = []
        for i, j in combinations(range(len(self.lines)), 2):
            sine = np.linalg.norm(cross(directions[i], directions[j]), axis=1)
            pairs.append((i, j, directions[[i, j]], np.where(seen[i] & seen[j], sine, -1.0)))
        return pairs

    @cached_property
    def approaches(self) -> list[tuple[np.ndarray, NearestApproach]]:
        """For each of `pairs` which points (N,) bool both views show along lines that are not nearly parallel, and the
        closest approach of these lines."""
        approaches = []
        for i, j, directions, sine in self.pairs:
            own = sine >= np.sin(MIN_ANGLE_RAD)
            from_mm, to_mm = self.lines[i].focal_point_mm, self.lines[j].focal_point_mm
            approaches.append((own, nearest_approach(from_mm, directions[0, own], to_mm, directions[1, own])))
        return approaches

    @cached_property
    def at(self) -> np.ndarray:
        """Place of each residual that a view shows (view, point, axis) in those of all points (point, view, axis)."""
        shown = [np.flatnonzero(seen) for seen in self.picks.seen]
        places = [self.size[1] * at[:, None] + [2 * k, 2 * k + 1] for k, at in enumerate(shown)]
        return np.concatenate(places).ravel()

    @cached_property
    def picks_mm2(self) -> np.ndarray:
        """(N, 2V, 2V): the picks' own covariances."""
        covariances = np.zeros((*self.size, self.size[1]))
        for k, (sight, seen) in enumerate(zip(self.lines, self.picks.seen, strict=True)):
            own = slice(2 * k, 2 * k + 2)
            covariances[seen, own, own] = pick_covariance_mm2(sight, self.picks.covariance_px2[k, seen])
        return covariances

    @cached_property
    def snapped(self) -> np.ndarray:
        """(V, N, 2V): for each view's picks the direction of the residuals in which a pick measures nothing, zero for
        a free pick."""
        unmeasured = np.zeros((len(self.lines), *self.size))
        for k, (sight, seen) in enumerate(zip(self.lines, self.picks.seen, strict=True)):
            unmeasured[k, seen, 2 * k : 2 * k + 2] = np.einsum(
                "ijk,ik->ij", sight.jacobian, self.picks.across_px[k, seen]
            )
        return unmeasured


class Solution:
    """The problem linearised at given points: residuals of all views, their covariance, and the weights for X."""

    def __init__(self, given: Given, xyz_mm: np.ndarray, method: Method) -> None:
        lines, picks = self.lines, self.picks = given.lines, given.picks
        self.given, self.xyz_mm, self.method = given, xyz_mm, method
        self.residuals = tuple(LineResiduals.at(sight, xyz_mm[s]) for sight, s in zip(lines, picks.seen, strict=True))
        own = self.own_mm2() if method == "weighted" else None
        information = self._distance_form() if own is None else self._information(own)
        self.information = information = self._without_direction(information)
        self.to_point = self.by_point([r.to_point for r in self.residuals])
        normal = np.swapaxes(self.to_point, 1, 2) @ information
        self.weights = np.linalg.solve(normal @ self.to_point, normal)  # (N, 3, 2V): step of X = weights @ residuals

    def by_point(self, of_views: Sequence[np.ndarray]) -> np.ndarray:
        """Return (N, 2V, ...) of values (n, 2, ...) for the n points that each view shows; zero for the others."""
        size = self.given.size
        by_point = np.zeros((size[0] * size[1], *of_views[0].shape[2:]))
        by_point[self.given.at] = np.concatenate(of_views).reshape(-1, *by_point.shape[1:])
        return by_point.reshape(*size, *by_point.shape[1:])

    def step_mm(self) -> np.ndarray:
        """Return the Gauss-Newton step (N, 3)."""
        return np.einsum("iaj,ij->ia", self.weights, self.xy_mm)

    @property
    def xy_mm(self) -> np.ndarray:
        """(N, 2V): the residuals of each point."""
        return self.by_point([r.xy_mm for r in self.residuals])

    def own_mm2(self) -> np.ndarray | None:
        """Return (N, 2V, 2V): covariance of each point's residuals by the views' errors; None where one is unknown."""
        if self.given.own_mm2 is not None or self.given.total is None:
            return self.given.own_mm2
        return np.einsum("ipiq->ipq", self._of_all(self.given.total))

    @cached_property
    def response(self) -> list[np.ndarray]:
        """For each view (3N, 3 + 2n): derivative of the points by its focal point and the xy of its n lines."""
        by_view = []
        for k, (r, seen) in enumerate(zip(self.residuals, self.picks.seen, strict=True)):
            own = np.zeros((len(seen), 3, r.to_line.shape[1]))
            own[seen] = np.einsum(
                "iap,ipz->iaz",
                self.weights[seen, :, 2 * k : 2 * k + 2],
                r.to_line.reshape(len(r.reach), 2, r.to_line.shape[1]),
            )
            by_view.append(own.reshape(3 * len(seen), -1))
        return by_view

    def budget_mm2(self) -> dict[str, np.ndarray] | None:
        """Return the covariance (3N, 3N) of the points for each source of BUDGET; None where an error is unknown."""
        if self.covariances is None:
            return None
        n, size = self.given.size
        each = np.array(list(self.covariances.values()))
        half = (self.weights @ each.reshape(-1, n, size, size * n)).reshape(-1, 3 * n, n, size)
        whole = (self.weights @ half.transpose(0, 2, 3, 1)).reshape(-1, 3 * n, 3 * n)
        return dict(zip(self.covariances, whole, strict=True))

    @cached_property
    def covariances(self) -> dict[str, np.ndarray] | None:
        """(N, 2V, N, 2V) for each source of BUDGET: of all points' residuals; None where an error is unknown."""
        if self.given.by_source is None:
            return None
        n, size = self.given.size
        picks = np.zeros((n, size, n, size))
        picks[range(n), :, range(n)] = self.given.picks_mm2
        return dict(zip(SOURCES, self._of_all(self.given.by_source), strict=True)) | {"picks": picks}

    def _of_all(self, errors: np.ndarray) -> np.ndarray:
        """Return the covariance (..., N, 2V, N, 2V) of all points' residuals, from that of z, `errors` (..., Z, Z)."""
        n, size = self.given.size
        whole, at = np.zeros((*errors.shape[:-2], n * size, n * size)), self.given.at
        whole[..., at[:, None], at] = covariance_of_residuals(self.residuals, errors)
        return whole.reshape(*errors.shape[:-2], n, size, n, size)

    def _information(self, own: np.ndarray) -> np.ndarray:
        """Return (N, 2V, 2V): the inverse of the covariance of each point's residuals, zero where not seen."""
        own, shown = own + self.given.picks_mm2, np.repeat(self.picks.seen.T, 2, axis=1)
        return inverse(own + np.eye(self.given.size[1]) * ~shown[:, None]) * (shown[:, None] & shown[:, :, None])

    def _distance_form(self) -> np.ndarray:
        """Return (N, 2V, 2V): the form of the residuals that equals X's summed squared distance from its lines."""
        n, size = self.given.size
        form = np.zeros((n, size, size))
        for k, (r, seen) in enumerate(zip(self.residuals, self.picks.seen, strict=True)):
            axes, along = r.lines.plane.axes, r.lines.directions @ r.lines.plane.axes.T
            across = axes @ axes.T - along[:, :, None] * along[:, None, :]
            form[seen, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = r.reach[:, None, None] ** 2 * across
        return form

    def _without_direction(self, information: np.ndarray) -> np.ndarray:
        """Return the information (N, 2V, 2V) in the limit of infinite variance in the directions `snapped`."""
        for direction in filter(np.any, self.given.snapped):
            carried = np.einsum("ipq,iq->ip", information, direction)
            weight = np.einsum("ip,ip->i", direction, carried)
            weight = np.divide(1.0, weight, out=np.zeros_like(weight), where=weight > 0.0)
            information = information - weight[:, None, None] * carried[:, :, None] * carried[:, None, :]
        return information


def inverse(covariance: np.ndarray) -> np.ndarray:
    """Return the inverse of covariances. Raises ReconstructionRefusedError where they are singular."""
    try:
        return np.linalg.inv(covariance)
    except np.linalg.LinAlgError:
        raise ReconstructionRefusedError(
            "give every pick a covariance above zero: the joint covariance of picks and views is singular, so some "
            "input is stated without error"
        ) from None


def start(given: Given) -> tuple[np.ndarray, np.ndarray]:
    """Return for each point the middle (N, 3) of the closest approach of the two lines with the largest angle, NaN
    where all its lines are too nearly parallel to determine it, and the sine (N,) of that angle."""
    sines = np.array([sine for _, _, _, sine in given.pairs])
    best, xyz = sines.argmax(axis=0), np.full((given.size[0], 3), np.nan)
    for k, (own, approach) in enumerate(given.approaches):
        taken = own & (best == k)
        xyz[taken] = approach.middle_mm[taken[own]]
    return xyz, sines.max(axis=0)


def _refuse_parallel(sine: float) -> None:
    if sine < np.sin(MIN_ANGLE_RAD):
        raise ReconstructionRefusedError(
            f"the lines of sight of a point are nearly parallel ({np.rad2deg(np.arcsin(sine)):.1f}°; at least "
            f"{np.rad2deg(MIN_ANGLE_RAD):.0f}° is needed); acquire an image from another direction"
        )


def behind(sight: LinesOfSight, xyz_mm: np.ndarray) -> np.ndarray:
    """Return (N,) bool: the points (N, 3) on the view's lines that lie behind its X-ray source."""
    return np.einsum("ia,ia->i", xyz_mm - sight.focal_point_mm, sight.directions) <= 0.0


def _refuse_behind(lines: Sequence[LinesOfSight], seen: np.ndarray, xyz_mm: np.ndarray) -> None:
    """Raise ReconstructionRefusedError for points behind an X-ray source, which no ray reaches."""
    for sight, shown in zip(lines, seen, strict=True):
        if behind(sight, xyz_mm[shown]).any():
            raise ReconstructionRefusedError(
                f"the lines of sight intersect behind the X-ray source of view {sight.view!r}; check that the picks of "
                "all images show the same points, and that the images belong to these views"
            )
