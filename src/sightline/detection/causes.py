"""Find why an image shows too few beads, from its pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np

from sightline.detection.common_shape import common_shape, logs_of_white
from sightline.detection.results import RejectedCandidate
from sightline.imaging import Radiograph
from sightline.imaging.defects import MAX_CLIPPED, clipped_share, torn


class SpotFault(StrEnum):
    """Reasons of rejected candidates by which the cause is found; they are saved as these texts."""

    NO_RIM = "no rim: it fades out like anatomy, not like a bead"
    NO_DISC = "no disc at this place: the fit moved away"
    TOO_SMALL = "its radius is below 2 px"


# Radius of beads that are hard to fit: half of the promised ones above 2 px are lost in compression [ours].
_FEW_PX = 3.0
# Spots for a statement about the image, or for a direction of motion, which fewer show by chance; and at most, which
# take a second [ours].
_MIN_SPOTS, _MAX_SPOTS = 5, 400
# A smeared rim lies within so many radii plus so many px; outside are other beads [ours].
_INSIDE, _RIM_PX = 1.6, 4.0
_RING = 1.5  # outer over inner radius of the background ring
# Smallest share of the squared gradients that is not of the background: with less, they show an edge's direction
# [ours].
_OWN = 0.5
# Refused images with motion of 2-12 px, or with two exposures, have 0.09 and more; images refused for another reason
# have 0.06 and less [twin: `campaigns/images.py`, two seeds].
DIRECTED = 0.075
# Spread of the aspects of spots that are all balls; other spots have 0.03 and more [gVirtualXray].
_ALL_ROUND = 0.02
# Of the spots, what a common direction needs: share within 60° of it, and its size in standard errors. Smeared beads
# have 0.74 and 8 and more, textures and edges of other images 0.53 and 2 and less [gVirtualXray, 20 images of files].
_ALIGNED, _CERTAIN = 0.65, 5.0


def cause_of(image: Radiograph, beads: np.ndarray, rejected: Sequence[RejectedCandidate]) -> str | None:
    """Return what is wrong with an image in which few beads were found, and what to do; None where it is not clear.

    `beads` (N, 3): u, v and radius, px.
    """
    share = 100 * clipped_share(image)
    if share > MAX_CLIPPED:
        return (
            f"the image is saturated: {share:.0f} % of its field is clipped; expose less, or export it without a window"
        )
    others = np.array([(*candidate.uv_px, candidate.radius_px) for candidate in rejected]).reshape(-1, 3)
    spots = np.concatenate([beads, others])
    shape = common_shape(image, spots[:, :2], spots[:, 2])
    shaped = _too_small(beads, rejected) or (None if shape is None else shape.not_square)
    if shaped is not None:
        return shaped
    moved = smear(image, beads, others)
    if moved is not None:
        return (
            f"the image is smeared by movement at about {moved.angle_deg:.0f}° to its rows: rims are softer there than "
            f"across ({moved.directed:.2f}, at most {DIRECTED:g}); hold still, and take it again in a single exposure"
        )
    # After the check for movement, since smeared lines match each other once shifted.
    tear = torn(image)
    if tear is not None:
        return tear.sentence
    all_round = shape is not None and shape.aspect_spread < _ALL_ROUND
    soft = sum(
        candidate.reason == SpotFault.NO_RIM or (all_round and candidate.reason == SpotFault.NO_DISC)
        for candidate in rejected
    )
    if soft >= max(_MIN_SPOTS, len(beads) / 2):
        return f"the image is blurred: {soft} spots fade out without a rim, {len(beads)} have one; focus, or hold still"
    return None


def _too_small(beads: np.ndarray, rejected: Sequence[RejectedCandidate]) -> str | None:
    small = np.count_nonzero(beads[:, 2] < _FEW_PX) + sum(
        candidate.reason == SpotFault.TOO_SMALL for candidate in rejected
    )
    if small < max(_MIN_SPOTS, (len(beads) + len(rejected)) / 3):
        return None
    return (
        f"the image has too few pixels: the radius of {small} beads is below {_FEW_PX:g} px; export it in full size, "
        "or show a smaller field"
    )


@dataclass(frozen=True)
class Smear:
    """Motion blur of an image.

    `directed`: share of the squared gradients around the spots that has one common direction, 0 to 1. `angle_deg`:
    direction of the motion, clockwise from the rows, 0 to 180.
    """

    directed: float
    angle_deg: float


def smear(image: Radiograph, beads: np.ndarray, others: np.ndarray) -> Smear | None:
    """Return the motion blur of an image, from its beads and other spots (N, 3): u, v and radius, px; None without any.

    Where there are enough beads, they must show it too: stripes and edges among the other spots also have directions.
    """
    gradients = _gradients(image)
    of_beads, of_others = (_directions(gradients, spots) for spots in (beads, others))
    every = np.concatenate([of_beads, of_others])
    sets = [every, of_beads] if len(of_beads) >= _MIN_SPOTS else [every]
    if len(every) < _MIN_SPOTS:
        return None
    common = [np.median(vectors, axis=0) for vectors in sets]
    weakest = min(common, key=lambda vector: float(np.hypot(*vector)))
    directed = float(np.hypot(*weakest))
    if directed < DIRECTED or not _agree(every, common[0]):
        return None
    strongest_deg = np.rad2deg(np.arctan2(weakest[1], weakest[0])) / 2
    return Smear(directed, float((strongest_deg + 90.0) % 180.0))


def _agree(vectors: np.ndarray, median: np.ndarray) -> bool:
    """Return whether vectors (N, 2) have their median (2,) in common: most point its way, and it is certain."""
    size, sizes = np.hypot(*median), np.hypot(*vectors.T)
    error = 1.86 * np.median(np.hypot(*(vectors - median).T)) / np.sqrt(len(vectors))  # of a median [calc]
    return bool(np.mean(vectors @ median > 0.5 * size * sizes) > _ALIGNED and size > _CERTAIN * error)


def _gradients(image: Radiograph) -> np.ndarray:
    """Return gu² - gv², 2 gu gv and gu² + gv² (3, H, W) of the log intensity, so that the exposure cancels."""
    logs = logs_of_white(image)
    logs = cv2.GaussianBlur(logs, (0, 0), 1.0)
    gu, gv = (cv2.Sobel(logs, cv2.CV_32F, du, 1 - du, ksize=3) for du in (1, 0))
    return np.stack([gu * gu - gv * gv, 2 * gu * gv, gu * gu + gv * gv])


def _directions(gradients: np.ndarray, spots: np.ndarray) -> np.ndarray:
    """Return the common gradient direction (M, 2) of each spot well inside the image, without its background's.

    Vectors at twice the angle; their length is 0 (no common direction) to 1 (all gradients).
    """
    height, width = gradients.shape[1:]
    directions = []
    for u, v, radius in spots[:: 1 + len(spots) // _MAX_SPOTS]:
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
            directions.append(own[:2] / own[2])
    return np.array(directions, dtype=np.float64).reshape(-1, 2)
