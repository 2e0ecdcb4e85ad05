"""The robot as the page has it: one order at a time, and an answer to each even when the link has ended."""

import asyncio
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.robot.rig import END_MM, ENTRY_MM, ROBOT, SETUP, T_MCS_CFCS, metadata, wire
from tests.robot.test_depth import Layers

from sightline.app import texts
from sightline.app.panels import drill, steps
from sightline.app.panels.drill import _depth, how_deep, reading
from sightline.app.session.robot_session import RobotNow, RobotSession
from sightline.app.session.sent import ZeroSource
from sightline.common.checks import Limits
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.errors import LinkError, RobotRefusedError
from sightline.frame import Frame
from sightline.rehearsal.operation import SimulatedTheatre, await_hand, registered
from sightline.robot.contract import DEPTH
from sightline.robot.control.controller import Controller
from sightline.robot.control.insertion import Setup
from sightline.robot.control.states import State
from sightline.robot.kinematics.designs import FEED
from sightline.robot.kinematics.target import CONTACT_LEAD_MM, CONTACT_SD_MM, PLAN_SD_MM, PlanIdentity, robot_target
from sightline.robot.link.client import RobotClient
from sightline.robot.link.server import RobotServer, Simulation


@pytest.fixture
def session():
    theatre = SimulatedTheatre.in_air("right", "none")
    with theatre.server(virtual=True) as server:
        made = RobotSession(theatre.robot, server.port, lambda: None)
        yield made
        made.close()


def test_a_second_order_is_refused_while_the_first_is_carried_out(session: RobotSession) -> None:
    async def both() -> list[object]:
        return await asyncio.gather(session.reset(1), session.reset(1), return_exceptions=True)

    first, second = asyncio.run(both())
    assert isinstance(second, RobotRefusedError)
    assert "still resetting" in str(second)
    assert "still" not in str(first)  # it came to the robot, which has no fault to reset
    assert session.now.activity == ""


def test_a_confirmation_of_another_state_drills_nothing(session: RobotSession) -> None:
    with pytest.raises(RobotRefusedError, match="confirm again"):
        asyncio.run(session.drill(State.ALIGNED))


def test_an_order_after_the_link_has_ended_is_answered(session: RobotSession) -> None:
    session.close()
    with pytest.raises(LinkError, match="lost"):
        asyncio.run(session.retract())


@pytest.mark.parametrize(
    ("stops", "raised", "said"),
    [(True, "told to stop", ""), (False, r"DRILL \(not ready, 13\)", "The robot refused: the door is open.")],
)
def test_a_motion_that_a_person_stopped_is_no_refusal(
    session: RobotSession, stops: bool, raised: str, said: str
) -> None:
    """Another refusal is shown with its reason. Fails where the page shows codes, or an error after STOP."""
    begun, end = threading.Event(), threading.Event()

    def refused(client: RobotClient) -> None:
        begun.set()
        assert end.wait(PATIENCE_S)
        raise RobotRefusedError("the robot refused DRILL (not ready, 13): the door is open", "the door is open")

    async def drill() -> None:
        task = asyncio.create_task(session._do("drilling", refused))
        await asyncio.to_thread(begun.wait, PATIENCE_S)
        if stops:
            await session.stop()
        end.set()
        await task

    with pytest.raises(RobotRefusedError, match=raised):
        asyncio.run(drill())
    assert session.now.last_error == said


def test_an_open_hole_is_told(session: RobotSession, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    client, target = session._client, SimpleNamespace(registration=SimpleNamespace(T_mcs_cfcs=None, imaged_s=0.0))
    for name in ("start_up", "calibrate"):
        monkeypatch.setattr(client, name, lambda *_: None)
    monkeypatch.setattr(client, "aim_plan", lambda *_: setattr(client, "open_hole_mm", 30.0))
    asyncio.run(session.send(target, 80.0))
    drilling = SimpleNamespace(now=session.now, session=None, changed="")
    of = SimpleNamespace(drilling=drilling, readiness=SimpleNamespace(can_send=True))
    for name in ("heading", "_state"):
        monkeypatch.setattr(drill, name, lambda *_: None)
    monkeypatch.setattr(drill, "note", lambda text, **_: told.append(text))
    drill._robot(SimpleNamespace(planning=SimpleNamespace(drilled=None), session=of))
    assert "This hole was drilled to 30.0 mm before: the robot drills on there" in told[0]


@pytest.mark.slow  # a wire is drilled
def test_an_arm_holds_its_guide_until_a_person_has_drilled_or_somebody_stops_it() -> None:
    """Fails where the page orders DRILL, which this arm refuses, and where it waits on after STOP."""
    theatre = SimulatedTheatre.in_air("right", "none", Frame.load("block60"), "six-axis")
    identity = PlanIdentity("plan-1", "right", "none", True, "", theatre.setup.frame)
    stood = registered(theatre.robot, theatre.imaged, time.monotonic())
    points = np.stack([ENTRY_MM, END_MM]) + theatre.setup.hip_mm
    target = robot_target(identity, points, {"planning": 1e-3 * np.eye(6)}, stood, Limits())
    with theatre.server(virtual=True) as server:
        session = RobotSession(theatre.robot, server.port, lambda: None)
        asyncio.run(session.send(target, target.length_mm + 1.0))
        asyncio.run(session.align())
        _until(session, lambda now: now.state == "ALIGNED")
        assert asyncio.run(session.drill(State.ALIGNED)) == State.DONE.value
        wire_mm = asyncio.run(session.simulated_wire()).axis_mm
        assert np.linalg.norm(wire_mm[1] - points[1]) < 1.0
        asyncio.run(session.stop())
        _until(session, lambda now: now.state == "STOP")
        with pytest.raises(RobotRefusedError, match="STOP"):
            asyncio.run(session._do("waiting", lambda client: await_hand(client, target)))
        session.close()


def test_nobody_is_told_of_a_link_that_was_ended_on_purpose() -> None:
    """When the program ends, the loop that would hear of it has ended already."""
    told: list[str] = []
    theatre = SimulatedTheatre.in_air("right", "none")
    with theatre.server(virtual=True) as server:
        session = RobotSession(theatre.robot, server.port, lambda: told.append("changed"))
        with pytest.raises(RobotRefusedError):
            asyncio.run(session.reset(1))
        assert told
        told.clear()
        session.close()
    assert session.now.lost
    assert not told


PATIENCE_S = 120.0  # of a busy machine
AT_CONTACT_MM = PLAN_SD_MM * CONTACT_SD_MM / float(np.hypot(PLAN_SD_MM, CONTACT_SD_MM))


@contextmanager
def _at_the_pause() -> Iterator[RobotSession]:
    """At the pause, 10 mm short of the tip, after bone was met where it is planned."""
    plant = Layers({-CONTACT_LEAD_MM: 20.0})
    controller = Controller(ROBOT, plant, Setup(SETUP.side, SETUP.frame_serial))

    def ready(client: RobotClient) -> None:
        client.start_up()
        client.calibrate(T_MCS_CFCS, 10.0)
        client.aim(wire(), metadata(), 10.0)
        assert controller.machine.insertion is not None
        plant.zero_mm = float(controller.machine.insertion.q[FEED])

    with RobotServer(controller, plant, Simulation(plant.advance, virtual=True), port=0) as server:
        session = RobotSession(ROBOT, server.port, lambda: None)
        asyncio.run(session._do("aiming", ready))
        assert session.now.zero == (ZeroSource.PLAN,)
        asyncio.run(session.align())
        _until(session, lambda now: now.state == "ALIGNED")
        asyncio.run(session.drill(State.ALIGNED))
        _until(session, lambda now: now.state == "PAUSED" and now.depth_sd_mm is not None)
        heard: list[str] = []  # the depth that is known by now may be of before it stood
        session._client.listeners.append(lambda message: heard.append(message.device_name))
        _until(session, lambda _: heard.count(DEPTH) > 2)
        yield session
        session.close()


@pytest.fixture(scope="module")
def paused() -> Iterator[RobotSession]:
    """One session for three tests, in their order: nothing is told, a shot is told, the wire is drilled on."""
    with _at_the_pause() as session:
        yield session


def _until(session: RobotSession, there) -> None:
    end = time.monotonic() + PATIENCE_S
    while not there(session.now):
        assert time.monotonic() < end, session.now
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("now", "words"),
    [
        (RobotNow(), "Depth – · thrust –"),
        (RobotNow(depth_mm=3.04), "Depth ± ? (zero: plan) · thrust –"),
        (
            RobotNow(depth_mm=80.0, depth_sd_mm=0.1, zero=(ZeroSource.PLAN, ZeroSource.CONTACT, ZeroSource.SHOT)),
            "Depth ± 0.2 mm (zero: plan, contact and second shot) · thrust –",
        ),
    ],
)
def test_a_depth_without_an_error_says_so(now: RobotNow, words: str) -> None:
    assert reading(now) == words


@pytest.mark.parametrize(
    ("told_mm", "said"),
    [
        ([], "by hand; the robot does not know how deep"),
        ([-10.0, 25.9], "to the planned depth"),
        ([-10.0, 23.7], "through the far cortex, 2.3 mm short of the planned depth"),
    ],
)
def test_a_wire_is_called_drilled_to_the_planned_depth_only_if_it_is(told_mm: list[float], said: str) -> None:
    """Planned: 21 mm, and 5 beyond them. Fails for a page that says so, or breaks, where a robot tells no depth."""
    limits = SimpleNamespace(beyond_mm=5.0)
    plan = SimpleNamespace(trajectory=SimpleNamespace(length_mm=21.0), kind=SimpleNamespace(limits=limits))
    drilled = SimpleNamespace(record=SimpleNamespace(depth_mm=np.array(told_mm)))
    planning: Any = SimpleNamespace(sent=SimpleNamespace(plan=plan), drilled=drilled)
    assert f"Drilled {said}. " in how_deep(planning)


APART = "at most 1.4 mm is consistent"
IMPOSSIBLE = [(1.6, 0.5, APART), (-1.6, 0.5, APART), (0.0, 0.0, "95 %"), (0.0, -0.1, "95 %")]
NOT_FINITE = [(np.nan, 0.5, "the depth"), (0.0, np.nan, "95 %"), (np.inf, 0.5, "the depth")]


def test_a_second_shot_that_cannot_be_tells_the_robot_nothing(paused: RobotSession) -> None:
    before = paused.now
    assert before.depth_mm is not None
    for off_mm, error_95_mm, why in (*IMPOSSIBLE, *NOT_FINITE):
        with pytest.raises(RobotRefusedError, match=why):
            asyncio.run(paused.send_shot_depth(before.depth_mm + off_mm, error_95_mm))
    paused.refuse_shot(before.depth_mm + 1.2, 0.5)  # within what both state
    heard: list[str] = []  # the robot would have answered by then
    paused._client.listeners.append(lambda message: heard.append(message.device_name))
    _until(paused, lambda _: heard.count(DEPTH) > 2)
    assert (paused.now.depth_sd_mm, paused.now.zero) == (before.depth_sd_mm, before.zero)


def test_a_second_shot_is_told_with_its_error_and_counts_once(paused: RobotSession) -> None:
    before = paused.now.depth_mm
    assert before is not None
    assert paused.now.zero == (ZeroSource.PLAN, ZeroSource.CONTACT)
    assert paused.now.depth_sd_mm == pytest.approx(AT_CONTACT_MM)
    words = f"± {TWO_SIDED_95 * AT_CONTACT_MM:.1f} mm (zero: plan and contact)"
    assert words in reading(paused.now)
    shot, error = before + 0.7, 0.5
    asyncio.run(paused.send_shot_depth(shot, error))
    _until(paused, lambda now: ZeroSource.SHOT in now.zero)
    now, sd = paused.now, error / TWO_SIDED_95
    weight = AT_CONTACT_MM**2 / (AT_CONTACT_MM**2 + sd**2)
    assert now.zero == (ZeroSource.PLAN, ZeroSource.CONTACT, ZeroSource.SHOT)
    assert now.depth_sd_mm == pytest.approx(AT_CONTACT_MM * np.sqrt(1 - weight))
    _until(paused, lambda now: now.depth_mm == pytest.approx(before + weight * 0.7, abs=0.02))
    with pytest.raises(RobotRefusedError, match="already sent"):
        asyncio.run(paused.send_shot_depth(shot, error))


def test_a_motion_is_shown_while_it_lasts(paused: RobotSession) -> None:
    """The robot's state is not queried meanwhile. Fails where "Paused" is shown while the wire advances."""

    async def drill() -> list[str]:
        task = asyncio.create_task(paused.drill(State.PAUSED))
        await asyncio.sleep(0)  # it has begun
        during = paused.now.phase
        await task
        return [during, paused.now.activity]

    assert paused.now.phase == "PAUSED"
    assert asyncio.run(drill()) == ["DRILL", ""]
    _until(paused, lambda now: now.phase == "DONE")


def test_a_second_shot_whose_answer_came_too_late_counts_once_too() -> None:
    with _at_the_pause() as session:
        before, tell = session.now.depth_mm, session._client.shot_depth
        assert before is not None

        def late(*told: float) -> None:
            tell(*told)
            raise LinkError("no answer in time")

        session._client.shot_depth = late
        with pytest.raises(LinkError):
            asyncio.run(session.send_shot_depth(before, 0.5))
        with pytest.raises(RobotRefusedError, match="already sent"):
            asyncio.run(session.send_shot_depth(before, 0.5))


@pytest.mark.parametrize(
    ("cortex_mm", "limits"), [(-11.7, Limits(beyond_mm=15.0, before_mm=40.0)), (0.0, Limits()), (-0.04, Limits())]
)
def test_the_bar_of_the_depth_begins_before_all_its_marks(cortex_mm: float, limits: Limits) -> None:
    """Fails for a bar that begins 10 mm before the entry, where the bone of a nail's hole begins earlier."""
    event = SimpleNamespace(name="cortex", depth_mm=cortex_mm)
    target = SimpleNamespace(depth_mm=26.0, limits=limits)
    session = SimpleNamespace(target=target, depth_limit_mm=27.0, record=SimpleNamespace(events=[event]))
    drilling = SimpleNamespace(session=session, now=SimpleNamespace(depth_mm=-2.0), by_hand=False)
    tab: Any = SimpleNamespace(session=SimpleNamespace(drilling=drilling))
    html = _depth(tab)
    at = [float(left) for left in re.findall(r'<b style="left:([\d.]+)%"', html)]
    assert len(at) == 4 and min(at) > 1.0 and at[0] < max(at)
    assert "-0.0" not in html


def test_a_lost_robot_is_told_in_words_and_asked_for_no_depth() -> None:
    """Fails for "[Errno 32] Broken pipe" as what to do, and for a form whose error is that of the last word heard."""
    now = SimpleNamespace(
        lost=True, fault=0, last_error="[Errno 32] Broken pipe", text="", state=State.PAUSED.value, zero=(), activity=""
    )
    planning = SimpleNamespace(kinds=("hip-screw",), all_drilled={}, frame=SimpleNamespace(solid=None))
    session: Any = SimpleNamespace(
        planning=planning, drilling=SimpleNamespace(now=now), shots=SimpleNamespace(on_patient=False)
    )
    tab: Any = SimpleNamespace(planning=planning, session=session)
    assert steps._drill(session) == (steps.StepStatus.ATTENTION, texts.LINK_LOST)
    assert drill._shot_key(tab) is None
    drill._second_shot(tab)  # it needs a page where it builds anything
