"""A rehearsed procedure: patient, set-up, images, robot and check images, all drawn from one seed.

Each part has its own generator, so it does not depend on the parts drawn before it: it is the same after a restart and
in the robot's separate process.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.case.views import NAMES as VIEWS
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.rehearsal.check_images import CheckImages
from sightline.rehearsal.operation import SimulatedTheatre, confirmed_setup
from sightline.rehearsal.robots import REMOUNT_SD, SHOWN_FEED_MM, calibrated_robot, drawn_robot, shown_wire_mm
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.link.simulated import SimulatedWire
from sightline.twin import HipScene, SetUp, render, shown_hip_scene
from sightline.twin.femur import SHORT_MM
from sightline.twin.implants import guide_wire
from sightline.twin.specimens import tagged

PARTS = (*VIEWS, "robot", "check", "picks")  # each has its own generator; add new parts at the end
LANDMARK_MARGIN_PX = 30.0  # landmarks nearer to the edge of a field are not picked [ours]
SHOWN_MM, MAX_SHOWN_MM = 25.0, 60.0  # length of the robot's own wire, to its tip, in images of a block [ours]
RIM_ANGLES_RAD = np.array([0.3, 2.4, 4.5])  # about a third of the outline apart
NO_SERIAL = "none"  # sent to the robot for a frame without a serial


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """A patient in or beside a frame in front of a C-arm: the true `setup` and `hip`."""

    seed: int
    setup: SetUp
    hip: HipScene

    @staticmethod
    def draw(seed: int, frame: Frame, side: str = "right") -> "Rehearsal":
        """Draw a rehearsal from its seed: in front of an intensifier, for a solid a flat panel (`chain_for`).

        Both fields show the whole ideal wire, and beside a solid the tip of the robot's own; an intensifier's field has
        no room for that. Raises SetUpError.
        """
        also = None
        if frame.solid is not None and frame.detector is None:
            imaged = np.array([0.0, 0.0, 0.0, 0.0, SHOWN_FEED_MM])
            also = shown_wire_mm(calibrated_robot(side, frame).manipulator, imaged, [SHOWN_MM, 0.0])
        return Rehearsal(seed, *shown_hip_scene(np.random.default_rng(seed), frame, side, also_mm=also))

    def generator(self, part: str) -> np.random.Generator:
        """Return the generator of one of PARTS in its initial state."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(PARTS.index(part),)))

    @property
    def side(self) -> str:
        """The patient's side."""
        return self.setup.side

    @property
    def serial(self) -> str:
        """The serial of the frame that the robot is set up for."""
        return self.setup.frame.serial or NO_SERIAL

    @cached_property
    def images(self) -> dict[str, Radiograph]:
        """The radiograph of each view. Images of a block show the robot's own wire besides."""
        scene = self.hip.scene
        if self.robot_wire_mm is not None:
            scene = scene + guide_wire(self.robot_wire_mm)
        made = {name: render(self.setup, name, scene, self.generator(name)) for name in VIEWS}
        return {name: tagged(self.setup, name, image) for name, image in made.items()}

    def pixels(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the true pixels (2, N, 2) of points (N, 3), CFCS, in both images."""
        return np.stack([self.setup.views[name].project(xyz_mm) for name in VIEWS])

    @cached_property
    def landmarks(self) -> dict[str, np.ndarray]:
        """Pixels (2, 2) in both images of each landmark of the bone that lies well inside both fields, by name."""
        known = self.hip.landmarks_mm
        uv = self.pixels(np.stack(list(known.values())))
        shown = [self.setup.views[name].in_field(uv[k], LANDMARK_MARGIN_PX) for k, name in enumerate(VIEWS)]
        return {name: uv[:, k] for k, name in enumerate(known) if shown[0][k] and shown[1][k]}

    @property
    def head_rim(self) -> np.ndarray:
        """Pixels (2, 3, 2) in both images of three points around the outline of the head."""
        out = np.zeros((2, len(RIM_ANGLES_RAD), 2))
        for k, name in enumerate(VIEWS):
            view = self.setup.views[name]
            ray, radius = self.hip.head_mm - view.focal_point_mm, self.hip.femur.head_radius_mm
            distance = np.linalg.norm(ray)
            across = np.linalg.svd(ray[None] / distance)[2][1:]
            # Tangent rays touch the sphere on a circle that is nearer to the source and smaller than the sphere.
            nearer = self.hip.head_mm - ray * (radius / distance) ** 2
            touching = radius * np.sqrt(1.0 - (radius / distance) ** 2)
            around = np.stack([np.cos(RIM_ANGLES_RAD), np.sin(RIM_ANGLES_RAD)], axis=1)
            out[k] = view.project(nearer + touching * around @ across)
        return out

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
        return CheckImages.take(self.setup, self.hip, wire.axis_mm, motion, rng)

    @property
    def _at_images(self) -> tuple[Manipulator, np.ndarray]:
        """The true robot, and its joints (5,) at the images."""
        return drawn_robot(self.robot, self.side, self.generator("robot"), self._feed_mm)

    @property
    def _feed_mm(self) -> float:
        return 0.0 if self.setup.frame.solid is None else SHOWN_FEED_MM
