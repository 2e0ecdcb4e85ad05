"""A person's eye: where on the screen an X-ray image is shown, found by what the screenshot shows, not by the page."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import affine_transform, zoom
from scipy.optimize import minimize
from scipy.signal import fftconvolve

COARSE = 8  # pixels of the screen in one of the first search
SCALES = np.arange(0.2, 1.0, 0.02)  # screen pixels of an image's pixel
ALIKE = 0.8  # of the shown picture and the image, a correlation; marks and a window of grey values lower it


@dataclass(frozen=True, eq=False)
class Shown:
    """An image of `size` px on the screen: turned by `quarters` of a circle after mirroring, `scale` screen pixels for
    one of its own, its middle at `middle` (x, y). `alike`: correlation of picture and image."""

    size: int
    mirrored: bool
    quarters: int
    scale: float
    middle: np.ndarray
    alike: float

    def at(self, uv: tuple[float, float]) -> tuple[float, float]:
        """Return where a pixel is on the screen."""
        off = np.array(uv) - (self.size - 1) / 2
        x, y = self.middle + self.scale * (self._turn @ off)
        return float(x), float(y)

    @property
    def _turn(self) -> np.ndarray:
        """The matrix (2, 2) of mirroring and turning, (x, y)."""
        quarter = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), self.quarters)
        return quarter @ np.diag([-1 if self.mirrored else 1, 1])

    def drawn(self, image: np.ndarray, size: tuple[int, int], pixel: int) -> np.ndarray:
        """Return the image as it would be shown on a screen of (height, width) `size`, on every `pixel`-th pixel; NaN
        beside it."""
        back = self._turn.T / self.scale  # screen to image, (x, y)
        start = np.array([(pixel - 1) / 2] * 2) - self.middle
        offset = (back @ start + (self.size - 1) / 2)[::-1]
        shape = (size[0] // pixel, size[1] // pixel)
        return affine_transform(image, back[::-1, ::-1] * pixel, offset, shape, order=1, cval=np.nan)


def find(image: np.ndarray, screen: np.ndarray) -> Shown:
    """Return where on a screenshot (H, W), grey, a square image is shown. Fails if nothing there is like it."""
    best = max(_coarse(image.astype(np.float64), screen.astype(np.float64)), key=lambda one: one.alike)
    for pixel in (4, 1):
        best = _refined(best, image.astype(np.float64), screen.astype(np.float64), pixel)
    assert best.alike > ALIKE, f"no picture on the screen is like this image: {best.alike:.2f}"
    return best


def _coarse(image: np.ndarray, screen: np.ndarray) -> Iterator[Shown]:
    """Yield the best place for each orientation and scale, on a screen of larger pixels."""
    seen = _reduced(screen, COARSE)
    for scale in SCALES:
        small = zoom(_reduced(image, 4), 4 * scale / COARSE, order=1)
        if min(np.subtract(seen.shape, small.shape)) < 0:
            continue
        for mirrored in (False, True):
            for quarters in range(4):
                turned = np.rot90(small[:, ::-1] if mirrored else small, -quarters)
                alike = _correlation(seen, turned)
                top = np.unravel_index(np.argmax(alike), alike.shape)
                middle = (np.array(top[::-1]) + np.array(turned.shape[::-1]) / 2) * COARSE - 0.5
                yield Shown(len(image), mirrored, quarters, float(scale), middle, float(alike[top]))


def _refined(start: Shown, image: np.ndarray, screen: np.ndarray, pixel: int) -> Shown:
    seen = _reduced(screen, pixel)

    def made(x: np.ndarray) -> Shown:
        return replace(start, scale=start.scale * np.exp(x[2]), middle=start.middle + x[:2])

    def unlike(x: np.ndarray) -> float:
        drawn = made(x).drawn(image, screen.shape, pixel)
        both = np.isfinite(drawn)
        return -float(np.corrcoef(drawn[both], seen[: drawn.shape[0], : drawn.shape[1]][both])[0, 1])

    step = np.array([pixel, pixel, pixel / 256.0])
    simplex = np.vstack([np.zeros(3), np.diag(step)])
    found = minimize(unlike, np.zeros(3), method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 0.02})
    return replace(made(found.x), alike=-float(found.fun))


def _reduced(image: np.ndarray, by: int) -> np.ndarray:
    """Return means of squares of pixels."""
    height, width = (n // by for n in image.shape)
    return image[: height * by, : width * by].reshape(height, by, width, by).mean(axis=(1, 3))


def _correlation(screen: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the correlation of a part with the screen below it, for each place at which it is wholly on the screen."""
    off = part - part.mean()
    ones = np.ones_like(part)
    mean = fftconvolve(screen, ones, mode="valid") / part.size
    spread = fftconvolve(screen**2, ones, mode="valid") / part.size - mean**2
    common = fftconvolve(screen, off[::-1, ::-1], mode="valid") / part.size
    return common / np.sqrt(np.maximum(spread, 1.0) * off.var())
