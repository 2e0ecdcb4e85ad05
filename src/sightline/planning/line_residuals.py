"""Residuals of points against their lines of sight, on the reference planes, and their covariance per source.

The residual of a point X in a view is `xy - projection(F, X)`, mm on the view's reference plane: the line's xy by the
plane map minus the central projection of X from the focal point F. Its error follows from those of xy and F.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
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
    known = [(one.to_line, one.lines, one.lines.covariance) for one in views if one.lines.covariance is not None]
    if len(known) < len(views):
        return None

    def between(source: str, i: int, j: int) -> np.ndarray:
        (by_a, a, _), (by_b, b, _) = known[i], known[j]
        if source not in a.sources_shared_with(b):
            return np.zeros((len(by_a), len(by_b)))
        return (by_a @ a.shared[source]) @ (by_b @ b.shared[source]).T

    return {
        source: joined([by @ covariance[source] @ by.T for by, _, covariance in known], partial(between, source))
        for source in SOURCES
    }


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
