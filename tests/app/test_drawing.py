"""What is drawn over an image: the patient's head up, the arrows from plan to measured wire, the implant on a wire."""

from typing import cast

import numpy as np
import pytest
from tests.app.given import marked, observed
from tests.planning import bone
from tests.three import draw_three

from sightline.app.drawing import shapes
from sightline.app.drawing.pictures import head_in, head_up
from sightline.app.drawing.shapes import deviations
from sightline.app.plan.decisions import Decisions
from sightline.app.plan.marks import END, ENTRY
from sightline.app.plan.planner import Planned, planned
from sightline.calibration import BeadView, calibrate
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.case.views import NAMES
from sightline.errors import OutsideRegionError
from sightline.frame import Frame
from sightline.twin import draw_setup

FRAME = Frame.load("gamma")


def _view(name: str, quarter: int = 0) -> BeadView:
    seen = observed(draw_setup(np.random.default_rng(21), FRAME), name, np.random.default_rng(3), quarter)
    return calibrate(seen, FRAME, view=name)


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
    seen = [observed(block, name, np.random.default_rng(3)) for name in NAMES]
    assert head_in(calibrate_together(seen, block.frame)[0], block.frame, "right") is None
    assert head_up(None) == 0


def test_an_arrow_points_from_plan_to_wire_and_names_the_distance_in_space() -> None:
    view = _view("pa")
    planned = np.array([[-31.3, 12.4, 3.7], [0.0, 900.0, 0.0]])  # the tip is outside the view
    off = np.array([0.9, -1.1, 1.3])  # the PA image shows little of z
    (arrow,) = deviations(view, planned, planned + off, ((1.926, 0.314), (2.0, 0.3)))
    tail, there = view.project(np.stack([planned[0], planned[0] + off]))
    np.testing.assert_allclose(arrow["points"], [tail, tail + 10 * (there - tail)], atol=1e-9)
    assert arrow["label"] == "entry 1.93 ± 0.31 mm off"  # fails where a distance is shown without its error
    assert "10 times as long" in arrow["title"]


def _known(end_mm: np.ndarray = bone.END_MM) -> Planned:
    """A hip screw planned on stand-in views."""
    uv_px = [view.project(np.stack([bone.ENTRY_MM, end_mm])) for view in bone.views()]
    places = {name: [uv[k] for uv in uv_px] for k, name in enumerate((ENTRY, END))}
    known = planned(marked(Decisions(), places), cast("list[BeadView]", bone.views()))
    assert known.plan is not None, known.refused
    return known


@pytest.mark.parametrize("image", NAMES)
def test_the_implant_lies_under_the_wire_with_its_thread_and_its_length_in_the_title(image: str) -> None:
    known = _known()
    assert known.plan is not None and known.plan.implant is not None
    drawn = shapes.wire(known, image)
    assert [one["style"] for one in drawn] == ["implant", "thread", "corridor", "wire"]
    outline, thread, _, wire = drawn
    length = known.plan.implant.length_mm
    assert outline["title"] == f"Lag screws: {length:g} mm from the entry point, 12.5 mm thick"
    assert outline["points"][0] == pytest.approx(wire["points"][0])  # both begin at the entry
    assert thread["points"][-1] == outline["points"][-1] != wire["points"][-1]  # the wire goes beyond it
    # A 2.5 mm wire and a 12.5 mm screw have one magnification.
    assert np.divide(outline["halfWidth"][0], wire["halfWidth"][0]) == pytest.approx(12.5 / known.plan.kind.wire_mm)


def test_a_wire_shorter_than_any_implant_is_drawn_alone() -> None:
    along = bone.END_MM - bone.ENTRY_MM
    drawn = shapes.wire(_known(bone.ENTRY_MM + 49.0 * along / np.linalg.norm(along)), NAMES[0])
    assert [one["style"] for one in drawn] == ["corridor", "wire"]


def test_the_wire_stays_where_the_view_does_not_show_the_implant(monkeypatch: pytest.MonkeyPatch) -> None:
    def outside(*_: object) -> None:
        raise OutsideRegionError("view 'pa' does not show the implant")

    monkeypatch.setattr(shapes, "template", outside)
    assert [one["style"] for one in shapes.wire(_known(), NAMES[0])] == ["corridor", "wire"]
