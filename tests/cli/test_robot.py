"""`sightline robot`: a plan driven by the simulator, a robot checked and reset, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.robot.rig import END_MM, ENTRY_MM, served, wait_for
from tests.robot.scripted_robot import old_robot, scripted
from tests.robot.test_robot_server import at_mid_motion, ready, still
from typer.testing import CliRunner

from sightline.case.interop.plan_file import sealed
from sightline.cli import commands
from sightline.errors import RobotRefusedError
from sightline.frame import Frame
from sightline.rehearsal.operation import SimulatedTheatre
from sightline.robot.control.states import State
from sightline.robot.link.client import RobotClient
from sightline.robot.transport import BlockingClient
from sightline.twin.xray.setup import hip_of


def run(*args: object, say: str = ""):
    return CliRunner().invoke(commands, ["robot", *map(str, args)], input=say)


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    return written(tmp_path / "plan.json")


def written(file: Path, **changed) -> Path:
    document = {
        "go": True,
        "verdict": "go",
        "missing": [],
        "kind": "free-wire",
        "side": "right",
        "limits": {"position_mm": 1.0, "direction_deg": 0.6, "beyond_mm": 0.0},
        "trajectory": trajectory(),
        "checks": [{"name": "gap", "passed": True}],
    }
    file.write_text(json.dumps(sealed(document | changed)))
    return file


def trajectory(wire_mm: np.ndarray | None = None, variance_mm2: float = 0.01) -> dict:
    entry, end = (ENTRY_MM, END_MM) if wire_mm is None else wire_mm
    covariance = variance_mm2 * np.eye(6)
    return {
        "coordinates": "CFCS",
        "entry_mm": entry.tolist(),
        "end_mm": end.tolist(),
        "direction": ((end - entry) / np.linalg.norm(end - entry)).tolist(),
        "length_mm": float(np.linalg.norm(end - entry)),
        "covariance_mm2": covariance.tolist(),
        "error_95": None,
        "gap_mm": [0.0, 0.0],
        "gap_tested": [True, True],
    }


def of_block60(file: Path) -> Path:
    """A plan of a right hip beside a block."""
    block = Frame.load("block60")
    beads = [{"id": "b1", "view": "all", "plate": "solid", "xyz_mm": [0.0, 0.0, 0.0]}]
    frame = {"name": block.name, "serial": None, "fingerprint": block.fingerprint, "beads": beads}
    return written(file, frame=frame, trajectory=trajectory(np.stack([ENTRY_MM, END_MM]) + hip_of(block, "right")))


@pytest.mark.slow
def test_a_plan_made_with_a_block_is_driven_by_the_robot_that_held_it(tmp_path):
    file = of_block60(tmp_path / "plan.json")
    refused = run("drive", file, "--yes")
    assert refused.exit_code == 3
    assert "made with the block block60/#" in refused.stderr
    done = run("drive", file, "--frame", "block60", "--json", say="y\ny\ny\ny\n")
    assert done.exit_code == 4, done.output
    assert "Take the block off" in done.stderr
    said = json.loads(done.stdout[done.stdout.index("{") :])
    assert said["state"] == "DONE"
    assert np.allclose(said["tip_mm"], END_MM + hip_of(Frame.load("block60"), "right"), atol=0.05)
    other = run("drive", written(tmp_path / "other.json", frame=gamma_part()), "--frame", "block60", "--yes")
    assert other.exit_code == 3
    assert "the plan's frame file is 'gamma/#" in other.stderr


def gamma_part() -> dict:
    frame = Frame.load("gamma")
    return {"name": frame.name, "serial": None, "fingerprint": frame.fingerprint, "beads": []}


@pytest.mark.slow
def test_a_plan_made_with_a_block_is_not_drilled_by_the_robot_that_holds_a_gamma(tmp_path):
    """Neither states a serial, but their coordinates differ; nor by one at an address."""
    file = of_block60(tmp_path / "plan.json")
    done = run("drive", file, "--rehearse", "9", "--yes")
    assert done.exit_code == 3
    assert "the simulated robot holds gamma/#" in done.stderr
    with SimulatedTheatre.in_air("right", "simulated").server(virtual=True) as server:
        done = run("drive", file, f"127.0.0.1:{server.port}", "--frame", "block60", "--yes")
    assert done.exit_code == 3


def test_drive_asks_before_each_motion(plan):
    done = run("drive", plan, say="y\nn\n")
    assert done.exit_code == 0
    assert "stopped before: drill" in done.stderr
    assert "95 % errors: entry" in done.stdout
    refused = run("drive", plan, say="n\n")
    assert "stopped before: align" in refused.stderr


def test_a_real_robot_takes_no_yes_and_no_saved_plan(plan):
    with old_robot() as port:
        done = run("drive", plan, f"127.0.0.1:{port}", "--yes")
        assert done.exit_code == 3
        assert "simulators only" in done.stderr
        done = run("drive", plan, f"127.0.0.1:{port}")
        assert done.exit_code == 3
        assert "where a real robot was" in done.stderr
        assert run("check", f"127.0.0.1:{port}", "--yes", "--quiet").exit_code == 3


def test_a_robot_set_up_for_the_other_side_refuses_with_both_named(plan):
    with SimulatedTheatre.in_air("left", "simulated").server(virtual=True) as server:
        done = run("drive", plan, f"127.0.0.1:{server.port}", "--frame-serial", "simulated", "--yes")
    assert done.exit_code == 3
    assert "the plan's side is 'right', the robot is set up for 'left'" in done.stderr


def test_a_rehearsal_at_an_address_or_of_another_serial_is_refused(plan):
    for given in (("127.0.0.1:1", "--rehearse", "9"), ("--rehearse", "9", "--frame-serial", "SN-1")):
        assert run("drive", plan, *given).exit_code == 2


@pytest.mark.parametrize(
    ("changed", "code", "why"),
    [
        ({"go": False, "verdict": "no-go"}, 3, "NO-GO"),
        ({"go": False, "verdict": "incomplete", "missing": ["The head."]}, 3, "INCOMPLETE"),
        ({"side": None}, 3, "side"),
        ({"trajectory": {}}, 2, "trajectory"),
        ({"trajectory": trajectory() | {"covariance_mm2": None}}, 3, "error is unknown"),
        ({"trajectory": trajectory(variance_mm2=1.0)}, 3, "must not be drilled"),
    ],
)
def test_plans_that_are_none(tmp_path, changed, code, why):
    done = run("drive", written(tmp_path / "plan.json", **changed), "--yes")
    assert done.exit_code == code
    assert why in " ".join(done.stderr.split())


@pytest.mark.slow
def test_the_plans_own_limits_and_depth_are_those_of_the_robot(tmp_path):
    narrow = {"position_mm": 0.3, "direction_deg": 0.6, "beyond_mm": 0.0}
    done = run("drive", written(tmp_path / "plan.json", limits=narrow), "--yes")
    assert done.exit_code == 3
    assert "above its limit of 0.30 mm" in done.stderr
    past = {"position_mm": 1.0, "direction_deg": 0.6, "beyond_mm": 4.0}
    done = run("drive", written(tmp_path / "plan.json", limits=past), "--yes", "--json")
    assert done.exit_code == 4, done.output
    tip = END_MM + 4.0 * (END_MM - ENTRY_MM) / np.linalg.norm(END_MM - ENTRY_MM)
    assert np.allclose(json.loads(done.stdout)["tip_mm"], tip, atol=0.05)


@pytest.mark.slow
def test_check_a_robot(monkeypatch):
    monkeypatch.setattr("sightline.robot.link.conformance.poses.HOLD_S", 0.6)
    with scripted(steps=100) as port:
        done = run("check", f"127.0.0.1:{port}", "--frame-serial", "SN-7", "--yes", "--json")
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["conforms"] is True
    assert {"name": "unknown command: 12", "verdict": "pass"}.items() <= said["findings"][3].items()
    assert said["findings"][-1]["name"].startswith("dry run")


def started(client: RobotClient) -> bool:
    """Whether the robot has noticed by now that the client before has left, and lets this one start it up."""
    try:
        client.start_up()
    except RobotRefusedError:
        return False
    return True


def test_what_could_not_be_asked_is_not_passed():
    """No person agreed to the dry run, the frame's serial is another one, or another client holds the lease."""
    plans, motions = 9, 14
    with scripted() as port, RobotClient(port=port) as client:
        address = f"127.0.0.1:{port}"
        for serial, least in (("SN-7", motions), ("SN-8", motions + plans), ("SN-7", motions + plans + 10)):
            done = run("check", address, "--frame-serial", serial, "--json", "--no-dry-run")
            assert done.exit_code == 5, done.output
            said = json.loads(done.stdout)
            assert said["conforms"] is None
            unasked = sum(finding["verdict"] == "not asked" for finding in said["findings"])
            assert unasked >= least
            assert (unasked == least) is (least <= motions + plans)
            if serial == "SN-8":
                wait_for(lambda: started(client))
    with scripted() as port:
        done = run("check", f"127.0.0.1:{port}", "--frame-serial", "SN-7", say="n\n")
    assert done.exit_code == 5
    assert "14 of 61 questions were not asked" in " ".join(done.stderr.split())


@pytest.mark.slow
def test_a_bad_robot_s_findings_are_printed_for_people_and_for_machines():
    """Whatever it sends: text where a message should be, too."""
    with scripted("answers a wrong CRC with text") as port:
        done = run("check", f"127.0.0.1:{port}", "--no-dry-run")
        assert done.exit_code == 3
        assert "does not follow docs/robot-link.md: survives" in done.stderr
        assert "FAIL" in done.stdout
        done = run("check", f"127.0.0.1:{port}", "--no-dry-run", "--json")
    assert done.exit_code == 3
    said = json.loads(done.stdout)
    assert said["conforms"] is False
    assert next(f["name"] for f in said["findings"] if f["verdict"] == "FAIL").startswith("survives")


def test_a_robot_is_stopped_however_many_clients_say_nothing():
    with served(virtual=True, halted=State.ALIGN) as server, RobotClient(port=server.port) as robot:
        ready(robot)
        mute, said = [BlockingClient(port=server.port) for _ in range(12)], []
        stopping = at_mid_motion(server, lambda: said.append(run("stop", f"127.0.0.1:{server.port}", "--json")))
        with pytest.raises(RobotRefusedError, match="stopped by a client's STOP"):
            robot.align()
        stopping.join()
        assert said[0].exit_code == 0, said[0].output
        assert json.loads(said[0].stdout) == {"text": "stands still"}
        assert still(server)
        for client in mute:
            client.close()
    late = run("stop", f"127.0.0.1:{server.port}")
    assert late.exit_code == 2
    assert "use the red button" in late.stderr


def test_reset_after_a_fault():
    with served() as server:
        address = f"127.0.0.1:{server.port}"
        assert "no fault" in run("reset", address).stderr
        with RobotClient(port=server.port) as robot:
            robot.emergency()
        kept = run("reset", address, say="n\n")
        assert kept.exit_code == 1
        assert "a client sent EMERGENCY" in kept.stderr
        done = run("reset", address, say="y\n")
        assert done.exit_code == 0, done.output
        assert "UNDEFINED" in done.stdout
