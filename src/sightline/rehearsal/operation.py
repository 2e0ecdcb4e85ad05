"""One insertion on the twin, from registration to a drilled wire, as in the integration trial.

The robot holds the frame while the images are acquired; the bone is at the true position of that frame. The robot gets
information only from the images and its encoders, over the link. The truth is used for evaluation only.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.geometry.lines import across, angle_rad, unit
from sightline.errors import LinkError, RobotRefusedError
from sightline.frame import Frame
from sightline.planning import Plan
from sightline.planning.verdict.relations import refuse_unrelated
from sightline.robot import contract
from sightline.robot.contract import STATUS_S
from sightline.robot.control.controller import Controller
from sightline.robot.control.insertion import IN_SLEEVE_MM, Insertion, OwnFrames, Setup
from sightline.robot.control.states import State
from sightline.robot.igtl import Status
from sightline.robot.kinematics.calibrated import (
    MACHINED_SD,
    CalibratedAxes,
    CalibratedRobot,
    Mount,
)
from sightline.robot.kinematics.designs import AHEAD, DESIGNS, FEED, GUIDED_HIP_MM, MOUTH_MM, YAW, Design, imaging_yaw
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.kinematics.target import (
    PlanIdentity,
    PoseAtImage,
    Registration,
    RobotTarget,
    register,
    robot_target,
)
from sightline.robot.link.client import RobotClient
from sightline.robot.link.outgoing import SIGHTLINE, Dialect
from sightline.robot.link.record import DrillingRecord, Recorder, SimulatedWire
from sightline.robot.link.server import RobotServer, Simulation
from sightline.robot.transport import LOOPBACK
from sightline.twin import BoneScene, HipScene
from sightline.twin.objects.things import WIRE_DIAMETER_MM
from sightline.twin.robot.drilling import Bone
from sightline.twin.robot.plant import SimulatedPlant
from sightline.twin.xray.setup import hip_of

# Mounts of frame or block and of wire on the flange, s.d. of a twist: 0.1 mm as in the accuracy trial, over a lever of
# 330 mm.
MOUNT_SD = np.array([3e-4] * 3 + [0.1] * 3)
# Share of the axes' machining errors that remains after calibration. 30 poses of three targets, 0.03 mm each, leave
# less; this adds 0.01 mm at the wire [calc].
REMAINING_SHARE = 0.1
# Largest deviation of the robot's base from its ideal place, in joint units: a person brings it to the table [ours]; of
# an arm that holds a guide as a twist about its mouth.
BASE_SPREAD = np.array([10.0, 10.0, np.deg2rad(2.0), np.deg2rad(2.0), 0.0])
GUIDE_SPREAD = np.array([np.deg2rad(2.0)] * 3 + [10.0] * 3)
# By the number of such an arm's joints, at the images: the hip ahead of its base along the wire and above it, mm, and
# the joints, to whose first the yaw is added: far from limits, singular positions, patient, table and C-arm [calc].
AT_HIP = {
    6: (850.0, 100.0, np.deg2rad([18.0, -110.0, -120.0, -130.0, -72.0, 0.0])),
    7: (900.0, 400.0, np.deg2rad([30.0, 17.0, -34.0, -127.0, -4.0, 231.0, -78.0])),
}
# A drilled wire stands where its tip, this near to its depth, moves less than this between messages 20 ms apart, so
# many times [ours]: its depth is read to 0.3 mm, and drilled at 1 mm/s.
NEAR_MM, STILL_TIP_MM, STANDS = 2.0, 0.005, 5
HAND_S = 300.0  # within which a simulated person has drilled: 250 mm at 1 mm/s, with a margin [calc]
# Feed at the images of a block, mm: the tip is some 75 mm before the hip, 25 mm before the bone, and more than 20 mm of
# the wire are in both fields [ours].
SHOWN_FEED_MM = 75.0
SLEEVE_MM = 5.0  # of the mouth of the wire's sleeve from the entry point: that for which SKIVING_RAD was computed


def calibrated_robot(
    side: str = "right", frame: Frame | None = None, yaw_rad: float | None = None, arm: Design = "manipulator"
) -> CalibratedRobot:
    """Return a nominal arm that holds a frame (default: one with plates), with axes and mounts calibrated to the
    accuracy of a workshop. `yaw_rad`: at the images, by default that of a wire in a hip."""
    manipulator = DESIGNS[arm](side, np.zeros(3) if frame is None else hip_of(frame, side), yaw_rad)
    sd = np.tile(REMAINING_SHARE * MACHINED_SD, manipulator.arm_joints)
    axes = CalibratedAxes(manipulator, np.diag(sd**2), np.zeros((0, 0)))
    known = (manipulator.T_flange_cfcs, manipulator.T_flange_tool)
    held, wire = (Mount(pose, np.diag(MOUNT_SD**2), np.zeros(0)) for pose in known)
    return CalibratedRobot.of(axes, held, wire)


def joints_at_images(
    robot: Manipulator, yaw_rad: float, feed_mm: float = 0.0, moved: RigidTransform | None = None
) -> np.ndarray:
    """Return the joints (n,) at which the frame on its nominal mount is level and upright: at `yaw_rad`, the wire fed
    by `feed_mm`; or a guide before the hip, at the pose `moved` from its ideal one. Raises RobotRefusedError."""
    if robot.has_feed:
        return np.array([0.0, 0.0, yaw_rad, 0.0, feed_mm])
    ahead_mm, above_mm, posture = AT_HIP[robot.count]
    turned = Rotation.from_rotvec([0.0, 0.0, yaw_rad])
    mouth = turned.apply([ahead_mm - (GUIDED_HIP_MM[2] - MOUTH_MM[2]), 0.0, above_mm])
    ideal = RigidTransform.from_components(mouth, turned * AHEAD)
    return robot.inverse_pose(ideal if moved is None else ideal * moved, posture + yaw_rad * np.eye(robot.count)[0])


def start_of(robot: Manipulator, side: str) -> np.ndarray:
    """Return the joints (n,) of an arm before the hip of `side`; for one without such a place the middle of its
    range."""
    try:
        return joints_at_images(robot, imaging_yaw(side))
    except (RobotRefusedError, KeyError):
        return (robot.lower + robot.upper) / 2


def shown_wire_mm(robot: Manipulator, imaged: np.ndarray, behind_mm: ArrayLike) -> np.ndarray:
    """Return the points (N, 3), CFCS, of the wire at the joints `imaged` (n,), `behind_mm` (N,) behind its tip."""
    along = -np.asarray(behind_mm)[:, None] * np.array([0.0, 0.0, 1.0])
    return (robot.T_mcs_cfcs(imaged).inv() * robot.T_mcs_tool(imaged)).apply(along)


def true_manipulator(robot: CalibratedRobot, rng: np.random.Generator) -> Manipulator:
    """Draw a true manipulator from the uncertainty of the calibration. The wire is fed along its own axis."""
    values, vectors = np.linalg.eigh(robot.covariance)
    twists = vectors @ (np.sqrt(np.clip(values, 0.0, None)) * rng.standard_normal(len(values)))
    known, (frame, wire) = robot.manipulator, RigidTransform.from_exp_coords(twists[-12:].reshape(2, 6))
    return known.displaced(twists[:-12]).with_mounts(frame * known.T_flange_cfcs, wire * known.T_flange_tool)


def drawn_robot(
    known: CalibratedRobot, yaw_rad: float, rng: np.random.Generator, feed_mm: float = 0.0
) -> tuple[Manipulator, np.ndarray]:
    """Draw a true robot, and its joints (n,) at the images: about at `yaw_rad`, with the frame level and upright."""
    if known.manipulator.has_feed:
        start = BASE_SPREAD * rng.uniform(-1, 1, 5)
        start[YAW] += yaw_rad
        start[FEED] += feed_mm
    else:
        moved = RigidTransform.from_exp_coords(GUIDE_SPREAD * rng.uniform(-1, 1, 6))
        start = joints_at_images(known.manipulator, yaw_rad, moved=moved)
    return true_manipulator(known, rng), start


@dataclass(frozen=True, eq=False)
class InsertionOutcome:
    """Deviation of a drilled wire from the ideal one: distance of its axis from the entry point, of its tip from the
    end point, mm, and the angle between both, rad."""

    entry_mm: float
    end_mm: float
    angle_rad: float

    @staticmethod
    def of(wire_mm: np.ndarray, ideal_mm: np.ndarray) -> "InsertionOutcome":
        """Compare two points (2, 3) of the wire, its mouth or entry and its tip, with entry and end (2, 3)."""
        (start, tip), (entry, end) = wire_mm, ideal_mm
        beside, angle = across(entry - start, unit(tip - start)), angle_rad(tip - start, end - entry)
        return InsertionOutcome(float(np.linalg.norm(beside)), float(np.linalg.norm(tip - end)), float(angle))


@dataclass(frozen=True, eq=False)
class SimulatedTheatre:
    """A simulated robot beside a patient.

    `robot`: its calibrated model; `plant`: the true robot; `imaged` (n,): its encoders at the images; `T_mcs_cfcs`: the
    true pose of the frame then, which is also that of the bone; `setup`: confirmed by a person.
    """

    robot: CalibratedRobot
    plant: SimulatedPlant
    imaged: np.ndarray
    T_mcs_cfcs: RigidTransform
    setup: Setup

    @staticmethod
    def draw(
        robot: CalibratedRobot,
        hip: HipScene | BoneScene,
        rng: np.random.Generator,
        setup: Setup,
        feed_mm: float = 0.0,
        *,
        yaw_rad: float | None = None,
        drill_mm: float = WIRE_DIAMETER_MM,
    ) -> "SimulatedTheatre":
        """Draw a true robot at the images of a hip or another bone, its wire of `drill_mm` fed by `feed_mm`. `yaw_rad`:
        at the images, by default that of a wire in a hip. Raises SetUpError without MuJoCo."""
        yaw_rad = imaging_yaw(setup.side) if yaw_rad is None else yaw_rad
        true, start = drawn_robot(robot, yaw_rad, rng, feed_mm)
        # A separate generator, because the number of samples depends on the link, but the images must not.
        plant = SimulatedPlant(true, None, rng.spawn(1)[0], start=start)
        place = plant.true_T_mcs_cfcs()
        metal = hip.in_nail if isinstance(hip, BoneScene) else None
        plant.meet(Bone(hip.bone.volumes, place, metal), drill_mm)
        return SimulatedTheatre(robot, plant, plant.read().encoders, place, setup)

    @staticmethod
    def in_air(side: str, serial: str, frame: Frame | None = None, arm: Design = "manipulator") -> "SimulatedTheatre":
        """Return the robot of the calibrated model without a patient, frame (default: Γ) level and upright.

        Raises SetUpError without MuJoCo."""
        frame = frame or Frame.load("gamma")
        robot = calibrated_robot(side, frame, arm=arm)
        start = joints_at_images(robot.manipulator, imaging_yaw(side), IN_SLEEVE_MM)
        plant = SimulatedPlant(robot.manipulator, None, np.random.default_rng(), start=start)
        confirmed = replace(confirmed_setup(frame, side, serial), into_bone=False)
        if frame.solid is None:
            confirmed = replace(confirmed, frame="")  # it takes plans of any plates
        return SimulatedTheatre(robot, plant, plant.read().encoders, plant.true_T_mcs_cfcs(), confirmed)

    def server(
        self, *, host: str = LOOPBACK, port: int = 0, virtual: bool = False, dialect: Dialect = SIGHTLINE
    ) -> RobotServer:
        """Return the robot's server, not yet listening. Once the robot is aligned, the sleeve is pushed to the bone;
        while it holds a guide, a person drills."""
        setup = self.setup
        if dialect.own_frames:
            setup = replace(setup, frames=own_frames(self.robot, self.imaged, setup.hip_mm))
        # Start fault numbers at the time of day, so that a reset for an earlier run's fault cannot clear a new one.
        controller = Controller(self.robot, self.plant, setup, first_fault=int(time.time()) % 1_000_000 + 1)
        pushed: Insertion | None = None
        by_hand: Insertion | None = None
        manipulator = self.robot.manipulator

        def advance(dt_s: float) -> None:
            nonlocal pushed, by_hand
            state, insertion = controller.machine.state, controller.machine.insertion
            # Also while drilling: a client may order it before the robot's next cycle.
            at_bone = state in (State.ALIGNED, State.DRILL, State.GUIDE)
            if at_bone and insertion is not None and insertion is not pushed:
                pushed = insertion
                entry_mm = float(insertion.q[manipulator.feed]) if manipulator.has_feed else insertion.standoff_mm
                self.plant.guide_mm = entry_mm + self._surface_mm(insertion) - SLEEVE_MM
            if state is not State.GUIDE:
                self.plant.let_go()
            elif insertion is not None and insertion is not by_hand:
                by_hand = insertion
                self.plant.drill_by_hand(insertion.standoff_mm + insertion.length_mm)
            self.plant.advance(dt_s)

        simulation = Simulation(advance, virtual, lambda: self.wire.text())  # noqa: PLW0108, the wire of then
        return RobotServer(controller, self.plant, simulation, host=host, port=port, dialect=dialect)

    def _surface_mm(self, insertion: Insertion) -> float:
        """Return the depth of the bone's surface on an insertion's line, where a person pushes the sleeve against it:
        the entry point, unless bone begins before it."""
        off, wire = insertion.limits.before_mm, self.plant.wire
        if off == 0 or wire is None:
            return 0.0
        along = (insertion.end_mm - insertion.entry_mm) / insertion.length_mm
        return wire.bone.first_met_mm(insertion.entry_mm - off * along, insertion.end_mm) - off

    def target(self, plan: Plan, name: str) -> RobotTarget:
        """Return the robot's target for a plan. Raises RobotRefusedError."""
        setup = self.setup
        identity = PlanIdentity(name, setup.side, setup.frame_serial, plan.verdict.go, plan.kind.key, setup.frame)
        return target_of(plan, identity, registered(self.robot, self.imaged, time.monotonic()))

    def drill(self, target: RobotTarget, depth_limit_mm: float) -> DrillingRecord:
        """Drill through the real link, in virtual time. Raises RobotRefusedError with the robot's reason, LinkError."""
        with self.server(virtual=True) as server, RobotClient(port=server.port) as client:
            return insert(client, target, depth_limit_mm)

    @property
    def wire(self) -> SimulatedWire:
        """The true wire, now."""
        return SimulatedWire(self.plant.true_wire_mm(), self.T_mcs_cfcs, self.imaged)

    def outcome(self, ideal_mm: np.ndarray) -> InsertionOutcome:
        """Compare the true wire with entry and end point (2, 3), CFCS."""
        return InsertionOutcome.of(self.wire.axis_mm, ideal_mm)


def confirmed_setup(frame: Frame, side: str, serial: str, *, c_arm_away: bool = False) -> Setup:
    """Return what a person confirms at a robot that holds a frame for the images.

    A block comes off its mount after them: so near to the patient the arm cannot turn with it. `c_arm_away`: so does
    the C-arm go, whose beams lie along the wire."""
    x, y, z = hip_of(frame, side).tolist()
    mounted = frame.solid is None
    return Setup(side, serial, frame_mounted=mounted, frame=frame.fingerprint, hip_mm=(x, y, z), c_arm_away=c_arm_away)


def own_frames(
    robot: CalibratedRobot, imaged: np.ndarray, hip_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> OwnFrames:
    """Return the own frames of a robot with encoders `imaged` (n,) at the images: its base frame is at the hip with the
    axes of the wire, both as at the images."""
    T_mcs_hip = robot.manipulator.T_mcs_cfcs(imaged) * RigidTransform.from_translation(hip_mm)
    axes = robot.manipulator.T_mcs_tool(imaged).rotation
    return OwnFrames(RigidTransform.from_components(T_mcs_hip.translation, axes), T_mcs_hip)


def registered(robot: CalibratedRobot, imaged: np.ndarray, now_s: float) -> Registration:
    """Register a robot that has not moved since the images, from its encoders (n,) read at `now_s` by time.monotonic,
    the clock of `insert`. Raises RobotRefusedError."""
    pose = PoseAtImage(imaged, now_s, now_s)
    return register(robot, {"pa": pose, "lateral": pose})


def target_of(plan: Plan, identity: PlanIdentity, registration: Registration) -> RobotTarget:
    """Return the robot's target for a plan and a registration. Raises RobotRefusedError, also for one of several wires
    whose relations to the others were not checked."""
    refuse_unrelated(plan.unchecked_relations)
    points = plan.trajectory.points
    return robot_target(identity, points.xyz_mm, points.budget_mm2, registration, plan.kind.limits)


def insert(
    client: RobotClient,
    target: RobotTarget,
    depth_limit_mm: float,
    confirm: Callable[[State], None] = lambda state: None,
) -> DrillingRecord:
    """Align, confirm, drill to the pause, confirm, drill to the tip, as a person does if every shot is in order; or let
    the simulated person drill through the guide that the arm holds.

    `confirm` is called in ALIGNED and PAUSED, and raises to go no further. Raises RobotRefusedError with the robot's
    reason, LinkError, and what `confirm` raises.
    """
    recorder = Recorder()
    client.listeners.append(recorder.heard)
    client.start_up()
    client.calibrate(target.registration.T_mcs_cfcs, target.registration.imaged_s)
    client.aim_plan(target, time.monotonic(), depth_limit_mm)
    client.align()
    confirm(State.ALIGNED)
    if not target.registration.robot.manipulator.has_feed:
        client.guide()
        await_hand(client, target)
        return recorder.record
    while (state := State(client.drill())) is not State.DONE:
        confirm(state)
    return recorder.record


def await_hand(client: RobotClient, target: RobotTarget) -> None:
    """Wait until the person at a simulated robot has drilled: the wire stands about at its depth.

    Raises RobotRefusedError with the robot's fault, or if it holds the guide no longer; LinkError if nobody drills so
    far."""
    along = (target.end_mm - target.entry_mm) / target.length_mm
    depth_mm, stands, until_s = -np.inf, 0, time.monotonic() + HAND_S
    while stands < STANDS:
        # A request lets virtual time go on for as long as it takes to send one more message of each stream.
        with client.connection.mailbox() as mail:
            tip_mm = client.simulated_wire().wire_mm[2]
            status = mail.need(lambda m: m.device_name == contract.CURRENT_STATUS, STATUS_S, contract.CURRENT_STATUS)
        if isinstance(status.body, Status) and (
            status.body.subcode or not status.body.text.startswith(State.GUIDE.value)
        ):
            raise RobotRefusedError(status.body.text)
        if time.monotonic() > until_s:
            raise LinkError(f"nobody has drilled through the guide within {HAND_S:g} s")
        before_mm, depth_mm = depth_mm, float((tip_mm - target.entry_mm) @ along)
        near = depth_mm > target.depth_mm - NEAR_MM
        stands = stands + 1 if near and abs(depth_mm - before_mm) < STILL_TIP_MM else 0
