"""The circles of a femoral head after their fit to the edges of the images, as decisions keep them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.case.canonical import plain
from sightline.planning import Circle


@dataclass(frozen=True)
class FittedHead:
    """Circles in PA and lateral image as JSON types, so that equal ones compare equal; `kept`: why an image's circle is
    still the drawn one, by view."""

    circles: tuple[Mapping[str, Any], Mapping[str, Any]]
    kept: Mapping[str, str]

    @staticmethod
    def made(circles: Sequence[Circle], kept: Mapping[str, str]) -> "FittedHead":
        """Return the result of `fit_head`."""
        first, second = map(plain, circles)
        return FittedHead((first, second), dict(kept))

    @property
    def head(self) -> tuple[Circle, Circle]:
        """The circles."""
        first, second = (Circle(**{key: np.array(value) for key, value in one.items()}) for one in self.circles)
        return first, second

    def document(self) -> dict[str, Any]:
        """Return it as JSON types."""
        return {"circles": list(self.circles), "kept": dict(self.kept)}

    @staticmethod
    def of(document: Mapping[str, Any]) -> "FittedHead":
        """Return it from JSON types. Raises KeyError, TypeError, ValueError."""
        first, second = document["circles"]
        made = FittedHead((first, second), {str(view): str(why) for view, why in document["kept"].items()})
        for circle in made.head:
            count = len(circle.uv_px)
            if circle.uv_px.shape != (count, 2) or circle.covariance_px2.shape != (2 * count, 2 * count):
                raise ValueError(circle.uv_px.shape)
        return made
