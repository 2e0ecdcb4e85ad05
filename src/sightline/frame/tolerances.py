"""How a frame's tolerances become errors of its beads: hierarchical, bead below plate below arm."""

import numpy as np

from sightline.frame.model import Frame


def _rigid(xyz_mm: np.ndarray, shift_mm: float, turn_rad: float) -> np.ndarray:
    """(3N, 6): how N points move with a shift and a small rotation about their centroid, per unit-variance number."""
    centred = xyz_mm - xyz_mm.mean(axis=0)
    out = np.zeros((len(xyz_mm), 3, 6))
    out[:, range(3), range(3)] = shift_mm
    for axis in range(3):
        out[:, :, 3 + axis] = turn_rad * np.cross(np.eye(3)[axis], centred)
    return out.reshape(-1, 6)


def _stated_factor(covariance_mm2: np.ndarray) -> np.ndarray:
    """A factor of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(covariance_mm2)
    return vectors * np.sqrt(np.clip(values, 0.0, None))


def error_factor(frame: Frame) -> np.ndarray:
    """See `Frame.error_factor`."""
    if frame.covariance_mm2 is not None:
        return _stated_factor(frame.covariance_mm2)
    sd = frame.effective_tolerances
    beads = sum(len(view.fiducials) for view in frame.views.values())
    shared: list[np.ndarray] = []
    start = 0
    for view in frame.views.values():
        both = np.concatenate([view.xrii.xyz_mm, view.source.xyz_mm])
        for points, first, mm, rad in (
            (view.xrii.xyz_mm, start, sd.plate_mm, sd.plate_rad),
            (view.source.xyz_mm, start + len(view.xrii.fiducials), sd.plate_mm, sd.plate_rad),
            (both, start, sd.arm_mm, sd.arm_rad),
        ):
            block = np.zeros((3 * beads, 6))
            block[3 * first : 3 * (first + len(points))] = _rigid(points, mm, rad)
            shared.append(block)
        start += len(both)
    return np.hstack([sd.bead_mm * np.eye(3 * beads), *shared])
