"""Residuals of points against their lines of sight, on the reference planes, and their covariance per source.

The residual of a point X in a view is `xy - projection(F, X)`, mm on the view's reference plane: the line's xy by the
plane map minus the central projection of X from the focal point F. Its error follows from those of xy and F.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import combinations, pairwise

import numpy as np

from sightline.calibration.projection import Pencil
from sightline.calibration.view import SOURCES, CalibratedView, LinesOfSight
from sightline.errors import ReconstructionRefusedError, UnusableInputError
from sightline.geometry.covariance import joined

# Two X-ray sources nearer than this belong to one exposure given twice [ours].
MIN_BASELINE_MM = 1.0


@dataclass(frozen=True, eq=False)
class LineResiduals:
    """Residuals of N points in one view.

    `xy_mm` (N, 2); `to_point` (N, 2, 3): d projection / d X; `to_line` (2N, 3 + 2N): d residual / d (F, every xy).
    `reach` (N,): distance of X from the focal point over that of the line's point on the plane: a line displaced by
    r on the plane is displaced by reach * r (perpendicular to itself) at X; negative behind the X-ray source.
    """

    lines: LinesOfSight
    xy_mm: np.ndarray
    to_point: np.ndarray
    to_line: np.ndarray
    reach: np.ndarray

    @staticmethod
    def at(lines: LinesOfSight, xyz_mm: np.ndarray) -> "LineResiduals":
        """Return the residuals of points (N, 3), one for each line."""
        plane, focal = lines.plane, lines.focal_point_mm
        reach = 1.0 - plane.height_mm(xyz_mm) / plane.height_mm(focal)
        to_point = Pencil.through(plane, focal).by_point(xyz_mm)
        # On the plane, a shift of F by r has the effect of a shift of X by (reach - 1) r.
        to_focal = (reach - 1.0)[:, None, None] * to_point
        to_line = np.hstack([-to_focal.reshape(-1, 3), np.eye(2 * len(xyz_mm))])
        residual = lines.xy_mm - plane.central_projection(focal, xyz_mm)
        return LineResiduals(lines, residual, to_point, to_line, reach)


def covariance_by_source(views: Sequence[LineResiduals]) -> dict[str, np.ndarray] | None:
    """Return the covariance (R, R) of the residuals of all views (view, point, axis) for each of SOURCES.

    None where a view's error is unknown. The views are correlated through the errors that they share.
    """
    known = [(one.to_line, one.lines.covariance) for one in views if one.lines.covariance is not None]
    if len(known) < len(views):
        return None
    own = {source: [by @ covariance[source] @ by.T for by, covariance in known] for source in SOURCES}
    return {source: joined(one, partial(_between, views, (source,))) for source, one in own.items()}


def total_covariance(views: Sequence[LineResiduals]) -> np.ndarray | None:
    """Return the sum of `covariance_by_source`, computed at once."""
    known = [(one.to_line, one.lines.total_covariance) for one in views]
    own = [by @ covariance @ by.T for by, covariance in known if covariance is not None]
    return joined(own, partial(_between, views, SOURCES)) if len(own) == len(views) else None


def _between(views: Sequence[LineResiduals], sources: Sequence[str], i: int, j: int) -> np.ndarray:
    """Return the covariance between the residuals of two views by the errors of `sources` that they share."""
    a, b = views[i], views[j]
    out = np.zeros((len(a.to_line), len(b.to_line)))
    for source in a.lines.sources_shared_with(b.lines):
        if source in sources:
            out += (a.to_line @ a.lines.shared[source]) @ (b.to_line @ b.lines.shared[source]).T
    return out


@lru_cache(maxsize=8)  # the views of a few cases [ours]
def no_lines(view: CalibratedView) -> LinesOfSight:
    """Return no lines of sight of a view: they tell its frame."""
    return view.lines_of_sight(np.zeros((0, 2)))


def refuse_two_frames(lines: Sequence[LinesOfSight]) -> None:
    """Raise ReconstructionRefusedError for views of two frames, whose coordinates are unrelated.

    A view from a matrix has no frame and is accepted with any.
    """
    known = [(one.view, one.frame_key) for one in lines if one.frame_key is not None]
    for (first, frame), (second, other) in pairwise(known):
        if frame == other:
            continue
        names = [key.partition("#")[0].rstrip("/") for key in (frame, other)]
        which = (
            f"the frames {names[0]} and {names[1]}" if names[0] != names[1] else f"two files of the frame {names[0]}"
        )
        raise ReconstructionRefusedError(
            f"the views {first!r} and {second!r} were calibrated with {which}, whose coordinates differ; "
            "calibrate all views with the one file of the frame in the images"
        )


def refuse_repeated(views: Sequence[CalibratedView]) -> None:
    """Raise UnusableInputError for fewer than two views, ReconstructionRefusedError where two are one exposure."""
    if len(views) < 2:
        raise UnusableInputError(f"{len(views)} views given; give two or more to reconstruct a point")
    for first, second in combinations(views, 2):
        baseline = float(np.linalg.norm(first.focal_point_mm - second.focal_point_mm))
        if first is second or baseline < MIN_BASELINE_MM:
            raise ReconstructionRefusedError(
                f"one view is given twice ({first.name!r} and {second.name!r}, X-ray sources {baseline:.1f} mm apart); "
                "give images taken from different directions"
            )


def pick_covariance_mm2(lines: LinesOfSight, covariance_px2: np.ndarray) -> np.ndarray:
    """Return the picks' covariances (N, 2, 2), px², propagated to the plane, mm²."""
    return lines.jacobian @ covariance_px2 @ np.swapaxes(lines.jacobian, -1, -2)
