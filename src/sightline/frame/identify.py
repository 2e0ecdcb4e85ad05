"""Which measured ball is which: the pose that most balls agree on, and what the others were taken for.

Three balls give a pose; of many threes the pose that most balls fit is kept, so that neither exchanged ids nor wrong
numbers bend it. Then the balls that do not fit are assigned to the places that they do fit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import RigidTransform

from sightline.errors import FrameError
from sightline.frame.measurements import Series
from sightline.frame.model import Frame
from sightline.geometry.rigid import rigid_fit, rigid_fits

TRIPLES = 400  # [calc] with half of the ids right, 50 of them are
MAX_MISFIT = 1 / 3  # [ours] of the smallest distance between two balls: nearer to their own place than to any other
MIN_FLATNESS = 0.05  # [ours] least height of a triple over its longest side
MAX_WRONG_SHARE = 0.5  # [ours] share of wrong ids beyond which no pose can be trusted
UNITS = {"metres": 1e-3, "centimetres": 0.1, "inches": 1 / 25.4, "micrometres": 1e3}
UNIT_TOLERANCE = 0.1  # [ours] how near a ratio of distances must come to a unit's to be taken for it
MIRRORED_RATIO = 1.2  # [ours] times as many balls: a single plate fits its mirror image as well


@dataclass(frozen=True, eq=False)
class Identified:
    """How a series lies: `pose` takes the instrument's coordinates to CFCS.

    `renamed`: measured id -> the ball whose place it fits. `astray_mm`: measured id -> how far it lies from its place,
    where that fits no other ball's. `mirrored`: only a mirror image of the series fits the frame.
    """

    series: str
    pose: RigidTransform
    renamed: dict[str, str]
    astray_mm: dict[str, float]
    mirrored: bool


def identify(series: Series, frame: Frame) -> Identified:
    """The pose of a series and its wrong ids. Raises FrameError where balls are unknown or determine no pose."""
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
            "the ids are not those of this frame, or its plates do not stand as the frame file says"
        )
    at = pose.apply(series.xyz_mm * (-1.0 if mirrored else 1.0))
    renamed, astray = _strays(series.ids, at, place, agrees, limit)
    return Identified(series.name, pose, renamed, astray, mirrored)


def _triples(nominal: np.ndarray, name: str) -> np.ndarray:
    """(T, 3) rows of balls that are not nearly on a line. Raises FrameError."""
    n = len(nominal)
    rng = np.random.default_rng(0)
    rows = np.argsort(rng.random((TRIPLES, n)), axis=1)[:, :3] if n > 3 else np.arange(n)[None]
    if n < 3:
        raise FrameError(f"series {name!r} holds {n} balls; a pose needs three that are not on a line")
    a, b, c = nominal[rows].swapaxes(0, 1)
    sides = np.stack([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)])
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / sides.max(axis=0)
    broad = height > MIN_FLATNESS * sides.max(axis=0)
    if not broad.any():
        raise FrameError(f"the balls of series {name!r} lie on a line; a pose needs three that do not")
    return rows[broad]


def _refuse_units(nominal: np.ndarray, series: Series, triples: np.ndarray) -> None:
    """Compares distances: the median bears many wrong ids."""
    first, second = triples[:, 0], triples[:, 1]
    theirs = np.linalg.norm(series.xyz_mm[first] - series.xyz_mm[second], axis=1)
    ratio = float(np.median(theirs / np.linalg.norm(nominal[first] - nominal[second], axis=1)))
    for unit, scale in UNITS.items():
        if abs(ratio / scale - 1) < UNIT_TOLERANCE:
            raise FrameError(f"series {series.name!r} is in {unit}; convert it, with its errors, to millimetres")
    if not 1 / 2 < ratio < 2:
        raise FrameError(
            f"distances in series {series.name!r} are {ratio:.3g} times those of the frame; check units and ids"
        )


def _consensus(
    nominal: np.ndarray, measured: np.ndarray, triples: np.ndarray, limit: float
) -> tuple[RigidTransform, np.ndarray]:
    """The pose that most balls agree on, and which do."""
    rotation, translation = rigid_fits(measured[triples], nominal[triples])
    at = np.einsum("tij,nj->tni", rotation, measured) + translation[:, None]
    count = ((at - nominal) ** 2).sum(axis=2) < limit**2
    agrees = count[np.argmax(count.sum(axis=1))]
    pose = rigid_fit(measured[agrees], nominal[agrees])
    for _ in range(3):  # the first three balls' own errors reach far; more balls come in as the pose settles
        agrees = np.linalg.norm(pose.apply(measured) - nominal, axis=1) < limit
        if agrees.sum() < 3:
            break
        pose = rigid_fit(measured[agrees], nominal[agrees])
    return pose, agrees


def _strays(
    ids: tuple[str, ...], at_mm: np.ndarray, place: dict[str, np.ndarray], agrees: np.ndarray, limit: float
) -> tuple[dict[str, str], dict[str, float]]:
    """What the balls that do not agree were: others, or none."""
    taken = {i for i, right in zip(ids, agrees, strict=True) if right}
    free = [i for i in place if i not in taken]
    lost = np.flatnonzero(~agrees)
    renamed: dict[str, str] = {}
    astray: dict[str, float] = {}
    if not len(lost):
        return renamed, astray
    distance = cdist(at_mm[lost], np.array([place[i] for i in free]))
    fits = dict(zip(*linear_sum_assignment(np.minimum(distance, 2 * limit)), strict=True))
    for row, ball in enumerate(lost):
        other = fits.get(row)
        if other is not None and distance[row, other] < limit:
            renamed[ids[ball]] = free[other]
        else:
            astray[ids[ball]] = float(np.linalg.norm(at_mm[ball] - place[ids[ball]]))
    return renamed, astray
