"""A serial arm of n joints with a wire and a frame on its flange: forward and inverse kinematics.

q (..., n): positions of the joints, from the base to the flange, mm or rad; a joint that feeds the wire is the last. A
pose is the product of exponentials of the screw axes, so axes displaced by a calibration need no special case. Poses
and twists as in geometry/rigid.py: (rotation rad, translation mm), spatial, in MCS.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.geometry.rigid import adjoint, cross_matrix, displacement
from sightline.errors import RobotRefusedError, UnusableInputError

# Newton's method ends with the step from an error below _CLOSE_MM, which leaves the rounding at 1 m, 1e-12.
_CLOSE_MM, _MAX_ITERATIONS, _DAMPING = 1e-6, 25, 1e-3
_SLACK = 1e-9  # rounding allowed beyond a joint limit, mm or rad
# Starts of the inverse, spread over the joints' range, and the largest change of an angle in one iteration [ours]:
# benchmarks/bench_arm.py counts what they find.
_STARTS, _MAX_STEP_RAD = 32, 0.5
# Rotations about the wire that are tried where something is in the way [ours]: to the last, errors grow by up to 9 %
# [calc].
_TURN_RAD, _TURNS = float(np.deg2rad(15.0)), 4
LEVER_MM = 300.0  # [ours] weighs an angle against a length: about the distance from the wrist to the tip
# [ours] smallest singular value of the wire's motion per joint motion, with angles times LEVER_MM; below it joints must
# move a hundred times as far as the wire.
MIN_SINGULAR = 0.01
_DETERMINED = 5  # joints that a line determines: the solution from the first start is as good as any [calc]
_SHARE = 0.5  # [ours] of the best quality that a solution needs to be ranked by its travel


@dataclass(frozen=True, eq=False)
class Capsule:
    """A part of the robot as a capsule: all points within `radius_mm` of a segment `ends_mm` (2, 3), flange coordinates
    at q = 0. The first `joints` joints move it."""

    name: str
    joints: int
    ends_mm: np.ndarray
    radius_mm: float


@dataclass(frozen=True, eq=False)
class Manipulator:
    """A serial arm of n `joints`, MCS. Arrays (n,) are in the joints' units: mm or rad, s; forces in N and N mm.

    `axes` (n, 6): each joint's unit twist at q = 0; a rotation without pitch, or a translation. `has_feed`: the last
    joint feeds the wire; otherwise a person drills through the guide that the arm holds. `T_mcs_flange_home`: the
    flange at q = 0. `T_flange_tool`: the wire on the flange at feed 0, origin at the tip, +z along the wire towards it;
    without a feed the origin is the mouth of the guide, which is `guide_mm` long. `T_flange_cfcs`: the frame on the
    flange. `backlash`: total play of a joint, not seen by its encoder; `stiffness`: of the joint behind its encoder,
    N/mm and N mm/rad; `column_stiffness`: N/mm along X, where no joint moves. `parts`: for the collision check.
    """

    joints: tuple[str, ...]
    axes: np.ndarray
    has_feed: bool
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
    parts: tuple[Capsule, ...]
    guide_mm: float = 0.0

    def __post_init__(self) -> None:
        rotation = np.linalg.norm(self.axes[:, :3], axis=1)
        translation = np.linalg.norm(self.axes[:, 3:], axis=1)
        pitch = np.einsum("ij,ij->i", self.axes[:, :3], self.axes[:, 3:])
        if (
            self.axes.shape != (self.count, 6)
            or not np.allclose(np.where(self.rotary, rotation, translation), 1.0, atol=1e-9)
            or not np.allclose(np.where(self.rotary, pitch, rotation), 0.0, atol=1e-9)
            or (self.has_feed and self.rotary[-1])
        ):
            raise UnusableInputError(f"the axes of {', '.join(self.joints)} must be unit twists without pitch")
        for array in filter(lambda value: isinstance(value, np.ndarray), vars(self).values()):
            array.flags.writeable = False

    @property
    def count(self) -> int:
        """Number of joints, n."""
        return len(self.joints)

    @property
    def arm_joints(self) -> int:
        """Number of joints that move the flange; a feed moves the wire on it."""
        return self.count - self.has_feed

    @cached_property
    def rotary(self) -> np.ndarray:
        """(n,): which joints rotate."""
        return np.linalg.norm(self.axes[:, :3], axis=1) > 0.5

    @property
    def feed(self) -> int:
        """Index of the joint that feeds the wire. Raises RobotRefusedError where a person feeds it."""
        if not self.has_feed:
            raise RobotRefusedError("this arm has no feed: it holds the guide, and a person drills through it")
        return self.count - 1

    def fed(self, q: np.ndarray, by_mm: float) -> np.ndarray:
        """Return the joints (n,) with the wire fed further."""
        return q + by_mm * np.eye(self.count)[self.feed]

    def along(self, q: np.ndarray, by_mm: float) -> RigidTransform:
        """Return the pose `T_mcs_tool` at q (n,), shifted along the wire."""
        return self.T_mcs_tool(q) * RigidTransform.from_translation([0.0, 0.0, by_mm])

    def T_mcs_flange(self, q: np.ndarray) -> RigidTransform:
        """Return the pose of the flange at q (n,) or (N, n)."""
        return RigidTransform.from_matrix(self.stages(q)[..., self.arm_joints, :, :] @ self._flange)

    def T_mcs_tool(self, q: np.ndarray) -> RigidTransform:
        """Return the pose of the wire's tip at q (n,) or (N, n): +z along the wire, towards the tip."""
        return RigidTransform.from_matrix(self.tool_matrix(q))

    def tool_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return the matrix (..., 4, 4) of `T_mcs_tool`, whose RigidTransform takes four times as long."""
        return self.stages(q)[..., -1, :, :] @ self._tool

    def T_mcs_cfcs(self, q: np.ndarray) -> RigidTransform:
        """Return the pose of the frame at q (n,) or (N, n)."""
        return self.T_mcs_flange(q) * self.T_flange_cfcs

    def flange_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the flange's spatial Jacobian (..., 6, n), a twist per joint; the column of a feed is zero."""
        jacobian = self.tool_jacobian(q)
        jacobian[..., self.arm_joints :] = 0.0
        return jacobian

    def tool_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's spatial Jacobian (..., 6, n), a twist per joint."""
        return self._jacobian(self.stages(q))

    def axes_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the flange's spatial twist per entry of `displaced`'s twists of the arm's K axes, (..., 6, 6 K).

        Displacing an axis by x turns its motion into exp(x) exp(axis q) exp(-x). To first order that is x transformed
        by the joints before it, less x transformed by these and the joint itself.
        """
        stages = self.stages(q)[..., : self.arm_joints + 1, :, :]
        carried = adjoint(RigidTransform.from_matrix(stages.reshape(-1, 4, 4))).reshape(*stages.shape[:-2], 6, 6)
        jacobian = np.swapaxes(carried[..., :-1, :, :] - carried[..., 1:, :, :], -3, -2)
        return jacobian.reshape(*jacobian.shape[:-2], -1)

    def displaced(self, twists: np.ndarray) -> "Manipulator":
        """Return the arm with its axes, and last the flange with all that is on it, each displaced by a spatial twist
        at q = 0: `twists` (K, 6), those beyond K <= n + 1 zero."""
        given = np.asarray(twists, dtype=np.float64).reshape(-1, 6)
        moves = RigidTransform.from_exp_coords(np.pad(given, ((0, self.count + 1 - len(given)), (0, 0))))
        return replace(
            self,
            axes=np.einsum("jab,jb->ja", adjoint(moves[: self.count]), self.axes),
            T_mcs_flange_home=moves[-1] * self.T_mcs_flange_home,
        )

    def with_mounts(self, frame: RigidTransform, wire: RigidTransform) -> "Manipulator":
        """Return the arm with other poses of frame and wire on the flange. A feed moves the wire along its +z."""
        axes = self.axes.copy()
        if self.has_feed:
            axes[self.feed] = [0.0, 0.0, 0.0, *(self.T_mcs_flange_home * wire).rotation.apply([0.0, 0.0, 1.0])]
        return replace(self, axes=axes, T_flange_cfcs=frame, T_flange_tool=wire)

    def inverse(
        self, entry_mm: np.ndarray, end_mm: np.ndarray, depth_mm: float = 0.0, near: np.ndarray | None = None
    ) -> np.ndarray:
        """Return q (n,) that puts the wire on the line from entry to end (3,) MCS, its tip `depth_mm` beyond the entry:
        the first of `solutions`. Raises RobotRefusedError for a line out of reach, with the reason."""
        return self.solutions(entry_mm, end_mm, depth_mm, near)[0]

    def solutions(
        self, entry_mm: np.ndarray, end_mm: np.ndarray, depth_mm: float = 0.0, near: np.ndarray | None = None
    ) -> np.ndarray:
        """Return joints (K, n) as of `inverse`, within the limits, the best first.

        Newton's method from many starts; the rotation about the wire is free. The quality of a solution is the least of
        its distance to the limits, as a share of the range, and of the smallest singular value. Of those with at least
        half of the best quality the one that travels least from `near` (n,), or else from the middle of the range,
        comes first. Raises RobotRefusedError, UnusableInputError.
        """
        tip, direction = np.asarray(entry_mm, dtype=np.float64), _direction(entry_mm, end_mm)
        tip = tip + depth_mm * direction
        if not np.isfinite(tip).all():
            raise UnusableInputError("a depth is a finite number")
        return self._ranked(tip, direction, None, near)

    def inverse_pose(self, T_mcs_tool: RigidTransform, near: np.ndarray | None = None) -> np.ndarray:
        """Return q (n,) that puts the wire there, its rotation about its axis included; `near` as of `solutions`.
        Raises RobotRefusedError, always for fewer than six joints but for a pose that happens to be reached."""
        rotation = T_mcs_tool.rotation.as_matrix()
        return self._ranked(T_mcs_tool.translation, rotation[:, 2], rotation, near)[0]

    def turned(self, q: np.ndarray) -> np.ndarray:
        """Return joints (K, n), within the limits, with the wire as at q (n,) but rotated about its axis by up to 60°,
        the least first. None of an arm whose joints a line determines."""
        ways: list[tuple[int, np.ndarray]] = []
        for turn in () if self.count <= _DETERMINED else (_TURN_RAD, -_TURN_RAD):
            at = q
            for step in range(1, _TURNS + 1):
                rotation = self.tool_matrix(at)[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
                found = self._newton(at[None], self.tool_matrix(at)[:3, 3], rotation[:, 2], rotation)
                if not len(found) or self.beyond_limits(found[0]).any() or self.singular(found)[0] < MIN_SINGULAR:
                    break
                at = found[0]
                ways.append((step, at))
        return np.array([at for _, at in sorted(ways, key=lambda way: way[0])]).reshape(-1, self.count)

    def follow_line(self, q: np.ndarray, depths_mm: np.ndarray) -> np.ndarray:
        """Return joints (K, n) whose tip lies `depths_mm` (K,) further along the wire's axis than at q (n,), each near
        the one before. Raises RobotRefusedError where the arm cannot follow within its limits."""
        tool, way = self.tool_matrix(q), []
        for depth in depths_mm:
            q = self._newton(q[None], tool[:3, 3] + depth * tool[:3, 2], tool[:3, 2], None)
            if not len(q):
                raise RobotRefusedError("the arm is singular on this line; move the robot's base or the line")
            q = q[0]
            self._refuse_beyond(q)
            way.append(q)
        return np.array(way)

    def singular(self, q: np.ndarray) -> np.ndarray:
        """Return the smallest singular value (N,) of the wire's motion at q (N, n): of five, with angles times
        LEVER_MM."""
        design, _ = self._linear(q, np.zeros(3), np.array([0.0, 0.0, 1.0]), None)
        return np.linalg.svd(design / self._weights, compute_uv=False)[..., -1]

    def beyond_limits(self, q: np.ndarray) -> np.ndarray:
        """Return by how much each joint exceeds its limits, signed, (..., n); 0 within them, NaN for NaN."""
        q = np.asarray(q, dtype=np.float64)
        beyond = q - np.minimum(np.maximum(q, self.lower), self.upper)
        return np.where(np.abs(beyond) <= _SLACK, 0.0, beyond)

    def stages(self, q: np.ndarray) -> np.ndarray:
        """Return the displacement from q = 0, MCS, of bodies carried by the first 0 to n joints, (..., n + 1, 4, 4)."""
        q = np.asarray(q, dtype=np.float64)
        if q.shape[-1:] != (self.count,):
            raise UnusableInputError(f"joint positions are (..., {self.count}), not {q.shape}")
        each = self._exponentials(q)
        displacements = np.empty((*q.shape[:-1], self.count + 1, 4, 4))
        displacements[..., 0, :, :] = np.eye(4)
        for joint in range(self.count):
            displacements[..., joint + 1, :, :] = displacements[..., joint, :, :] @ each[..., joint, :, :]
        return displacements

    def refuse_misread(self, q: np.ndarray, names: Sequence[str]) -> None:
        """Raise RobotRefusedError for positions (N, n) that an arm cannot have had, as of joints in degrees. `names`
        (N): of the positions."""
        for name, at in zip(names, q, strict=True):
            if text := self.excesses(at, "is at"):
                raise RobotRefusedError(
                    f"give the joints in rad and mm, from the base to the flange, of the arm that is named: at {name} "
                    f"{text}"
                )

    def excesses(self, q: np.ndarray, *verb: str) -> str:
        """Return `describe_excess` of the joints that exceed their limits at q (n,), "" if none does."""
        beyond = self.beyond_limits(q)
        return "; ".join(self.describe_excess(j, q[j], beyond[j], *verb) for j in np.flatnonzero(beyond).tolist())

    def describe_excess(self, joint: int, q: float, beyond: float, verb: str = "would go to") -> str:
        """Return the text that says by how much a joint would exceed its limit; with `verb` "is at", that it does."""
        scale, unit = (float(np.rad2deg(1.0)), "°") if self.rotary[joint] else (1.0, " mm")
        at, by, limit = (f"{scale * value:.1f}{unit}" for value in (q, abs(beyond), q - beyond))
        return f"{self.joints[joint]} {verb} {at}, {by} beyond its limit of {limit}"

    @cached_property
    def _flange(self) -> np.ndarray:
        return self.T_mcs_flange_home.as_matrix()

    @cached_property
    def _tool(self) -> np.ndarray:
        return (self.T_mcs_flange_home * self.T_flange_tool).as_matrix()

    @cached_property
    def _screws(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(n, 3, 3) cross matrices of the rotations and their squares, (n, 3) translations."""
        cross = cross_matrix(self.axes[:, :3])
        return cross, cross @ cross, self.axes[:, 3:]

    @cached_property
    def _weights(self) -> np.ndarray:
        """(n,): mm per unit of each joint."""
        return np.where(self.rotary, LEVER_MM, 1.0)

    @cached_property
    def _starts(self) -> np.ndarray:
        """(_STARTS, n): positions spread evenly over the joints' range, a rotation by at most half a turn to each side:
        an additive recurrence."""
        base = 2.0
        for _ in range(20):  # the positive root of x^(n + 1) = x + 1
            base = (1 + base) ** (1 / (self.count + 1))
        shares = (0.5 + np.arange(1, _STARTS + 1)[:, None] * base ** -np.arange(1.0, self.count + 1)) % 1
        half = np.where(self.rotary, np.pi, np.inf)
        lower, upper = np.maximum(self.lower, -half), np.minimum(self.upper, half)
        return lower + shares * (upper - lower)

    def _exponentials(self, q: np.ndarray) -> np.ndarray:
        """Return each joint's own motion, (..., n, 4, 4): Rodrigues' formula, which for a translation gives q v."""
        cross, square, velocity = self._screws
        at = q[..., None, None]
        sine, versine = np.sin(at), 1 - np.cos(at)
        motions = np.zeros((*q.shape, 4, 4))
        motions[..., :3, :3] = np.eye(3) + sine * cross + versine * square
        along = at * np.eye(3) + versine * cross + (at - sine) * square
        motions[..., :3, 3] = np.einsum("...jab,jb->...ja", along, velocity)
        motions[..., 3, 3] = 1.0
        return motions

    def _jacobian(self, stages: np.ndarray) -> np.ndarray:
        before = stages[..., :-1, :, :]
        rotated, shift = before[..., :3, :3], before[..., :3, 3]
        rotation = np.einsum("...jab,jb->...ja", rotated, self.axes[:, :3])
        translation = np.einsum("...jab,jb->...ja", rotated, self.axes[:, 3:]) + np.cross(shift, rotation)
        return np.swapaxes(np.concatenate([rotation, translation], axis=-1), -1, -2)

    def _ranked(
        self, tip: np.ndarray, direction: np.ndarray, rotation: np.ndarray | None, near: np.ndarray | None
    ) -> np.ndarray:
        middle = (self.lower + self.upper) / 2 if near is None else np.asarray(near, dtype=np.float64)
        found = np.empty((0, self.count))
        if self.count <= _DETERMINED:
            found = self._wrapped(self._newton(middle[None], tip, direction, rotation), middle)
        if not len(found) or self.beyond_limits(found).any():
            found = self._wrapped(self._newton(np.vstack([middle, self._starts]), tip, direction, rotation), middle)
        if not len(found):
            raise RobotRefusedError(
                "the line is out of reach: no position of the joints lays the wire on it, so it is too far away, too "
                "steep, or points back at the arm; move the robot's base or the line"
            )
        beyond = np.abs(self.beyond_limits(found)) / (self.upper - self.lower)
        within = ~beyond.any(axis=1)
        if not within.any():
            self._refuse_beyond(found[int(np.argmin(beyond.max(axis=1)))])
        found = found[within]
        singular = self.singular(found)
        if singular.max() < MIN_SINGULAR:
            raise RobotRefusedError("the arm is singular on this line; move the robot's base or the line")
        quality = np.minimum(self._margin(found), singular)
        travel = np.abs((found - middle) / (self.upper - self.lower))[:, : self.arm_joints].max(axis=1)
        return found[np.lexsort([travel, quality < _SHARE * quality.max()])]

    def _linear(
        self, q: np.ndarray, tip: np.ndarray, direction: np.ndarray, rotation: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative (N, 5, n) of the tip and of the direction's two angles by the joints, the angles times
        LEVER_MM, and what is missing (N, 5) at q (N, n). With a `rotation` (3, 3) of the tool three angles: (N, 6)."""
        stages = self.stages(q)
        tool, twist = stages[:, -1] @ self._tool, self._jacobian(stages)
        if rotation is None:
            along, seen = tool[:, :3, 2], LEVER_MM * np.swapaxes(tool[:, :3, :2], 1, 2)
            turn = np.cross(along, direction)
            sine = np.linalg.norm(turn, axis=1)
            turn *= (np.arctan2(sine, along @ direction) / np.where(sine > 0, sine, 1.0))[:, None]
        else:
            seen = LEVER_MM * np.broadcast_to(np.eye(3), (len(q), 3, 3))
            turn = Rotation.from_matrix(rotation @ np.swapaxes(tool[:, :3, :3], 1, 2)).as_rotvec()
        design = np.concatenate([displacement(tool[:, :3, 3]) @ twist, seen @ twist[:, :3]], axis=1)
        return design, np.concatenate([tip - tool[:, :3, 3], (seen @ turn[..., None])[..., 0]], axis=1)

    def _newton(
        self, starts: np.ndarray, tip: np.ndarray, direction: np.ndarray, rotation: np.ndarray | None
    ) -> np.ndarray:
        """Return the joints (K, n) with the wire there, from starts (S, n) that converge: the least step each time."""
        q, found = starts, []
        for _ in range(_MAX_ITERATIONS):
            design, off = self._linear(q, tip, direction, rotation)
            size = np.abs(off).max(axis=1)
            weighted = design / self._weights
            # Damping vanishes with the error, so convergence is quadratic, also near a singular position.
            normal = weighted @ np.swapaxes(weighted, 1, 2)
            normal += (_DAMPING * np.minimum(size, 1.0))[:, None, None] * np.eye(off.shape[1])
            step = (np.swapaxes(weighted, 1, 2) @ np.linalg.solve(normal, off[..., None]))[..., 0]
            longest = np.abs(step).max(axis=1) / (_MAX_STEP_RAD * LEVER_MM)
            q = q + step / self._weights / np.maximum(longest, 1.0)[:, None]
            done = size < _CLOSE_MM  # before this step
            found.append(q[done])
            q = q[~done]
            if not len(q):
                break
        return np.concatenate(found)

    def _wrapped(self, q: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Return joints (N, n) with whole turns taken off, so that each angle is within half a turn of `near` (n,), or
        of its limits."""
        full = np.where(self.rotary, 2 * np.pi, 0.0)
        q = q - full * np.round((q - near) / (2 * np.pi))
        for turn in (-full, full):
            shifted = q + turn
            fits = (self.lower <= shifted) & (shifted <= self.upper) & (self.beyond_limits(q) != 0)
            q = np.where(fits, shifted, q)
        return q

    def _margin(self, q: np.ndarray) -> np.ndarray:
        """Return the least distance (N,) of the arm's joints to their limits, as a share of their range."""
        room = np.minimum(q - self.lower, self.upper - q) / (self.upper - self.lower)
        return room[:, : self.arm_joints].min(axis=1)

    def _refuse_beyond(self, q: np.ndarray) -> None:
        if text := self.excesses(q):
            raise RobotRefusedError(f"the line is out of reach: {text}; move the robot's base or the line")


def _direction(entry_mm: np.ndarray, end_mm: np.ndarray) -> np.ndarray:
    along = np.asarray(end_mm, dtype=np.float64) - np.asarray(entry_mm, dtype=np.float64)
    length = np.linalg.norm(along)
    if along.shape != (3,) or not np.isfinite(length):
        raise UnusableInputError("entry and end point are three finite numbers each")
    if length == 0:
        raise RobotRefusedError("entry and end point are the same and give no direction; plan again")
    return along / length
