"""The demo's robot with a block: registered by encoders, and by images of its own wire."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest

from sightline.calibration import calibrate
from sightline.cli import demo as demo_robot
from sightline.cli.demo import RobotAhead
from sightline.common.geometry.covariance import length_quantile
from sightline.errors import RobotRefusedError
from sightline.frame import Frame
from sightline.rehearsal.operation import SHOWN_FEED_MM, drawn_robot, shown_wire_mm
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.rehearsal.wire import BY_ENCODERS, BY_IMAGES, DemoPlan, registrations
from sightline.robot.kinematics.designs import imaging_yaw
from sightline.robot.kinematics.target import Registration
from sightline.studies.scenes import VIEWS, measure

BLOCK = Frame.load("block60")


@pytest.fixture(scope="module")
def planned() -> DemoPlan:
    """Its balls are measured with 0.05 px, not found in images."""
    rehearsal, rng = Rehearsal.draw(4, BLOCK), np.random.default_rng(11)
    balls = measure(rng, rehearsal.setup, 0.05)
    views = [SimpleNamespace(view=calibrate(balls[name], BLOCK, view=name)) for name in VIEWS]
    return DemoPlan(rehearsal, "block60", SimpleNamespace(pick_sd_px=0.5), None, views)  # type: ignore[arg-type]


def joints(planned: DemoPlan) -> np.ndarray:
    of = planned.rehearsal
    return drawn_robot(of.robot, imaging_yaw(of.side), of.generator("robot"), SHOWN_FEED_MM)[1]


@pytest.mark.slow
def test_both_registrations_know_the_wire_as_they_state_and_images_better(planned):
    """The true wire in CFCS at the images, against each: a registration in other coordinates is 80 mm off."""
    q = joints(planned)
    found = registrations(planned, q, 0.0, np.random.default_rng(12))
    assert list(found) == [BY_ENCODERS, BY_IMAGES]
    true, tips = planned.rehearsal.robot_wire_mm, {}
    assert true is not None
    for by, one in found.items():
        stated = tip_error_95_mm(one)
        assert np.linalg.norm(shown_wire_mm(one.robot.manipulator, q, [0.0])[0] - true[1]) < 1.3 * stated
        tips[by] = stated
    assert tips[BY_IMAGES] < 0.6 * tips[BY_ENCODERS] < 0.6


def tip_error_95_mm(stood: Registration) -> float:
    tip = stood.robot.manipulator.T_mcs_tool(stood.q).translation[None]
    parts = stood.robot.wire_against_frame(stood.q, stood.q, tip)
    return float(length_quantile(parts["hand_eye"] + parts["drill_axis"]))


@pytest.mark.slow
def test_a_block_that_was_knocked_on_its_mount_is_refused(planned):
    of = planned.rehearsal
    elsewhere = np.add(of.robot_wire_mm, [0.0, 1.5, 0.0])
    knocked = SimpleNamespace(robot=of.robot, pixels=of.pixels, robot_wire_mm=elsewhere)
    with pytest.raises(RobotRefusedError, match="images and encoders disagree"):
        registrations(replace(planned, rehearsal=knocked), joints(planned), 0.0, np.random.default_rng(13))


@pytest.mark.slow
def test_a_gamma_s_images_do_not_show_the_wire(planned):
    around = SimpleNamespace(robot=planned.rehearsal.robot, robot_wire_mm=None)
    assert list(registrations(replace(planned, rehearsal=around), joints(planned), 0.0, None)) == [BY_ENCODERS]


def test_a_robot_starts_ahead_of_those_patients_and_frames_that_it_drills():
    """Fails for a robot of another patient than the images', and for one that stays beside a frame without room."""
    started = []

    def start(*of):
        started.append(SimpleNamespace(of=of, close=lambda: started.append("closed")))
        return started[-1]

    with patch.object(demo_robot, "_robot", side_effect=start), patch.object(demo_robot, "_installed", lambda: True):
        with RobotAhead(3, "pedicle-screw", None, "manipulator") as ahead:
            ahead.keep_beside(BLOCK)
        assert started == []
        with RobotAhead(3, "distal-interlocking", None, "six-axis") as ahead:
            ahead.keep_beside(BLOCK)
            assert started[0].of == (3, "block60", "right", "distal-interlocking", "six-axis")
            assert len(started) == 1
        assert started.pop() == "closed"
        with RobotAhead(3, "hip-screw", "block40+detector-plate", "manipulator") as ahead:
            ahead.keep_beside(Frame.load("block40+detector-plate"))
            assert started[-1] == "closed"
        assert started.count("closed") == 1  # once
