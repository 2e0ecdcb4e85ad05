"""Head, shaft and neck fitted to the edges of drawn images, whose views are known: what a session keeps, ends, and
refuses."""

import asyncio
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.app.given import marked
from tests.planning import bone
from tests.planning.bone import rim, views
from tests.test_fitted_head import head_image
from tests.test_fitted_neck import neck_borders, neck_image

from sightline.app.plan.decisions import Decisions, Mark, as_fitted
from sightline.app.plan.planner import drawn_axis, drawn_head, picks_of, plan_input, planned
from sightline.app.session import planning as module
from sightline.app.session.jobs import Jobs
from sightline.app.session.planning import Planning
from sightline.case.journal import Case
from sightline.case.picks import Picks, ask_plan
from sightline.case.views import NAMES
from sightline.errors import CaseError, UnusableInputError
from sightline.imaging import Radiograph
from sightline.planning import Line

VIEWS: Any = tuple(views())
RIM_RAD = np.array([0.4, 2.3, 4.6])
AT = {"pa": (100.0, 100.0), "lateral": (100.0, 100.0)}
AXIS = ("shaft-1", "shaft-2")
BORDERS = tuple(f"shaft-border-{k}" for k in range(1, 5))
WIDE_PX = 60.0
Images = tuple[Radiograph, Radiograph]


class _Planning(Planning):
    """With images whose views are known."""

    images: Images
    calibrated = True

    def seen(self, image: str) -> Any:
        return SimpleNamespace(image=self.images[NAMES.index(image)]) if image in NAMES else None

    def views(self, names: tuple[str, ...] | None = None) -> Any:
        return VIEWS if self.calibrated else None


@cache
def _good() -> Images:
    """Images of a femur's head and neck."""
    first, second = (neck_image(view, k) for k, view in enumerate(VIEWS))
    return first, second


def _dark(image: Radiograph) -> Radiograph:
    """The image of nothing."""
    return Radiograph(np.full_like(image.pixels, 9000), 65535.0)


@cache
def _drawn() -> Decisions:
    """Wire, head's rim, neck's borders, and the shaft's axis and borders, in both images; borders are on."""
    decisions = Decisions(side="right", borders=True)
    uv, across = bone.pixels(list(VIEWS)), np.array([[-WIDE_PX, 0.0], [WIDE_PX, 0.0]])
    rims = [rim(view, RIM_RAD) for view in VIEWS]
    lines = [neck_borders(view, 2.0).borders_px.reshape(4, 2) for view in VIEWS]
    marks = {name: [each[k] for each in uv["wire"]] for k, name in enumerate(("entry", "end"))}
    marks |= {name: [each[k] + 3.0 for each in uv["shaft"]] for k, name in enumerate(AXIS)}
    marks |= {name: [each[k % 2] + across[k // 2] for each in uv["shaft"]] for k, name in enumerate(BORDERS)}
    marks |= {f"head-{k + 1}": [each[k] for each in rims] for k in range(3)}
    marks |= {f"neck-border-{k + 1}": [each[k] for each in lines] for k in range(4)}
    return marked(decisions, marks)


def _with_shaft(decisions: Decisions) -> Decisions:
    """With the shaft fitted 1 px beside its drawing, in the PA image only."""
    drawn = drawn_axis(decisions, "shaft")
    assert drawn is not None and drawn[0].borders_px is not None
    moved = Line(drawn[0].uv_px + 1.0, drawn[0].sd_px, drawn[0].borders_px + 1.0, 0.7 * np.eye(4))
    return replace(decisions, fitted_shaft=as_fitted((moved, drawn[1]), {"lateral": "no clear edge"}))


@pytest.fixture
def planning(tmp_path: Path) -> Iterator[_Planning]:
    nobody: Any = None
    with Case.create(tmp_path) as case:
        made = _Planning(case, "gamma", nobody, Jobs())
        made.images = _good()
        made.edit(_drawn())
        yield made


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Decisions:
    """All three fitted: the head and from it the neck to their images."""
    nobody: Any = None
    with Case.create(tmp_path_factory.mktemp("fitted")) as case:
        made = _Planning(case, "gamma", nobody, Jobs())
        made.images = _good()
        made.edit(_drawn())
        asyncio.run(made.fit("head"))
        asyncio.run(made.fit("neck"))
        return _with_shaft(made.decisions)


def _kept(planning: _Planning, match: str, fit: str = "head") -> str:
    """Fit in vain: nothing is changed, in the decisions and in the journal. Return what is said."""
    before, last = planning.decisions, planning.case.last
    with pytest.raises(UnusableInputError, match=match) as refused:
        asyncio.run(planning.fit(fit))
    assert planning.decisions is before and planning.case.last == last
    return str(refused.value)


def test_what_is_not_drawn_or_not_calibrated_is_not_fitted(planning: _Planning) -> None:
    planning.calibrated = False
    _kept(planning, "click three points on the head's rim in both calibrated images first")
    planning.calibrated = True
    planning.jobs.working = "fitting the head to its edges"
    _kept(planning, "wait: fitting the head to its edges is not done yet")
    planning.jobs.working = ""
    for left_out, fit, why in (
        ("head-2", "head", "click three points on the head's rim in both calibrated images first"),
        ("head-2", "neck", "on the head's rim in both calibrated images first: the neck"),
        ("neck-border-4", "neck", "border of the neck"),
        (BORDERS[3], "shaft", "click two points on each border of the shaft"),
    ):
        planning.edit(_drawn().with_mark(left_out, None))
        _kept(planning, why, fit)


def test_a_head_without_its_edges_is_kept_as_drawn_and_says_why_in_each_image(planning: _Planning) -> None:
    planning.images = (_dark(_good()[0]), _dark(_good()[1]))
    why = "no edge of a bone is clear within 12 px"
    said = _kept(planning, f"PA image: kept as drawn; .*{why}.*Lateral image: kept as drawn; .*{why}")
    assert said.count("kept as drawn") == len(NAMES)


def test_one_image_without_an_edge_keeps_its_circle_and_the_other_is_fitted(planning: _Planning) -> None:
    """Fails for a plan that takes the fitted circle's small error for the drawn one's."""
    planning.images = (head_image(VIEWS[0], 0), _dark(_good()[1]))
    asyncio.run(planning.fit("head"))
    fitted, drawn = planning.decisions.fitted_head, drawn_head(planning.decisions)
    assert fitted is not None and drawn is not None and list(fitted.kept) == ["lateral"]
    (said,) = module.kept_as_drawn(fitted.kept)
    assert said.startswith("Lateral image: kept as drawn; no edge")
    asked = plan_input(planning.decisions, 2).aids
    assert asked is not None and asked.head is not None
    assert np.array_equal(asked.head[1].uv_px, drawn[1].uv_px)
    assert np.array_equal(asked.head[1].covariance_px2, drawn[1].covariance_px2)
    assert len(asked.head[0].uv_px) > len(drawn[0].uv_px)


@pytest.mark.parametrize(
    ("fit", "change"),
    [
        ("head", lambda planning: planning.edit(planning.decisions.with_image("pa", 90, same_pixels=True))),
        ("head", lambda planning: planning.remove(("head-1",))),
        ("neck", lambda planning: planning.edit(planning.decisions.with_mark("neck-border-1", Mark(AT)))),
        ("neck", lambda planning: planning.edit(planning.decisions.with_mark("head-1", Mark(AT)))),
    ],
)
def test_a_fit_of_what_has_changed_meanwhile_is_dropped(
    planning: _Planning, monkeypatch: pytest.MonkeyPatch, fit: str, change: Callable[[Planning], None]
) -> None:
    """Fails for a session that puts the fit of one drawing, image or head's centre on another."""
    monkeypatch.setattr(planning, "_reopen", lambda: None)

    async def changed(fit: Callable[..., Any], *given: Any) -> Any:
        change(planning)
        return fit(*given)

    monkeypatch.setattr(asyncio, "to_thread", changed)
    with pytest.raises(UnusableInputError, match=f"fit the {fit} again: its drawing"):
        asyncio.run(planning.fit(fit))
    assert planning.decisions.fitted_head is None and planning.decisions.fitted_neck is None


def test_the_plan_takes_what_was_fitted_until_axes_are_drawn_themselves(fitted: Decisions) -> None:
    """A program that fits the neck from other circles than those of the head fails: its axis passes the head's centre.
    One that kept the error of the clicks would state a quarter of the angle's error."""
    known = planned(fitted, VIEWS)
    asked, drawn = plan_input(fitted, 2).aids, drawn_axis(fitted, "neck")
    assert asked is not None and asked.neck is not None and drawn is not None and asked.head is not None
    assert all(line.covariance_px2 is not None for line in asked.neck)
    assert all(line.covariance_px2 is None for line in drawn)
    assert known.anatomy.neck is not None and known.anatomy.head is not None
    assert known.anatomy.neck.distance_mm(known.anatomy.head.centre_mm) < 0.05
    shown = known.fitted_axis("neck")
    assert shown is not None and np.array_equal(shown.axis[0].uv_px, asked.neck[0].uv_px)
    before = planned(replace(fitted, fitted_shaft=None), VIEWS)
    angles = [next(one for one in each.metrics if one.name == "wire to shaft") for each in (before, known)]
    assert angles[0].sd is not None and angles[1].sd is not None
    assert angles[1].value != angles[0].value and angles[1].sd > 1.3 * angles[0].sd
    itself = planned(replace(fitted, borders=False), VIEWS)
    assert itself.fitted_axis("neck") is None and itself.fitted_axis("shaft") is None


def test_an_axis_is_drawn_by_itself_or_by_both_borders_and_the_clicks_of_either_stay() -> None:
    """A program that takes two clicks on one border for the axis fails: they have other names."""
    uv = bone.pixels(list(VIEWS))["shaft"]
    for borders, off in ((True, 0.0), (False, 3.0)):
        aids = plan_input(replace(_drawn(), borders=borders), 2).aids
        assert aids is not None and aids.shaft is not None
        for line, axis in zip(aids.shaft, uv, strict=True):
            assert (line.borders_px is not None) is borders
            assert np.allclose(line.uv_px, axis + off)
    assert drawn_axis(replace(_drawn(), borders=False), "shaft") is None
    left = plan_input(_drawn().with_mark(BORDERS[3], None), 2).aids
    assert left is not None and left.shaft is None
    asked = {spec.name for spec in _drawn().specs}
    assert set(BORDERS) <= asked and not set(AXIS) & asked


def test_a_fit_ends_with_what_it_follows_from_and_with_nothing_else(fitted: Decisions) -> None:
    """A program that kept it would plan on a bone that is not the one drawn, or not of this image."""
    fits = ("fitted_head", "fitted_shaft", "fitted_neck")

    def ended(after: Decisions) -> set[str]:
        return {name for name in fits if getattr(after, name) is None}

    for name, gone in (
        ("head-2", {"fitted_head", "fitted_neck"}),  # the neck's axis begins at the head's centre
        ("neck-border-3", {"fitted_neck"}),
        (BORDERS[2], {"fitted_shaft"}),
        ("entry", set[str]()),
        (AXIS[0], set[str]()),
        ("neck-1", set[str]()),
    ):
        assert ended(fitted.with_mark(name, Mark(AT))) == ended(fitted.with_mark(name, None)) == gone, name
    assert ended(fitted.with_image("lateral", 9, same_pixels=False)) == set(fits)
    assert not ended(fitted.with_image("lateral", 9, same_pixels=True))
    assert not ended(fitted.with_image("oblique", 9, same_pixels=False))


@pytest.mark.parametrize(
    ("fit", "part", "key", "broken"),
    [
        ("fitted_head", "circles", "covariance_px2", [[1.0]]),
        ("fitted_shaft", "lines", "covariance_px2", [[1.0]]),
        ("fitted_neck", "lines", "borders_px", None),
    ],
)
def test_a_fit_comes_back_from_its_json_and_a_broken_one_is_refused(
    fitted: Decisions, fit: str, part: str, key: str, broken: Any
) -> None:
    document = json.loads(json.dumps(fitted.document()))
    assert Decisions.of(document) == fitted
    document[fit][part][0][key] = broken
    with pytest.raises(CaseError, match="cannot be read"):
        Decisions.of(document)
    del document[fit], document["borders"]  # older cases, whose axes were drawn themselves
    assert getattr(Decisions.of(document), fit) is None and not Decisions.of(document).borders


def test_the_file_of_picks_gives_the_same_plan(fitted: Decisions) -> None:
    """As `sightline plan --picks` reads it, with the fits made again."""
    decided = replace(fitted, fitted_shaft=None).with_mark("landmark-head-centre", fitted.mark("end"))
    picks = Picks.model_validate_json(picks_of(decided, NAMES).text)
    assert (picks.fit, len(picks.landmarks)) == (("head", "neck"), 1)
    images: Any = [
        SimpleNamespace(view=view, seen=SimpleNamespace(image=image))
        for view, image in zip(VIEWS, _good(), strict=True)
    ]
    asked, known = ask_plan(picks, images, decided.kind, decided.side, propose=False), planned(decided, VIEWS)
    assert known.plan is not None
    assert asked.request.plan_on(VIEWS).document() == known.plan.document()
