"""How far the edges of a bone's shadow lie from those in an image: another bone's do not meet, however it lies."""

import numpy as np

from sightline.from_images.registration.align import Differences
from sightline.from_images.registration.similarity import block_sums

_BLOCK_PX = 12  # [ours] a window and its surroundings
_LEAST_INFORMATION = 0.3  # of a direction in a block, 1/px²: less does not tell a shift [ours]


def shifts_px(view: Differences) -> np.ndarray:
    """Return the shifts (N, 2) that would match blocks of the shadow with the image, each in one direction in which the
    block has edges: its length, px, and its information, 1/px²."""
    down, right = np.gradient(view.shadow.values)
    weight, _ = view.loss_by_residual
    products = np.stack(
        [right * right, right * down, down * down, right * view.residual, down * view.residual], axis=-1
    )
    sums = block_sums(weight[:, :, None] * products, _BLOCK_PX)
    information, vectors = np.linalg.eigh(sums[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    pulls = np.einsum("nki,nk->ni", vectors, sums[:, 3:])
    told = information > _LEAST_INFORMATION
    return np.stack([np.abs(pulls[told] / information[told]), information[told]], axis=1)
