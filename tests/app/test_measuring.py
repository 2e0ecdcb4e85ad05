"""The ruler in both images: in space where they show the same places, else in each image alone."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from tests.planning.bone import CENTRE_MM, ENTRY_MM, views

from sightline.app import texts
from sightline.app.tab.tab import measured_in_both

PLANNING: Any = SimpleNamespace(seen={view.name: SimpleNamespace(view=view) for view in views()}.get)


def _clicks(*points_mm: np.ndarray) -> dict[str, list[tuple[float, float]]]:
    return {view.name: [(u, v) for u, v in view.project(np.array(points_mm))] for view in views()}


def test_as_many_clicks_on_the_same_places_are_measured_in_space() -> None:
    said = measured_in_both(PLANNING, _clicks(CENTRE_MM, ENTRY_MM))
    assert said is not None
    label, note = said
    assert label.startswith(f"{np.linalg.norm(ENTRY_MM - CENTRE_MM):.1f} ± ") and label.endswith("mm")
    assert note == texts.RULER_SPACE
    turned = measured_in_both(PLANNING, _clicks(CENTRE_MM, ENTRY_MM, CENTRE_MM + np.array([0.0, 0.0, 30.0])))
    assert turned is not None and "°" in turned[0]


def test_clicks_in_one_image_more_in_one_or_on_other_places_are_not() -> None:
    both = _clicks(CENTRE_MM, ENTRY_MM)
    assert measured_in_both(PLANNING, {"pa": both["pa"]}) is None
    assert measured_in_both(PLANNING, both | {"pa": [*both["pa"], (400.0, 400.0)]}) is None
    assert measured_in_both(PLANNING, both | {"pa": both["pa"][::-1]}) is None
