"""A record holds the robot's samples and events, and nothing else."""

import numpy as np
import pytest

from sightline.robot import contract
from sightline.robot.igtl import Message, Sensor, String
from sightline.robot.link.record import DrillingEvent, DrillingRecord, Recorder, last_hole


def test_depth_goes_with_the_force_before_it_and_events_keep_their_order():
    recorder = Recorder()
    assert recorder.record.depth_mm.shape == (0,)
    stands = [(1.5, 4.0), (1.504, 30.25), *[(1.5, 2.0)] * 100]  # while a person thinks
    for depth, force in ((-1.0, 0.2), (0.5, 12.5), *stands):
        recorder.heard(Message(Sensor(np.array([force])), contract.FORCE))
        recorder.heard(Message(Sensor(np.array([depth])), contract.DEPTH))
    recorder.heard(Message(String("contact; 0.12 mm; 1.4 N"), contract.EVENT))
    recorder.heard(Message(String("break-through; 5.31 mm; -0.4 N"), contract.EVENT))
    record = recorder.record
    assert np.allclose(record.depth_mm, [-1.0, 0.5, 1.5])
    assert np.allclose(record.force_n, [0.2, 12.5, 30.25])
    assert record.events == (DrillingEvent("contact", 0.12, 1.4), DrillingEvent("break-through", 5.31, -0.4))
    assert record.document()["events"][1] == {"name": "break-through", "depth_mm": 5.31, "force_n": -0.4}
    assert record.depth_sd_mm is record.document()["depth_sd_mm"] is None  # the robot states no error


def test_a_hole_that_was_drilled_in_two_is_one_record_and_another_is_not():
    first, other = (
        DrillingRecord(np.array([depth]), np.array([3.0]), (DrillingEvent("contact", 0.1, 1.2),), np.array([0.4]))
        for depth in (30.0, 5.0)
    )
    rest = DrillingRecord(np.array([80.0]), np.array([0.2]), (DrillingEvent("open hole", 30.0, 0.0),), np.array([0.4]))
    assert last_hole([]) is None
    assert last_hole([rest, other]) is other
    whole = last_hole([other, first, rest])
    assert whole is not None
    assert (whole.depth_mm.tolist(), whole.force_n.tolist()) == ([30.0, 80.0], [3.0, 0.2])
    assert [event.name for event in whole.events] == ["contact", "open hole"]
    assert whole.depth_sd_mm is not None and len(whole.depth_sd_mm) == 2


@pytest.mark.parametrize(
    "message",
    [
        Message(Sensor(np.array([1.0])), contract.DEPTH),  # no force yet
        Message(Sensor(np.array([1.0, 2.0])), contract.FORCE),
        Message(Sensor(np.array([np.nan])), contract.DEPTH),
        Message(Sensor(np.array([1.0])), "other/depth"),
        Message(String("contact; 0.12 m; 1.4 N"), contract.EVENT),
        Message(String("<b>contact</b>; 0.12 mm; 1.4 N"), contract.EVENT),
        Message(String("contact; 0.12 mm; 1.4 N"), "other/event"),
    ],
)
def test_what_is_no_sample_and_no_event_passes_by(message):
    recorder = Recorder()
    recorder.heard(message)
    record = recorder.record
    assert len(record.depth_mm) == len(record.force_n) == len(record.events) == 0
