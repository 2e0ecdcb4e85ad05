"""The errors of a calibration's lines of sight."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True, eq=False)
class LineErrors:
    """Errors of (focal point, xy of line 1, ..., xy of line N), 3 + 2N numbers, mm.

    `noise`, `misfit` (3 + 2N, 3 + 2N): covariances from the beads' measurement and from the map's own misfit.
    `frame_factor` (3 + 2N, K): response to the unit-variance errors of `Frame.error_factor`.
    """

    noise: np.ndarray
    misfit: np.ndarray
    frame_factor: np.ndarray

    def shared(self) -> dict[str, np.ndarray]:
        """Return `LinesOfSight.shared`: views of one frame share its errors."""
        return {"frame": self.frame_factor}

    def by_source(self) -> dict[str, np.ndarray]:
        """Return the covariance for each of `view.SOURCES`; they add up to the total, and none has negative variances.

        "beads" and "map" are conditional on the focal point; "focal_point" is what its uncertainty adds.
        """
        own = self.noise + self.misfit
        gain = own[:, :3] @ _pseudo_inverse(own[:3, :3])  # (3 + 2N, 3): regression on the focal point
        rest = np.eye(len(own))
        rest[:, :3] -= gain
        return {
            "beads": _symmetric(rest @ self.noise @ rest.T),
            "map": _symmetric(rest @ self.misfit @ rest.T),
            "focal_point": _symmetric(gain @ own[:3, :3] @ gain.T),
            "frame": self.frame_factor @ self.frame_factor.T,
        }


def _pseudo_inverse(covariance: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of a covariance that may be singular or zero."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-15 * values[-1]
    return (vectors[:, kept] / values[kept]) @ vectors[:, kept].T


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)


class StatedErrors(Protocol):
    """Errors of (focal point, xy of line 1, ..., xy of line N), 3 + 2N numbers, mm."""

    def by_source(self) -> dict[str, np.ndarray]:
        """Return the covariance (3 + 2N, 3 + 2N) for each of `view.SOURCES`; they add up to the total."""
        ...

    def shared(self) -> dict[str, np.ndarray]:
        """Return `LinesOfSight.shared`, (3 + 2N, K) for each source whose errors other views share."""
        ...


class Posterior(Protocol):
    """A method's fit, which states the errors of its lines of sight."""

    def line_errors(self, uv_px: np.ndarray) -> StatedErrors:
        """Return the errors of focal point and lines of sight of pixels (N, 2)."""
        ...
