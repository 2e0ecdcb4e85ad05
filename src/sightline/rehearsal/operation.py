"""One insertion from set-up to drilled wire, everything on the twin: what the integration trial and the demo do.

The robot holds the frame while the images are taken; the bone is then where that frame truly stands. What the robot is
told comes from the images and from its encoders alone, over the link; the truth judges it.
"""

from dataclasses import dataclass
from time import monotonic

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.planning import Plan
from sightline.rehearsal.robots import true_manipulator
from sightline.robot.calibrated import CalibratedRobot
from sightline.robot.client import RobotClient
from sightline.robot.controller import Controller
from sightline.robot.insertion import Setup
from sightline.robot.manipulator import FEED, YAW, imaging_yaw
from sightline.robot.record import DrillingRecord, Recorder
from sightline.robot.registration import PoseAtImage, register
from sightline.robot.server import RobotServer
from sightline.robot.states import State
from sightline.robot.target import PlanIdentity, RobotTarget, aim
from sightline.twin import HipScene
from sightline.twin.drilling import Bone
from sightline.twin.manipulator import SimulatedPlant

SLEEVE_MM = 5.0  # the sleeve that guides the wire ends so far before the entry point, at the bone [ours]
# How far the robot's base is from where it would be ideal, joints' units: a person brings it to the table [ours].
BASE_SPREAD = np.array([10.0, 10.0, np.deg2rad(2.0), np.deg2rad(2.0), 0.0])


@dataclass(frozen=True, eq=False)
class Outcome:
    """How a drilled wire lies against the ideal one: distance of its axis from the entry point, of its tip from the
    end point, mm, and the angle between the two, rad."""

    entry_mm: float
    end_mm: float
    angle_rad: float

    @staticmethod
    def of(wire_mm: np.ndarray, ideal_mm: np.ndarray) -> "Outcome":
        """Of the wire's mouth or entry and its tip (2, 3), against entry and end (2, 3)."""
        (start, tip), (entry, end) = wire_mm, ideal_mm
        along, ideal = (v / np.linalg.norm(v) for v in (tip - start, end - entry))
        off = entry - start
        angle = np.arctan2(np.linalg.norm(np.cross(along, ideal)), along @ ideal)
        return Outcome(
            float(np.linalg.norm(off - (off @ along) * along)), float(np.linalg.norm(tip - end)), float(angle)
        )


@dataclass(frozen=True, eq=False)
class Theatre:
    """A robot beside a patient: as it is known (`robot`), as it is (`plant`), its encoders at the images (`imaged`),
    and where the frame truly stood then (`T_mcs_cfcs`), which is where the bone is."""

    robot: CalibratedRobot
    plant: SimulatedPlant
    imaged: np.ndarray
    T_mcs_cfcs: RigidTransform
    side: str
    serial: str

    @staticmethod
    def draw(robot: CalibratedRobot, hip: HipScene, rng: np.random.Generator, serial: str, side: str) -> "Theatre":
        """The frame is brought level and upright around the hip, as its mount is made for."""
        ready = BASE_SPREAD * rng.uniform(-1, 1, 5)
        ready[YAW] += imaging_yaw(side)
        # Its own generator: how many samples it takes depends on the link, and the images must not.
        plant = SimulatedPlant(true_manipulator(robot, rng), None, rng.spawn(1)[0], start=ready)
        place = plant.true_T_mcs_cfcs()
        plant.meet(Bone(hip.bone.volumes, place))
        return Theatre(robot, plant, plant.read().encoders, place, side, serial)

    def target(self, plan: Plan, name: str) -> RobotTarget:
        """What the robot is to drill. Raises RobotRefusedError."""
        now = monotonic()
        pose = PoseAtImage(self.imaged, now, now)
        registration = register(self.robot, {"pa": pose, "lateral": pose})
        points = plan.trajectory.points
        identity = PlanIdentity(name, self.side, self.serial, plan.verdict.go)
        return aim(identity, points.xyz_mm, points.budget_mm2, registration)

    def drill(self, target: RobotTarget, depth_limit_mm: float) -> DrillingRecord:
        """Through the real link, in virtual time: align, confirm, drill to the pause, confirm, drill to the tip.

        Raises RobotRefusedError with what the robot says against it, LinkError."""
        recorder = Recorder()
        self.plant.guide_mm = float(target.q[FEED]) - SLEEVE_MM
        controller = Controller(self.robot, self.plant, Setup(self.side, self.serial))
        server = RobotServer(controller, self.plant, port=0, advance=self.plant.advance, virtual=True)
        with server, RobotClient(port=server.port, heartbeat=False) as client:
            client.listeners.append(recorder.heard)
            client.start_up()
            client.calibrate(target.registration.T_mcs_cfcs, target.registration.imaged_s)
            client.aim_plan(target, monotonic(), depth_limit_mm)
            client.align()
            while client.drill() != State.DONE.value:
                pass  # a person looks at the second shot, and confirms
        return recorder.record

    def wire_mm(self) -> np.ndarray:
        """(2, 3): the drilled wire where it leaves its guide and its tip, in CFCS as it truly stood at the images."""
        return self.T_mcs_cfcs.inv().apply(self.plant.true_wire_mm()[[0, 2]])

    def back_at_images(self, rng: np.random.Generator) -> RigidTransform:
        """Planning CFCS to that of a check: the chuck is opened, and the arm goes back to where the images were taken,
        as well as its play lets it. The bone, and the wire in it, stay."""
        play = self.robot.manipulator.backlash / 2 * rng.uniform(-1, 1, 5)
        true = self.plant.robot
        return true.T_mcs_cfcs(self.imaged + play).inv() * true.T_mcs_cfcs(self.imaged)

    def outcome(self, ideal_mm: np.ndarray) -> Outcome:
        """The physics' word, against entry and end point (2, 3) CFCS."""
        return Outcome.of(self.wire_mm(), ideal_mm)
