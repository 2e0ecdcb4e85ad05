"""The robot as the page has it: one order at a time, and an answer to each even when the link has ended."""

import asyncio

import pytest

from sightline.app.robot_session import RobotSession
from sightline.errors import LinkError, RobotRefusedError
from sightline.rehearsal.operation import Theatre
from sightline.robot.states import State


@pytest.fixture
def session():
    theatre = Theatre.in_air("right", "none")
    with theatre.server(virtual=True) as server:
        made = RobotSession(theatre.robot, server.port, lambda: None, heartbeat=False)
        yield made
        made.close()


def test_a_second_order_is_refused_while_the_first_is_carried_out(session: RobotSession) -> None:
    async def both() -> list[object]:
        return await asyncio.gather(session.reset(1), session.reset(1), return_exceptions=True)

    first, second = asyncio.run(both())
    assert isinstance(second, RobotRefusedError)
    assert "still resetting" in str(second)
    assert "still" not in str(first)  # it came to the robot, which has no fault to reset
    assert session.now.doing == ""


def test_a_confirmation_of_another_state_drills_nothing(session: RobotSession) -> None:
    with pytest.raises(RobotRefusedError, match="confirm again"):
        asyncio.run(session.drill(State.ALIGNED))


def test_an_order_after_the_link_has_ended_is_answered(session: RobotSession) -> None:
    session.close()
    with pytest.raises(LinkError, match="lost"):
        asyncio.run(session.retract())
