"""Directions of views against those that a procedure wants: judged where the frame tells how the patient lies."""

import json
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from sightline.calibration.view import LinesOfSight
from sightline.planning import Plan, Procedure, kind, plan
from sightline.planning.procedures.files import copy_text, document_from_json
from sightline.planning.view_directions import angles_of, assumed_axes, beam_of, unknown_directions

from . import bone
from .standin import StandInView, stand_in, turned

WIRE_MM = np.array([[12.0, 9.0, -4.0], [-20.0, -11.0, 6.0]])


@dataclass(frozen=True, eq=False)
class OfBlock(StandInView):
    """A view of a block."""

    def lines_of_sight(self, uv_px: np.ndarray) -> LinesOfSight:
        """As of views that were adjusted together."""
        return replace(super().lines_of_sight(uv_px), adjustment="one")


@cache
def _views(first: float, second: float, side: str = "right") -> list[StandInView]:
    """Two views from anterior, with the detector tilted by these angles towards the head."""
    towards = 1.0 if side == "right" else -1.0  # a positive rotation about +X takes +Z to -Y, the head of a right side
    pa = stand_in("pa", 0.3, 0.05)
    return [turned(pa, "x", towards * angle, name) for name, angle in (("inlet", first), ("outlet", second))]


def _procedure(required: bool = False) -> Procedure:
    given = json.loads(copy_text("iliosacral-screw", "mine"))
    given["checks"] = [{"check": "view directions", "required": required, "source": "a test"}]
    return Procedure.of(document_from_json(json.dumps(given)))


def _plan(views: list[StandInView], side: str | None = "right", required: bool = False) -> Plan:
    uv = np.array([view.project(WIRE_MM) for view in views])
    known = _procedure(required)
    return plan(views, uv[:, 0], uv[:, 1], kind=known, side=side, curve=lambda *_: bone.curve_once())


def test_angles_are_those_of_the_procedures_page():
    assert beam_of(0.0, 0.0, None) == pytest.approx([0.0, 0.0, 1.0])  # towards anterior
    assert beam_of(90.0, 0.0, None) == pytest.approx([1.0, 0.0, 0.0])  # towards the operated side
    assert beam_of(0.0, 90.0, "right") == pytest.approx([0.0, -1.0, 0.0])  # towards the head: caudal is +Y
    assert beam_of(0.0, 90.0, "left") == pytest.approx([0.0, 1.0, 0.0])
    for side in ("right", "left"):
        assert angles_of(beam_of(-31.0, 17.0, side), side) == pytest.approx((-31.0, 17.0))


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize(
    ("inlet", "outlet", "passes"), [(25, -42, True), (12, -50, True), (25, -20, False), (45, -42, False)]
)
def test_a_view_from_elsewhere_fails_and_says_where_it_was(inlet: float, outlet: float, passes: bool, side: str):
    """Wanted are 25° and -42° within 15°; the wire lies beside the axis of the beams, by up to 1.5°."""
    made = _plan(_views(inlet, outlet, side), side)
    (judged,) = (check for check in made.verdict.checks if check.name == "view directions")
    assert judged.passed == passes and judged.limit == 15.0
    worst = max(abs(inlet - 25), abs(outlet + 42))
    assert judged.figure == pytest.approx(worst, abs=2.0)
    if not passes:
        name, tilt = ("inlet", 25) if abs(inlet - 25) > 15 else ("outlet", -42)
        assert f"The view {name} is" in judged.sentence and f"acquire it at orbit 0°, tilt {tilt}°" in judged.sentence


def test_exchanged_images_and_a_wrong_side_fail():
    inlet, outlet = _views(25, -42)
    for views, side in (([outlet, inlet], "right"), ([inlet, outlet], "left")):
        (judged,) = (check for check in _plan(views, side).verdict.checks if check.name == "view directions")
        assert not judged.passed


def test_the_side_is_needed_where_a_view_is_tilted():
    assert "view directions" not in {check.name for check in _plan(_views(25, -42), None).verdict.checks}
    required = _plan(_views(25, -42), None, required=True)
    (missing,) = (one for one in required.verdict.unmade if one.name == "view directions")
    assert "the side is not given" in missing.sentence


def test_a_block_does_not_say_how_the_patient_lies():
    """The check is left out and the plan says so; required, it is missing. It never passes."""
    views = [OfBlock(**vars(view)) for view in _views(25, -42)]
    left_out = _plan(views)
    assert "view directions" not in {check.name for check in left_out.verdict.checks}
    assert any("nothing says how the patient lies" in said for said in left_out.sentences())
    required = _plan(views, required=True)
    assert {"view directions"} <= {check.name for check in required.verdict.unmade}
    assert not any("nothing says how" in said for said in _plan(_views(25, -42)).sentences())
    assert unknown_directions(kind("hip-screw"), views) == ""  # it has no such check
    assert "axes are taken for the patient's" in assumed_axes(kind("hip-screw"), views)  # by its check of the side
    assert assumed_axes(kind("hip-screw"), _views(25, -42)) == assumed_axes(kind("pedicle-screw"), views) == ""
