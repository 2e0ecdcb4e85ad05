"""How the errors of a calibration reach its lines of sight."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True, eq=False)
class LineErrors:
    """Errors of (focal point, xy of line 1, ..., xy of line N), 3 + 2N numbers, mm.

    `noise`, `misfit` (3 + 2N, 3 + 2N): covariances that the beads' measurement and the map's own inexactness
    leave. `frame_factor` (3 + 2N, K): response to the unit-variance errors of `Frame.error_factor`.
    """

    noise: np.ndarray
    misfit: np.ndarray
    frame_factor: np.ndarray

    def by_source(self) -> dict[str, np.ndarray]:
        """The covariance for each of `view.SOURCES`; they add up to the whole, and none has a negative variance.

        "beads" and "map" are what is left with the focal point known (conditioned on), "focal_point" is what not
        knowing it adds.
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
    """Of a covariance that may be singular, even zero."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-15 * values[-1]
    return (vectors[:, kept] / values[kept]) @ vectors[:, kept].T


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)


class Posterior(Protocol):
    """What a method knows of the errors of its lines of sight."""

    def line_errors(self, uv_px: np.ndarray) -> LineErrors:
        """For pixels (N, 2)."""
        ...
