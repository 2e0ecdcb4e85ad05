"""How a frame's tolerances become errors of its beads: hierarchical, bead below plate below arm."""

import numpy as np

from sightline.frame.model import Frame, InUse, Tolerances

EXPANSION_PER_K = 70e-6  # PMMA [mem, physics.md]
SWELLING_PER_WATER = 0.2  # growth in length per share of mass taken up as water: 1 % of water, 0.2 % [mem]
DRAPE_N = 10.0  # a wet drape: moves an arm by one plate tolerance [ours]


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
        columns = [_stated_factor(frame.covariance_mm2)]
    else:
        sd = frame.effective_tolerances
        beads = sum(len(view.fiducials) for view in frame.views.values())
        columns = [sd.bead_mm * np.eye(3 * beads), *_shared(frame, sd)]
    if frame.in_use is not None:
        columns += _in_use(frame, frame.in_use)
    return np.hstack(columns)


def _shared(frame: Frame, sd: Tolerances) -> list[np.ndarray]:
    """Columns of the plates' and the arms' errors, (3M, 6) each."""
    shared: list[np.ndarray] = []
    beads = sum(len(view.fiducials) for view in frame.views.values())
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
    return shared


def _in_use(frame: Frame, handled: InUse) -> list[np.ndarray]:
    """Columns of what use adds. All plates are of one material in one room: they grow alike, each about its middle, so
    heat and water are one number each. A drape hangs on an arm, and moves both plates of a view as one, anywhere."""
    plates = [plate.xyz_mm for view in frame.views.values() for plate in (view.xrii, view.source)]
    growth = np.concatenate([xyz - xyz.mean(axis=0) for xyz in plates]).reshape(-1, 1)
    load = handled.drape_n / DRAPE_N
    sag = Tolerances(0.0, 0.0, 0.0, load * Tolerances.plate_mm, load * Tolerances.plate_rad)
    return [
        EXPANSION_PER_K * handled.warmer_k * growth,
        SWELLING_PER_WATER * handled.water_share * growth,
        *_shared(frame, sag),
    ]
