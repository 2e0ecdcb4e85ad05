"""The least-squares adjustment of a check shot, in the CFCS of the planning images, in which the bone is at rest.

A row is one number observed in one view: two for each landmark; one for each point of the wire's centre line, across
the line; one for its tip, along the line.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.calibration.view import CalibratedView, LinesOfSight, Pencil
from sightline.common.checks import Limits
from sightline.common.geometry.covariance import block_diagonal, joined
from sightline.common.geometry.lines import nearest_approach, unit
from sightline.errors import OutsideRegionError, ReconstructionRefusedError, UnusableInputError
from sightline.planning.check.result import MAX_OUTLIER, MIN_LANDMARKS, CheckShot, checks
from sightline.planning.check.wires import GUIDED_MM, STILL, Beforehand, KnownWire, Landmarks, WireSeen
from sightline.planning.points.lines_of_sight import (
    LineResiduals,
    pick_covariance_mm2,
    refuse_two_frames,
)
from sightline.planning.points.picks import Pick, stack
from sightline.planning.points.reconstruct import reconstruct
from sightline.planning.points.solution import MIN_ANGLE_RAD
from sightline.planning.points.trajectory import Trajectory

# Prior s.d. per axis of a movement that no landmark shows: a leg assumed to be still [twin, BoneMotion].
STILL_MM, STILL_RAD = 1.0, float(np.deg2rad(0.5))
_FREE_MM, _FREE_RAD = 100.0, 1.0
MIN_REDUNDANCY = 1e-3  # redundancy number below which an observation cannot be tested by the others [ours]
_OUTSIDE_MM = 15.0  # length of wire outside the entry point that is used: further out it may be bent [ours]
CURVE = 4  # terms of the wire's curve along each perpendicular axis: offset, direction, two of bending
# Another wire was found beyond these [ours]: 37° between wire and plan; along the wire, between the tips of the two
# views, whose error is 0.2 mm.
_MIN_COSINE, _MAX_TIP_GAP_MM = 0.8, 5.0


@dataclass(frozen=True, eq=False)
class Rows:
    """R rows of one view, mm on its reference plane, for N points.

    `residual` (R,); `to_point` (R, N, 3): derivative of the projections by the points; `covariance` (R, R): without
    the errors that `lines` share with other views; `shared`: for each source of those the response (R, K), as in
    `LinesOfSight.shared`.
    """

    lines: LinesOfSight

    residual: np.ndarray
    to_point: np.ndarray
    covariance: np.ndarray
    shared: dict[str, np.ndarray]

    @staticmethod
    def of(lines: LinesOfSight, xyz_mm: np.ndarray, noise_px2: np.ndarray, select: np.ndarray) -> "Rows":
        """Return the rows of points (N, 3), each seen on its line with the pixel covariance `noise_px2` (N, 2, 2).

        `select` (R, 2N): takes the points' residuals to rows.
        """
        assert lines.covariance is not None  # noqa: S101 - called only where the errors are known
        at, n = LineResiduals.at(lines, xyz_mm), len(xyz_mm)
        to_line = select @ at.to_line
        common = {source: response @ response.T for source, response in lines.shared.items()}
        known = np.sum([own - common.get(source, 0.0) for source, own in lines.covariance.items()], axis=0)
        picks = block_diagonal(pick_covariance_mm2(lines, noise_px2))
        own = to_line @ known @ to_line.T + select @ picks @ select.T
        to_point = np.einsum("rnc,nca->rna", select.reshape(len(select), n, 2), at.to_point)
        shared = {source: to_line @ response for source, response in lines.shared.items()}
        return Rows(lines, select @ at.xy_mm.ravel(), to_point, own, shared)


def along_and_across(lines: LinesOfSight, xyz_mm: np.ndarray, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors (N, 2) along and across the image, on the plane, of a curve through points (N, 3) with
    tangents (N, 3)."""
    pencil = Pencil.through(lines.plane, lines.focal_point_mm)
    along = unit(np.einsum("nca,na->nc", pencil.by_point(xyz_mm), tangent))
    return along, np.stack([-along[:, 1], along[:, 0]], axis=-1)


def joint_covariance(rows: Sequence[Rows]) -> np.ndarray:
    """Return the covariance (R, R) of the concatenated rows of several views."""

    def between(i: int, j: int) -> np.ndarray:
        a, b = rows[i], rows[j]
        covariance = np.zeros((len(a.residual), len(b.residual)))
        for source in a.lines.sources_shared_with(b.lines):
            covariance += a.shared[source] @ b.shared[source].T
        return covariance

    return joined([view_rows.covariance + between(i, i) for i, view_rows in enumerate(rows)], between)


class Adjustment:
    """Gauss-Newton adjustment of the observations (`Rows`) in the plan's views and the check's two.

    Unknowns: the landmarks and the plan's two points (3N + 6), a small movement (6: rotation about the plan's middle,
    shift), the wire's curve (8) and its tip's place along the plan (1). The plan's points are unknowns because the
    landmarks constrain the errors of the views that show both.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        picks: Sequence[Sequence[Pick]],
        views: tuple[Sequence[CalibratedView], Sequence[CalibratedView]],
        wires: Sequence[WireSeen],
        landmarks: Landmarks,
        *,
        known: Beforehand = STILL,
    ) -> None:
        self._known, self._curve_terms = known, 2 if known.straight else CURVE
        self._trajectory, self._landmarks, self._views, self._n = trajectory, landmarks, views, len(landmarks)
        self._axes = np.vstack([np.linalg.svd(trajectory.direction[None])[2][1:], trajectory.direction])
        of_plan = stack(picks)
        ends, self._pick_px2 = of_plan.uv_px, of_plan.unbound()
        planned_px = np.full((len(ends), self._n + 2, 2), np.nan)
        planned_px[:2, : self._n], planned_px[:, self._n :] = landmarks.planned_uv_px, ends
        self._shown = np.isfinite(planned_px[..., 0])  # (V, N + 2): which points the plan's views show
        self._before = [
            view.lines_of_sight(uv[shown]) for view, uv, shown in zip(views[0], planned_px, self._shown, strict=True)
        ]
        marks_mm, self.movement = start_movement(views, landmarks, known.movement)
        self._points_mm = np.concatenate([marks_mm, [trajectory.entry_mm, trajectory.end_mm]])
        wires = [within_region(view, wire) for view, wire in zip(views[1], wires, strict=True)]
        curve, self._tip_mm = start_wire(trajectory, self._axes, self.movement, views[1], wires)
        self._curve = curve[: self._curve_terms]
        wires = [self._near_the_bone(view, wire) for view, wire in zip(views[1], wires, strict=True)]
        self.wires = wires
        self._wire_px2 = [np.append(wire.variance_px2, wire.tip_variance_px2) for wire in wires]
        self._after = [
            view.lines_of_sight(np.concatenate([marks, wire.uv_px, wire.tip_uv_px[None]]))
            for view, marks, wire in zip(views[1], landmarks.checked_uv_px, wires, strict=True)
        ]
        for together in (self._before, self._after) if known.by_landmarks else ([*self._before, *self._after],):
            refuse_two_frames(together)

    def step(self) -> None:
        """Make one Gauss-Newton step."""
        residual, _, gain, _ = self._linearised()
        sizes = [self._points_mm.size, 3, 3, self._curve.size]
        points, rotvec, shift, curve, tip = np.split(gain @ residual, np.cumsum(sizes))
        self._points_mm = self._points_mm + points.reshape(-1, 3)
        rotation, middle = Rotation.from_rotvec(rotvec), self._middle
        move = RigidTransform.from_components(middle + shift - rotation.apply(middle), rotation)
        self.movement = move * self.movement
        self._curve = self._curve + curve.reshape(-1, 2)
        self._tip_mm += float(tip[0])

    def outlying_point(self) -> tuple[int, int] | None:
        """Return image and index of the centre-line point (`wires`) that is the worst outlier of all observations.

        None where another observation is the worst, or the worst is within MAX_OUTLIER.
        """
        residual, design, _, covariance = self._linearised()
        sigma = _standardised_residuals(residual, design, covariance)
        worst, first = int(sigma.argmax()), 2 * int(self._shown.sum())
        if sigma[worst] <= MAX_OUTLIER:
            return None
        for view, wire in enumerate(self.wires):
            first += 2 * self._n
            if first <= worst < first + len(wire.uv_px):
                return view, worst - first
            first += len(wire.uv_px) + 1
        return None

    def result(self, limits: Limits, *, through: bool = False) -> CheckShot:
        """Return the check shot with its errors and its checks; `through`: as of `check_shot`."""
        residual, design, gain, covariance = self._linearised()
        # An uninformative prior does not count as an observation.
        free = 0 if self._known.registered else 6 if self._n >= MIN_LANDMARKS else 3 if self._n else 0
        square = residual @ np.linalg.solve(covariance, residual) / (len(residual) - free - design.shape[1])
        to_deviation = self._to_deviation(limits.beyond_mm) @ gain
        # The plan's picks define the plan: their error is not an error of the deviation from it.
        deviation_mm2 = to_deviation @ (covariance - self._plan_picks_mm2(len(covariance))) @ to_deviation.T
        bending = slice(self._points_mm.size + 10, -1)
        bends = self._curve[2:].ravel()
        known = (gain @ covariance @ gain.T)[bending, bending]
        along = np.linspace(0.0, self._tip_mm, 101)
        entry, tip = self._wire(np.array([0.0, self._tip_mm]))
        chord = entry + np.outer(along / self._tip_mm, tip - entry)
        planned = self._points_mm[-2:]
        planned_tip = planned[1] + limits.beyond_mm / self._trajectory.length_mm * (planned[1] - planned[0])
        shot = CheckShot(
            entry_mm=entry,
            tip_mm=tip,
            deviation_mm=np.concatenate([self._axes[:2] @ (entry - planned[0]), self._axes @ (tip - planned_tip)]),
            covariance_mm2=deviation_mm2,
            across=self._axes[:2],
            length_mm=self._trajectory.length_mm + limits.beyond_mm,
            movement=self.movement,
            landmarks=self._n,
            bow_mm=float(np.linalg.norm(self._wire(along) - chord, axis=1).max()),
            bow_sigma=float(np.sqrt(bends @ np.linalg.solve(known, bends) / max(len(bends), 1))),
            residual_rms=float(np.sqrt(square)),
            outlier_sigma=float(_standardised_residuals(residual, design, covariance).max()),
        )
        walls_mm = self._trajectory.length_mm if through else None
        return replace(shot, checks=checks(shot, limits, self._views[1], walls_mm, self._known.registered))

    @property
    def _middle(self) -> np.ndarray:
        """(3,) the middle of the plan in the CFCS of the check images."""
        return self.movement.apply((self._trajectory.entry_mm + self._trajectory.end_mm) / 2)

    def _terms(self, along_mm: np.ndarray | float) -> np.ndarray:
        return terms(np.asarray(along_mm) / self._trajectory.length_mm)[..., : self._curve_terms]

    def _wire(self, along_mm: np.ndarray) -> np.ndarray:
        """Return points (N, 3) of the wire, CFCS of the planning images."""
        offset = self._terms(along_mm) @ self._curve  # from the planned axis
        return self._trajectory.entry_mm + along_mm[:, None] * self._axes[2] + offset @ self._axes[:2]

    def _tangent(self, along_mm: np.ndarray) -> np.ndarray:
        """Return the derivative (N, 3) of `_wire` by `along_mm`."""
        return (self._wire(along_mm + 0.5) - self._wire(along_mm - 0.5)) / 1.0

    def _places(self, focal_mm: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return (N,) the places along the plan, mm, at which lines of sight pass the wire."""
        line = self.movement.apply(self._wire(np.array([0.0, self._trajectory.length_mm])))
        on = nearest_approach(focal_mm, directions, line[0], line[1] - line[0]).second_mm
        return (self.movement.inv().apply(on) - self._trajectory.entry_mm) @ self._axes[2]

    def _linearised(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the residuals of all rows and of the prior, the design matrix, the gain from residuals to unknowns,
        and the residuals' covariance."""
        marks_px2 = np.broadcast_to(self._landmarks.sd_px**2 * np.eye(2), (self._n, 2, 2))
        rows, designs = [], []
        for lines, plan_px2, shown in zip(self._before, self._pick_px2, self._shown, strict=True):
            noise, count = np.concatenate([marks_px2, plan_px2])[shown], int(shown.sum())
            seen = Rows.of(lines, self._points_mm[shown], noise, np.eye(2 * count))
            by_points = np.zeros((2 * count, len(shown), 3))
            by_points[:, shown] = seen.to_point
            design = np.zeros((2 * count, 3 * len(shown) + 7 + self._curve.size))
            design[:, : 3 * len(shown)] = by_points.reshape(2 * count, 3 * len(shown))
            rows.append(seen)
            designs.append(design)
        for lines, wire_px2 in zip(self._after, self._wire_px2, strict=True):
            seen, design = self._after_rows(lines, wire_px2, marks_px2)
            rows.append(seen)
            designs.append(design)
        prior = np.zeros((6, designs[0].shape[1]))
        prior[:, self._points_mm.size : self._points_mm.size + 6] = np.eye(6)
        residual = np.concatenate([*(of_view.residual for of_view in rows), self._prior_residual()])
        design = np.concatenate([*designs, prior])
        covariance = np.zeros((len(residual), len(residual)))
        covariance[:-6, :-6] = joint_covariance(rows)
        rotation_sd = _FREE_RAD if self._n >= MIN_LANDMARKS else STILL_RAD
        prior_sd = np.repeat([rotation_sd, _FREE_MM if self._n else STILL_MM], 3)
        covariance[-6:, -6:] = self._known.covariance
        if not self._known.registered:
            covariance[-6:, -6:] += np.diag(prior_sd**2)
        weighted = np.linalg.solve(covariance, design).T
        return residual, design, np.linalg.solve(weighted @ design, weighted), covariance

    def _plan_picks_mm2(self, size: int) -> np.ndarray:
        """Return the part (R, R) of the rows' covariance that comes from the plan's picks."""
        covariance = np.zeros((size, size))
        for view, lines in enumerate(self._before):
            for k in np.flatnonzero(self._shown[view, self._n :]):
                at = int(self._shown[view, : self._n + k].sum())
                first = 2 * (int(self._shown[:view].sum()) + at)
                jacobian = lines.jacobian[at]
                covariance[first : first + 2, first : first + 2] = jacobian @ self._pick_px2[view, k] @ jacobian.T
        return covariance

    def _after_rows(self, lines: LinesOfSight, wire_px2: np.ndarray, marks_px2: np.ndarray) -> tuple[Rows, np.ndarray]:
        """Return the rows of a check image and their derivatives by all unknowns."""
        n, count, moving = self._n, len(wire_px2) - 1, self._points_mm.size
        along = np.append(self._places(lines.focal_point_mm, lines.directions[n:-1]), self._tip_mm)
        tangent = self._tangent(along)
        xyz = self.movement.apply(np.concatenate([self._points_mm[:n], self._wire(along)]))
        rotation = self.movement.rotation.as_matrix()
        along_image, across_image = along_and_across(lines, xyz[n:], tangent @ rotation.T)
        select = np.zeros((2 * n + count + 1, len(xyz), 2))
        select[np.arange(2 * n), np.arange(2 * n) // 2, np.arange(2 * n) % 2] = 1.0
        select[2 * n + np.arange(count), n + np.arange(count)] = across_image[:-1]
        select[-1, -1] = along_image[-1]
        noise = np.concatenate([marks_px2, wire_px2[:, None, None] * np.eye(2)])
        rows = Rows.of(lines, xyz, noise, select.reshape(len(select), -1))
        design = np.zeros((len(select), moving + 7 + self._curve.size))
        in_bone = rows.to_point @ rotation
        design[:, : 3 * n] = in_bone[:, :n].reshape(len(select), -1)
        design[:, moving : moving + 3] = np.cross(xyz - self._middle, rows.to_point).sum(axis=1)
        design[:, moving + 3 : moving + 6] = rows.to_point.sum(axis=1)
        by_offset = in_bone[:, n:] @ self._axes[:2].T
        of_curve = self._terms(along)
        design[:, moving + 6 : -1] = np.einsum("rnc,nk->rkc", by_offset, of_curve).reshape(len(select), -1)
        design[:, -1] = in_bone[:, -1] @ tangent[-1]
        return rows, design

    def _prior_residual(self) -> np.ndarray:
        """Return (6,): the prior mean (the movement known beforehand) minus the current movement."""
        middle, known = (self._trajectory.entry_mm + self._trajectory.end_mm) / 2, self._known.movement
        rotation = self.movement.rotation
        if self._known is not STILL:  # a product with no rotation may differ in the last bit
            rotation = rotation * known.rotation.inv()
        return -np.concatenate([rotation.as_rotvec(), self.movement.apply(middle) - known.apply(middle)])

    def _to_deviation(self, beyond_mm: float) -> np.ndarray:
        """Return the derivative (5, unknowns) of the deviation; the planned tip is `beyond_mm` past the end point."""
        first = self._points_mm.size + 6
        derivative = np.zeros((5, first + self._curve.size + 1))
        ends = self._terms(np.array([0.0, self._tip_mm]))
        for row, k in ((0, 0), (2, 1)):
            derivative[row : row + 2, first:-1] = np.kron(ends[k], np.eye(2))
        derivative[2:4, -1] = self._tangent(np.array([self._tip_mm]))[0] @ self._axes[:2].T
        derivative[4, -1] = 1.0
        past = beyond_mm / self._trajectory.length_mm
        derivative[:2, first - 12 : first - 9] = -self._axes[:2]
        derivative[2:, first - 12 : first - 9], derivative[2:, first - 9 : first - 6] = (
            past * self._axes,
            -(1 + past) * self._axes,
        )
        return derivative

    def _near_the_bone(self, view: CalibratedView, wire: KnownWire) -> KnownWire:
        """Return the wire without its points far outside the entry."""
        lines = view.lines_of_sight(wire.uv_px)
        along = self._places(lines.focal_point_mm, lines.directions)
        outside_mm = (GUIDED_MM if self._known.straight else _OUTSIDE_MM) + self._known.before_mm
        kept = (along > -outside_mm) & (along < self._tip_mm)
        if np.count_nonzero(kept) < CURVE:
            raise ReconstructionRefusedError(
                f"view {view.name!r} shows {np.count_nonzero(kept)} points of the wire within the bone (at least "
                f"{CURVE} are needed); check that the images belong to this plan"
            )
        return replace(wire, uv_px=wire.uv_px[kept], variance_px2=wire.variance_px2[kept])


def _standardised_residuals(residual: np.ndarray, design: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return (R,) |residual| over its own standard deviation (Baarda's data snooping); 0 below MIN_REDUNDANCY."""
    weight = np.linalg.inv(covariance)
    weight -= weight @ design @ np.linalg.solve(design.T @ weight @ design, design.T @ weight)
    tested = np.diag(weight) > MIN_REDUNDANCY * np.diag(covariance) ** -1
    return np.where(tested, np.abs(weight @ residual) / np.sqrt(np.where(tested, np.diag(weight), 1.0)), 0.0)


def within_region(view: CalibratedView, wire: WireSeen) -> KnownWire:
    """Return the wire without its points outside the view's calibrated region. Raises ReconstructionRefusedError."""
    kept = np.array([_in_region(view, uv) for uv in wire.uv_px], dtype=bool)
    if np.count_nonzero(kept) < CURVE:
        raise ReconstructionRefusedError(
            f"the wire lies outside the region that view {view.name!r} is calibrated in; move the frame so that its "
            "beads surround it"
        )
    return KnownWire(wire.uv_px[kept], wire.variance_px2[kept], wire.tip_uv_px, float(wire.tip_variance_px2))


def start_movement(
    views: tuple[Sequence[CalibratedView], Sequence[CalibratedView]], landmarks: Landmarks, known: RigidTransform
) -> tuple[np.ndarray, RigidTransform]:
    """Return the landmarks (N, 3) in the planning CFCS, and the rigid motion to their places in the check's CFCS.

    `known`: the motion as far as landmarks do not show it.
    """
    if not len(landmarks):
        return np.zeros((0, 3)), known
    spread = np.broadcast_to(landmarks.sd_px**2 * np.eye(2), (2, len(landmarks), 2, 2))
    before = reconstruct(views[0][:2], landmarks.planned_uv_px, spread).xyz_mm
    after = reconstruct(views[1], landmarks.checked_uv_px, spread).xyz_mm
    rotation = known.rotation
    if len(landmarks) >= MIN_LANDMARKS:
        rotation = Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))[0]
    return before, RigidTransform.from_components(after.mean(axis=0) - rotation.apply(before.mean(axis=0)), rotation)


def on_patient(
    views: tuple[Sequence[CalibratedView], Sequence[CalibratedView]], landmarks: Landmarks, *, straight: bool
) -> Beforehand:
    """Return what is known of images whose frame is fixed to the patient. Raises UnusableInputError for fewer landmarks
    than determine where it is."""
    if len(landmarks) < MIN_LANDMARKS:
        raise UnusableInputError(
            f"find {MIN_LANDMARKS} landmarks of the bone or more in all four images, not {len(landmarks)}: the robot "
            "does not know where a frame is that is fixed to the patient"
        )
    movement = start_movement(views, landmarks, RigidTransform.identity())[1]
    return Beforehand(movement, straight=straight, by_landmarks=True)


def start_wire(
    trajectory: Trajectory,
    axes: np.ndarray,
    movement: RigidTransform,
    views: Sequence[CalibratedView],
    wires: Sequence[WireSeen],
) -> tuple[np.ndarray, float]:
    """Return curve (CURVE, 2) and tip (mm along the plan) of the line in which the planes of both views' lines of sight
    intersect.

    `axes` (3, 3): two rows perpendicular to the plan, one along it. Raises ReconstructionRefusedError.
    """
    normals, through = [], []
    for view, wire in zip(views, wires, strict=True):
        lines = view.lines_of_sight(np.concatenate([wire.uv_px, wire.tip_uv_px[None]]))
        normals.append(np.linalg.svd(lines.directions)[2][2])
        through.append(lines)
    direction = np.cross(*normals)
    if np.linalg.norm(direction) < np.sin(MIN_ANGLE_RAD):
        raise ReconstructionRefusedError(
            "both views see the wire in one plane, which does not determine its place in space; take one of the images "
            "from another direction"
        )
    direction, middle = unit(direction), movement.apply((trajectory.entry_mm + trajectory.end_mm) / 2)
    focal = [lines.focal_point_mm for lines in through]
    on = np.linalg.solve(
        np.stack([*normals, direction]), [normals[0] @ focal[0], normals[1] @ focal[1], direction @ middle]
    )
    back = movement.inv()
    origin, direction = back.apply(on), back.rotation.apply(direction)
    direction = direction if direction @ axes[2] > 0 else -direction
    if direction @ axes[2] < _MIN_COSINE:
        angle, limit = np.rad2deg(np.arccos([direction @ axes[2], _MIN_COSINE]))
        raise ReconstructionRefusedError(
            f"the wire lies at {angle:.0f}° to the plan (at most {limit:.0f}°): check that the images show this wire "
            "and belong to this plan"
        )
    off = (origin - trajectory.entry_mm) @ axes.T
    slope = axes[:2] @ direction / (axes[2] @ direction)
    curve = np.zeros((CURVE, 2))
    curve[0], curve[1] = off[:2] - slope * off[2], slope * trajectory.length_mm
    ends = [
        nearest_approach(lines.focal_point_mm, lines.directions[-1], on, movement.rotation.apply(direction)).second_mm
        for lines in through
    ]
    along = (back.apply(np.array(ends)) - trajectory.entry_mm) @ axes[2]
    if (apart := float(np.ptp(along))) > _MAX_TIP_GAP_MM:
        raise ReconstructionRefusedError(
            f"the tips seen in the two images lie {apart:.0f} mm apart along the wire (at most {_MAX_TIP_GAP_MM:.0f} "
            "mm): the images are exchanged, or one does not show this wire's tip"
        )
    return curve, float(along.mean())


def terms(share: np.ndarray) -> np.ndarray:
    """Return the terms (..., CURVE) of the wire's curve at fractions `share` of the planned length.

    The bending terms vanish at entry and end.
    """
    bend = share * (share - 1)
    return np.stack([np.ones_like(share), share, bend, bend * (2 * share - 1)], axis=-1)


def _in_region(view: CalibratedView, uv_px: np.ndarray) -> bool:
    try:
        view.lines_of_sight(uv_px[None])
    except OutsideRegionError:
        return False
    return True
