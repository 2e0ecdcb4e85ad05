"""Residuals of the beads after calibration."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of N beads of a view, on the reference plane, mm.

    `residual_mm` (N, 2): the bead's place by the map minus its place by the frame. `leave_one_out_mm` (N, 2): the same
    without the bead in the calibration; `predicted` (N,) bool: False in rows that are not valid because the method
    cannot predict the bead without itself. `sigma` (N,): length of the leave-one-out error over its own standard
    deviation. `used` (N,) bool: False where the bead was left out as wrong.
    """

    ids: tuple[str, ...]
    uv_px: np.ndarray
    residual_mm: np.ndarray
    leave_one_out_mm: np.ndarray
    predicted: np.ndarray
    sigma: np.ndarray
    used: np.ndarray

    def __post_init__(self) -> None:
        for name in ("uv_px", "residual_mm", "leave_one_out_mm", "predicted", "sigma", "used"):
            getattr(self, name).flags.writeable = False

    @property
    def left_out(self) -> tuple[str, ...]:
        """Ids of the beads left out as wrong."""
        return tuple(i for i, used in zip(self.ids, self.used, strict=True) if not used)

    @property
    def rms_mm(self) -> float:
        """Rms residual per axis over the beads used: 0.7 times the rms of the residuals' lengths."""
        return float(np.sqrt(np.mean(self.residual_mm[self.used] ** 2)))

    @property
    def leave_one_out_rms_mm(self) -> float:
        """Rms leave-one-out error per axis over the beads that were used and could be predicted."""
        rows = self.used & self.predicted
        return float(np.sqrt(np.mean(self.leave_one_out_mm[rows] ** 2)))
