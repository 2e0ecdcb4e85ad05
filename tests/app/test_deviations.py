"""The arrows from plan to measured wire in a check image."""

import numpy as np

from sightline.app.drawing.shapes import deviations
from sightline.calibration import calibrate
from sightline.detection import Observations
from sightline.frame import Frame
from sightline.twin import bead_images, draw_setup


def test_an_arrow_points_from_plan_to_wire_and_names_the_distance_in_space() -> None:
    frame = Frame.load("gamma")
    setup = draw_setup(np.random.default_rng(21), frame)
    ids, uv = bead_images(setup, "pa", np.random.default_rng(3), 0.1)
    noise = np.repeat(0.01 * np.eye(2)[None], len(ids), axis=0)
    view = calibrate(Observations("pa", ids, uv, noise, image_shape=(1024, 1024)), frame, view="pa")
    planned = np.array([[-31.3, 12.4, 3.7], [0.0, 900.0, 0.0]])  # the tip is outside the view
    off = np.array([0.9, -1.1, 1.3])  # the PA image shows little of z
    (arrow,) = deviations(view, planned, planned + off, ((1.926, 0.314), (2.0, 0.3)))
    tail, there = view.project(np.stack([planned[0], planned[0] + off]))
    np.testing.assert_allclose(arrow["points"], [tail, tail + 10 * (there - tail)], atol=1e-9)
    assert arrow["label"] == "entry 1.93 ± 0.31 mm off"  # fails where a distance is shown without its error
    assert "10 times as long" in arrow["title"]
