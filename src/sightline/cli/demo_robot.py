"""Second half of the demo: the simulated robot drills the planned wire, and a check shot measures it."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from sightline.case.contents import CheckRequest, Pair
    from sightline.case.report.drilled import Drilled
    from sightline.cli.output import Output
    from sightline.frame import Frame
    from sightline.imaging import Radiograph
    from sightline.planning import Plan
    from sightline.planning.check_result import CheckShot
    from sightline.rehearsal.rehearsal import Rehearsal


@dataclass(frozen=True, eq=False)
class DemoPlan:
    """A plan for a rehearsal and its inputs; `frame_name`: of its frame, for `Frame.load`; `landmarks_px` (2, L, 2):
    the landmarks named `landmarks`, as picked with `pick_sd_px`."""

    rehearsal: "Rehearsal"
    frame_name: str
    plan: "Plan"
    images: "Pair"
    landmarks: tuple[str, ...]
    landmarks_px: "np.ndarray"
    pick_sd_px: float


@dataclass(frozen=True, eq=False)
class Checked:
    """A check shot: its inputs, its images, and its result or the reason for a refusal.

    `images` is None where one of them could not be calibrated.
    """

    asked: "CheckRequest"
    images: "Pair | None"
    found: "CheckShot | str"


def drill(output: "Output", planned: DemoPlan, rng: "np.random.Generator") -> "tuple[Drilled, Checked] | None":
    """Return the drilled wire and its check shot; None, with a message, if the robot is not installed or refuses."""
    from sightline.errors import RefusedError

    if find_spec("mujoco") is None:
        output.note("the robot is left out: it needs MuJoCo (pip install 'sightline[robot]')")
        return None
    if planned.rehearsal.setup.frame.solid is not None:
        output.say(
            "not drilled: the simulated robot holds the plates of a frame; it does not know where a block stands"
        )
        return None
    try:
        return _drill(output, planned, rng)
    except RefusedError as error:
        output.say(f"not drilled: {error}")
        return None


def _drill(output: "Output", planned: DemoPlan, rng: "np.random.Generator") -> "tuple[Drilled, Checked]":
    from time import monotonic

    import numpy as np

    from sightline.case.contents import CheckRequest
    from sightline.case.report.drilled import Deviation, Drilled
    from sightline.errors import RefusedError
    from sightline.planning.check_shot import Landmarks
    from sightline.rehearsal.operation import InsertionOutcome, insert, registered, target_of
    from sightline.rehearsal.process import RobotProcess
    from sightline.robot.kinematics.target import PlanIdentity
    from sightline.robot.link.client import RobotClient
    from sightline.twin.implants import WIRE_DIAMETER_MM

    rehearsal, plan, sd_px = planned.rehearsal, planned.plan, planned.pick_sd_px
    with output.step("6/8 the robot: registering, aligning, drilling under force supervision"):
        frame = rehearsal.setup.frame.fingerprint
        identity = PlanIdentity("demo", rehearsal.side, rehearsal.serial, plan.verdict.go, plan.kind.key, frame)
        with (
            RobotProcess(rehearsal.seed, planned.frame_name, rehearsal.side, virtual=True) as process,
            RobotClient(port=process.port, heartbeat=False) as robot,
        ):
            target = target_of(plan, identity, registered(rehearsal.robot, robot.joints()[0], monotonic()))
            record = insert(robot, target, _depth_limit(planned, target.end_error_95_mm, rng))
            wire = robot.simulated_wire()
    with output.step("7/8 the check shot: two more images, finding the wire in both"):
        taken = rehearsal.check_images(wire)
        found = taken.landmarks_px(planned.landmarks, sd_px, rng)
        asked, images = CheckRequest(WIRE_DIAMETER_MM, Landmarks(planned.landmarks_px, found, sd_px)), None
        try:
            images = _read_back(taken.images, rehearsal.setup.frame)
            check = asked.shot(plan, planned.images, images)
        except RefusedError as error:
            check = str(error)
    physics = []
    for name, line in (("the plan", plan.trajectory.points.xyz_mm), ("the ideal wire", rehearsal.hip.wire_mm)):
        one = InsertionOutcome.of(wire.axis_mm, line)
        physics.append(Deviation(name, one.entry_mm, one.end_mm, float(np.rad2deg(one.angle_rad))))
    return Drilled(target, record, check, tuple(physics)), Checked(asked, images, check)


def _read_back(images: "dict[str, Radiograph]", frame: "Frame") -> "Pair":
    """Return both images read back from files, as the planning images are, and calibrated."""
    from sightline.atomic import scratch_folder
    from sightline.case.views import NAMES, calibrate_pair, see_pair
    from sightline.imaging import write_dicom

    with scratch_folder() as folder:
        pa, lateral = (write_dicom(images[name], folder / f"{name}.dcm") for name in NAMES)
        return calibrate_pair(see_pair(pa, lateral, frame), frame, "smooth")


def _depth_limit(planned: DemoPlan, end_error_95_mm: float, rng: "np.random.Generator") -> float:
    """Return the depth limit beyond the planned entry, mm: the distance along the wire to the head's surface, picked in
    both views, less the 95 % error of both."""
    import numpy as np

    from sightline.geometry.covariance import TWO_SIDED_95
    from sightline.planning import reconstruct
    from sightline.robot.control.motion.supervision import depth_limit

    uv = planned.rehearsal.pixels(planned.rehearsal.surface_mm[None])
    uv = uv + planned.pick_sd_px * rng.standard_normal(uv.shape)
    spread = np.broadcast_to(planned.pick_sd_px**2 * np.eye(2), (2, 1, 2, 2))
    surface = reconstruct([image.view for image in planned.images], uv, spread)
    entry_mm, along = planned.plan.trajectory.entry_mm, planned.plan.trajectory.direction
    sd_mm = np.sqrt(along @ surface.covariance_mm2[0] @ along)
    error_mm = np.hypot(TWO_SIDED_95 * sd_mm, end_error_95_mm)
    return depth_limit(float((surface.xyz_mm[0] - entry_mm) @ along), float(error_mm))
