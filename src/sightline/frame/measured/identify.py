"""Identification of measured balls: the pose that most balls agree on, and the ids of those that do not.

Three balls give a pose; of many triples the pose that most balls fit is kept (RANSAC), so that neither exchanged ids
nor wrong numbers affect it. The balls that do not fit are then assigned to the places that they do fit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import RigidTransform

from sightline.common.geometry.rigid import rigid_fit, rigid_fits
from sightline.errors import FrameError
from sightline.frame.model import Frame
from sightline.frame.tables import Series

TRIPLES = 400  # [calc] with half of the ids right, 50 triples have right ids only
MAX_MISFIT = 1 / 3  # [ours] of the smallest distance between two balls: nearer to a ball's own place than to any other
MIN_FLATNESS = 0.05  # [ours] minimum height of a triple over its longest side: a flatter one leaves its rotation open
MAX_WRONG_SHARE = 0.5  # share of wrong ids beyond which no pose is reliable: that of TRIPLES
UNITS = {"metres": 1e-3, "centimetres": 0.1, "inches": 1 / 25.4, "micrometres": 1e3}
UNIT_TOLERANCE = 0.1  # [ours] of a ratio of distances that shows a wrong unit: far below a factor of 2.5 between two
MIRRORED_RATIO = 1.2  # [ours] of the balls that fit mirrored to those upright: a single plate fits its mirror image too


@dataclass(frozen=True, eq=False)
class Identified:
    """The pose of a series and its wrong ids; `pose` takes the instrument's coordinates to CFCS.

    `renamed`: measured id -> the ball whose place it fits. `astray_mm`: measured id -> distance from its place, where
    it fits no other ball's. `mirrored`: whether only the mirror image of the series fits the frame.
    """

    series: str
    pose: RigidTransform
    renamed: dict[str, str]
    astray_mm: dict[str, float]
    mirrored: bool


def identify(series: Series, frame: Frame) -> Identified:
    """Return the pose of a series and its wrong ids.

    Raises FrameError where balls are unknown or do not determine a pose.
    """
    place = {ball: np.array(xyz) for ball, xyz in frame.xyz_mm_by_id.items()}
    if unknown := [i for i in series.ids if i not in place]:
        raise FrameError(
            f"series {series.name!r}: frame {frame.name!r} has no ball {', '.join(map(repr, unknown[:5]))}; "
            "write the ids of the frame file"
        )
    nominal = np.array([place[i] for i in series.ids])
    triples = _triples(nominal, series.name)
    _refuse_units(nominal, series, triples)
    everywhere = np.array(list(place.values()))
    limit = MAX_MISFIT * float(KDTree(everywhere).query(everywhere, k=2)[0][:, 1].min())
    upright, reflected = (_consensus(nominal, series.xyz_mm * sign, triples, limit) for sign in (1.0, -1.0))
    mirrored = bool(reflected[1].sum() > MIRRORED_RATIO * upright[1].sum())
    pose, agrees = reflected if mirrored else upright
    if agrees.mean() < 1 - MAX_WRONG_SHARE:
        raise FrameError(
            f"series {series.name!r}: only {agrees.sum()} of {len(agrees)} balls fit frame {frame.name!r} together; "
            "check that the ids are those of this frame, and that its plates are mounted as in the frame file"
        )
    at = pose.apply(series.xyz_mm * (-1.0 if mirrored else 1.0))
    renamed, astray = _strays(series.ids, at, place, agrees, limit)
    return Identified(series.name, pose, renamed, astray, mirrored)


def _triples(nominal: np.ndarray, name: str) -> np.ndarray:
    """Return (T, 3): indices of triples of balls that are not nearly collinear. Raises FrameError."""
    n = len(nominal)
    rng = np.random.default_rng(0)
    rows = np.argsort(rng.random((TRIPLES, n)), axis=1)[:, :3] if n > 3 else np.arange(n)[None]
    if n < 3:
        raise FrameError(f"series {name!r} has {n} balls; measure at least three that do not lie on one line")
    a, b, c = nominal[rows].swapaxes(0, 1)
    sides = np.stack([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)])
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / sides.max(axis=0)
    broad = height > MIN_FLATNESS * sides.max(axis=0)
    if not broad.any():
        raise FrameError(f"the balls of series {name!r} lie on one line; measure at least three that do not")
    return rows[broad]


def _refuse_units(nominal: np.ndarray, series: Series, triples: np.ndarray) -> None:
    """Raise FrameError where the median ratio of distances, which is robust to wrong ids, shows a wrong unit."""
    first, second = triples[:, 0], triples[:, 1]
    theirs = np.linalg.norm(series.xyz_mm[first] - series.xyz_mm[second], axis=1)
    ratio = float(np.median(theirs / np.linalg.norm(nominal[first] - nominal[second], axis=1)))
    for unit, scale in UNITS.items():
        if abs(ratio / scale - 1) < UNIT_TOLERANCE:
            raise FrameError(f"convert series {series.name!r} and its errors to millimetres: it is in {unit}")
    if not 1 / 2 < ratio < 2:
        raise FrameError(
            f"distances in series {series.name!r} are {ratio:.3g} times those of the frame; check units and ids"
        )


def _consensus(
    nominal: np.ndarray, measured: np.ndarray, triples: np.ndarray, limit: float
) -> tuple[RigidTransform, np.ndarray]:
    """Return the pose that most balls agree on, and which do, (n,) bool."""
    rotation, translation = rigid_fits(measured[triples], nominal[triples])
    at = np.einsum("tij,nj->tni", rotation, measured) + translation[:, None]
    fits = ((at - nominal) ** 2).sum(axis=2) < limit**2
    agrees = fits[np.argmax(fits.sum(axis=1))]
    pose = rigid_fit(measured[agrees], nominal[agrees])
    for _ in range(3):  # a pose from three balls extrapolates their errors; more balls agree once it is refitted
        agrees = np.linalg.norm(pose.apply(measured) - nominal, axis=1) < limit
        if agrees.sum() < 3:
            break
        pose = rigid_fit(measured[agrees], nominal[agrees])
    return pose, agrees


def _strays(
    ids: tuple[str, ...], at_mm: np.ndarray, place: dict[str, np.ndarray], agrees: np.ndarray, limit: float
) -> tuple[dict[str, str], dict[str, float]]:
    """Return, of the balls that do not agree, those that fit another ball's place, and the distances of the others."""
    right = {i for i, agreed in zip(ids, agrees, strict=True) if agreed}
    free = [i for i in place if i not in right]
    strays = np.flatnonzero(~agrees)
    renamed: dict[str, str] = {}
    astray: dict[str, float] = {}
    if not len(strays):
        return renamed, astray
    distance = cdist(at_mm[strays], np.array([place[i] for i in free]))
    fits = dict(zip(*linear_sum_assignment(np.minimum(distance, 2 * limit)), strict=True))
    for row, ball in enumerate(strays):
        other = fits.get(row)
        if other is not None and distance[row, other] < limit:
            renamed[ids[ball]] = free[other]
        else:
            astray[ids[ball]] = float(np.linalg.norm(at_mm[ball] - place[ids[ball]]))
    return renamed, astray
