"""The wire inside the neck of the femur, whose borders are drawn in two images."""

import numpy as np

from sightline.errors import ReconstructionRefusedError
from sightline.planning.directions import unit

Borders = tuple[np.ndarray, np.ndarray]
_MIN_SINE = 0.5  # of the angle between the two views of the neck, seen along it [ours]
_STATIONS = 5  # along the drawn part of the neck, whose borders are straight [ours]


def wire_in_neck(entry: np.ndarray, tip: np.ndarray, views: tuple[Borders, Borders]) -> np.ndarray:
    """Return the least distances (K,), mm, of wires from the surface of the neck, between the ends of its borders.

    `entry`, `tip` (K, 3); `views`: focal points (K, 3) and borders (K, 2, 2, 3) of both, two points of each border on
    the view's plate. Negative outside the neck. Raises ReconstructionRefusedError.

    A border is a plane through the focal point; the planes midway between two borders of a view meet in the neck's
    axis. Its section is the ellipse nearest to a circle that touches the four planes: its squared half-width in the
    direction n is n M n. A point at the share s of the way to an ellipse lies (1 - s) times its shorter semi-axis or
    more from it.
    """
    drawn = [(focal, _one_way(lines)) for focal, lines in views]
    inward = [_inward(focal, lines) for focal, lines in drawn]
    one, other = (unit(normals[:, 0] - normals[:, 1]) for normals in inward)
    sine = np.linalg.norm(np.cross(one, other), axis=-1)[:, None]
    if sine[0, 0] < _MIN_SINE:
        raise ReconstructionRefusedError(
            "both images show the neck from nearly the same side; rotate the C-arm for one"
        )
    axes = np.stack([one, other, np.cross(one, other) / sine], axis=1)
    on = np.stack([drawn[0][0], drawn[1][0], entry], axis=1)
    middle = np.linalg.solve(axes, (axes * on).sum(axis=-1)[..., None])[..., 0]
    way = axes[:, 2]
    ends = [_ends(focal, lines, middle, way) for focal, lines in drawn]
    wire = np.stack([((point - middle) * way).sum(axis=-1) for point in (entry, tip)], axis=1)
    first, last = _common([*ends, wire])
    along = first + np.linspace(0.0, 1.0, _STATIONS) * (last - first)
    axis = middle[:, None] + along[..., None] * way[:, None]
    share = (along - wire[:, :1]) / (wire[:, 1:] - wire[:, :1])
    beside = entry[:, None] + share[..., None] * (tip - entry)[:, None] - axis
    half = [((axis - f[:, None]) * n[:, :1]).sum(axis=-1) for (f, _), n in zip(drawn, inward, strict=True)]
    x, y = ((beside * n[:, None]).sum(axis=-1) for n in (one, other))
    return _from_ellipse((x, y), (half[0], half[1]), (one * other).sum(axis=-1)[:, None])


def _one_way(lines: np.ndarray) -> np.ndarray:
    """Return borders whose points run the same way."""
    way = np.diff(lines[0], axis=1)[:, 0]
    return lines if way[0] @ way[1] > 0.0 else np.stack([lines[:, 0], lines[:, 1, ::-1]], axis=1)


def _inward(focal: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Return the unit normals (K, 2, 3) of the planes of a view's borders, each towards the other border."""
    normal = unit(np.cross(lines[:, :, 0] - focal[:, None], lines[:, :, 1] - focal[:, None]))
    other = lines[:, ::-1].mean(axis=2) - focal[:, None]
    return normal * np.sign((normal * other).sum(axis=-1))[..., None]


def _ends(focal: np.ndarray, lines: np.ndarray, middle: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Return where an axis crosses the planes through a focal point and both borders' ends, (K, 2) mm along it."""
    normal = np.cross(lines[:, 0] - focal[:, None], lines[:, 1] - focal[:, None])
    return (normal * (focal - middle)[:, None]).sum(axis=-1) / (normal * way[:, None]).sum(axis=-1)


def _common(sections: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return first and last place (K, 1) of the common part of sections (K, 2) of an axis."""
    first = np.max([one.min(axis=1) for one in sections], axis=0)[:, None]
    last = np.min([one.max(axis=1) for one in sections], axis=0)[:, None]
    if first[0, 0] >= last[0, 0]:
        raise ReconstructionRefusedError(
            "the borders of the neck in both images and the wire have no common part; draw them at the same place"
        )
    return first, last


def _from_ellipse(
    beside: tuple[np.ndarray, np.ndarray], half: tuple[np.ndarray, np.ndarray], cosine: np.ndarray
) -> np.ndarray:
    """Return the least distance (K,) of points from ellipses: how far they lie `beside` the middle (K, S) and the
    `half` widths (K, S) in two directions, with the `cosine` (K, 1) of the angle between these."""
    sine = np.sqrt(1.0 - cosine**2)
    (x, other), (a, b) = beside, half
    mean, part = (a**2 + b**2) / 2, (a**2 - b**2) / 2
    shortest2 = mean - np.abs(part) / sine
    if shortest2[0].min() <= 0.0:
        raise ReconstructionRefusedError("the borders of the neck in both images do not fit one neck; draw them again")
    y, cross = (other - x * cosine) / sine, -part * cosine / sine
    share2 = ((mean - part) * x**2 - 2 * cross * x * y + (mean + part) * y**2) / (mean**2 - (part / sine) ** 2)
    return (np.sqrt(shortest2) * (1.0 - np.sqrt(share2))).min(axis=1)
