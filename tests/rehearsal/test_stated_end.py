"""The robot's stated end error against drilled ends: drawn errors of plan, robot and contact, and the twin's drill."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.robot.test_target import IDENTITY

from sightline.common.checks import Limits
from sightline.rehearsal.operation import calibrated_robot, drawn_robot, registered
from sightline.robot.kinematics.designs import FEED, imaging_yaw
from sightline.robot.kinematics.target import (
    CONTACT_LEAD_MM,
    CONTACT_SD_MM,
    CONTACT_SHIFT_SD_MM,
    SKIVING_RAD,
    DepthZero,
    RobotTarget,
    robot_target,
)

WIRE_MM = np.array([[34.7, 31.2, -4.3], [-25.4, -31.8, 6.9]])
PLAN_SD_MM = 0.15  # per axis of entry and end, as plans by 0.5 px state
ROBOT = calibrated_robot()


def target_for(rng: np.random.Generator, imaged: np.ndarray, wire_mm: np.ndarray, now_s: float = 0.0) -> RobotTarget:
    planned = wire_mm + PLAN_SD_MM * rng.standard_normal((2, 3))
    budget = {"planning": PLAN_SD_MM**2 * np.eye(6)}
    return robot_target(IDENTITY, planned, budget, registered(ROBOT, imaged, now_s), Limits())


def end_error_mm(rng: np.random.Generator) -> tuple[np.ndarray, RobotTarget]:
    """Return where a drilled tip ends from the true end point, MCS: the controller's own correction by contact."""

    def stood(q: np.ndarray) -> tuple[np.ndarray, RigidTransform]:
        joints = q + (ROBOT.manipulator.resolution * rng.uniform(-1, 1, 5) + play * rng.uniform(-1, 1, 5)) / 2
        return joints, RigidTransform.from_exp_coords(ROBOT.compliance_sd * rng.standard_normal(6))

    play = ROBOT.manipulator.backlash
    true, imaged = drawn_robot(ROBOT, imaging_yaw("right"), rng)
    target = target_for(rng, imaged, WIRE_MM)
    joints, bent = stood(imaged)
    entry, end = (true.T_mcs_flange(joints) * bent * true.T_flange_cfcs).apply(WIRE_MM)
    joints, bent = stood(target.q)
    tool = true.T_mcs_flange(joints) * bent * true.T_flange_tool
    along = tool.rotation.apply([0.0, 0.0, 1.0])

    def tip(feed_mm: float) -> np.ndarray:  # the same play at every feed
        return tool.translation + (feed_mm + joints[FEED] - target.q[FEED]) * along

    touched = target.q[FEED] - (tip(float(target.q[FEED])) - entry) @ along
    touched += -CONTACT_LEAD_MM + CONTACT_SD_MM * rng.standard_normal()
    zero = DepthZero(float(target.q[FEED])).corrected(float(touched), -CONTACT_LEAD_MM, CONTACT_SD_MM)
    skived = SKIVING_RAD * target.length_mm * rng.standard_normal(3)
    return tip(zero.feed_mm + target.length_mm) + skived - (skived @ along) * along - end, target


@pytest.mark.slow
def test_ends_lie_within_the_stated_bound_with_the_shift_by_contact():
    """500 drawn drillings. Without the shift by contact the error along the wire is a third beyond its stated one."""
    rng = np.random.default_rng(31)
    inside, stated, bare = [], [], []
    for _ in range(500):
        off, target = end_error_mm(rng)
        inside.append(np.linalg.norm(off) <= target.end_error_95_mm)
        along = (target.end_mm - target.entry_mm) / target.length_mm
        variance = along @ target.covariance_mm2[3:, 3:] @ along
        stated.append(off @ along / np.sqrt(variance))
        bare.append(off @ along / np.sqrt(variance - np.trace(target.budget_mm2["depth_zero"])))
    # Three standard deviations of 500 trials are 3 %, of an rms 10 %.
    assert 0.92 < np.mean(inside) < 0.98
    assert 0.88 < np.sqrt(np.mean(np.square(stated))) < 1.1
    assert np.sqrt(np.mean(np.square(bare))) > 1.15


def test_a_wire_past_its_end_point_has_no_error_of_depth():
    """Both bounds are the same but for the feed's own play."""
    rng = np.random.default_rng(32)
    _, imaged = drawn_robot(ROBOT, imaging_yaw("right"), rng)
    budget = {"planning": PLAN_SD_MM**2 * np.eye(6)}
    ending, passing = (
        robot_target(IDENTITY, WIRE_MM, budget, registered(ROBOT, imaged, 0.0), Limits(beyond_mm=beyond))
        for beyond in (0.0, 15.0)
    )
    added = ending.covariance_mm2 - passing.covariance_mm2
    along = (ending.end_mm - ending.entry_mm) / ending.length_mm
    np.testing.assert_allclose(added[3:, 3:], np.trace(added) * np.outer(along, along), atol=1e-9)
    assert np.abs(added[:3]).max() < 1e-9
    assert 0.1**2 < np.trace(added) < CONTACT_SHIFT_SD_MM**2 < 0.25**2
