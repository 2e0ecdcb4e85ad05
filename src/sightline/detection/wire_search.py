"""Coarse search for a wire: a dark line with lighter sides, in an image resampled along a path."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter1d

from sightline.detection.wire_model import BEND, ImagePath
from sightline.errors import WireRefusedError

# To either side of where the wire is expected, and the largest rotation against it [ours]: farther off is another
# wire, and a wider corridor has more bone edges.
CORRIDOR_MM, CORRIDOR_RAD = 8.0, np.radians(5.0)
_ROTATIONS = 21  # tried within the corridor
_ALONG = 9  # px averaged along the path before sides are compared
_SIDE = 1.7  # radii from the middle to where the sides are sampled
_MIN_CONTRAST = 0.2  # log light: cortices seen along their length have 0.1-0.15, wires 0.4 and more [twin]
_MIN_LENGTH = 6.0  # [ours] visible length, in radii: of shorter ones, beads and edges are taken for wires
# Another line is a rival from this share of the best line's summed darkness, and where it lies apart by so many radii,
# median along both [ours]: nearer, both are the rims of one wire.
_RIVAL, _APART = 0.6, 3.0
_SURE = 0.5  # of the rms distance of lines to plans in any other assignment: a lone line is in the nearer third [ours]
_REWEIGHTED, _MIN_RESIDUAL_PX = 10, 0.5  # [ours] reweighted fits; smaller residuals, of pixels, get the same weight
_BRIDGED = 0.3  # share of the usual darkness that marks the end of a wire; under dense bone it is 0.5 [twin]


@dataclass(frozen=True, eq=False)
class CoarseWire:
    """A coarse wire: its path to beyond the tip, and the tip's s on it and on the expected path, px.

    `others`: points (M, 2) of the other wires seen beside it.
    """

    path: ImagePath
    tip_s_px: float
    expected_tip_s_px: float
    others: tuple[np.ndarray, ...]


def search(  # noqa: PLR0917
    logs: np.ndarray,
    usable: np.ndarray,
    path: ImagePath,
    radius_px: np.ndarray,
    px_per_mm: np.ndarray,
    others_uv_px: Sequence[np.ndarray] = (),
    corridor_mm: float = CORRIDOR_MM,
) -> CoarseWire:
    """Return the one dark line of about the radius (M,) within the corridor about `path`.

    `others_uv_px`: points (M, 2) where other wires are planned, which may be in the image too. Raises WireRefusedError.
    """
    corridor = corridor_mm * float(np.median(px_per_mm))
    radius = float(np.median(radius_px))
    length = path.s_px[-1]
    reach = int(corridor + 0.5 * length * np.tan(CORRIDOR_RAD) + 3 * radius)
    s, x = np.arange(int(length) + 1.0), np.arange(-reach, reach + 1.0)
    dark, known = _darkness(logs, usable, path, s, x, radius)
    offsets, slopes = np.arange(-corridor, corridor + 1.0), np.tan(CORRIDOR_RAD) * np.linspace(-1, 1, _ROTATIONS)
    lever = s - length / 2
    sums = np.empty((len(slopes), len(offsets)))
    capped = np.where(known, np.clip(dark, 0.0, 2 * _MIN_CONTRAST), 0.0)
    for k, slope in enumerate(slopes):
        rows = np.rint(offsets[:, None] + slope * lever + reach).astype(int)
        sums[k] = capped[rows, np.arange(len(s))].sum(axis=1)
    best = np.unravel_index(int(sums.argmax()), sums.shape)
    if sums[best] < _MIN_CONTRAST * _MIN_LENGTH * radius:
        raise WireRefusedError(
            f"no wire is seen within {corridor_mm:.0f} mm and {np.degrees(CORRIDOR_RAD):.0f}° of where it is planned; "
            "check that the image belongs to this plan, that the wire is in, and the exposure"
        )
    lines, shares = _dark_lines(sums, offsets, slopes, lever, radius)
    plans = _across(path, others_uv_px, s)
    own = _own(lines, shares, plans, radius, float(np.median(px_per_mm)))
    across = _followed(dark, known, lines[own], reach, radius)
    tip = _end(dark, known, across, reach, radius)
    kept = slice(None, min(int(tip + 12 * radius), len(s)))
    centre = _smooth(s, across, tip, radius)
    on, _, normal = path.at(s)
    followed = ImagePath.through((on + centre[:, None] * normal)[kept])
    others = []
    for line in (_followed(dark, known, line, reach, radius) for line in lines[:own] + lines[own + 1 :]):
        until = int(_gain(dark, known, line, reach)[0].argmax()) + 1
        others.append((on + line[:, None] * normal)[:until])
    return CoarseWire(followed, float(followed.s_px[int(tip)]), tip, tuple(others))


def _darkness(  # noqa: PLR0917
    logs: np.ndarray, usable: np.ndarray, path: ImagePath, s: np.ndarray, x: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return how much darker (X, S) the log image is than its darker side, and where that is known."""
    on, _, normal = path.at(s)
    where = (on[None] + x[:, None, None] * normal[None]).astype(np.float32)
    straight = cv2.remap(logs, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    seen = cv2.remap(usable.astype(np.float32), where[..., 0], where[..., 1], cv2.INTER_NEAREST)
    middle = _mean(straight, seen, int(1.2 * radius))
    side, shift = _mean(straight, seen, int(0.6 * radius)), round(_SIDE * radius)
    left, right = np.roll(side[0], shift, axis=0), np.roll(side[0], -shift, axis=0)
    known = (middle[1] > 0.3) & (np.roll(side[1], shift, axis=0) > 0.3) & (np.roll(side[1], -shift, axis=0) > 0.3)
    known[:shift] = known[-shift:] = False
    return np.minimum(left, right) - middle[0], known


def _mean(values: np.ndarray, weight: np.ndarray, across: int) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted means over `across` x _ALONG pixels, and the mean weights."""
    size = max(across, 1), _ALONG
    share, total = (
        uniform_filter1d(uniform_filter1d(a, size[0], axis=0), size[1], axis=1) for a in (weight, values * weight)
    )
    return total / np.maximum(share, 1e-3), share


def _dark_lines(
    sums: np.ndarray, offsets: np.ndarray, slopes: np.ndarray, lever: np.ndarray, radius: float
) -> tuple[list[np.ndarray], list[float]]:
    """Return the offsets (S,) of the darkest line and of those nearly as dark beside it, and their shares of its sum.

    Beside it: over most of the length.
    """
    steps, lines, shares = lever[::20], [], []
    free = np.ones(sums.shape, dtype=bool)
    while free.any():
        line = np.unravel_index(int(np.where(free, sums, -1.0).argmax()), sums.shape)
        share = float(sums[line]) / float(sums.max())
        if share <= _RIVAL:
            break
        lines.append(offsets[line[1]] + slopes[line[0]] * lever)
        shares.append(share)
        apart = (offsets[None] - offsets[line[1]])[..., None] + (slopes - slopes[line[0]])[:, None, None] * steps
        free &= np.median(np.abs(apart), axis=-1) > _APART * radius
    return lines, shares


def _across(path: ImagePath, uv_px: Sequence[np.ndarray], s: np.ndarray) -> list[np.ndarray]:
    """Return the offsets (S,) from the path of straight lines through points (M, 2) each, where they run beside it."""
    offsets = []
    for points in uv_px:
        along, across = path.places(points)
        beside = (along >= 0) & (along <= s[-1])
        if np.count_nonzero(beside) > 1:
            offsets.append(np.polynomial.Polynomial.fit(along[beside], across[beside], 1)(s))
    return offsets


def _own(
    lines: Sequence[np.ndarray], shares: Sequence[float], plans: Sequence[np.ndarray], radius: float, px_per_mm: float
) -> int:
    """Return the number of the line that is the planned wire.

    `plans`: offsets (S,) of the other plans from this one. Every line must be one wire, this or another. Raises
    WireRefusedError where another assignment of lines to wires explains the lines too.
    """
    off = np.array([[np.median(np.abs(line - plan)) for plan in (0.0 * line, *plans)] for line in lines])
    best = np.full(len(lines) + 1, np.inf)  # rms distance, by the line that is the planned wire; the last: none is it
    for wires in permutations(range(off.shape[1]), len(lines)):
        own = wires.index(0) if 0 in wires else -1
        best[own] = min(best[own], float(np.linalg.norm(off[range(len(lines)), wires])))
    own = int(best.argmin())
    if len(lines) == 1 and off[0, 0] < radius:
        return 0
    if own < len(lines) and best[own] < _SURE * np.delete(best, own).min():
        return own
    if len(lines) > 1:
        raise WireRefusedError(
            f"two dark lines compete for the wire (the second has {shares[1]:.0%} of the first's darkness); "
            "take other metal out of the beam, or give a path nearer to the wire"
        )
    raise WireRefusedError(
        f"the line found lies {off[0, 0] / px_per_mm:.1f} mm beside the plan and {off[0, 1:].min() / px_per_mm:.1f} mm "
        "beside that of another wire, so it may be the other; check that the planned wire is in, and take the image "
        "from a direction that shows the wires apart"
    )


def _followed(dark: np.ndarray, known: np.ndarray, at: np.ndarray, reach: int, radius: float) -> np.ndarray:
    """Return x (S,) of the darkest line near a straight one, smoothed with its darkness as weight."""
    x = np.arange(-round(radius), round(radius) + 1)
    rows = np.clip(np.rint(at + reach).astype(int) + x[:, None], 0, len(dark) - 1)
    columns = np.arange(dark.shape[1])
    weight = np.where(known, np.clip(dark, 0.0, None), 0.0)[rows, columns] ** 2
    total = gaussian_filter(np.stack([weight.sum(0), (weight * (rows - reach)).sum(0)]), (0, 3 * radius))
    return np.where(total[0] > 1e-6, total[1] / np.maximum(total[0], 1e-6), at)


def _end(dark: np.ndarray, known: np.ndarray, across: np.ndarray, reach: int, radius: float) -> float:
    """Return s of the tip, up to which the line is dark. Raises WireRefusedError."""
    gain, usual = _gain(dark, known, across, reach)
    tip = int(gain.argmax())
    if usual < _MIN_CONTRAST or gain[tip] < 0.2 * _BRIDGED * usual * tip or tip < _MIN_LENGTH * radius:
        raise WireRefusedError(
            "the wire is too faint or hidden by other metal over most of its length; "
            "take other metal out of the beam, or expose more"
        )
    if tip > len(across) - 4 * radius:
        raise WireRefusedError(
            "the wire does not end where it can be seen: its tip lies outside the field, or far beyond the planned "
            "one; bring the tip into the field"
        )
    return float(tip)


def _gain(dark: np.ndarray, known: np.ndarray, across: np.ndarray, reach: int) -> tuple[np.ndarray, float]:
    """Return the sums (S,) of darkness over what bridges gaps, largest where the line ends, and its usual darkness."""
    rows, columns = np.rint(across + reach).astype(int), np.arange(len(across))
    value, seen = np.clip(dark[rows, columns], 0.0, None), known[rows, columns]
    usual = float(np.quantile(value[seen], 0.75)) if seen.any() else 0.0
    return np.cumsum(np.where(seen, np.minimum(value, usual) - _BRIDGED * usual, 0.0)), usual


def _smooth(s: np.ndarray, across: np.ndarray, tip: float, radius: float) -> np.ndarray:
    """Return the cubic (S,) of least absolute deviations through the line up to its tip, extrapolated straight beyond.

    Structures beside the wire pull the line aside locally. A path with such a bump would hide the deviation from
    `find_wire`.
    """
    inside = s < tip - radius
    curve = np.polynomial.Polynomial.fit(s[inside], across[inside], BEND)
    for _ in range(_REWEIGHTED):
        off = np.maximum(np.abs(across[inside] - curve(s[inside])), _MIN_RESIDUAL_PX)
        curve = np.polynomial.Polynomial.fit(s[inside], across[inside], BEND, w=off**-0.5)
    return curve(np.minimum(s, tip)) + curve.deriv()(tip) * np.maximum(s - tip, 0.0)
