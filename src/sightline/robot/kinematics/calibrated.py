"""Calibration of the manipulator: its axes, and the mounts of frame and wire on the flange, with their covariance."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtrc  # not scipy.stats, which takes half a second to import

from sightline.common.checks import FALSE_ALARM
from sightline.common.geometry.rigid import adjoint, displacement
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.kinematics.manipulator import Manipulator

# Machining tolerance of an axis, 1 s.d. of its twist [ours]: 1 mrad and 0.2 mm, of an ordinary workshop. A prior that
# is too narrow would contradict the measurements.
MACHINED_SD = np.array([1e-3] * 3 + [0.2] * 3)
# Deflection under load between imaging and drilling that the encoders cannot see, 1 s.d. of the flange's twist: weight
# of frame and drilling unit, a thrust of 35 N against 1000 N/mm [ours, physics.md "Drilling"].
COMPLIANCE_SD = np.array([1e-4] * 3 + [0.03] * 3)
# The same of an arm that holds a guide: it is pushed by up to 20 N, and carries itself [calc].
GUIDE_COMPLIANCE_SD = np.array([2e-4] * 3 + [0.07] * 3)
# The robot's sources of error in a trajectory; their covariances add up.
SOURCES = ("kinematics", "hand_eye", "drill_axis", "encoders", "compliance")
# Repeatability of a block on its mount, s.d. of a twist about its own middle [ours]: 0.5 mrad and 0.05 mm, of dowel
# pins.
REMOUNT_SD = np.array([5e-4] * 3 + [0.05] * 3)
MIN_SEEN_MM = 20.0  # [ours] length of wire between two points that gives its direction, to 0.1 mm / 20 mm = 0.3°
_AXES, _FRAME, _WIRE = slice(0, -12), slice(-12, -6), slice(-6, None)
_MAX_ITERATIONS, _TOLERANCE = 30, 1e-9


@dataclass(frozen=True, eq=False)
class Mount:
    """A pose on the flange: `pose` maps mount coordinates to flange coordinates; `covariance` (6, 6): of its error as a
    spatial twist in flange coordinates (rad, mm); `residual_mm` (N,): of the measured points."""

    pose: RigidTransform
    covariance: np.ndarray
    residual_mm: np.ndarray


def measured_mount(own_mm: np.ndarray, flange_mm: np.ndarray, sd_mm: float) -> Mount:
    """Return a mount from N >= 3 points known in its own coordinates and measured in the flange's, both (N, 3).

    `sd_mm`: standard deviation of a measured point, per axis. Raises UnusableInputError for points that determine no
    pose, RobotRefusedError for points that contradict each other.
    """
    own, flange = (np.asarray(points, dtype=np.float64) for points in (own_mm, flange_mm))
    _need(own.shape == flange.shape and own.ndim == 2 and len(own) >= 3, "a mount needs three points or more, twice")
    _need(np.isfinite(own).all() and np.isfinite(flange).all() and sd_mm > 0, "measured points must be finite numbers")
    spread = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)
    _need(spread[1] > 10 * sd_mm, "the points lie on one line and determine no pose; measure one beside it")
    rotation, *_ = Rotation.align_vectors(flange - flange.mean(axis=0), own - own.mean(axis=0))
    pose = RigidTransform.from_components(flange.mean(axis=0) - rotation.apply(own.mean(axis=0)), rotation)
    residual = flange - pose.apply(own)
    refuse_unlikely((residual**2).sum() / sd_mm**2, 3 * len(own) - 6, "the measured points")
    design = displacement(pose.apply(own)).reshape(-1, 6)
    return Mount(pose, sd_mm**2 * np.linalg.inv(design.T @ design), np.linalg.norm(residual, axis=1))


def measured_axis(feed_mm: np.ndarray, tip_flange_mm: np.ndarray, sd_mm: float) -> Mount:
    """Return the wire's mount from its tip measured at N >= 2 feeds (N,), in flange coordinates (N, 3).

    The pose's origin is the tip at feed 0 and its +z the direction of feed; the rotation about +z is arbitrary and has
    no error. Raises UnusableInputError, and RobotRefusedError for tips off the line or not moved as fed.
    """
    feed, tip = np.asarray(feed_mm, dtype=np.float64), np.asarray(tip_flange_mm, dtype=np.float64)
    _need(tip.shape == (len(feed), 3) and len(feed) >= 2, "a wire's axis needs its tip at two feeds or more")
    _need(np.isfinite(feed).all() and np.isfinite(tip).all() and sd_mm > 0, "measured tips must be finite numbers")
    _need(np.ptp(feed) > 100 * sd_mm, "the feeds lie too close together to give a direction; measure further apart")
    design = np.stack([np.ones_like(feed), feed], axis=1)
    (origin, slope), *_ = np.linalg.lstsq(design, tip, rcond=None)
    residual = tip - design @ np.stack([origin, slope])
    length = np.linalg.norm(slope)
    along_sd = sd_mm / np.sqrt(((feed - feed.mean()) ** 2).sum())
    squares = (residual**2).sum() / sd_mm**2 + ((length - 1) / along_sd) ** 2
    refuse_unlikely(squares, 3 * len(feed) - 5, "the measured tips")
    normal = sd_mm**2 * np.linalg.inv(design.T @ design)
    return _along(origin, slope / length, np.kron(normal, np.eye(3)), np.linalg.norm(residual, axis=1))


def seen_axis(wire_mm: np.ndarray, covariance_mm2: np.ndarray, feed_mm: float, sd_mm: float) -> Mount:
    """Return the wire's mount on the frame, CFCS, from a point of it and its tip (2, 3) that images show, CFCS, with
    their covariance (6, 6); pose as of `measured_axis`.

    `feed_mm`: the feed, or how far the wire stands out of a guide's mouth; `sd_mm`: its error. Raises
    UnusableInputError.
    """
    (point, tip), length = wire_mm, float(np.linalg.norm(wire_mm[1] - wire_mm[0]))
    _need(length >= MIN_SEEN_MM, f"images of the wire need two points of it {MIN_SEEN_MM:g} mm apart or more")
    z = (tip - point) / length
    slope = (np.eye(3) - np.outer(z, z)) @ np.hstack([-np.eye(3), np.eye(3)]) / length
    design = np.vstack([np.hstack([np.zeros((3, 3)), np.eye(3)]) - feed_mm * slope, slope])
    joint = design @ covariance_mm2 @ design.T
    joint[:3, :3] += sd_mm**2 * np.outer(z, z)
    return _along(tip - feed_mm * z, z, joint, np.zeros(0))


def _along(origin: np.ndarray, z: np.ndarray, joint: np.ndarray, residual_mm: np.ndarray) -> Mount:
    """Return the mount with an origin and +z, from the joint covariance (6, 6) of both. An error dz across z is the
    rotation z x dz about the origin."""
    across = np.linalg.svd(z[None])[2][1:]
    x, y = across if np.linalg.det(np.vstack([across, z])) > 0 else across[::-1]
    pose = RigidTransform.from_components(origin, Rotation.from_matrix(np.stack([x, y, z], axis=1)))
    to_rotation = np.cross(z, np.eye(3)).T
    to_twist = np.zeros((6, 6))
    to_twist[:3, 3:] = to_rotation
    to_twist[3:, :3] = np.eye(3)
    to_twist[3:, 3:] = -displacement(origin)[:, :3] @ to_rotation  # the twist rotates about the coordinates' origin
    return Mount(pose, to_twist @ joint @ to_twist.T, residual_mm)


def refuse_unlikely(squares: float, freedom: int, what: str) -> None:
    """Raise RobotRefusedError if a normalised sum of squares is improbable for its degrees of freedom."""
    if freedom > 0 and chdtrc(freedom, squares) < FALSE_ALARM:
        raise RobotRefusedError(
            f"{what} deviate by {np.sqrt(squares / freedom):.1f} times their stated accuracy: two are swapped, "
            "something moved, or the stated accuracy is too optimistic; measure again"
        )


def _need(condition: bool | np.bool_, message: str) -> None:
    if not condition:
        raise UnusableInputError(message)


@dataclass(frozen=True, eq=False)
class CalibratedAxes:
    """`manipulator` with the K axes of its arm as measured; `covariance` (6 K, 6 K) of their twists; `residual_mm`
    (N, M) of the measured targets."""

    manipulator: Manipulator
    covariance: np.ndarray
    residual_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class CalibratedRobot:
    """A calibrated robot. `manipulator`: with all calibrations applied.

    `covariance` (6 K + 12, 6 K + 12): of the twists of the arm's K axes (MCS, at q = 0), then of frame and wire on the
    flange (flange coordinates). These errors are common to all poses. Independent in every pose, of the flange's twist
    in flange coordinates (6,): `compliance_sd`, that the encoders cannot see, and `pose_sd`, of kinematics that are
    stated and not measured.
    """

    manipulator: Manipulator
    covariance: np.ndarray
    compliance_sd: np.ndarray
    pose_sd: np.ndarray = field(default_factory=lambda: np.zeros(6))

    def __post_init__(self) -> None:
        size = 6 * self.manipulator.arm_joints + 12
        if self.covariance.shape != (size, size) or np.linalg.eigvalsh(self.covariance)[0] < -1e-12:
            raise UnusableInputError(
                f"a robot's calibration needs a covariance ({size}, {size}) without negative variances"
            )

    @staticmethod
    def of(axes: CalibratedAxes, frame: Mount, wire: Mount, *, on_frame: bool = False) -> "CalibratedRobot":
        """Return the robot from its three independent calibrations. The wire is fed along its mount's +z. `on_frame`:
        the wire's mount is on the frame (`seen_axis`), not on the flange."""
        covariance = np.zeros((len(axes.covariance) + 12,) * 2)
        covariance[_AXES, _AXES] = axes.covariance
        covariance[_FRAME, _FRAME], covariance[_WIRE, _WIRE] = frame.covariance, wire.covariance
        pose = wire.pose
        if on_frame:
            carried, pose = adjoint(frame.pose), frame.pose * wire.pose
            covariance[_WIRE, _WIRE] = carried @ wire.covariance @ carried.T + frame.covariance
            covariance[_WIRE, _FRAME] = covariance[_FRAME, _WIRE] = frame.covariance
        manipulator = axes.manipulator.with_mounts(frame.pose, pose)
        return CalibratedRobot(manipulator, covariance, COMPLIANCE_SD if manipulator.has_feed else GUIDE_COMPLIANCE_SD)

    def with_wire_seen(self, q: np.ndarray, wire_mm: np.ndarray, covariance_mm2: np.ndarray) -> "CalibratedRobot":
        """Return the robot with its mounts of frame and wire corrected by images of both at the joints `q` (n,).

        `wire_mm` (2, 3): a point of the wire and its tip, CFCS, as reconstructed from the images, with their
        `covariance_mm2` (6, 6); along the wire only the tip counts, and where a wire stands out of a guide nothing. A
        linear update of the stated errors of the mounts: axes, play and deflection are common to frame and wire at one
        pose, so only the feed's own error enters. Errors of the images that a plan on them shares with the wire are
        counted in both. Raises UnusableInputError, and RobotRefusedError where images and encoders disagree beyond
        their stated errors.
        """
        (point, tip), manipulator = wire_mm, self.manipulator
        cfcs = manipulator.T_mcs_cfcs(q)
        known = cfcs.inv() * manipulator.T_mcs_tool(q)
        x, y, along = known.rotation.as_matrix().T
        expected_tip = known.translation
        if not manipulator.has_feed:
            expected_tip = expected_tip + (tip - expected_tip) @ along * along
        behind_mm = float((expected_tip - point) @ along)
        if behind_mm < MIN_SEEN_MM:
            raise UnusableInputError(
                f"the first point lies {behind_mm:.0f} mm behind the wire's tip by the encoders (at least "
                f"{MIN_SEEN_MM:g} mm); give a point of the wire near the guide as the entry and its tip as the end"
            )
        on_wire = np.stack([expected_tip - behind_mm * along, expected_tip])
        select = np.zeros((5 if manipulator.has_feed else 4, 6))
        select[:2, :3], select[2:, 3:] = (x, y), np.eye(3) if manipulator.has_feed else (x, y)
        residual = select @ (wire_mm - on_wire).ravel()
        to_cfcs = np.kron(np.eye(2), cfcs.rotation.inv().as_matrix())
        move = select @ to_cfcs @ displacement(cfcs.apply(on_wire)).reshape(-1, 6)
        design = np.zeros((len(select), len(self.covariance)))
        design[:, _WIRE] = move @ self._to_flange(q)
        design[:, _FRAME] = -design[:, _WIRE]
        fed = move @ (manipulator.tool_jacobian(q) - manipulator.flange_jacobian(q)) * self.joint_sd
        expected = design @ self.covariance @ design.T + select @ covariance_mm2 @ select.T + fed @ fed.T
        _refuse_disagreement(residual, expected, tip - expected_tip)
        gain = np.linalg.solve(expected, design @ self.covariance).T
        shift, covariance = gain @ residual, self.covariance - gain @ design @ self.covariance
        frame, wire = (RigidTransform.from_exp_coords(shift[block]) for block in (_FRAME, _WIRE))
        corrected = manipulator.with_mounts(frame * manipulator.T_flange_cfcs, wire * manipulator.T_flange_tool)
        return replace(self, manipulator=corrected, covariance=(covariance + covariance.T) / 2)

    def wire_against_frame(
        self, imaged: np.ndarray, drilling: np.ndarray, xyz_mm: np.ndarray, stated: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        """Return for each of SOURCES the covariance (3N, 3N) mm² of points (N, 3) MCS of the wire at the joints
        `drilling` (n,), relative to a patient located in the frame at the joints `imaged` (n,). `stated` (6, 6): of the
        flange's pose then, in place of `pose_sd`.

        Errors common to both poses cancel: at the same joints the axes cancel and the mounts remain.
        """
        move = displacement(xyz_mm).reshape(-1, 6)
        wire, frame = self._to_flange(drilling), self._to_flange(imaged)
        axes = move @ (self.manipulator.axes_jacobian(drilling) - self.manipulator.axes_jacobian(imaged))
        # What the wire's mount shares with the frame's (`with_wire_seen`) is counted with the frame's.
        follows = self.covariance[_WIRE, _FRAME] @ np.linalg.pinv(self.covariance[_FRAME, _FRAME], hermitian=True)
        own = self.covariance[_WIRE, _WIRE] - follows @ self.covariance[_FRAME, _WIRE]
        shared = (
            (axes, self.covariance[_AXES, _AXES]),
            (move @ (wire @ follows - frame), self.covariance[_FRAME, _FRAME]),
            (move @ wire, own),
        )
        covariances = {
            name: part @ covariance @ part.T for name, (part, covariance) in zip(SOURCES, shared, strict=False)
        }
        covariances["encoders"] = self._of_joints(move, drilling, feed=True) + self._of_joints(move, imaged, feed=False)
        unseen, pose = np.diag(self.compliance_sd**2), np.diag(self.pose_sd**2)
        covariances["compliance"] = move @ (wire @ unseen @ wire.T + frame @ unseen @ frame.T) @ move.T
        then = pose if stated is None else stated
        covariances["kinematics"] += move @ (wire @ pose @ wire.T + frame @ then @ frame.T) @ move.T
        return covariances

    def frame_moved(
        self, imaged: np.ndarray, now: np.ndarray, about_mm: np.ndarray
    ) -> tuple[RigidTransform, np.ndarray]:
        """Return how a patient at rest moved in the frame's coordinates since the joints `imaged` (n,), if the frame is
        on its mount again at the joints `now` (n,).

        The motion maps CFCS then to CFCS now. Its covariance (6, 6) is that of a rotation about the point `about_mm`
        (3,), CFCS then, and of a shift there; axes of CFCS now, rad and mm. Errors common to both poses cancel;
        REMOUNT_SD is added. A movement of the patient is not in it.
        """
        manipulator = self.manipulator
        then, stood = manipulator.T_mcs_cfcs(imaged), manipulator.T_mcs_cfcs(now)
        turned = self._to_flange(now) - self._to_flange(imaged)
        axes = manipulator.axes_jacobian(now) - manipulator.axes_jacobian(imaged)
        unseen, remount = np.diag(self.compliance_sd**2 + self.pose_sd**2), adjoint(stood) * REMOUNT_SD
        twist = axes @ self.covariance[_AXES, _AXES] @ axes.T
        twist += turned @ self.covariance[_FRAME, _FRAME] @ turned.T + remount @ remount.T
        for q in (imaged, now):
            moved = manipulator.flange_jacobian(q) * self.joint_sd
            twist += moved @ moved.T + self._to_flange(q) @ unseen @ self._to_flange(q).T
        back = stood.rotation.inv().as_matrix()
        to_point = np.zeros((6, 6))
        to_point[:3, :3], to_point[3:] = back, back @ displacement(then.apply(about_mm))
        return stood.inv() * then, to_point @ twist @ to_point.T

    @cached_property
    def joint_sd(self) -> np.ndarray:
        """(n,): standard deviation of a joint's position from encoder resolution and backlash, both uniform; mm,
        rad."""
        return np.hypot(self.manipulator.resolution, self.manipulator.backlash) / np.sqrt(12)

    def _to_flange(self, q: np.ndarray) -> np.ndarray:
        """Return the matrix (6, 6) that maps a twist in flange coordinates to MCS."""
        return adjoint(self.manipulator.T_mcs_flange(q))

    def _of_joints(self, move: np.ndarray, q: np.ndarray, *, feed: bool) -> np.ndarray:
        moved = self.manipulator.tool_jacobian(q) if feed else self.manipulator.flange_jacobian(q)
        return (move @ moved * self.joint_sd**2) @ (move @ moved).T


def _refuse_disagreement(residual: np.ndarray, covariance: np.ndarray, tip_off_mm: np.ndarray) -> None:
    """Raise RobotRefusedError if a residual is improbable for its covariance."""
    squares = float(residual @ np.linalg.solve(covariance, residual))
    if chdtrc(len(residual), squares) < FALSE_ALARM:
        raise RobotRefusedError(
            f"images and encoders disagree: the tip lies {np.linalg.norm(tip_off_mm):.2f} mm from where the encoders "
            f"put it; the deviations are {np.sqrt(squares / len(residual)):.1f} times the stated errors. Frame or wire "
            "moved on the flange, or another line was picked; look at both images, then calibrate the robot again"
        )


def calibrate_axes(manipulator: Manipulator, q: np.ndarray, targets_mm: np.ndarray, sd_mm: float) -> CalibratedAxes:
    """Return the axes of the arm from M targets on the flange, measured at N joint positions `q` (N, n): (N, M, 3) mm,
    MCS.

    `sd_mm`: standard deviation of a measured target, per axis. The positions of the targets on the flange are estimated
    too. The machining tolerances are the prior of the axes, so that directions without measurements keep their
    uncertainty. Raises UnusableInputError, and RobotRefusedError for measurements that do not fit such a manipulator.
    """
    q, measured = np.asarray(q, dtype=np.float64), np.asarray(targets_mm, dtype=np.float64)
    if measured.ndim != 3 or measured.shape[::2] != (len(q), 3) or not np.isfinite(measured).all() or sd_mm <= 0:
        raise UnusableInputError("measured targets must be finite numbers (N, M, 3), for joint positions (N, n)")
    n, m = measured.shape[:2]
    known = np.tile(1 / MACHINED_SD, manipulator.arm_joints)
    if 3 * n * m <= 3 * m + len(known):
        raise UnusableInputError(
            f"{n} poses of {m} targets do not determine {manipulator.arm_joints} axes; measure more poses"
        )
    twists, places = np.zeros(len(known)), manipulator.T_mcs_flange(q[0]).inv().apply(measured[0])
    manipulator.refuse_misread(q, [f"pose {k + 1}" for k in range(n)])
    for _ in range(_MAX_ITERATIONS):
        now = manipulator.displaced(twists)
        pose = now.T_mcs_flange(q)
        expected = np.stack([pose.apply(place) for place in places], axis=1)
        residual = (measured - expected) / sd_mm
        design = _target_design(now, q, expected) / sd_mm
        whole = np.vstack([design, np.hstack([np.diag(known), np.zeros((len(known), 3 * m))])])
        step, *_ = np.linalg.lstsq(whole, np.concatenate([residual.ravel(), -known * twists]), rcond=None)
        # Successive twists of one axis add up to first order only; the step vanishes at convergence.
        twists, places = twists + step[: len(known)], places + step[len(known) :].reshape(m, 3)
        if np.abs(step).max() < _TOLERANCE:
            break
    else:
        raise RobotRefusedError("the calibration of the axes does not converge; check the units and the order of poses")
    what = "the measured targets, against the model of the arm that is named,"
    refuse_unlikely((residual**2).sum() + ((known * twists) ** 2).sum(), 3 * n * m - 3 * m, what)
    covariance = np.linalg.inv(whole.T @ whole)[: len(known), : len(known)]
    covariance = (covariance + covariance.T) / 2  # of many axes rounding leaves 1e-9 of it
    return CalibratedAxes(now, covariance, sd_mm * np.linalg.norm(residual, axis=-1))


def _target_design(manipulator: Manipulator, q: np.ndarray, expected_mm: np.ndarray) -> np.ndarray:
    """Return the design matrix (3NM, 6K + 3M): derivatives of the targets by the axes and by their places on the
    flange."""
    n, m = expected_mm.shape[:2]
    of_axes = np.einsum("nmai,nij->nmaj", displacement(expected_mm), manipulator.axes_jacobian(q))
    of_places = np.zeros((n, m, 3, m, 3))
    rotation = manipulator.T_mcs_flange(q).rotation.as_matrix()
    for target in range(m):
        of_places[:, target, :, target] = rotation
    return np.concatenate([of_axes.reshape(3 * n * m, -1), of_places.reshape(3 * n * m, -1)], axis=1)
