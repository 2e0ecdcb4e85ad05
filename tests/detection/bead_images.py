"""Images of beads with known truth: ideal shadows, Poisson counts, then the detector's blur."""

from dataclasses import dataclass

import cv2
import numpy as np

from sightline.imaging import Radiograph

_OVER = 8  # samples per pixel and axis
BLUR_PX = 0.9


@dataclass(frozen=True)
class Bead:
    """A bead. `depth`: attenuation along a ball's diameter, or of a disc; negative for a hole. `inner`: of a washer."""

    u: float
    v: float
    radius: float
    depth: float = 3.0
    ball: bool = True
    inner: float = 0.0


def transmission(bead: Bead, shape: tuple[int, int]) -> np.ndarray:
    """Return the transmission (H, W) of the bead, averaged over each pixel."""
    out = np.ones(shape)
    reach = int(bead.radius) + 2
    left, top = int(bead.u) - reach, int(bead.v) - reach
    n = 2 * reach + 1
    fine = (np.arange(n * _OVER) + 0.5) / _OVER - 0.5
    r2 = ((fine[None, :] + left - bead.u) ** 2 + (fine[:, None] + top - bead.v) ** 2) / bead.radius**2
    path = np.sqrt(np.clip(1 - r2, 0, None)) if bead.ball else ((r2 < 1) & (r2 >= (bead.inner / bead.radius) ** 2))
    patch = np.exp(-bead.depth * path).reshape(n, _OVER, n, _OVER).mean(axis=(1, 3))
    y0, y1, x0, x1 = max(top, 0), min(top + n, shape[0]), max(left, 0), min(left + n, shape[1])
    out[y0:y1, x0:x1] = patch[y0 - top : y1 - top, x0 - left : x1 - left]
    return out


def quanta(beads: list[Bead], open_quanta: np.ndarray, scatter: float | np.ndarray = 0.4) -> np.ndarray:
    """Expected counts per pixel: primary behind the beads, and scatter that they do not stop: a share of the open
    quanta, or counts (H, W)."""
    primary = open_quanta.copy()
    for bead in beads:
        primary *= transmission(bead, open_quanta.shape)
    return primary + (scatter if isinstance(scatter, np.ndarray) else scatter * open_quanta)


def radiograph(
    expected: np.ndarray, rng: np.random.Generator | None, white: int = 4095, level: float = 0.6
) -> Radiograph:
    """Return a 12-bit image of the expected counts; without `rng`, no noise and no digitisation."""
    gain = level * white / float(np.median(expected))
    counts = expected if rng is None else rng.poisson(expected).astype(float)
    image = cv2.GaussianBlur(counts, (0, 0), BLUR_PX, borderType=cv2.BORDER_REFLECT) * gain
    if rng is None:
        return Radiograph(np.clip(image, 0, white).astype(np.float32), white)
    return Radiograph(np.clip(np.rint(image), 0, white).astype(np.uint16), white)


def grid(spacing: float, size: int, rng: np.random.Generator) -> np.ndarray:
    """Return places (N, 2) on a grid, each with its own sub-pixel phase."""
    ticks = np.arange(spacing, size - spacing / 2, spacing)
    return np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2) + rng.uniform(-0.5, 0.5, (len(ticks) ** 2, 2))


def normalised(error_px: np.ndarray, covariance_px2: np.ndarray) -> np.ndarray:
    """Return half the squared normalised errors (N,): their mean is 1 where the stated covariance is right."""
    return np.einsum("ni,nij,nj->n", error_px, np.linalg.inv(covariance_px2), error_px) / 2
