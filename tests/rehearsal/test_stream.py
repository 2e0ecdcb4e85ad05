"""The simulated fluoroscopy, watched image by image: no clock has a part in it."""

import time

import numpy as np
import pytest

from sightline.case.watch.analyser import REST_FRAMES, LiveAnalyser
from sightline.frame import Frame
from sightline.rehearsal.stream import BUMP_MM, IMAGES_PER_S, Shot, SimulatedFluoroscopy


@pytest.mark.slow
def test_the_bump_is_told_with_its_second_image_and_the_wire_is_drawn() -> None:
    frame = Frame.load("gamma")
    stream = SimulatedFluoroscopy(3, frame)
    analyser = LiveAnalyser(frame, stream.wire, ())
    still = [stream.still[k % len(stream.still)] for k in range(REST_FRAMES + 3)]
    shots = [Shot(one, k + 1, time.time()) for k, one in enumerate([*still, *stream.moved])]
    said = [analyser.look(shot, time.monotonic(), shot.number, 0) for shot in shots]
    before, after = said[: len(still)], said[len(still) :]
    assert all(w.reason == "" for w in said)
    assert not any(w.moved for w in before)
    assert [w.moved for w in after] == [False] + [True] * (len(after) - 1)
    assert after[1].movement.shift_mm == pytest.approx(BUMP_MM, abs=0.05)
    ends = said[0].view.project(np.stack([stream.wire.entry_mm, stream.wire.end_mm]))
    assert said[0].corridor.uv_px[[0, -1]] == pytest.approx(ends, abs=0.01)
    assert said[0].corridor.half_95_px is None  # nobody planned it


def test_stored_images_come_when_their_time_has_come(monkeypatch) -> None:
    now_s = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(time, "time", lambda: 1e9 + now_s[0])
    monkeypatch.setattr(time, "sleep", lambda for_s: now_s.append(now_s.pop() + for_s))
    stream = object.__new__(SimulatedFluoroscopy)
    stream.still, stream.moved, stream._closed = ("a", "b"), ("c",), False
    shots = iter(stream)
    first, second, third = next(shots), next(shots), next(shots)
    assert (first.image, second.image, third.image) == ("a", "b", "a")
    assert first.number == 1
    assert third.stamped_s - first.stamped_s == pytest.approx(2 / IMAGES_PER_S)
    now_s[0] += 0.05  # whoever watches was late: the next image comes at once, the one after it in its own time
    assert [next(shots).stamped_s, next(shots).stamped_s] == pytest.approx([1e9 + now_s[0] - 1 / 60, 1e9 + now_s[0]])
    stream.close()
    assert next(shots, None) is None
