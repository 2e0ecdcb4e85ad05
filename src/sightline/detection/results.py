"""Results of detection: beads found in an image, and labelled beads."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from sightline.common.fitting import quantiles
from sightline.common.show import Plotted, centre_sd, counted, covariance_columns, dataframe, image_size
from sightline.detection.beads.bead import centres
from sightline.errors import ObservationsError

if TYPE_CHECKING:
    from pandas import DataFrame

# Of a field that no file and no case holds: the image that a result was found in, to be drawn behind it, and what can
# be had from it again.
_NOT_WRITTEN = {"written": False}


def _frozen(array: np.ndarray, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return a read-only float64 copy. Raises ObservationsError on another shape and on values that are not finite."""
    frozen = np.array(array, dtype=np.float64)
    if frozen.shape != shape:
        raise ObservationsError(f"{what} has the shape {frozen.shape}; {shape} was expected")
    if not np.isfinite(frozen).all():
        raise ObservationsError(f"{what} holds values that are not finite")
    frozen.flags.writeable = False
    return frozen


def _stated(covariance_px2: np.ndarray, n: int) -> np.ndarray:
    """Return `_frozen` covariances (N, 2, 2). Raises ObservationsError where one is not positive definite."""
    frozen = _frozen(covariance_px2, (n, 2, 2), "covariance_px2")
    u_px, v_px = np.sqrt(np.maximum(frozen[:, (0, 1), (0, 1)], 0.0)).T
    unknown = np.count_nonzero(np.abs(frozen[:, (0, 1), (1, 0)]).max(axis=1, initial=0.0) >= u_px * v_px)
    if unknown:
        raise ObservationsError(
            f"the covariances of {unknown} of {n} beads are not positive definite: their errors are not known; if you "
            "state them, give variances above zero, in px²; if `detect` did, export the image as the C-arm stores it"
        )
    return frozen


@dataclass(frozen=True)
class RejectedCandidate:
    """A candidate that is not a bead, or a detection that was not labelled, and why."""

    uv_px: tuple[float, float]
    radius_px: float
    reason: str


@dataclass(frozen=True, eq=False, repr=False)
class Detections(Plotted):
    """Beads found in one image, in IDCS.

    `uv_px` (N, 2), `radius_px` (N,) (the outer radius of a washer), `covariance_px2` (N, 2, 2),
    `kind` (N,) of "ball", "washer" or "hole", `contrast` (N,) (signed change of log intensity at the centre),
    `rejected` with reasons, `image_shape` (H, W). `pixels` (H, W): the image itself where it is known, for plots.
    `shadows` (N,): centre, blur, ellipticity and residual of each shadow's fit, fields of a record, for `look_again`.
    It fits all beads again where they are None, as after `sl.load`, or of other `uv_px`.

    >>> beads = sl.detect("out/demo/demo_pa.dcm")
    >>> ax = beads.plot()
    >>> table = beads.to_dataframe()  # needs pandas
    """

    uv_px: np.ndarray
    radius_px: np.ndarray
    covariance_px2: np.ndarray
    kind: tuple[str, ...]
    contrast: np.ndarray
    image_shape: tuple[int, int]
    rejected: tuple[RejectedCandidate, ...] = ()
    pixels: np.ndarray | None = field(default=None, metadata=_NOT_WRITTEN)
    shadows: np.ndarray | None = field(default=None, metadata=_NOT_WRITTEN)

    def __post_init__(self) -> None:
        n = len(np.atleast_2d(self.uv_px)) if np.size(self.uv_px) else 0
        for name, shape in (("uv_px", (n, 2)), ("radius_px", (n,)), ("contrast", (n,))):
            object.__setattr__(self, name, _frozen(np.reshape(getattr(self, name), shape), shape, name))
        object.__setattr__(self, "covariance_px2", _stated(np.reshape(self.covariance_px2, (n, 2, 2)), n))

    def __len__(self) -> int:
        return len(self.uv_px)

    def summary(self) -> str:
        """Return how many beads were found, how large they are and how well their centres are known."""
        kinds = ", ".join(counted(self.kind.count(k), k) for k in ("ball", "washer", "hole") if k in self.kind)
        lines = [f"Detections: {counted(len(self), 'bead')} in {image_size(self.image_shape)}"]
        if len(self):
            sizes = f"radius {self.radius_px.min():.1f} to {self.radius_px.max():.1f} px"
            lines.append(f"  {kinds}; {sizes}; {centre_sd(self.covariance_px2)}")
        return "\n".join([*lines, f"  {counted(len(self.rejected), 'candidate')} rejected"])

    def to_dataframe(self) -> "DataFrame":
        """Return a row for each bead: u_px, v_px, radius_px, kind, contrast and covariance. Needs pandas."""
        place = {"u_px": self.uv_px[:, 0], "v_px": self.uv_px[:, 1], "radius_px": self.radius_px}
        rest = {"kind": self.kind, "contrast": self.contrast, **covariance_columns(self.covariance_px2)}
        return dataframe(place | rest)

    def _draw(self, ax: Any) -> None:
        from sightline.common import draw

        draw.image(ax, self.pixels, self.image_shape, self.uv_px, f"{counted(len(self), 'bead')} detected")
        for kind, colour in (("ball", draw.ORANGE), ("washer", draw.BLUE), ("hole", draw.GREEN)):
            mine = np.array([k == kind for k in self.kind], dtype=bool)
            draw.circles(ax, self.uv_px[mine], self.radius_px[mine], colour, kind)
        draw.marks(ax, _places(self.rejected), "x", draw.RED, f"rejected ({len(self.rejected)})")
        draw.legend(ax)


@dataclass(frozen=True, eq=False, repr=False)
class Observations(Plotted):
    """Labelled beads of one view: fiducial `ids[i]` is seen at `uv_px[i]`, in IDCS.

    `covariance_px2` (N, 2, 2), or None where the measurement noise is unknown. `mirrored`: the image is a mirror image
    of the frame. `image_shape` (H, W), or None. `radius_px` (N,) as in `Detections`: then `uv_px` are the centroids of
    shadows, which distortion shifts from the images of the centres; None where these are known. `rejected`: detections
    that were not labelled, with reasons; None where only labelled beads are known. `pixels` (H, W): the image for
    plots, or None.
    Raises ObservationsError on wrong shapes, values that are not finite, covariances that are not positive definite,
    and duplicate ids.

    >>> sl.Observations("pa", ("pa-x-d1", "pa-x-d2"), [[512.0, 388.5], [700.2, 390.1]])
    Observations of view pa: 2 beads labelled in an image of unknown size
      error of the centres unknown
    """

    view: str
    ids: tuple[str, ...]
    uv_px: np.ndarray
    covariance_px2: np.ndarray | None = None
    mirrored: bool = False
    image_shape: tuple[int, int] | None = None
    radius_px: np.ndarray | None = None
    rejected: tuple[RejectedCandidate, ...] | None = None
    pixels: np.ndarray | None = field(default=None, metadata=_NOT_WRITTEN)

    def __post_init__(self) -> None:
        n = len(self.ids)
        object.__setattr__(self, "ids", tuple(self.ids))
        if len(set(self.ids)) != n:
            twice = sorted({i for i in self.ids if self.ids.count(i) > 1})
            raise ObservationsError(f"fiducials observed twice in one view: {', '.join(twice)}")
        object.__setattr__(self, "uv_px", _frozen(self.uv_px, (n, 2), "uv_px"))
        if self.covariance_px2 is not None:
            object.__setattr__(self, "covariance_px2", _stated(self.covariance_px2, n))
        if self.radius_px is not None:
            object.__setattr__(self, "radius_px", _frozen(self.radius_px, (n,), "radius_px"))

    def __len__(self) -> int:
        return len(self.ids)

    def summary(self) -> str:
        """Return which view was seen, how many beads are labelled and how well their centres are known."""
        lines = [f"Observations of view {self.view}: {counted(len(self), 'bead')} labelled"]
        lines[0] += f" in {image_size(self.image_shape)}"
        lines.append(f"  {centre_sd(self.covariance_px2)}")
        if self.mirrored:
            lines.append("  the image is a mirror image of the frame")
        if self.rejected is not None:
            lines.append(f"  {counted(len(self.rejected), 'detection')} not labelled")
        return "\n".join(lines)

    def to_dataframe(self) -> "DataFrame":
        """Return a row for each bead: view, id, u_px, v_px, covariance where it is known. Needs pandas."""
        columns = {"view": [self.view] * len(self), "id": self.ids, "u_px": self.uv_px[:, 0], "v_px": self.uv_px[:, 1]}
        known = {} if self.covariance_px2 is None else covariance_columns(self.covariance_px2)
        return dataframe(columns | known)

    def _draw(self, ax: Any) -> None:
        from sightline.common import draw

        title = f"view {self.view}: {counted(len(self), 'bead')} labelled"
        draw.image(ax, self.pixels, self.image_shape, self.uv_px, title)
        radius = np.full(len(self), np.nan) if self.radius_px is None else self.radius_px
        draw.labels(ax, self.uv_px, radius, self.ids, draw.ORANGE)
        draw.marks(ax, _places(self.rejected or ()), "x", draw.RED, f"not labelled ({len(self.rejected or ())})")
        draw.legend(ax)


def _places(rejected: tuple[RejectedCandidate, ...]) -> np.ndarray:
    """(N, 2) px."""
    return np.array([candidate.uv_px for candidate in rejected]).reshape(-1, 2)


FACTOR = 2
_USUAL_RADIUS_PX = 14.0  # largest median of the beads: datum balls, 5/3 as large, then have 24 px of 25 [calc]
# Where some are larger than this, they are binned too, unless the smallest tenth would become hard to fit. Fits of
# discs above 23 px do not always converge [twin].
_LARGE_PX, _SMALL_PX = 22.0, 6.0  # [ours] below 23 px, and 3 px after binning, above the promised 2 px
# Spots with less than this share of the strong spots' contrast are texture or noise: 0.2-0.35 at low dose on pixels
# of 0.1 mm, beads 0.5 and more [twin]. A few strong or large spots may be metal or anatomy.
_FAINT, _SOME = 0.45, 5
_EXACT = 2.0**32  # steps per px: with this rounding, coordinates are bit-identical in both scales


def is_fine(radius_px: np.ndarray, contrast: np.ndarray) -> bool:
    """Return whether spots of these radii and contrasts (N,) are so large that the image should be binned."""
    if len(radius_px) == 0:
        return False
    strength = np.abs(contrast)
    strong = np.sort(radius_px[strength >= _FAINT * np.sort(strength)[-_SOME:][0]])
    small, usual = quantiles(strong, (0.1, 0.5))
    return bool(usual > _USUAL_RADIUS_PX or (strong[-_SOME:][0] > _LARGE_PX and small > _SMALL_PX))


_Beads = TypeVar("_Beads", Detections, Observations)


def finer(beads: _Beads, image_shape: tuple[int, int] | None) -> _Beads:
    """Convert beads of the binned image to the image itself."""
    return _scaled(beads, _finer_uv, FACTOR, image_shape)


def coarser(beads: _Beads) -> _Beads:
    """Convert beads of an image to the binned image."""
    shape = beads.image_shape
    return _scaled(beads, _coarser_uv, 1 / FACTOR, None if shape is None else (shape[0] // FACTOR, shape[1] // FACTOR))


def _scaled(beads: Any, to_other: Callable[[np.ndarray], np.ndarray], factor: float, image_shape: Any) -> Any:
    """Return detections or observations with other pixels; what is unknown stays unknown."""
    changed: dict[str, Any] = {"uv_px": to_other(beads.uv_px), "image_shape": image_shape}
    if beads.covariance_px2 is not None:
        changed["covariance_px2"] = beads.covariance_px2 * factor**2
    if beads.radius_px is not None:
        changed["radius_px"] = beads.radius_px * factor
    if beads.rejected is not None:
        changed["rejected"] = tuple(
            replace(spot, uv_px=tuple(to_other(np.array(spot.uv_px)).tolist()), radius_px=spot.radius_px * factor)
            for spot in beads.rejected
        )
    if isinstance(beads, Detections) and beads.shadows is not None:
        changed["shadows"] = shadows = beads.shadows.copy()
        shadows["u_px"], shadows["v_px"] = to_other(centres(shadows)).T
        shadows["blur_px"] *= factor
    return replace(beads, **changed)


def _finer_uv(uv_px: np.ndarray) -> np.ndarray:
    """Convert coordinates: pixel (0, 0) of the binned image is centred between pixels 0 and 1 of the image."""
    return (np.rint(uv_px * _EXACT) / _EXACT + 0.5) * FACTOR - 0.5


def _coarser_uv(uv_px: np.ndarray) -> np.ndarray:
    return (uv_px + 0.5) / FACTOR - 0.5
