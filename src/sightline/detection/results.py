"""What detection hands on: beads found in an image, and beads that have been told apart."""

from dataclasses import dataclass

import numpy as np

from sightline.errors import ObservationsError


def _frozen(array: np.ndarray, shape: tuple[int, ...], what: str) -> np.ndarray:
    """A read-only float64 copy of the given shape. Raises ObservationsError otherwise."""
    out = np.array(array, dtype=np.float64)
    if out.shape != shape:
        raise ObservationsError(f"{what} has the shape {out.shape}; {shape} was expected")
    if not np.isfinite(out).all():
        raise ObservationsError(f"{what} holds values that are not finite")
    out.flags.writeable = False
    return out


@dataclass(frozen=True)
class Rejected:
    """A candidate that is not a bead, or a detection that was not labelled, and why."""

    uv_px: tuple[float, float]
    radius_px: float
    reason: str


@dataclass(frozen=True, eq=False)
class Detections:
    """Beads found in one image, in IDCS.

    `uv_px` (N, 2), `radius_px` (N,) (the outer radius of a washer), `covariance_px2` (N, 2, 2),
    `kind` (N,) of "ball", "washer" or "hole", `contrast` (N,) (signed change of log intensity at the centre),
    `rejected` with reasons, `image_shape` (H, W).
    """

    uv_px: np.ndarray
    radius_px: np.ndarray
    covariance_px2: np.ndarray
    kind: tuple[str, ...]
    contrast: np.ndarray
    image_shape: tuple[int, int]
    rejected: tuple[Rejected, ...] = ()

    def __post_init__(self) -> None:
        n = len(np.atleast_2d(self.uv_px)) if np.size(self.uv_px) else 0
        for name, shape in (
            ("uv_px", (n, 2)),
            ("radius_px", (n,)),
            ("covariance_px2", (n, 2, 2)),
            ("contrast", (n,)),
        ):
            object.__setattr__(self, name, _frozen(np.reshape(getattr(self, name), shape), shape, name))

    def __len__(self) -> int:
        return len(self.uv_px)


@dataclass(frozen=True, eq=False)
class Observations:
    """Beads of one view that have been labelled: fiducial `ids[i]` is seen at `uv_px[i]`, in IDCS.

    `covariance_px2` (N, 2, 2), or None where nothing is known of the measurement noise. `mirrored` says
    that the image is a mirror image of the frame. `image_shape` (H, W) where the image is known. `radius_px` (N,): as
    in `Detections`, or None where it is not known. `rejected`: detections that were not labelled, with
    reasons; None where the beads come without the others of their image.
    Raises ObservationsError on wrong shapes, values that are not finite, and an id that stands twice.
    """

    view: str
    ids: tuple[str, ...]
    uv_px: np.ndarray
    covariance_px2: np.ndarray | None = None
    mirrored: bool = False
    image_shape: tuple[int, int] | None = None
    radius_px: np.ndarray | None = None
    rejected: tuple[Rejected, ...] | None = None

    def __post_init__(self) -> None:
        n = len(self.ids)
        object.__setattr__(self, "ids", tuple(self.ids))
        if len(set(self.ids)) != n:
            twice = sorted({i for i in self.ids if self.ids.count(i) > 1})
            raise ObservationsError(f"fiducials observed twice in one view: {', '.join(twice)}")
        object.__setattr__(self, "uv_px", _frozen(self.uv_px, (n, 2), "uv_px"))
        if self.covariance_px2 is not None:
            object.__setattr__(self, "covariance_px2", _frozen(self.covariance_px2, (n, 2, 2), "covariance_px2"))
        if self.radius_px is not None:
            object.__setattr__(self, "radius_px", _frozen(self.radius_px, (n,), "radius_px"))

    def __len__(self) -> int:
        return len(self.ids)
