"""Check shots of a rehearsal: what a right wire looks like at any depth."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

import sightline as sl
from sightline.common.checks import failed
from sightline.frame import Frame
from sightline.from_images.pipeline import check_shot, label_beads
from sightline.planning import plan
from sightline.planning.check.shot import Landmarks
from sightline.rehearsal.rehearsal import VIEWS, Rehearsal
from sightline.robot.link.record import SimulatedWire

SEED = 9  # in its lateral image the femur's outline crosses the wire and pulls a piece of it aside by half a pixel


@pytest.fixture(scope="module")
def rehearsal() -> Rehearsal:
    return Rehearsal.draw(SEED, Frame.load("gamma"))


@pytest.mark.slow
@pytest.mark.parametrize("short_mm", [0.0, 0.2, 0.4, 0.6])
def test_a_wire_where_it_was_planned_passes_at_any_depth(rehearsal: Rehearsal, short_mm: float) -> None:
    """Where the pieces of its centre line begin and end follows from the tip."""
    frame, wire = rehearsal.setup.frame, rehearsal.hip.wire_mm
    views = []
    for name in VIEWS:
        image = rehearsal.images[name]
        views.append(sl.calibrate(label_beads(image, sl.detect(image), frame, name), frame))
    uv, names = rehearsal.pixels(wire), list(rehearsal.landmarks)
    marks = np.stack([rehearsal.landmarks[name] for name in names], axis=1)
    made = plan(views, uv[:, 0], uv[:, 1], landmarks_uv_px=marks)
    along = (wire[1] - wire[0]) / np.linalg.norm(wire[1] - wire[0])
    drilled = np.stack([wire[0], wire.mean(axis=0), wire[1] - short_mm * along])
    taken = rehearsal.check_images(SimulatedWire(drilled, RigidTransform.identity(), np.zeros(5)))
    landmarks = Landmarks(marks, taken.landmarks_px(names, 0.0, np.random.default_rng(0)), 0.5)
    found = check_shot(made, views, [taken.images[name] for name in VIEWS], frame, landmarks=landmarks)
    assert not failed(found.checks), [check.sentence for check in failed(found.checks)]
    assert found.deviation_mm[4] == pytest.approx(-short_mm, abs=3 * np.sqrt(found.covariance_mm2[4, 4]))


def test_images_that_are_taken_again_show_another_place_of_the_c_arm(
    rehearsal: Rehearsal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fails where a refused check shot would be refused for ever, because each one is the first again."""
    noise = lambda setup, names, scene, rng: {name: rng.standard_normal(9) for name in names}  # noqa: E731
    monkeypatch.setattr("sightline.rehearsal.patient.render_views", noise)
    monkeypatch.setattr("sightline.rehearsal.patient.tagged", lambda setup, name, image: image)
    entry, tip = rehearsal.hip.wire_mm
    wire = SimulatedWire(np.stack([entry, (entry + tip) / 2, tip]), RigidTransform.identity(), np.zeros(5))
    first, second, third, again = (rehearsal.check_images(wire, retake=n) for n in (0, 1, 2, 1))
    tips = [taken.pixels(wire.axis_mm, 0.0, np.random.default_rng(0))[:, -1] for taken in (first, second, third)]
    for one, other in ((0, 1), (1, 2), (0, 2)):
        assert np.linalg.norm(tips[one] - tips[other], axis=1).min() > 5.0
    for name in VIEWS:
        np.testing.assert_array_equal(again.images[name], second.images[name])
