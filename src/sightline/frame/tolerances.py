"""The errors of a frame's beads from its tolerances, in a hierarchy: bead, plate, arm."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.covariance import factor_of
from sightline.frame.plate import FrameView

EXPANSION_PER_K = 70e-6  # PMMA [src data sheets of cast sheet: 60 to 80 ppm/K; physics.md, Frame]
MOISTURE_EXPANSION = 0.2  # [ours] relative expansion of PMMA per share of water: half of the water's own volume
DRAPE_N = 10.0  # load of a wet drape, which moves an arm by one plate tolerance [ours]


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of a frame's errors: bead (independent), plate (its beads share it), arm (a view shares it).

    Defaults: physics.md, section Frame.
    """

    bead_mm: float = 0.02
    plate_mm: float = 0.05
    plate_rad: float = 0.2e-3
    arm_mm: float = 0.1
    arm_rad: float = 0.3e-3


@dataclass(frozen=True)
class InUse:
    """Handling errors of a frame between its measurement and its use (heat, water, drapes), one s.d. each.

    `warmer_k`: temperature change of the plates (PMMA), kelvin; `water_share`: share of their mass absorbed or released
    as water; `drape_n`: load of drapes on an arm, newtons.
    """

    warmer_k: float = 0.0
    water_share: float = 0.0
    drape_n: float = 0.0


def _rigid(xyz_mm: np.ndarray, shift_mm: float, rotation_rad: float) -> np.ndarray:
    """Return (3N, 6): displacements of N points by a shift and a small rotation about their centroid, 1 s.d. each."""
    centred = xyz_mm - xyz_mm.mean(axis=0)
    displacements = np.zeros((len(xyz_mm), 3, 6))
    displacements[:, range(3), range(3)] = shift_mm
    for axis in range(3):
        displacements[:, :, 3 + axis] = rotation_rad * np.cross(np.eye(3)[axis], centred)
    return displacements.reshape(-1, 6)


def error_factor(
    bodies: Sequence[np.ndarray],
    views: Mapping[str, FrameView],
    stated: Tolerances | np.ndarray,
    in_use: InUse | None = None,
) -> np.ndarray:
    """Return L (3M, K), mm: the errors of the M bead coordinates are L @ e with K independent unit-variance e.

    `bodies`: beads (N, 3) of each plate, or of a solid and the plate with it; `views`: empty for a solid, whose bodies
    share no errors. `stated`: tolerances, or the full covariance (3M, 3M), mm². `in_use`: handling errors to add. Order
    of the rows: see `Frame.error_factor`.

    All bodies have one material and one environment, and expand alike, each about its middle: heat and water are one
    number each. A drape loads an arm, and moves both plates of a view together.
    """
    if isinstance(stated, Tolerances):
        columns = [stated.bead_mm * np.eye(3 * sum(map(len, bodies))), *_shared(views, stated)]
    else:
        columns = [factor_of(stated)]
    if in_use is not None:
        expansion = np.concatenate([xyz - xyz.mean(axis=0) for xyz in bodies]).reshape(-1, 1)
        load = in_use.drape_n / DRAPE_N
        sag = Tolerances(0.0, 0.0, 0.0, load * Tolerances.plate_mm, load * Tolerances.plate_rad)
        columns += [EXPANSION_PER_K * in_use.warmer_k * expansion, MOISTURE_EXPANSION * in_use.water_share * expansion]
        columns += _shared(views, sag)
    return np.hstack(columns)


def _shared(views: Mapping[str, FrameView], sd: Tolerances) -> list[np.ndarray]:
    """Return the columns of the plates' and the arms' errors, (3M, 6) each."""
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
