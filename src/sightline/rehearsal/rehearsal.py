"""A rehearsed procedure at the hip: patient, set-up, images, robot and check images, all drawn from one seed."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.case.views import NAMES as VIEWS
from sightline.frame import Frame
from sightline.planning.procedures import kind
from sightline.rehearsal.check_images import CheckImages
from sightline.rehearsal.operation import SimulatedTheatre, confirmed_setup
from sightline.rehearsal.patient import LANDMARK_MARGIN_PX, AidClicks, RehearsedPatient
from sightline.rehearsal.robots import REMOUNT_SD, SHOWN_FEED_MM, calibrated_robot, drawn_robot, shown_wire_mm
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.link.simulated import SimulatedWire
from sightline.twin import HipScene, Scene, shown_hip_scene
from sightline.twin.femur import SHORT_MM
from sightline.twin.implants import guide_wire

SHOWN_MM, MAX_SHOWN_MM = 25.0, 60.0  # length of the robot's own wire, to its tip, in images of a block [ours]
NO_SERIAL = "none"  # sent to the robot for a frame without a serial


@dataclass(frozen=True, eq=False)
class Rehearsal(RehearsedPatient):
    """A patient with a hip, and the robot that holds the frame."""

    bone: HipScene

    @staticmethod
    def draw(seed: int, frame: Frame, side: str = "right", procedure: str = "hip-screw") -> "Rehearsal":
        """Draw a rehearsal from its seed: in front of an intensifier, for a solid a flat panel (`chain_for`).

        Both fields show the whole ideal wire, and beside a solid the tip of the robot's own; an intensifier's field has
        no room for that. Raises SetUpError.
        """
        also = None
        if frame.solid is not None and frame.detector is None:
            imaged = np.array([0.0, 0.0, 0.0, 0.0, SHOWN_FEED_MM])
            also = shown_wire_mm(calibrated_robot(side, frame).manipulator, imaged, [SHOWN_MM, 0.0])
        return Rehearsal(seed, *shown_hip_scene(np.random.default_rng(seed), frame, side, also_mm=also), procedure)

    @property
    def hip(self) -> HipScene:
        """The bone."""
        return self.bone

    @property
    def serial(self) -> str:
        """The serial of the frame that the robot is set up for."""
        return self.setup.frame.serial or NO_SERIAL

    @property
    def scene(self) -> Scene:
        """Everything in the beam. Images of a block show the robot's own wire besides."""
        scene = self.hip.scene
        return scene if self.robot_wire_mm is None else scene + guide_wire(self.robot_wire_mm)

    @property
    def head_rim(self) -> np.ndarray:
        """Pixels (2, 3, 2) in both images of three points around the outline of the head."""
        return self.rim_px(self.hip.head_mm, self.hip.femur.head_radius_mm)

    @property
    def aids_px(self) -> AidClicks:
        """Clicks on the aids that are drawn, as of other patients: of those of the procedure the head."""
        asked = {aid.key for aid in kind(self.procedure).aids}
        return {"head": list(self.head_rim)} if "head" in asked else {}

    @property
    def surface_mm(self) -> np.ndarray:
        """The point (3,), CFCS, at which the ideal wire would leave the femoral head."""
        entry, end = self.hip.wire_mm
        return end + SHORT_MM * (end - entry) / np.linalg.norm(end - entry)

    @cached_property
    def robot(self) -> CalibratedRobot:
        """The calibrated model of the robot."""
        return calibrated_robot(self.side, self.setup.frame)

    def theatre(self) -> SimulatedTheatre:
        """Return the true robot at its place at the images, beside this bone. Raises SetUpError without MuJoCo."""
        setup = confirmed_setup(self.setup.frame, self.side, self.serial)
        return SimulatedTheatre.draw(self.robot, self.hip, self.generator("robot"), setup, self._feed_mm)

    @cached_property
    def robot_wire_mm(self) -> np.ndarray | None:
        """A point and the tip (2, 3), CFCS, of the robot's own wire at the images of a block: the farthest point behind
        the tip that both fields show. None for plates and intensifiers, whose images do not show it."""
        if self.setup.frame.solid is None or self.setup.frame.detector is not None:
            return None
        true, imaged = self._at_images
        wire = shown_wire_mm(true, imaged, np.append(np.arange(MAX_SHOWN_MM, SHOWN_MM, -1.0), [SHOWN_MM, 0.0]))
        uv = self.pixels(wire)
        shown = [self.setup.views[name].in_field(uv[k], LANDMARK_MARGIN_PX) for k, name in enumerate(VIEWS)]
        return wire[[int(np.argmax(shown[0] & shown[1])), -1]]

    def check_images(self, wire: SimulatedWire) -> CheckImages:
        """Render two more images with the true wire. The chuck is opened and the arm returns to its place at the
        images, up to its play; a block is put back on its mount; the bone with the wire stays. Raises SetUpError."""
        rng = self.generator("check")
        true, imaged = self._at_images
        play = self.robot.manipulator.backlash / 2 * rng.uniform(-1, 1, 5)
        then = true.T_mcs_cfcs(imaged + play)
        if self.setup.frame.solid is not None:
            then = then * RigidTransform.from_exp_coords(REMOUNT_SD * rng.standard_normal(6))
        motion = then.inv() * true.T_mcs_cfcs(imaged)
        return self._check_images(wire.axis_mm, motion, rng)

    @property
    def _at_images(self) -> tuple[Manipulator, np.ndarray]:
        """The true robot, and its joints (5,) at the images."""
        return drawn_robot(self.robot, self.side, self.generator("robot"), self._feed_mm)

    @property
    def _feed_mm(self) -> float:
        return 0.0 if self.setup.frame.solid is None else SHOWN_FEED_MM
