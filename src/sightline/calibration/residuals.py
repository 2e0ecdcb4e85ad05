"""What is left of each bead after calibration."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Residuals:
    """For each of N beads of a view, on the reference plane, mm.

    `residual_mm` (N, 2): where the map puts the bead less where the frame puts it. `leave_one_out_mm` (N, 2): the
    same, the bead itself having no part in the calibration; `predicted` (N,) bool: False in the rows that say nothing,
    because the method cannot predict the bead without itself. `sigma` (N,): size of the leave-one-out error over its
    own standard deviation. `used` (N,) bool: False where the bead was left out as wrong.
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
        """Ids of the beads that were left out as wrong."""
        return tuple(i for i, used in zip(self.ids, self.used, strict=True) if not used)

    @property
    def rms_mm(self) -> float:
        """Of the residuals per axis, over the beads that were used: 0.7 times the rms of their lengths."""
        return float(np.sqrt(np.mean(self.residual_mm[self.used] ** 2)))

    @property
    def leave_one_out_rms_mm(self) -> float:
        """Per axis, over the beads that were used and could be predicted."""
        rows = self.used & self.predicted
        return float(np.sqrt(np.mean(self.leave_one_out_mm[rows] ** 2)))
