"""A frame's errors split into ball errors within each plate and motions of a view's plates against each other."""

from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.rigid import displacement
from sightline.frame import Frame, Plate

MOTIONS = ("shift 1", "shift 2", "along the beam", "tilt 1", "tilt 2", "twist")


@dataclass(frozen=True, eq=False)
class PlatePair:
    """Motion of a view's source plate against its XRII plate: MOTIONS along and about the XRII plate's axes and normal.

    `moved` (6,): mm and rad; `prior_sd`, `sd` (6,): standard deviations before and after the images.
    """

    view: str
    moved: np.ndarray
    prior_sd: np.ndarray
    sd: np.ndarray


@dataclass(frozen=True, eq=False)
class InPlate:
    """Displacements of M balls against the best-fitting rigid motion of their plate, (M, 3), CFCS, mm."""

    moved_mm: np.ndarray
    prior_sd_mm: np.ndarray
    sd_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of a frame's M balls (M, 3), mm, with their covariances (3M, 3M) before (`prior`) and after the images.

    `sound` (M,) bool: balls that are used to determine their plate's motion.
    """

    moved_mm: np.ndarray
    prior: np.ndarray
    covariance: np.ndarray
    sound: np.ndarray


def plate_pairs(frame: Frame, errors: Errors) -> tuple[PlatePair, ...]:
    """Return the relative motion of the two plates of every view."""
    pairs = []
    for name, view in frame.views.items():
        to_pair = np.zeros((6, errors.moved_mm.size))
        start = frame.rows(name).start
        for sign, plate in ((-1, view.xrii), (1, view.source)):
            rows = slice(start, start + 3 * len(plate.ids))
            to_pair[:, rows] = sign * _motion(plate, view.xrii, errors.sound[rows.start // 3 : rows.stop // 3])
            start = rows.stop
        sds = (_sd(to_pair, covariance) for covariance in (errors.prior, errors.covariance))
        pairs.append(PlatePair(name, to_pair @ errors.moved_mm.ravel(), *sds))
    return tuple(pairs)


def in_plate(frame: Frame, errors: Errors) -> InPlate:
    """Return the displacement of every ball within its plate."""
    rest, start = np.eye(errors.moved_mm.size), 0
    for _, _, plate in frame.named_plates:
        rows = slice(start, start + 3 * len(plate.ids))
        rigid = _rigid(plate, plate)
        rest[rows, rows] -= rigid @ _motion(plate, plate, errors.sound[rows.start // 3 : rows.stop // 3])
        start = rows.stop
    moved = (rest @ errors.moved_mm.ravel()).reshape(-1, 3)
    return InPlate(moved, *(_sd(rest, covariance).reshape(-1, 3) for covariance in (errors.prior, errors.covariance)))


def _sd(rows: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("ij,ij->i", rows @ covariance, rows), 0.0))


def _motion(plate: Plate, axes_of: Plate, sound: np.ndarray) -> np.ndarray:
    """Return (6, 3N): takes the errors of a plate's balls to its rigid motion, using the sound ones."""
    rows = np.repeat(sound, 3)
    motion = np.zeros((6, len(rows)))
    motion[:, rows] = np.linalg.pinv(_rigid(plate, axes_of)[rows])
    return motion


def _rigid(plate: Plate, axes_of: Plate) -> np.ndarray:
    """Return (3N, 6): displacements of a plate's balls by MOTIONS about their mean, along the axes of `axes_of`."""
    axes = axes_of.plane.basis.T
    twists = displacement(plate.xyz_mm - plate.xyz_mm.mean(axis=0)).reshape(-1, 6)
    return np.hstack([twists[:, 3:] @ axes, twists[:, :3] @ axes])
