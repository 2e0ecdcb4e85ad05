"""A frame's errors told apart: balls in their plate, and the two plates of a view against each other."""

from dataclasses import dataclass

import numpy as np

from sightline.frame import Frame, Plate
from sightline.frame.deviations import plates
from sightline.geometry.rigid import displacement

MOTIONS = ("shift 1", "shift 2", "along the beam", "tilt 1", "tilt 2", "twist")


@dataclass(frozen=True, eq=False)
class PlatePair:
    """The XRII plate of a view against its source plate: MOTIONS, along and about the XRII plate's two axes and normal.

    `moved` (6,): mm and rad; `prior_sd`, `sd` (6,): before and after the images.
    """

    view: str
    moved: np.ndarray
    prior_sd: np.ndarray
    sd: np.ndarray


@dataclass(frozen=True, eq=False)
class InPlate:
    """Of M balls, against the rigid plate that fits their plate's balls best, (M, 3) CFCS, mm."""

    moved_mm: np.ndarray
    prior_sd_mm: np.ndarray
    sd_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of a frame's M balls (M, 3), mm, with their covariances (3M, 3M) before (`prior`) and after the images.

    `sound` (M,) bool: balls that tell where their plate is.
    """

    moved_mm: np.ndarray
    prior: np.ndarray
    covariance: np.ndarray
    sound: np.ndarray


def plate_pairs(frame: Frame, errors: Errors) -> tuple[PlatePair, ...]:
    """Of every view."""
    out = []
    for name, view in frame.views.items():
        to_pair = np.zeros((6, errors.moved_mm.size))
        start = frame.rows(name).start
        for sign, plate in ((-1, view.xrii), (1, view.source)):
            mine = slice(start, start + 3 * len(plate.ids))
            to_pair[:, mine] = sign * _motion(plate, view.xrii, errors.sound[mine.start // 3 : mine.stop // 3])
            start = mine.stop
        sds = (_sd(to_pair, covariance) for covariance in (errors.prior, errors.covariance))
        out.append(PlatePair(name, to_pair @ errors.moved_mm.ravel(), *sds))
    return tuple(out)


def in_plate(frame: Frame, errors: Errors) -> InPlate:
    """Of every ball."""
    rest, start = np.eye(errors.moved_mm.size), 0
    for _, _, plate in plates(frame):
        mine = slice(start, start + 3 * len(plate.ids))
        rigid = _rigid(plate, plate)
        rest[mine, mine] -= rigid @ _motion(plate, plate, errors.sound[mine.start // 3 : mine.stop // 3])
        start = mine.stop
    left = (rest @ errors.moved_mm.ravel()).reshape(-1, 3)
    return InPlate(left, *(_sd(rest, covariance).reshape(-1, 3) for covariance in (errors.prior, errors.covariance)))


def _sd(rows: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("ij,ij->i", rows @ covariance, rows), 0.0))


def _motion(plate: Plate, axes_of: Plate, sound: np.ndarray) -> np.ndarray:
    """(6, 3N): the rigid motion of a plate that its sound balls' errors make."""
    rows = np.repeat(sound, 3)
    out = np.zeros((6, len(rows)))
    out[:, rows] = np.linalg.pinv(_rigid(plate, axes_of)[rows])
    return out


def _rigid(plate: Plate, axes_of: Plate) -> np.ndarray:
    """(3N, 6): how a plate's balls move with MOTIONS, about their middle."""
    turned = np.vstack([axes_of.plane.axes, axes_of.plane.normal]).T
    twists = displacement(plate.xyz_mm - plate.xyz_mm.mean(axis=0)).reshape(-1, 6)
    return np.hstack([twists[:, 3:] @ turned, twists[:, :3] @ turned])
