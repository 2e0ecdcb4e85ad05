"""A robot's file: what was measured becomes a calibrated robot, and what is not one is refused."""

import json
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.robot.arms import SIX, as_mjcf, calibrated

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.rehearsal.arm_images import tracker_measurements
from sightline.rehearsal.operation import calibrated_robot, true_manipulator
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.kinematics.measured import Measurements, RobotFile

SD = 0.03
IMAGED = np.array([3.0, -5.0, np.pi / 4, 0.0, 0.5])
LIFTED = IMAGED + np.array([0.3, 0.0, 0.0, 0.0, 0.0])


def true_robot(seed: int = 3) -> Manipulator:
    """One whose mounts and axes are not where they were designed."""
    true = true_manipulator(calibrated_robot(), np.random.default_rng(seed))
    return replace(true, T_flange_cfcs=RigidTransform.from_translation([1.0, -0.7, 0.6]) * true.T_flange_cfcs)


def measurements(true: Manipulator, seed: int = 4, **changed) -> dict:
    """What a person measures on it with a tracker of 0.03 mm."""
    rng = np.random.default_rng(seed)
    said = {
        "schema": "sightline-robot-measurements/1",
        "robot_serial": "R-1",
        "frame_serial": "SN-7",
        "side": "right",
        "measured_on": datetime.now(UTC).isoformat(),
    }
    return said | tracker_measurements(true, rng.uniform(-60.0, 60.0, (8, 3)), rng) | changed


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> RobotFile:
    file = tmp_path_factory.mktemp("robot") / "measured.json"
    file.write_text(json.dumps(measurements(true_robot())))
    return RobotFile.calibrated(Measurements.read(file))[0]


def test_the_file_is_the_robot_that_was_measured(robot, tmp_path):
    """Nearer to the true one than the design, and within what it states."""
    robot.write(tmp_path / "robot.json")
    read = RobotFile.read(tmp_path / "robot.json")
    assert read == robot
    true, known, design = true_robot(), read.robot().manipulator, calibrated_robot().manipulator
    q = np.array([20.0, -30.0, 0.4, 0.2, 120.0])
    tip = [(one.T_mcs_cfcs(IMAGED).inv() * one.T_mcs_tool(q)).translation for one in (true, known, design)]
    off, was = np.linalg.norm(tip[1] - tip[0]), np.linalg.norm(tip[2] - tip[0])
    xyz = known.T_mcs_tool(q).translation[None]
    stated = sum(read.robot().wire_against_frame(IMAGED, q, xyz).values())
    assert off < 4 * np.sqrt(np.trace(stated))
    assert off < 0.3
    assert was > 1.0


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"schema": "other/1"}, "schema"),
        ({"robot_serial": ""}, "robot_serial"),
        ({"side": "middle"}, "side"),
        ({"measured_on": "yesterday"}, "measured_on"),
        ({"colour": "red"}, "colour"),
        ({"wire": {"sd_mm": 0.0, "feed_mm": [0.0], "tip_flange_mm": [[0, 0, 0]]}}, "wire"),
        ({"frame": {"sd_mm": SD, "own_mm": [[0, 0, 1e9]], "flange_mm": [[0, 0, 0]]}}, "frame"),
    ],
)
def test_measurements_that_are_none(tmp_path, changed, why):
    (tmp_path / "m.json").write_text(json.dumps(measurements(true_robot(), **changed)))
    with pytest.raises(UnusableInputError, match=why):
        Measurements.read(tmp_path / "m.json")


@pytest.mark.parametrize("text", ["", "[]", "{", "null", "[" * 5000, '{"schema": NaN}', " " * (2**22 + 1)])
def test_files_that_are_none(tmp_path, text):
    (tmp_path / "robot.json").write_text(text)
    for kind in (Measurements, RobotFile):
        with pytest.raises(UnusableInputError, match=r"robot\.json"):
            kind.read(tmp_path / "robot.json")


def test_a_robot_whose_numbers_are_none(robot, tmp_path):
    good = json.loads(robot.model_dump_json(by_alias=True))
    for change, why in (
        (lambda d: d["manipulator"]["T_flange_tool"][0].__setitem__(0, 2.0), "rigid"),
        (lambda d: d["manipulator"]["axes"][0].__setitem__(3, 2.0), "unit twists"),
        (lambda d: d["covariance"][0].__setitem__(0, -1.0), "negative"),
        (lambda d: d["covariance"][0].__setitem__(1, 0.5), "symmetric"),
        (lambda d: d["covariance"].pop(), "covariance"),
    ):
        bad = json.loads(json.dumps(good))
        change(bad)
        (tmp_path / "robot.json").write_text(json.dumps(bad))
        with pytest.raises(UnusableInputError, match=why):
            RobotFile.read(tmp_path / "robot.json")


def test_contradicting_measurements_are_refused(tmp_path):
    said = measurements(true_robot())
    said["frame"]["own_mm"] = said["frame"]["own_mm"][::-1]
    (tmp_path / "m.json").write_text(json.dumps(said))
    with pytest.raises(RobotRefusedError, match="measured points"):
        RobotFile.calibrated(Measurements.read(tmp_path / "m.json"))


def test_where_it_stood_at_the_images(robot):
    now = 1.7e9
    with pytest.raises(RobotRefusedError, match="pa and lateral image is missing"):
        robot.registration()
    one = robot.at_image("pa", IMAGED, now, "image.png")
    with pytest.raises(RobotRefusedError, match="the lateral image is missing"):
        one.registration()
    both = one.at_image("lateral", IMAGED + 1e-4, now + 60.0, "image.png")
    assert both.registration().imaged_s == now + 60.0
    with pytest.raises(RobotRefusedError, match="moved between the images"):
        one.at_image("lateral", LIFTED, now + 60.0, "image.png")
    with pytest.raises(RobotRefusedError, match="home the robot; then acquire both images again"):
        one.at_image("pa", IMAGED + 900.0, now, "image.png")
    with pytest.raises(UnusableInputError, match="5 finite"):
        one.at_image("lateral", np.full(5, np.nan), now, "image.png")
    later = both.at_image("pa", LIFTED, now + 700.0, "image.png")  # for the next patient
    assert set(later.images) == {"pa"}
    assert set(one.at_image("lateral", IMAGED, now - 60.0, "l").images) == {"lateral"}  # the clock was set back
    with pytest.raises(RobotRefusedError, match="moved"):
        robot.refuse_moved(IMAGED, LIFTED)
    robot.refuse_moved(IMAGED, IMAGED + 1e-4)


def test_another_side_frame_or_day_is_refused(robot):
    now = time.time()
    robot.refuse_other("right", "SN-7", "", now)
    for side, serial in (("left", "SN-7"), ("right", "SN-8"), ("right", None), (None, "SN-7")):
        with pytest.raises(RobotRefusedError, match="another patient's plan"):
            robot.refuse_other(side, serial, "", now)
    for days in (91, -1):
        with pytest.raises(RobotRefusedError, match="was calibrated on"):
            robot.refuse_other("right", "SN-7", "", now + timedelta(days=days).total_seconds())


def test_an_arm_of_six_joints_has_a_file_too_and_older_files_are_read(robot, tmp_path):
    six = true_manipulator(calibrated(SIX), np.random.default_rng(5))
    (tmp_path / "six.json").write_text(json.dumps(measurements(six) | {"arm": "six-axis"}))
    file = RobotFile.calibrated(Measurements.read(tmp_path / "six.json"))[0]
    file.write(tmp_path / "robot.json")
    read = RobotFile.read(tmp_path / "robot.json").robot().manipulator
    assert (read.joints, read.has_feed, read.guide_mm) == (SIX.joints, False, SIX.guide_mm)
    assert np.allclose(read.lower, SIX.lower)
    with pytest.raises(UnusableInputError, match="6 finite"):
        file.at_image("pa", IMAGED, 1.7e9, "image.png")
    version_1 = json.loads(robot.model_dump_json(by_alias=True)) | {"schema": "sightline-robot/1"}
    kept = ("axes", "T_mcs_flange_home", "T_flange_cfcs", "T_flange_tool")
    version_1["manipulator"] = {name: version_1["manipulator"][name] for name in kept}
    (tmp_path / "old.json").write_text(json.dumps(version_1))
    assert RobotFile.read(tmp_path / "old.json") == robot


def test_an_arm_from_a_model_file_is_calibrated(tmp_path):
    """The six-axis arm as MJCF, its joints named otherwise."""
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(as_mjcf(SIX))
    six = true_manipulator(calibrated(SIX), np.random.default_rng(5))
    arm = {"model": "arm.xml", "flange": "flange"}
    (tmp_path / "six.json").write_text(json.dumps(measurements(six) | {"arm": arm}))
    file = RobotFile.calibrated(Measurements.read(tmp_path / "six.json"), tmp_path)[0]
    q = np.full(6, 0.3)
    off = file.robot().manipulator.T_mcs_flange(q).inv() * six.T_mcs_flange(q)
    assert np.linalg.norm(off.translation) < 0.2
    assert file.manipulator.joints[0] == "axis-0"
    (tmp_path / "six.json").write_text(json.dumps(measurements(six) | {"arm": arm | {"model": "../arm.xml"}}))
    with pytest.raises(UnusableInputError, match=r"arm\..*model"):
        Measurements.read(tmp_path / "six.json")
