"""Drawn aids that locate the bone in two images: circles, lines and single clicks, px, each with a click's error."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import UnusableInputError
from sightline.planning.picks import DEFAULT_PICK_SD_PX, Pick

MIN_RIM_CLICKS = 3
_RIM_ANGLES_RAD = np.arange(12) * np.pi / 6  # where a drawn circle is compared with the silhouette


@dataclass(frozen=True, eq=False)
class Circle:
    """A round outline in one image: M rim points `uv_px` (M, 2), `covariance_px2` (2M, 2M) with u and v interleaved.

    `summary` (k, M) maps the M distances from the rim to the k independent measurements: one for each click; three
    for a drawn circle (two for its centre, one for its radius).

    >>> circle = sl.Circle.through([[521, 427], [799, 584], [801, 257]])
    >>> circle.uv_px.shape
    (3, 2)
    """

    uv_px: np.ndarray
    covariance_px2: np.ndarray
    summary: np.ndarray

    @staticmethod
    def through(rim_uv_px: ArrayLike, sd_px: float = DEFAULT_PICK_SD_PX) -> "Circle":
        """Return the outline through three or more clicks (M, 2) on the rim. Raises UnusableInputError."""
        rim = np.asarray(rim_uv_px, dtype=np.float64)
        if rim.ndim != 2 or rim.shape[1] != 2 or len(rim) < MIN_RIM_CLICKS or not np.isfinite(rim).all():
            raise UnusableInputError(
                f"a circle needs {MIN_RIM_CLICKS} or more finite clicks (u, v) on its rim; got the shape {rim.shape}"
            )
        _refuse_sd(sd_px)
        return Circle(rim, sd_px**2 * np.eye(2 * len(rim)), np.eye(len(rim)))

    @staticmethod
    def of(centre_uv_px: ArrayLike, radius_px: float, sd_px: float = DEFAULT_PICK_SD_PX) -> "Circle":
        """Return a circle drawn over the outline; `sd_px`: of its radius and of its centre, per axis.

        Raises UnusableInputError.
        """
        centre = np.asarray(centre_uv_px, dtype=np.float64)
        if centre.shape != (2,) or not np.isfinite(centre).all() or not 0.0 < radius_px < np.inf:
            raise UnusableInputError("a circle has a finite centre (u, v) and a positive radius, px")
        _refuse_sd(sd_px)
        outward = np.stack([np.cos(_RIM_ANGLES_RAD), np.sin(_RIM_ANGLES_RAD)], axis=1)
        by_circle = np.concatenate(
            [np.broadcast_to(np.eye(2), (len(_RIM_ANGLES_RAD), 2, 2)), outward[:, :, None]], axis=2
        )
        by_circle = by_circle.reshape(-1, 3)
        summary = np.linalg.pinv(np.column_stack([outward, np.ones(len(_RIM_ANGLES_RAD))]))
        return Circle(centre + radius_px * outward, sd_px**2 * by_circle @ by_circle.T, summary)


@dataclass(frozen=True, eq=False)
class Line:
    """A straight line in one image through two clicks `uv_px` (2, 2); they need not match the other image's clicks.

    >>> shaft = sl.Line([[220, 710], [520, 560]])
    """

    uv_px: np.ndarray
    sd_px: float = DEFAULT_PICK_SD_PX

    def __post_init__(self) -> None:
        uv = np.array(self.uv_px, dtype=np.float64)
        if uv.shape != (2, 2) or not np.isfinite(uv).all():
            raise UnusableInputError(f"a line needs two finite pixels (u, v), shape (2, 2); got the shape {uv.shape}")
        _refuse_sd(self.sd_px)
        object.__setattr__(self, "uv_px", uv)


@dataclass(frozen=True, eq=False)
class Aids:
    """Drawn aids; None for one that is not drawn. Pairs are (PA, lateral).

    `calcar` (medial cortex of the neck) and `cortex` (lateral cortex of the shaft): clicked in the PA image only.
    `outline`: both borders of the neck in each image, drawn where it is narrowest.

    >>> head = sl.Circle.of((680, 420), 130.0), sl.Circle.of((440, 360), 130.0)
    >>> aids = sl.Aids(head=head)
    """

    head: tuple[Circle, Circle] | None = None
    neck: tuple[Line, Line] | None = None
    shaft: tuple[Line, Line] | None = None
    calcar: Pick | None = None
    cortex: Pick | None = None
    outline: tuple[tuple[Line, Line], tuple[Line, Line]] | None = None

    @staticmethod
    def of(document: Mapping[str, Any]) -> "Aids":
        """Return the aids of a JSON document with these fields."""
        made: dict[str, Any] = {}
        for name, kind in (("head", Circle), ("neck", Line), ("shaft", Line), ("calcar", Pick), ("cortex", Pick)):
            drawn = document[name]
            if isinstance(drawn, list):
                made[name] = tuple(_read(kind, one) for one in drawn)
            elif drawn is not None:
                made[name] = _read(kind, drawn)
        if document.get("outline") is not None:  # cases of earlier versions have none
            made["outline"] = tuple(tuple(_read(Line, line) for line in view) for view in document["outline"])
        return Aids(**made)


def _read(kind: type, document: Mapping[str, Any]) -> Any:
    return kind(**{key: np.array(value) if isinstance(value, list) else value for key, value in document.items()})


def _refuse_sd(sd_px: float) -> None:
    if not 0.0 < sd_px < np.inf:
        raise UnusableInputError(f"a click's standard deviation is {sd_px} px; give a positive one")
