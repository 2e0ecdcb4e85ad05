"""The default orientation: the patient's head up, however an image is stored."""

import numpy as np
import pytest
from tests.three import draw_three

from sightline.app.drawing.pictures import head_in, head_up
from sightline.calibration import BeadView, calibrate
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.detection import Observations
from sightline.frame import Frame
from sightline.twin import SetUp, bead_images, draw_setup

SIDE_PX = 1024
FRAME = Frame.load("gamma")


def _observed(setup: SetUp, name: str, quarter: int) -> Observations:
    """An image of SIDE_PX x SIDE_PX, stored `quarter` quarter turns clockwise."""
    ids, uv = bead_images(setup, name, np.random.default_rng(3), 0.1)
    for _ in range(quarter):
        uv = np.stack([SIDE_PX - 1 - uv[:, 1], uv[:, 0]], axis=1)
    noise = np.repeat(0.01 * np.eye(2)[None], len(ids), axis=0)
    return Observations(name, ids, uv, noise, image_shape=(SIDE_PX, SIDE_PX))


def _view(name: str, quarter: int = 0) -> BeadView:
    return calibrate(_observed(draw_setup(np.random.default_rng(21), FRAME), name, quarter), FRAME, view=name)


@pytest.mark.parametrize(("side", "to_head_mm"), [("right", -25.0), ("left", 25.0)])
@pytest.mark.parametrize("name", ["pa", "lateral"])
def test_the_head_is_up_however_the_image_is_stored(name: str, side: str, to_head_mm: float) -> None:
    stored = []
    for quarter in range(4):
        view = _view(name, quarter)
        stored.append(head := head_in(view, FRAME, side))
        assert head is not None
        turn = np.radians(head_up(head))
        right, down = np.diff(view.project(np.array([[4.0, 3.0, -6.0], [4.0, 3.0 + to_head_mm, -6.0]])), axis=0)[0]
        shown = (np.cos(turn) * right - np.sin(turn) * down, np.sin(turn) * right + np.cos(turn) * down)
        assert shown[1] < -0.7 * np.hypot(*shown)  # within an eighth of a turn of up
    assert [(head - stored[0]) % 360 for head in stored] == [0, 90, 180, 270]


def test_it_is_unknown_without_a_side_a_map_or_plates() -> None:
    view = _view("pa")
    assert head_in(None, FRAME, "right") is None
    assert head_in(view, FRAME, None) is None
    block = draw_three(np.random.default_rng(17), "flat-panel-0.3")[0]
    seen = [_observed(block, name, 0) for name in ("pa", "lateral")]
    assert head_in(calibrate_together(seen, block.frame)[0], block.frame, "right") is None
    assert head_up(None) == 0
