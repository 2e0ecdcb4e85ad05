"""Second half of the demo: the simulated robot drills the planned wires, and a check shot measures each."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Generic, TypeVar, cast

from sightline.common.closing import Closing

if TYPE_CHECKING:
    import numpy as np

    from sightline.case.contents import CheckRequest, Pair, PlanRequest
    from sightline.case.report.drilled import Deviation, Drilled
    from sightline.cli.demos.shots import ShotTaken
    from sightline.cli.output import Output
    from sightline.frame import Frame
    from sightline.imaging import Radiograph
    from sightline.planning import Plan, WirePlans
    from sightline.planning.check.result import CheckShot
    from sightline.planning.points.results import SpacePoints
    from sightline.rehearsal.patient import CheckImages, RehearsedPatient
    from sightline.rehearsal.process import RobotProcess
    from sightline.rehearsal.rehearsal import Rehearsal
    from sightline.robot.kinematics.target import Registration, RobotTarget

Who_co = TypeVar("Who_co", bound="RehearsedPatient", covariant=True)
BY_ENCODERS, BY_IMAGES = "encoders", "images"


@dataclass(frozen=True, eq=False)
class DemoPlan(Generic[Who_co]):
    """A plan for a rehearsed patient, as `asked`, and its images; `frame_name`: of its frame, for `Frame.load`.

    `wires`: the plans of all wires of the procedure, where it has several. `before_mm`: wires that are in the bone
    already, their axes (2, 3), CFCS of the planning images, by key.
    """

    rehearsal: Who_co
    frame_name: str
    asked: "PlanRequest"
    plan: "Plan"
    images: "Pair"
    wires: "WirePlans | None" = None
    before_mm: "Mapping[str, np.ndarray]" = field(default_factory=dict)

    @property
    def key(self) -> str:
        """The wire's key."""
        return self.plan.kind.wire.key

    @property
    def others_mm(self) -> "tuple[np.ndarray, ...]":
        """Entry and end (2, 3) of each other wire, as planned."""
        return () if self.wires is None else self.wires.others_mm(self.key)

    def each(self) -> "list[DemoPlan[Who_co]]":
        """Return the plan of each wire, in the proposed order of drilling."""
        from sightline.from_images.pipeline import propose_order

        wires = self.wires
        if wires is None:
            return [self]
        views, frame = [image.view for image in self.images], self.rehearsal.setup.frame
        order = propose_order(wires.lines, wires.procedure, views, frame, wires.placed)
        return [replace(self, asked=self.asked.of_wire(key), plan=wires.plans[key]) for key in order.keys]


@dataclass(frozen=True, eq=False)
class Checked:
    """A check shot: its inputs, its images, and its result or the reason for a refusal.

    `images` is None where one of them could not be calibrated.
    """

    asked: "CheckRequest"
    images: "Pair | None"
    found: "CheckShot | str"


@dataclass(frozen=True, eq=False)
class Inserted:
    """A wire in the bone, its axis `wire_mm` (2, 3), CFCS of the planning images: how it was drilled, its check shot,
    and the shots while drilling by the robot's state. `again`: the inputs, where it was planned again before."""

    plan: "Plan"
    wire_mm: "np.ndarray"
    drilled: "Drilled"
    checked: Checked
    shots: "dict[str, ShotTaken]"
    again: "PlanRequest | None" = None


class RobotAhead(Closing):
    """The process of the simulated robot, started before it is needed: it starts while the images are drawn.

    It is started if the robot drills the patient that `drawn_patient` draws. `frame`: its name, by default the
    procedure's.
    """

    def __init__(self, seed: int, procedure: str, frame: str | None) -> None:
        from sightline.cli.demos.procedures import SIDE, WITH_ROBOT

        starts = procedure in WITH_ROBOT and _installed()
        self._running = _robot(seed, frame or WITH_ROBOT[procedure], SIDE, procedure) if starts else None

    def keep_beside(self, frame: "Frame") -> None:
        """End it where a frame leaves the robot no room."""
        if not _has_room(frame):
            self.close()

    def take(self, planned: "DemoPlan[Rehearsal]") -> "RobotProcess":
        """The one that was started, or a new one for another wire."""
        taken, self._running = self._running, None
        of = planned.rehearsal
        return taken or _robot(of.seed, planned.frame_name, of.side, of.procedure)

    def close(self) -> None:
        """End it, if nobody took it."""
        if self._running is not None:
            self._running.close()
            self._running = None


def _robot(seed: int, frame_name: str, side: str, procedure: str) -> "RobotProcess":
    """Start the process, without an import that takes long."""
    from sightline.rehearsal.process import RobotProcess

    return RobotProcess(seed, frame_name, side, procedure, virtual=True)


def carry_out(
    output: "Output", planned: "DemoPlan[RehearsedPatient]", ahead: RobotAhead, rng: "np.random.Generator"
) -> dict[str, Inserted]:
    """Return the wires by key, put in one after another in the proposed order, each checked before the next.

    They are drilled by the robot, or placed at bones that its simulation does not know. It ends where the robot does
    not drill (`drill`).
    """
    from sightline.cli.demos.procedures import PLACED, with_robot

    done: dict[str, Inserted] = {}
    drills = with_robot(planned.rehearsal.procedure)
    if not drills:
        output.say(PLACED)
    for one in planned.each():
        beside = replace(_again(one, tuple(done)), before_mm={key: other.wire_mm for key, other in done.items()})
        by_robot = cast("DemoPlan[Rehearsal]", beside)
        inserted = drill(output, by_robot, ahead, rng) if drills else place(output, beside, rng)
        if inserted is None:
            break
        done[one.key] = inserted
    return done


def _again(planned: "DemoPlan[Who_co]", drilled: tuple[str, ...]) -> "DemoPlan[Who_co]":
    """Return a hole of a nail planned again on the same images, beside the holes that are drilled; other plans as they
    are."""
    asked = planned.asked
    if asked.nail is None or not drilled:
        return planned
    left = {key: picks for key, picks in (asked.others or {}).items() if key not in drilled}
    asked = replace(asked, nail=replace(asked.nail, drilled=drilled), others=left)
    return replace(planned, asked=asked, plan=asked.plan(planned.images))


def _installed() -> bool:
    return find_spec("mujoco") is not None


def _has_room(frame: "Frame") -> bool:
    return frame.detector is None


def drill(
    output: "Output", planned: "DemoPlan[Rehearsal]", ahead: RobotAhead, rng: "np.random.Generator"
) -> Inserted | None:
    """Return a wire drilled by the robot; None, with a message, if the robot is not installed or refuses."""
    from sightline.errors import RefusedError

    if not _installed():
        output.note("the robot is left out: it needs MuJoCo (pip install 'sightline[robot]')")
        return None
    if not _has_room(planned.rehearsal.setup.frame):
        output.say("not drilled: beside a block the field of an image intensifier has no room for the robot's wire")
        return None
    try:
        return _drill(output, planned, ahead, rng)
    except RefusedError as error:
        output.say(f"not drilled: {error}")
        return None


def place(output: "Output", planned: "DemoPlan[RehearsedPatient]", rng: "np.random.Generator") -> Inserted:
    """Return a wire put into the twin's bone where it is planned, without a robot."""
    from sightline.case.report.drilled import Drilled

    wire_mm = planned.plan.trajectory.points.xyz_mm
    with output.step(f"7/8 the check shot{_of(planned)}: two more images, finding the wire in both"):
        checked = check(planned, planned.rehearsal.shown_again({**planned.before_mm, planned.key: wire_mm}), rng)
    drilled = Drilled(None, None, checked.found, _physics(planned, wire_mm)[1:])
    return Inserted(planned.plan, wire_mm, drilled, checked, {})


def _of(planned: "DemoPlan[RehearsedPatient]") -> str:
    return "" if planned.wires is None else f" of the {planned.plan.kind.wire.name}"


def _physics(planned: "DemoPlan[RehearsedPatient]", wire_mm: "np.ndarray") -> "tuple[Deviation, ...]":
    """Return the true deviations of a wire (2, 3) from the plan, from the ideal wire, and from the points that were
    picked, if any were; of a drill that goes past its end point, at the end point."""
    import numpy as np

    from sightline.case.report.drilled import Deviation
    from sightline.rehearsal.operation import InsertionOutcome

    ideal_mm, past = planned.rehearsal.ideal_mm[planned.key], planned.plan.kind.limits.beyond_mm > 0
    lines = [("the plan", planned.plan.trajectory.points.xyz_mm), ("the ideal wire", ideal_mm)]
    if planned.asked.nail is None:
        lines.append(("the picked points, as in the check shot", planned.rehearsal.picked_mm(planned.plan)))
    ends = {name: _beside(wire_mm, line) if past else wire_mm for name, line in lines}
    found = [(name, InsertionOutcome.of(ends[name], line)) for name, line in lines]
    return tuple(Deviation(name, one.entry_mm, one.end_mm, float(np.rad2deg(one.angle_rad))) for name, one in found)


def _beside(wire_mm: "np.ndarray", line_mm: "np.ndarray") -> "np.ndarray":
    """Return the points (2, 3) of a wire's axis that are nearest to entry and end (2, 3)."""
    import numpy as np

    along = (wire_mm[1] - wire_mm[0]) / np.linalg.norm(wire_mm[1] - wire_mm[0])
    return wire_mm[0] + ((line_mm - wire_mm[0]) @ along)[:, None] * along


def _drill(output: "Output", planned: "DemoPlan[Rehearsal]", ahead: RobotAhead, rng: "np.random.Generator") -> Inserted:
    from time import monotonic

    from sightline.case.report.drilled import Drilled
    from sightline.cli.demos.shots import confirming
    from sightline.common.checks import failed
    from sightline.rehearsal.operation import insert
    from sightline.robot.link.client import RobotClient

    rehearsal = planned.rehearsal
    with (
        output.step(f"6/8 the robot{_of(planned)}: registering, aligning, drilling under force supervision"),
        ahead.take(planned) as process,
        RobotClient(port=process.port, heartbeat=False) as robot,
    ):
        targets = targets_by(registrations(planned, robot.joints()[0], monotonic(), rng), planned)
        fit = [target for target in targets.values() if not failed(target.checks)]
        target = fit[0] if fit else targets[BY_ENCODERS]  # a hole's limit needs the images
        confirm, shots = confirming(output, planned, robot, target, rng)
        record = insert(robot, target, depth_limit_mm(planned, target, rng), confirm)
        wire = robot.simulated_wire()
    with output.step(f"7/8 the check shot{_of(planned)}: two more images, finding the wire in both"):
        checked = check(planned, rehearsal.check_images(wire, planned.key, planned.before_mm), rng)
    physics = _physics(planned, wire.axis_mm)
    seen = {state: one.found for state, one in shots.items()}
    drilled = Drilled(target, record, checked.found, physics, targets.get(BY_IMAGES), seen)
    again = planned.asked if planned.asked.nail is not None and planned.before_mm else None
    return Inserted(planned.plan, wire.axis_mm, drilled, checked, shots, again)


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
    name = "demo" if planned.wires is None else f"demo-{planned.key}"
    identity = PlanIdentity(name, rehearsal.side, rehearsal.serial, plan.verdict.go, plan.kind.key, frame)
    return {by: target_of(plan, identity, one) for by, one in stood.items()}


def check(planned: "DemoPlan[RehearsedPatient]", taken: "CheckImages", rng: "np.random.Generator") -> Checked:
    """Return the check shot of a wire on two more images."""
    from sightline.case.contents import CheckRequest
    from sightline.cli.demos.shots import found_again
    from sightline.errors import RefusedError

    asked, images = CheckRequest(planned.plan.kind.wire_mm, found_again(planned, taken, rng)), None
    try:
        images = read_back(taken.images, planned.rehearsal.setup.frame)
        return Checked(asked, images, asked.shot(planned.plan, planned.images, images, planned.others_mm))
    except RefusedError as error:
        return Checked(asked, images, str(error))


def read_back(images: "dict[str, Radiograph]", frame: "Frame") -> "Pair":
    """Return both images read back from files, as the planning images are, and calibrated."""
    from sightline.case.views import NAMES, calibrate_pair, see_pair
    from sightline.common.atomic import scratch_folder
    from sightline.imaging import write_dicom

    with scratch_folder() as folder:
        pa, lateral = (write_dicom(images[name], folder / f"{name}.dcm") for name in NAMES)
        return calibrate_pair(see_pair(pa, lateral, frame), frame, "smooth")


def depth_limit_mm(planned: "DemoPlan[Rehearsal]", target: "RobotTarget", rng: "np.random.Generator") -> float:
    """Return the depth limit beyond the planned entry, mm: the distance along the wire to the head's surface, picked in
    both views, less the 95 % error of both. A drill through a nail has that of a plan without a surface."""
    import numpy as np

    from sightline.common.geometry.covariance import TWO_SIDED_95
    from sightline.robot.control.insertion import DEPTH_SLACK_MM
    from sightline.robot.control.supervision import depth_limit

    if planned.asked.nail is not None:
        return target.depth_mm + DEPTH_SLACK_MM
    surface = _picked(planned, planned.rehearsal.surface_mm(planned.key)[None], rng)
    assert surface.covariance_mm2 is not None  # noqa: S101 - both views state their errors
    entry_mm, along = planned.plan.trajectory.entry_mm, planned.plan.trajectory.direction
    sd_mm = np.sqrt(along @ surface.covariance_mm2[0] @ along)
    error_mm = np.hypot(TWO_SIDED_95 * sd_mm, target.end_error_95_mm)
    return depth_limit(float((surface.xyz_mm[0] - entry_mm) @ along), float(error_mm))


def _picked(planned: "DemoPlan[RehearsedPatient]", xyz_mm: "np.ndarray", rng: "np.random.Generator") -> "SpacePoints":
    """Return true points (N, 3), CFCS, as reconstructed from a person's picks in both images."""
    import numpy as np

    from sightline.planning import reconstruct

    uv = planned.rehearsal.pixels(xyz_mm)
    uv = uv + planned.asked.pick_sd_px * rng.standard_normal(uv.shape)
    spread = np.broadcast_to(planned.asked.pick_sd_px**2 * np.eye(2), (*uv.shape, 2))
    return reconstruct([image.view for image in planned.images], uv, spread)
