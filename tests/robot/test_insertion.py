"""Limits by which a target or a registration is refused: just inside it is taken, just beyond it is not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.robot.rig import END_MM, ENTRY_MM, ROBOT, SETUP, T_MCS_CFCS, metadata, wire

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.control import insertion
from sightline.robot.control.insertion import Insertion, LinkRegistration, read_registration, read_target
from sightline.robot.igtl import Message, Transform
from sightline.robot.kinematics.reach import Surroundings

ALONG = (END_MM - ENTRY_MM) / np.linalg.norm(END_MM - ENTRY_MM)
LENGTH_MM = 30.0
NOW_S = 5.0
FINE = 1e-3  # how near a limit both sides of it are asked, of mm and s; messages carry 32 bits


def read(end_mm: np.ndarray = END_MM, said: dict[str, str] | None = None) -> Insertion:
    """A target whose tip ends there; `said`: of its plan, or a bare one. The registration puts the frame's origin where
    it brings the target into reach, whatever its coordinates."""
    here = RigidTransform.from_translation(T_MCS_CFCS.rotation.apply(END_MM - end_mm))
    registration = LinkRegistration(here * T_MCS_CFCS, 0)
    pose = wire(end_mm - LENGTH_MM * ALONG, end_mm)
    message = Message(Transform.of(pose), "TGT_1", version=2, metadata={} if said is None else metadata(**said))
    return read_target(message, registration, ROBOT, SETUP, NOW_S)


def plan(*, length_mm: float = LENGTH_MM, slack_mm: float = 1.0, valid_s: float = 500.0) -> dict[str, str]:
    return {"length_mm": repr(length_mm), "depth_limit_mm": repr(length_mm + slack_mm), "valid_s": repr(valid_s)}


@pytest.mark.parametrize(
    ("inside", "beyond", "why"),
    [
        (plan(length_mm=5.0), plan(length_mm=5.0 - FINE), "give no direction"),
        (plan(slack_mm=0.2 + FINE), plan(slack_mm=0.2 - FINE), "comes within 0.2 mm of its limit"),
        (plan(slack_mm=30.0 - FINE), plan(slack_mm=30.0 + FINE), "where no bone is"),
        (plan(valid_s=600.0), plan(valid_s=600.0 + FINE), "claims to be valid"),
        (plan(valid_s=FINE), plan(valid_s=0.0), "has expired"),
    ],
    ids=["length", "least slack", "most slack", "longest", "shortest"],
)
def test_a_plan_s_limits(inside, beyond, why):
    assert read(said=inside).expires_s == NOW_S + float(inside["valid_s"])
    with pytest.raises(RobotRefusedError, match=why):
        read(said=beyond)


def at(translation_mm, matrix=None) -> np.ndarray:
    pose = (np.eye(4) if matrix is None else matrix).copy()
    pose[:3, 3] = translation_mm
    return pose


def taken(pose: RigidTransform | np.ndarray, said: dict[str, str] | None = None, **times) -> Insertion:
    matrix = pose.as_matrix() if isinstance(pose, RigidTransform) else pose
    message = Message(
        Transform(matrix), "TGT_1", times.get("sent", 0), 2, metadata=metadata() if said is None else said
    )
    return read_target(message, LinkRegistration(T_MCS_CFCS, times.get("registered", 0)), ROBOT, SETUP, NOW_S)


@pytest.mark.parametrize(
    ("pose", "said", "why"),
    [
        (wire(ENTRY_MM + 200, END_MM + 200), {}, "out of reach"),
        (wire(END_MM, ENTRY_MM), {}, "out of reach"),
        (wire(), {"coordinates": "MCS"}, "in the frame 'MCS'"),
        (wire(), {"coordinates": ""}, "in the frame ''"),
        (wire(), {"units": "m"}, "in 'm'"),
        (wire(), {"length_mm": "0"}, "no direction"),
        (wire(), {"length_mm": "nan"}, "no number"),
        (wire(), {"length_mm": "eighty"}, "no number"),
        (wire(), {"length_mm": "200", "depth_limit_mm": "201"}, "too near|out of reach|feed ends"),
        (wire(), {"depth_limit_mm": "30"}, "of its limit of 30.0 mm"),
        (wire(), {"go": "no"}, "checks of the plan failed"),
        (wire(), {"go": "maybe"}, "'yes' or 'no'"),
        (wire(), {"side": "left"}, "side is 'left'"),
        (wire(), {"side": "middle"}, "side"),
        (wire(), {"frame_serial": "SN-8"}, "frame serial is 'SN-8'"),
        (wire(), {"frame": "block60/SN-7#2"}, "frame file is 'block60/SN-7#2'"),
        (wire(), {"valid_s": "-3"}, "expired"),
        (at(END_MM, np.diag([2.0, 2.0, 2.0, 1.0])), {}, "no rigid motion"),
        (at(END_MM, np.diag([-1.0, 1.0, 1.0, 1.0])), {}, "left-handed"),
        (at([np.nan, 0, 0]), {}, "not finite"),
    ],
)
def test_targets_that_must_not_be_drilled_are_refused_with_the_reason(pose, said, why):
    with pytest.raises(RobotRefusedError, match=why):
        taken(pose, metadata(**said))


def test_a_plan_states_everything_and_is_not_older_than_the_registration():
    for missing in contract.PLAN_KEYS[1:]:
        with pytest.raises(RobotRefusedError, match=f"does not state {missing}"):
            taken(wire(), {key: value for key, value in metadata().items() if key != missing})
    assert taken(wire(), sent=50, registered=50).identity is not None
    with pytest.raises(RobotRefusedError, match="older than the registration"):
        taken(wire(), sent=49, registered=50)


@pytest.mark.parametrize(
    ("pose", "why"),
    [(at([300, 200, -260], np.diag([2.0, 2.0, 2.0, 1.0])), "no rigid motion"), (at([np.inf, 0, 0]), "not finite")],
)
def test_registrations_that_are_none_are_refused(pose, why):
    with pytest.raises(RobotRefusedError, match=why):
        read_registration(Message(Transform(pose), "CLB_1"), SETUP)


def test_a_target_in_metres_lies_within_a_millimetre_of_the_origin():
    aside = np.array([0.6, 0.0, 0.8])
    assert read((1.0 + FINE) * aside).end_mm == pytest.approx(T_MCS_CFCS.apply(END_MM), abs=1e-4)
    with pytest.raises(RobotRefusedError, match="looks like metres"):
        read((1.0 - FINE) * aside)


def test_a_bare_target_is_a_wire_of_95_mm_and_a_millimetre_more_at_most():
    bare = read(END_MM + 40.0 * ALONG)
    assert bare.length_mm == pytest.approx(95.0, abs=1e-6)
    assert bare.depth_limit_mm == pytest.approx(96.0, abs=1e-9)
    assert bare.expires_s == NOW_S + 600.0
    assert bare.identity is None


def test_a_registration_in_metres_puts_the_base_within_ten_millimetres():
    def registration(distance_mm: float) -> LinkRegistration:
        pose = RigidTransform.from_translation([0.0, distance_mm, 0.0])
        return read_registration(Message(Transform.of(pose), "CLB_1"), SETUP)

    assert registration(10.0 + FINE).T_mcs_cfcs.translation == pytest.approx([0.0, -10.0 - FINE, 0.0], abs=1e-5)
    with pytest.raises(RobotRefusedError, match="looks like metres"):
        registration(10.0 - FINE)


def test_the_collision_check_has_the_patient_where_the_hip_lies_in_the_frames_coordinates(monkeypatch):
    """At a block's place beside the hip; a Γ frame's origin is the hip."""
    seen = []
    monkeypatch.setattr(insertion, "hip_surroundings", lambda pose, *_, **__: seen.append(pose) or Surroundings(()))
    known = read(END_MM)
    for hip_mm in ((0.0, 0.0, 0.0), (2.0, -76.8, -22.4)):
        known.cleared(ROBOT.manipulator, known.q, replace(SETUP, hip_mm=hip_mm))
        assert np.allclose(seen[-1].translation, known.T_mcs_cfcs.apply(hip_mm), atol=1e-9)
        assert np.allclose(seen[-1].rotation.as_matrix(), known.T_mcs_cfcs.rotation.as_matrix(), atol=1e-12)
