"""`sightline robot serve | check | calibrate | register | drive | reset`: a simulated robot, or one at an address."""

import os
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sightline.cli.output import Json, Output, Quiet, as_json, example

if TYPE_CHECKING:
    from collections.abc import Callable

    from sightline.case.interop.plan_file import PlanFile
    from sightline.cli.robots.drive_shots import DriveShots
    from sightline.frame import Frame
    from sightline.rehearsal.operation import SimulatedTheatre
    from sightline.robot.kinematics.measured import RobotFile
    from sightline.robot.kinematics.target import Registration, RobotTarget
    from sightline.robot.link.client import RobotClient
    from sightline.robot.link.server import RobotServer

app = typer.Typer(no_args_is_help=True, help="Simulate, check, calibrate or drive a robot.")

SERIAL = "simulated"
Address = Annotated[str, typer.Argument(metavar="HOST:PORT", help="Address of the robot.")]
Side = Annotated[Literal["right", "left"], typer.Option(help="The patient's side.")]
Serial = Annotated[
    str | None, typer.Option(help=f"Serial of the frame on the flange; by default {SERIAL!r}.", show_default=False)
]
Seed = Annotated[
    int | None, typer.Option(min=0, help="Rehearse on the patient of this seed, whose images `sightline demo` writes.")
]
FrameName = Annotated[
    str, typer.Option(help="Frame on the simulated robot: a file, gamma, biplane, stereo or a block.")
]
Rehearsed = Literal["hip-screw", "cannulated-hip-screws", "free-wire", "distal-interlocking"]
AtHip = Annotated[
    Rehearsed,
    typer.Option(help="Procedure of the rehearsed patient: its images show the wires of this one."),
]
Yes = Annotated[bool, typer.Option("--yes", help="Answer yes to every question; simulators only.")]


def register(parent: typer.Typer) -> None:
    """Add the commands."""
    parent.add_typer(app, name="robot")


@app.command("serve", epilog=example("sightline robot serve --rehearse 9 --side right"))
def serve(
    *,
    port: Annotated[int, typer.Option(help="Port to listen at; 0 takes a free one.")] = 18936,
    host: Annotated[
        str, typer.Option(help="Address to listen at. Anyone who can reach it can move the robot.")
    ] = "127.0.0.1",
    side: Side = "right",
    frame_serial: Serial = None,
    rehearse: Seed = None,
    frame: FrameName = "gamma",
    procedure: AtHip = "hip-screw",
    dialect: Annotated[
        Literal["sightline", "brp2013"],
        typer.Option(help="brp2013: for clients that know only the convention of 2013."),
    ] = "sightline",
    virtual: Annotated[
        bool, typer.Option("--virtual", help="Run as fast as the machine computes, for clients without heartbeats.")
    ] = False,
    attached: Annotated[
        bool,
        typer.Option(
            "--attached",
            help='For programs: print {"port": N} first; end when standard input ends.',
        ),
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Run a simulated robot until Ctrl-C.

    Its wire moves in air, or with --rehearse in a simulated bone.
    """
    with Output(json=json, quiet=quiet) as out:
        from sightline.robot.link.outgoing import DIALECTS
        from sightline.robot.link.server import tune_process

        theatre = _theatre(side, frame_serial, rehearse, frame, procedure)
        tune_process()
        with theatre.server(host=host, port=port, virtual=virtual, dialect=DIALECTS[dialect]) as server:
            out.say(f"the simulated robot listens at {host}:{server.port}; stop with Ctrl-C")
            if attached:
                typer.echo(as_json({"port": server.port}))
                Thread(target=_close_with_stdin, args=(server,), name="stdin", daemon=True).start()
            try:
                server.wait()
            except KeyboardInterrupt:
                out.note("stopping")
            cycles = server.dialogue.cycles
        out.result({"port": server.port, "cycles": cycles.count, "late": cycles.missed, "worst_s": cycles.worst_s})


@app.command("check", epilog=example("sightline robot check 127.0.0.1:18936"))
def check(
    address: Address,
    *,
    dry_run: Annotated[bool, typer.Option(help="Also align in air, without drilling; a person confirms first.")] = True,
    yes: Yes = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Check that a robot follows docs/robot-link.md.

    Exit code 3 if it does not.
    """
    wrong: list[str] = []
    with Output(json=json, quiet=quiet) as out:
        from sightline.robot.link.conformance.examination import ConformanceVerdict, Examination
        from sightline.robot.link.server import tune_process

        tune_process()
        with Examination(*parse_address(address)) as robot:
            with out.step("asking the robot"):
                findings = robot.examine()
            if dry_run and _agreed(robot.simulated, yes, "The robot will move: it aligns in air. Is it clear?"):
                with out.step("dry run"):
                    findings += robot.dry_run()
        rows = [(finding.name, finding.verdict.value, finding.seen) for finding in findings]
        out.table(f"Robot at {address}", ("question", "", "seen"), rows)
        wrong = [finding.name for finding in findings if finding.verdict is ConformanceVerdict.FAILED]
        if wrong:
            out.note(f"the robot does not follow docs/robot-link.md: {'; '.join(wrong)}")
        named = ("name", "verdict", "seen")
        out.result({"conforms": not wrong, "findings": [dict(zip(named, row, strict=True)) for row in rows]})
    if wrong:
        raise typer.Exit(3)


@app.command("calibrate", epilog=example("sightline robot calibrate measured.json --frame frame.json --out robot.json"))
def calibrate(
    measurements: Annotated[Path, typer.Argument(help="JSON of measurements on the robot (docs/real-robot.md).")],
    *,
    frame: Annotated[
        str | None,
        typer.Option(help="File of the frame on the flange; without it plans that state theirs are refused."),
    ] = None,
    out_file: Annotated[Path, typer.Option("--out", help="Robot file to write.")] = Path("robot.json"),
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate a robot from measurements.

    Axes, frame and wire are measured; the result is the robot file that register and drive need.
    """
    with Output(json=json, quiet=quiet) as out:
        from sightline.frame import Frame
        from sightline.robot.kinematics.measured import Measurements, RobotFile

        said, known = Measurements.read(measurements), None if frame is None else Frame.load(frame)
        robot, rms = RobotFile.calibrated(said)
        if known is not None:
            robot = robot.of_frame(known.serial, known.fingerprint)
        robot.write(out_file)
        sd = {"axes": said.axes.sd_mm, "frame": said.frame.sd_mm, "wire": said.wire.sd_mm}
        rows = [(name, f"{rms[name]:.3f}", f"{sd[name]:.3f}") for name in rms]
        out.table("Residuals, mm", ("measured", "rms", "stated, per axis"), rows)
        out.say(f"robot {robot.robot_serial} with frame {robot.frame_serial}: {out_file}")
        out.result({"file": str(out_file), "residual_rms_mm": rms, "robot_serial": robot.robot_serial})


_REGISTER = (
    "sightline robot register robot.json 127.0.0.1:18936 --view pa --image pa.dcm",
    "sightline robot register robot.json --from-images out/wire/plan.json",
)


@app.command("register", epilog=example(*_REGISTER))
def register_image(
    robot_file: Annotated[Path, typer.Argument(help="Robot file of `sightline robot calibrate`.")],
    address: Annotated[str | None, typer.Argument(metavar="HOST:PORT", help="Address of the robot.")] = None,
    *,
    view: Annotated[Literal["pa", "lateral"] | None, typer.Option(help="View of the image.")] = None,
    image: Annotated[
        Path | None, typer.Option(help="File of the image, once it is taken; the plan must be made on it.")
    ] = None,
    from_images: Annotated[
        Path | None,
        typer.Option(
            help="plan.json, made on both registered images, from a point of the robot's own wire near the guide "
            "(entry) to its tip (end): compares images with encoders and corrects frame and wire on the flange."
        ),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Record the robot's joints at an image.

    Once for each view. The joints are kept in the robot file. Then, if the images show the wire, --from-images.
    """
    if from_images is not None:
        if (address, view, image) != (None, None, None):
            raise typer.BadParameter("--from-images takes the robot file alone: both images are registered before it")
        _register_from_images(robot_file, from_images, json=json, quiet=quiet)
        return
    if address is None or view is None or image is None:
        raise typer.BadParameter("give HOST:PORT, --view and --image, or --from-images")
    with Output(json=json, quiet=quiet) as out:
        import time

        from sightline.case.journal.originals import anonymous_name
        from sightline.errors import RobotRefusedError
        from sightline.imaging import read_image
        from sightline.robot.kinematics.measured import RobotFile
        from sightline.robot.link.client import RobotClient

        known = RobotFile.read(robot_file)
        known.refuse_old(time.time())
        with RobotClient(*parse_address(address), heartbeat=False, streams=False) as robot:
            before = robot.joints()[0]
            question = (
                f"Take the {view} image now, with the frame {known.frame_serial} on the robot's flange and nowhere "
                f"else; robot {known.robot_serial} must not move. Is the image in {image.name}?"
            )
            if not _said_yes(question):
                raise RobotRefusedError("no image was taken, so nothing was registered; run the command again")
            q, now = robot.joints()[0], time.time()
        known.refuse_moved(before, q)
        read_image(image, 0)  # raises if it is not an image
        source = anonymous_name(image)
        known.at_image(view, q, now, source).write(robot_file)
        out.say(f"joints at the {view} image: {', '.join(f'{one:.3f}' for one in q)} (mm, rad)")
        out.result({"file": str(robot_file), "view": view, "joints": q, "read_s": now, "source": source})


def _register_from_images(robot_file: Path, wire: Path, *, json: bool, quiet: bool) -> None:
    with Output(json=json, quiet=quiet) as out:
        from sightline.robot.kinematics.measured import RobotFile

        known, seen = RobotFile.read(robot_file), read_plan(wire)
        _registration_for(seen, known)
        assert seen.covariance_mm2 is not None  # noqa: S101 - read_plan refused
        corrected = known.with_wire_seen(seen.points_mm, seen.covariance_mm2)
        errors = {
            "encoders": _pose_errors(known.model_copy(update={"wire_seen": None}).registration()),
            "images": _pose_errors(corrected.registration()),
        }
        corrected.write(robot_file)
        rows = [(name, f"{tip:.2f} mm", f"{angle:.2f}°") for name, (tip, angle) in errors.items()]
        out.table("Wire in CFCS at the images, 95 % error", ("by", "tip", "direction"), rows)
        out.say(f"images and encoders agree; the corrected mounts hold for plans on these images: {robot_file}")
        out.result({"file": str(robot_file), "error_95": errors})


def _pose_errors(stood: "Registration") -> tuple[float, float]:
    """Return the 95 % errors of the wire against the frame at the images: tip in mm, direction in degrees."""
    import numpy as np

    from sightline.geometry.covariance import length_quantile, line_direction

    tool = stood.robot.manipulator.T_mcs_tool(stood.q)
    wire = tool.apply(np.array([[0.0, 0.0, -100.0], [0.0, 0.0, 0.0]]))
    covariance = sum(stood.robot.wire_against_frame(stood.q, stood.q, wire).values(), np.zeros((6, 6)))
    by_point = line_direction(*wire)
    angle = float(length_quantile(by_point @ covariance @ by_point.T))
    return float(length_quantile(covariance[3:, 3:])), float(np.rad2deg(angle))


@app.command("drive", epilog=example("sightline robot drive out/plan/plan.json --rehearse 9"))
def drive(
    plan: Annotated[Path, typer.Argument(help="plan.json of `sightline plan --out`, or its folder.")],
    address: Annotated[
        str | None, typer.Argument(metavar="HOST:PORT", help="Address of the robot; without it a simulator is started.")
    ] = None,
    *,
    registration: Annotated[
        Path | None, typer.Option(help="Robot file with the joints at both images; a real robot needs it.")
    ] = None,
    wire: Annotated[str | None, typer.Option(help="Key of the wire, in a plan of several.", show_default=False)] = None,
    frame_serial: Serial = None,
    rehearse: Seed = None,
    frame: FrameName = "gamma",
    case: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the case with this plan: with a block or --patient-frame, the shots at the skin and at the "
            "pause are measured against it while the robot waits, and recorded.",
            show_default=False,
        ),
    ] = None,
    patient_frame: Annotated[
        str | None,
        typer.Option(
            help="Frame that is fixed to the patient in these shots: a file, or a built-in frame. The robot must not "
            "hold it; three landmarks found again tell where it is.",
            show_default=False,
        ),
    ] = None,
    pick_sd: Annotated[float, typer.Option(help="Standard deviation of a pick in a shot, px.")] = 0.5,
    yes: Yes = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Drive a planned wire into the bone.

    Align, confirm, drill, pause, confirm, drill. A person confirms each motion. A real robot first makes a dry run
    without the wire. A shot that says STOP ends it.
    """
    with Output(json=json, quiet=quiet) as out, ExitStack() as stack:
        from sightline.cli.robots.drive_shots import DriveShots, planned_in
        from sightline.robot.kinematics.measured import RobotFile
        from sightline.robot.link.client import RobotClient
        from sightline.robot.link.server import tune_process

        tune_process()
        known = read_plan(plan, wire)
        fixed = _frame_on_patient(patient_frame, case)
        block = known.of_solid and fixed is None  # that a person puts back on its mount for the shots
        measured_on = None if case is None or not (block or fixed) else planned_in(case, known)
        stood = None if registration is None else RobotFile.read(registration)
        _refuse_contradictions(address, stood, rehearse, frame_serial)
        if address is None:
            with out.step("starting a simulator"):
                theatre = _theatre(known.side or "", frame_serial, rehearse, frame, known.procedure)
            frame_serial = theatre.setup.frame_serial
            server = stack.enter_context(theatre.server(virtual=True))
            robot = stack.enter_context(RobotClient(port=server.port, heartbeat=False))
        else:
            robot = stack.enter_context(RobotClient(*parse_address(address)))
        _refuse_yes(robot.simulated, yes)
        with out.step("sending the plan"):
            if stood is None:
                target = _send(robot, known, known.identifier(plan.stem), frame_serial or SERIAL, frame)
            else:
                target = _send_registered(robot, known, known.identifier(plan.stem), stood)
        _show(out, target, robot)
        shots = None
        if case is not None and measured_on is not None and not yes:
            shots = DriveShots(out, case, measured_on, robot, target, pick_sd, fixed)
        for name, question, go in _steps(
            robot, target, known_way=robot.simulated, block=known.of_solid, put_back=block
        ):
            if name in _SHOT_BEFORE:
                _shot(out, robot, _SHOT_BEFORE[name], shots, measurable=block or fixed is not None)
            if not _agreed(robot.simulated, yes, question):
                robot.stop()
                out.note(f"stopped before: {name}")
                break
            with out.step(name):
                go()
        state, tip_mm = robot.status().text.split(";")[0], robot.position().translation
        out.say(f"state of the robot: {state}")
        told = {"state": state, "tip_mm": tip_mm, "end_mm": known.points_mm[1]}
        if shots is not None:
            told["shots"] = shots.document()
        if rehearse is not None:
            told["true_wire_mm"] = robot.simulated_wire().axis_mm
        out.result(told)


@app.command("reset", epilog=example("sightline robot reset 127.0.0.1:18936"))
def reset(address: Address, *, json: Json = False, quiet: Quiet = False) -> None:
    """Reset a robot after a fault.

    Shows the fault and asks a person to confirm before it is reset.
    """
    with Output(json=json, quiet=quiet) as out:
        from sightline.errors import RobotRefusedError
        from sightline.robot.link.client import RobotClient

        with RobotClient(*parse_address(address), heartbeat=False, streams=False) as robot:
            status = robot.status()
            if not status.subcode:
                raise RobotRefusedError(f"there is no fault to reset; state of the robot: {status.error_name}")
            typer.echo(f"{status.text}", err=True)
            typer.confirm("Have you removed the cause at the robot?", abort=True, err=True)
            robot.reset(status.subcode)
            out.say(f"fault {status.subcode} is reset; state of the robot: {robot.status().error_name}")
        out.result({"fault": status.subcode, "text": status.text})


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of 'HOST:PORT'. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    host, _, port = text.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise UnusableInputError(f"{text!r} is not an address; write HOST:PORT, for example 127.0.0.1:18936")
    return host, int(port)


def read_plan(file: Path, wire: str | None = None) -> "PlanFile":
    """Return a plan that may be sent to a robot; of several wires that of one.

    Raises UnusableInputError, RobotRefusedError.
    """
    from sightline.case.interop.plan_file import PlanFile

    plan = PlanFile.read(file, wire)
    plan.refuse_for_robot()
    return plan


def _theatre(
    side: str, frame_serial: str | None, rehearse: int | None, frame: str, procedure: str
) -> "SimulatedTheatre":
    """Return a robot in air, or at the patient of a procedure's rehearsal; of a file of the user's, at a hip screw's.

    Raises UnusableInputError, SetUpError.
    """
    from sightline.errors import UnusableInputError
    from sightline.frame import Frame
    from sightline.rehearsal.operation import SimulatedTheatre

    if rehearse is None:
        return SimulatedTheatre.in_air(side, frame_serial or SERIAL, Frame.load(frame))
    if frame_serial is not None:
        raise UnusableInputError("--rehearse uses the serial of its own frame; leave out --frame-serial")
    from sightline.rehearsal.patient import AT_HIP, BONE_OF, NAILED
    from sightline.rehearsal.rehearsal import Rehearsal

    if procedure in BONE_OF:
        raise UnusableInputError(f"--rehearse simulates no robot for {procedure!r}, of which the plan is: leave it out")
    known = procedure if procedure in (*AT_HIP, NAILED) else "hip-screw"
    return Rehearsal.draw(rehearse, Frame.load(frame), side, known).theatre()


def _close_with_stdin(server: "RobotServer") -> None:
    """Close the server when standard input ends.

    Reads the file descriptor: a thread that waits in a Python file object would keep the process from ending.
    """
    while os.read(0, 1024):
        pass
    server.close()


def _refuse_contradictions(
    address: str | None, stood: "RobotFile | None", rehearse: int | None, frame_serial: str | None
) -> None:
    """Raise UnusableInputError for options of `drive` that exclude each other."""
    from sightline.errors import UnusableInputError

    if address is None and stood is not None:
        raise UnusableInputError("--registration belongs to a robot at an address; give its HOST:PORT")
    if address is not None and rehearse is not None:
        raise UnusableInputError(
            "--rehearse starts a simulator and takes no address; leave out one of them, and state --frame-serial"
        )
    if stood is not None and frame_serial is not None:
        raise UnusableInputError("the robot file states the frame's serial; leave out --frame-serial")


def _frame_on_patient(frame: str | None, case: Path | None) -> "Frame | None":
    """Return the frame of `--patient-frame`. Raises FrameError, and UnusableInputError where no shot is measured."""
    from sightline.errors import UnusableInputError
    from sightline.frame import Frame

    if frame is not None and case is None:
        raise UnusableInputError("--patient-frame serves the shots that are measured: give --case too")
    return None if frame is None else Frame.load(frame)


_SHOT_BEFORE = {"drill": "ALIGNED", "drill on": "PAUSED"}  # the robot's state at the shot before a step


def _shot(out: Output, robot: "RobotClient", state: str, shots: "DriveShots | None", *, measurable: bool) -> None:
    """Measure the shot before a step, or say why it is not measured. Stops the robot where the shot says STOP.

    Raises RobotRefusedError.
    """
    from sightline.errors import RobotRefusedError
    from sightline.planning.check.drill_shot import TURNED_AWAY

    if not measurable:
        out.note(f"{state}: {TURNED_AWAY}")
    elif shots is None:
        out.note(f"{state}: the shot is not measured: give --case, the case with this plan. The decision is yours.")
    else:
        try:
            shots.ask(state)
        except RobotRefusedError:
            robot.stop()
            raise


_Step = tuple[str, str, "Callable[[], object]"]


def _steps(
    robot: "RobotClient", target: "RobotTarget", *, known_way: bool, block: bool, put_back: bool
) -> "list[_Step]":
    """Return each motion: its name, the question a person must answer first, and the call that starts it.

    `block`: the robot held one at the images, which a person takes off first; `put_back`: and puts back for each shot.
    """
    import time

    from sightline.robot import contract

    def again() -> None:
        robot.retract()
        _tell(robot, target, time.time())

    again_off = "Is the block off again? " if put_back else ""
    off: list[_Step] = [
        ("block off", "Take the block off the robot: the arm must not turn with it. Is it off?", lambda: None)
    ]
    if contract.HAS_DRILLING not in robot.capabilities:
        return [
            *(off if block else []),
            (
                "go to the target",
                "This robot knows only the convention of 2013: it moves the wire straight to the end point, without "
                "a dry run. Is the way clear, and is the plan right in both images?",
                robot.align,
            ),
        ]
    dry: list[_Step] = [
        (
            "dry run",
            "Dry run: take the wire out. The arm moves to the plan in air. Is the way clear?",
            robot.align,
        ),
        ("draw back", "Did the arm reach the planned position? It will draw back; then put the wire in.", again),
    ]
    return [
        *(off if block else []),
        *([] if known_way else dry),
        (
            "align",
            "The wire draws back, the arm turns, the wire stops 20 mm before the bone. Is the way clear?",
            robot.align,
        ),
        (
            "drill",
            f"{again_off}Does the sleeve stand on the bone, and does the confirmation shot show the guide on the plan? "
            "The robot will drill.",
            robot.drill,
        ),
        (
            "drill on",
            f"{again_off}Does the second shot, 10 mm short of the tip, show the wire on the plan?",
            robot.drill,
        ),
    ]


def _send(robot: "RobotClient", plan: "PlanFile", name: str, frame_serial: str, frame: str) -> "RobotTarget":
    """Register a simulator that holds a frame by its encoders at the images, and send it the plan.

    Raises RobotRefusedError for a real robot, whose position at the images the plan does not hold, and for a plan made
    with another block.
    """
    import time

    from sightline.errors import RobotRefusedError
    from sightline.frame import Frame
    from sightline.rehearsal.rehearsal import robot_at
    from sightline.robot.kinematics.target import PoseAtImage, register

    if not robot.simulated:
        raise RobotRefusedError(
            "give --registration, the robot file of `sightline robot calibrate` and `register`: a plan does not say "
            "where a real robot was at its images"
        )
    held = Frame.load(frame)
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
    stood = register(robot_at(plan.procedure, plan.side or "", held), poses)
    target = _target(plan, f"{name}-{now:.0f}", frame_serial, stood)
    _tell(robot, target, now)
    return target


def _send_registered(robot: "RobotClient", plan: "PlanFile", name: str, stood: "RobotFile") -> "RobotTarget":
    """Send the plan to a robot registered by its file. Raises RobotRefusedError where they do not belong together."""
    import time

    registration = _registration_for(plan, stood)
    target = _target(plan, name, stood.frame_serial, registration)
    target.refuse_unfit(time.time())
    robot.start_up()
    _tell(robot, target, time.time())
    return target


def _registration_for(plan: "PlanFile", stood: "RobotFile") -> "Registration":
    """Return the robot's registration for a plan. Raises RobotRefusedError for another side, frame or images."""
    import time

    frame = plan.document.frame
    stood.refuse_other(plan.side, None if frame is None else frame.serial, plan.frame, time.time())
    registration = stood.registration()
    stood.refuse_other_images(plan.images)
    return registration


def _target(plan: "PlanFile", name: str, frame_serial: str, registration: "Registration") -> "RobotTarget":
    from sightline.robot.kinematics.target import PlanIdentity, robot_target

    budget = None if plan.covariance_mm2 is None else {"planning": plan.covariance_mm2}
    identity = PlanIdentity(name, plan.side or "", frame_serial, plan.go, plan.document.kind or "", plan.frame)
    return robot_target(identity, plan.points_mm, budget, registration, plan.limits)


def _tell(robot: "RobotClient", target: "RobotTarget", now_s: float) -> None:
    from sightline.robot.control.insertion import DEPTH_SLACK_MM

    robot.calibrate(target.registration.T_mcs_cfcs, target.registration.imaged_s)
    robot.aim_plan(target, now_s, target.depth_mm + DEPTH_SLACK_MM)


def _show(out: Output, target: "RobotTarget", robot: "RobotClient") -> None:
    entry, end = target.entry_mm, target.end_mm
    rows = [(name, *(f"{v:.1f}" for v in xyz)) for name, xyz in (("entry", entry), ("end", end))]
    kind = "simulated robot" if robot.simulated else "REAL ROBOT"
    out.table(f"Wire of {target.length_mm:.1f} mm for a {kind}, MCS, mm", ("point", "x", "y", "z"), rows)
    out.say(
        f"95 % errors: entry {target.entry_error_95_mm:.2f} mm, tip {target.end_error_95_mm:.2f} mm; side "
        f"{target.identity.side}, frame {target.identity.frame_serial}"
    )


def _refuse_yes(simulated: bool, yes: bool) -> None:
    from sightline.errors import RobotRefusedError

    if yes and not simulated:
        raise RobotRefusedError("--yes works with simulators only; a person must confirm each motion of a real robot")


def _agreed(simulated: bool, yes: bool, question: str) -> bool:
    _refuse_yes(simulated, yes)
    return yes or _said_yes(question)


def _said_yes(question: str) -> bool:
    return typer.confirm(question, err=True)
