"""What to move before the next exposure."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import GAMMA, Camera, choose

from sightline.calibration import advise
from sightline.errors import CalibrationRefusedError, UnusableInputError

ROW, COLUMN = np.mgrid[:1024, :1024]
ROUND = (ROW - 511.5) ** 2 + (COLUMN - 511.5) ** 2 < 506.0**2
BEADS = np.array([f.xyz_mm for f in GAMMA.view("pa").fiducials])


def seen_from(shift_mm, bend: float = 0.03):
    """The beads in the round field of a frame shifted against the C-arm, labelled."""
    camera = replace(Camera.pa(bend=bend), pitch_mm=0.24)
    uv = camera.project(BEADS + np.asarray(shift_mm))
    whole = replace(camera.observe(GAMMA), uv_px=uv)
    inside = np.linalg.norm(uv - 511.5, axis=1) < 496.0
    return choose(whole, {i for i, k in zip(whole.ids, inside, strict=True) if k}.__contains__), inside


@pytest.mark.parametrize("shift", [(45.0, 0.0, 0.0), (0.0, -50.0, 0.0), (-40.0, 35.0, 0.0)])
def test_it_says_how_to_bring_the_plates_back(shift):
    observations, inside = seen_from(shift)
    advice = advise(observations, GAMMA, ROUND)
    assert max(advice.outside.values()) > 0.1
    on_xrii = np.arange(len(BEADS)) < len(GAMMA.view("pa").xrii.fiducials)
    for name, mine in (("XRII", on_xrii), ("source", ~on_xrii)):
        assert advice.outside[name] == pytest.approx(1 - inside[mine].mean(), abs=0.08)
    assert seen_from(np.array(shift) + advice.move_mm)[1].mean() > 0.98
    assert np.linalg.norm(advice.move_mm) <= np.linalg.norm(shift) + 5.0
    for axis, mm in enumerate(advice.move_mm):
        if mm:
            assert f"{abs(mm):.0f} mm" in advice.sentences[0]
            assert f"({'+-'[int(mm < 0)]}{'XYZ'[axis]})" in advice.sentences[0] or axis == 1


def test_nothing_is_to_be_moved_when_all_is_seen():
    advice = advise(seen_from((0.0, 0.0, 0.0))[0], GAMMA, ROUND)
    assert not advice.move_mm.any()
    assert "need not be moved" in advice.sentences[0]


def test_without_a_mask_the_whole_image_counts():
    observations = seen_from((45.0, 0.0, 0.0))[0]
    assert max(advise(observations, GAMMA).outside.values()) < max(advise(observations, GAMMA, ROUND).outside.values())


def test_what_cannot_be_advised_is_refused():
    observations = seen_from((0.0, 0.0, 0.0))[0]
    with pytest.raises(UnusableInputError, match="size of the image"):
        advise(replace(observations, image_shape=None), GAMMA)
    with pytest.raises(CalibrationRefusedError, match="at least 4"):
        advise(choose(observations, lambda i: i in observations.ids[:3]), GAMMA, ROUND)
