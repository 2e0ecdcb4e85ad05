"""`sightline robot drive`: a planned wire drilled by a robot, and the shots that are measured while it waits."""

import math
import shlex
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.cli.base import Output, WireKey, command, parse_address
from sightline.cli.check_shot import NewImages, landmarks_of, measure_check, measure_shot
from sightline.cli.robot.commands import (
    SERIAL,
    Simulator,
    Yes,
    agreed,
    app,
    read_plan,
    refuse_yes,
    registration_for,
)
from sightline.common.checks import failed

if TYPE_CHECKING:
    from sightline.case.contents import DrillShotRequest
    from sightline.case.interop.plan_file import PlanFile
    from sightline.case.journal import Case, Entry
    from sightline.case.picks import Picks
    from sightline.case.replay import Recomputed
    from sightline.common.checks import Check
    from sightline.frame import Frame
    from sightline.planning.check.shot import DrillShot
    from sightline.rehearsal.rehearsal import Rehearsal
    from sightline.robot.igtl import Message
    from sightline.robot.kinematics.measured import RobotFile
    from sightline.robot.kinematics.target import Registration, RobotTarget
    from sightline.robot.link.client import RobotClient
    from sightline.robot.link.record import DrillingRecord


FROM_CASE = "case"  # instead of files
# A guide that is further off is told to the person who drills: a third of what is a fault, and a direction like it
# [ours].
GUIDE_TOLD_MM, GUIDE_TOLD_RAD = 0.3, math.radians(0.3)


@dataclass(frozen=True)
class MeasuredShots:
    """Where the shots while drilling are measured."""

    case: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the case with this plan, for the check shot at the end; with a block or --patient-frame "
            "the shots at the skin and at the pause are measured too, while the robot waits. All are recorded.",
            show_default=False,
        ),
    ] = None
    patient_frame: Annotated[
        str | None,
        typer.Option(
            help="Frame that is fixed to the patient in these shots: a file, or a built-in frame. The robot must not "
            "hold it; three landmarks found again tell where it is.",
            show_default=False,
        ),
    ] = None

    @property
    def frame_on_patient(self) -> "Frame | None":
        """The frame that is fixed to the patient. Raises FrameError, UnusableInputError where no shot is measured."""
        from sightline.errors import UnusableInputError
        from sightline.frame import Frame

        if self.patient_frame is not None and self.case is None:
            raise UnusableInputError("--patient-frame serves the shots that are measured: give --case too")
        return None if self.patient_frame is None else Frame.load(self.patient_frame)


@command(app, "drive", "sightline robot drive out/plan/plan.json --rehearse 9")
def drive(
    output: Output,
    *,
    plan: Annotated[Path, typer.Argument(help="plan.json of `sightline plan --out`, or its folder.")],
    address: Annotated[
        str | None, typer.Argument(metavar="HOST:PORT", help="Address of the robot; without it a simulator is started.")
    ] = None,
    registration: Annotated[
        Path | None, typer.Option(help="Robot file with the joints at both images; a real robot needs it.")
    ] = None,
    wire: WireKey = None,
    simulator: Simulator,
    measured: MeasuredShots,
    yes: Yes = False,
) -> None:
    """Drive a planned wire into the bone.

    Align, confirm, drill, pause, confirm, drill, check shot. A person confirms each motion. A real robot first makes a
    dry run without the wire. A shot that says STOP ends it. Exit code 4 if no check shot shows where the wire lies.
    """
    from sightline.robot.kinematics.measured import RobotFile
    from sightline.robot.link.server import tune_process

    tune_process()
    known = read_plan(plan, wire)
    on_patient = measured.frame_on_patient
    block = known.of_solid and on_patient is None  # that a person puts back on its mount for the shots
    planned = 0 if measured.case is None else planned_in(measured.case, known)
    stood = None if registration is None else RobotFile.read(registration)
    _refuse_contradictions(address, stood, simulator)
    with ExitStack() as stack:
        robot, held, patient = _connected(output, stack, address, simulator, known)
        refuse_yes(robot.simulated, yes)
        with output.step("sending the plan"):
            name = known.identifier(plan.stem)
            if stood is None:
                target = _send(robot, known, name, held)
            else:
                target = _send_registered(robot, known, name, stood)
        _show(output, target, robot)
        shots = None if measured.case is None else DriveShots(output, measured.case, planned, robot, target, on_patient)
        steps = _steps(robot, target, block=known.of_solid, put_back=block)
        stopped = _carry_out(output, robot, steps, shots, Asked(yes=yes, measurable=block or on_patient is not None))
        document = _ended(output, robot, known, shots)
        if patient is not None:
            document["true_wire_mm"] = robot.simulated_wire().axis_mm
        if stopped is None:
            _say_verified(output, document, _check_shot(shots, patient, known, yes=yes))
        elif stopped.drills_on:
            _say_verified(output, document, UNFINISHED)
        else:
            output.result(document)  # no wire is in the bone


@dataclass(frozen=True)
class Asked:
    """How a person is asked: `yes` answers every question; `measurable`: shots while drilling can be measured."""

    yes: bool
    measurable: bool


def _carry_out(
    output: Output, robot: "RobotClient", steps: "list[_Step]", shots: "DriveShots | None", asked: Asked
) -> "_Step | None":
    """Carry out the steps; return the one before which a person stopped, None where all are done.

    What was drilled is recorded in the case of the shots, however the steps end.
    """
    from sightline.robot.link.record import Recorder

    recorder = Recorder()
    robot.listeners.append(recorder.heard)
    try:
        for step in steps:
            if step.state_before:
                _shot(output, robot, step.state_before, None if asked.yes else shots, measurable=asked.measurable)
            if not agreed(robot.simulated, asked.yes, step.question):
                robot.stop()
                output.note(f"stopped before: {step.name}")
                return step
            with output.step(step.name):
                step.start()
        return None
    finally:
        if shots is not None:
            shots.record_drilled(recorder.record)


def _ended(output: Output, robot: "RobotClient", plan: "PlanFile", shots: "DriveShots | None") -> dict[str, Any]:
    """Print the robot's state and return it as a document, with where the tip lies and the shots that were measured."""
    from sightline.robot import contract

    state, reached_mm = robot.status().text.split(";")[0], robot.position().translation
    output.say(f"state of the robot: {state}")
    # Where a person drilled, the robot knows where the mouth of its guide is, not the tip.
    by_hand = contract.HAS_GUIDE in robot.capabilities
    document: dict[str, Any] = {"state": state, "tip_mm": None if by_hand else reached_mm, "end_mm": plan.points_mm[1]}
    return document if shots is None else {**document, "shots": shots.document()}


UNFINISHED = (
    "the wire is in the bone and its drilling was not ended; drive this plan again, while it is valid, to drill it on"
)


def _say_verified(
    output: Output, document: dict[str, Any], checked: "tuple[dict[str, Any], tuple[Check, ...]] | str"
) -> None:
    """Print the result with the check shot and its checks, or that the wire is not verified and why."""
    if isinstance(checked, str):
        output.say(f"not verified: {checked}")
        output.result({**document, "verified": False, "check_shot": None}, verified=False)
        return
    shot, checks = checked
    output.result({**document, "verified": not failed(checks), "check_shot": shot}, checks)


def _check_shot(
    shots: "DriveShots | None", patient: "Rehearsal | None", plan: "PlanFile", *, yes: bool
) -> "tuple[dict[str, Any], tuple[Check, ...]] | str":
    """Return the check shot of the drilled wire and its checks, or why there is none."""
    from sightline.planning.procedures.procedure import ProcedureKey

    if shots is None:
        return (
            "no check shot shows where the wire lies; give --case, the case with this plan, and two images at the end"
        )
    if patient is not None:
        return shots.check_rehearsed(patient, ProcedureKey.of(plan.document.kind or "").wire)
    return "--yes gives no check images; take two, and run `sightline check-shot`" if yes else shots.ask_for_check()


def _connected(
    output: Output, stack: ExitStack, address: str | None, simulator: Simulator, plan: "PlanFile"
) -> "tuple[RobotClient, Simulator, Rehearsal | None]":
    """Return the robot at an address, or one that is simulated until the stack ends, what it holds, and its patient."""
    from sightline.robot.link.client import RobotClient

    if address is not None:
        return stack.enter_context(RobotClient(*parse_address(address))), simulator, None
    with output.step("starting a simulator"):
        patient = simulator.patient(plan.side or "", plan.procedure, simulator.arm)
        theatre = simulator.in_air(plan.side or "", simulator.arm) if patient is None else patient.theatre()
    server = stack.enter_context(theatre.server(virtual=True))
    robot = stack.enter_context(RobotClient(port=server.port))
    return robot, replace(simulator, frame_serial=theatre.setup.frame_serial), patient


def _refuse_contradictions(address: str | None, stood: "RobotFile | None", simulator: Simulator) -> None:
    """Raise UnusableInputError for options of `drive` that exclude each other."""
    from sightline.errors import UnusableInputError

    if address is None and stood is not None:
        raise UnusableInputError("--registration belongs to a robot at an address; give its HOST:PORT")
    if address is not None and simulator.rehearse is not None:
        raise UnusableInputError(
            "--rehearse starts a simulator and takes no address; leave out one of them, and state --frame-serial"
        )
    if stood is not None and simulator.frame_serial is not None:
        raise UnusableInputError("the robot file states the frame's serial; leave out --frame-serial")


def _shot(output: Output, robot: "RobotClient", state: str, shots: "DriveShots | None", *, measurable: bool) -> None:
    """Measure the shot before a step, or say why it is not measured. Stops the robot where the shot says STOP.

    Raises RobotRefusedError.
    """
    from sightline.errors import RobotRefusedError
    from sightline.planning.check.shot import NO_WIRE, TURNED_AWAY
    from sightline.robot import contract

    if contract.HAS_GUIDE in robot.capabilities:
        output.note(f"{state}: {NO_WIRE}")
    elif not measurable:
        output.note(f"{state}: {TURNED_AWAY}")
    elif shots is None:
        output.note(f"{state}: the shot is not measured: give --case, the case with this plan. The decision is yours.")
    else:
        try:
            shots.ask(state)
        except RobotRefusedError:
            robot.stop()
            raise


@dataclass(frozen=True)
class _Step:
    """A motion: the question that a person must answer first, the call that starts it, and the robot's state at the
    shot before it, if there is one. `drills_on`: the wire is in the bone before it."""

    name: str
    question: str
    start: Callable[[], object]
    state_before: str = ""
    drills_on: bool = False


def _steps(robot: "RobotClient", target: "RobotTarget", *, block: bool, put_back: bool) -> list[_Step]:
    """Return each motion. `block`: the robot held one at the images, which a person takes off first; `put_back`: and
    puts back for each shot."""
    from sightline.planning.check.shot import ALIGNED, PAUSED
    from sightline.robot import contract

    def again() -> None:
        robot.retract()
        _tell(robot, target, time.time())

    again_off = "Is the block off again? " if put_back else ""
    off = _Step("block off", "Take the block off the robot: the arm must not turn with it. Is it off?", lambda: None)
    straight = _Step(
        "go to the target",
        "This robot knows only the convention of 2013: it moves the wire straight to the end point, without a dry run. "
        "Is the way clear, and is the plan right in both images?",
        robot.align,
    )
    dry = (
        _Step(
            "dry run", "Dry run: take the wire out. The arm moves to the plan in air. Is the way clear?", robot.align
        ),
        _Step("draw back", "Did the arm reach the planned position? It will draw back; then put the wire in.", again),
    )
    drilling = (
        _Step(
            "align",
            "The wire draws back, the arm turns, the wire stops 20 mm before the bone. Is the way clear?",
            robot.align,
        ),
        _Step(
            "drill",
            f"{again_off}Does the sleeve stand on the bone, and does the confirmation shot show the guide on the plan? "
            "The robot will drill.",
            robot.drill,
            ALIGNED,
        ),
        _Step(
            "drill on",
            f"{again_off}Does the second shot, 10 mm short of the tip, show the wire on the plan?",
            robot.drill,
            PAUSED,
            drills_on=True,
        ),
    )
    first = [off] if block else []
    if contract.HAS_GUIDE in robot.capabilities:
        return [*first, *_guiding_steps(robot, target, again_off)]
    if contract.HAS_DRILLING not in robot.capabilities:
        return [*first, straight]
    return [*first, *(() if robot.simulated else dry), *drilling]


def _guiding_steps(robot: "RobotClient", target: "RobotTarget", again_off: str) -> list[_Step]:
    """Return each step with an arm that holds the guide while a person drills through it."""
    from sightline.planning.check.shot import ALIGNED
    from sightline.robot.kinematics.target import READ_DEPTH_SD_MM

    guide_mm, watch = target.registration.robot.manipulator.guide_mm, GuideWatch()
    robot.listeners.append(watch.heard)
    return [
        _Step(
            "align",
            f"The arm goes to the line without a wire, then straight along it, and stops {target.standoff_mm:.0f} mm "
            "before the bone. Is the way clear?",
            robot.align,
        ),
        _Step(
            "hold the guide",
            f"{again_off}Does the confirmation shot show the guide on the plan? The robot will hold it; then push the "
            "inner sleeve to the bone and drill by hand.",
            robot.guide,
            ALIGNED,
        ),
        _Step(
            "drilled by hand",
            f"Drill until {target.pushed_mm:.1f} mm of the wire have left the guide's mouth: until its free length "
            f"behind the guide is its whole length less {target.pushed_mm + guide_mm:.1f} mm. A length that is read "
            f"adds {2 * READ_DEPTH_SD_MM:.1f} mm to the depth's error (95 %). Is it drilled?",
            lambda: watch.ended(robot, target),
            drills_on=True,
        ),
        _Step(
            "draw the guide back",
            "Is the drill off the wire? The guide draws back along it, 60 mm.",
            robot.retract,
            drills_on=True,
        ),
    ]


class GuideWatch:
    """Says when the guide that a robot holds is off the plan, and remembers by how much at most: mm, rad."""

    def __init__(self) -> None:
        self.largest = (0.0, 0.0)
        self._told = False

    def heard(self, message: "Message") -> None:
        """Take a message of the robot."""
        from sightline.robot import contract
        from sightline.robot.igtl import Sensor

        if message.device_name != contract.GUIDE_OFF or not isinstance(message.body, Sensor):
            return
        off_mm, off_rad = (float(value) for value in message.body.values)
        self.largest = (max(self.largest[0], off_mm), max(self.largest[1], off_rad))
        beyond = off_mm > GUIDE_TOLD_MM or off_rad > GUIDE_TOLD_RAD
        if beyond and not self._told:
            _answer(f"the guide is {_off(off_mm, off_rad)} from the plan: press less against it")
        self._told = beyond

    def ended(self, robot: "RobotClient", target: "RobotTarget") -> None:
        """Wait for the hand of a simulated person, and say how far the guide was off while the wire was drilled."""
        from sightline.rehearsal.operation import await_hand

        if robot.simulated:
            await_hand(robot, target)
        _answer(f"the guide was at most {_off(*self.largest)} from the plan")


def _off(mm: float, rad: float) -> str:
    return f"{mm:.2f} mm and {math.degrees(rad):.2f}°"


def _send(robot: "RobotClient", plan: "PlanFile", name: str, simulator: Simulator) -> "RobotTarget":
    """Register a simulator by its encoders at the images, and send it the plan.

    Raises RobotRefusedError for a real robot, whose position at the images the plan does not hold, and for a plan made
    with another block.
    """
    from sightline.errors import RobotRefusedError
    from sightline.frame import Frame
    from sightline.rehearsal.rehearsal import robot_at
    from sightline.robot.kinematics.target import PoseAtImage, register

    if not robot.simulated:
        raise RobotRefusedError(
            "give --registration, the robot file of `sightline robot calibrate` and `register`: a plan does not say "
            "where a real robot was at its images"
        )
    held = Frame.load(simulator.frame)
    if plan.of_solid and plan.frame != held.fingerprint:
        raise RobotRefusedError(
            f"the plan was made with the block {plan.frame}, the simulated robot holds {held.fingerprint}; name the "
            "plan's block with --frame"
        )
    now = time.time()
    robot.start_up()
    q = robot.simulated_wire().imaged  # where it stood at the images, not where an earlier drive left it
    poses = {view: PoseAtImage(q, now, now) for view in ("pa", "lateral")}
    # A new name each time: a robot refuses a plan that it has drilled.
    stood = register(robot_at(plan.procedure, plan.side or "", held, simulator.arm), poses)
    target = _target(plan, f"{name}-{now:.0f}", simulator.frame_serial or SERIAL, stood)
    _tell(robot, target, now)
    return target


def _send_registered(robot: "RobotClient", plan: "PlanFile", name: str, stood: "RobotFile") -> "RobotTarget":
    """Send the plan to a robot registered by its file. Raises RobotRefusedError where they do not belong together."""
    registration = registration_for(plan, stood)
    target = _target(plan, name, stood.frame_serial, registration)
    target.refuse_unfit(time.time())
    robot.start_up()
    _tell(robot, target, time.time())
    return target


def _target(plan: "PlanFile", name: str, frame_serial: str, registration: "Registration") -> "RobotTarget":
    from sightline.robot.kinematics.target import PlanIdentity, robot_target

    budget = None if plan.covariance_mm2 is None else {"planning": plan.covariance_mm2}
    identity = PlanIdentity(name, plan.side or "", frame_serial, plan.go, plan.document.kind or "", plan.frame)
    return robot_target(identity, plan.points_mm, budget, registration, plan.limits)


def _tell(robot: "RobotClient", target: "RobotTarget", now_s: float) -> None:
    from sightline.robot.control.insertion import DEPTH_SLACK_MM

    robot.calibrate(target.registration.T_mcs_cfcs, target.registration.imaged_s)
    robot.aim_plan(target, now_s, target.depth_mm + DEPTH_SLACK_MM)


def _show(output: Output, target: "RobotTarget", robot: "RobotClient") -> None:
    from sightline.robot import contract

    entry, end, serial = target.entry_mm, target.end_mm, target.identity.frame_serial
    rows = [(name, *(f"{v:.1f}" for v in xyz)) for name, xyz in (("entry", entry), ("end", end))]
    kind = "simulated robot" if robot.simulated else "REAL ROBOT"
    output.table(f"Wire of {target.length_mm:.1f} mm for a {kind}, MCS, mm", ("point", "x", "y", "z"), rows)
    output.say(
        f"95 % errors: entry {target.entry_error_95_mm:.2f} mm, tip {target.end_error_95_mm:.2f} mm; side "
        f"{target.identity.side}, frame {'without a serial' if serial == contract.NO_SERIAL else serial}"
    )
    if robot.open_hole_mm is not None:
        output.say(
            f"this hole was drilled to {robot.open_hole_mm:.1f} mm before: the robot drills on there, and stops "
            "if it meets bone before"
        )


def planned_in(folder: Path, plan: "PlanFile") -> int:
    """Return the number of a plan's entry in the case of a folder. Raises CaseError, RobotRefusedError."""
    from sightline.case.journal import Case, Kind
    from sightline.errors import RobotRefusedError

    points = plan.points_mm.tolist()
    with Case.open(folder, read_only=True) as case:
        for entry in reversed(case.entries(Kind.PLANNED)):
            path = entry.content["trajectory"]
            if entry.content.get("kind") == plan.document.kind and [path["entry_mm"], path["end_mm"]] == points:
                return entry.number
    raise RobotRefusedError(
        "the case does not hold this plan, so that no shot can be compared with it; plan with --case and --out together"
    )


@dataclass(frozen=True, eq=False)
class DriveShots:
    """The shots of one drilling, against the plan of the entry `planned` in the case of `folder`.

    `on_patient`: the frame fixed to the patient; None for the plan's own
    block, put back on its mount. `taken`: the results by the robot's state.
    """

    output: "Output"
    folder: Path
    planned: int
    robot: "RobotClient"
    target: "RobotTarget"
    on_patient: "Frame | None" = None
    taken: "dict[str, DrillShot]" = field(default_factory=dict)

    def ask(self, state: str) -> None:
        """Measure the shot that a person gives while the robot waits in a state, until it says GO or none is given.

        A depth that says GO in PAUSED is sent to the robot. Raises RobotRefusedError for a shot that says STOP.
        """
        from sightline.errors import RobotRefusedError, SightlineError
        from sightline.planning.check.shot import PAUSED

        with_it = "put the block on its mount" if self.on_patient is None else "leave the frame on the patient"
        while True:
            given = _prompted(f"Shot at {state}: {with_it}, take two images", "with nothing you decide by eye")
            if not given:
                _answer(f"{state}: no shot was given; the decision is yours")
                return
            try:
                shot = self._measure(state, given)
            except SightlineError as refused:
                _answer(f"{state}: not measured: {refused}")
                continue
            self.taken[state] = shot
            _say(self.output, shot)
            if shot.decision == "STOP":
                raise RobotRefusedError(f"the shot at {state} says STOP: {_reasons(shot)}")
            if shot.decision == "GO":
                if state == PAUSED:
                    self.robot.shot_depth(shot.depth_mm, shot.depth_sd_mm)
                    _answer("the depth was sent to the robot")
                return

    def ask_for_check(self) -> "tuple[dict[str, Any], tuple[Check, ...]] | str":
        """Measure the check shot that a person gives, its document and checks; or return that none was given."""
        from sightline.errors import SightlineError

        while True:
            try:
                given = _prompted(
                    "Check shot: take two images of the plan's views with its frame in them",
                    "with nothing the wire is not verified",
                )
            except typer.Abort:
                _answer("")  # the input ended: go to the next line
                given = ""
            if not given:
                return "no check images were given; take two, and run `sightline check-shot`"
            try:
                paths, picks = _read(given)
                return self._check(paths, picks)
            except SightlineError as refused:
                _answer(f"check shot: not measured: {refused}")

    def check_rehearsed(self, patient: "Rehearsal", wire: str) -> "tuple[dict[str, Any], tuple[Check, ...]] | str":
        """Measure the check shot whose images the twin takes, with the landmarks as a person picks them.

        `wire`: its key, "" for the first. Return its document and checks, or why it was refused.
        """
        from sightline.case.picks import Landmark, Picks
        from sightline.case.views import CHECK_NAMES, NAMES
        from sightline.common.atomic import scratch_folder
        from sightline.errors import RefusedError
        from sightline.imaging import write_dicom
        from sightline.rehearsal.patient import MAX_TAKES

        true, why, sd_px = self.robot.simulated_wire(), "", Picks().pick_sd_px
        marks = patient.landmarks.values()
        for retake in range(MAX_TAKES):
            rng = patient.generator("picks", retake + 1)
            with self.output.step("taking two check images"):
                taken = patient.check_images(true, wire, retake=retake)
            again = taken.landmarks_px(tuple(patient.landmarks), sd_px, rng).swapaxes(0, 1)
            pixels = [map(tuple, [*before.tolist(), *then.tolist()]) for before, then in zip(marks, again, strict=True)]
            found = [Landmark.model_validate(dict(zip((*NAMES, *CHECK_NAMES), uv, strict=True))) for uv in pixels]
            with scratch_folder() as folder:
                files = [write_dicom(taken.images[name], folder / f"{name}.dcm") for name in NAMES]
                try:
                    return self._check(tuple(files), Picks(landmarks=tuple(found)))
                except RefusedError as refused:
                    why = str(refused)
                    self.output.note(f"check shot: not measured: {refused}")
        return f"the check shot was refused: {why}"

    def record_drilled(self, record: "DrillingRecord") -> None:
        """Record in the case what was drilled, if the wire has met the bone."""
        from sightline.case.journal import Actor, Case, Kind
        from sightline.errors import CaseError

        if not record.events and not (record.depth_mm > 0).any():
            return
        try:
            with Case.open(self.folder) as case:
                case.record(Kind.DRILLED, {"record": record.document()}, by=Actor.ROBOT, rests_on=[self.planned])
        except CaseError as error:  # what the robot says, and where the wire lies, matters more
            _answer(f"the drilling was not recorded: {error}")

    def document(self) -> dict[str, Any]:
        """Return the shots as JSON types, by state."""
        return {state: shot.document() for state, shot in self.taken.items()}

    def _measure(self, state: str, given: str) -> "DrillShot":
        """Read, calibrate and measure two images, and record them with the result. Raises SightlineError."""
        from sightline.case.journal import Case
        from sightline.case.replay import Recomputed
        from sightline.case.stages import record_shot

        paths, picks = _read(given)
        with Case.open(self.folder) as case:
            of = case, Recomputed(case), case.entry(self.planned)
            request = self._request(state, of[1], of[2], picks)
            return measure_shot(self.output, of, request, self._new(of, paths, self.on_patient), record_shot)[0]

    def _check(self, paths: tuple[Path, ...] | None, picks: "Picks") -> "tuple[dict[str, Any], tuple[Check, ...]]":
        """Measure, record and print a check shot. Raises SightlineError."""
        from sightline.case.journal import Case
        from sightline.case.replay import Recomputed

        with Case.open(self.folder) as case:
            of = case, Recomputed(case), case.entry(self.planned)
            return measure_check(self.output, of, picks, self._new(of, paths))

    def _new(
        self,
        of: "tuple[Case, Recomputed, Entry]",
        paths: tuple[Path, ...] | None,
        frame: "Frame | None" = None,
    ) -> NewImages:
        """Return two more images of the plan's views, displayed as those of the plan; `frame`: by default the plan's.

        Without files they are the newest, taken after all shots and motions so far.
        """
        from sightline.case.journal import Kind
        from sightline.case.stages import frame_of

        case, again, plan = of
        before = again.images(plan)[:2]
        arm = before[0].view.c_arm
        known = {} if arm is None else {"source_detector_mm": arm.source_detector_mm, "pixel_mm": arm.pixel_mm}
        mirrored = [image.name for image in before if image.view.mirrored_display]
        shown = frame or frame_of(case, case.entry(plan.rests_on[0]).settings["frame"])
        since = [entry.number for kind in (Kind.SHOT, Kind.DRILLED) for entry in case.entries(kind, plan.number)]
        return NewImages(paths, shown, mirrored, known, max([plan.number, *since]))

    def _request(self, state: str, again: "Recomputed", plan: "Entry", picks: "Picks") -> "DrillShotRequest":
        """Return the request with what a person picked, and with what the robot's encoders say.

        Raises UnusableInputError.
        """
        from sightline.case.contents import CheckRequest, DrillShotRequest
        from sightline.errors import UnusableInputError
        from sightline.planning.check.shot import ALIGNED

        stood, straight = self.target.registration, state == ALIGNED
        if straight and picks.wire_points is None:
            raise UnusableInputError(
                "in its guide the wire is not found by itself: give points on it in both images, wire_points of the "
                "file of picks"
            )
        check = CheckRequest(again.plan(plan).kind.wire_mm, landmarks_of(picks, plan))
        picked = picks.wire_uv_px
        q = self.robot.joints()[0]
        tip_mm = self.target.depth_at(q)
        if self.on_patient is not None:
            return DrillShotRequest(check, tip_mm, straight, None, None, picked)
        middle_mm = again.plan(plan).trajectory.points.xyz_mm.mean(axis=0)
        movement, covariance = stood.robot.frame_moved(stood.q, q, middle_mm)
        return DrillShotRequest(check, tip_mm, straight, movement.as_matrix(), covariance, picked)


def _prompted(request: str, without: str) -> str:
    """Return what a person answers to the request for two images."""
    text = (
        f"{request}, and give both files and one of picks, 'PA LATERAL PICKS', or '{FROM_CASE} PICKS' for the newest "
        f"images of the case; {without}"
    )
    return str(typer.prompt(text, default="", show_default=False, err=True)).strip()


def _read(given: str) -> "tuple[tuple[Path, ...] | None, Picks]":
    """Return the files of two images in an answer, None for those of the case, and what was picked in them.

    Raises UnusableInputError.
    """
    from sightline.case.picks import Picks
    from sightline.errors import UnusableInputError

    try:
        files = shlex.split(given)
    except ValueError as error:
        raise UnusableInputError(f"a quotation mark is left open ({error}); give the files again") from error
    images, rest = ([], files[1:]) if files[0] == FROM_CASE else (files[:2], files[2:])
    if len(images) == 1 or len(rest) > 1:
        raise UnusableInputError(
            f"give the files of two images, PA first, or '{FROM_CASE}', and at most one file of picks"
        )
    return tuple(map(Path, images)) or None, Picks.read(Path(rest[0])) if rest else Picks()


def _answer(text: str) -> None:
    """Print what a person needs to go on, also with --json."""
    typer.echo(text, err=True)


def _reasons(shot: "DrillShot") -> str:
    return " ".join(check.sentence for check in failed(shot.verdict.checks))


def _say(output: "Output", shot: "DrillShot") -> None:
    """Print a shot for people: its decision, what failed, and what was measured."""
    shown = shot.document()
    off, error = shown["deviation"], shown["error_95"]
    _answer(f"{shot.state}: {shot.decision}{'' if shot.decision == 'GO' else f': {_reasons(shot)}'}")
    rows = [
        ("axis at the entry", f"{off['entry_mm']:.2f} mm", f"{error['entry_mm']:.2f} mm"),
        (
            "axis at the end, drilled on straight",
            f"{shown['end_deviation_mm']:.2f} mm",
            f"{shown['end_error_95_mm']:.2f} mm",
        ),
        ("direction", f"{off['direction_deg']:.2f}°", f"{error['direction_deg']:.2f}°"),
    ]
    output.table("Wire against the plan", ("of", "deviation", "95 % error"), rows)
    output.say(f"the tip is {shot.depth_mm:.2f} mm beyond the planned entry (s.d. {shot.depth_sd_mm:.2f} mm)")
