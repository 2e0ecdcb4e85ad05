"""What navigation of 2013 asks of a robot, as its own test program does: scripts of what is sent and what must come.

The program itself (ProstateBRP/CommunicationTest, NavigationTestSimulator) was built and run against `sightline robot
serve --dialect brp2013`; docs/robot-link.md says with what result. These scripts stand for it here.
"""

from collections.abc import Iterable

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.robot.rig import CLIENT, IMAGED, ROBOT, SETUP, Rig, wire

from sightline.rehearsal.operation import own_frames
from sightline.robot.control.insertion import Setup
from sightline.robot.control.states import State
from sightline.robot.igtl import Message, Status, String, Transform
from sightline.robot.link.outgoing import BRP2013
from sightline.robot.plant import CYCLE_S

POSE = np.eye(4)  # registration and target alike
SETUP_2013 = Setup(SETUP.side, SETUP.frame_serial, into_bone=False, frames=own_frames(ROBOT, IMAGED))
ONES = np.vstack([np.ones((3, 4)), [0.0, 0.0, 0.0, 1.0]])


def far(z_mm: float) -> np.ndarray:
    pose = POSE.copy()
    pose[2, 3] = z_mm
    return pose


def answers(text: str, code: int | None = 1) -> list:
    """ACK, CURRENT_STATUS naming what was commanded, and a STATUS of that name unless there is none."""
    said = [("ACK", text), ("CURRENT_STATUS", 1, text)]
    return said if code is None else [*said, (text, code)]


BEGIN = [("START_UP", answers("START_UP")), ("PLANNING", answers("PLANNING", None))]
CALIBRATION = [*BEGIN, ("CALIBRATION", answers("CALIBRATION", None))]
REGISTERED = [*CALIBRATION, (("CLB", POSE), ["ACK", ("CALIBRATION", 1)])]
TARGETING = [*REGISTERED, ("TARGETING", answers("TARGETING"))]
ARRIVED = [
    *TARGETING,
    (("TGT", POSE), ["ACK", ("TARGET", 1), "TARGET"]),
    ("MOVE_TO_TARGET", [*answers("MOVE_TO_TARGET"), "CURRENT_POSITION"]),
    ("MANUAL", answers("MANUAL")),
]
TESTS = {
    1: [*ARRIVED, ("STOP", answers("STOP")), ("EMERGENCY", answers("EMERGENCY"))],
    3: [*CALIBRATION, (("CLB", ONES), ["ACK", ("CALIBRATION", 10)])],
    4: [*CALIBRATION, ("TARGETING", answers("TARGETING", 13))],
    5: [*TARGETING, (("TGT", far(5000.0)), ["ACK", ("TARGET", 10)])],
    8: [*TARGETING, ("MOVE_TO_TARGET", answers("MOVE_TO_TARGET", 13))],
    9: [*ARRIVED, ("MOVE_TO_TARGET", answers("MOVE_TO_TARGET", 13))],
}


def talk(rig: Rig, script: Iterable) -> None:
    for number, (sent, wanted) in enumerate(script):
        if isinstance(sent, str):
            said = rig.send(f"CMD_{number:04d}", String(sent))
        else:
            said = rig.send(f"{sent[0]}_{number:04d}", Transform(sent[1]))
        for _ in range(round(60 / CYCLE_S)):
            if len(said) >= len(wanted):
                break
            said += rig.run(CYCLE_S)
        said += rig.run(0.3)
        assert [_seen(message, want) for message, want in zip(said, wanted, strict=True)] == wanted, sent


def _seen(message: Message, wanted) -> tuple | str:
    """As much of a message as is wanted of it."""
    match message.body:
        case String(text):
            return message.device_name.split("_")[0], text
        case Status(code, error_name):
            return (message.device_name, code, error_name)[: len(wanted)]
        case _:
            return message.device_name.split("_0")[0]


@pytest.mark.parametrize("number", TESTS)
def test_scripts_of_2013(number):
    talk(Rig(setup=SETUP_2013, dialect=BRP2013), TESTS[number])
    with pytest.raises((AssertionError, ValueError)):
        talk(Rig(), TESTS[number])  # our own dialect is another


def test_positions_are_told_in_the_frame_that_the_registration_leads_to():
    rig = Rig(setup=SETUP_2013, dialect=BRP2013)
    talk(rig, ARRIVED)
    (said,) = rig.send("CURRENT_POSITION", String("CURRENT_POSITION"))
    pose = said.body.rigid()
    # It stands 20 mm before the entry point of a wire of 95 mm that ends at the origin, along z.
    assert np.allclose(pose.translation, [0.0, 0.0, -115.0], atol=0.05)
    assert np.allclose(pose.rotation.apply([0.0, 0.0, 1.0]), [0.0, 0.0, 1.0], atol=1e-3)


def test_others_hear_of_an_emergency_as_ever():
    rig = Rig(setup=SETUP_2013, dialect=BRP2013)
    rig.dialogue.joined(2)
    rig.command("START_UP")
    rig.command("EMERGENCY")
    rig.now_s += CYCLE_S
    told = {
        outgoing.client: outgoing.message.body.code
        for outgoing in rig.dialogue.cycle(rig.now_s)
        if outgoing.message.device_name == "EMERGENCY"
    }
    assert told == {CLIENT: 1, 2: 3}


def test_a_client_of_2013_hears_from_ours_too_only_what_it_knows():
    rig = Rig()
    rig.reach(State.CALIBRATION)
    rig.go(("CLB", "TARGETING"))
    end = wire() * RigidTransform.from_translation([0.0, 0.0, 50.0])  # a bare target is a wire of 95 mm
    said = rig.send("TGT_1", Transform.of(end))
    assert [message.device_name for message in said] == ["ACK_1", "TARGET", "TARGET", "REACHABLE_TARGET"]
    assert said[1].body.code == 1
    said += rig.command("MOVE_TO_TARGET") + rig.run_until(State.ALIGNED)
    assert {message.version for message in said} == {1}
    assert {message.type_name for message in said} == {"STRING", "STATUS", "TRANSFORM"}
    assert said[-1].body.rigid().translation == pytest.approx(end.apply([0.0, 0.0, -115.0]), abs=0.05)
