"""What a person draws on two images to tell the bone: circles, lines, single clicks; in px, each as sure as a click."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import UnusableInputError
from sightline.planning.picks import DEFAULT_PICK_SD_PX, Pick

FEWEST_RIM_CLICKS = 3
_RIM = np.arange(12) * np.pi / 6  # where a drawn circle is compared with the silhouette


@dataclass(frozen=True, eq=False)
class Circle:
    """A round outline in one image: M points `uv_px` (M, 2) of its rim, `covariance_px2` (2M, 2M), u v by turns.

    `summary` (k, M): the k numbers of the M distances from the rim that the drawing tells independently: each click its
    own, a drawn circle three (two of its centre, one of its radius).
    """

    uv_px: np.ndarray
    covariance_px2: np.ndarray
    summary: np.ndarray

    @staticmethod
    def through(rim_uv_px: ArrayLike, sd_px: float = DEFAULT_PICK_SD_PX) -> "Circle":
        """Three or more clicks (M, 2) on the rim. Raises UnusableInputError."""
        rim = np.asarray(rim_uv_px, dtype=np.float64)
        if rim.ndim != 2 or rim.shape[1] != 2 or len(rim) < FEWEST_RIM_CLICKS or not np.isfinite(rim).all():
            raise UnusableInputError(
                f"a circle needs {FEWEST_RIM_CLICKS} or more finite clicks (u, v) on its rim; got the shape {rim.shape}"
            )
        _refuse_sd(sd_px)
        return Circle(rim, sd_px**2 * np.eye(2 * len(rim)), np.eye(len(rim)))

    @staticmethod
    def of(centre_uv_px: ArrayLike, radius_px: float, sd_px: float = DEFAULT_PICK_SD_PX) -> "Circle":
        """A circle drawn over the outline; centre, per axis, and radius err by `sd_px`. Raises UnusableInputError."""
        centre = np.asarray(centre_uv_px, dtype=np.float64)
        if centre.shape != (2,) or not np.isfinite(centre).all() or not 0.0 < radius_px < np.inf:
            raise UnusableInputError("a circle has a finite centre (u, v) and a positive radius, px")
        _refuse_sd(sd_px)
        outward = np.stack([np.cos(_RIM), np.sin(_RIM)], axis=1)
        by_circle = np.concatenate([np.broadcast_to(np.eye(2), (len(_RIM), 2, 2)), outward[:, :, None]], axis=2)
        by_circle = by_circle.reshape(-1, 3)
        summary = np.linalg.pinv(np.column_stack([outward, np.ones(len(_RIM))]))
        return Circle(centre + radius_px * outward, sd_px**2 * by_circle @ by_circle.T, summary)


@dataclass(frozen=True, eq=False)
class Line:
    """A straight line in one image through two clicks `uv_px` (2, 2); they need not be the other image's points."""

    uv_px: np.ndarray
    sd_px: float = DEFAULT_PICK_SD_PX

    def __post_init__(self) -> None:
        uv = np.array(self.uv_px, dtype=np.float64)
        if uv.shape != (2, 2) or not np.isfinite(uv).all():
            raise UnusableInputError(f"a line goes through two finite pixels (u, v); got the shape {uv.shape}")
        _refuse_sd(self.sd_px)
        object.__setattr__(self, "uv_px", uv)


@dataclass(frozen=True, eq=False)
class Aids:
    """What has been drawn; None where it has not. Pairs are (PA, lateral); `calcar` (the medial cortex of the neck) and
    `cortex` (the lateral cortex of the shaft) are clicked in the PA image alone."""

    head: tuple[Circle, Circle] | None = None
    neck: tuple[Line, Line] | None = None
    shaft: tuple[Line, Line] | None = None
    calcar: Pick | None = None
    cortex: Pick | None = None

    @staticmethod
    def of(document: Mapping[str, Any]) -> "Aids":
        """From what its fields are as JSON types."""
        made: dict[str, Any] = {}
        for name, kind in (("head", Circle), ("neck", Line), ("shaft", Line), ("calcar", Pick), ("cortex", Pick)):
            drawn = document[name]
            if isinstance(drawn, list):
                made[name] = tuple(_read(kind, one) for one in drawn)
            elif drawn is not None:
                made[name] = _read(kind, drawn)
        return Aids(**made)


def _read(kind: type, document: Mapping[str, Any]) -> Any:
    return kind(**{key: np.array(value) if isinstance(value, list) else value for key, value in document.items()})


def _refuse_sd(sd_px: float) -> None:
    if not 0.0 < sd_px < np.inf:
        raise UnusableInputError(f"a click's standard deviation is {sd_px} px; give a positive one")
