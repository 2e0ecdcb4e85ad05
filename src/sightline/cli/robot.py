"""`sightline robot serve | check | calibrate | register | drive | reset`: the simulated robot, and any robot behind an
address."""

import os
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sightline.cli.output import Json, Output, Quiet, as_json

if TYPE_CHECKING:
    from collections.abc import Callable

    from sightline.case.interop.plan_file import PlanFile
    from sightline.rehearsal.operation import Theatre
    from sightline.robot.kinematics.measured import RobotFile
    from sightline.robot.kinematics.registration import Registration
    from sightline.robot.kinematics.target import RobotTarget
    from sightline.robot.link.client import RobotClient
    from sightline.robot.link.server import RobotServer

app = typer.Typer(
    no_args_is_help=True, help="Serve a simulated robot; check, calibrate, register, drive and reset any."
)

SERIAL = "simulated"
Address = Annotated[str, typer.Argument(metavar="HOST:PORT", help="Where the robot listens.")]
Side = Annotated[Literal["right", "left"], typer.Option(help="The patient's side.")]
Serial = Annotated[
    str | None, typer.Option(help=f"Serial of the frame on the flange, {SERIAL!r} unless told.", show_default=False)
]
Seed = Annotated[
    int | None, typer.Option(min=0, help="Rehearse the patient of this seed, whose images `sightline demo` writes.")
]
FrameName = Annotated[str, typer.Option(help="The rehearsal's frame: a file, or gamma, biplane, stereo.")]
Yes = Annotated[bool, typer.Option("--yes", help="Ask nothing. Simulators only.")]


def register(parent: typer.Typer) -> None:
    """Add the commands."""
    parent.add_typer(app, name="robot")


@app.command("serve")
def serve(
    *,
    port: Annotated[int, typer.Option(help="0 takes a free one.")] = 18936,
    host: Annotated[str, typer.Option(help="Address to listen at: who reaches it can move it.")] = "127.0.0.1",
    side: Side = "right",
    frame_serial: Serial = None,
    rehearse: Seed = None,
    frame: FrameName = "gamma",
    dialect: Annotated[
        Literal["sightline", "brp2013"], typer.Option(help="brp2013: for clients of the convention of 2013 alone.")
    ] = "sightline",
    virtual: Annotated[
        bool, typer.Option("--virtual", help="As fast as it computes, for clients without heartbeats.")
    ] = False,
    attached: Annotated[
        bool,
        typer.Option(
            "--attached",
            help='For programs: first line {"port": N}; ends when standard input does, as with its parent.',
        ),
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Serve a simulated robot until Ctrl-C: its wire in air, or in the bone of a rehearsal."""
    with Output(json=json, quiet=quiet) as out:
        from sightline.robot.link.dialect import DIALECTS
        from sightline.robot.link.server import tune_process

        theatre = _theatre(side, frame_serial, rehearse, frame)
        tune_process()
        with theatre.server(host=host, port=port, virtual=virtual, dialect=DIALECTS[dialect]) as server:
            out.say(f"a simulated robot listens at {host}:{server.port}; stop it with Ctrl-C")
            if attached:
                typer.echo(as_json({"port": server.port}))
                Thread(target=_close_with_stdin, args=(server,), name="stdin", daemon=True).start()
            try:
                server.wait()
            except KeyboardInterrupt:
                out.note("stopping")
            cycles = server.dialogue.cycles
        out.result({"port": server.port, "cycles": cycles.count, "late": cycles.missed, "worst_s": cycles.worst_s})


@app.command("check")
def check(
    address: Address,
    *,
    dry_run: Annotated[bool, typer.Option(help="Also align in air, without drilling; asks first.")] = True,
    yes: Yes = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Ask a robot whether it keeps the contract of docs/robot-link.md; exit code 3 where it does not."""
    wrong: list[str] = []
    with Output(json=json, quiet=quiet) as out:
        from sightline.robot.link.conformance.examination import Examination, Verdict
        from sightline.robot.link.server import tune_process

        tune_process()
        with Examination(*parse_address(address)) as robot:
            with out.step("asking"):
                findings = robot.examine()
            if dry_run and _agreed(robot.simulated, yes, "The robot will move: it aligns in air. Is it clear?"):
                with out.step("dry run"):
                    findings += robot.dry_run()
        rows = [(finding.name, finding.verdict.value, finding.seen) for finding in findings]
        out.table(f"Robot at {address}", ("question", "", "seen"), rows)
        wrong = [finding.name for finding in findings if finding.verdict is Verdict.FAILED]
        if wrong:
            out.note(f"the robot does not keep the contract: {'; '.join(wrong)}")
        named = ("name", "verdict", "seen")
        out.result({"conforms": not wrong, "findings": [dict(zip(named, row, strict=True)) for row in rows]})
    if wrong:
        raise typer.Exit(3)


@app.command("calibrate")
def calibrate(
    measurements: Annotated[Path, typer.Argument(help="What was measured on the robot, JSON: docs/real-robot.md.")],
    *,
    out_file: Annotated[Path, typer.Option("--out", help="The robot's file.")] = Path("robot.json"),
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate a robot from measurements of its axes, its frame and its wire, and write its file."""
    with Output(json=json, quiet=quiet) as out:
        from sightline.robot.kinematics.measured import Measurements, RobotFile

        said = Measurements.read(measurements)
        robot, rms = RobotFile.calibrated(said)
        robot.write(out_file)
        sd = {"axes": said.axes.sd_mm, "frame": said.frame.sd_mm, "wire": said.wire.sd_mm}
        rows = [(name, f"{rms[name]:.3f}", f"{sd[name]:.3f}") for name in rms]
        out.table("Residuals, mm", ("measured", "rms", "stated, per axis"), rows)
        out.say(f"robot {robot.robot_serial} with frame {robot.frame_serial}: {out_file}")
        out.result({"file": str(out_file), "residual_rms_mm": rms, "robot_serial": robot.robot_serial})


@app.command("register")
def register_image(
    robot_file: Annotated[Path, typer.Argument(help="The robot's file, of `sightline robot calibrate`.")],
    address: Address,
    *,
    view: Annotated[Literal["pa", "lateral"], typer.Option(help="Which image is taken.")],
    image: Annotated[Path, typer.Option(help="Its file, once it is taken: the one that the plan is made on.")],
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Read the robot's joints at the moment of an image, and keep them in its file: once for each view."""
    with Output(json=json, quiet=quiet) as out:
        import time

        from sightline.case.journal.originals import called
        from sightline.errors import RobotRefusedError
        from sightline.imaging import read_image
        from sightline.robot.kinematics.measured import RobotFile
        from sightline.robot.link.client import RobotClient

        known = RobotFile.read(robot_file)
        known.refuse_old(time.time())
        with RobotClient(*parse_address(address), heartbeat=False, streams=False) as robot:
            before = robot.joints()[0]
            question = f"Robot {known.robot_serial} stands still. Take the {view} image now; is it in {image.name}?"
            if not _said_yes(question):
                raise RobotRefusedError("no image was taken; nothing was registered")
            q, now = robot.joints()[0], time.time()
        known.refuse_moved(before, q)
        read_image(image, 0)  # or what is registered is not an image
        source = called(image)
        known.at_image(view, q, now, source).write(robot_file)
        out.say(f"the {view} image: joints {', '.join(f'{one:.3f}' for one in q)} (mm, rad)")
        out.result({"file": str(robot_file), "view": view, "joints": q, "read_s": now, "source": source})


@app.command("drive")
def drive(
    plan: Annotated[Path, typer.Argument(help="plan.json, as `sightline plan --out` writes it.")],
    address: Annotated[str | None, typer.Argument(metavar="[HOST:PORT]", help="A simulator starts by itself.")] = None,
    *,
    registration: Annotated[
        Path | None, typer.Option(help="The robot's file with its poses at the images: a real robot needs it.")
    ] = None,
    frame_serial: Serial = None,
    rehearse: Seed = None,
    frame: FrameName = "gamma",
    yes: Yes = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Drive a planned wire: align, confirm, drill, pause, confirm, drill. Asks before each motion; a real robot first
    goes to the plan without the wire."""
    with Output(json=json, quiet=quiet) as out, ExitStack() as stack:
        from sightline.errors import UnusableInputError
        from sightline.robot.kinematics.measured import RobotFile
        from sightline.robot.link.client import RobotClient
        from sightline.robot.link.server import tune_process

        tune_process()
        known = read_plan(plan)
        stood = None if registration is None else RobotFile.read(registration)
        if address is None:
            if stood is not None:
                raise UnusableInputError("--registration is of a robot that stands somewhere: give its HOST:PORT")
            with out.step("starting a simulator"):
                theatre = _theatre(known.side or "", frame_serial, rehearse, frame)
            frame_serial = theatre.setup.frame_serial
            server = stack.enter_context(theatre.server(virtual=True))
            robot = stack.enter_context(RobotClient(port=server.port, heartbeat=False))
        elif rehearse is not None:
            raise UnusableInputError(
                "--rehearse starts a simulator by itself; leave it or the address out, and state --frame-serial"
            )
        elif stood is not None and frame_serial is not None:
            raise UnusableInputError("the robot's file names its frame; leave out --frame-serial")
        else:
            robot = stack.enter_context(RobotClient(*parse_address(address)))
        _refuse_yes(robot.simulated, yes)
        with out.step("sending the plan"):
            if stood is None:
                target = _send(robot, known, known.identifier(plan.stem), frame_serial or SERIAL)
            else:
                target = _send_registered(robot, known, known.identifier(plan.stem), stood)
        _show(out, target, robot)
        for name, question, go in _steps(robot, target, known_way=robot.simulated):
            if not _agreed(robot.simulated, yes, question):
                robot.stop()
                out.note(f"stopped before: {name}")
                break
            with out.step(name):
                go()
        state, tip_mm = robot.status().text.split(";")[0], robot.position().translation
        out.say(f"the robot is in {state}")
        told = {"state": state, "tip_mm": tip_mm, "end_mm": known.points_mm[1]}
        if rehearse is not None:
            told["true_wire_mm"] = robot.simulated_wire().axis_mm
        out.result(told)


@app.command("reset")
def reset(address: Address, *, json: Json = False, quiet: Quiet = False) -> None:
    """Reset a robot after a fault: shows the fault, asks a person, and sends its number."""
    with Output(json=json, quiet=quiet) as out:
        from sightline.errors import RobotRefusedError
        from sightline.robot.link.client import RobotClient

        with RobotClient(*parse_address(address), heartbeat=False, streams=False) as robot:
            status = robot.status()
            if not status.subcode:
                raise RobotRefusedError(f"there is no fault to reset; the robot is in {status.error_name}")
            typer.echo(f"{status.text}", err=True)
            typer.confirm("Have you seen to it, at the robot?", abort=True, err=True)
            robot.reset(status.subcode)
            out.say(f"fault {status.subcode} is reset; the robot is in {robot.status().error_name}")
        out.result({"fault": status.subcode, "text": status.text})


def parse_address(text: str) -> tuple[str, int]:
    """'host:port'. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    host, _, port = text.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise UnusableInputError(f"{text!r} is no address; write HOST:PORT, for example 127.0.0.1:18936")
    return host, int(port)


def read_plan(file: Path) -> "PlanFile":
    """A plan that a robot may be sent. Raises UnusableInputError, RobotRefusedError."""
    from sightline.case.interop.plan_file import PlanFile

    plan = PlanFile.read(file)
    plan.refuse_for_robot()
    return plan


def _theatre(side: str, frame_serial: str | None, rehearse: int | None, frame: str) -> "Theatre":
    """A robot in air, or before the bone of a rehearsal. Raises UnusableInputError, SetUpError."""
    from sightline.errors import UnusableInputError
    from sightline.rehearsal.operation import Theatre

    if rehearse is None:
        return Theatre.in_air(side, frame_serial or SERIAL)
    if frame_serial is not None:
        raise UnusableInputError("a rehearsal takes the serial of its frame; leave out --frame-serial")
    from sightline.frame import Frame
    from sightline.rehearsal.procedure import Rehearsal

    return Rehearsal.draw(rehearse, Frame.load(frame), side).theatre()


def _close_with_stdin(server: "RobotServer") -> None:
    """By the file's number: a thread that waits in a Python file keeps the process from ending."""
    while os.read(0, 1024):
        pass
    server.close()


_Step = tuple[str, str, "Callable[[], object]"]


def _steps(robot: "RobotClient", target: "RobotTarget", *, known_way: bool) -> "list[_Step]":
    """Each motion, what a person must have seen before it, and how it is told."""
    import time

    from sightline.robot import contract

    def again() -> None:
        robot.retract()
        _tell(robot, target, time.time())

    if contract.HAS_DRILLING not in robot.capabilities:
        return [
            (
                "go to the target",
                "This robot knows the convention of 2013 alone: it moves the wire to the end point at once, and no dry "
                "run shows the way. Is it clear, and do both images show the plan as it should be?",
                robot.align,
            )
        ]
    dry: list[_Step] = [
        (
            "dry run",
            "Dry run: take the wire out. The arm turns to the plan, in air. Is the way clear?",
            robot.align,
        ),
        ("draw back", "Did the arm go where it should? It draws back; then put the wire in.", again),
    ]
    return [
        *([] if known_way else dry),
        ("align", "The wire goes back, the arm turns, the wire stops 20 mm before bone. Is it clear?", robot.align),
        ("drill", "Does the confirmation shot show the guide on the plan? The robot will drill.", robot.drill),
        ("drill on", "Does the second shot, 10 mm short of the tip, show the wire on the plan?", robot.drill),
    ]


def _send(robot: "RobotClient", plan: "PlanFile", name: str, frame_serial: str) -> "RobotTarget":
    """Register, aim and send. The frame is where a simulator's encoders say; a real one's images are long taken."""
    import time

    from sightline.errors import RobotRefusedError
    from sightline.rehearsal.robots import calibrated_robot
    from sightline.robot.kinematics.registration import PoseAtImage, register

    if not robot.simulated:
        raise RobotRefusedError(
            "a saved plan does not say where a real robot stood at its images: give --registration, the file of "
            "`sightline robot calibrate` and `register`"
        )
    now = time.time()
    robot.start_up()
    q = robot.simulated_wire().imaged  # where it stood at the images, not where an earlier drive left it
    poses = {view: PoseAtImage(q, now, now) for view in ("pa", "lateral")}
    # A plan for a simulator, whose images were never taken, is a new one each time.
    target = _target(plan, f"{name}-{now:.0f}", frame_serial, register(calibrated_robot(plan.side or ""), poses))
    _tell(robot, target, now)
    return target


def _send_registered(robot: "RobotClient", plan: "PlanFile", name: str, stood: "RobotFile") -> "RobotTarget":
    """The same, of a robot whose file says where it stood. Raises RobotRefusedError for another plan's."""
    import time

    frame = plan.document.frame
    stood.refuse_other(plan.side, None if frame is None else frame.serial, time.time())
    registration = stood.registration()
    stood.refuse_other_images(plan.images)
    target = _target(plan, name, stood.frame_serial, registration)
    target.refuse_unfit(time.time())
    robot.start_up()
    _tell(robot, target, time.time())
    return target


def _target(plan: "PlanFile", name: str, frame_serial: str, registration: "Registration") -> "RobotTarget":
    from sightline.robot.kinematics.target import PlanIdentity, aim

    budget = None if plan.covariance_mm2 is None else {"planning": plan.covariance_mm2}
    identity = PlanIdentity(name, plan.side or "", frame_serial, plan.go, plan.document.kind or "")
    return aim(identity, plan.points_mm, budget, registration, plan.limits)


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
        raise RobotRefusedError("--yes works with simulators alone; a person must confirm each motion of a real robot")


def _agreed(simulated: bool, yes: bool, question: str) -> bool:
    _refuse_yes(simulated, yes)
    return yes or _said_yes(question)


def _said_yes(question: str) -> bool:
    return typer.confirm(question, err=True)
