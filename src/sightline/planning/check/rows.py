"""The observation rows of a check shot: residuals, their derivatives by the unknowns, and their covariance.

A row is one number observed in one view: two for each landmark; one for each point of the wire's centre line, across
the line; one for its tip, along the line.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.projection import Pencil
from sightline.calibration.view import LinesOfSight
from sightline.common.geometry.covariance import joined
from sightline.planning.points.line_residuals import LineResiduals, pick_covariance_mm2


@dataclass(frozen=True, eq=False)
class Rows:
    """R rows of one view, mm on its reference plane, for N points.

    `residual` (R,); `to_point` (R, N, 3): derivative of the projections by the points; `covariance` (R, R): without
    the errors that `lines` share with other views; `shared`: for each source of those the response (R, K), as in
    `LinesOfSight.shared`.
    """

    lines: LinesOfSight

    residual: np.ndarray
    to_point: np.ndarray
    covariance: np.ndarray
    shared: dict[str, np.ndarray]

    @staticmethod
    def of(lines: LinesOfSight, xyz_mm: np.ndarray, noise_px2: np.ndarray, select: np.ndarray) -> "Rows":
        """Return the rows of points (N, 3), each seen on its line with the pixel covariance `noise_px2` (N, 2, 2).

        `select` (R, 2N): takes the points' residuals to rows.
        """
        assert lines.covariance is not None  # noqa: S101 - called only where the errors are known
        at, n = LineResiduals.at(lines, xyz_mm), len(xyz_mm)
        picks = np.zeros((n, 2, n, 2))
        picks[np.arange(n), :, np.arange(n), :] = pick_covariance_mm2(lines, noise_px2)
        to_line = select @ at.to_line
        common = {source: response @ response.T for source, response in lines.shared.items()}
        known = np.sum([own - common.get(source, 0.0) for source, own in lines.covariance.items()], axis=0)
        own = to_line @ known @ to_line.T + select @ picks.reshape(2 * n, 2 * n) @ select.T
        to_point = np.einsum("rnc,nca->rna", select.reshape(len(select), n, 2), at.to_point)
        shared = {source: to_line @ response for source, response in lines.shared.items()}
        return Rows(lines, select @ at.xy_mm.ravel(), to_point, own, shared)


def along_and_across(lines: LinesOfSight, xyz_mm: np.ndarray, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors (N, 2) along and across the image, on the plane, of a curve through points (N, 3) with
    tangents (N, 3)."""
    pencil = Pencil.through(lines.plane, lines.focal_point_mm)
    along = np.einsum("nca,na->nc", pencil.by_point(xyz_mm), tangent)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return along, np.stack([-along[:, 1], along[:, 0]], axis=-1)


def joint_covariance(rows: Sequence[Rows]) -> np.ndarray:
    """Return the covariance (R, R) of the concatenated rows of several views."""

    def between(i: int, j: int) -> np.ndarray:
        a, b = rows[i], rows[j]
        out = np.zeros((len(a.residual), len(b.residual)))
        for source in a.lines.sources_shared_with(b.lines):
            out += a.shared[source] @ b.shared[source].T
        return out

    return joined([one.covariance + between(i, i) for i, one in enumerate(rows)], between)
