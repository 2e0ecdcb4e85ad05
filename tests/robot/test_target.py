"""From the poses at two images to a target in MCS; and what must be refused on the way."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.common.checks import Check, Limits
from sightline.common.geometry.lines import unit
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.rehearsal.operation import calibrated_robot
from sightline.robot.kinematics.target import (
    LIFETIME_S,
    PlanIdentity,
    PoseAtImage,
    Registration,
    RobotTarget,
    register,
    robot_target,
)
from sightline.robot.link.client import plan_metadata

Q = np.array([3.0, -5.0, np.pi / 4, 0.0, 0.0])
IDENTITY = PlanIdentity("plan-1", "right", "SN-7", go=True)
POINTS = np.array([[35.0, 31.0, -4.0], [-25.0, -32.0, 7.0]])
PLANNED = {"frame": 0.01 * np.eye(6), "picks": 0.02 * np.eye(6)}


def registered(q: np.ndarray = Q, second: np.ndarray = Q) -> Registration:
    poses = {"pa": PoseAtImage(q, 10.02, 10.0), "lateral": PoseAtImage(second, 40.0, 39.95)}
    return register(calibrated_robot(), poses)


def aimed(
    identity: PlanIdentity = IDENTITY, points: np.ndarray = POINTS, scale: float = 1.0, limits: Limits | None = None
) -> RobotTarget:
    budget = {name: scale * part for name, part in PLANNED.items()}
    return robot_target(identity, points, budget, registered(), limits or Limits())


def test_the_frame_stands_where_the_flange_holds_it():
    found = registered()
    manipulator = found.robot.manipulator
    assert np.allclose(found.T_mcs_cfcs.as_matrix(), manipulator.T_mcs_cfcs(Q).as_matrix(), atol=1e-12)
    assert set(found.of_view) == {"pa", "lateral"}
    assert found.imaged_s == 39.95


def test_the_last_digit_of_an_encoder_is_no_movement():
    second = Q + calibrated_robot().manipulator.resolution
    middle = registered(second=second).T_mcs_cfcs.translation
    assert np.linalg.norm(middle - registered().T_mcs_cfcs.translation) < 0.05


@pytest.mark.parametrize("joint", range(4))
def test_a_robot_that_moved_between_the_images_is_refused(joint):
    second = Q.copy()
    second[joint] += (0.15, 0.15, 0.001, 0.001)[joint]
    with pytest.raises(RobotRefusedError, match=r"acquire both images again: it moved between the images"):
        registered(second=second)


def test_stale_foreign_and_broken_poses_are_refused():
    robot = calibrated_robot()
    with pytest.raises(RobotRefusedError, match=r"acquire the pa image again: .* read 0\.50 s from it"):
        register(robot, {"pa": PoseAtImage(Q, 10.0, 10.5)})
    with pytest.raises(RobotRefusedError, match=r"home the robot.*at the pa image lift is at 503\.0 mm"):
        register(robot, {"pa": PoseAtImage(Q + 500.0, 10.0, 10.0)})
    for q, finite in ((Q[:4], 4), (Q * np.nan, 0)):
        with pytest.raises(UnusableInputError, match=rf"has {finite} finite joint values \(5 needed\)"):
            register(robot, {"pa": PoseAtImage(q, 10.0, 10.0)})
    with pytest.raises(UnusableInputError, match="time of its pose is not finite"):
        register(robot, {"pa": PoseAtImage(Q, 10.0, np.nan)})
    with pytest.raises(UnusableInputError, match="each image"):
        register(robot, {})


def test_the_wire_of_the_target_lies_on_the_trajectory():
    target = aimed()
    manipulator = target.registration.robot.manipulator
    entry, end = target.registration.T_mcs_cfcs.apply(POINTS)
    assert np.allclose(manipulator.T_mcs_tool(target.q).translation, entry, atol=1e-9)
    fed = target.q + np.array([0, 0, 0, 0, target.length_mm])
    assert np.allclose(manipulator.T_mcs_tool(fed).translation, end, atol=1e-9)
    assert np.allclose(target.T_cfcs_wire.translation, POINTS[1], atol=1e-9)
    assert np.allclose(target.T_cfcs_wire.rotation.apply([0, 0, 1]), np.diff(POINTS, axis=0)[0] / target.length_mm)


def test_errors_of_planning_and_robot_add_up():
    target = aimed()
    assert set(target.budget_mm2) == {
        "frame", "picks", "kinematics", "hand_eye", "drill_axis", "encoders", "compliance", "skiving",
        "depth_zero",
    }  # fmt: skip
    assert np.allclose(target.covariance_mm2, np.sum(list(target.budget_mm2.values()), axis=0))
    turned = target.registration.T_mcs_cfcs.rotation.as_matrix()
    assert np.allclose(target.budget_mm2["picks"][:3, :3], 0.02 * turned @ turned.T)
    assert target.entry_error_95_mm > 0.3 > 0.1
    assert 0 < target.direction_error_95_rad < np.deg2rad(1.0)


def test_a_target_is_refused_by_its_errors_its_plan_and_its_age():
    good = aimed()
    good.refuse_unfit(39.95 + LIFETIME_S - 1)
    with pytest.raises(RobotRefusedError, match=r"expired 1 s ago"):
        good.refuse_unfit(39.95 + LIFETIME_S + 1)
    with pytest.raises(RobotRefusedError, match="expired"):
        good.refuse_unfit(np.nan)
    good.refuse_unfit(39.95)
    with pytest.raises(RobotRefusedError, match=r"dated 60 s in the future: the clock was set back"):
        good.refuse_unfit(39.95 - 60.0)
    with pytest.raises(RobotRefusedError, match="NO-GO"):
        aimed(replace(IDENTITY, go=False)).refuse_unfit(40.0)
    with pytest.raises(RobotRefusedError, match=r"drilled tip, .* is above its limit of .*largest share: picks"):
        aimed(scale=20.0).refuse_unfit(40.0)


def test_the_plans_limits_decide_and_its_depth_is_drilled():
    plain, strict, loose = (
        {check.name: check for check in aimed(limits=limits).checks}
        for limits in (Limits(), Limits(0.2, 1e-4), Limits(0.9, 0.2))
    )
    for name, limit in (("wire entry error", 1.0), ("wire end error", 1.0), ("wire direction error", 0.6)):
        assert plain[name].limit == pytest.approx(limit)
        assert not strict[name].passed
    assert (strict["wire end error"].limit, loose["wire end error"].limit) == (0.2, 0.9)
    assert loose["wire direction error"].limit == pytest.approx(np.rad2deg(0.2))
    target = aimed(limits=Limits(beyond_mm=7.5))
    assert target.depth_mm == pytest.approx(target.length_mm + 7.5)
    past = POINTS[1] + 7.5 * np.diff(POINTS, axis=0)[0] / target.length_mm
    assert np.allclose(target.T_cfcs_wire.translation, past, atol=1e-9)
    said = plan_metadata(target, 40.0, 99.0)
    assert float(said["length_mm"]) == pytest.approx(target.depth_mm)
    assert [float(said[key]) for key in ("position_limit_mm", "direction_limit_deg", "beyond_mm")] == pytest.approx(
        [1.0, 0.6, 7.5]
    )
    with pytest.raises(RobotRefusedError, match="feed ends"):
        aimed(limits=Limits(beyond_mm=200.0))


def test_a_drill_through_walls_must_pass_both_with_97_percent():
    through = Limits(0.75, 0.1, beyond_mm=15.0, before_mm=30.0)
    hole = np.stack([POINTS[0], POINTS[0] + 11.0 * unit(POINTS[1] - POINTS[0])])

    def checked(scale: float, limits: Limits = through) -> tuple[RobotTarget, dict[str, Check]]:
        target = aimed(points=hole, scale=scale, limits=limits)
        return target, {check.name: check for check in target.checks}

    # A program that judges each end by its 95 % error accepts the second; errors along the drill would refuse the last.
    refused = []
    for scale in np.linspace(0.1, 3.0, 30):
        target, checks = checked(float(scale))
        values, vectors = np.linalg.eigh(target.covariance_mm2)
        drawn = (vectors * np.sqrt(np.clip(values, 0.0, None))) @ np.random.default_rng(5).standard_normal((6, 200_000))
        along = unit(target.end_mm - target.entry_mm)
        both = drawn.reshape(2, 3, -1)
        off = np.linalg.norm(both - along[:, None] * np.einsum("i,kin->kn", along, both)[:, None], axis=1)
        passes = 100 * float((off < 0.75).all(axis=0).mean())
        check = checks["wire through both walls"]
        assert check.figure is not None
        assert check.figure == pytest.approx(passes, abs=0.2)  # 5 s.d. of the share of 200,000 draws
        assert check.passed == (check.figure >= 97.0)
        refused += [not check.passed and checks["wire entry error"].passed and checks["wire end error"].passed]
        if not check.passed:
            with pytest.raises(
                RobotRefusedError, match=r"passes both walls with a probability of 9\d\.\d % \(at least 97"
            ):
                target.refuse_unfit(40.0)
            break
    assert any(refused)  # by this check alone
    assert "wire through both walls" not in checked(1.0, Limits(beyond_mm=15.0))[1]


def test_lines_that_no_wire_can_follow_are_refused():
    with pytest.raises(RobotRefusedError, match="same"):
        aimed(points=POINTS[[0, 0]])
    with pytest.raises(RobotRefusedError, match="out of reach"):
        aimed(points=POINTS + 200.0)
    with pytest.raises(RobotRefusedError, match="out of reach"):
        aimed(points=POINTS[::-1])
    with pytest.raises(RobotRefusedError, match="feed ends"):
        aimed(points=np.stack([POINTS[0], POINTS[0] + 4 * (POINTS[1] - POINTS[0])]))
    with pytest.raises(UnusableInputError, match="finite"):
        aimed(points=POINTS * np.nan)
    with pytest.raises(RobotRefusedError, match="error is unknown"):
        robot_target(IDENTITY, POINTS, None, registered(), Limits())
    with pytest.raises(UnusableInputError, match="side"):
        PlanIdentity("plan-1", "middle", "SN-7", go=True)
