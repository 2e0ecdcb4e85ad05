"""Aids of `sightline plan` fitted to edges: what is passed to the fits, and what is said where a drawing is kept."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.planning.bone import rim, views
from tests.test_fitted_neck import neck_borders, neck_image

from sightline.cli.plan_aids import fitted
from sightline.errors import UnusableInputError
from sightline.planning import Aids, Circle, Line

RIM_RAD = np.array([0.4, 2.3, 4.6])


@cache
def _images() -> Any:
    made = [
        SimpleNamespace(view=view, seen=SimpleNamespace(image=neck_image(view, k))) for k, view in enumerate(views())
    ]
    return tuple(made)


def _aids() -> Aids:
    """Head and neck, the neck of the lateral image without borders."""
    pa, lateral = views()
    head = Circle.through(rim(pa, RIM_RAD)), Circle.through(rim(lateral, RIM_RAD))
    return Aids(head=head, neck=(neck_borders(pa), Line(neck_borders(lateral).uv_px)))


def test_the_neck_is_fitted_from_the_fitted_head_and_an_image_without_borders_says_why() -> None:
    """A program that fits it from the head as drawn gives the same axis with and without --fit-head."""
    axes = []
    for head in (False, True):
        aids, unfitted = fitted(_aids(), _images(), head=head, shaft=False, neck=True)
        assert aids is not None and aids.neck is not None and aids.neck[0].covariance_px2 is not None
        (said,) = unfitted["neck_not_fitted"]
        assert said.startswith("lateral image: neck kept as drawn; its axis is drawn, not its borders")
        assert ("head_not_fitted" in unfitted) == head
        axes.append(aids.neck[0].uv_px)
    assert not np.allclose(axes[0], axes[1])


@pytest.mark.parametrize("aids", [None, Aids(), Aids(neck=_aids().neck), Aids(head=_aids().head)])
def test_there_is_nothing_to_fit_without_a_drawn_neck_and_head(aids: Aids | None) -> None:
    with pytest.raises(UnusableInputError, match="--fit-neck fits a drawn neck from the centre of a drawn head"):
        fitted(aids, _images(), head=False, shaft=False, neck=True)
