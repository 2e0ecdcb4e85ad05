"""A robot that is not a simulator, from its measurements to a drilled wire: every motion is confirmed, and a plan that
is not this robot's, this frame's or of these images is refused."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from tests.cli.test_robot import run, trajectory, written
from tests.robot.rig import END_MM, IMAGED, wait_for
from tests.robot.scripted_robot import ScriptedRobot, serving
from tests.robot.test_by_images import measured, mount_file, pose_file
from tests.robot.test_measured import measurements, true_robot

from sightline.case.journal.originals import anonymous_name
from sightline.cli.robot.drive import DriveShots
from sightline.errors import UnusableInputError
from sightline.frame import Frame
from sightline.robot import contract
from sightline.robot.igtl import Message, encode
from sightline.robot.link.record import Recorder

EXAMPLE = Path(__file__).parents[2] / "examples" / "plant_template.py"
GAMMA, BLOCK = (replace(Frame.load(name), serial="SN-7") for name in ("gamma", "block30"))
FRAME = {"name": "gamma", "serial": "SN-7", "fingerprint": GAMMA.fingerprint, "beads": []}
VIEWS = ("pa", "lateral")


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory) -> Path:
    """The robot's file as `robot calibrate` writes it."""
    folder = tmp_path_factory.mktemp("robot")
    (folder / "measured.json").write_text(json.dumps(measurements(true_robot())))
    GAMMA.save(folder / "gamma.json")
    frame = ("--frame", folder / "gamma.json")
    done = run("calibrate", folder / "measured.json", *frame, "--out", folder / "robot.json", "--json")
    assert done.exit_code == 0, done.output
    assert max(json.loads(done.stdout)["residual_rms_mm"].values()) < 0.1
    return folder / "robot.json"


@pytest.fixture
def robot_file(calibrated, tmp_path) -> Path:
    file = tmp_path / "robot.json"
    file.write_bytes(calibrated.read_bytes())
    return file


@pytest.fixture
def images(tmp_path) -> dict[str, Path]:
    """The file of each image, as it comes from the C-arm."""
    return {view: image(tmp_path / f"{view}.npy", number) for number, view in enumerate(VIEWS)}


def image(file: Path, number: int) -> Path:
    """One that differs with its number."""
    np.save(file, np.full((16, 16), number, dtype=np.uint8))
    return file


def views_of(images: dict[str, Path]) -> list[dict]:
    """As plan.json names them."""
    return [{"view": view, "source": anonymous_name(file)} for view, file in images.items()]


@pytest.fixture
def plan(tmp_path, images) -> Path:
    return written(tmp_path / "plan.json", frame=FRAME, views=views_of(images))


def real_robot() -> ScriptedRobot:
    robot = ScriptedRobot(simulated=False, steps=5)
    robot.joints_at = IMAGED
    return robot


def register(file: Path, address: str, images: dict[str, Path]) -> None:
    for view in VIEWS:
        done = run("register", file, address, "--view", view, "--image", images[view], say="y\n")
        assert done.exit_code == 0, done.output


def test_calibrate_register_and_drive(robot_file, plan, images):
    peer = real_robot()
    with serving(peer) as port:
        address = f"127.0.0.1:{port}"
        register(robot_file, address, images)
        done = run("drive", plan, address, "--registration", robot_file, "--json", say="y\n" * 5)
        assert done.exit_code == 4, done.output  # without a check shot
        assert np.allclose(json.loads(done.stdout.splitlines()[-1])["tip_mm"], END_MM, atol=0.01)
        assert [one for one in peer.commands if one in ("MOVE_TO_TARGET", "DRILL", "RETRACT")] == [
            "MOVE_TO_TARGET", "RETRACT", "MOVE_TO_TARGET", "DRILL", "DRILL",
        ]  # fmt: skip
        for agreed in (0, 2, 3):
            before = len(peer.commands)
            done = run("drive", plan, address, "--registration", robot_file, say="y\n" * agreed + "n\n")
            assert "stopped before" in done.stderr
            moved = [one for one in peer.commands[before:] if one in ("MOVE_TO_TARGET", "DRILL", "RETRACT")]
            assert len(moved) == agreed
        assert run("drive", plan, address, "--registration", robot_file, "--yes").exit_code == 3


def test_an_arm_calibrated_by_images_at_poses_is_registered_by_its_pose(tmp_path, plan, images):
    """The plan on both images is also that of its wire, for calibration and against the encoders."""
    frame = {key: FRAME[key] for key in ("name", "serial", "fingerprint")}
    mount_file(tmp_path, by_pose=True, frame=frame, measured_on=datetime.now(UTC).isoformat())
    measured(tmp_path, measured_on=datetime.now(UTC).isoformat())
    file = tmp_path / "robot.json"
    done = run("calibrate", tmp_path / "measured.json", "--out", file, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["residual_rms_mm"] == {}
    for view in VIEWS:
        pose = pose_file(tmp_path, measured_on=datetime.now(UTC).isoformat())
        done = run("register", file, "--pose", pose, "--view", view, "--image", images[view], say="y\n")
        assert done.exit_code == 0, done.output
    done = run("register", file, "--from-images", plan, "--json")
    assert done.exit_code == 0, done.output
    assert run("register", file, "--view", "pa", "--image", images["pa"]).exit_code == 2
    mount_file(tmp_path, by_pose=True, frame={**frame, "fingerprint": "gamma/SN-7#other"})
    done = run("calibrate", tmp_path / "measured.json", "--out", file)
    assert "the wire was planned with another frame file" in done.output.replace("\n", " ")


@pytest.mark.parametrize("late_s", [1, 20])
def test_every_prompt_may_be_answered_late(robot_file, plan, images, tmp_path, monkeypatch, late_s):
    """The robot streams meanwhile, as it does while a shot is measured: a client that does not read it is given up."""
    peer, waits, given = (
        real_robot(),
        0,
        iter(("pa.npy lateral.npy", "", "pa.npy lateral.npy", "", "pa.npy lateral.npy")),
    )
    second = encode(Message(peer.joints(), "late")) * round(2 / contract.TELEMETRY_S)  # twice for pose and joints
    read = 0

    def heard(_: Recorder, message: Message) -> None:
        nonlocal read
        read += message.device_name == "late"

    def pass_time(*_: object, **__: object) -> bool:
        nonlocal waits
        waits += 1
        peer.peers[0].write(late_s * second)
        wait_for(lambda: read == waits * late_s * 100)
        return True

    def not_seen(*_: object) -> None:
        pass_time()
        raise UnusableInputError("no wire is seen")

    monkeypatch.setattr(Recorder, "heard", heard)
    monkeypatch.setattr("sightline.cli.robot.drive.planned_in", lambda *_: 1)
    monkeypatch.setattr(DriveShots, "_measure", not_seen)
    monkeypatch.setattr(DriveShots, "_check", lambda *_: ({}, ()) if pass_time() else None)
    monkeypatch.setattr(DriveShots, "record_drilled", lambda *_: None)
    with serving(peer) as port:
        address = f"127.0.0.1:{port}"
        register(robot_file, address, images)
        monkeypatch.setattr("typer.confirm", pass_time)
        monkeypatch.setattr("typer.prompt", lambda *_, **__: next(given) if pass_time() else None)
        shots = ("--case", tmp_path, "--patient-frame", "block40")
        done = run("drive", plan, address, "--registration", robot_file, *shots)
    assert done.exit_code == 0, done.output
    assert waits == 5 + 5 + 3  # motions, prompts for images, and measurements
    assert peer.commands.count("DRILL") == 2


def test_what_is_not_this_robot_s_is_refused(robot_file, plan, images, tmp_path):
    peer = real_robot()
    with serving(peer) as port:
        address = f"127.0.0.1:{port}"
        done = run("drive", plan, address, "--registration", robot_file, say="y\n" * 5)
        assert done.exit_code == 3
        assert "pa and lateral image is missing" in done.stderr
        done = run("register", robot_file, address, "--view", "pa", "--image", images["pa"], say="n\n")
        assert done.exit_code == 3
        register(robot_file, address, images)
        for changed, why in (
            ({"side": "left"}, "side"),
            ({"frame": FRAME | {"serial": None}}, "frame serial"),
            ({"frame": FRAME | {"name": "block30", "fingerprint": BLOCK.fingerprint}}, "frame file is block30"),
            ({"frame": {key: FRAME[key] for key in ("name", "serial", "beads")}}, "frame file is not stated"),
        ):
            other = written(tmp_path / "other.json", **({"frame": FRAME, "views": views_of(images)} | changed))
            done = run("drive", other, address, "--registration", robot_file, say="y\n" * 5)
            assert done.exit_code == 3
            assert why in done.stderr
        document = json.loads(robot_file.read_text())
        for image in document["images"].values():
            image["read_s"] -= 700.0
        robot_file.write_text(json.dumps(document))
        done = run("drive", plan, address, "--registration", robot_file, say="y\n" * 5)
        assert done.exit_code == 3
        assert "expired" in done.stderr
        assert "MOVE_TO_TARGET" not in peer.commands
    assert run("drive", plan, "--registration", robot_file).exit_code == 2
    assert run("drive", plan, "127.0.0.1:1", "--registration", robot_file, "--frame-serial", "SN-7").exit_code == 2


def test_a_frame_of_another_serial_than_the_measured_one_is_refused(tmp_path):
    (tmp_path / "measured.json").write_text(json.dumps(measurements(true_robot())))
    done = run("calibrate", tmp_path / "measured.json", "--frame", "gamma", "--out", tmp_path / "robot.json")
    assert done.exit_code == 3
    assert "the frame file states the serial None" in done.stderr


def test_a_plan_on_other_images_than_those_registered_is_refused(robot_file, plan, images, tmp_path):
    """Where the robot stood at its images is not known, though side and frame are the same."""
    peer = real_robot()
    with serving(peer) as port:
        address = f"127.0.0.1:{port}"
        register(robot_file, address, images)
        new = image(tmp_path / "new.npy", 2)
        named, anew = views_of(images), {"view": "lateral", "source": anonymous_name(new)}
        for views in ([named[0], anew], [named[0]], [], [named[0], {**named[0], "view": "lateral"}]):
            other = written(tmp_path / "other.json", frame=FRAME, views=views)
            done = run("drive", other, address, "--registration", robot_file, say="y\n" * 5)
            assert done.exit_code == 3
            assert "plan on the registered images" in " ".join(done.stderr.split())
        register(robot_file, address, images | {"lateral": new})
        planned_anew = written(tmp_path / "new.json", frame=FRAME, views=[named[0], anew])
        for planned, refused in ((plan, True), (planned_anew, False)):
            done = run("drive", planned, address, "--registration", robot_file, say="n\n")
            assert (done.exit_code == 3) is refused, done.output
        assert "MOVE_TO_TARGET" not in peer.commands
        for none in (tmp_path / "none.npy", plan):
            done = run("register", robot_file, address, "--view", "pa", "--image", none, say="y\n")
            assert done.exit_code == 2


def test_a_plan_on_new_images_is_another_plan_for_the_robot(robot_file, plan, images, tmp_path):
    """Ten minutes after the first its identifier has expired; that of the next, in a file of the same name, has not."""
    peer = real_robot()
    with serving(peer) as port:
        address = f"127.0.0.1:{port}"
        for number in range(2):
            image(images["pa"], 10 + number)
            register(robot_file, address, images)
            written(plan, frame=FRAME, views=views_of(images))
            for _ in range(2):  # sent again it is the same plan
                done = run("drive", plan, address, "--registration", robot_file, say="n\n")
                assert done.exit_code == 0, done.output
    first, again, other, _ = peer.plans
    assert first == again != other
    assert first.startswith("plan-")


def test_images_of_the_wire_correct_the_mounts_or_are_refused(robot_file, plan, images, tmp_path):
    """They hold for plans on these images alone: the next image makes the encoders' pose the robot's again."""
    q = np.round(IMAGED, 3)
    manipulator = true_robot()
    wire = (manipulator.T_mcs_cfcs(q).inv() * manipulator.T_mcs_tool(q)).apply([[0.0, 0.0, -60.0], [0.0, 0.0, 0.0]])
    named = {"frame": FRAME, "views": views_of(images)}
    seen = written(tmp_path / "wire.json", **named, trajectory=trajectory(wire, 0.0025))
    off = wire + np.array([0.0, 2.0, 0.0])
    knocked = written(tmp_path / "knocked.json", **named, trajectory=trajectory(off, 0.0025))
    other = written(tmp_path / "other.json", frame=FRAME | {"fingerprint": "x"}, views=views_of(images))
    assert run("register", robot_file, "--from-images", seen).exit_code == 3  # no images yet
    with serving(real_robot()) as port:
        address = f"127.0.0.1:{port}"
        register(robot_file, address, images)
        before = robot_file.read_bytes()
        for wrong, why in ((knocked, "disagree"), (other, "frame file")):
            done = run("register", robot_file, "--from-images", wrong)
            assert done.exit_code == 3
            assert why in done.stderr
        assert robot_file.read_bytes() == before
        done = run("register", robot_file, "--from-images", seen, "--json")
        assert done.exit_code == 0, done.output
        errors = json.loads(done.stdout)["error_95"]
        assert errors["images"][0] < errors["encoders"][0]
        done = run("drive", plan, address, "--registration", robot_file, say="n\n")
        assert done.exit_code == 0, done.output
        register(robot_file, address, images)
    assert json.loads(robot_file.read_text())["wire_seen"] is None
    assert run("register", robot_file, address, "--from-images", seen).exit_code == 2
    assert run("register", robot_file, address).exit_code == 2


def test_a_robot_of_2013_is_told_once_and_asked_for(robot_file, plan, images):
    peer = ScriptedRobot(ours=False, clients=1, steps=5)
    with serving(peer) as port:
        document = json.loads(robot_file.read_text())
        document["images"] = {
            view: {"q": IMAGED.tolist(), "read_s": time.time(), "source": anonymous_name(file)}
            for view, file in images.items()
        }
        robot_file.write_text(json.dumps(document))
        done = run("drive", plan, f"127.0.0.1:{port}", "--registration", robot_file, say="y\n")
        assert done.exit_code == 4, done.output
        assert "convention of 2013" in done.stderr
        assert peer.commands.count("MOVE_TO_TARGET") == 1


@contextmanager
def example(robot_file: Path) -> Iterator[str]:
    """The address of the template's robot."""
    command = [sys.executable, str(EXAMPLE), str(robot_file), "0"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603
        assert process.stdin is not None
        assert process.stdout is not None
        yield process.stdout.readline().split()[-1]
        process.stdin.close()


@pytest.mark.slow
def test_the_plant_template_is_a_robot(robot_file, images):
    """It is registered and checked like any other."""
    with example(robot_file) as address:
        register(robot_file, address, images)
        done = run("check", address, "--no-dry-run", "--frame-serial", "SN-7", "--json")
        assert done.exit_code == 5, done.output  # nobody was there for the dry run
        findings = [(one["name"], one["verdict"]) for one in json.loads(done.stdout)["findings"]]
        assert all(name.startswith("dry run: ") for name, verdict in findings if verdict == "not asked"), findings
        assert "FAIL" not in dict(findings).values()
        assert json.loads(robot_file.read_text())["images"]["pa"]["q"] == pytest.approx(IMAGED.tolist())
