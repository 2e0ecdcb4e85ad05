"""The neck of the step Plan fitted to the edges of its images: from the head's centre, kept, ended, and refused."""

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
from tests.planning.bone import rim, views
from tests.test_fitted_neck import neck_borders, neck_image

from sightline.app.plan.decisions import Decisions, Mark
from sightline.app.plan.planner import drawn_axis, plan_input, planned
from sightline.app.session.jobs import Jobs
from sightline.app.session.planning import Planning
from sightline.case.journal import Case
from sightline.case.views import NAMES
from sightline.errors import CaseError, UnusableInputError
from sightline.imaging import Radiograph

VIEWS: Any = tuple(views())
RIM_RAD = np.array([0.4, 2.3, 4.6])
AT = {"pa": (100.0, 100.0), "lateral": (100.0, 100.0)}
FITTED = "fitted_neck"


class _Planning(Planning):
    """With images whose views are known."""

    def seen(self, image: str) -> Any:
        return SimpleNamespace(image=_images()[NAMES.index(image)]) if image in NAMES else None

    def views(self, names: tuple[str, ...] | None = None) -> Any:
        return VIEWS


@cache
def _images() -> tuple[Radiograph, Radiograph]:
    first, second = (neck_image(view, k) for k, view in enumerate(VIEWS))
    return first, second


@cache
def _drawn() -> Decisions:
    """The wire, three clicks on the head's rim, and two on each border of the neck, in both images."""
    decisions = Decisions(side="right", borders=True)
    clicks = {"head": [rim(view, RIM_RAD) for view in VIEWS]}
    lines = [neck_borders(view, 2.0).borders_px for view in VIEWS]
    clicks["neck-border"] = [borders.reshape(4, 2) for borders in lines if borders is not None]
    clicks["entry"] = clicks["end"] = [np.full((1, 2), 100.0) for _ in VIEWS]
    for name, uv in clicks.items():
        for k in range(len(uv[0])):
            at = {image: (float(one[k, 0]), float(one[k, 1])) for image, one in zip(NAMES, uv, strict=True)}
            decisions = decisions.with_mark(name if len(uv[0]) == 1 else f"{name}-{k + 1}", Mark(at))
    return decisions


@pytest.fixture
def planning(tmp_path: Path) -> Iterator[_Planning]:
    nobody: Any = None
    with Case.create(tmp_path) as case:
        made = _Planning(case, "gamma", nobody, Jobs())
        made.edit(_drawn())
        yield made


def _fit(planning: Planning) -> Decisions:
    asyncio.run(planning.fit_neck())
    return planning.decisions


def test_the_plan_takes_the_fitted_neck_until_axes_are_drawn_themselves(planning: _Planning) -> None:
    """And the page draws it. A program that fits the neck from other circles than those of the head fails: its axis
    passes the head's centre."""
    decisions = _fit(planning)
    asked, drawn = plan_input(decisions, 2).aids, drawn_axis(decisions, "neck")
    assert asked is not None and asked.neck is not None and drawn is not None
    assert all(line.covariance_px2 is not None for line in asked.neck)
    assert all(line.covariance_px2 is None for line in drawn)
    known = planned(decisions, VIEWS)
    assert known.anatomy.neck is not None and known.anatomy.head is not None
    assert known.anatomy.neck.distance_mm(known.anatomy.head.centre_mm) < 0.05
    shown = known.fitted_axis("neck")
    assert shown is not None and np.array_equal(shown.axis[0].uv_px, asked.neck[0].uv_px)
    assert planned(replace(decisions, borders=False), VIEWS).fitted_axis("neck") is None
    again = Decisions.of(json.loads(json.dumps(decisions.document())))
    assert again == decisions
    document = decisions.document()
    document[FITTED]["lines"][0]["covariance_px2"] = [[1.0]]
    with pytest.raises(CaseError, match="cannot be read"):
        Decisions.of(document)
    del document[FITTED]  # older cases
    assert Decisions.of(document).fitted_neck is None


def test_a_fit_ends_with_what_it_follows_from_and_with_nothing_else(planning: _Planning) -> None:
    """Also with a click on the head, and its fit. A program that kept it would begin the axis at another centre."""
    decisions = _fit(planning)
    for name in ("neck-border-3", "head-2"):
        assert decisions.with_mark(name, Mark(AT)).fitted_neck is None
        assert decisions.with_mark(name, None).fitted_neck is None
    assert decisions.with_image("lateral", 9, same_pixels=False).fitted_neck is None
    assert decisions.with_image("lateral", 9, same_pixels=True).fitted_neck is not None
    for name in ("entry", "shaft-border-1", "neck-1"):
        assert decisions.with_mark(name, Mark(AT)).fitted_neck is not None
    asyncio.run(planning.fit_head())
    assert planning.decisions.fitted_head is not None and planning.decisions.fitted_neck is None


@pytest.mark.parametrize(
    ("left_out", "why"),
    [
        ("head-2", "on the head's rim in both calibrated images first: the neck"),
        ("neck-border-4", "border of the neck"),
    ],
)
def test_a_neck_without_borders_or_head_is_not_fitted(planning: _Planning, left_out: str, why: str) -> None:
    planning.edit(planning.decisions.with_mark(left_out, None))
    with pytest.raises(UnusableInputError, match=why):
        _fit(planning)
    assert planning.decisions.fitted_neck is None


@pytest.mark.parametrize(
    "change",
    [
        lambda planning: planning.edit(planning.decisions.with_mark("neck-border-1", Mark(AT))),
        lambda planning: planning.edit(planning.decisions.with_mark("head-1", Mark(AT))),
        lambda planning: planning.edit(planning.decisions.with_image("pa", 90, same_pixels=True)),
    ],
)
def test_a_fit_of_what_has_changed_meanwhile_is_dropped(
    planning: _Planning, monkeypatch: pytest.MonkeyPatch, change: Callable[[Planning], None]
) -> None:
    """Fails for a session that puts the fit from one head's centre on another head."""
    monkeypatch.setattr(planning, "_reopen", lambda: None)

    async def changed(fit: Callable[..., Any], *given: Any) -> Any:
        change(planning)
        return fit(*given)

    monkeypatch.setattr(asyncio, "to_thread", changed)
    with pytest.raises(UnusableInputError, match="fit the neck again: its drawing, the head or an image"):
        _fit(planning)
    assert planning.decisions.fitted_neck is None
