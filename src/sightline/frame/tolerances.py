"""How a frame's tolerances become errors of its beads: hierarchical, bead below plate below arm."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sightline.frame.plate import FrameView

EXPANSION_PER_K = 70e-6  # PMMA [mem, physics.md]
MOISTURE_EXPANSION = 0.2  # growth in length per share of mass taken up as water: 1 % of water, 0.2 % [mem]
DRAPE_N = 10.0  # a wet drape: moves an arm by one plate tolerance [ours]


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of a frame's errors: bead (independent), plate (its beads share it), arm (a view shares it).

    Defaults: physics.md, section Frame [ours].
    """

    bead_mm: float = 0.02
    plate_mm: float = 0.05
    plate_rad: float = 0.2e-3
    arm_mm: float = 0.1
    arm_rad: float = 0.3e-3


@dataclass(frozen=True)
class InUse:
    """What befalls a frame between its measurement and its use, one s.d. each: kelvin that the plates (PMMA) are warmer
    or colder, share of their mass taken up or given off as water, newtons of drapes on an arm."""

    warmer_k: float = 0.0
    water_share: float = 0.0
    drape_n: float = 0.0


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


def error_factor(
    views: Mapping[str, FrameView], stated: Tolerances | np.ndarray, in_use: InUse | None = None
) -> np.ndarray:
    """(3M, K), mm: the coordinates of the views' M beads err by this times K independent unit-variance numbers.

    `stated`: tolerances, or the full covariance (3M, 3M), mm². Order of the rows: see `Frame.error_factor`.
    """
    if isinstance(stated, Tolerances):
        beads = sum(len(view.fiducials) for view in views.values())
        columns = [stated.bead_mm * np.eye(3 * beads), *_shared(views, stated)]
    else:
        columns = [_stated_factor(stated)]
    if in_use is not None:
        columns += _in_use(views, in_use)
    return np.hstack(columns)


def _shared(views: Mapping[str, FrameView], sd: Tolerances) -> list[np.ndarray]:
    """Columns of the plates' and the arms' errors, (3M, 6) each."""
    shared: list[np.ndarray] = []
    beads = sum(len(view.fiducials) for view in views.values())
    start = 0
    for view in views.values():
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


def _in_use(views: Mapping[str, FrameView], handled: InUse) -> list[np.ndarray]:
    """Columns of what use adds. All plates are of one material in one room: they grow alike, each about its middle, so
    heat and water are one number each. A drape hangs on an arm, and moves both plates of a view as one, anywhere."""
    plates = [plate.xyz_mm for view in views.values() for plate in (view.xrii, view.source)]
    growth = np.concatenate([xyz - xyz.mean(axis=0) for xyz in plates]).reshape(-1, 1)
    load = handled.drape_n / DRAPE_N
    sag = Tolerances(0.0, 0.0, 0.0, load * Tolerances.plate_mm, load * Tolerances.plate_rad)
    return [
        EXPANSION_PER_K * handled.warmer_k * growth,
        MOISTURE_EXPANSION * handled.water_share * growth,
        *_shared(views, sag),
    ]
