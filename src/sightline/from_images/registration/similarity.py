"""The difference of two images after local normalisation, and its derivatives: blind to slow changes of brightness."""

from dataclasses import dataclass

import cv2
import numpy as np

WINDOW = 9  # pooled pixels along a side [ours]: of 5 to 17 the least bias beside overlapping bone


def box(values: np.ndarray) -> np.ndarray:
    """Return sums over windows, (H, W) or (H, W, K)."""
    return cv2.boxFilter(values, -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT)


def block_sums(values: np.ndarray, side: int) -> np.ndarray:
    """Return the sums (N, K) of (H, W, K) over blocks of `side` x `side` pixels."""
    for axis in (0, 1):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], side), axis=axis)
    return values.reshape(-1, values.shape[2])


@dataclass(frozen=True, eq=False)
class Normalised:
    """An image (H, W) less its local mean, over its local standard deviation and a floor."""

    values: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    scale: np.ndarray
    weight: np.ndarray
    area: np.ndarray
    image: np.ndarray

    @staticmethod
    def of(image: np.ndarray, weight: np.ndarray, floor: float) -> "Normalised":
        """Normalise an image with weights (H, W), float64."""
        area = np.maximum(box(weight), 1e-6)
        mean = box(weight * image) / area
        variance = np.maximum(box(weight * image**2) / area - mean**2, 0.0)
        scale = np.sqrt(variance + floor**2)
        return Normalised((image - mean) / scale, mean, variance, scale, weight, area, image)

    def derivatives(self, by: np.ndarray) -> np.ndarray:
        """Return the derivatives (H, W, K) of `values` for derivatives (H, W, K) of the image."""
        w, area = self.weight[:, :, None], self.area[:, :, None]
        of_mean = box(w * by) / area
        of_square = box(w * self.image[:, :, None] * by) / area
        of_scale = (of_square - self.mean[:, :, None] * of_mean) / self.scale[:, :, None]
        return (by - of_mean - self.values[:, :, None] * of_scale) / self.scale[:, :, None]
