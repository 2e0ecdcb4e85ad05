"""The simulated plant against the closed-form kinematics and against statics worked out by hand."""

import os
import subprocess
import sys
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import SetUpError
from sightline.imaging.volumes.volume import Volume
from sightline.rehearsal.operation import joints_at_images
from sightline.robot.kinematics.designs import FEED, LIFT, TRAVERSE, YAW, nominal_manipulator, seven_axis, six_axis
from sightline.robot.plant import CYCLE_S, WATCHDOG_S, PlantFlag
from sightline.twin.robot.drilling import Bone
from sightline.twin.robot.mjcf import Build, mjcf, units
from sightline.twin.robot.plant import Hand, SimulatedPlant

pytest.importorskip("mujoco")
NOMINAL = nominal_manipulator()
WEIGHTLESS = Build(gravity=(0.0, 0.0, 0.0))
START = np.array([10.0, -20.0, 0.6, 0.1, 100.0])


def plant(robot=NOMINAL, bone=None, build=None, start=START, seed=0) -> SimulatedPlant:
    return SimulatedPlant(robot, bone, np.random.default_rng(seed), start, build)


def driven(one: SimulatedPlant, velocity, seconds: float, *, drill_on: bool = False) -> None:
    """Commanded every cycle, as by a controller that lives."""
    for _ in range(round(seconds / CYCLE_S)):
        one.command(velocity, drill_on)
        one.advance(CYCLE_S)


def displaced(seed):
    return NOMINAL.displaced(np.random.default_rng(seed).uniform(-1, 1, (6, 6)) * np.repeat([3e-3, 1.0], 3))


@pytest.mark.parametrize(
    "robot",
    [
        NOMINAL,
        displaced(1),
        nominal_manipulator("left").displaced(np.full((6, 6), 1e-3)),
        six_axis(),
        seven_axis("left"),
    ],
)
def test_without_springs_mujoco_has_the_closed_form_kinematics(robot):
    mujoco = import_module("mujoco")
    model = mujoco.MjModel.from_xml_string(mjcf(robot, Build.of(robot)))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(2)
    for _ in range(20):
        q = rng.uniform(robot.lower, robot.upper)
        for joint, name in enumerate(robot.joints):
            data.qpos[model.joint(name).qposadr[0]] = q[joint] * units(robot)[joint]
        mujoco.mj_kinematics(model, data)
        for site, pose in (
            ("tool", robot.T_mcs_tool(q)),
            ("flange", robot.T_mcs_flange(q)),
            ("cfcs", robot.T_mcs_cfcs(q)),
        ):
            assert np.abs(data.site(site).xpos * 1e3 - pose.translation).max() < 1e-9
            assert np.abs(data.site(site).xmat.reshape(3, 3) - pose.rotation.as_matrix()).max() < 1e-9


def guiding(robot) -> tuple[SimulatedPlant, RigidTransform]:
    """An arm that holds a guide before a hip, and where the guide truly is."""
    one = plant(robot, start=joints_at_images(robot, np.pi / 4))
    return one, one._body.pose("tool")


def shifted_mm(one: SimulatedPlant, since: RigidTransform) -> float:
    return float(np.linalg.norm(one._body.pose("tool").translation - since.translation))


@pytest.mark.parametrize(("robot", "most_mm"), [(six_axis(), 0.35), (seven_axis(), 0.5)])
def test_a_push_of_20_n_bends_an_arm_and_one_of_60_n_moves_it_away(robot, most_mm):
    one, held = guiding(robot)
    encoders = one.read().encoders
    one.advance(0.2)  # it carries its own weight
    assert np.abs(one.read().encoders - encoders).max() < 2 * robot.resolution[0]
    assert shifted_mm(one, held) < 0.01
    for newtons in (20.0, 60.0):
        one.drill_by_hand(100.0)
        one._hand = replace(one._hand, push_n=np.array([0.0, newtons, 0.0]))
        one.advance(1.5)
        if newtons == 20.0:
            assert 0.1 < shifted_mm(one, held) < most_mm
            one.let_go()
            one.advance(0.5)
            assert shifted_mm(one, held) < 0.1  # up to its play
    before, after = (robot.T_mcs_tool(q).translation for q in (encoders, one.read().encoders))
    assert np.linalg.norm(after - before) > 1.0


def test_a_person_drills_along_the_guide_and_the_wire_stays():
    robot = six_axis()
    one, guide = guiding(robot)
    one.push_n = 0.0
    one.drill_by_hand(1.5)
    goal = one._hand.goal_mm
    one.advance(goal + 0.2)
    wire = guide.inv() * one.true_T_mcs_tool()
    assert wire.translation[2] == pytest.approx(goal, abs=0.01)
    assert np.abs(wire.translation[:2]).max() < 0.05
    assert one.true_wire_mm()[0] == pytest.approx(guide.translation, abs=0.06)
    laid = one.true_T_mcs_tool().translation
    driven(one, np.eye(6)[1] * 0.05, 0.2)
    assert one.true_T_mcs_tool().translation == pytest.approx(laid, abs=1e-12)


def test_the_play_of_a_sleeve_the_push_and_the_read_depth_are_as_stated():
    """Half of 0.05 mm at either end of a guide of 120 mm, uniform; up to 20 N across; 0.3 mm, 1 s.d."""
    rng = np.random.default_rng(3)
    drawn = [Hand.draw(60.0, 120.0, 20.0, rng) for _ in range(400)]
    ends = np.array([hand.T_tool_wire.apply([[0.0, 0.0, 0.0], [0.0, 0.0, -120.0]])[:, :2] for hand in drawn])
    assert 0.024 < np.abs(ends).max() < 0.02501
    assert np.std(ends) == pytest.approx(0.05 / np.sqrt(12), rel=0.05)
    push = np.array([hand.push_n for hand in drawn])
    assert 19.0 < np.linalg.norm(push, axis=1).max() <= 20.0
    assert np.abs(push[:, 2]).max() == 0.0
    assert np.std([hand.goal_mm - 60.0 for hand in drawn]) == pytest.approx(0.3, rel=0.1)


def test_an_arm_of_other_joints_needs_masses():
    five = replace(
        six_axis(),
        has_feed=False,
        **{
            name: getattr(six_axis(), name)[:5]
            for name in (
                "joints",
                "axes",
                "lower",
                "upper",
                "speed",
                "acceleration",
                "resolution",
                "backlash",
                "stiffness",
            )
        },
    )
    with pytest.raises(SetUpError, match="masses"):
        plant(five, start=np.zeros(5))


def test_encoders_count_in_their_resolution():
    one = plant()
    driven(one, np.array([3.0, -2.0, 0.03, 0.02, 4.0]), 1.0)
    counts = one.read().encoders / NOMINAL.resolution
    assert np.allclose(counts, np.round(counts), atol=1e-6)
    assert one.read().time_s == pytest.approx(1.0)


def test_velocities_are_followed_and_kept():
    one = plant(build=WEIGHTLESS)
    before, velocity = one.read().encoders, np.array([5.0, -5.0, 0.05, -0.05, 10.0])
    driven(one, velocity, 0.5)
    after = one.read().encoders
    driven(one, velocity, 1.0)
    assert np.allclose(one.read().encoders - after, velocity, atol=3 * NOMINAL.resolution)
    # It got there with the stated acceleration: half the ramp's time is lost.
    lost = velocity * 0.5 - (after - before)
    assert np.allclose(lost, velocity * np.abs(velocity) / NOMINAL.acceleration / 2, atol=0.02 * np.abs(velocity))


def test_a_velocity_beyond_the_joints_speed_is_cut():
    one = plant(build=WEIGHTLESS, start=np.zeros(5))
    driven(one, 10 * NOMINAL.speed, 0.1)
    first = one.read().encoders
    driven(one, 10 * NOMINAL.speed, 0.5)
    assert np.allclose((one.read().encoders - first) / 0.5, NOMINAL.speed, rtol=0.01)


def test_from_full_speed_a_hold_stops_within_50_ms_and_stays():
    one = plant(start=np.zeros(5))
    driven(one, NOMINAL.speed, 0.5)
    one.hold()
    one.advance(0.045)
    first = one.read().encoders
    one.advance(CYCLE_S)
    slack = 2 * NOMINAL.resolution
    assert (np.abs(one.read().encoders - first) < 0.01 * NOMINAL.speed * CYCLE_S + slack).all()
    one.advance(1.0)
    assert np.allclose(one.read().encoders, first, atol=5 * slack.max())


@pytest.mark.parametrize(("attribute", "value"), [("stop_pressed", True), ("run_held", False)])
def test_the_hardwares_own_inputs_stop_whatever_is_commanded(attribute, value):
    one = plant()
    driven(one, NOMINAL.speed / 2, 0.1, drill_on=True)
    assert PlantFlag.DRILL_ON in one.read().flags
    setattr(one, attribute, value)
    one.advance(0.1)
    first = one.read().encoders
    driven(one, NOMINAL.speed / 2, 0.2, drill_on=True)
    assert np.allclose(one.read().encoders, first, atol=3 * NOMINAL.resolution)
    assert PlantFlag.DRILL_ON not in one.read().flags
    assert (PlantFlag.STOP_PRESSED in one.read().flags) == (attribute == "stop_pressed")
    assert (PlantFlag.RUN_HELD in one.read().flags) == (attribute != "run_held")


def test_drives_that_nobody_commands_stop_by_themselves():
    """A dead controller: what it said last holds for 50 ms and no longer, and the drill stops with it."""
    one = plant(build=WEIGHTLESS)
    driven(one, NOMINAL.speed / 2, 0.2, drill_on=True)
    one.advance(WATCHDOG_S - 2 * CYCLE_S)
    assert PlantFlag.DRILL_ON in one.read().flags
    one.advance(2 * CYCLE_S)
    last = one.read().encoders
    one.advance(0.05)
    assert PlantFlag.DRILL_ON not in one.read().flags
    stopped = one.read().encoders
    # From half speed at full acceleration, and the cycle in which the watchdog acts.
    way = (NOMINAL.speed / 2) ** 2 / (2 * NOMINAL.acceleration) + NOMINAL.speed / 2 * CYCLE_S
    assert (stopped - last < way + 2 * NOMINAL.resolution).all()
    one.advance(0.5)
    assert np.allclose(one.read().encoders, stopped, atol=3 * NOMINAL.resolution)
    driven(one, NOMINAL.speed / 2, 0.2)  # and obey again
    assert (one.read().encoders > stopped + 10 * NOMINAL.resolution).all()


@pytest.mark.parametrize("sign", [1, -1])
def test_a_joint_stops_at_its_limit(sign):
    near = NOMINAL.upper - 0.01 * NOMINAL.speed if sign > 0 else NOMINAL.lower + 0.01 * NOMINAL.speed
    one = plant(build=WEIGHTLESS, start=near)
    driven(one, sign * NOMINAL.speed, 1.0)
    assert PlantFlag.AT_LIMIT in one.read().flags
    assert (np.abs(NOMINAL.beyond_limits(one.read().encoders)) < 0.01 * NOMINAL.speed).all()
    driven(one, -sign * NOMINAL.speed, 0.3)
    assert PlantFlag.AT_LIMIT not in one.read().flags


@pytest.mark.parametrize("bad", [np.zeros(4), [0, 0, np.nan, 0, 0], [0, 0, np.inf, 0, 0]])
def test_a_command_that_is_no_velocity_is_refused(bad):
    one = plant()
    with pytest.raises(ValueError, match="5 finite"):
        one.command(bad, drill_on=False)


def test_gravity_sags_what_the_encoders_cannot_see():
    """The lift's spring carries all that it lifts; its play is taken up downwards."""
    one, build = plant(), Build()
    one.advance(0.5)
    seen = NOMINAL.T_mcs_flange(one.read().encoders).translation
    sag = (one.true_T_mcs_flange().translation - seen)[2]
    kg = sum(weight.kg for weight in build.weights) + build.frame.kg
    expected = -kg * 9.81 / NOMINAL.stiffness[LIFT] - NOMINAL.backlash[LIFT] / 2
    assert sag == pytest.approx(expected, abs=0.006)  # the lift's encoder counts in 0.005


def test_the_pitch_hangs_at_the_lower_end_of_its_play():
    one = plant(build=Build(gravity=(0.0, 0.0, -0.5)))  # enough to take up the play, little for the springs
    tool, encoders = one.true_T_mcs_tool(), one.read().encoders
    seen = NOMINAL.T_mcs_tool(encoders)
    drop = np.arcsin((tool.rotation.apply([0, 0, 1.0]) - seen.rotation.apply([0, 0, 1.0]))[2] / np.cos(0.1))
    assert drop == pytest.approx(-np.deg2rad(0.025), rel=0.15)


def test_springs_too_stiff_for_the_time_step_are_refused():
    with pytest.raises(SetUpError, match="pitch"):
        plant(replace(NOMINAL, stiffness=NOMINAL.stiffness * [1, 1, 1, 1e3, 1]))


def test_the_yaws_play_leaves_the_wire_where_it_came_from():
    """Approached from either side, the same encoder reading means two directions of the wire, the play apart."""
    ends = []
    for sign in (1, -1):
        one = plant(start=START - sign * np.array([0.0, 0.0, 0.05, 0.0, 0.0]))
        driven(one, sign * np.array([0.0, 0.0, 0.02, 0.0, 0.0]), 2.0)
        axis = one.true_T_mcs_tool().rotation.apply([0.0, 0.0, 1.0])
        ends.append(np.arctan2(axis[1], axis[0]) - one.read().encoders[YAW])
    assert ends[1] - ends[0] == pytest.approx(0.0, abs=np.deg2rad(0.055))
    assert abs(ends[1] - ends[0]) > np.deg2rad(0.02)


def slab(robot, q, ahead_mm=10.0, share=1.0):
    """Bone across the wire's path, `ahead_mm` beyond the tip, in front of everything."""
    tool = robot.T_mcs_tool(q)
    volume = Volume(np.full((41, 41, 61), share), np.array([-20.0, -20.0, ahead_mm]), np.ones(3))
    return Bone((volume,), tool)


def test_thrust_bends_the_robot_back_where_the_encoders_cannot_see_it():
    free = plant(build=WEIGHTLESS)
    one = plant(bone=slab(NOMINAL, START, 2.0), build=WEIGHTLESS)
    one.guide_mm = START[FEED] - 5.0
    for each in (free, one):
        driven(each, np.array([0.0, 0.0, 0.0, 0.0, 1.0]), 8.0, drill_on=True)
    assert one.thrust_n == pytest.approx(35.0, rel=0.02)
    assert np.allclose(one.read().encoders, free.read().encoders, atol=0.03)
    axis = NOMINAL.T_mcs_tool(START).rotation.apply([0.0, 0.0, 1.0])
    flange = axis @ (one.true_T_mcs_flange().translation - free.true_T_mcs_flange().translation)
    thrust = one.thrust_n * axis
    springs = np.array([1 / NOMINAL.column_stiffness, 1 / NOMINAL.stiffness[TRAVERSE], 1 / NOMINAL.stiffness[LIFT]])
    assert flange == pytest.approx(-(axis * springs) @ thrust, abs=0.02)  # the play is 0.01
    tip = axis @ (one.true_T_mcs_tool().translation - free.true_T_mcs_tool().translation)
    assert tip < flange - 35.0 / 100.0  # and the wire itself is pressed back


def test_a_hold_while_drilling_leaves_the_tip_where_it_is():
    one = plant(bone=slab(NOMINAL, START, 2.0))
    one.guide_mm = START[FEED] - 5.0
    driven(one, np.array([0.0, 0.0, 0.0, 0.0, 1.0]), 6.0, drill_on=True)
    before = one.true_T_mcs_tool().translation
    one.hold()
    one.advance(1.0)
    assert np.linalg.norm(one.true_T_mcs_tool().translation - before) < 0.1


def test_whatever_is_commanded_the_plant_stays_whole():
    """Fifteen seconds of random commands: nothing leaves its limits, the truth stays with the encoders."""
    rng = np.random.default_rng(11)
    one = plant()
    for _ in range(50):
        driven(one, rng.uniform(-2, 2, 5) * NOMINAL.speed, 0.3, drill_on=bool(rng.integers(2)))
        encoders = one.read().encoders
        assert (np.abs(NOMINAL.beyond_limits(encoders)) < 0.01 * NOMINAL.speed).all()
        off = one.true_T_mcs_tool().translation - NOMINAL.T_mcs_tool(encoders).translation
        assert np.linalg.norm(off) < 2.0


def test_without_mujoco_the_plant_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(SetUpError, match=r"sightline\[robot\]"):
        plant()


@pytest.mark.parametrize("bad", [NOMINAL.upper + 1.0, np.full(5, np.nan)])
def test_a_start_beyond_the_limits_is_refused(bad):
    with pytest.raises(SetUpError, match="limits"):
        plant(start=bad)


def test_a_drive_that_cannot_follow_says_so_and_does_not_wind_up():
    weak = Build(gravity=(0.0, 0.0, 0.0), drive_force=(1000.0, 400.0, 60.0, 60.0, 15.0))
    one = plant(bone=slab(NOMINAL, START, 2.0), build=weak)
    one.guide_mm = START[FEED] - 5.0
    driven(one, np.array([0.0, 0.0, 0.0, 0.0, 1.0]), 6.0)  # against bone, not turning
    assert PlantFlag.OVERLOAD in one.read().flags
    assert one.thrust_n == pytest.approx(15.0, abs=1.0)
    stuck = one.read().encoders[FEED]
    driven(one, np.array([0.0, 0.0, 0.0, 0.0, -1.0]), 1.0)
    assert one.read().encoders[FEED] < stuck - 0.8


def test_the_true_wire_runs_from_its_guide_through_its_entry_to_its_tip():
    tilt = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, np.deg2rad(40.0), 0.0]))
    tool = NOMINAL.T_mcs_tool(START)
    volume = Volume(np.ones((61, 61, 61)), np.array([-30.0, -30.0, 0.0]), np.ones(3))
    ahead = RigidTransform.from_translation([0.0, 0.0, 6.0])
    one = plant(bone=Bone((volume,), tool * ahead * tilt))
    one.guide_mm = START[FEED] - 30.0
    driven(one, np.array([0.0, 0.0, 0.0, 0.0, 1.0]), 25.0, drill_on=True)
    mouth, entry, tip = one.true_wire_mm()
    true = one.true_T_mcs_tool()
    assert np.allclose(tip, true.translation)
    assert np.linalg.norm(entry - mouth) == pytest.approx(38.0, abs=2.0)
    chord = (tip - entry) / np.linalg.norm(tip - entry)
    assert np.rad2deg(np.arccos(chord @ true.rotation.apply([0.0, 0.0, 1.0]))) < 0.2
    axis = one.true_T_mcs_flange().rotation.apply([0.0, 0.0, 1.0])
    leaning, beyond = (np.cross(axis, part / np.linalg.norm(part)) for part in (entry - mouth, tip - entry))
    assert np.linalg.norm(leaning) > 2e-3
    assert np.allclose(beyond, 1.5 * leaning, atol=0.15 * np.linalg.norm(leaning))  # a cantilever's end


def test_the_same_generator_gives_the_same_readings():
    read = []
    for _ in range(2):
        one = plant(bone=slab(NOMINAL, START, 2.0), seed=3)
        driven(one, np.array([0.0, 0.0, 0.01, 0.0, 1.0]), 1.0, drill_on=True)
        one.advance(0.003)
        read.append((*one.read().encoders, one.read().force_n, one.read().time_s))
    assert read[0] == read[1]
    assert read[0][-1] == pytest.approx(1.0)  # whole cycles; 3 ms are owed


@pytest.mark.parametrize("graphics", ["osmesa", "none of MuJoCo's"])
def test_graphics_that_are_not_there_are_not_needed(graphics: str) -> None:
    """As a shell names them that renders elsewhere without a screen. The variable keeps its value."""
    script = (
        "import os\nimport numpy as np\nfrom sightline.robot.kinematics.designs import nominal_manipulator\n"
        "from sightline.twin.robot.plant import SimulatedPlant\n"
        "SimulatedPlant(nominal_manipulator(), None, np.random.default_rng(0), np.zeros(5))\n"
        "print(os.environ['MUJOCO_GL'])"
    )
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", script],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "MUJOCO_GL": graphics},
    )
    assert done.stdout == f"{graphics}\n"
