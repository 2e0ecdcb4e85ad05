"""Why a session keeps a head as drawn: every refusal of *Fit head*, on drawn images whose views are known."""

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.bone_images import rays, shown, with_cortex
from tests.planning.bone import CENTRE_MM, RADIUS_MM, rim, views
from tests.test_fitted_head import head_image

from sightline.app.plan.decisions import Decisions, Mark
from sightline.app.plan.planner import drawn_head, plan_input
from sightline.app.session import planning as module
from sightline.app.session.jobs import Jobs
from sightline.app.session.planning import Planning
from sightline.case.journal import Case
from sightline.case.views import NAMES
from sightline.errors import UnusableInputError
from sightline.imaging import Radiograph

VIEWS: Any = tuple(views())
TURNS_RAD = np.array([0.4, 2.3, 4.6])
Images = tuple[Radiograph, Radiograph]


class _Planning(Planning):
    """With images whose views are known."""

    images: Images
    calibrated = True

    def seen(self, image: str) -> Any:
        return SimpleNamespace(image=self.images[NAMES.index(image)]) if image in NAMES else None

    def views(self, names: tuple[str, ...] | None = None) -> Any:
        return VIEWS if self.calibrated else None


@pytest.fixture
def planning(tmp_path: Path) -> Iterator[_Planning]:
    """A head is drawn with three clicks in each image."""
    nobody: Any = None
    with Case.create(tmp_path) as case:
        made = _Planning(case, "gamma", nobody, Jobs())
        made.images = _good()
        made.edit(_clicked(np.zeros((2, 2))))
        yield made


@cache
def _good() -> Images:
    first, second = (head_image(view, k) for k, view in enumerate(VIEWS))
    return first, second


def _clicked(off_px: np.ndarray, share: float = 1.0) -> Decisions:
    """Clicks on the rim, moved by `off_px` (2, 2) in each image, or on a smaller circle about its middle."""
    decisions = Decisions(side="right")
    rims = [rim(view, TURNS_RAD) for view in VIEWS]
    uv = [at.mean(axis=0) + share * (at - at.mean(axis=0)) + off for at, off in zip(rims, off_px, strict=True)]
    for k in range(len(TURNS_RAD)):
        places = {name: (float(at[k, 0]), float(at[k, 1])) for name, at in zip(NAMES, uv, strict=True)}
        decisions = decisions.with_mark(f"head-{k + 1}", Mark(places))
    return decisions


def _dark(image: Radiograph) -> Radiograph:
    """The image of nothing."""
    return Radiograph(np.full_like(image.pixels, 9000), 65535.0)


def _rolled(image: Radiograph) -> Radiograph:
    """The image of a head at another height."""
    return replace(image, pixels=np.roll(image.pixels, (9, 9), axis=(0, 1)))


def _doubled(view: Any) -> Radiograph:
    """Two balls about one centre, whose edges are 1.8 mm apart."""
    away = np.linalg.norm(np.cross(CENTRE_MM - view.focal_point_mm, rays(view)), axis=-1)
    return shown(sum(with_cortex(away, radius, 1.0) for radius in (RADIUS_MM - 0.9, RADIUS_MM + 0.9)), 5)


def _fit(planning: Planning) -> None:
    asyncio.run(planning.fit_head())


def _kept(planning: _Planning, match: str) -> str:
    """Fit in vain: nothing is changed, in the decisions and in the journal. Return what is said."""
    before, last = planning.decisions, planning.case.last
    with pytest.raises(UnusableInputError, match=match) as refused:
        _fit(planning)
    assert planning.decisions is before and planning.case.last == last and planning.decisions.fitted_head is None
    return str(refused.value)


def test_a_head_that_is_not_drawn_or_not_calibrated_is_not_fitted(planning: _Planning) -> None:
    planning.calibrated = False
    _kept(planning, "click three points on the head's rim in both calibrated images first")
    planning.calibrated = True
    planning.edit(planning.decisions.with_mark("head-2", None))
    _kept(planning, "click three points on the head's rim in both calibrated images first")


@pytest.mark.parametrize(
    ("images", "drawn", "why"),
    [
        (lambda good: tuple(map(_dark, good)), _clicked(np.zeros((2, 2))), "no edge of a bone is clear within 12 px"),
        (lambda good: (good[0], _rolled(good[1])), _clicked(np.zeros((2, 2))), "are not those of one sphere"),
        (lambda good: tuple(map(_doubled, VIEWS)), _clicked(np.zeros((2, 2))), "two edges near it are about equally"),
        (lambda good: good, _clicked(np.zeros((2, 2)), 0.1), "its radius is [12]. px"),
        (lambda good: good, _clicked(np.full((2, 2), 4000.0)), "it lies outside the image"),
    ],
)
def test_a_head_without_its_edges_in_the_images_is_kept_as_drawn_and_says_why(
    planning: _Planning, images: Callable[[Images], Images], drawn: Decisions, why: str
) -> None:
    """Fails for a session that replaces the drawing by a fit that was refused, or that does not say why in each
    image."""
    planning.edit(drawn)
    planning.images = images(_good())
    said = _kept(planning, f"PA image: kept as drawn; .*{why}.*Lateral image: kept as drawn; .*{why}")
    assert said.count("kept as drawn") == len(NAMES)


def test_one_image_without_an_edge_keeps_its_circle_and_the_other_is_fitted(planning: _Planning) -> None:
    """Fails for a plan that takes the fitted circle's small error for the drawn one's."""
    planning.images = (_good()[0], _dark(_good()[1]))
    _fit(planning)
    fitted, drawn = planning.decisions.fitted_head, drawn_head(planning.decisions)
    assert fitted is not None and drawn is not None
    assert list(fitted.kept) == ["lateral"] and "no edge of a bone is clear" in fitted.kept["lateral"]
    (said,) = module.kept_as_drawn(fitted.kept)
    assert said.startswith("Lateral image: kept as drawn; no edge")
    asked = plan_input(planning.decisions.with_mark("entry", Mark(_ENDS)).with_mark("end", Mark(_ENDS)), 2).aids
    assert asked is not None and asked.head is not None
    assert np.array_equal(asked.head[1].uv_px, drawn[1].uv_px)
    assert np.array_equal(asked.head[1].covariance_px2, drawn[1].covariance_px2)
    assert len(asked.head[0].uv_px) > len(drawn[0].uv_px)


_ENDS = {"pa": (100.0, 100.0), "lateral": (100.0, 100.0)}


@pytest.mark.parametrize(
    "change",
    [
        lambda planning: planning.edit(planning.decisions.with_image("pa", 90, same_pixels=True)),
        lambda planning: planning.edit(planning.decisions.with_mark("head-1", Mark(_ENDS))),
        lambda planning: planning.remove(("head-1",)),
        lambda planning: planning.undo(),
    ],
)
def test_a_fit_of_what_has_changed_meanwhile_is_dropped(
    planning: _Planning, monkeypatch: pytest.MonkeyPatch, change: Callable[[Planning], None]
) -> None:
    """Fails for a session that puts the fit of one drawing, or of one image, on another."""
    monkeypatch.setattr(planning, "_reopen", lambda: None)

    async def changed(fit: Callable[..., Any], *given: Any) -> Any:
        change(planning)
        return fit(*given)

    monkeypatch.setattr(asyncio, "to_thread", changed)
    with pytest.raises(UnusableInputError, match="fit the head again: its drawing or an image has changed meanwhile"):
        _fit(planning)
    assert planning.decisions.fitted_head is None


def test_only_one_fit_runs_at_a_time(planning: _Planning) -> None:
    planning.jobs.working = "fitting the head to its edges"
    _kept(planning, "wait: fitting the head to its edges is not done yet")
