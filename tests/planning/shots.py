"""Check shots of a straight wire, without images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.planning.check.result import CheckShot


@dataclass(frozen=True, eq=False)
class Wire:
    """See `WireSeen`."""

    uv_px: np.ndarray
    variance_px2: np.ndarray
    tip_uv_px: np.ndarray
    tip_variance_px2: float


def straight_shot(wire_mm: np.ndarray, across: np.ndarray, deviation_mm: Sequence[float], sd_mm: float) -> CheckShot:
    """A check shot of a planned wire (2, 3) that deviates by `deviation_mm` (5,) along `across` (2, 3), in rest."""
    entry, end = wire_mm
    return CheckShot(
        entry_mm=entry,
        tip_mm=end + np.array(deviation_mm[2:4]) @ across,
        deviation_mm=np.array(deviation_mm),
        covariance_mm2=sd_mm**2 * np.eye(5),
        across=across,
        length_mm=float(np.linalg.norm(end - entry)),
        movement=RigidTransform.identity(),
        landmarks=3,
        bow_mm=0.0,
        bow_sigma=0.0,
        residual_rms=1.0,
        outlier_sigma=1.0,
    )
