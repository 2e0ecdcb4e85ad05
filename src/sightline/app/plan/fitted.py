"""A head's circles and an axis's borders after their fit to the edges of the images, as decisions keep them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sightline.case.canonical import plain
from sightline.planning import Circle, Line


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
        first, second = (Circle(**_arrays(one)) for one in self.circles)
        return first, second

    def document(self) -> dict[str, Any]:
        """Return it as JSON types."""
        return {"circles": list(self.circles), "kept": dict(self.kept)}

    @staticmethod
    def of(document: Mapping[str, Any]) -> "FittedHead":
        """Return it from JSON types. Raises KeyError, TypeError, ValueError."""
        first, second = document["circles"]
        made = FittedHead((first, second), _reasons(document))
        for circle in made.head:
            count = len(circle.uv_px)
            if circle.uv_px.shape != (count, 2) or circle.covariance_px2.shape != (2 * count, 2 * count):
                raise ValueError(circle.uv_px.shape)
        return made


@dataclass(frozen=True)
class FittedAxis:
    """Lines with their borders in PA and lateral image as JSON types, so that equal ones compare equal; `kept`: why an
    image's line is still the drawn one, by view."""

    lines: tuple[Mapping[str, Any], Mapping[str, Any]]
    kept: Mapping[str, str]

    @staticmethod
    def made(lines: Sequence[Line], kept: Mapping[str, str]) -> "FittedAxis":
        """Return the result of `fit_shaft` or `fit_neck`."""
        first, second = map(plain, lines)
        return FittedAxis((first, second), dict(kept))

    @property
    def axis(self) -> tuple[Line, Line]:
        """The lines."""
        first, second = (Line(**_arrays(one)) for one in self.lines)
        return first, second

    def document(self) -> dict[str, Any]:
        """Return it as JSON types."""
        return {"lines": list(self.lines), "kept": dict(self.kept)}

    @staticmethod
    def of(document: Mapping[str, Any]) -> "FittedAxis":
        """Return it from JSON types. Raises KeyError, TypeError, ValueError, UnusableInputError."""
        first, second = document["lines"]
        made = FittedAxis((first, second), _reasons(document))
        for line in made.axis:
            borders = line.borders_px
            if borders is None or borders.shape != (2, 2, 2) or line.spread_px2.shape != (4, 4):
                raise ValueError(borders)
        return made


def _arrays(document: Mapping[str, Any]) -> dict[str, Any]:
    return {key: np.array(value) if isinstance(value, list) else value for key, value in document.items()}


def _reasons(document: Mapping[str, Any]) -> dict[str, str]:
    return {str(view): str(why) for view, why in document["kept"].items()}
