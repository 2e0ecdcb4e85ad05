"""The robot behind its port: an insertion, refusals, lost clients and servers, and stops."""

import asyncio
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.robot.rig import (
    END_MM,
    ENTRY_MM,
    IMAGED,
    ROBOT,
    SETUP,
    T_MCS_CFCS,
    IdealPlant,
    Rig,
    metadata,
    mid_motion,
    served,
    wait_for,
    wire,
)

from sightline.errors import LinkError, RobotRefusedError
from sightline.robot.control.controller import Controller
from sightline.robot.control.states import State
from sightline.robot.control.timing import LoopClock
from sightline.robot.igtl import Message, String, Transform, encode
from sightline.robot.link.client import RobotClient
from sightline.robot.link.server import RobotServer, Simulation
from sightline.robot.transport import BlockingClient


def ready(robot: RobotClient) -> None:
    robot.start_up()
    robot.calibrate(T_MCS_CFCS, 10.0)
    robot.aim(wire(), metadata(), 10.0)


def still(server) -> bool:
    """Return whether the joints were commanded to stand still after the robot handled all requests."""
    wait_for(lambda: not server.dialogue.controller.busy)
    return not server._plant.goal.any()


@pytest.fixture(scope="module")
def virtual():
    with served(virtual=True) as server:
        yield server


@pytest.fixture
def robot(virtual):
    wait_for(lambda: virtual.dialogue.controller.lease is None)
    with RobotClient(port=virtual.port, streams=False) as client:
        yield client


def test_a_whole_insertion(virtual, robot):
    ready(robot)
    robot.align()
    along = (END_MM - ENTRY_MM) / np.linalg.norm(END_MM - ENTRY_MM)
    assert np.allclose(robot.position().translation, ENTRY_MM - 20 * along, atol=0.05)
    assert np.allclose(robot.position().rotation.apply([0, 0, 1]), along, atol=1e-4)
    assert robot.drill() == "PAUSED"
    assert robot.drill() == "DONE"
    assert np.allclose(robot.position().translation, END_MM, atol=0.05)
    robot.retract()
    assert robot.status().error_name == "PLANNING"
    with pytest.raises(RobotRefusedError, match="not MOVE_TO_TARGET in PLANNING"):
        robot.align()


def test_a_target_through_the_table_is_refused(robot):
    ready(robot)
    steep = np.array([0.0, 45.0, 0.0])
    lifted = T_MCS_CFCS * RigidTransform.from_translation([0.0, 0.0, 90.0])  # the table rises with the frame
    robot.calibrate(lifted, 20.0)
    with pytest.raises(RobotRefusedError, match=r"table|out of reach"):
        robot.aim(wire(ENTRY_MM + steep, END_MM + steep), metadata(), 20.0)


def test_a_robot_does_not_know_where_its_wire_truly_is(robot):
    with pytest.raises(RobotRefusedError, match="no COMMAND 'SIMULATED_WIRE'"):
        robot.simulated_wire()


def test_streams_and_what_they_hold():
    began = time.time()
    with served() as server, RobotClient(port=server.port) as robot:
        ready(robot)
        rows = robot.stream("arm/measured_js").body.values
        assert rows.shape == (6, 5)
        assert np.allclose(rows[0], server.dialogue.controller.machine.snapshot().reading.encoders, atol=0.02)
        pose = robot.stream("arm/measured_cp")
        assert pose.metadata["coordinates"] == "MCS"
        assert np.allclose(pose.body.matrix, ROBOT.manipulator.T_mcs_tool(rows[0]).as_matrix(), atol=0.02)
        assert len(robot.stream("arm/force").body.values) == 1
        length = np.linalg.norm(END_MM - ENTRY_MM)
        assert robot.stream("arm/depth").body.values[0] < 0 < length
        count, missed, worst_s = robot.stream("arm/cycles").body.values
        assert count > 0 <= missed
        assert worst_s >= 0
        assert robot.stream("CURRENT_STATUS").body.error_name == "TARGETING"
        assert began <= robot.stream("arm/measured_cp").time_s <= time.time()


def client_of(server) -> RobotClient:
    return RobotClient(port=server.port, streams=False)


def at_mid_motion(server, act) -> threading.Thread:
    """Do something from another thread while the robot moves."""
    thread = threading.Thread(target=lambda: (mid_motion(server), act()))
    thread.start()
    return thread


@pytest.mark.parametrize(("how", "other"), [("STOP", True), ("EMERGENCY", False)])
def test_a_stop_from_another_thread_and_from_another_client(how, other):
    with (
        served(virtual=True, halted=State.ALIGN) as server,
        client_of(server) as robot,
        client_of(server) as second,
    ):
        ready(robot)
        said, by = [], second if other else robot
        stopping = at_mid_motion(server, lambda: said.append(by.stop() if how == "STOP" else by.emergency()))
        with pytest.raises(RobotRefusedError, match=r"stopped by a client's STOP|a client sent EMERGENCY"):
            robot.align()
        stopping.join()
        assert said[0].code == (1 if how == "STOP" else 3)
        assert still(server)
        assert robot.status().error_name == how
        if how == "EMERGENCY":
            with pytest.raises(RobotRefusedError, match="a person must reset"):
                robot.start_up()
            fault = robot.status().subcode
            with pytest.raises(RobotRefusedError, match="not"):
                robot.reset(fault + 1)
            robot.reset(fault)
            assert robot.status().error_name == "UNDEFINED"


def test_a_stop_with_a_wrong_crc_stops():
    data = encode(Message(String("STOP"), "CMD_1"))
    with served(virtual=True, halted=State.ALIGN) as server, client_of(server) as robot:
        ready(robot)
        with BlockingClient(port=server.port) as raw:
            stopping = at_mid_motion(server, lambda: raw._socket.sendall(data[:57] + b"x" + data[58:]))
            with pytest.raises(RobotRefusedError, match="stopped by a client's STOP"):
                robot.align()
            stopping.join()
            assert still(server)


@pytest.mark.parametrize("state", [State.TARGETING, State.ALIGN], ids=lambda state: state.value)
def test_a_client_that_is_killed(state):
    with served(virtual=True, halted=None if state is State.TARGETING else state) as server:
        controller = server.dialogue.controller
        client = socket.create_connection(("127.0.0.1", server.port))
        steps = [
            (String("START_UP"), "CMD_1"), (String("CALIBRATION"), "CMD_2"), (Transform.of(T_MCS_CFCS.inv()), "CLB_1"),
            (String("TARGETING"), "CMD_3"), (Transform.of(wire()), "TGT_1"),
        ]  # fmt: skip
        if state is not State.TARGETING:
            steps += [(String("MOVE_TO_TARGET"), "CMD_4")]
        for body, name in steps:
            said = metadata() if name.startswith("TGT") else {}
            client.sendall(encode(Message(body, name, version=2, metadata=said)))
        if state is State.TARGETING:
            wait_for(lambda: controller.machine.insertion is not None)
        else:
            mid_motion(server)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        client.close()  # with a reset, as the system does for a process that is killed
        wait_for(lambda: controller.machine.state is State.UNDEFINED)
        assert controller.lease is None
        assert still(server)


def test_a_server_that_ends_and_starts_again():
    with served(virtual=True, halted=State.ALIGN) as server:
        port = server.port
        robot = client_of(server)
        ready(robot)
        ending = at_mid_motion(server, server.close)
        with pytest.raises(LinkError, match=r"lost|closed"):
            robot.align()
        ending.join()
        robot.close()
    with pytest.raises(LinkError, match="cannot connect"):
        RobotClient(port=port)
    with served(port=port), RobotClient(port=port) as robot:
        assert robot.status().error_name == "UNDEFINED"
        with pytest.raises(RobotRefusedError):
            robot.align()
        robot.start_up()


def test_a_port_that_is_taken():
    with served() as server, pytest.raises(LinkError, match="choose another port"), served(port=server.port):
        pass


def test_what_cannot_be_read_moves_nothing_and_is_answered(virtual, robot):
    ready(robot)
    with BlockingClient(port=virtual.port) as raw:
        good = encode(Message(String("START_UP"), "CMD_1"))
        raw._socket.sendall(good[:-1] + bytes([good[-1] ^ 1]))
        said = raw.receive(1.0)
        assert said.body.error_name == "UNREADABLE"
        assert "altered" in said.body.text
    assert robot.status().error_name == "TARGETING"


class Counted:
    """A connection for `RobotServer.received`, without a socket."""

    def __init__(self):
        self.closed = False

    def close(self, reason):
        self.closed = True


def test_a_stranger_s_flood_cuts_off_the_stranger_alone():
    plant = IdealPlant()
    server = RobotServer(Controller(ROBOT, plant, SETUP), plant)  # whose loop does not turn: what comes waits
    holder, strangers = Counted(), [Counted() for _ in range(7)]
    for connection in (holder, *strangers):
        server.opened(connection)
    question, beat = Message(String(""), "CURRENT_STATUS"), Message(String(""), "HEARTBEAT")
    for _ in range(5000):
        for stranger in strangers:
            server.received(stranger, question)
    for _ in range(100):
        server.received(holder, beat)
    assert [stranger.closed for stranger in strangers] == [True] * 7
    assert not holder.closed
    heard = []
    for _ in range(100):
        heard += [one.client for one in server._inbox.batch(32)]
    assert heard.count(1) >= 100  # the leaseholder, in few turns
    assert len(server._inbox) < 7 * 300


def test_a_round_of_the_link_has_read_all_that_had_come(monkeypatch):
    """The robot's program paused, and a message waits in its socket: it is heard before silence is judged."""
    monkeypatch.setattr("sightline.robot.link.server.READ_S", 0.0)
    moved = IdealPlant()
    server = RobotServer(Controller(ROBOT, moved, SETUP), moved, port=0)

    async def link() -> None:
        listening = asyncio.create_task(server._listen())
        while not server._listening.is_set():
            await asyncio.sleep(0)
        with socket.create_connection(("127.0.0.1", server.port)) as client:
            while not server._connections:
                await asyncio.sleep(0)
            for number in range(20):
                asked = server._rounds
                client.sendall(encode(Message(String(""), "HEARTBEAT")))  # this coroutine is the pause
                while server._rounds < asked + 2:
                    await asyncio.sleep(0)
                assert server._inbox.waiting(1) == 1 + number + 1  # that it is there was heard first
        server._closing.set()
        await listening

    asyncio.run(link())


class Clock:
    """Of a server whose loop is run by a test: `sleep` takes what it should, and one of `pauses_s` besides; the link
    is read meanwhile, and `goes_on` told what passed."""

    def __init__(self, server: RobotServer, now_s: float, pauses_s: list[float], goes_on) -> None:
        self.now_s, self._pauses_s, self._server, self._goes_on = now_s, pauses_s, server, goes_on
        self._thread = threading.get_ident()

    def monotonic(self) -> float:
        return self.now_s if threading.get_ident() == self._thread else time.monotonic()

    def sleep(self, seconds: float) -> None:
        if threading.get_ident() != self._thread:  # that of another server, which goes on
            time.sleep(seconds)
            return
        self._server._rounds += 1
        if self._pauses_s:
            passed = seconds + self._pauses_s.pop(0)
            self.now_s += passed
            self._goes_on(passed)
        else:
            self._server._end.set()


@pytest.mark.parametrize("simulated", [True, False], ids=["simulated", "real"])
def test_a_simulated_robot_stands_still_while_its_program_does(simulated, monkeypatch):
    """Its motion goes on afterwards; a real robot's drives have stopped, and the motion ends."""
    rig = Rig.at(State.ALIGN)
    server = RobotServer(rig.controller, rig.plant, Simulation(rig.plant.advance) if simulated else None)
    server.dialogue = rig.dialogue
    began, own = rig.now_s, LoopClock()
    own.now_s = began  # the rig's time goes on in the server's
    monkeypatch.setattr("sightline.robot.link.server.LoopClock", lambda: own)
    pauses_s = [0.0] * 20 + [0.3, 0.0, 5.0] + [0.0] * 20
    clock = Clock(server, began, pauses_s, (lambda _: None) if simulated else rig.plant.advance)
    monkeypatch.setattr("sightline.robot.link.server.time", clock)
    monkeypatch.setattr(server, "_event_loop", SimpleNamespace(call_soon_threadsafe=lambda *_: None), raising=False)
    moved = np.abs(rig.plant.q - IMAGED).max()
    server._turn_on_time()
    if simulated:
        assert rig.state is State.ALIGN
        assert np.abs(rig.plant.q - IMAGED).max() > moved
        assert own.now_s - began < 43 * 0.005 + 2 * 0.02
    else:
        assert rig.state is State.STOP
    assert server.dialogue.cycles.worst_s == pytest.approx(5.0)


def test_a_robot_that_says_nothing_is_noticed(monkeypatch):
    monkeypatch.setattr("sightline.robot.link.exchange.ACK_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent, RobotClient(port=silent.getsockname()[1]) as robot:
        assert not robot.capabilities
        with pytest.raises(LinkError, match=r"no ACK of START_UP within 0\.05 s"):
            robot.start_up()
