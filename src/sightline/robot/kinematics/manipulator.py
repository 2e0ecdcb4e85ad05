"""The manipulator's joints, and forward and inverse kinematics of flange, wire and frame. docs/robot.md has the
drawing.

q (..., 5): lift, traverse (mm), yaw, pitch (rad), feed (mm). A pose is the product of exponentials of the screw axes,
so axes displaced by a calibration need no special case. Poses and twists as in geometry/rigid.py: (rotation rad,
translation mm), spatial, in MCS.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.geometry.lines import nearest_approach
from sightline.common.geometry.rigid import adjoint, cross_matrix, displacement
from sightline.errors import RobotRefusedError, UnusableInputError

JOINTS = ("lift", "traverse", "yaw", "pitch", "feed")
LIFT, TRAVERSE, YAW, PITCH, FEED = range(5)
ROTARY = np.array([False, False, True, True, False])
ARM_JOINTS = 4  # joints that move the flange; the feed moves the wire on it
# The design [ours], with the numbers of `nominal_manipulator`: ball screws and geared rotations. The axes of yaw and
# pitch intersect in WRIST_MM at q = 0, MCS; in flange coordinates the tip at q = 0, ahead of the wrist and below it,
# and the hip, on the wire's axis and 150 mm ahead of the retracted tip.
WRIST_MM, TIP_MM, HIP_MM = (250.0, 0.0, 300.0), (0.0, -40.0, 250.0), (0.0, -40.0, 400.0)
WIRE_YAW_RAD = float(np.deg2rad(45.0))  # a wire of 135° to the shaft, seen from the robot beside the patient [paper]
# Newton's stopping tolerance for the tip (mm) and the direction (rad): rounding at 1 m is 1e-13.
_TOLERANCE, _MAX_ITERATIONS = 1e-11, 20
_SLACK = 1e-9  # rounding allowed beyond a joint limit, mm or rad
_MIN_COMPONENT = 1e-6  # a component smaller than this gives no direction


@dataclass(frozen=True, eq=False)
class Manipulator:
    """A manipulator of five joints, MCS. Arrays (5,) are in the joints' units: mm or rad, s; forces in N and N mm.

    `axes` (5, 6): each joint's unit twist at q = 0; a rotation without pitch, or a translation. `T_mcs_flange_home`:
    the flange at q = 0. `T_flange_tool`: the wire on the flange at feed 0, origin at the tip, +z along the wire towards
    it. `T_flange_cfcs`: the frame on the flange. `backlash`: total play of a joint, not seen by its encoder;
    `stiffness`: of the joint behind its encoder, N/mm and N mm/rad; `column_stiffness`: N/mm along X, where no joint
    moves.
    """

    axes: np.ndarray
    T_mcs_flange_home: RigidTransform
    T_flange_tool: RigidTransform
    T_flange_cfcs: RigidTransform
    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    resolution: np.ndarray
    backlash: np.ndarray
    stiffness: np.ndarray
    column_stiffness: float

    def __post_init__(self) -> None:
        rotation = np.linalg.norm(self.axes[:, :3], axis=1)
        translation = np.linalg.norm(self.axes[:, 3:], axis=1)
        pitch = np.einsum("ij,ij->i", self.axes[:, :3], self.axes[:, 3:])
        if not np.allclose(np.where(ROTARY, rotation, translation), 1.0, atol=1e-9) or not np.allclose(
            np.where(ROTARY, pitch, rotation), 0.0, atol=1e-9
        ):
            raise UnusableInputError(f"the axes of {', '.join(JOINTS)} must be unit twists without pitch")
        for array in filter(lambda value: isinstance(value, np.ndarray), vars(self).values()):
            array.flags.writeable = False

    def T_mcs_flange(self, q: np.ndarray) -> RigidTransform:
        """Return the pose of the flange at q (5,) or (N, 5)."""
        return RigidTransform.from_matrix(self.stages(q)[..., ARM_JOINTS, :, :] @ self._flange)

    def T_mcs_tool(self, q: np.ndarray) -> RigidTransform:
        """Return the pose of the wire's tip at q (5,) or (N, 5): +z along the wire, towards the tip."""
        return RigidTransform.from_matrix(self.tool_matrix(q))

    def tool_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return the matrix (..., 4, 4) of `T_mcs_tool`, whose RigidTransform takes four times as long."""
        return self.stages(q)[..., -1, :, :] @ self._tool

    def T_mcs_cfcs(self, q: np.ndarray) -> RigidTransform:
        """Return the pose of the frame at q (5,) or (N, 5)."""
        return self.T_mcs_flange(q) * self.T_flange_cfcs

    def flange_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the flange's spatial Jacobian (..., 6, 5), a twist per joint; the feed's column is zero."""
        jacobian = self.tool_jacobian(q)
        jacobian[..., FEED] = 0.0
        return jacobian

    def tool_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's spatial Jacobian (..., 6, 5), a twist per joint."""
        before = self.stages(q)[..., :-1, :, :]
        rotated, shift = before[..., :3, :3], before[..., :3, 3]
        rotation = np.einsum("...jab,jb->...ja", rotated, self.axes[:, :3])
        translation = np.einsum("...jab,jb->...ja", rotated, self.axes[:, 3:]) + np.cross(shift, rotation)
        return np.swapaxes(np.concatenate([rotation, translation], axis=-1), -1, -2)

    def flange_parameter_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the flange's spatial twist per entry of `displaced`'s twists, (..., 6, 36); the feed's columns are
        zero.

        Displacing an axis by x turns its motion into exp(x) exp(axis q) exp(-x). To first order that is x transformed
        by the joints before it, less x transformed by these and the joint itself.
        """
        stages = self.stages(q)
        carried = adjoint(RigidTransform.from_matrix(stages.reshape(-1, 4, 4))).reshape(*stages.shape[:-2], 6, 6)
        jacobian = np.zeros((*stages.shape[:-3], 6, len(JOINTS) + 1, 6))
        for joint in range(ARM_JOINTS):
            jacobian[..., joint, :] = carried[..., joint, :, :] - carried[..., joint + 1, :, :]
        jacobian[..., -1, :] = carried[..., ARM_JOINTS, :, :]
        return jacobian.reshape(*jacobian.shape[:-2], -1)

    def displaced(self, twists: np.ndarray) -> "Manipulator":
        """Return the manipulator with its five axes, and the flange with all that is on it, each displaced by a spatial
        twist at q = 0, `twists` (6, 6)."""
        moves = RigidTransform.from_exp_coords(np.asarray(twists, dtype=np.float64).reshape(len(JOINTS) + 1, 6))
        return replace(
            self,
            axes=np.einsum("jab,jb->ja", adjoint(moves[: len(JOINTS)]), self.axes),
            T_mcs_flange_home=moves[-1] * self.T_mcs_flange_home,
        )

    def inverse(self, entry_mm: np.ndarray, end_mm: np.ndarray, depth_mm: float = 0.0) -> np.ndarray:
        """Return q (5,) that puts the wire on the line from entry to end (3,) MCS, its tip `depth_mm` beyond the entry.

        Closed form for the nominal axes and any tool, then Newton's method for displaced axes. Raises RobotRefusedError
        for a line out of reach, naming the joints and by how much.
        """
        direction = _direction(entry_mm, end_mm)
        tip = np.asarray(entry_mm, dtype=np.float64) + depth_mm * direction
        if not np.isfinite(tip).all():
            raise UnusableInputError("a depth is a finite number")
        q = self._nominal_inverse(tip, direction)
        for _ in range(_MAX_ITERATIONS):
            q, off = self._newton(q, tip, direction)
            if off < _TOLERANCE:
                break
        else:
            raise RobotRefusedError(
                "no position of the joints was found that lays the wire on this line: the axes differ too much from "
                "the nominal ones; calibrate the manipulator again"
            )
        self._refuse_beyond(q)
        return q

    def beyond_limits(self, q: np.ndarray) -> np.ndarray:
        """Return by how much each joint exceeds its limits, signed, (..., 5); 0 within them, NaN for NaN."""
        q = np.asarray(q, dtype=np.float64)
        beyond = q - np.minimum(np.maximum(q, self.lower), self.upper)
        return np.where(np.abs(beyond) <= _SLACK, 0.0, beyond)

    def stages(self, q: np.ndarray) -> np.ndarray:
        """Return the displacement from q = 0, MCS, of bodies carried by the first 0 to 5 joints, (..., 6, 4, 4)."""
        q = np.asarray(q, dtype=np.float64)
        if q.shape[-1:] != (len(JOINTS),):
            raise UnusableInputError(f"joint positions are (..., {len(JOINTS)}), not {q.shape}")
        each = self._exponentials(q)
        displacements = np.empty((*q.shape[:-1], len(JOINTS) + 1, 4, 4))
        displacements[..., 0, :, :] = np.eye(4)
        for joint in range(len(JOINTS)):
            displacements[..., joint + 1, :, :] = displacements[..., joint, :, :] @ each[..., joint, :, :]
        return displacements

    @cached_property
    def _flange(self) -> np.ndarray:
        return self.T_mcs_flange_home.as_matrix()

    @cached_property
    def _tool(self) -> np.ndarray:
        return (self.T_mcs_flange_home * self.T_flange_tool).as_matrix()

    @cached_property
    def _wrist(self) -> np.ndarray:
        """(3,): intersection, or point of nearest approach, of the yaw and pitch axes at q = 0, mm."""
        axis, moment = self.axes[[YAW, PITCH], :3], self.axes[[YAW, PITCH], 3:]
        point = np.cross(axis, moment)
        return nearest_approach(point[0], axis[0], point[1], axis[1]).middle_mm

    @cached_property
    def _screws(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(5, 3, 3) cross matrices of the rotations and their squares, (5, 3) translations."""
        cross = cross_matrix(self.axes[:, :3])
        return cross, cross @ cross, self.axes[:, 3:]

    def _exponentials(self, q: np.ndarray) -> np.ndarray:
        """Return each joint's own motion, (..., 5, 4, 4): Rodrigues' formula, which for a translation gives q v."""
        cross, square, velocity = self._screws
        at = q[..., None, None]
        sine, versine = np.sin(at), 1 - np.cos(at)
        motions = np.zeros((*q.shape, 4, 4))
        motions[..., :3, :3] = np.eye(3) + sine * cross + versine * square
        along = at * np.eye(3) + versine * cross + (at - sine) * square
        motions[..., :3, 3] = np.einsum("...jab,jb->...ja", along, velocity)
        motions[..., 3, 3] = 1.0
        return motions

    def _nominal_inverse(self, tip: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return q (5,) in closed form for vertical yaw, level pitch (positive lifts the tip), lift along Z and
        traverse along Y."""
        q = np.zeros(len(JOINTS))
        q[PITCH] = self._pitch(direction)
        wire, feed = _lifted(self._tool[:3, 2], q[PITCH]), _lifted(self.axes[FEED, 3:], q[PITCH])
        yaw = np.arctan2(direction[1], direction[0]) - np.arctan2(wire[1], wire[0])
        q[YAW] = (yaw + np.pi) % (2 * np.pi) - np.pi
        yawed = Rotation.from_rotvec([0.0, 0.0, q[YAW]]).as_matrix()
        reach, along = yawed @ _lifted(self._tool[:3, 3] - self._wrist, q[PITCH]), yawed @ feed
        if np.hypot(*direction[:2]) < _MIN_COMPONENT or abs(along[0]) < _MIN_COMPONENT:
            raise RobotRefusedError(
                "the line runs straight up or across the robot's front, where no joint reaches along it; move the base"
            )
        q[FEED] = (tip[0] - self._wrist[0] - reach[0]) / along[0]
        _, q[TRAVERSE], q[LIFT] = tip - self._wrist - reach - q[FEED] * along
        return q

    def _pitch(self, direction: np.ndarray) -> float:
        """Return the pitch, rad, at which the wire has the elevation of a direction."""
        x, _, z = self._tool[:3, 2]
        radius = np.hypot(x, z)
        if abs(direction[2]) > radius:
            raise RobotRefusedError("no pitch makes the wire as steep as this line; bring the robot to another place")
        return float(np.arcsin(direction[2] / radius) - np.arctan2(z, x))

    def _newton(self, q: np.ndarray, tip: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, float]:
        """Return q after one Newton step, and the wire's largest error before it, in mm or rad."""
        tool = self.stages(q)[-1] @ self._tool
        off = np.concatenate([tip - tool[:3, 3], direction - tool[:3, 2]])
        size = float(np.abs(off).max())
        if size < _TOLERANCE:
            return q, size
        twist = self.tool_jacobian(q)
        design = np.concatenate([displacement(tool[:3, 3]) @ twist, -cross_matrix(tool[:3, 2]) @ twist[:3]])
        return q + np.linalg.lstsq(design, off, rcond=None)[0], size

    def _refuse_beyond(self, q: np.ndarray) -> None:
        beyond = self.beyond_limits(q)
        excesses = [describe_excess(joint, q[joint], beyond[joint]) for joint in np.flatnonzero(beyond).tolist()]
        if excesses:
            raise RobotRefusedError(
                f"the line is out of reach: {'; '.join(excesses)}; move the robot's base or the line"
            )


def imaging_yaw(side: str) -> float:
    """Return the yaw, rad, at which the frame on its nominal mount is level and square to the patient."""
    return WIRE_YAW_RAD if side == "right" else -WIRE_YAW_RAD


def nominal_manipulator(
    side: str = "right", hip_mm: ArrayLike = (0.0, 0.0, 0.0), yaw_rad: float | None = None
) -> Manipulator:
    """Return the manipulator as designed, with a frame mounted for a hip of the patient's `side`.

    `hip_mm` (3,), CFCS: where the hip lies, at the origin of a Γ frame, beside a block. The robot stands beside the
    patient: +X medial, +Z anterior. The mount rotates the frame relative to the wire, so that its beams are level and
    upright at `yaw_rad`, by default that of a typical wire.
    """
    if side not in ("right", "left"):
        raise UnusableInputError(f"a hip's side is 'right' or 'left', not {side!r}")
    wrist = np.array(WRIST_MM)
    # Flange axes at q = 0: z along the wire (MCS +X), y up, x along MCS +Y.
    home = RigidTransform.from_components(wrist, Rotation.from_matrix(np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])))
    up, sideways, ahead = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    axes = np.zeros((5, 6))
    axes[LIFT, 3:], axes[TRAVERSE, 3:], axes[FEED, 3:] = up, sideways, ahead
    for joint, axis in ((YAW, up), (PITCH, -sideways)):
        axes[joint] = np.concatenate([axis, np.cross(wrist, axis)])
    yaw = imaging_yaw(side) if yaw_rad is None else yaw_rad
    upright = Rotation.from_rotvec([0.0, 0.0, np.pi])  # CFCS in MCS: +X lateral, +Z up
    mount = (Rotation.from_rotvec([0.0, 0.0, yaw]) * home.rotation).inv() * upright
    return Manipulator(
        axes=axes,
        T_mcs_flange_home=home,
        T_flange_tool=RigidTransform.from_translation(TIP_MM),
        T_flange_cfcs=RigidTransform.from_components(HIP_MM - mount.apply(hip_mm), mount),
        lower=_per_joint(-100.0, -60.0, -45.0, 0.0),
        upper=_per_joint(100.0, 60.0, 45.0, 250.0),
        speed=_per_joint(20.0, 10.0, 10.0, 20.0),
        acceleration=_per_joint(800.0, 400.0, 400.0, 800.0),  # from full speed to rest in 25 ms
        resolution=_per_joint(0.005, 360 / 2**17, 360 / 2**17, 0.005),
        backlash=_per_joint(0.01, 0.05, 0.05, 0.01),  # yaw and pitch as in the accuracy trial
        stiffness=np.array([2e3, 2e3, 5e7, 5e7, 1e3]),
        column_stiffness=1e3,
    )


def _per_joint(slide: float, yaw_deg: float, pitch_deg: float, feed: float) -> np.ndarray:
    """Return values per joint (5,): lift and traverse alike; degrees converted to rad."""
    return np.array([slide, slide, np.deg2rad(yaw_deg), np.deg2rad(pitch_deg), feed])


def _direction(entry_mm: np.ndarray, end_mm: np.ndarray) -> np.ndarray:
    along = np.asarray(end_mm, dtype=np.float64) - np.asarray(entry_mm, dtype=np.float64)
    length = np.linalg.norm(along)
    if along.shape != (3,) or not np.isfinite(length):
        raise UnusableInputError("entry and end point are three finite numbers each")
    if length == 0:
        raise RobotRefusedError("entry and end point are the same and give no direction; plan again")
    return along / length


def _lifted(vector: np.ndarray, pitch: float) -> np.ndarray:
    """Return a vector (3,) rotated by a positive pitch at yaw 0: X towards Z."""
    x, y, z = vector
    return np.array([np.cos(pitch) * x - np.sin(pitch) * z, y, np.sin(pitch) * x + np.cos(pitch) * z])


def fed(q: np.ndarray, by_mm: float) -> np.ndarray:
    """Return the joints (5,) with the wire fed further."""
    return q + by_mm * np.eye(len(JOINTS))[FEED]


def describe_excess(joint: int, q: float, beyond: float, verb: str = "would go to") -> str:
    """Return the text that says by how much a joint would exceed its limit; with `verb` "is at", that it does."""
    scale, unit = (float(np.rad2deg(1.0)), "°") if ROTARY[joint] else (1.0, " mm")
    at, by, limit = (f"{scale * value:.1f}{unit}" for value in (q, abs(beyond), q - beyond))
    return f"{JOINTS[joint]} {verb} {at}, {by} beyond its limit of {limit}"
