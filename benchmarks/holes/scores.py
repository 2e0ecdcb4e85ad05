"""How a measured hole of a nail differs from the true one."""

from dataclasses import dataclass

import numpy as np

from sightline.planning import Hole
from sightline.twin.anatomy.nailed_femur import DistalNail


@dataclass(frozen=True)
class Trial:
    """Errors of one hole at its middle, mm, and of its direction, °; squared Mahalanobis lengths of both together (4
    degrees of freedom); time of the fit, s; `turned_deg`: of the beam from the hole after the advised turn, °."""

    off_mm: float
    off_deg: float
    square: float
    time_s: float
    turned_deg: float = float("nan")


def scored(hole: Hole, nail: DistalNail, time_s: float = 0.0) -> Trial:
    """Return how a measured hole differs from the first hole of a nail."""
    point, axis = nail.holes[0]
    axis = axis * np.sign(axis @ hole.direction)
    ends = point + axis * ((np.stack([hole.entry_mm, hole.exit_mm]) - point) @ axis)[:, None]
    across = np.linalg.svd(hole.direction[None])[2][1:]
    to_axis = np.kron(np.eye(2), across)
    error = to_axis @ (np.stack([hole.entry_mm, hole.exit_mm]) - ends).ravel()
    square = float(error @ np.linalg.solve(to_axis @ hole.covariance_mm2 @ to_axis.T, error))
    off = np.linalg.norm(np.cross(hole.middle_mm - point, axis))
    return Trial(
        float(off), float(np.rad2deg(np.arcsin(np.linalg.norm(np.cross(axis, hole.direction))))), square, time_s
    )
