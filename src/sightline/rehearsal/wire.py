"""Puts a planned wire into a rehearsed patient's bone: its plan, the robot's target, the shots, what came of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from sightline.case.contents import CheckRequest, DrillShotRequest, Pair, PlanRequest
from sightline.case.report.drilled import Deviation, Drilled
from sightline.case.views import NAMES, calibrate_pair, see_pair
from sightline.common.atomic import scratch_folder
from sightline.common.checks import failed
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.common.geometry.lines import unit
from sightline.errors import RefusedError, RobotRefusedError
from sightline.from_images.pipeline import propose_order
from sightline.imaging import Radiograph, write_dicom
from sightline.planning import Plan, WirePlans, reconstruct
from sightline.planning.check.wires import Landmarks
from sightline.planning.points.results import SpacePoints
from sightline.rehearsal.operation import InsertionOutcome, registered, target_of
from sightline.rehearsal.patient import CheckImages, RehearsedPatient
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.control.insertion import DEPTH_SLACK_MM
from sightline.robot.control.states import State
from sightline.robot.control.supervision import depth_limit
from sightline.robot.kinematics.designs import Design
from sightline.robot.kinematics.target import PlanIdentity, Registration, RobotTarget
from sightline.robot.link.client import RobotClient

BY_ENCODERS, BY_IMAGES = "encoders", "images"


@dataclass(frozen=True, eq=False)
class DemoPlan:
    """A plan for a rehearsed patient, its inputs `asked`, and its images; `frame_name`: of its frame, for `Frame.load`.

    `wires`: the plans of all wires of the procedure, where it has several. `before_mm`: wires that are in the bone
    already, their axes (2, 3), CFCS of the planning images, by key.
    """

    rehearsal: RehearsedPatient
    frame_name: str
    asked: PlanRequest
    plan: Plan
    images: Pair
    wires: WirePlans | None = None
    before_mm: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def robot(self) -> Rehearsal:
        """The patient of a procedure WITH_ROBOT, with the robot."""
        return cast("Rehearsal", self.rehearsal)

    @property
    def arm(self) -> Design:
        """The design of the robot; the manipulator's where none drills."""
        return getattr(self.rehearsal, "arm", "manipulator")

    @property
    def key(self) -> str:
        """The wire's key."""
        return self.plan.kind.wire.key

    @property
    def of_wire(self) -> str:
        """Words that name the wire, "" where it is alone."""
        return "" if self.wires is None else f" of the {self.plan.kind.wire.name}"

    @property
    def others_mm(self) -> tuple[np.ndarray, ...]:
        """Entry and end (2, 3) of each other wire, as planned."""
        return () if self.wires is None else self.wires.others_mm(self.key)

    def each(self) -> "list[DemoPlan]":
        """Return the plan of each wire, in the proposed order of drilling."""
        wires = self.wires
        if wires is None:
            return [self]
        views, frame = [image.view for image in self.images], self.rehearsal.setup.frame
        order = propose_order(wires.lines, wires.procedure, views, frame, wires.placed)
        return [replace(self, asked=self.asked.of_wire(key), plan=wires.plans[key]) for key in order.keys]

    def beside(self, inserted: "Mapping[str, Inserted]") -> "DemoPlan":
        """Return the plan beside wires in the bone; a nail's hole is planned again on the same images, beside those
        that are drilled."""
        beside = replace(self, before_mm={key: wire.wire_mm for key, wire in inserted.items()})
        if self.asked.nail is None or not inserted:
            return beside
        left = {key: picks for key, picks in (self.asked.others or {}).items() if key not in inserted}
        asked = replace(self.asked, nail=replace(self.asked.nail, drilled=tuple(inserted)), others=left)
        return replace(beside, asked=asked, plan=asked.plan(self.images))

    def picked(self, xyz_mm: np.ndarray, rng: np.random.Generator) -> SpacePoints:
        """Return true points (N, 3), CFCS, as reconstructed from a person's picks in both images."""
        uv = self.rehearsal.pixels(xyz_mm)
        uv = uv + self.asked.pick_sd_px * rng.standard_normal(uv.shape)
        spread = np.broadcast_to(self.asked.pick_sd_px**2 * np.eye(2), (*uv.shape, 2))
        return reconstruct([image.view for image in self.images], uv, spread)

    def found_again(self, taken: CheckImages, rng: np.random.Generator) -> Landmarks:
        """Return the plan's landmarks, picked by a person in two more images."""
        asked = self.asked
        assert asked.landmarks_uv_px is not None  # noqa: S101 - they were picked
        again = taken.landmarks_px(tuple(self.rehearsal.landmarks), asked.pick_sd_px, rng)
        return Landmarks(asked.landmarks_uv_px, again, asked.pick_sd_px)


@dataclass(frozen=True, eq=False)
class TakenShot:
    """A check shot, or a shot while drilling: its inputs, its images (None if one could not be calibrated), and its
    result or the reason for a refusal."""

    request: CheckRequest | DrillShotRequest
    images: Pair | None
    result: Any

    @staticmethod
    def of(planned: DemoPlan, request: CheckRequest | DrillShotRequest, images: dict[str, Radiograph]) -> "TakenShot":
        """Measure images that are read back from files, as the planning images are."""
        frame, calibrated = planned.rehearsal.setup.frame, None
        try:
            with scratch_folder() as folder:
                pa, lateral = (write_dicom(images[name], folder / f"{name}.dcm") for name in NAMES)
                calibrated = calibrate_pair(see_pair(pa, lateral, frame), frame, "smooth")
            result = request.shot(planned.plan, planned.images, calibrated, planned.others_mm)
        except RefusedError as error:
            result = str(error)
        return TakenShot(request, calibrated, result)


@dataclass(frozen=True, eq=False)
class Inserted:
    """A wire in the bone, its axis `wire_mm` (2, 3), CFCS of the planning images: its plan, how it was drilled, its
    check shot, and the shots while drilling by the robot's state."""

    planned: DemoPlan
    wire_mm: np.ndarray
    drilled: Drilled
    checked: TakenShot
    shots: dict[str, TakenShot] = field(default_factory=dict)


def registrations(
    planned: DemoPlan, imaged: np.ndarray, now_s: float, rng: np.random.Generator
) -> dict[str, Registration]:
    """Return the robot's registration by its encoders (n,) at the images; with a block also by the images, in which a
    person picks the robot's own wire. Raises RobotRefusedError where both disagree beyond their stated errors."""
    robot, wire_mm = planned.robot.robot, planned.robot.robot_wire_mm
    by_encoders = {BY_ENCODERS: registered(robot, imaged, now_s)}
    if wire_mm is None:
        return by_encoders
    seen = planned.picked(wire_mm, rng)
    assert seen.joint_covariance_mm2 is not None  # noqa: S101 - both views state their errors
    corrected = robot.with_wire_seen(imaged, seen.xyz_mm, seen.joint_covariance_mm2)
    return by_encoders | {BY_IMAGES: registered(corrected, imaged, now_s)}


def targets_by(registrations: dict[str, Registration], planned: DemoPlan) -> dict[str, RobotTarget]:
    """Return the robot's target by each registration. Raises RobotRefusedError."""
    patient, plan = planned.robot, planned.plan
    name = "demo" if planned.wires is None else f"demo-{planned.key}"
    frame = patient.setup.frame.fingerprint
    identity = PlanIdentity(name, patient.side, patient.serial, plan.verdict.go, plan.kind.key, frame)
    return {by: target_of(plan, identity, registration) for by, registration in registrations.items()}


def depth_limit_mm(planned: DemoPlan, target: RobotTarget, rng: np.random.Generator) -> float:
    """Return the depth limit beyond the planned entry, mm: the distance along the wire to the head's surface, picked in
    both views, less the 95 % error of both. A drill through a nail has that of a plan without a surface."""
    if planned.asked.nail is not None:
        return target.depth_mm + DEPTH_SLACK_MM
    surface = planned.picked(planned.robot.surface_mm(planned.key)[None], rng)
    assert surface.covariance_mm2 is not None  # noqa: S101 - both views state their errors
    entry_mm, along = planned.plan.trajectory.entry_mm, planned.plan.trajectory.direction
    sd_mm = np.sqrt(along @ surface.covariance_mm2[0] @ along)
    error_mm = np.hypot(TWO_SIDED_95 * sd_mm, target.end_error_95_mm)
    return depth_limit(float((surface.xyz_mm[0] - entry_mm) @ along), float(error_mm))


def drill_shot(
    planned: DemoPlan, robot: RobotClient, target: RobotTarget, state: State, rng: np.random.Generator
) -> TakenShot:
    """Take and measure two images, with the block on its mount again; send a depth measured at the pause.

    Raises RobotRefusedError for a shot that says STOP.
    """
    plan, q = planned.plan, robot.joints()[0]
    taken = planned.robot.drilling_images(robot.simulated_wire(), q, state.value, planned.key, planned.before_mm)
    middle_mm = plan.trajectory.points.xyz_mm.mean(axis=0)
    movement, covariance = planned.robot.robot.frame_moved(target.registration.q, q, middle_mm)
    check = CheckRequest(plan.kind.wire_mm, planned.found_again(taken, rng))
    picked = None if taken.picked_mm is None else taken.pixels(taken.picked_mm, planned.asked.pick_sd_px, rng)
    depth_mm, straight = target.depth_at(q), state is State.ALIGNED
    request = DrillShotRequest(check, depth_mm, straight, movement.as_matrix(), covariance, picked)
    shot = TakenShot.of(planned, request, taken.images)
    if isinstance(shot.result, str):
        return shot
    if shot.result.decision == "STOP":
        reasons = "; ".join(check.sentence for check in failed(shot.result.verdict.checks))
        raise RobotRefusedError(f"the shot at {state.value} says STOP: {reasons}")
    if state is State.PAUSED and shot.result.decision == "GO":
        robot.shot_depth(shot.result.depth_mm, shot.result.depth_sd_mm)
    return shot


def deviations(planned: DemoPlan, wire_mm: np.ndarray) -> tuple[Deviation, ...]:
    """Return the true deviations of a wire (2, 3) from the plan, from the ideal wire, and from the points that were
    picked, if any were; of a drill that goes past its end point, at the end point."""
    lines = [
        ("the plan", planned.plan.trajectory.points.xyz_mm),
        ("the ideal wire", planned.rehearsal.ideal_mm[planned.key]),
    ]
    if planned.asked.nail is None:
        lines.append(("the picked points, as in the check shot", planned.rehearsal.picked_mm(planned.plan)))
    along = unit(wire_mm[1] - wire_mm[0])
    off_lines = []
    for name, line_mm in lines:
        ends_mm = wire_mm
        if planned.plan.kind.limits.beyond_mm > 0:  # the points of the wire's axis nearest to entry and end
            ends_mm = wire_mm[0] + ((line_mm - wire_mm[0]) @ along)[:, None] * along
        off = InsertionOutcome.of(ends_mm, line_mm)
        off_lines.append(Deviation(name, off.entry_mm, off.end_mm, float(np.rad2deg(off.angle_rad))))
    return tuple(off_lines)
