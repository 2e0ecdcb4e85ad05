"""Arms of six and seven axes: kinematics against MuJoCo, the guide held while a person drills, model files."""

import re

import numpy as np
import pytest
from rig import END_MM, ENTRY_MM, IdealPlant, Rig, code, metadata, wire
from scipy.spatial.transform import RigidTransform, Rotation
from tests.robot.arms import ARM_SETUP, SEVEN, SIX, FollowingArm, Streamed, at_images, calibrated, longer

from sightline.common.checks import Limits, failed
from sightline.common.geometry.rigid import displacement
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.rehearsal.operation import calibrated_robot, confirmed_setup, joints_at_images
from sightline.robot import contract
from sightline.robot.control.insertion import Insertion, LinkRegistration, read_target
from sightline.robot.control.states import State
from sightline.robot.igtl import Message, Transform
from sightline.robot.kinematics.calibrated import MACHINED_SD, calibrate_axes
from sightline.robot.kinematics.designs import imaging_yaw, nominal_manipulator, six_axis
from sightline.robot.kinematics.manipulator import MIN_SINGULAR
from sightline.robot.kinematics.model_file import read_arm
from sightline.robot.kinematics.reach import Obstacle, Surroundings, check_reach, hip_surroundings
from sightline.robot.kinematics.target import STANDOFF_MM, PlanIdentity, PoseAtImage, register, robot_target
from sightline.robot.plant import CYCLE_S


@pytest.mark.parametrize("arm", [SIX, SEVEN, six_axis("left")])
def test_a_line_that_is_reachable_is_found_within_the_limits(arm):
    """Lines where random joints lay the wire, away from singular positions."""
    rng, found = np.random.default_rng(7), 0
    for q in rng.uniform(0.9 * arm.lower + 0.1 * arm.upper, 0.1 * arm.lower + 0.9 * arm.upper, (40, arm.count)):
        if arm.singular(q[None])[0] < 5 * MIN_SINGULAR:
            continue
        tool = arm.T_mcs_tool(q)
        entry, end = tool.apply([[0.0, 0.0, 30.0], [0.0, 0.0, 90.0]])
        joints = arm.inverse(entry, end, -30.0)
        laid = arm.T_mcs_tool(joints)
        assert np.abs(laid.translation - tool.translation).max() < 1e-6
        assert np.abs((laid.rotation.as_matrix() - tool.rotation.as_matrix())[:, 2]).max() < 1e-9
        assert not arm.beyond_limits(joints).any()
        found += 1
    assert found > 25


def test_a_line_that_no_joints_reach_is_refused():
    with pytest.raises(RobotRefusedError, match="out of reach"):
        SIX.inverse(np.array([1500.0, 0.0, 0.0]), np.array([1600.0, 0.0, 0.0]))


def test_the_solution_near_a_position_is_that_position():
    q = at_images(SEVEN)
    near = SEVEN.inverse(*SEVEN.T_mcs_tool(q).apply([[0.0, 0.0, 0.0], [0.0, 0.0, 50.0]]), near=q)
    assert np.abs(near - q).max() < np.deg2rad(30.0)


def test_a_guide_is_drawn_back_straight():
    q = at_images(SIX)
    back = SIX.follow_line(q, -np.arange(10.0, 61.0, 10.0))
    tool = SIX.T_mcs_tool(q).inv() * SIX.T_mcs_tool(back)
    assert np.allclose(tool.translation, [[0.0, 0.0, -mm] for mm in range(10, 61, 10)], atol=1e-9)


def test_what_is_in_the_way_is_avoided_by_a_rotation_about_the_wire():
    """Lines some degrees from a typical wire in a hip: one whose nearest position is clear stays, one whose nearest is
    not is laid the same otherwise, and one that no rotation frees is refused."""
    block = Frame.load("block60")
    robot, setup = calibrated_robot("right", block, arm="seven-axis"), confirmed_setup(block, "right", "SN-7")
    arm, hip = robot.manipulator, np.array(setup.hip_mm)
    q = joints_at_images(arm, imaging_yaw("right"))
    stood = LinkRegistration(arm.T_mcs_cfcs(q), 0)

    def insertion(tilt_deg: float) -> Insertion:
        points = Rotation.from_euler("z", tilt_deg, degrees=True).apply([[36.0, 28.0, -12.0], [-32.0, -40.0, 4.0]])
        pose = Transform.of(wire(*(points + hip)))
        return read_target(Message(pose, "TGT_1"), stood, robot, setup, 0.0, near=q)

    free = insertion(0.0)
    assert free.cleared(arm, q, setup) is free
    blocked = insertion(6.0)
    theatre = hip_surroundings(stood.T_mcs_cfcs * RigidTransform.from_translation(hip), frame_mounted=False)
    cleared = blocked.cleared(arm, q, setup)
    ways = [check_reach(arm, one.waypoints(arm, q), theatre) for one in (blocked, cleared)]
    assert [bool(failed(way)) for way in ways] == [True, False]
    moved = arm.T_mcs_tool(blocked.q).inv() * arm.T_mcs_tool(cleared.q)
    assert np.allclose(moved.translation, 0.0, atol=1e-6)
    assert np.allclose(moved.rotation.as_rotvec()[:2], 0.0, atol=1e-8)
    assert 0.2 < moved.rotation.magnitude() < np.deg2rad(60.1)
    with pytest.raises(RobotRefusedError, match="The link 7 leaves 0 mm to the patient"):
        insertion(12.0).cleared(arm, q, setup)


def test_a_wire_whose_rotation_the_joints_determine_is_not_turned():
    assert not len(nominal_manipulator().turned(np.array([0.0, 0.0, 0.5, 0.1, 20.0])))


@pytest.mark.parametrize("arm", [SIX, SEVEN])
def test_axes_of_any_arm_are_calibrated_with_an_honest_error(arm):
    """Of the flange relative to another pose, as it is used; the nominal axes leave a millimetre."""
    rng, squares = np.random.default_rng(11), []
    places = np.array([[80.0, 10.0, 60.0], [-60.0, 50.0, 20.0], [10.0, -70.0, 90.0]])
    q = np.clip(at_images(arm) + rng.uniform(-0.5, 0.5, (30, arm.count)), arm.lower, arm.upper)
    true = arm.displaced(np.tile(MACHINED_SD, arm.arm_joints) * rng.standard_normal(6 * arm.arm_joints))
    measured = np.stack([true.T_mcs_flange(q).apply(place) for place in places], axis=1)
    found = calibrate_axes(arm, q, measured + 0.03 * rng.standard_normal((30, 3, 3)), 0.03)
    known = found.manipulator
    for here in rng.uniform(-0.4, 0.4, (12, arm.count)) + q[0]:
        moved = [one.T_mcs_flange(q[0]).inv() * one.T_mcs_flange(here) for one in (true, known)]
        error = known.T_mcs_flange(q[0]).rotation.apply(moved[0].translation - moved[1].translation)
        design = displacement(known.T_mcs_flange(here).translation)
        design = design @ (known.axes_jacobian(here) - known.axes_jacobian(q[0]))
        squares.append(error @ np.linalg.solve(design @ found.covariance @ design.T, error) / 3)
        assert np.linalg.norm(error) < 0.2
    assert 0.3 < np.mean(squares) < 2.2  # 36 correlated numbers


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        ("another arm", "against the model of the arm"),
        ("degrees", r"joints in rad and mm, .* at pose 1 joint \d is at"),
        ("order", "against the model of the arm|units and the order"),
        ("one by 5°", "against the model of the arm"),
    ],
)
def test_measurements_of_another_arm_or_other_joints_are_refused(spoil, said):
    rng, places = np.random.default_rng(12), np.array([[80.0, 10.0, 60.0], [-60.0, 50.0, 20.0], [10.0, -70.0, 90.0]])
    true = longer(SIX) if spoil == "another arm" else SIX
    q = at_images(SIX) + rng.uniform(-0.5, 0.5, (20, 6))
    measured = np.stack([true.T_mcs_flange(q).apply(place) for place in places], axis=1)
    calibrate_axes(true, q, measured, 0.03)
    if spoil == "degrees":
        q = np.rad2deg(q)
    elif spoil == "order":
        q = q[:, [0, 2, 1, 3, 4, 5]]
    elif spoil == "one by 5°":
        q[7, 3] += np.deg2rad(5.0)
    with pytest.raises(RobotRefusedError, match=said):
        calibrate_axes(SIX, q, measured, 0.03)


def test_poses_at_the_edge_of_the_workspace_are_refused():
    """Stretched, where the arm is singular, and at a joint's limit."""
    stretched = np.array([0.3, -0.6, 0.0, -0.4, 1.2, 0.2])
    with pytest.raises(RobotRefusedError, match="singular on this line"):
        SIX.follow_line(stretched, np.array([-300.0, 300.0]))
    with pytest.raises(RobotRefusedError, match=r"joint 1 would go to 18\d\.\d°.* beyond its limit of 180\.0°"):
        SIX.follow_line(at_images(SIX), np.arange(10.0, 800.0, 10.0))


def test_a_guide_meets_the_table_and_may_touch_the_patient():
    q = at_images(SIX)
    at_mouth = SIX.T_mcs_tool(q) * RigidTransform.from_translation([0.0, 0.0, 12.0])
    for name in ("table", "patient"):
        around = Surroundings((Obstacle(name, at_mouth, np.array([8.0, 8.0, 2.0])),), frame_mounted=False)
        found = check_reach(SIX, q[None], around)[1]
        assert found.name == f"{name} clearance"
        assert found.passed == (name == "patient")
        assert found.sentence.startswith("The guide leaves 0 mm") == (name == "table")


def test_the_target_of_an_arm_without_feed_states_sleeve_and_depth():
    robot, q = calibrated(SIX), at_images(SIX)
    stood = register(robot, {view: PoseAtImage(q, 5.0, 5.0) for view in ("pa", "lateral")})
    identity = PlanIdentity("plan-1", "right", "SN-7", True)
    target = robot_target(identity, np.stack([ENTRY_MM, END_MM]), {"planning": 1e-3 * np.eye(6)}, stood, Limits())
    mouth = SIX.T_mcs_tool(target.q)
    along = (target.end_mm - target.entry_mm) / target.length_mm
    assert np.allclose(mouth.translation, target.entry_mm - STANDOFF_MM * along, atol=1e-6)
    assert np.allclose(target.T_cfcs_wire.translation, END_MM, atol=1e-6)
    assert target.pushed_mm == pytest.approx(STANDOFF_MM + target.length_mm)
    assert np.sqrt(along @ target.budget_mm2["sleeve"][3:, 3:] @ along) == pytest.approx(0.3)
    # Play of 0.05 mm at both ends of a guide of 120 mm, uniform, carried 20 mm on: 0.0144 hypot(1 + 1/6, 1/6).
    across = np.cross(along, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    assert np.sqrt(across @ target.budget_mm2["sleeve"][:3, :3] @ across) == pytest.approx(0.0170, abs=1e-4)


def test_the_stated_error_holds_however_the_arm_rotates_about_the_wire():
    robot = calibrated_robot("right", Frame.load("block60"), arm="six-axis")
    arm, q = robot.manipulator, joints_at_images(robot.manipulator, imaging_yaw("right"))
    stood = register(robot, {view: PoseAtImage(q, 5.0, 5.0) for view in ("pa", "lateral")})
    identity = PlanIdentity("plan-1", "right", "SN-7", True)
    target = robot_target(identity, np.stack([ENTRY_MM, END_MM]), {"planning": 1e-3 * np.eye(6)}, stood, Limits())
    points = np.stack([target.entry_mm, target.end_mm])
    shares = [robot.wire_against_frame(q, joints, points) for joints in (target.q, *arm.turned(target.q))]
    traces = [np.trace(sum(share.values())) for share in shares]
    assert max(traces) > 1.01 * traces[0]
    assert sum(np.trace(target.budget_mm2[name]) for name in shares[0]) == pytest.approx(max(traces))


def rig_with(plant, q: np.ndarray) -> Rig:
    """A six-axis arm at the joints `q` (6,) that has its target, the C-arm drawn back."""
    rig = Rig(moved=plant, setup=ARM_SETUP, robot=calibrated(SIX))
    for step in ("START_UP", "CALIBRATION"):
        rig.command(step)
    assert code(rig.send("CLB_1", Transform.of(SIX.T_mcs_cfcs(q).inv()))) == 1
    rig.command("TARGETING")
    said = rig.send("TGT_1", Transform.of(wire()), version=2, metadata=metadata())
    assert code(said, "TARGET") == 1, said
    return rig


@pytest.fixture
def rig() -> Rig:
    return rig_with(IdealPlant(SIX, at_images(SIX)), at_images(SIX))


def fault(rig: Rig) -> str:
    assert rig.controller.machine.fault is not None
    return rig.controller.machine.fault.text


def off_mm(rig: Rig) -> float:
    off = rig.controller.machine.guide_off
    assert off is not None
    return off[0]


def test_the_guide_is_held_on_the_plan_and_drawn_back(rig):
    assert contract.HAS_GUIDE in rig.dialogue._capability()[1].types
    rig.command("MOVE_TO_TARGET")
    rig.run_until(State.ALIGNED)
    assert off_mm(rig) < 0.02
    said = rig.command("DRILL")
    assert any("no feed" in getattr(message.body, "text", "") for message in said)
    rig.command("GUIDE")
    rig.run(1.0)
    assert rig.state is State.GUIDE
    held = SIX.T_mcs_tool(rig.plant.q)
    rig.command("RETRACT")
    rig.run_until(State.PLANNING)
    moved = (held.inv() * SIX.T_mcs_tool(rig.plant.q)).translation
    assert np.allclose(moved, [0.0, 0.0, -60.0], atol=0.05)


@pytest.mark.parametrize(("push_mm", "state"), [(0.6, State.GUIDE), (1.3, State.EMERGENCY)])
def test_a_guide_that_is_pushed_away_is_told_and_beyond_a_millimetre_a_fault(rig, push_mm, state):
    rig.command("MOVE_TO_TARGET")
    rig.run_until(State.ALIGNED)
    rig.command("GUIDE")
    rig.run(0.1)
    held = SIX.T_mcs_tool(rig.plant.q)
    aside = held.apply([push_mm, 0.0, 0.0])
    rig.plant.q = SIX.inverse(aside, aside + held.apply([0.0, 0.0, 50.0]) - held.translation, near=rig.plant.q)
    rig.run(0.1)
    assert rig.state is state
    if state is State.GUIDE:
        assert off_mm(rig) == pytest.approx(push_mm, abs=0.02)
    else:
        assert "1.3 mm from the plan" in fault(rig)


MODEL = """<mujoco><compiler angle="radian"/><worldbody>
<body name="one" pos="0.1 0 0.2" euler="0.1 0.2 0.3"><joint name="turn" axis="0 0 1" range="-2 2" limited="true"/>
<geom type="capsule" fromto="0 0 0 0 0 .3" size=".05"/>
<body name="two" pos="0 0.02 0.3" euler="1.2 0 0"><joint name="tilt" axis="0 1 0" pos="0 0 .01" {limits}/>
<geom type="box" size=".05 .04 .2"/>
<body name="three" pos="0 0 .3"><joint name="slide" type="slide" axis="1 0 0" range="-.2 .2" limited="true"/>
<geom type="sphere" size=".03"/><body name="tool0" pos="0 0 .1" euler="0 .3 0"/></body></body></body>
</worldbody></mujoco>"""


def test_an_arm_from_a_file_moves_as_in_mujoco(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    text = MODEL.format(limits='range="-1 2" limited="true"')
    (tmp_path / "arm.xml").write_text(text)
    arm = read_arm(tmp_path / "arm.xml", "tool0")
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for q in np.random.default_rng(3).uniform(arm.lower, arm.upper, (5, 3)):
        data.qpos[:] = q * [1.0, 1.0, 1e-3]
        mujoco.mj_kinematics(model, data)
        flange = arm.T_mcs_flange(q)
        assert np.allclose(flange.translation, 1e3 * data.body("tool0").xpos, atol=1e-9)
        assert np.allclose(flange.rotation.as_matrix().ravel(), data.body("tool0").xmat, atol=1e-12)
    assert arm.joints == ("turn", "tilt", "slide") and np.allclose(arm.upper, [2.0, 2.0, 200.0])
    assert [(part.name, part.joints, round(part.radius_mm)) for part in arm.parts] == [
        ("one", 1, 50),
        ("two", 2, 64),
        ("three", 3, 30),
    ]


@pytest.mark.parametrize(
    ("limits", "flange", "feed", "said"),
    [
        ("", "tool0", None, "'tilt' has no limits"),
        ('range="-1 2" limited="true"', "tool1", None, "no body 'tool1'; it has one, two, three, tool0"),
        ('range="-1 2" limited="true"', "tool0", "tilt", "moves straight"),
        ('range="-1 2" limited="maybe"', "tool0", None, "not a model that MuJoCo reads"),
    ],
)
def test_a_file_that_is_no_arm_is_refused(tmp_path, limits, flange, feed, said):
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(MODEL.format(limits=limits))
    with pytest.raises(UnusableInputError, match=said):
        read_arm(tmp_path / "arm.xml", flange, feed)


def streamed(spoil: str = "") -> tuple[Rig, FollowingArm]:
    """A six-axis arm behind a controller of its own, on its way to its target."""
    q = at_images(SIX)
    arm = FollowingArm(q)
    rig = rig_with(Streamed(arm), q)
    rig.command("MOVE_TO_TARGET")
    rig.run(0.5)
    arm.spoil = spoil
    return rig, arm


def test_an_arm_with_its_own_controller_comes_to_its_target():
    rig, _ = streamed()
    rig.run_until(State.ALIGNED)
    assert off_mm(rig) < 0.05


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        ("frozen", "no sample from the drives"),
        ("NaN", "gives no number"),
        ("fault", "protective stop"),
        ("late by 200 ms", "from where it should be"),
        ("half speed", "from where it should be"),
        ("cut short", "from where it should be"),
        ("overshoots", "is 0.2.* from where it should be"),
        ("refuses", "outside its workspace"),
        ("never stops", "from where it should be|still move"),
    ],
)
def test_a_bad_arm_is_stopped_with_its_cause(spoil, said):
    rig, _ = streamed(spoil)
    rig.run_until(State.EMERGENCY, 10.0)
    assert re.search(said, fault(rig))


def test_an_arm_that_acknowledges_a_stop_and_moves_on_is_a_fault():
    rig, _ = streamed("never stops")
    rig.command("STOP")
    rig.run_until(State.EMERGENCY, 2.0)
    assert "still move" in fault(rig)


def test_a_guide_that_drifts_while_it_is_held_is_a_fault():
    rig, arm = streamed()
    rig.run_until(State.ALIGNED)
    rig.command("GUIDE")
    arm.spoil = "drifts"
    rig.run_until(State.EMERGENCY, 10.0)
    assert "from the plan" in fault(rig)


def test_an_arm_whose_commander_dies_is_at_rest_within_100_ms():
    _, arm = streamed()
    moving = arm.state().encoders
    for _ in range(24):  # nobody commands it any more
        arm.advance(CYCLE_S)
    stood = arm.state().encoders
    assert np.abs(stood - moving).max() > 0.01
    for _ in range(20):
        arm.advance(0.01)
        assert np.abs(arm.state().encoders - stood).max() < 1e-12
