"""Drawn aids that locate the bone in two images: circles, lines and single clicks, px, each with a click's error."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import UnusableInputError
from sightline.planning.points.picks import DEFAULT_PICK_SD_PX, Pick

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
    """A straight line in one image through two pixels `uv_px` (2, 2); they need not match the other image's.

    `borders_px` (2, 2, 2): the borders that an axis lies between, where these were drawn. The axis is then midway on
    the plane of the view, and `uv_px` midway in the image. `covariance_px2` (4, 4): of both pixels of a line that was
    fitted, u and v interleaved; None for `sd_px` in each coordinate.

    >>> shaft = sl.Line([[220, 710], [520, 560]])
    """

    uv_px: np.ndarray
    sd_px: float = DEFAULT_PICK_SD_PX
    borders_px: np.ndarray | None = None
    covariance_px2: np.ndarray | None = None

    def __post_init__(self) -> None:
        uv = np.array(self.uv_px, dtype=np.float64)
        if uv.shape != (2, 2) or not np.isfinite(uv).all():
            raise UnusableInputError(f"a line needs two finite pixels (u, v), shape (2, 2); got the shape {uv.shape}")
        _refuse_sd(self.sd_px)
        object.__setattr__(self, "uv_px", uv)

    @property
    def spread_px2(self) -> np.ndarray:
        """(4, 4): the covariance of both pixels."""
        return self.sd_px**2 * np.eye(4) if self.covariance_px2 is None else self.covariance_px2

    @staticmethod
    def between(borders_px: ArrayLike, sd_px: float = DEFAULT_PICK_SD_PX) -> "Line":
        """Return the axis midway between two borders, (2, 2, 2): two clicks on each. Raises UnusableInputError."""
        borders = np.array(borders_px, dtype=np.float64)
        if borders.shape != (2, 2, 2) or not np.isfinite(borders).all():
            raise UnusableInputError(
                f"an axis between borders needs two finite clicks on each, shape (2, 2, 2); got {borders.shape}"
            )
        first, second = borders[:, 1] - borders[:, 0]
        if first @ second < 0.0:  # clicked the other way
            borders[1] = borders[1, ::-1]
        _refuse_sd(sd_px)
        return Line(borders.mean(axis=0), sd_px / np.sqrt(2), borders_px=borders)


# Clicks that make one drawing of a type in one image.
CLICKS = {"plane": 2, "cylinder": 4, "outline tube": 4, "oval tube": 4, "rim pair": 8}


@dataclass(frozen=True, eq=False)
class Drawing:
    """An aid of a type in CLICKS: its clicks (M, 2) in each image, None where it is not drawn.

    - "plane": both ends of a line along it. In two images: from edge to edge, so that the middles show one point
    - "cylinder", "outline tube": two clicks on one border, two on the other, in two images
    - "oval tube": in the first image, where the tube is seen end-on, the ends of the long axis of its oval, then of the
      short one; in the second image borders, as above
    - "rim pair": the ends of two diameters of one rim, then of the other, in two images

    >>> front = sl.planning.Drawing("plane", (None, [[801, 402], [797, 540]]))
    """

    type: str
    uv_px: tuple[np.ndarray | None, ...]
    sd_px: float = DEFAULT_PICK_SD_PX

    def __post_init__(self) -> None:
        if self.type not in CLICKS:
            raise UnusableInputError(f"an aid has the type {self.type!r}; choose from {', '.join(CLICKS)}")
        made = tuple(None if uv is None else np.array(uv, dtype=np.float64) for uv in self.uv_px)
        for uv in made:
            if uv is not None and (uv.shape != (CLICKS[self.type], 2) or not np.isfinite(uv).all()):
                raise UnusableInputError(
                    f"a {self.type} needs {CLICKS[self.type]} finite pixels (u, v) in an image; got {uv.shape}"
                )
        _refuse_sd(self.sd_px)
        object.__setattr__(self, "uv_px", made)


Clicked = Mapping[str, Sequence[np.ndarray | None]]


@dataclass(frozen=True, eq=False)
class Aids:
    """Drawn aids; None for one that is not drawn. Pairs are (PA, lateral).

    `calcar` (medial cortex of the neck) and `cortex` (lateral cortex of the shaft): clicked in the PA image only.
    `outline`: both borders of the neck in each image, drawn where it is narrowest. `others`: aids of other bones, by
    their keys in the procedure's file.

    >>> head = sl.Circle.of((680, 420), 130.0), sl.Circle.of((440, 360), 130.0)
    >>> aids = sl.Aids(head=head)
    """

    head: tuple[Circle, Circle] | None = None
    neck: tuple[Line, Line] | None = None
    shaft: tuple[Line, Line] | None = None
    calcar: Pick | None = None
    cortex: Pick | None = None
    outline: tuple[tuple[Line, Line], tuple[Line, Line]] | None = None
    others: Mapping[str, Drawing] = field(default_factory=dict)

    @staticmethod
    def clicked(types: Mapping[str, str], uv_px: Clicked, sd_px: float = DEFAULT_PICK_SD_PX) -> "Aids":
        """Return the aids of a procedure, given the clicks of each by its key: (M, 2) in each image, or None.

        `types`: those of the aids in the procedure's file, by their keys. Aids without clicks are not drawn; of head,
        neck, shaft and outline also those that are drawn in one image only. Raises UnusableInputError.
        """
        made: dict[str, Any] = {}
        others: dict[str, Drawing] = {}
        for key, each in uv_px.items():
            drawn = [uv for uv in each if uv is not None]
            if key in _OF_HIP and len(drawn) >= _OF_HIP[key][0]:
                count, of = _OF_HIP[key]
                made[key] = tuple(of(np.asarray(uv), sd_px) for uv in drawn[:count])
                made[key] = made[key] if count > 1 else made[key][0]
            elif key not in _OF_HIP and drawn:
                others[key] = Drawing(types[key], tuple(each), sd_px)
        # Sorted, as a case keeps them: another order changes the last bit of a sum.
        return Aids(**made, others=dict(sorted(others.items())))

    @staticmethod
    def of(document: Mapping[str, Any]) -> "Aids":
        """Return the aids of a JSON document with these fields."""
        made: dict[str, Any] = {}
        for name, kind in (("head", Circle), ("neck", Line), ("shaft", Line), ("calcar", Pick), ("cortex", Pick)):
            drawn = document[name]
            if isinstance(drawn, list):
                made[name] = tuple(_read(kind, drawing) for drawing in drawn)
            elif drawn is not None:
                made[name] = _read(kind, drawn)
        if document.get("outline") is not None:  # cases of earlier versions have none
            made["outline"] = tuple(tuple(_read(Line, line) for line in view) for view in document["outline"])
        others = {
            key: Drawing(drawing["type"], tuple(drawing["uv_px"]), drawing["sd_px"])
            for key, drawing in document.get("others", {}).items()
        }
        return Aids(**made, others=others)


def _axis(uv: np.ndarray, sd_px: float) -> Line:
    """Return an axis by two clicks on it, or by four: two on one border of the bone and two on the other."""
    return Line.between(uv.reshape(2, 2, 2), sd_px) if uv.shape == (4, 2) else Line(uv, sd_px)


# Images that each aid of a hip is drawn in, and what makes it of its clicks in one of them.
_OF_HIP: Mapping[str, tuple[int, Callable[[np.ndarray, float], Any]]] = {
    "head": (2, Circle.through),
    "neck": (2, _axis),
    "shaft": (2, _axis),
    "calcar": (1, lambda uv, sd_px: Pick.free(uv[0], sd_px)),
    "cortex": (1, lambda uv, sd_px: Pick.free(uv[0], sd_px)),
    "outline": (2, lambda uv, sd_px: (Line(uv[:2], sd_px), Line(uv[2:], sd_px))),
}


def _read(kind: type, document: Mapping[str, Any]) -> Any:
    return kind(**{key: np.array(value) if isinstance(value, list) else value for key, value in document.items()})


def _refuse_sd(sd_px: float) -> None:
    if not 0.0 < sd_px < np.inf:
        raise UnusableInputError(f"a click's standard deviation is {sd_px} px; give a positive one")
