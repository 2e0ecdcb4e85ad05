"""A rehearsed procedure with a robot: patient, set-up, images, robot and check images, all drawn from one seed."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.case.views import NAMES as VIEWS
from sightline.case.views import OBLIQUE
from sightline.common.geometry.lines import unit
from sightline.errors import SetUpError
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.planning.check.shot import ALIGNED
from sightline.rehearsal.operation import (
    SHOWN_FEED_MM,
    SimulatedTheatre,
    calibrated_robot,
    confirmed_setup,
    drawn_robot,
    joints_at_images,
    shown_wire_mm,
)
from sightline.rehearsal.patient import (
    ATTEMPTS,
    BONES_OF,
    LANDMARK_MARGIN_PX,
    NAILED,
    AidClicks,
    CheckImages,
    RehearsedPatient,
    anatomical_wires,
    retaken,
)
from sightline.robot.contract import NO_SERIAL
from sightline.robot.kinematics.calibrated import REMOUNT_SD, CalibratedRobot
from sightline.robot.kinematics.designs import Design, imaging_yaw
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.link.record import SimulatedWire
from sightline.twin import HipScene, Scene, render, shown_hip_scene
from sightline.twin.anatomy.femur import draw_femur
from sightline.twin.objects.things import WIRE_DIAMETER_MM, guide_wire
from sightline.twin.scenes.bone_scene import shown_bone_scene
from sightline.twin.scenes.specimens import tagged
from sightline.twin.xray.setup import BEAMS

# Of the robot's own wire in images of a block [ours]: its length to the tip, at least what gives a direction and at
# most what the field has; and the points that a person picks on it, the tip last, more than the form asks for.
SHOWN_MM, MAX_SHOWN_MM, PICKED = 25.0, 60.0, 7
# Of a frame fixed to the patient by hand, s.d. of a twist against its place at the images: 2° and 3 mm per axis [ours].
ON_PATIENT_SD = np.array([np.deg2rad(2.0)] * 3 + [3.0] * 3)


@dataclass(frozen=True, eq=False)
class Rehearsal(RehearsedPatient):
    """A patient, and the robot that holds the frame: with a hip, or with a nail in the femur (`procedure`). `arm`: its
    design."""

    arm: Design = "manipulator"

    @staticmethod
    def draw(
        seed: int, frame: Frame, side: str = "right", procedure: str = "hip-screw", arm: Design = "manipulator"
    ) -> "Rehearsal":
        """Draw a rehearsal from its seed: in front of an intensifier, for a solid a flat panel (`chain_for`).

        Both fields show all ideal wires, and beside a solid the tip of the robot's own; an intensifier's field has no
        room for that, and a guide no wire. Raises SetUpError.
        """
        rng = np.random.default_rng(seed)
        femur, also = None if procedure == NAILED else draw_femur(rng), None
        robot = robot_at(procedure, side, frame, arm).manipulator
        if frame.solid is not None and frame.detector is None and robot.has_feed:
            imaged = joints_at_images(robot, _yaw(procedure, side), SHOWN_FEED_MM)
            also = shown_wire_mm(robot, imaged, [SHOWN_MM, 0.0])
        if femur is None:
            setup, nailed = shown_bone_scene(rng, frame, BONES_OF[procedure], side, also_mm=also)
            return Rehearsal(seed, setup.renamed(VIEWS), nailed, procedure, arm)
        wires = anatomical_wires(femur, procedure)
        setup, hip = shown_hip_scene(rng, frame, side, femur, also_mm=also, wires_mm=wires)
        return Rehearsal(seed, setup, hip, procedure, arm)

    @property
    def hip(self) -> HipScene:
        """The hip. Raises SetUpError for another bone."""
        if not isinstance(self.bone, HipScene):
            raise SetUpError(f"the patient of {self.procedure!r} has no hip")
        return self.bone

    @property
    def serial(self) -> str:
        """The serial of the frame that the robot is set up for."""
        return self.setup.frame.serial or NO_SERIAL

    @property
    def scene(self) -> Scene:
        """Everything in the beam. Images of a block show the robot's own wire besides."""
        scene = self.bone.scene
        return scene if self.robot_wire_mm is None else scene + guide_wire(self.robot_wire_mm)

    @property
    def head_rim(self) -> np.ndarray:
        """Pixels (2, 3, 2) in both images of three points around the outline of the head."""
        return self.rim_px(self.hip.head_mm, self.hip.femur.head_radius_mm)

    @cached_property
    def aids_px(self) -> AidClicks:
        """Clicks on the aids that are drawn, as of other patients; of a single wire the head first, and always."""
        if len(self.document.wires) > 1 or "head" not in {aid.key for aid in self.document.aids}:
            return super().aids_px
        return {"head": list(self.head_rim)} | {key: uv for key, uv in super().aids_px.items() if key != "head"}

    @property
    def drawn_apart(self) -> tuple[str, ...]:
        """Keys of the aids whose noise has a generator of its own: earlier versions did not draw these."""
        return () if len(self.document.wires) > 1 else ("neck", "shaft", "cortex")

    def surface_mm(self, key: str) -> np.ndarray:
        """Return the point (3,), CFCS, at which the ideal wire of this key would leave the femoral head."""
        entry, end = self.ideal_mm[key]
        along, off = unit(end - entry), end - self.hip.head_mm
        past = off @ along
        return end + along * (np.sqrt(past**2 + self.hip.femur.head_radius_mm**2 - off @ off) - past)

    @cached_property
    def robot(self) -> CalibratedRobot:
        """The calibrated model of the robot."""
        return robot_at(self.procedure, self.side, self.setup.frame, self.arm)

    def theatre(self) -> SimulatedTheatre:
        """Return the true robot at its place at the images, beside this bone. Raises SetUpError without MuJoCo."""
        nailed, yaw_rad = self.procedure == NAILED, _yaw(self.procedure, self.side)
        setup = confirmed_setup(self.setup.frame, self.side, self.serial, c_arm_away=nailed)
        drill_mm = self.document.wires[0].diameter_mm if nailed else WIRE_DIAMETER_MM
        held = self.generator("robot"), setup, self._feed_mm
        return SimulatedTheatre.draw(self.robot, self.bone, *held, yaw_rad=yaw_rad, drill_mm=drill_mm)

    @cached_property
    def robot_wire_mm(self) -> np.ndarray | None:
        """A point and the tip (2, 3), CFCS, of the robot's own wire at the images of a block: the farthest point behind
        the tip that both fields show. None for plates and intensifiers, whose images do not show it, and for an arm
        without a feed, whose guide holds no wire then."""
        frame = self.setup.frame
        if frame.solid is None or frame.detector is not None or not self.robot.manipulator.has_feed:
            return None
        true, imaged = self._at_images
        wire = shown_wire_mm(true, imaged, np.append(np.arange(MAX_SHOWN_MM, SHOWN_MM, -1.0), [SHOWN_MM, 0.0]))
        uv = self.pixels(wire)
        shown = [self.setup.views[name].in_field(uv[k], LANDMARK_MARGIN_PX) for k, name in enumerate(VIEWS)]
        return wire[[int(np.argmax(shown[0] & shown[1])), -1]]

    def oblique_image(self) -> Radiograph:
        """Render a third image of a block, its beam between those of the others, that shows wires and landmarks.

        Raises SetUpError.
        """
        rng, landmarks = self.generator(OBLIQUE), [self.bone.landmarks_mm[name] for name in self.landmarks]
        points = np.array([*self.wires_mm.reshape(-1, 3), *landmarks])
        for _ in range(ATTEMPTS):
            setup = replace(self._set_up_again(rng, {OBLIQUE: BEAMS[OBLIQUE]}), true_frame=self.setup.true_frame)
            view = setup.views[OBLIQUE]
            if view.in_field(view.project(points), LANDMARK_MARGIN_PX).all():
                return tagged(setup, OBLIQUE, render(setup, OBLIQUE, self.scene, rng))
        raise SetUpError(f"none of {ATTEMPTS} oblique images shows wires and landmarks")

    def check_images(
        self,
        wire: SimulatedWire,
        key: str = "",
        before_mm: Mapping[str, np.ndarray] = MappingProxyType({}),
        *,
        retake: int = 0,
    ) -> CheckImages:
        """Render two more images with the true wire, and those that are in the bone `before_mm` (2, 3), CFCS of the
        planning images, by key; `key`: its own, by default that of the file's first.

        The chuck is opened and the arm returns to its place at the images, up to its play; a block is put back on its
        mount; the bone with the wires stays. `retake`: how often these images were taken before; each time C-arm and
        arm stand a little differently. Raises SetUpError.
        """
        rng = retaken(self.generator("check", len(before_mm)), retake)
        true, imaged = self._at_images
        play = self.robot.manipulator.backlash / 2 * rng.uniform(-1, 1, self.robot.manipulator.count)
        then = true.T_mcs_cfcs(imaged + play)
        if self.setup.frame.solid is not None:
            then = then * RigidTransform.from_exp_coords(REMOUNT_SD * rng.standard_normal(6))
        motion = then.inv() * true.T_mcs_cfcs(imaged)
        key = key or self.document.wires[0].key
        return self._check_images({**before_mm, key: wire.axis_mm}, motion, rng)

    def drilling_images(
        self,
        wire: SimulatedWire,
        q: np.ndarray,
        state: str,
        key: str = "",
        before_mm: Mapping[str, np.ndarray] = MappingProxyType({}),
        *,
        on_patient: bool = False,
    ) -> CheckImages:
        """Render two images in ALIGNED or PAUSED, at the encoders `q` (n,): a block is put back on its mount, and the
        arm stands where it is, up to its play. `key`, `before_mm`: as of `check_images`. `on_patient`: the frame was
        taken off the arm and fixed to the patient, about where it was at the images (ON_PATIENT_SD).

        In ALIGNED the sleeve is drawn back. A person picks the wire there, since part of it lies before a saturated
        background: `picked_mm`. Raises SetUpError.
        """
        rng, key = self.generator(state, len(before_mm)), key or self.document.wires[0].key
        true, _ = self._at_images
        play = self.robot.manipulator.backlash / 2 * rng.uniform(-1, 1, self.robot.manipulator.count)
        now = true.T_mcs_cfcs(q + play) * RigidTransform.from_exp_coords(REMOUNT_SD * rng.standard_normal(6))
        motion = now.inv() * wire.T_mcs_cfcs
        if on_patient:
            motion = RigidTransform.from_exp_coords(ON_PATIENT_SD * rng.standard_normal(6))
        if state != ALIGNED:
            return self._check_images({**before_mm, key: wire.axis_mm}, motion, rng)
        along = (wire.T_mcs_cfcs.inv() * true.T_mcs_tool(q)).rotation.apply([0.0, 0.0, 1.0])
        behind = np.append(np.arange(MAX_SHOWN_MM, SHOWN_MM, -1.0), [SHOWN_MM, 0.0])
        line = wire.axis_mm[1] - behind[:, None] * along
        taken = self._check_images({**before_mm, key: line[[0, -1]]}, motion, rng, line[-2:])
        line = motion.apply(line)
        shown = [view.in_field(view.project(line), LANDMARK_MARGIN_PX) for view in taken.setup.views.values()]
        return replace(taken, picked_mm=np.linspace(line[int(np.argmax(np.all(shown, axis=0)))], line[-1], PICKED))

    @property
    def _at_images(self) -> tuple[Manipulator, np.ndarray]:
        """The true robot, and its joints (n,) at the images."""
        return drawn_robot(self.robot, _yaw(self.procedure, self.side), self.generator("robot"), self._feed_mm)

    @property
    def _feed_mm(self) -> float:
        return 0.0 if self.setup.frame.solid is None else SHOWN_FEED_MM


def robot_at(procedure: str, side: str, frame: Frame, arm: Design = "manipulator") -> CalibratedRobot:
    """Return the calibrated model of the robot that holds a frame for a procedure."""
    return calibrated_robot(side, frame, _yaw(procedure, side), arm)


def _yaw(procedure: str, side: str) -> float:
    """Return the yaw at the images, rad: that of a wire in a hip; beside a nail the robot stands square to the leg."""
    return 0.0 if procedure == NAILED else imaging_yaw(side)
