"""The zero of depth: plan, contact and shot weighed by their errors; contact where no bone is planned stops."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.robot.rig import CLIENT, END_MM, ENTRY_MM, SETUP, IdealPlant, Rig, code, metadata, wire

from sightline.errors import RobotRefusedError
from sightline.robot.contract import DEPTH, DEPTH_SD, OPEN_HOLE_DEPTH
from sightline.robot.control.states import State
from sightline.robot.igtl import Capability, Message, Status, Transform
from sightline.robot.kinematics.designs import FEED
from sightline.robot.kinematics.target import (
    CONTACT_LEAD_MM,
    CONTACT_SD_MM,
    MAX_ZERO_SHIFT_MM,
    PLAN_SD_MM,
    DepthZero,
    contact_range,
)
from sightline.robot.link.record import Recorder
from sightline.robot.link.server import VIRTUAL_TELEMETRY_S

LENGTH_MM, SHORT_MM = float(np.linalg.norm(END_MM - ENTRY_MM)), 20.0  # drilling takes a second for each millimetre
WEIGHT = PLAN_SD_MM**2 / (PLAN_SD_MM**2 + CONTACT_SD_MM**2)


def test_what_is_told_is_weighed_by_its_error():
    """As the least-squares mean of both does, tried on random errors."""
    rng = np.random.default_rng(3)
    zeros, true = [], 120.0
    for _ in range(4000):
        planned = DepthZero(true + rng.normal(0.0, PLAN_SD_MM))
        feed = true + 40.0
        told = planned.corrected(feed, 40.0 + rng.normal(0.0, 0.3), 0.3)
        zeros.append(told.feed_mm - true)
    assert np.std(zeros) == pytest.approx(told.sd_mm, rel=0.04)
    assert np.mean(zeros) == pytest.approx(0.0, abs=4 * told.sd_mm / np.sqrt(4000))
    assert told.sd_mm < 0.3


def test_what_cannot_be_is_refused():
    for off in (MAX_ZERO_SHIFT_MM + 0.01, -MAX_ZERO_SHIFT_MM - 0.01, np.nan, np.inf):
        with pytest.raises(RobotRefusedError, match="something has moved"):
            DepthZero(100.0).corrected(140.0, 40.0 + off, 0.2)
    for sd in (0.0, -0.1, np.nan, np.inf):
        with pytest.raises(RobotRefusedError):
            DepthZero(100.0).corrected(140.0, 40.0, sd)


def test_bone_may_be_met_until_its_contact_could_no_longer_be_taken():
    assert contact_range() == (-MAX_ZERO_SHIFT_MM - CONTACT_LEAD_MM, MAX_ZERO_SHIFT_MM - CONTACT_LEAD_MM)


BEFORE = {"before_mm": "12"}  # bone begins up to 12 mm before the entry point, a nail's wall, and
THROUGH = BEFORE | {"beyond_mm": "15"}  # the drill goes past the nail, to the far cortex
SKIN_N, CORTEX_N, METAL_N = 2.0, 20.0, 90.0


class Layers(IdealPlant):
    """Pushes back with the forces of layers, each from a depth on."""

    def __init__(self, forces: dict[float, float]) -> None:
        super().__init__()
        self.forces, self.zero_mm = forces, np.inf

    def read(self):
        depth = self.q[FEED] - self.zero_mm
        felt = [force for at, force in self.forces.items() if depth > at]
        return replace(super().read(), force_n=felt[-1] if felt else 0.0)


def targeted(plant: IdealPlant, said: dict[str, str], length_mm: float = LENGTH_MM) -> tuple[Rig, list[Message]]:
    """In TARGETING, with the answers to a target into bone."""
    rig = Rig(moved=plant, setup=replace(SETUP, into_bone=True))
    rig.reach(State.CALIBRATION)
    rig.go(("CLB", "TARGETING"))
    return rig, aimed(rig, said, length_mm)


def aimed(rig: Rig, said: dict[str, str], length_mm: float, end_mm: np.ndarray = END_MM) -> list[Message]:
    entry_mm = end_mm + length_mm / LENGTH_MM * (ENTRY_MM - END_MM)
    plan = metadata(length_mm=repr(length_mm), depth_limit_mm=repr(length_mm + 1.0), **said)
    return rig.send("TGT_1", Transform.of(wire(entry_mm, end_mm)), version=2, metadata=plan)


def through(bone: dict[float, float] | Layers, said: dict[str, str] = THROUGH, length_mm: float = LENGTH_MM) -> Rig:
    """In DRILL, before layers at depths beyond the planned entry point."""
    plant = bone if isinstance(bone, Layers) else Layers(bone)
    rig, answers = targeted(plant, said, length_mm)
    assert code(answers, "TARGET") == 1
    rig.go(("MOVE_TO_TARGET", State.ALIGNED))
    plant.zero_mm = float(rig.controller.machine.insertion.q[FEED])
    rig.command("DRILL")
    return rig


def drilling(bone_mm: float) -> Rig:
    """In DRILL, with bone so far beyond the planned entry point, which the robot knows it must meet."""
    return through({bone_mm: CORTEX_N}, {}, SHORT_MM)


@cache
def _paused(bone_mm: float) -> Rig:
    rig = drilling(bone_mm)
    rig.run_until(State.PAUSED)
    return rig


@pytest.mark.parametrize("bone_mm", [1.1, -2.4])
def test_contact_sets_the_zero_as_far_as_it_is_to_be_trusted(bone_mm):
    planned = drilling(bone_mm).controller.machine.drilling.zero
    assert planned.sd_mm == PLAN_SD_MM
    rig = deepcopy(_paused(bone_mm))
    off = bone_mm + CONTACT_LEAD_MM
    zero = rig.controller.machine.drilling.zero
    assert zero.feed_mm - planned.feed_mm == pytest.approx(WEIGHT * off, abs=0.05)  # noticed 0.02 mm late
    assert zero.sd_mm == pytest.approx(PLAN_SD_MM * np.sqrt(1 - WEIGHT))
    assert rig.controller.machine.snapshot().depth_mm == pytest.approx(SHORT_MM - 10.0, abs=0.02)
    assert rig.plant.q[FEED] - planned.feed_mm == pytest.approx(SHORT_MM - 10.0 + WEIGHT * off, abs=0.05)
    rig.command("DRILL")
    rig.run_until(State.DONE)  # bone was met already: it is not met again
    assert rig.controller.machine.drilling.zero == zero


@pytest.mark.parametrize(
    ("bone_mm", "why"), [(-4.5, "met something 4.5 mm before"), (60.0, "no bone was met up to 2.4")]
)
def test_bone_where_none_is_planned_stops_with_the_reason(bone_mm, why):
    rig = drilling(bone_mm)
    said = rig.run_until(State.STOP, 20.0)
    assert any(why in message.body.text for message in said if isinstance(message.body, Status))
    assert rig.run(0.2) == []
    assert rig.speed() < 0.01
    assert rig.plant.q[FEED] - rig.plant.zero_mm < MAX_ZERO_SHIFT_MM


def test_a_hole_s_drill_waits_before_the_bone_pauses_before_the_nail_and_keeps_its_zero():
    rig = through({-9.0: CORTEX_N, -4.0: 0.0, 24.0: CORTEX_N, 27.0: 0.0})
    machine = rig.controller.machine
    assert machine.snapshot().depth_mm == pytest.approx(-32.0, abs=0.02)  # 20 mm before where bone may begin
    planned = machine.drilling.zero
    rig.run_until(State.PAUSED)
    assert machine.snapshot().depth_mm == pytest.approx(-6.0, abs=0.02)
    assert machine.drilling.zero == planned  # nobody knew where the bone begins
    rig.command("DRILL")
    said = rig.run_until(State.DONE)
    assert code(said, "DRILL") == 1
    assert 30.0 < machine.snapshot().depth_mm < 30.5 < LENGTH_MM  # the far cortex is behind the drill and its point


def test_bone_before_the_entry_of_a_wire_that_ends_in_bone_leaves_the_pause_near_its_end():
    rig = through({-9.0: CORTEX_N, -4.0: 2.0}, BEFORE, SHORT_MM)
    planned = rig.controller.machine.drilling.zero
    rig.run_until(State.PAUSED)
    assert rig.controller.machine.snapshot().depth_mm == pytest.approx(SHORT_MM - 10.0, abs=0.02)
    assert rig.controller.machine.drilling.zero == planned


@pytest.mark.parametrize(
    ("forces", "why"),
    [
        ({-18.0: SKIN_N}, "met something 17.9 mm before"),  # 6 mm earlier than bone can begin
        ({-18.0: CORTEX_N}, "met something 18.0 mm before"),
        ({-8.0: SKIN_N, 0.0: METAL_N}, "no cortex was met up to 2.6 mm before"),
        ({0.0: METAL_N}, "no bone was met up to 2.6 mm before"),  # the nail at the entry point is no bone
    ],
    ids=["soft tissue", "something hard", "no cortex", "nothing before the nail"],
)
def test_bone_where_no_hole_s_bone_can_be_stops_before_the_nail(forces, why):
    rig, said = through(forces), []
    while rig.now_s < 60.0 and rig.state is not State.STOP:
        said += rig.run(0.1)
        if rig.state is State.PAUSED:  # 6 mm before the nail; bone may still be met
            rig.command("DRILL")
    assert rig.state is State.STOP
    assert any(why in message.body.text for message in said if isinstance(message.body, Status))
    assert rig.plant.q[FEED] - rig.plant.zero_mm < -1.5


def test_a_drill_that_touches_the_nail_is_a_fault():
    rig = through({-9.0: CORTEX_N, -4.0: 0.0, 0.0: METAL_N})
    rig.run_until(State.PAUSED)
    rig.command("DRILL")
    said = rig.run_until(State.EMERGENCY, 20.0)
    assert any("above its limit" in message.body.text for message in said if isinstance(message.body, Status))
    assert rig.plant.q[FEED] - rig.plant.zero_mm < 0.5


@pytest.mark.parametrize("said", [{"before_mm": "41"}, {"before_mm": "2"}, {"before_mm": "nan"}, {"beyond_mm": "99"}])
def test_a_target_that_says_what_cannot_be_is_refused(said):
    assert code(targeted(IdealPlant(), said)[1], "TARGET") == 10


class Holed(Layers):
    """Keeps the hole that was drilled into it, unless the bone has moved since."""

    def __init__(self, forces: dict[float, float]) -> None:
        super().__init__(forces)
        self.bottom_mm, self.moved = -np.inf, False

    def advance(self, dt_s: float) -> None:
        super().advance(dt_s)
        self.bottom_mm = max(self.bottom_mm, self.q[FEED] - self.zero_mm)

    def read(self):
        open_here = self.q[FEED] - self.zero_mm < self.bottom_mm - 0.05 and not self.moved
        return replace(super().read(), force_n=0.0) if open_here else super().read()


def stopped(why: str) -> tuple[Rig, DepthZero]:
    """Stopped 6 mm deep in bone that begins 1.1 mm beyond the entry, and with the zero of depth then."""
    rig = through(Holed({1.1: CORTEX_N}), {}, SHORT_MM)
    rig.run_until_depth(6.0)
    zero = rig.controller.machine.drilling.zero
    if why == "STOP":
        rig.command("STOP")
    elif why == "client lost":
        rig.dialogue.left(CLIENT, rig.now_s)
    else:
        rig.reads(force_n=200.0)
        rig.run_until(State.EMERGENCY)
        rig.reads()
        rig.panel.reset()
    rig.run(0.5)
    return rig, zero


def told_again(rig: Rig, end_mm: np.ndarray = END_MM) -> list[float]:
    """Register and send the target, align and begin to drill; return the depths of an open hole that were told."""
    rig.go(("START_UP", "CALIBRATION", "CLB", "TARGETING"))
    said = aimed(rig, {}, SHORT_MM, end_mm)
    assert code(said, "TARGET") == 1
    rig.go(("MOVE_TO_TARGET", State.ALIGNED, "DRILL"))
    return [float(m.body.values[0]) for m in said if m.device_name == OPEN_HOLE_DEPTH]


@pytest.mark.parametrize("why", ["STOP", "client lost", "fault"])
def test_a_hole_left_unfinished_is_finished_from_its_bottom(why):
    """Its zero holds, contact is not sought, and both parts are recorded."""
    rig, zero = stopped(why)
    assert told_again(rig) == [pytest.approx(6.0, abs=0.1)]
    rig.run_until(State.PAUSED)
    rig.command("DRILL")
    rig.run_until(State.DONE)
    assert rig.controller.machine.drilling.zero == zero
    assert zero.sd_mm < PLAN_SD_MM
    assert rig.plant.q[FEED] == pytest.approx(zero.feed_mm + SHORT_MM, abs=0.02)
    noted = [(one.event.value, one.depth_mm) for one in rig.controller.machine.drilling.noted]
    assert noted[:2] == [("open hole", pytest.approx(6.0, abs=0.1)), ("contact", pytest.approx(6.0, abs=0.2))]


def test_after_a_stop_the_same_target_is_drilled_on_without_being_sent_again():
    rig = through(Holed({1.1: CORTEX_N}), {}, SHORT_MM)
    rig.go((State.PAUSED, "DRILL"))
    rig.run_until_depth(SHORT_MM - 5.0)
    zero = rig.controller.machine.drilling.zero
    rig.go(("STOP", "MOVE_TO_TARGET", State.ALIGNED, "DRILL"))
    rig.run_until(State.PAUSED)  # in the hole: a second shot comes before the rest
    assert rig.controller.machine.snapshot().depth_mm == pytest.approx(SHORT_MM - 10.0, abs=0.02)
    rig.command("DRILL")
    rig.run_until(State.DONE)
    assert rig.controller.machine.drilling.zero == zero


def test_bone_in_an_open_hole_stops_and_another_target_has_none():
    rig, _ = stopped("STOP")
    rig.plant.moved = True
    assert told_again(rig)
    said = rig.run_until(State.STOP)
    assert any("in the hole that it drilled to 6.0 mm: bone or robot has moved" in text for text in texts(said))
    assert rig.plant.q[FEED] - rig.plant.zero_mm < 1.5
    rig.plant.moved = False
    assert told_again(rig, END_MM + np.array([0.1, 0.0, 0.0])) == []
    said = rig.run_until(State.STOP)
    assert any("no bone was met" in text and "a hole that this robot does not know" in text for text in texts(said))


def test_a_hole_that_ended_in_a_cortex_must_have_one_behind_its_bottom():
    """A wire that slipped back in its chuck would go on by that much too far: the robot stops behind the bottom."""
    rig, _ = stopped("STOP")
    rig.plant.bottom_mm += 5.0
    told_again(rig)
    said = rig.run_until(State.STOP)
    assert any("no bone was met up to 9.0 mm beyond" in text and "a cortex at 6.0 mm" in text for text in texts(said))


def texts(said: list[Message]) -> list[str]:
    return [message.body.text for message in said if isinstance(message.body, Status)]


def test_depth_travels_with_its_error_and_is_recorded_with_it():
    rig = drilling(0.4)
    rig.send("", Capability(("X_TELEMETRY",)))
    rig.dialogue.telemetry_s = VIRTUAL_TELEMETRY_S
    recorder = Recorder()
    streamed = []
    while rig.state is not State.PAUSED:
        rig.now_s += 0.005
        rig.plant.advance(0.005)
        for outgoing in rig.dialogue.cycle(rig.now_s):
            recorder.heard(outgoing.message)
            streamed.append(outgoing.message.device_name)
    assert streamed.index(DEPTH_SD) < streamed.index(DEPTH)  # the error is that of the depth that follows
    record = recorder.record
    assert record.depth_sd_mm[0] == PLAN_SD_MM
    assert record.depth_sd_mm[-1] == pytest.approx(PLAN_SD_MM * np.sqrt(1 - WEIGHT))
    told = record.document()
    assert len(told["depth_sd_mm"]) == len(told["depth_mm"]) > 100
    assert [event.name for event in record.events][:2] == ["contact", "cortex"]


def test_a_shot_that_leaves_too_little_feed_is_refused():
    rig = deepcopy(_paused(1.1))
    hole, manipulator = rig.controller.machine.drilling, rig.controller.machine.robot.manipulator
    hole._manipulator = replace(manipulator, upper=rig.plant.q + np.array([9, 9, 9, 9, 10.3]))
    with pytest.raises(RobotRefusedError, match="the feed would end"):
        hole.correct_depth(float(rig.plant.q[FEED]), SHORT_MM - 11.0, 0.1)
