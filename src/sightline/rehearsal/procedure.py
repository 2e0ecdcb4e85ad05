"""A rehearsed procedure: patient, set-up, images, robot and check images, all drawn from one seed.

Each part has a generator of its own, so that it is the same whichever parts were drawn before it: after a restart, or
in the robot's process beside the one that shows the images.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.case.views import NAMES as VIEWS
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.rehearsal.check_images import CheckImages
from sightline.rehearsal.operation import Theatre
from sightline.rehearsal.robots import calibrated_robot, drawn_robot
from sightline.robot.control.insertion import Setup
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.link.simulated import SimulatedWire
from sightline.twin import HipScene, SetUp, render, shown_hip_scene
from sightline.twin.femur import SHORT_MM

PARTS = (*VIEWS, "robot", "check", "picks")  # each with a generator of its own; new ones at the end
LANDMARK_MARGIN_PX = 30.0  # inside both fields; landmarks nearer to the edge are not picked [ours]
RIM_TURNS_RAD = np.array([0.3, 2.4, 4.5])  # about a third of the outline apart
NO_SERIAL = "none"  # what the robot is told of a frame that has none


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """A patient in a frame that a robot holds before a C-arm: `setup` and `hip` as they truly are."""

    seed: int
    setup: SetUp
    hip: HipScene

    @staticmethod
    def draw(seed: int, frame: Frame, side: str = "right") -> "Rehearsal":
        """The same for the same three. Both fields show the whole ideal wire. Raises SetUpError."""
        return Rehearsal(seed, *shown_hip_scene(np.random.default_rng(seed), frame, side))

    def generator(self, part: str) -> np.random.Generator:
        """Of one of PARTS, at its beginning."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(PARTS.index(part),)))

    @property
    def side(self) -> str:
        """The patient's."""
        return self.setup.side

    @property
    def serial(self) -> str:
        """Of the frame, as the robot is set up for it."""
        return self.setup.frame.serial or NO_SERIAL

    @cached_property
    def images(self) -> dict[str, Radiograph]:
        """The radiograph of each view."""
        return {name: render(self.setup, name, self.hip.scene, self.generator(name)) for name in VIEWS}

    def pixels(self, xyz_mm: np.ndarray) -> np.ndarray:
        """(2, N, 2): where both images show points (N, 3) CFCS."""
        return np.stack([self.setup.views[name].project(xyz_mm) for name in VIEWS])

    @cached_property
    def landmarks(self) -> dict[str, np.ndarray]:
        """(2, 2) pixels in both images of each landmark of the bone that both fields show well, by its name."""
        known = self.hip.landmarks_mm
        uv = self.pixels(np.stack(list(known.values())))
        shown = [self.setup.views[name].in_field(uv[k], LANDMARK_MARGIN_PX) for k, name in enumerate(VIEWS)]
        return {name: uv[:, k] for k, name in enumerate(known) if shown[0][k] and shown[1][k]}

    @property
    def head_rim(self) -> np.ndarray:
        """(2, 3, 2) pixels in both images: three points around the outline of the head."""
        out = np.zeros((2, len(RIM_TURNS_RAD), 2))
        for k, name in enumerate(VIEWS):
            view = self.setup.views[name]
            ray, radius = self.hip.head_mm - view.focal_point_mm, self.hip.femur.head_radius_mm
            distance = np.linalg.norm(ray)
            across = np.linalg.svd(ray[None] / distance)[2][1:]
            # The rays that touch a sphere do so on a circle nearer to the source, smaller than the sphere.
            nearer = self.hip.head_mm - ray * (radius / distance) ** 2
            touching = radius * np.sqrt(1.0 - (radius / distance) ** 2)
            around = np.stack([np.cos(RIM_TURNS_RAD), np.sin(RIM_TURNS_RAD)], axis=1)
            out[k] = view.project(nearer + touching * around @ across)
        return out

    @property
    def surface_mm(self) -> np.ndarray:
        """(3,) CFCS: where the ideal wire would leave the femoral head."""
        entry, end = self.hip.wire_mm
        return end + SHORT_MM * (end - entry) / np.linalg.norm(end - entry)

    @cached_property
    def robot(self) -> CalibratedRobot:
        """As it is known."""
        return calibrated_robot(self.side)

    def theatre(self) -> Theatre:
        """The robot as it is, where it stands at the images, before this bone. Raises SetUpError without MuJoCo."""
        return Theatre.draw(self.robot, self.hip, self.generator("robot"), Setup(self.side, self.serial))

    def check_images(self, wire: SimulatedWire) -> CheckImages:
        """Two more images, with the wire where it truly is. The chuck is opened, and the arm goes back to where the
        images were taken, as well as its play lets it; the bone, and the wire in it, stay. Raises SetUpError."""
        rng = self.generator("check")
        true, imaged = drawn_robot(self.robot, self.side, self.generator("robot"))
        play = self.robot.manipulator.backlash / 2 * rng.uniform(-1, 1, 5)
        motion = true.T_mcs_cfcs(imaged + play).inv() * true.T_mcs_cfcs(imaged)
        return CheckImages.take(self.setup, self.hip, wire.axis_mm, motion, rng)
