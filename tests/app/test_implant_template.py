"""The implant that fits the wire, as the app draws it."""

from typing import cast

import numpy as np
import pytest
from tests.planning import bone

from sightline.app.drawing import shapes
from sightline.app.plan.decisions import Decisions, Mark
from sightline.app.plan.marks import END, ENTRY
from sightline.app.plan.planner import Planned, planned
from sightline.calibration import BeadView
from sightline.case.views import NAMES
from sightline.errors import OutsideRegionError


def _known(end_mm: np.ndarray = bone.END_MM) -> Planned:
    """A hip screw planned on stand-in views."""
    decisions = Decisions()
    for name, at in ((ENTRY, bone.ENTRY_MM), (END, end_mm)):
        mark = Mark()
        for image, view in zip(NAMES, bone.views(), strict=True):
            u, v = view.project(at[None])[0]
            mark = mark.placed(image, (float(u), float(v)))
        decisions = decisions.with_mark(name, mark)
    known = planned(decisions, cast("list[BeadView]", bone.views()))
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
