"""Mounts: poses of frame and wire on the flange, measured directly or by hand-eye calibration."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtrc  # not scipy.stats, which takes half a second to import

from sightline.common.geometry.rigid import adjoint, displacement
from sightline.errors import RobotRefusedError, UnusableInputError

# A fit less probable than this means swapped points or a wrong stated accuracy [ours].
MIN_PROBABILITY = 1e-4
# Least rotation between the poses of a hand-eye calibration: less leaves the lever arm undetermined [ours].
MIN_ROTATION_RAD = float(np.deg2rad(10.0))
_MAX_ITERATIONS, _TOLERANCE = 50, 1e-10


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
    z = slope / length
    across = np.linalg.svd(z[None])[2][1:]
    x, y = across if np.linalg.det(np.vstack([across, z])) > 0 else across[::-1]
    pose = RigidTransform.from_components(origin, Rotation.from_matrix(np.stack([x, y, z], axis=1)))
    # Covariance of (origin, slope), per axis; a slope error dz across z is the rotation z x dz about the origin.
    normal = sd_mm**2 * np.linalg.inv(design.T @ design)
    joint = np.kron(normal, np.eye(3))
    to_rotation = np.cross(z, np.eye(3)).T
    to_twist = np.zeros((6, 6))
    to_twist[:3, 3:] = to_rotation
    to_twist[3:, :3] = np.eye(3)
    to_twist[3:, 3:] = -displacement(origin)[:, :3] @ to_rotation  # the twist rotates about the flange's origin
    return Mount(pose, to_twist @ joint @ to_twist.T, np.linalg.norm(residual, axis=1))


def hand_eye(T_mcs_flange: RigidTransform, T_world_mount: RigidTransform, covariance: np.ndarray) -> Mount:
    """Return a mount from N >= 3 poses of flange and mount; the latter in the coordinates of a tracker fixed in the
    theatre.

    `covariance` (6, 6): of each measured pose of the mount, as a twist in the mount's own coordinates. The tracker's
    pose is estimated too. Raises UnusableInputError, and RobotRefusedError for too little rotation between the poses or
    for poses that contradict each other.
    """
    n = len(T_mcs_flange)
    _need(len(T_world_mount) == n and n >= 3, "a hand-eye calibration needs three poses or more, of both")
    _refuse_small_rotations(T_mcs_flange.rotation)
    mount, world = _hand_eye_start(T_mcs_flange, T_world_mount)
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    for _ in range(_MAX_ITERATIONS):
        expected = world * T_mcs_flange * mount
        error = (expected.inv() * T_world_mount).as_exp_coords() @ root.T
        back = adjoint((T_mcs_flange * mount).inv())
        to_mount = np.broadcast_to(adjoint(mount.inv()), (n, 6, 6))
        design = np.einsum("ab,nbc->nac", root, np.concatenate([to_mount, back], axis=-1)).reshape(-1, 12)
        step, *_ = np.linalg.lstsq(design, error.ravel(), rcond=None)
        mount = RigidTransform.from_exp_coords(step[:6]) * mount
        world = world * RigidTransform.from_exp_coords(step[6:])
        if np.abs(step).max() < _TOLERANCE:
            break
    else:
        raise RobotRefusedError(
            "the hand-eye calibration does not converge; check that the poses of frame and flange belong together"
        )
    refuse_unlikely((error**2).sum(), 6 * n - 12, "the measured poses")
    found = np.linalg.inv(design.T @ design)[:6, :6]
    left = (world * T_mcs_flange * mount).inv() * T_world_mount
    return Mount(mount, found, np.linalg.norm(left.translation, axis=1))


def _hand_eye_start(flange: RigidTransform, seen: RigidTransform) -> tuple[RigidTransform, RigidTransform]:
    """Return (mount, world) by least squares in closed form: rotations from relative rotations, then translations."""
    pairs = [(i, j) for i in range(len(flange)) for j in range(i)]
    i, j = np.array(pairs).T
    moved = (flange[j].inv() * flange[i]).rotation.as_rotvec()
    shown = (seen[j].inv() * seen[i]).rotation.as_rotvec()
    # The mount's rotation maps one set of relative rotation vectors to the other.
    rotation, *_ = Rotation.align_vectors(moved, shown)
    to_world = (seen.rotation * rotation.inv() * flange.rotation.inv()).mean()
    # seen = to_world (R_flange m + t_flange) + w, linear in m and w
    lever = (to_world * flange.rotation).as_matrix()
    design = np.concatenate([lever, np.broadcast_to(np.eye(3), lever.shape)], axis=-1).reshape(-1, 6)
    rest = seen.translation - to_world.apply(flange.translation)
    (*solution,) = np.linalg.lstsq(design, rest.ravel(), rcond=None)[0]
    return (
        RigidTransform.from_components(np.array(solution[:3]), rotation),
        RigidTransform.from_components(np.array(solution[3:]), to_world),
    )


def _refuse_small_rotations(rotation: Rotation) -> None:
    """Raise RobotRefusedError unless the poses rotate about two axes: one axis leaves the position along it open."""
    rotations = (rotation[0].inv() * rotation).as_rotvec()
    second = np.linalg.svd(rotations, compute_uv=False)[1]
    if second < MIN_ROTATION_RAD:
        raise RobotRefusedError(
            f"the poses rotate by {np.rad2deg(second):.1f}° about a second axis, at least "
            f"{np.rad2deg(MIN_ROTATION_RAD):.0f}° are needed; rotate the wrist about both of its axes"
        )


def refuse_unlikely(squares: float, freedom: int, what: str) -> None:
    """Raise RobotRefusedError if a normalised sum of squares is improbable for its degrees of freedom."""
    if freedom > 0 and chdtrc(freedom, squares) < MIN_PROBABILITY:
        raise RobotRefusedError(
            f"{what} deviate by {np.sqrt(squares / freedom):.1f} times their stated accuracy: two are swapped, "
            "something moved, or the stated accuracy is too optimistic; measure again"
        )


def _need(condition: bool | np.bool_, message: str) -> None:
    if not condition:
        raise UnusableInputError(message)
