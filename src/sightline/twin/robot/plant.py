"""The simulated plant: the true manipulator, simulated by MuJoCo, with its wire in the bone of the images."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import isfinite

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.mujoco import import_mujoco
from sightline.errors import SetUpError
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.plant import CYCLE_S, WATCHDOG_S, PlantFlag, Reading
from sightline.twin.objects.things import WIRE_DIAMETER_MM
from sightline.twin.robot.drilling import Bone, Wire, sensed
from sightline.twin.robot.mjcf import STEP_S, Build, M, mjcf, units

STEPS = round(CYCLE_S / STEP_S)
SETTLE_S = 0.5  # time to come to rest under gravity
GUIDE_MM = 85.0  # feed at which the wire leaves its guide, about 15 mm before a typical entry point [ours]
# Of a person who drills through a held guide [ours]: pace, play of the wire in the sleeve, sideways push on the guide,
# and error of a depth that is read, 1 s.d.
HAND_MM_S, PLAY_MM, PUSH_N, READ_SD_MM = 1.0, 0.05, 20.0, 0.3
FULL_FORCE = 0.999  # share of a drive's maximum force above which it cannot follow
_REPORTED = (PlantFlag.DRILL_ON, PlantFlag.STOP_PRESSED, PlantFlag.RUN_HELD, PlantFlag.OVERLOAD, PlantFlag.AT_LIMIT)


def _all_set(flags: tuple[bool, ...]) -> PlantFlag:
    joined = PlantFlag.NONE
    for flag, is_set in zip(_REPORTED, flags, strict=True):
        joined |= flag if is_set else PlantFlag.NONE
    return joined


# Joined once: an `|` of two flags takes over a microsecond, and a cycle has up to five.
_FLAGS = {flags: _all_set(flags) for flags in product((False, True), repeat=len(_REPORTED))}


@dataclass(frozen=True, eq=False)
class Hand:
    """A person who drills through a held guide until the wire is `goal_mm` beyond its mouth, as it truly is.
    `T_tool_wire`: the wire in the guide, by its play; `push_n` (3,): on the guide's mouth, tool axes, from the first
    millimetre on."""

    goal_mm: float
    T_tool_wire: RigidTransform
    push_n: np.ndarray

    @cached_property
    def axes(self) -> np.ndarray:
        """(3, 3): rows x, y, z of the wire, tool axes. Kept, because scipy takes half of a cycle for it."""
        return self.T_tool_wire.rotation.as_matrix().T

    @staticmethod
    def draw(goal_mm: float, guide_mm: float, most_n: float, rng: np.random.Generator) -> "Hand":
        """Draw a person who reads `goal_mm` off the wire's free length: anywhere within the play at both ends of the
        guide, and a push in any direction across it of up to `most_n`."""
        mouth, other = PLAY_MM / 2 * rng.uniform(-1, 1, (2, 2))
        x, y = (mouth - other) / guide_mm
        tilt = Rotation.from_rotvec([-y, x, 0.0])
        angle, newtons = rng.uniform(0.0, 2 * np.pi), most_n * rng.uniform()
        push = newtons * np.array([np.cos(angle), np.sin(angle), 0.0])
        read = goal_mm + READ_SD_MM * rng.standard_normal()
        return Hand(float(read), RigidTransform.from_components([*mouth, 0.0], tilt), push)


class SimulatedPlant:
    """A `Plant` with its own clock, which `advance` moves on. Methods named true_ return the true state, including what
    encoders cannot measure (play, springs, gravity, thrust, a bent wire): for evaluation, never for a controller.

    `robot`: the true arm. `bone` None: the wire moves in air. `start` (n,): joints at time zero. `guide_mm`: the feed
    at which the wire's tip is at the mouth of its sleeve, which a person pushes forward to the bone. Without a feed
    that is how far the sleeve's mouth is from the guide's, and a person drills: `drill_by_hand`; `push_n` is the
    largest push.
    `stop_pressed`, `run_held`: the hardware inputs. Raises SetUpError if MuJoCo is not installed or the start is beyond
    the limits.
    """

    def __init__(
        self,
        robot: Manipulator,
        bone: Bone | None,
        rng: np.random.Generator,
        start: np.ndarray | None = None,
        build: Build | None = None,
    ) -> None:
        self.robot = robot
        self.wire: Wire | None = None
        self.guide_mm = GUIDE_MM if robot.has_feed else 0.0
        self.push_n, self.pushed_mm = PUSH_N, 0.0
        self._hand: Hand | None = None
        # A separate generator, because the number of samples depends on the link.
        self._hand_rng = rng.spawn(1)[0]
        self.stop_pressed, self.run_held = False, True
        self._rng = rng
        at = np.zeros(robot.count) if start is None else np.asarray(start, dtype=np.float64)
        if not np.isfinite(at).all() or robot.beyond_limits(at).any():
            raise SetUpError("the plant must start within its joints' limits")
        self._body = _Body(robot, build or Build.of(robot), at)
        self._laid = self._body.tool()  # tip and axes of a straight wire that a person drills
        self._slowest = -robot.speed
        self._goal, self._drill_on = np.zeros(self.robot.count), False
        self._time_s, self._owed_s = 0.0, 0.0
        self._told_s = 0.0  # time of the last command
        if bone is not None:
            self.meet(bone)
        self._reading = self._sample(overloaded=False, limited=False)

    def read(self) -> Reading:
        """See Plant."""
        return self._reading

    def command(self, joint_velocity: np.ndarray, drill_on: bool) -> None:
        """See Plant. Raises ValueError unless there is a finite velocity for each joint."""
        velocity = np.asarray(joint_velocity, dtype=np.float64)
        if velocity.shape != (self.robot.count,) or not all(map(isfinite, velocity.tolist())):
            raise ValueError(f"a command is {self.robot.count} finite joint velocities")
        self._goal = np.minimum(np.maximum(velocity, self._slowest), self.robot.speed)
        self._drill_on, self._told_s = drill_on, self._time_s

    def hold(self) -> None:
        """See Plant."""
        self._goal, self._drill_on = np.zeros(self.robot.count), False

    def meet(self, bone: Bone, diameter_mm: float = WIRE_DIAMETER_MM) -> None:
        """Mount a new wire in front of this bone."""
        self.wire, self.pushed_mm = Wire(bone, diameter_mm), 0.0
        self._drill()

    def drill_by_hand(self, goal_mm: float) -> None:
        """Let a person drill through the held guide, until the wire is read to be `goal_mm` beyond its mouth."""
        self._hand = Hand.draw(goal_mm, self.robot.guide_mm, self.push_n, self._hand_rng)

    def let_go(self) -> None:
        """Let the person stop; a wire beyond the mouth stays where it is."""
        self._hand = None

    def advance(self, dt_s: float) -> None:
        """Advance the clock by whole cycles; the remainder is carried over to the next call."""
        self._owed_s += dt_s
        while self._owed_s > CYCLE_S - 1e-9:
            self._owed_s -= CYCLE_S
            self._cycle()

    @property
    def thrust_n(self) -> float:
        """True reaction force of the bone along the wire, N."""
        return 0.0 if self.wire is None else self.wire.thrust_n

    def true_T_mcs_flange(self) -> RigidTransform:
        """Return the true pose of the flange."""
        return self._body.pose("flange")

    def true_T_mcs_cfcs(self) -> RigidTransform:
        """Return the true pose of the frame."""
        return self._body.pose("cfcs")

    def true_T_mcs_tool(self) -> RigidTransform:
        """Return the true pose of the wire's tip, +z along the wire there, including its bending."""
        straight = self._straight
        if self.wire is None:
            return straight
        axis = straight.rotation.apply([0.0, 0.0, 1.0])
        bend = Rotation.from_rotvec(np.cross(axis, self.wire.slope))
        return RigidTransform.from_components(self.wire.tip_mm, bend * straight.rotation)

    def true_wire_mm(self) -> np.ndarray:
        """Return three points (3, 3) of the wire: at its guide's mouth, where bone holds it (else halfway), its tip."""
        tool, free = self._straight, max(self._free_mm, 0.0)
        mouth = tool.apply([0.0, 0.0, -free])
        tip = tool.translation if self.wire is None else self.wire.tip_mm
        held = None if self.wire is None else self.wire.entry_mm
        return np.stack([mouth, (mouth + tip) / 2 if held is None else held, tip])

    @property
    def _straight(self) -> RigidTransform:
        """Pose of the tip of a straight wire."""
        if self.robot.has_feed:
            return self._body.pose("tool")
        tip, axes = self._laid
        return RigidTransform.from_components(tip, Rotation.from_matrix(axes.T))

    @property
    def _free_mm(self) -> float:
        """From the sleeve's mouth to the tip, negative within the sleeve."""
        out = self._body.positions()[self.robot.feed] if self.robot.has_feed else self.pushed_mm
        return out - self.guide_mm

    @property
    def _may_move(self) -> bool:
        return self.run_held and not self.stop_pressed

    def _cycle(self) -> None:
        if self._time_s - self._told_s > WATCHDOG_S - CYCLE_S / 2:
            self.hold()
        goal = self._goal if self._may_move else np.zeros(self.robot.count)
        overloaded, limited = self._body.drive(goal)
        self._time_s += CYCLE_S
        self._drill()
        self._reading = self._sample(overloaded, limited)

    def _drill(self) -> None:
        if not self.robot.has_feed:
            self._drill_by_hand()
        elif self.wire is not None:
            tip, axes = self._body.tool()
            thrust = self.wire.step(tip, axes, self._free_mm, self._drill_on and self._may_move, CYCLE_S)
            self._body.push(tip, -thrust * axes[2])

    def _drill_by_hand(self) -> None:
        """The thrust is the person's, whose other hand pushes at the guide."""
        hand, (mouth, axes) = self._hand, self._body.tool()
        self._body.push(mouth, np.zeros(3) if hand is None else min(self.pushed_mm, 1.0) * (hand.push_n @ axes))
        if hand is None and self.pushed_mm > 0.0:
            return  # it stays in the bone
        if hand is not None:
            mouth, axes = mouth + hand.T_tool_wire.translation @ axes, hand.axes @ axes
            self.pushed_mm = min(self.pushed_mm + HAND_MM_S * CYCLE_S, hand.goal_mm)
            self._hand = hand if self.pushed_mm < hand.goal_mm else None
        self._laid = mouth + self.pushed_mm * axes[2], np.array(axes)  # the body's own axes change with it
        if self.wire is not None:
            self.wire.step(*self._laid, self._free_mm, hand is not None, CYCLE_S)

    def _sample(self, overloaded: bool, limited: bool) -> Reading:
        drills = self._drill_on and self._may_move
        flags = _FLAGS[bool(drills), bool(self.stop_pressed), bool(self.run_held), overloaded, limited]
        encoders = np.rint(self._body.encoders() / self.robot.resolution) * self.robot.resolution
        encoders.flags.writeable = False
        return Reading(self._time_s, encoders, sensed(self.thrust_n * self.robot.has_feed, self._rng), flags)


class _Body:
    """The moving masses: MuJoCo's state, in mm and rad.

    A cycle handles a few numbers at a time: Python's lists compare them, and `np.minimum` limits them, in a third of
    the time of numpy's `all`, `any` and `clip` or less.
    """

    def __init__(self, robot: Manipulator, build: Build, start: np.ndarray) -> None:
        mujoco = self._mujoco = import_mujoco("the simulated robot")
        self._model = mujoco.MjModel.from_xml_string(mjcf(robot, build))
        self._data = mujoco.MjData(self._model)
        self._lower, self._upper, self._acceleration = robot.lower, robot.upper, robot.acceleration
        braking = robot.speed**2 / (2 * robot.acceleration) + robot.speed * CYCLE_S  # longest stopping distance
        self._free = list(zip((robot.lower + braking).tolist(), (robot.upper - braking).tolist(), strict=True))
        self._ramp = robot.acceleration * STEP_S  # largest change of a velocity in one step
        self._units = units(robot)
        # Each joint has one degree of freedom, so its index in positions is that in forces.
        self._seen = np.array([self._model.joint(name).qposadr[0] for name in robot.joints])
        self._behind = np.array([self._model.joint(f"{name}-behind").qposadr[0] for name in robot.joints])
        self._force = np.array(build.drive_force)
        self._full: list[float] = (FULL_FORCE * self._force).tolist()
        self._site = {name: self._model.site(name).id for name in ("flange", "cfcs", "tool")}
        self._fed = self._model.body(f"{robot.joints[-1]}-link").id
        self._pace = np.zeros(robot.count)  # present command, mm/s and rad/s
        data = self._data
        # Views of MuJoCo's own memory: each look-up by name takes a microsecond.
        self._qpos, self._drive_force = data.qpos, data.qfrc_actuator
        self._tip, self._tip_axes = data.site_xpos[self._site["tool"]], data.site_xmat[self._site["tool"]].reshape(3, 3)
        self._fed_middle, self._fed_force = data.xipos[self._fed], data.xfrc_applied[self._fed]
        self._control = data.ctrl[: robot.count], data.ctrl[robot.count :]
        data.qpos[self._seen] = data.act[:] = start * self._units
        self._carries_itself = build.carries_itself
        if self._carries_itself:
            mujoco.mj_forward(self._model, data)
            data.qfrc_applied[self._seen] = data.qfrc_bias[self._seen]
        mujoco.mj_step(self._model, data, nstep=round(SETTLE_S / STEP_S))
        mujoco.mj_kinematics(self._model, data)

    def encoders(self) -> np.ndarray:
        """Return the joints (n,) at their drives."""
        return self._qpos[self._seen] / self._units

    def positions(self) -> np.ndarray:
        """Return the true joints (n,), behind play and springs."""
        return (self._qpos[self._seen] + self._qpos[self._behind]) / self._units

    def tool(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the tip (3,) of a straight wire, mm, and the tool's axes (3, 3), rows."""
        return self._tip / M, self._tip_axes.T

    def pose(self, name: str) -> RigidTransform:
        """Return the pose of a site."""
        site = self._site[name]
        rotation = Rotation.from_matrix(self._data.site_xmat[site].reshape(3, 3))
        return RigidTransform.from_components(self._data.site_xpos[site] / M, rotation)

    def push(self, at_mm: np.ndarray, force_n: np.ndarray) -> None:
        """Apply a force (3,) to the wire at a point (3,), until the next call."""
        x, y, z = (at_mm * M - self._fed_middle).tolist()
        a, b, c = force_n.tolist()
        # Cross product by hand: numpy's takes 40 µs, half of a cycle.
        self._fed_force[:] = (a, b, c, y * c - z * b, z * a - x * c, x * b - y * a)

    def drive(self, goal: np.ndarray) -> tuple[bool, bool]:
        """Simulate one cycle towards joint velocities (n,); return whether a drive was overloaded, and whether a limit
        was reached."""
        at = self.encoders()
        within = all(low < q < high for q, (low, high) in zip(at.tolist(), self._free, strict=True))
        allowed = goal if within else self._braked(goal, at)
        data, model = self._data, self._model
        wanted, left = allowed.tolist(), STEPS
        while left and self._pace.tolist() != wanted:
            self._pace = self._pace + np.minimum(np.maximum(allowed - self._pace, -self._ramp), self._ramp)
            first, second = self._control
            first[:] = second[:] = self._pace * self._units
            self._mujoco.mj_step(model, data)
            left -= 1
        if left:
            self._mujoco.mj_step(model, data, nstep=left)
        force = self._drive_force[self._seen].tolist()
        overloaded = any(abs(newtons) > full for newtons, full in zip(force, self._full, strict=True))
        if overloaded:  # keep the reference near the joint
            slack = self._force / self._model.actuator_gainprm[: len(self._force), 0]
            data.act[:] = np.clip(data.act, self._qpos[self._seen] - slack, self._qpos[self._seen] + slack)
        if self._carries_itself:
            data.qfrc_applied[self._seen] = data.qfrc_bias[self._seen]
        self._mujoco.mj_kinematics(model, data)
        return overloaded, allowed is not goal and wanted != goal.tolist()

    def _braked(self, goal: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Return `goal` (n,) limited to velocities that can stop before a joint limit after one more cycle."""
        spent, twice = np.abs(self._pace) * CYCLE_S, 2 * self._acceleration
        forward = np.sqrt(twice * np.maximum(self._upper - at - spent, 0.0))
        backward = np.sqrt(twice * np.maximum(at - self._lower - spent, 0.0))
        return np.minimum(np.maximum(goal, -backward), forward)
