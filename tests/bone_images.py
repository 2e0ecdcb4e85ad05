"""Images of round bones as views whose geometry is known show them, drawn from the chords of lines of sight."""

from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter

from sightline.imaging import Radiograph
from sightline.planning.bone.drawings import Axis

SIZE = 1024


@cache
def rays(view) -> np.ndarray:
    """Directions (H, W, 3) of lines of sight, one for 2 x 2 pixels."""
    at = np.arange(0, SIZE, 2.0) + 0.5  # the middle of 2 x 2 pixels
    uv = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    ray = view.plane.to_space(view.to_plane(uv)) - view.focal_point_mm
    return (ray / np.linalg.norm(ray, axis=1, keepdims=True)).reshape(SIZE // 2, SIZE // 2, 3)


def shown(bone: np.ndarray, seed: int) -> Radiograph:
    """The image of attenuations, one for 2 x 2 pixels, with blur and noise."""
    light = gaussian_filter(np.kron(20000 * np.exp(-bone), np.ones((2, 2))), 1.5)
    noise = 60.0 * np.random.default_rng(seed).standard_normal(light.shape)
    return Radiograph(np.rint(np.clip(light + noise, 1, 60000)).astype(np.uint16), 65535.0)


def with_cortex(beside_mm: np.ndarray, radius_mm: float | np.ndarray, cortex_mm: float = 1.2) -> np.ndarray:
    """Attenuation of a round bone with a cortex, for rays at distances from its middle."""
    return 0.02 * (_chord(beside_mm, radius_mm) - 0.7 * _chord(beside_mm, radius_mm - cortex_mm))


def _chord(beside_mm: np.ndarray, radius_mm: float | np.ndarray) -> np.ndarray:
    return 2 * np.sqrt(np.clip(radius_mm**2 - beside_mm**2, 0.0, None))


def wrong(axis: Axis, on_mm: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (4,) across an axis of both its ends, mm, of a true axis through a point; and their stated covariance."""
    assert axis.covariance_mm2 is not None
    by_end = np.kron(np.eye(2), np.linalg.svd(axis.direction[None])[2][1:])
    true = on_mm + ((axis.ends_mm - on_mm) @ along)[:, None] * along
    return by_end @ (axis.ends_mm - true).ravel(), by_end @ axis.covariance_mm2 @ by_end.T
