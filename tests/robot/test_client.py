"""The client verifies the robot: acknowledged, reachable and final poses are compared with the plan, answers belong to
their queries, and a stop gets through."""

import subprocess
import sys
import threading
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from tests.robot.rig import wait_for
from tests.robot.scripted_robot import HOME, ScriptedRobot, serving
from tests.systems import needs_posix

from sightline.errors import LinkError, RobotRefusedError
from sightline.robot import contract
from sightline.robot.igtl import Message, NDArray, String, encode
from sightline.robot.link.client import RobotClient
from sightline.robot.link.exchange import AXIS_LIMIT_RAD, TIP_LIMIT_MM, WireDeviation, refuse_other_pose
from sightline.robot.link.shared_connection import Mailbox

T_MCS_CFCS = RigidTransform.from_components([400.0, 20.0, 290.0], Rotation.from_rotvec([0.0, 0.0, np.pi]))
TARGET = T_MCS_CFCS.inv() * RigidTransform.from_matrix(HOME) * RigidTransform.from_translation([3.0, -2.0, 120.0])


def told(robot: RobotClient) -> None:
    robot.start_up()
    robot.calibrate(T_MCS_CFCS)
    robot.aim(TARGET)


def test_the_deviation_is_that_of_axis_and_tip():
    turned = TARGET * RigidTransform.from_components([0.0, 0.0, 0.0], Rotation.from_rotvec([0.0, 0.0, 2.1]))
    deviation = WireDeviation.of(turned, TARGET)
    assert max(deviation.aside_mm, abs(deviation.along_mm), deviation.angle_rad) < 1e-9
    deviation.refuse_large("the wire lies")
    shift = RigidTransform.from_translation([0.3, -0.4, 0.7])
    tilt = RigidTransform.from_components([0.0, 0.0, 0.0], Rotation.from_rotvec([0.0, 0.01, 0.0]))
    deviation = WireDeviation.of(TARGET * shift * tilt, TARGET)
    assert (deviation.aside_mm, deviation.along_mm, deviation.angle_rad) == pytest.approx((0.5, 0.7, 0.01), abs=1e-9)


@pytest.mark.parametrize(
    ("aside", "along", "angle", "depth_off", "good"),
    [
        (0.49, 0.0, 0.0, None, True),
        (0.51, 0.0, 0.0, None, False),
        (0.0, -0.51, 0.0, None, False),
        (0.0, 0.0, 0.99 * AXIS_LIMIT_RAD, None, True),
        (0.0, 0.0, 1.01 * AXIS_LIMIT_RAD, None, False),
        (0.0, 1.5, 0.0, 0.02, True),  # a shot has moved the zero of depth
        (0.0, 1.5, 0.0, 0.6, False),
        (0.0, 3.2, 0.0, 0.02, True),  # read a quarter of a second apart
        (0.0, 3.3, 0.0, 0.02, False),
        (0.0, 0.0, 0.0, float("nan"), False),
        (float("nan"), 0.0, 0.0, None, False),
    ],
)
def test_beyond_its_limits_it_is_refused(aside, along, angle, depth_off, good):
    deviation = WireDeviation(aside, along, angle)
    if good:
        deviation.refuse_large("the wire lies", depth_off, 3.0 if depth_off is not None else 0.0)
    else:
        with pytest.raises(RobotRefusedError, match="elsewhere than planned"):
            deviation.refuse_large("the wire lies", depth_off, 3.0 if depth_off is not None else 0.0)
    assert TIP_LIMIT_MM == 0.5


def test_an_echo_is_what_was_sent_to_32_bits():
    sent = TARGET.as_matrix()
    refuse_other_pose(sent.astype(np.float32), sent, "target")
    refuse_other_pose(np.full((4, 4), np.nan), np.full((4, 4), np.nan), "target")
    for row, column, by in ((0, 3, 0.001), (1, 1, 1e-5), (0, 3, np.nan)):
        echo = sent.copy()
        echo[row, column] += by
        with pytest.raises(RobotRefusedError, match="another target"):
            refuse_other_pose(echo, sent, "target")


@pytest.mark.parametrize("ours", [True, False], ids=["ours", "2013"])
@pytest.mark.parametrize(
    ("flaw", "why"),
    [
        ("would lay it aside", "would lay the wire elsewhere than planned: the tip 15.00 mm aside"),
        (
            "would lay it deeper",
            r"would lay the wire elsewhere than planned: the tip 0\.00 mm aside and \+15\.00 mm along",
        ),
        ("echoes another target", "another target than was sent"),
        ("echoes another registration", "another registration than was sent"),
    ],
)
def test_a_robot_that_means_another_target_is_not_told_to_move(ours, flaw, why):
    peer = ScriptedRobot(flaw, ours=ours)
    with serving(peer) as port, RobotClient(port=port) as robot:
        with pytest.raises(RobotRefusedError, match=why):
            told(robot)
        for move in (robot.align, robot.drill, robot.guide):
            with pytest.raises(RobotRefusedError, match="nothing may move"):
                move()
        assert not {"MOVE_TO_TARGET", "DRILL", "GUIDE"} & set(peer.commands)


@pytest.mark.parametrize(
    ("flaw", "ours", "why"),
    [
        ("lays it aside", True, r"from the entry point, the aligned wire lies elsewhere than planned: the tip 15\.00"),
        ("lays it aside", False, r"the wire lies elsewhere than planned: the tip 15\.00"),
        ("aligns in the bone", True, r"from the entry point, .* 0\.00 mm aside and \+85\.00 mm along"),
    ],
)
def test_a_robot_that_aligns_the_wire_elsewhere_than_it_said_is_found_out(flaw, ours, why):
    with serving(ScriptedRobot(flaw, ours=ours, steps=5)) as port, RobotClient(port=port) as robot:
        told(robot)
        with pytest.raises(RobotRefusedError, match=why):
            robot.align()


@pytest.mark.parametrize(
    ("deeper_mm", "shot", "beyond_mm", "why"),
    [
        (1.1, False, 0.0, None),  # as contact may move the zero
        (2.0, False, 0.0, "its zero moved by 2.00 mm .at most 1.2 mm"),
        (2.0, True, 0.0, None),
        (0.4, False, 10.0, "its zero moved by 0.40 mm .at most 0.0 mm"),  # there is no contact
        (-2.0, False, 0.0, "and -2.00 mm along the wire"),
    ],
)
def test_a_zero_of_depth_is_moved_by_contact_or_a_shot_alone(monkeypatch, deeper_mm, shot, beyond_mm, why):
    peer = ScriptedRobot(steps=2)
    peer.deeper_mm = deeper_mm
    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        robot.aim(TARGET, {contract.LENGTH_MM: repr(peer.length_mm), contract.BEYOND_MM: repr(beyond_mm)})
        robot.align()
        if shot:
            monkeypatch.setattr(robot, "order", lambda name, text: "")  # it takes it
            robot.shot_depth(peer.length_mm)
        with nullcontext() if why is None else pytest.raises(RobotRefusedError, match=why):
            robot.drill()


def test_an_open_hole_s_depth_is_a_number_and_its_zero_may_have_moved():
    peer = ScriptedRobot(steps=2)
    peer.deeper_mm, peer.open_hole_mm = 2.0, 30.0
    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        robot.aim(TARGET, {contract.LENGTH_MM: repr(peer.length_mm)})
        robot.align()
        robot.drill()
        assert robot.open_hole_mm == 30.0
        peer.open_hole_mm = np.nan
        with pytest.raises(RobotRefusedError, match="the robot's arm/open_hole is not a SENSOR of one finite number"):
            robot.aim(TARGET)
        peer.open_hole_mm = None
        told(robot)
        assert robot.open_hole_mm is None


def test_answers_are_those_of_their_questions():
    peer = ScriptedRobot()
    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        for k in range(5):
            for _ in range(3):
                robot.stream(contract.MEASURED_JS)  # and others wait to be read
            peer.tip = HOME.copy()
            peer.tip[0, 3] += 15.0 * k
            assert robot.joints()[0, 0] == pytest.approx(peer.tip[0, 3])
            peer.tip[1, 3] = 7.0 * k
            assert T_MCS_CFCS.apply(robot.position().translation) == pytest.approx(peer.tip[:3, 3], abs=1e-3)
            assert robot.status().error_name == peer.phase


def test_nor_does_a_late_answer_count_for_the_next_question(monkeypatch):
    monkeypatch.setattr("sightline.robot.link.shared_connection.STATUS_S", 0.5)
    peer = ScriptedRobot()
    with serving(peer) as port, RobotClient(port=port, streams=False, heartbeat=False) as robot:
        peer.holds = True
        with pytest.raises(LinkError, match="no arm/measured_js"):
            robot.joints()
        peer.late = HOME + 5.0  # it moves after what it held back, which comes now, in its order
        peer.holds = False
        assert robot.joints()[0, 0] == pytest.approx(255.0)


def test_a_robot_of_2013_answers_with_where_it_is_now():
    peer = ScriptedRobot(ours=False, steps=5)
    with serving(peer) as port, RobotClient(port=port) as robot:
        assert not robot.capabilities
        told(robot)
        robot.plan()  # which such a robot answers by no STATUS of that name
        told(robot)
        robot.command("MOVE_TO_TARGET")
        assert robot.position().translation == pytest.approx(TARGET.translation, abs=1e-3)
        peer.tip = HOME.copy()
        assert T_MCS_CFCS.apply(robot.position().translation) == pytest.approx(HOME[:3, 3], abs=1e-3)


# A stop finds a way.


def test_four_stops_at_once_are_all_answered():
    peer = ScriptedRobot()
    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        said = []
        threads = [threading.Thread(target=lambda: said.append(robot.stop())) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [one.code for one in said] == [1, 1, 1, 1]
        assert peer.commands.count("STOP") == 4


@pytest.mark.parametrize("clients", [1, 8], ids=["takes one client", "is deaf on the second connection"])
def test_a_stop_falls_back_to_the_main_connection(clients):
    """While another thread waits there for the end of the motion."""
    peer = ScriptedRobot("deaf on other connections", clients=clients)
    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        refused = []

        def move() -> None:
            try:
                robot.align()
            except RobotRefusedError as error:
                refused.append(str(error))

        moving = threading.Thread(target=move)
        moving.start()
        wait_for(lambda: peer.moving is not None)
        assert robot.stop().code == 1
        moving.join()
        assert peer.moving is None
        assert peer.phase == "STOP"
        assert refused


def test_where_no_stop_is_answered_the_connections_are_closed(monkeypatch):
    peer = ScriptedRobot("deaf to STOP")
    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        monkeypatch.setattr("sightline.robot.link.exchange.ACK_S", 0.1)
        with pytest.raises(LinkError, match="red button"):
            robot.stop()
        wait_for(lambda: not peer.peers)
        assert peer.phase == "UNDEFINED"  # it stopped by itself
        with pytest.raises(LinkError):
            robot.status()


def test_a_stop_s_connection_that_dies_is_made_anew(monkeypatch):
    monkeypatch.setattr("sightline.robot.link.exchange.PROBE_S", 0.05)
    peer = ScriptedRobot()
    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        first = peer.peers[1]
        first.transport.abort()
        wait_for(lambda: len(peer.peers) == 2 and first not in peer.peers)
        assert robot.stop().code == 1
        assert peer.phase == "STOP"


@pytest.mark.parametrize(("times", "size", "messages"), [(1, 1000, 400), (200, 5, 500)], ids=["20 MB", "200 times"])
def test_a_person_may_think_for_as_long_as_they_like(times, size, messages):
    """More streams than sockets hold, or those of ten seconds 200 times, while no call is made: a robot gives up a
    client that reads none."""
    peer, arrived = ScriptedRobot(steps=1), 0

    def count(message: Message) -> None:
        nonlocal arrived
        arrived += message.device_name == "minutes"

    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        robot.listeners.append(count)
        streamed = encode(Message(NDArray(np.zeros((6, size))), "minutes")) * messages
        for k in range(times):
            peer.peers[0].write(streamed)
            wait_for(lambda due=(k + 1) * messages: arrived == due)
            assert robot.status().code == 1
        robot.align()


# Signs of life.


@pytest.mark.parametrize(("pauses", "comes"), [(3, True), (0, False)], ids=["it paused", "the robot is late"])
def test_a_pause_of_the_client_is_not_the_robot_s_lateness(monkeypatch, pauses, comes):
    """What comes after it comes in time, though its second has long passed on the clock."""
    clock, left = SimpleNamespace(now_s=0.0), pauses
    monkeypatch.setattr("sightline.robot.link.shared_connection.time", SimpleNamespace(monotonic=lambda: clock.now_s))
    answer = Message(String("START_UP"), "ACK_1")

    class Connection:
        def wait(self, mail: Mailbox, timeout_s: float) -> None:
            nonlocal left
            left -= 1
            clock.now_s += 5.0 if left >= 0 else timeout_s
            if comes and left == -5:
                mail.came.append(answer)

    assert Mailbox(Connection()).until(lambda _: True, contract.ACK_S) is (answer if comes else None)
    assert clock.now_s == pytest.approx(15.2 if comes else contract.ACK_S, abs=0.06)


def test_a_program_that_hangs_is_silent(monkeypatch):
    monkeypatch.setattr("sightline.robot.link.shared_connection.ALIVE_S", 0.1)
    peer = ScriptedRobot(steps=3000)
    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        hangs = threading.Event()
        robot.listeners.append(lambda _: hangs.wait(60.0) if peer.moving is not None else None)

        def align() -> None:
            with pytest.raises((LinkError, RobotRefusedError)):  # its ACK may lie behind what hangs
                robot.align()

        moving = threading.Thread(target=align)
        moving.start()
        wait_for(lambda: peer.moving is not None)
        wait_for(lambda: peer.moving is None)
        assert peer.phase == "STOP"
        hangs.set()
        moving.join()


def test_between_two_calls_nobody_moves_anything():
    """After an abandoned call the robot stops, because its client is silent."""
    peer = ScriptedRobot(steps=3000)
    with serving(peer) as port, RobotClient(port=port) as robot:
        told(robot)
        with pytest.raises(LinkError, match="no STATUS MOVE_TO_TARGET"):
            robot.command("MOVE_TO_TARGET", 0.1)
        wait_for(lambda: peer.moving is None)
        assert peer.phase == "STOP"


@pytest.mark.slow
@needs_posix
@pytest.mark.parametrize(("signal", "ends"), [(9, "UNDEFINED"), (19, "STOP")], ids=["killed", "stopped"])
def test_a_client_that_is_gone_is_not_outlived_by_its_heartbeats(signal, ends):
    """Heartbeats come from a separate process, which ends with the client and stops for a client that hangs."""
    peer = ScriptedRobot(steps=3000)
    with serving(peer) as port:
        says = f"from tests.robot.test_client import *\nrobot = RobotClient(port={port})\ntold(robot)\nrobot.align()\n"
        with subprocess.Popen([sys.executable, "-c", says], stderr=subprocess.DEVNULL) as client:  # noqa: S603
            wait_for(lambda: peer.moving is not None)
            moving = peer.peers[0]
            client.send_signal(signal)
            wait_for(lambda: peer.moving is None)
            assert peer.phase == ends
            client.kill()
        wait_for(lambda: not peer.peers)
        assert moving.transport.is_closing()


@pytest.mark.slow
def test_what_holds_the_interpreter_delays_no_heartbeat():
    """A computation that lets no other thread run, for longer than the robot's silence."""
    peer = ScriptedRobot(steps=40)
    with serving(peer) as port:
        says = (
            "import time\nimport sightline.robot.link.shared_connection\n"
            "sightline.robot.link.shared_connection.ALIVE_S = 30.0\n"
            f"from tests.robot.test_client import *\nrobot = RobotClient(port={port})\ntold(robot)\n"
            "big = np.random.default_rng(1).random(1_000_000).tolist()\n"
            "began = time.monotonic()\nsorted(big[:100_000])\n"
            "big = big * round(0.2 / (time.monotonic() - began) + 1)\n"  # a second and more
            "def listen(_, hold=[1]):\n"
            "    if hold:\n"
            "        hold.pop()\n"
            "        began = time.monotonic()\n"
            "        sorted(big)\n"
            "        print(time.monotonic() - began, flush=True)\n"
            "robot.listeners.append(listen)\nrobot.align()\nprint('aligned', flush=True)\n"
        )
        done = subprocess.run([sys.executable, "-c", says], capture_output=True, text=True, timeout=120, check=False)  # noqa: S603
    assert "aligned" in done.stdout, done.stderr
    assert float(done.stdout.split()[0]) > 0.5
