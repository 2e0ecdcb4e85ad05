"""Motion within an exposure: it softens the rims of all spots along one direction, and of none across it."""

from dataclasses import dataclass

import cv2
import numpy as np

from sightline.imaging import Radiograph

_FEWEST = 5  # spots that tell a direction [ours]
_MOST = 400  # spots that are looked at [ours]
_INSIDE, _RIM_PX = 1.6, 4.0  # times the radius, and beyond: a smeared rim lies within [ours]
_RING = 1.5  # times that: what lies in between is background
_OWN = 0.5  # of the squared gradients inside must be the spot's own [ours]
# Refused images with motion of 2-12 px, or of two exposures, have 0.09 and more; those refused for another reason 0.06
# and less [twin: `campaigns/images.py`, two seeds].
DIRECTED = 0.075


@dataclass(frozen=True)
class Smear:
    """`directed`: how much of the squared gradients about the spots has one direction in common, 0 to 1; `angle_deg`:
    of the motion, clockwise from the rows, 0 to 180."""

    directed: float
    angle_deg: float


def smear(image: Radiograph, beads: np.ndarray, others: np.ndarray) -> Smear | None:
    """Whether an image is smeared by motion, from its beads and its other spots, (N, 3): u, v and radius, px.

    Beads, where there are enough, must show it as well as all spots together do: stripes and edges that are taken for
    spots have directions too.
    """
    gradients = _gradients(image)
    of_beads, of_others = (_directions(gradients, spots) for spots in (beads, others))
    every = np.concatenate([of_beads, of_others])
    sets = [every, of_beads] if len(of_beads) >= _FEWEST else [every]
    if len(every) < _FEWEST:
        return None
    common = [np.median(one, axis=0) for one in sets]
    weakest = min(common, key=lambda one: float(np.hypot(*one)))
    directed = float(np.hypot(*weakest))
    if directed < DIRECTED:
        return None
    strongest_deg = np.rad2deg(np.arctan2(weakest[1], weakest[0])) / 2
    return Smear(directed, float((strongest_deg + 90.0) % 180.0))


def _gradients(image: Radiograph) -> np.ndarray:
    """(3, H, W): gu² - gv², 2 gu gv and gu² + gv² of the log intensity, of which scatter and exposure are no part."""
    logs = np.log(np.maximum(image.pixels.astype(np.float32) / np.float32(image.white), 1e-4))
    logs = cv2.GaussianBlur(logs, (0, 0), 1.0)
    gu, gv = (cv2.Sobel(logs, cv2.CV_32F, du, 1 - du, ksize=3) for du in (1, 0))
    return np.stack([gu * gu - gv * gv, 2 * gu * gv, gu * gu + gv * gv])


def _directions(gradients: np.ndarray, spots: np.ndarray) -> np.ndarray:
    """(M, 2): of the spots well inside the image, the direction of their gradients at twice its angle, as a vector of
    length 0 (none) to 1 (all); without what the background about each has."""
    height, width = gradients.shape[1:]
    out = []
    for u, v, radius in spots[:: 1 + len(spots) // _MOST]:
        inner = _INSIDE * radius + _RIM_PX
        reach = int(np.ceil(_RING * inner))
        u0, v0 = round(u), round(v)
        if not (reach <= u0 < width - reach and reach <= v0 < height - reach):
            continue
        about = gradients[:, v0 - reach : v0 + reach + 1, u0 - reach : u0 + reach + 1]
        apart = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1])
        inside = about[:, apart <= inner].mean(axis=1)
        own = inside - about[:, (apart > inner) & (apart <= reach)].mean(axis=1)
        if own[2] > _OWN * inside[2]:
            out.append(own[:2] / own[2])
    return np.array(out, dtype=np.float64).reshape(-1, 2)
