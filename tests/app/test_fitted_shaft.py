"""The shaft of the step Plan drawn by both borders, and fitted to the edges of its images: kept, undone, and ended."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.planning import bone

from sightline.app.plan.decisions import Decisions, Mark
from sightline.app.plan.fitted import FittedShaft
from sightline.app.plan.planner import drawn_shaft, plan_input, planned
from sightline.case.views import NAMES
from sightline.errors import CaseError
from sightline.planning import Line

AXIS = ("shaft-1", "shaft-2")
BORDERS = tuple(f"shaft-border-{k}" for k in range(1, 5))
WIDE_PX = 60.0


def _drawn() -> Decisions:
    """The wire, the shaft's axis, and clicks on its borders, in both images; borders are on."""
    decisions = Decisions(side="right", borders=True)
    uv = bone.pixels(bone.views())
    across = np.array([[-WIDE_PX, 0.0], [WIDE_PX, 0.0]])
    marks = {name: [each[k] for each in uv["wire"]] for k, name in enumerate(("entry", "end"))}
    marks |= {name: [each[k] + 3.0 for each in uv["shaft"]] for k, name in enumerate(AXIS)}
    marks |= {name: [each[k % 2] + across[k // 2] for each in uv["shaft"]] for k, name in enumerate(BORDERS)}
    for name, places in marks.items():
        at = {image: (float(u), float(v)) for image, (u, v) in zip(NAMES, places, strict=True)}
        decisions = decisions.with_mark(name, Mark(at))
    return decisions


def _fitted(decisions: Decisions) -> Decisions:
    """Fitted 1 px beside its drawing, in the PA image only."""
    drawn = drawn_shaft(decisions)
    assert drawn is not None and drawn[0].borders_px is not None
    moved = Line(drawn[0].uv_px + 1.0, drawn[0].sd_px, drawn[0].borders_px + 1.0, 0.7 * np.eye(4))
    return replace(decisions, fitted_shaft=FittedShaft.made((moved, drawn[1]), {"lateral": "no clear edge"}))


def test_an_axis_is_drawn_by_itself_or_by_both_borders_and_the_clicks_of_either_stay() -> None:
    """A program that takes two clicks on one border for the axis fails: they have other names."""
    decisions = _drawn()
    uv = bone.pixels(bone.views())["shaft"]
    by_borders = plan_input(decisions, 2).aids
    assert by_borders is not None and by_borders.shaft is not None
    for line, axis in zip(by_borders.shaft, uv, strict=True):
        assert line.borders_px is not None
        assert np.allclose(line.uv_px, axis)
    itself = plan_input(replace(decisions, borders=False), 2).aids
    assert itself is not None and itself.shaft is not None
    for line, axis in zip(itself.shaft, uv, strict=True):
        assert line.borders_px is None
        assert np.allclose(line.uv_px, axis + 3.0)
    assert drawn_shaft(replace(decisions, borders=False)) is None
    left = decisions.with_mark(BORDERS[3], None)
    assert plan_input(left, 2).aids is not None and plan_input(left, 2).aids.shaft is None  # type: ignore[union-attr]
    asked = {spec.name for spec in decisions.specs}
    assert set(BORDERS) <= asked and not set(AXIS) & asked


def test_older_cases_draw_axes_themselves() -> None:
    document = _drawn().document()
    assert Decisions.of(document).borders
    del document["borders"], document["fitted_shaft"]
    assert not Decisions.of(document).borders and Decisions.of(document).fitted_shaft is None


def test_a_fit_comes_back_from_its_json_and_a_broken_one_is_refused() -> None:
    decisions = _fitted(_drawn())
    document = json.loads(json.dumps(decisions.document()))
    assert Decisions.of(document) == decisions
    document["fitted_shaft"]["lines"][0]["covariance_px2"] = [[1.0]]
    with pytest.raises(CaseError, match="cannot be read"):
        Decisions.of(document)
    document["fitted_shaft"] = {"lines": [{"uv_px": [[1.0, 2.0], [3.0, 4.0]]}] * 2, "kept": {}}
    with pytest.raises(CaseError, match="cannot be read"):
        Decisions.of(document)


def test_a_fit_ends_with_another_click_on_a_border_or_another_image_and_with_nothing_else() -> None:
    """A program that kept it would plan on a shaft that is not the one drawn, or not of this image."""
    decisions = _fitted(_drawn())
    assert decisions.with_mark(BORDERS[2], Mark({"pa": (1.0, 2.0)})).fitted_shaft is None
    assert decisions.with_mark(BORDERS[0], None).fitted_shaft is None
    assert decisions.with_image("lateral", 9, same_pixels=False).fitted_shaft is None
    assert decisions.with_image("lateral", 9, same_pixels=True).fitted_shaft is not None
    assert decisions.with_image("oblique", 9, same_pixels=False).fitted_shaft is not None
    for name in ("entry", "head-1", "neck-border-1", AXIS[0]):
        assert decisions.with_mark(name, Mark({"pa": (1.0, 2.0)})).fitted_shaft is not None


def test_the_verdicts_angle_takes_the_fitted_axis_and_its_error() -> None:
    """A program that kept the error of the clicks would state a quarter of it here."""
    before, after = (planned(one, bone.views()) for one in (_drawn(), _fitted(_drawn())))  # type: ignore[arg-type]
    angles = [next(one for one in each.metrics if one.name == "wire to shaft") for each in (before, after)]
    assert angles[0].value is not None and angles[1].value is not None
    assert angles[0].sd is not None and angles[1].sd is not None
    assert angles[1].value != angles[0].value
    assert angles[1].sd > 1.3 * angles[0].sd
    assert after.anatomy.shaft is not None and after.anatomy.shaft.direction_covariance_rad2 is not None
    assert planned(replace(_fitted(_drawn()), borders=False), bone.views()).fitted_shaft is None  # type: ignore[arg-type]
