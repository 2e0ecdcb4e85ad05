"""`sightline robot serve | check | calibrate | register | reset`: a simulated robot, an arm, or one at an address."""

import math
import os
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sightline.cli.base import Arm, FrameName, Output, Rehearsed, Side, Twin, as_json, command, group, parse_address

if TYPE_CHECKING:
    import numpy as np

    from sightline.case.interop.plan_file import PlanFile
    from sightline.rehearsal.operation import SimulatedTheatre
    from sightline.rehearsal.rehearsal import Rehearsal
    from sightline.robot.control.insertion import Setup
    from sightline.robot.control.machine import Machine
    from sightline.robot.kinematics.measured import FlangePose, RobotFile
    from sightline.robot.kinematics.target import Registration
    from sightline.robot.link.server import RobotServer
    from sightline.robot.ros2_values import Value

app = group("robot", "Simulate, check, calibrate or drive a robot.")

SERIAL = "simulated"
_SAMPLE_SEED = 1  # any one: the page shows its values
_DRY_RUN = (
    "The wire draws back and the arm aligns in air; a faulty robot may drill on. Is the wire out, is nobody near, and "
    "is the way clear?"
)
Address = Annotated[str, typer.Argument(metavar="HOST:PORT", help="Address of the robot.")]
Yes = Annotated[bool, typer.Option("--yes", help="Answer yes to every question; simulators only.")]
Controlled = Literal["sim", "franka", "ros2"]


@dataclass(frozen=True)
class Held:
    """What a simulated robot holds, and the patient beside it."""

    frame_serial: Annotated[
        str | None,
        typer.Option(help=f"Serial of the frame on the flange; by default {SERIAL!r}.", show_default=False),
    ] = None
    rehearse: Annotated[
        int | None,
        typer.Option(min=0, help="Rehearse on the patient of this seed, whose images `sightline demo` writes."),
    ] = None
    frame: FrameName = "gamma"

    def theatre(self, side: str, procedure: str, arm: Twin) -> "SimulatedTheatre":
        """Return a robot in air, or at the rehearsed patient. Raises UnusableInputError, SetUpError."""
        patient = self.patient(side, procedure, arm)
        return self.in_air(side, arm) if patient is None else patient.theatre()

    def in_air(self, side: str, arm: Twin) -> "SimulatedTheatre":
        """Return a robot without a patient. Raises SetUpError."""
        from sightline.frame import Frame
        from sightline.rehearsal.operation import SimulatedTheatre

        return SimulatedTheatre.in_air(side, self.frame_serial or SERIAL, Frame.load(self.frame), arm)

    def patient(self, side: str, procedure: str, arm: Twin) -> "Rehearsal | None":
        """Return the patient of a procedure's rehearsal; of a file of the user's, a hip screw's. None without one.

        Raises UnusableInputError, SetUpError.
        """
        from sightline.errors import UnusableInputError
        from sightline.frame import Frame

        if self.rehearse is None:
            return None
        if self.frame_serial is not None:
            raise UnusableInputError("--rehearse uses the serial of its own frame; leave out --frame-serial")
        from sightline.rehearsal.patient import AT_HIP, BONE_OF, NAILED
        from sightline.rehearsal.rehearsal import Rehearsal

        if procedure in BONE_OF:
            raise UnusableInputError(
                f"--rehearse simulates no robot for {procedure!r}, of which the plan is: leave it out"
            )
        known = procedure if procedure in (*AT_HIP, NAILED) else "hip-screw"
        return Rehearsal.draw(self.rehearse, Frame.load(self.frame), side, known, arm)


@dataclass(frozen=True)
class Simulator(Held):
    """A simulated robot."""

    arm: Arm = "manipulator"


@dataclass(frozen=True)
class ServedArm:
    """An arm: of a design, or that of a robot file, with a controller of its own."""

    robot_file: Annotated[
        Path | None, typer.Argument(help="Robot file of `sightline robot calibrate`, for --arm sim, franka and ros2.")
    ] = None
    address: Annotated[
        str | None, typer.Argument(metavar="HOST|NAMESPACE", help="Where the arm of --arm franka or ros2 is.")
    ] = None
    arm: Annotated[
        Literal[Twin, Controlled],
        typer.Option(
            help="A simulator (manipulator feeds the wire, six-axis and seven-axis hold the guide while a person "
            "drills), or the arm of a robot file: sim does exactly what it is told; franka, ros2 are real."
        ),
    ] = "manipulator"


@dataclass(frozen=True)
class Listening:
    """Where a robot listens, and to whom."""

    port: Annotated[int, typer.Option(help="Port to listen at; 0 takes a free one.")] = 18936
    host: Annotated[str, typer.Option(help="Address to listen at. Anyone who can reach it can move the robot.")] = (
        "127.0.0.1"
    )
    dialect: Annotated[
        Literal["sightline", "brp2013"],
        typer.Option(help="brp2013: for clients that know only the convention of 2013."),
    ] = "sightline"


@command(
    app,
    "serve",
    "sightline robot serve --rehearse 9 --side right",
    "sightline robot serve robot.json --arm franka 172.16.0.2",
    "sightline robot serve robot.json --arm ros2 /ur5e",
)
def serve(
    output: Output,
    *,
    served: ServedArm,
    listening: Listening,
    held: Held,
    side: Annotated[Side, typer.Option(help="The patient's side.")] = "right",
    procedure: Annotated[
        Rehearsed, typer.Option(help="Procedure of the rehearsed patient: its images show the wires of this one.")
    ] = "hip-screw",
    virtual: Annotated[
        bool, typer.Option("--virtual", help="Run as fast as the machine computes, without regard to heartbeats.")
    ] = False,
    attached: Annotated[
        bool,
        typer.Option(
            "--attached",
            help='For programs: print {"port": N} first; end when standard input ends.',
        ),
    ] = False,
) -> None:
    """Run a simulated robot, or a real arm, until Ctrl-C.

    The simulated wire moves in air, or with --rehearse in a simulated bone. A real arm needs its robot file; a person
    confirms the set-up, and the arm moves when a client of the link commands it.
    """
    from sightline.errors import UnusableInputError
    from sightline.robot.link.outgoing import DIALECTS
    from sightline.robot.link.server import tune_process

    with ExitStack() as stack:
        if served.arm in ("sim", "franka", "ros2"):
            if (side, procedure, virtual, held, listening.dialect) != (
                "right",
                "hip-screw",
                False,
                Held(),
                "sightline",
            ):
                raise UnusableInputError(
                    "the robot's file states side and frame; --procedure, --virtual and --dialect belong to simulators"
                )
            server = _arm_server(stack, served, served.arm, listening)
        elif served.robot_file is not None:
            raise UnusableInputError("a robot file needs --arm sim, franka or ros2")
        else:
            theatre, dialect = held.theatre(side, procedure, served.arm), DIALECTS[listening.dialect]
            server = theatre.server(host=listening.host, port=listening.port, virtual=virtual, dialect=dialect)
        tune_process()
        stack.enter_context(server)
        output.say(f"the robot ({served.arm}) listens at {listening.host}:{server.port}; stop with Ctrl-C")
        if attached:
            typer.echo(as_json({"port": server.port}))
            Thread(target=_close_with_stdin, args=(server,), name="stdin", daemon=True).start()
        try:
            server.wait()
        except KeyboardInterrupt:
            output.note("stopping")
        cycles = server.dialogue.cycles
    output.result({"port": server.port, "cycles": cycles.count, "late": cycles.missed, "worst_s": cycles.worst_s})


def _arm_server(stack: ExitStack, served: ServedArm, arm: Controlled, listening: Listening) -> "RobotServer":
    """Return the server, not yet listening, of an arm with a controller of its own, connected until the stack ends.

    Raises RobotRefusedError, UnusableInputError."""
    import time

    from sightline.errors import UnusableInputError
    from sightline.rehearsal.operation import start_of
    from sightline.robot.arms.connect import connect
    from sightline.robot.arms.streamed import StreamedArm
    from sightline.robot.control.controller import Controller
    from sightline.robot.kinematics.measured import RobotFile
    from sightline.robot.link.server import RobotServer

    if served.robot_file is None or (served.address is None) != (arm == "sim"):
        at = {"sim": "", "franka": " HOST", "ros2": " NAMESPACE"}[arm]
        raise UnusableInputError(f"give the robot's file: sightline robot serve robot.json --arm {arm}{at}")
    known, address = RobotFile.read(served.robot_file), served.address or ""
    known.refuse_old(time.time())
    robot, setup = known.robot(), _confirmed(known, address or "the simulator")
    start = start_of(robot.manipulator, known.side)
    plant = StreamedArm(stack.enter_context(connect(arm, address, robot.manipulator, start)))
    controller = Controller(robot, plant, setup, first_fault=int(time.time()) % 1_000_000 + 1)
    if arm == "ros2":
        from sightline.robot.transport.ros2 import Ros2Broadcast

        poses = partial(published_poses, controller.machine)
        stack.enter_context(Ros2Broadcast(f"{address}/sightline", poses, "sightline_poses"))
    return RobotServer(controller, plant, host=listening.host, port=listening.port)


def published_poses(machine: "Machine") -> "dict[str, Value]":
    """Return what ROS 2 is shown of a served arm, in its base: the pose of the guide's mouth, that of the wire's tip at
    the plan's end, +z along the wire; its state, and the target's plan with its verdict."""
    from sightline.robot.ros2_values import BASE, FramePose, Text

    insertion, manipulator = machine.insertion, machine.robot.manipulator
    tool, state = FramePose.of(BASE, "tool", manipulator.T_mcs_tool(machine.q)), machine.state.value
    if insertion is None:
        return {"tool": tool, "status": Text(state)}
    plan = insertion.identity
    verdict = "no plan" if plan is None else f"plan {plan.plan}: {'GO' if plan.go else 'NO-GO'}"
    target = FramePose.of(BASE, "target", insertion.T_mcs_cfcs * insertion.T_cfcs_wire(manipulator))
    return {"tool": tool, "target": target, "status": Text(f"{state}; {verdict}")}


def _confirmed(known: "RobotFile", where: str) -> "Setup":
    """Return the set-up that a person confirms. Raises RobotRefusedError where it is another."""
    from sightline.errors import RobotRefusedError, UnusableInputError
    from sightline.robot.control.insertion import Setup

    question = (
        f"Robot {known.robot_serial} at {where}: {known.side} side, frame {known.frame_serial} on its flange. Is that "
        "so, is the stop button within reach, and is nobody near?"
    )
    if not typer.confirm(question, err=True):
        raise RobotRefusedError("the set-up is not confirmed, so no arm is served")
    mounted = typer.confirm("Does the frame stay on the flange while the arm moves? A block comes off.", err=True)
    hip_mm = (0.0, 0.0, 0.0)
    if not mounted:
        place = typer.prompt("Where does the hip lie in the frame's coordinates, to 10 mm (x y z, mm)?", err=True)
        try:
            x, y, z = map(float, str(place).split())
        except ValueError:
            x = y = z = math.nan
        if not math.isfinite(x + y + z):
            raise UnusableInputError(f"{place!r} is not a place: give three numbers, as 0 77 -22")
        hip_mm = (x, y, z)
    away = typer.confirm("Is the C-arm drawn back before the arm moves?", err=True)
    return Setup(
        known.side,
        known.frame_serial,
        frame_mounted=mounted,
        into_bone=False,  # a person drills
        frame=known.frame,
        hip_mm=hip_mm,
        c_arm_away=away,
    )


_NOT_ASKED = 5  # exit code where a question could not be asked: neither kept nor violated


@command(app, "check", "sightline robot check 127.0.0.1:18936 --frame-serial SN-7")
def check(
    output: Output,
    *,
    address: Address,
    dry_run: Annotated[bool, typer.Option(help="Also align in air; a person confirms first.")] = True,
    frame_serial: Annotated[
        str, typer.Option(help="Serial of the frame on the flange; with another, plans are not asked about.")
    ] = SERIAL,
    yes: Yes = False,
) -> None:
    """Check that a robot follows docs/robot-link.md.

    First the wire draws back into its sleeve. Exit code 3 if the robot does not follow it; 5 if a question could not be
    asked.
    """
    from sightline.robot.link.conformance.examination import ConformanceVerdict, Examination
    from sightline.robot.link.server import tune_process

    tune_process()
    with Examination(*parse_address(address), frame_serial) as robot:
        moves = dry_run and agreed(robot.simulated, yes, _DRY_RUN)
        if moves:
            with output.step("drawing the wire back"):
                robot.draw_back()
        with output.step("asking the robot"):
            findings = robot.examine()
        with output.step("dry run"):
            findings += robot.dry_run() if moves else robot.leave_out_dry_run()
    rows = [(finding.name, finding.verdict.value, finding.seen) for finding in findings]
    output.table(f"Robot at {address}", ("question", "", "seen"), rows)
    wrong = [finding for finding in findings if finding.verdict is ConformanceVerdict.FAILED]
    unasked = [finding for finding in findings if finding.verdict is ConformanceVerdict.NOT_ASKED]
    if wrong:
        output.note(f"the robot does not follow docs/robot-link.md: {'; '.join(finding.name for finding in wrong)}")
    if unasked:
        output.note(f"{len(unasked)} of {len(findings)} questions were not asked, the first because: {unasked[0].seen}")
    named = ("name", "verdict", "seen")
    conforms = False if wrong else None if unasked else True
    output.result({"conforms": conforms, "findings": [dict(zip(named, row, strict=True)) for row in rows]})
    if conforms is not True:
        raise typer.Exit(3 if wrong else _NOT_ASKED)


@command(
    app,
    "calibrate",
    "sightline robot calibrate measured.json --frame frame.json --out robot.json",
    "sightline robot calibrate --simulated out/arm",
    "sightline robot calibrate --from-images out/arm/images.json --out mount.json",
)
def calibrate(
    output: Output,
    *,
    measurements: Annotated[
        Path | None, typer.Argument(help="JSON of measurements on the robot (docs/real-robot.md).")
    ] = None,
    from_images: Annotated[
        Path | None,
        typer.Option(
            help="Instead: JSON of images of a block on the flange, each with the flange's pose (docs/real-robot.md); "
            "gives the block's mount."
        ),
    ] = None,
    simulated: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Instead: write sample measurements and images to a folder.")
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(
            help="File of the frame on the flange; without it plans that state theirs are refused. With --from-images "
            "the list names it."
        ),
    ] = None,
    out_file: Annotated[
        Path | None, typer.Option("--out", help="File to write: robot.json, or mount.json.", show_default=False)
    ] = None,
) -> None:
    """Calibrate a robot from measurements, or from images.

    From measurements of axes, frame and wire comes the robot file that register and drive need; from images of a block
    on the flange its place there, with its error.
    """
    if sum(given is not None for given in (measurements, from_images, simulated)) != 1:
        raise typer.BadParameter("give a file of measurements, --from-images or --simulated")
    if simulated is not None:
        from sightline.rehearsal.arm_images import write_samples

        with output.step("drawing images"):
            files = write_samples(simulated, _SAMPLE_SEED)
        output.written(files)
        output.result({"files": [str(file) for file in files]})
        return
    if from_images is not None:
        _calibrate_from_images(output, from_images, frame, out_file or Path("mount.json"))
        return
    assert measurements is not None  # noqa: S101 - one of the three is given
    _calibrate_from_measurements(output, measurements, frame, out_file or Path("robot.json"))


def _calibrate_from_measurements(output: Output, measurements: Path, frame: str | None, out_file: Path) -> None:
    from sightline.errors import RobotRefusedError
    from sightline.frame import Frame
    from sightline.robot.kinematics.measured import Measurements, RobotFile, SeenWirePart

    measured, known = Measurements.read(measurements), None if frame is None else Frame.load(frame)
    folder, plan, seen = measurements.parent, None, None
    if isinstance(measured.wire, SeenWirePart):
        plan = read_plan(folder / measured.wire.plan)
        assert plan.covariance_mm2 is not None  # noqa: S101 - read_plan refused
        seen = plan.points_mm, plan.covariance_mm2
    robot, rms = RobotFile.calibrated(measured, folder, seen)
    if known is not None:
        robot = robot.of_frame(known.serial, known.fingerprint)
    if plan is not None and plan.frame != robot.frame:
        raise RobotRefusedError(f"the wire was planned with another frame file than the block's: {plan.frame}")
    robot.write(out_file)
    rows = [(name, f"{rms[name]:.3f}", f"{getattr(measured, name).sd_mm:.3f}") for name in rms]
    output.table("Residuals, mm", ("measured", "rms", "stated, per axis"), rows)
    output.say(f"robot {robot.robot_serial} with frame {robot.frame_serial}: {out_file}")
    output.result({"file": str(out_file), "residual_rms_mm": rms, "robot_serial": robot.robot_serial})


def _calibrate_from_images(output: Output, file: Path, frame: str | None, out_file: Path) -> None:
    import numpy as np

    from sightline.common.atomic import write_whole
    from sightline.common.checks import failed
    from sightline.frame import Frame
    from sightline.from_images.arm import ArmImages, calibrate_on_arm

    listed = ArmImages.read(file)
    block = listed.frame_in(file.parent) if frame is None else Frame.load(frame)
    with output.step("finding beads and adjusting"):
        found = calibrate_on_arm(listed, file.parent, block)
    rows: list[tuple[str, str, str, str]] = []
    for name, off in found.held.deviations().items():
        shift = "far" if off.shift_mm is None else f"{off.shift_mm:.3f}"
        used = "left out: contradicts the others" if name in found.held.bad else "used"
        rows.append((name, shift, f"{np.degrees(off.rotation):.3f}", used))
    rows += [(name, "-", "-", f"left out: {why}") for name, why in found.unseen.items()]
    output.table("Block in each image against all others", ("image", "mm", "°", ""), rows)
    x, y, z = found.mount.pose.translation
    place, rotation = found.error_95
    output.say(f"block {block.key.rstrip('/')} on the flange: ({x:.2f}, {y:.2f}, {z:.2f}) mm")
    output.say(f"its 95 % error: {place:.3f} mm in its middle, {np.degrees(rotation):.3f}°")
    document = found.document(listed, file.parent)
    if not failed(found.held.checks):
        write_whole(out_file, as_json(document).encode())
        output.written([out_file])
    output.result(document, found.held.checks)


@command(
    app,
    "register",
    "sightline robot register robot.json 127.0.0.1:18936 --view pa --image pa.dcm",
    "sightline robot register robot.json --pose pose.json --view pa --image pa.dcm",
    "sightline robot register robot.json --from-images out/wire/plan.json",
)
def register_image(
    output: Output,
    *,
    robot_file: Annotated[Path, typer.Argument(help="Robot file of `sightline robot calibrate`.")],
    address: Annotated[str | None, typer.Argument(metavar="HOST:PORT", help="Address of the robot.")] = None,
    view: Annotated[Literal["pa", "lateral"] | None, typer.Option(help="View of the image.")] = None,
    image: Annotated[
        Path | None, typer.Option(help="File of the image, once it is taken; the plan must be made on it.")
    ] = None,
    pose: Annotated[
        Path | None,
        typer.Option(
            help="Instead of HOST:PORT: JSON of the flange's pose at the image, for an arm calibrated by images at "
            "poses (docs/real-robot.md)."
        ),
    ] = None,
    from_images: Annotated[
        Path | None,
        typer.Option(
            help="plan.json, made on both registered images, from a point of the robot's own wire near the guide "
            "(entry) to its tip (end): compares images with encoders and corrects frame and wire on the flange."
        ),
    ] = None,
) -> None:
    """Record the robot's joints, or its flange's pose, at an image.

    Once for each view; kept in the robot file. Then, if the images show the wire, --from-images.
    """
    if from_images is not None:
        if (address, view, image, pose) != (None, None, None, None):
            raise typer.BadParameter("--from-images takes the robot file alone: both images are registered before it")
        _register_from_images(output, robot_file, from_images)
        return
    if (address is None) == (pose is None) or view is None or image is None:
        raise typer.BadParameter("give HOST:PORT or --pose, with --view and --image, or give --from-images")
    import time

    from sightline.case.journal.originals import anonymous_name
    from sightline.imaging import read_image
    from sightline.robot.kinematics.measured import RobotFile

    known = RobotFile.read(robot_file)
    known.refuse_old(time.time())
    question = (
        f"Take the {view} image now, with the frame {known.frame_serial} on the robot's flange and nowhere else; robot "
        f"{known.robot_serial} must not move. Is the image in {image.name}?"
    )
    at, now = _where_it_is(known, address, pose, question)
    read_image(image, 0)  # raises if it is not an image
    source = anonymous_name(image)
    registered = known.at_image(view, at, now, source)
    registered.write(robot_file)
    q = registered.images[view].q
    output.say(f"joints at the {view} image: {', '.join(f'{joint:.3f}' for joint in q)} (mm, rad)")
    output.result({"file": str(robot_file), "view": view, "joints": q, "read_s": now, "source": source})


def _where_it_is(
    known: "RobotFile", address: str | None, pose: Path | None, question: str
) -> "tuple[np.ndarray | FlangePose, float]":
    """Return the joints of a robot at an address once a person says that the image is taken, or the pose in a file, and
    its time. Raises RobotRefusedError, UnusableInputError."""
    import time

    from sightline.errors import RobotRefusedError
    from sightline.robot.kinematics.measured import FlangePose
    from sightline.robot.link.client import RobotClient

    def ask() -> None:
        if not typer.confirm(question, err=True):
            raise RobotRefusedError("no image was taken, so nothing was registered; run the command again")

    if pose is not None:
        stated = FlangePose.read(pose)
        ask()
        return stated, stated.measured_on.timestamp()
    assert address is not None  # noqa: S101 - one of the two is given
    with RobotClient(*parse_address(address), heartbeat=False, streams=False) as robot:
        before = robot.joints()[0]
        ask()
        q, now = robot.joints()[0], time.time()
    known.refuse_moved(before, q)
    return q, now


def _register_from_images(output: Output, robot_file: Path, wire: Path) -> None:
    from sightline.robot.kinematics.measured import RobotFile

    known, seen = RobotFile.read(robot_file), read_plan(wire)
    registration_for(seen, known)
    assert seen.covariance_mm2 is not None  # noqa: S101 - read_plan refused
    corrected = known.with_wire_seen(seen.points_mm, seen.covariance_mm2)
    errors = {
        "encoders": _pose_errors(known.model_copy(update={"wire_seen": None}).registration()),
        "images": _pose_errors(corrected.registration()),
    }
    corrected.write(robot_file)
    rows = [(name, f"{tip:.2f} mm", f"{angle:.2f}°") for name, (tip, angle) in errors.items()]
    output.table("Wire in CFCS at the images, 95 % error", ("by", "tip", "direction"), rows)
    output.say(f"images and encoders agree; the corrected mounts hold for plans on these images: {robot_file}")
    output.result({"file": str(robot_file), "error_95": errors})


def _pose_errors(stood: "Registration") -> tuple[float, float]:
    """Return the 95 % errors of the wire against the frame at the images: tip in mm, direction in degrees."""
    import numpy as np

    from sightline.common.geometry.covariance import length_quantile, line_direction

    tool = stood.robot.manipulator.T_mcs_tool(stood.q)
    wire = tool.apply(np.array([[0.0, 0.0, -100.0], [0.0, 0.0, 0.0]]))
    covariance = sum(stood.robot.wire_against_frame(stood.q, stood.q, wire, stood.stated).values(), np.zeros((6, 6)))
    by_point = line_direction(*wire)
    angle = float(length_quantile(by_point @ covariance @ by_point.T))
    return float(length_quantile(covariance[3:, 3:])), float(np.rad2deg(angle))


@command(app, "stop", "sightline robot stop 127.0.0.1:18936")
def stop(output: Output, address: Address) -> None:
    """Stop a robot, whoever commands it.

    Works also where other programs hold all of its places. It is not an emergency stop: use the red button where it
    matters.
    """
    from sightline.robot.link.exchange import stop_robot

    ended = stop_robot(*parse_address(address)).refuse_unless_ok()
    output.say(f"the robot confirms the stop: {ended.text or 'no text'}")
    output.result({"text": ended.text})


@command(app, "reset", "sightline robot reset 127.0.0.1:18936")
def reset(output: Output, address: Address) -> None:
    """Reset a robot after a fault.

    Shows the fault and asks a person to confirm before it is reset.
    """
    from sightline.errors import RobotRefusedError
    from sightline.robot.link.client import RobotClient

    with RobotClient(*parse_address(address), heartbeat=False, streams=False) as robot:
        status = robot.status()
        if not status.subcode:
            raise RobotRefusedError(f"there is no fault to reset; state of the robot: {status.error_name}")
        typer.echo(f"{status.text}", err=True)
        typer.confirm("Have you removed the cause at the robot?", abort=True, err=True)
        robot.reset(status.subcode)
        output.say(f"fault {status.subcode} is reset; state of the robot: {robot.status().error_name}")
    output.result({"fault": status.subcode, "text": status.text})


def read_plan(file: Path, wire: str | None = None) -> "PlanFile":
    """Return a plan that may be sent to a robot; of several wires that of one.

    Raises UnusableInputError, RobotRefusedError.
    """
    from sightline.case.interop.plan_file import PlanFile

    plan = PlanFile.read(file, wire)
    plan.refuse_for_robot()
    return plan


def _close_with_stdin(server: "RobotServer") -> None:
    """Close the server when standard input ends.

    Reads the file descriptor: a thread that waits in a Python file object would keep the process from ending.
    """
    while os.read(0, 1024):
        pass
    server.close()


def registration_for(plan: "PlanFile", stood: "RobotFile") -> "Registration":
    """Return the robot's registration for a plan. Raises RobotRefusedError for another side, frame or images."""
    import time

    frame = plan.document.frame
    stood.refuse_other(plan.side, None if frame is None else frame.serial, plan.frame, time.time())
    registration = stood.registration()
    stood.refuse_other_images(plan.images)
    return registration


def refuse_yes(simulated: bool, yes: bool) -> None:
    """Raise RobotRefusedError for --yes at a real robot."""
    from sightline.errors import RobotRefusedError

    if yes and not simulated:
        raise RobotRefusedError("--yes works with simulators only; a person must confirm each motion of a real robot")


def agreed(simulated: bool, yes: bool, question: str) -> bool:
    """Return whether a person answers yes, which --yes does at a simulator. Raises RobotRefusedError."""
    refuse_yes(simulated, yes)
    return yes or typer.confirm(question, err=True)
