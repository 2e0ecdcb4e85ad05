"""The beads of one view: image centres, coordinates in the frame, and the frame's errors there."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from sightline.calibration.maps.hull import refuse_collinear
from sightline.calibration.plates.shadow_centres import centres_px
from sightline.common.geometry.planes import Plane
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError
from sightline.frame import Frame, Plate

MIN_SD_PX, MAX_SD_PX = 1e-6, 1e3  # of a bead's centre: far below any measurement's, about the size of an image [ours]


@dataclass(frozen=True, eq=False)
class Beads:
    """N beads of one view, in the order of the frame: XRII plate first.

    `uv_px` (N, 2): images of their centres; `covariance_px2` (N, 2, 2), None where the noise is unknown; `xyz_mm`
    (N, 3), CFCS; `on_xrii` (N,) bool; `rows` (N,): their indices among the fiducials of the view; `radius_px` (N,) of
    their shadows, None where not measured.
    """

    frame: Frame
    view: str
    ids: tuple[str, ...]
    uv_px: np.ndarray
    covariance_px2: np.ndarray | None
    xyz_mm: np.ndarray
    on_xrii: np.ndarray
    rows: np.ndarray
    radius_px: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def plane(self) -> Plane:
        """The reference plane: that of the whole XRII plate, whichever of its beads were detected."""
        return self.frame.view(self.view).xrii.plane

    def where(self, keep: np.ndarray) -> "Beads":
        """Return the beads for which `keep` (N,) is true."""
        if keep.all():
            return self
        noise = None if self.covariance_px2 is None else self.covariance_px2[keep]
        ids = tuple(i for i, k in zip(self.ids, keep, strict=True) if k)
        return replace(
            self,
            ids=ids,
            uv_px=self.uv_px[keep],
            covariance_px2=noise,
            xyz_mm=self.xyz_mm[keep],
            on_xrii=self.on_xrii[keep],
            rows=self.rows[keep],
            radius_px=None if self.radius_px is None else self.radius_px[keep],
        )

    def frame_factor(self) -> np.ndarray:
        """Return the beads' rows (3N, K) of `Frame.error_factor`, mm."""
        whole = self.frame.error_factor[self.frame.rows(self.view)]
        return whole.reshape(-1, 3, whole.shape[1])[self.rows].reshape(-1, whole.shape[1])

    @property
    def frame_covariance(self) -> np.ndarray:
        """(3M, 3M) covariance, mm², of the coordinates of all M beads of the view, of which these are the `rows`."""
        return _view_covariance(self.frame, self.view)


@lru_cache(maxsize=16)
def _view_covariance(frame: Frame, view: str) -> np.ndarray:
    """Return the covariance (3M, 3M) of all beads of a view, the same for every image of the frame."""
    factor = frame.error_factor[frame.rows(view)]
    return factor @ factor.T


def match(observations: Observations, frame: Frame, view: str | None) -> Beads:
    """Return the observations joined with their frame, at the images of the beads' centres (`centres_px`). `view`: the
    expected view; None: that of the observations.

    Raises ObservationsError for another view, an unknown fiducial or an impossible covariance; FrameError where the
    frame has no such view; CalibrationRefusedError where fewer than 4 beads of a plate are seen, or all on one line.
    """
    if view is not None and view != observations.view:
        raise ObservationsError(
            f"the observations are of view {observations.view!r}, not {view!r}; "
            "check that the PA and the lateral image are not swapped"
        )
    frame_view = frame.view(observations.view)
    place, xyz_mm = _places(frame, observations.view)
    unknown = [i for i in observations.ids if i not in place]
    if unknown:
        raise ObservationsError(
            f"view {observations.view!r} of frame {frame.name!r} has no fiducial {', '.join(map(repr, unknown[:5]))}; "
            "check that the observations belong to this frame and view"
        )
    rows = np.array([place[i] for i in observations.ids], dtype=int)
    order = np.argsort(rows)
    rows = rows[order]
    noise = observations.covariance_px2
    if noise is not None:
        noise = noise[order]
        _refuse_stated(noise)
    xyz, uv = xyz_mm[rows], centres_px(observations, frame)[order]
    ids = tuple(observations.ids[k] for k in order.tolist())
    on_xrii = rows < len(frame_view.xrii.fiducials)
    radius = None if observations.radius_px is None else observations.radius_px[order]
    beads = Beads(frame, observations.view, ids, uv, noise, xyz, on_xrii, rows, radius)
    for mine, plate, name in ((on_xrii, frame_view.xrii, "XRII"), (~on_xrii, frame_view.source, "source")):
        _refuse_unusable(uv[mine], xyz[mine], plate, name)
    return beads


@lru_cache(maxsize=16)
def _places(frame: Frame, view: str) -> tuple[dict[str, int], np.ndarray]:
    """Return the row of each fiducial of a view by its id, and their coordinates (M, 3), mm."""
    fiducials = frame.view(view)
    xyz_mm = np.concatenate([fiducials.xrii.xyz_mm, fiducials.source.xyz_mm])
    return {fiducial.id: row for row, fiducial in enumerate(fiducials.fiducials)}, xyz_mm


def _refuse_stated(covariance_px2: np.ndarray) -> None:
    """Raise ObservationsError for covariances (N, 2, 2) that no measurement has and that give no usable weights."""
    u2, v2, uv = covariance_px2[:, 0, 0], covariance_px2[:, 1, 1], covariance_px2[:, 1, 0]
    middle, apart = (u2 + v2) / 2, np.hypot((u2 - v2) / 2, uv)
    smallest = float((middle - apart).min(initial=np.inf))
    largest = float((middle + apart).max(initial=0.0))
    if not smallest > 0:
        raise ObservationsError(
            "a bead's covariance is not positive definite; give a covariance with variances above zero, in px²"
        )
    if smallest < MIN_SD_PX**2 or largest > MAX_SD_PX**2:
        raise ObservationsError(
            f"a bead's stated error is not between {MIN_SD_PX:g} and {MAX_SD_PX:g} px in every direction; "
            "give variances in px²"
        )


def _refuse_unusable(uv_px: np.ndarray, xyz_mm: np.ndarray, plate: Plate, name: str) -> None:
    """Raise CalibrationRefusedError for a plate with too few beads detected for any method."""
    of = f"of the {len(plate.fiducials)} beads of the {name} plate"
    if len(xyz_mm) == 0:
        raise CalibrationRefusedError(
            f"none {of} is seen; both plates are needed: move the frame so that both lie in the field"
        )
    if len(xyz_mm) < 4:
        raise CalibrationRefusedError(
            f"only {len(xyz_mm)} {of} are seen (at least 4 are needed, 20 or more are good): move the frame so that "
            "more of the plate lies in the field"
        )
    for points, where in ((xyz_mm, "in the frame,"), (uv_px, "in the image,")):
        refuse_collinear(points, f"{where} the {len(points)} beads seen of the {name} plate")
