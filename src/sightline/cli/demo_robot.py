"""Second half of the demo: the simulated robot drills the planned wire, and a check shot measures it."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    import numpy as np

    from sightline.case.contents import CheckRequest, Pair, PlanRequest
    from sightline.case.report.drilled import Deviation, Drilled
    from sightline.cli.demo_shots import ShotTaken
    from sightline.cli.output import Output
    from sightline.frame import Frame
    from sightline.imaging import Radiograph
    from sightline.planning import Plan
    from sightline.planning.check_result import CheckShot
    from sightline.planning.results import SpacePoints
    from sightline.rehearsal.check_images import CheckImages
    from sightline.rehearsal.patient import RehearsedPatient
    from sightline.rehearsal.rehearsal import Rehearsal
    from sightline.robot.kinematics.registration import Registration
    from sightline.robot.kinematics.target import RobotTarget

Who_co = TypeVar("Who_co", bound="RehearsedPatient", covariant=True)
BY_ENCODERS, BY_IMAGES = "encoders", "images"


@dataclass(frozen=True, eq=False)
class DemoPlan(Generic[Who_co]):
    """A plan for a rehearsed patient, as `asked`, and its images; `frame_name`: of its frame, for `Frame.load`."""

    rehearsal: Who_co
    frame_name: str
    asked: "PlanRequest"
    plan: "Plan"
    images: "Pair"


@dataclass(frozen=True, eq=False)
class Checked:
    """A check shot: its inputs, its images, and its result or the reason for a refusal.

    `images` is None where one of them could not be calibrated.
    """

    asked: "CheckRequest"
    images: "Pair | None"
    found: "CheckShot | str"


def carry_out(
    output: "Output", planned: "DemoPlan[RehearsedPatient]", rng: "np.random.Generator"
) -> "tuple[Drilled, Checked, dict[str, ShotTaken]] | None":
    """Return the wire, its check shot, and the shots while drilling by the robot's state.

    It is drilled by the robot, or placed at bones that its simulation does not know. None as of `drill`.
    """
    from sightline.rehearsal.rehearsal import Rehearsal

    who = planned.rehearsal
    if not isinstance(who, Rehearsal):
        return place(output, planned, rng)
    return drill(output, DemoPlan(who, planned.frame_name, planned.asked, planned.plan, planned.images), rng)


def drill(
    output: "Output", planned: "DemoPlan[Rehearsal]", rng: "np.random.Generator"
) -> "tuple[Drilled, Checked, dict[str, ShotTaken]] | None":
    """Return what `carry_out` returns of a drilled wire; None, with a message, if the robot is not installed or
    refuses."""
    from sightline.errors import RefusedError

    if find_spec("mujoco") is None:
        output.note("the robot is left out: it needs MuJoCo (pip install 'sightline[robot]')")
        return None
    if planned.rehearsal.setup.frame.detector is not None:
        output.say("not drilled: beside a block the field of an image intensifier has no room for the robot's wire")
        return None
    try:
        return _drill(output, planned, rng)
    except RefusedError as error:
        output.say(f"not drilled: {error}")
        return None


def place(
    output: "Output", planned: "DemoPlan[RehearsedPatient]", rng: "np.random.Generator"
) -> "tuple[Drilled, Checked, dict[str, ShotTaken]]":
    """Return the wire put into the twin's bone where it is planned, without a robot, and its check shot."""
    from sightline.case.report.drilled import Drilled
    from sightline.cli.demo_procedures import PLACED

    output.say(PLACED)
    wire_mm = planned.plan.trajectory.points.xyz_mm
    with output.step("7/8 the check shot: two more images, finding the wire in both"):
        checked = check(planned, planned.rehearsal.shown_again(wire_mm), rng)
    return Drilled(None, None, checked.found, _physics(planned, wire_mm)[1:]), checked, {}


def _physics(planned: "DemoPlan[RehearsedPatient]", wire_mm: "np.ndarray") -> "tuple[Deviation, ...]":
    """Return the true deviations of a wire (2, 3) from the plan and from the ideal wire."""
    import numpy as np

    from sightline.case.report.drilled import Deviation
    from sightline.rehearsal.operation import InsertionOutcome

    lines = (("the plan", planned.plan.trajectory.points.xyz_mm), ("the ideal wire", planned.rehearsal.wires_mm[0]))
    found = [(name, InsertionOutcome.of(wire_mm, line)) for name, line in lines]
    return tuple(Deviation(name, one.entry_mm, one.end_mm, float(np.rad2deg(one.angle_rad))) for name, one in found)


def _drill(
    output: "Output", planned: "DemoPlan[Rehearsal]", rng: "np.random.Generator"
) -> "tuple[Drilled, Checked, dict[str, ShotTaken]]":
    from time import monotonic

    from sightline.case.report.drilled import Drilled
    from sightline.cli.demo_shots import confirming
    from sightline.rehearsal.operation import insert
    from sightline.rehearsal.process import RobotProcess
    from sightline.robot.link.client import RobotClient

    rehearsal = planned.rehearsal
    with (
        output.step("6/8 the robot: registering, aligning, drilling under force supervision"),
        RobotProcess(rehearsal.seed, planned.frame_name, rehearsal.side, virtual=True) as process,
        RobotClient(port=process.port, heartbeat=False) as robot,
    ):
        targets = targets_by(registrations(planned, robot.joints()[0], monotonic(), rng), planned)
        target = targets[BY_ENCODERS]
        confirm, shots = confirming(output, planned, robot, target, rng)
        record = insert(robot, target, depth_limit_mm(planned, target.end_error_95_mm, rng), confirm)
        wire = robot.simulated_wire()
    with output.step("7/8 the check shot: two more images, finding the wire in both"):
        checked = check(planned, rehearsal.check_images(wire), rng)
    physics = _physics(planned, wire.axis_mm)
    seen = {state: one.found for state, one in shots.items()}
    return Drilled(target, record, checked.found, physics, targets.get(BY_IMAGES), seen), checked, shots


def registrations(
    planned: "DemoPlan[Rehearsal]", imaged: "np.ndarray", now_s: float, rng: "np.random.Generator"
) -> "dict[str, Registration]":
    """Return the robot's registration by its encoders (5,) at the images; with a block also by the images, in which a
    person picks the robot's own wire. Raises RobotRefusedError where both disagree beyond their stated errors."""
    from sightline.rehearsal.operation import registered

    robot, wire_mm = planned.rehearsal.robot, planned.rehearsal.robot_wire_mm
    out = {BY_ENCODERS: registered(robot, imaged, now_s)}
    if wire_mm is not None:
        seen = _picked(planned, wire_mm, rng)
        assert seen.joint_covariance_mm2 is not None  # noqa: S101 - both views state their errors
        corrected = robot.with_wire_seen(imaged, seen.xyz_mm, seen.joint_covariance_mm2)
        out[BY_IMAGES] = registered(corrected, imaged, now_s)
    return out


def targets_by(stood: "dict[str, Registration]", planned: "DemoPlan[Rehearsal]") -> "dict[str, RobotTarget]":
    """Return the robot's target by each registration. Raises RobotRefusedError."""
    from sightline.rehearsal.operation import target_of
    from sightline.robot.kinematics.target import PlanIdentity

    rehearsal, plan = planned.rehearsal, planned.plan
    frame = rehearsal.setup.frame.fingerprint
    identity = PlanIdentity("demo", rehearsal.side, rehearsal.serial, plan.verdict.go, plan.kind.key, frame)
    return {by: target_of(plan, identity, one) for by, one in stood.items()}


def check(planned: "DemoPlan[RehearsedPatient]", taken: "CheckImages", rng: "np.random.Generator") -> Checked:
    """Return the check shot of a wire on two more images."""
    from sightline.case.contents import CheckRequest
    from sightline.cli.demo_shots import found_again
    from sightline.errors import RefusedError

    asked, images = CheckRequest(planned.plan.kind.wire_mm, found_again(planned, taken, rng)), None
    try:
        images = read_back(taken.images, planned.rehearsal.setup.frame)
        return Checked(asked, images, asked.shot(planned.plan, planned.images, images))
    except RefusedError as error:
        return Checked(asked, images, str(error))


def read_back(images: "dict[str, Radiograph]", frame: "Frame") -> "Pair":
    """Return both images read back from files, as the planning images are, and calibrated."""
    from sightline.atomic import scratch_folder
    from sightline.case.views import NAMES, calibrate_pair, see_pair
    from sightline.imaging import write_dicom

    with scratch_folder() as folder:
        pa, lateral = (write_dicom(images[name], folder / f"{name}.dcm") for name in NAMES)
        return calibrate_pair(see_pair(pa, lateral, frame), frame, "smooth")


def depth_limit_mm(planned: "DemoPlan[Rehearsal]", end_error_95_mm: float, rng: "np.random.Generator") -> float:
    """Return the depth limit beyond the planned entry, mm: the distance along the wire to the head's surface, picked in
    both views, less the 95 % error of both."""
    import numpy as np

    from sightline.geometry.covariance import TWO_SIDED_95
    from sightline.robot.control.motion.supervision import depth_limit

    surface = _picked(planned, planned.rehearsal.surface_mm[None], rng)
    assert surface.covariance_mm2 is not None  # noqa: S101 - both views state their errors
    entry_mm, along = planned.plan.trajectory.entry_mm, planned.plan.trajectory.direction
    sd_mm = np.sqrt(along @ surface.covariance_mm2[0] @ along)
    error_mm = np.hypot(TWO_SIDED_95 * sd_mm, end_error_95_mm)
    return depth_limit(float((surface.xyz_mm[0] - entry_mm) @ along), float(error_mm))


def _picked(planned: "DemoPlan[RehearsedPatient]", xyz_mm: "np.ndarray", rng: "np.random.Generator") -> "SpacePoints":
    """Return true points (N, 3), CFCS, as reconstructed from a person's picks in both images."""
    import numpy as np

    from sightline.planning import reconstruct

    uv = planned.rehearsal.pixels(xyz_mm)
    uv = uv + planned.asked.pick_sd_px * rng.standard_normal(uv.shape)
    spread = np.broadcast_to(planned.asked.pick_sd_px**2 * np.eye(2), (*uv.shape, 2))
    return reconstruct([image.view for image in planned.images], uv, spread)
