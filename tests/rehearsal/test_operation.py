"""How a drilled wire is judged, and a whole insertion of the plastic femur."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.robot.rig import END_MM, ENTRY_MM, wait_for

from sightline.common.checks import Limits
from sightline.errors import RobotRefusedError
from sightline.rehearsal.operation import SLEEVE_MM, InsertionOutcome, SimulatedTheatre, registered
from sightline.robot.control.states import State
from sightline.robot.kinematics.designs import FEED, imaging_yaw, nominal_manipulator
from sightline.robot.kinematics.target import PlanIdentity, RobotTarget, robot_target
from sightline.robot.link.client import RobotClient
from sightline.studies.rendered.fig15 import Figure15
from sightline.twin.robot.plant import Hand

IDEAL = np.array([[40.0, 30.0, -5.0], [-30.0, -35.0, 7.0]])


def test_a_wire_errs_by_its_depth_on_its_line_and_as_it_is_turned():
    length = np.linalg.norm(IDEAL[1] - IDEAL[0])
    along = (IDEAL[1] - IDEAL[0]) / length
    across = np.cross(along, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(along, [0.0, 0.0, 1.0]))
    for wire, end_mm, angle in (
        (np.stack([IDEAL[0] - 12.0 * along, IDEAL[1] + 0.4 * along]), 0.4, 0.0),
        (np.stack([IDEAL[0], IDEAL[1] + 0.01 * length * across]), 0.01 * length, np.arctan(0.01)),
    ):
        found = InsertionOutcome.of(wire, IDEAL)
        assert found.entry_mm == pytest.approx(0.0, abs=1e-9)
        assert found.end_mm == pytest.approx(end_mm)
        assert found.angle_rad == pytest.approx(angle, abs=1e-9)


def test_the_frame_stands_square_at_its_nominal_yaw():
    assert np.rad2deg([imaging_yaw("right"), imaging_yaw("left")]) == pytest.approx([45.0, -45.0])
    for side in ("right", "left"):
        turned = nominal_manipulator(side).T_mcs_cfcs(np.array([0.0, 0.0, imaging_yaw(side), 0.0, 0.0])).rotation
        assert turned.apply([1.0, 0.0, 0.0]) == pytest.approx([-1.0, 0.0, 0.0], abs=1e-12)  # lateral: to the robot


def test_a_second_insertion_finds_its_line_where_the_images_had_it():
    """The frame stood at the images where its encoders were then, not where the first insertion left them."""
    pytest.importorskip("mujoco")
    theatre = SimulatedTheatre.in_air("right", "SN-7")
    wire, budget = np.stack([ENTRY_MM, END_MM]), {"planning": 0.01 * np.eye(6)}
    with theatre.server(virtual=True) as server:
        for number in range(2):
            with RobotClient(port=server.port, streams=False) as robot:
                registration = registered(theatre.robot, robot.simulated_wire().imaged, time.monotonic())
                target = robot_target(
                    PlanIdentity(f"{number}", "right", "SN-7", go=True), wire, budget, registration, Limits()
                )
                robot.start_up()
                robot.calibrate(registration.T_mcs_cfcs)
                robot.aim_plan(target, time.monotonic(), target.length_mm + 1.0)
                robot.align()
                along = (END_MM - ENTRY_MM) / np.linalg.norm(END_MM - ENTRY_MM)
                assert np.allclose(robot.position().translation, ENTRY_MM - 20 * along, atol=0.05)
                left = registered(theatre.robot, robot.joints()[0], time.monotonic())
                with pytest.raises(RobotRefusedError, match=r"out of reach|feed"):
                    robot_target(target.identity, wire, budget, left, Limits())
            wait_for(lambda: server.dialogue.controller.lease is None)


def drilled_in_air(theatre: SimulatedTheatre) -> tuple[InsertionOutcome, RobotTarget]:
    """Align, guide and drill a wire of 40 mm, and compare it with its plan."""
    wire, budget = np.stack([ENTRY_MM, END_MM]), {"planning": 0.01 * np.eye(6)}
    registration = registered(theatre.robot, theatre.imaged, time.monotonic())
    target = robot_target(PlanIdentity("1", "right", "SN-7", go=True), wire, budget, registration, Limits())
    theatre.drill(target, target.length_mm + 1.0)
    return theatre.outcome(wire), target


@pytest.mark.parametrize("arm", ["six-axis", "seven-axis"])
def test_a_person_drills_through_the_guide_that_an_arm_holds(arm, monkeypatch):
    pytest.importorskip("mujoco")
    monkeypatch.setattr("sightline.twin.robot.plant.HAND_MM_S", 10.0)
    theatre = SimulatedTheatre.in_air("right", "SN-7", arm=arm)
    outcome, target = drilled_in_air(theatre)
    assert outcome.entry_mm < 1.0
    assert outcome.end_mm < 2.0  # its depth is read
    assert np.rad2deg(outcome.angle_rad) < 0.6
    assert theatre.plant.guide_mm == pytest.approx(target.standoff_mm - SLEEVE_MM)
    assert theatre.plant.pushed_mm == pytest.approx(target.pushed_mm, abs=1.5)


def test_a_guide_that_is_pushed_away_stops_the_person(monkeypatch):
    pytest.importorskip("mujoco")
    monkeypatch.setattr(
        Hand, "draw", lambda goal, *_: Hand(goal, RigidTransform.identity(), np.array([60.0, 0.0, 0.0]))
    )
    theatre = SimulatedTheatre.in_air("right", "SN-7", arm="six-axis")
    with pytest.raises(RobotRefusedError, match="pushed away"):
        drilled_in_air(theatre)
    assert theatre.plant.pushed_mm < 5.0


@pytest.mark.parametrize("state", [State.ALIGNED, State.DRILL])
def test_the_sleeve_is_at_the_bone_however_soon_drilling_is_ordered(state, monkeypatch):
    """A drilling order may come before the robot's first cycle in ALIGNED; the wire is guided all the same."""
    pytest.importorskip("mujoco")
    theatre = SimulatedTheatre.in_air("right", "SN-7")
    plant, server = theatre.plant, theatre.server(virtual=True)
    machine = server.dialogue.controller.machine
    feed = plant.read().encoders[FEED] + 40.0
    insertion = SimpleNamespace(q=np.array([0.0, 0.0, 0.0, 0.0, feed]), limits=Limits())
    monkeypatch.setattr(machine, "insertion", insertion)
    monkeypatch.setattr(machine, "state", state)
    assert plant.guide_mm != pytest.approx(feed - SLEEVE_MM)
    server._advance(1e-3)
    assert plant.guide_mm == pytest.approx(feed - SLEEVE_MM)


def test_the_summary_counts_insertions_within_the_papers_limits() -> None:
    inserted = {"entry": 0.3, "end": 0.4, "angle": 0.2, "plan_entry": 0.1, "plan_angle": 0.1}
    values = dict.fromkeys(Figure15().methods, inserted)
    summary = Figure15().summary([values, {"refused": "SetUpError: no"}])
    assert "1 of 2 insertions" in summary.findings[0]
    assert summary.tables[1].rows[-1][2] == "refused"
