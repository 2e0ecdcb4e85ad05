"""Advice on how to move the frame before the next exposure, from the labelled beads of one image.

A perspective projection (direct linear transformation) fitted to the detected beads projects all beads of the view into
the image. Distortion is neglected, so results are good to some millimetres, as exact as a frame is moved by hand.
"""

from dataclasses import dataclass

import numpy as np

from sightline.calibration.plates.beads import Beads, match
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, UnusableInputError
from sightline.frame import Frame, FrameView

MIN_BEADS = 8  # the 11 parameters of a projection need six beads; two more for redundancy [calc]
# Moves that are tried [ours]: by steps as small as a hand makes; after a longer one the beam misses the frame's middle.
STEP_MM, MAX_MOVE_MM = 5.0, 100.0
# A bead counts as visible when its centre lies this far inside the image [ours]: its whole disc, which has 5 to 10 px.
MARGIN_PX = 10.0
# Directions along the CFCS axes in words (docs/conventions.md); caudal and cranial depend on the side.
WORDS = {
    (0, 1): "outwards, away from the body (+X)",
    (0, -1): "inwards, towards the body (-X)",
    (1, 1): "along +Y",
    (1, -1): "along -Y",
    (2, 1): "up (+Z)",
    (2, -1): "down (-Z)",
}


@dataclass(frozen=True, eq=False)
class SetupAdvice:
    """Advice for one view.

    `outside`, `outside_after`: share of each plate's beads outside the field, now and after moving the frame by
    `move_mm` (3,), CFCS, which is zero where no move helps or is needed. `sentences`: the advice in words.
    """

    outside: dict[str, float]
    outside_after: dict[str, float]
    move_mm: np.ndarray
    sentences: tuple[str, ...]


def advise(observations: Observations, frame: Frame, field_mask: np.ndarray | None = None) -> SetupAdvice:
    """Return the advice for one view. `field_mask` (H, W) bool: the exposed field; by default the whole image.

    Raises UnusableInputError without both mask and image shape, CalibrationRefusedError with too few beads.
    """
    mask = _mask(observations, field_mask)
    beads = match(observations, frame, None)
    projection = _projection(beads)
    view = frame.view(beads.view)
    names = {"XRII": view.xrii.xyz_mm, "source": view.source.xyz_mm}
    moves = _moves(view)
    shares = np.stack([_outside(projection, xyz + moves[:, None], mask) for xyz in names.values()], axis=1)
    # Fewest beads outside first; among equals the shortest move.
    best = int(np.argmin(np.round(shares.sum(axis=1), 3) + 1e-6 * np.linalg.norm(moves, axis=1)))
    here = int(np.argmin(np.linalg.norm(moves, axis=1)))
    before, after = (dict(zip(names, map(float, shares[k]), strict=True)) for k in (here, best))
    return SetupAdvice(before, after, moves[best], _sentences(beads.view, before, after, moves[best]))


def _mask(observations: Observations, field_mask: np.ndarray | None) -> np.ndarray:
    if field_mask is not None:
        return np.asarray(field_mask, dtype=bool)
    if observations.image_shape is None:
        raise UnusableInputError("the size of the image is unknown; give the field's mask or the image's shape")
    return np.ones(observations.image_shape, dtype=bool)


def _projection(beads: Beads) -> np.ndarray:
    """Return the projection (3, 4) by direct linear transformation in normalised coordinates (Hartley 1997)."""
    if len(beads) < MIN_BEADS:
        raise CalibrationRefusedError(
            f"{len(beads)} beads are seen; advice on the set-up needs {MIN_BEADS}: move the frame into the field"
        )
    to_unit2, to_unit3 = _normaliser(beads.uv_px), _normaliser(beads.xyz_mm)
    u = np.column_stack([beads.uv_px, np.ones(len(beads))]) @ to_unit2.T
    x = np.column_stack([beads.xyz_mm, np.ones(len(beads))]) @ to_unit3.T
    rows = np.zeros((2 * len(beads), 12))
    rows[0::2, :4] = rows[1::2, 4:8] = x
    rows[0::2, 8:], rows[1::2, 8:] = -u[:, :1] * x, -u[:, 1:2] * x
    solution = np.linalg.svd(rows)[2][-1].reshape(3, 4)
    return np.linalg.inv(to_unit2) @ solution @ to_unit3


def _normaliser(points: np.ndarray) -> np.ndarray:
    """Return the homogeneous matrix that moves points to their mean and scales them to unit size."""
    d = points.shape[1]
    matrix = np.eye(d + 1)
    matrix[:d, :d] /= points.std()
    matrix[:d, d] = -points.mean(axis=0) / points.std()
    return matrix


def _moves(view: FrameView) -> np.ndarray:
    """Return (M, 3) shifts of the frame in its XRII plate's plane, along CFCS axes where the plate is aligned."""
    steps = np.arange(-MAX_MOVE_MM, MAX_MOVE_MM + STEP_MM / 2, STEP_MM)
    a, b = np.meshgrid(steps, steps)
    return np.stack([a.ravel(), b.ravel()], axis=1) @ view.xrii.plane.axes


def _outside(projection: np.ndarray, xyz_mm: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return (M,): share of points (M, N, 3) imaged outside the mask or within MARGIN_PX of the image's edge."""
    image = xyz_mm @ projection[:, :3].T + projection[:, 3]
    uv = image[..., :2] / image[..., 2:]
    height, width = mask.shape
    at = np.clip(np.round(uv), 0, np.array([width, height]) - 1).astype(int)
    near = (uv >= MARGIN_PX).all(axis=-1) & (uv <= np.array([width, height]) - 1 - MARGIN_PX).all(axis=-1)
    return 1 - (near & mask[at[..., 1], at[..., 0]]).mean(axis=-1)


def _sentences(view: str, before: dict[str, float], after: dict[str, float], move_mm: np.ndarray) -> tuple[str, ...]:
    if not any(before.values()):
        return (f"{view}: both plates are fully in the field; the frame need not be moved.",)
    lost = " and ".join(f"{share:.0%} of the {name} plate" for name, share in before.items() if share)
    verb = "lies" if "and" not in lost else "lie"
    if not move_mm.any():
        return (f"{view}: {lost} {verb} outside the field, and moving the frame would not help; use a larger field.",)
    ways = [
        f"{abs(mm):.0f} mm {WORDS[axis, int(np.sign(mm))]}" for axis, mm in enumerate(move_mm) if abs(mm) >= STEP_MM / 2
    ]
    rest = " and ".join(f"{share:.0%} of the {name} plate" for name, share in after.items() if share)
    end = f"; {rest} would still lie outside" if rest else "; then both plates lie in the field"
    return (f"{view}: {lost} {verb} outside the field: move the frame " + " and ".join(ways) + end + ".",)
