"""Radial profiles of a blurred bead: 1 in the middle of the sharp shape, 0 far outside, as tables for the fit."""

from functools import cache

import numpy as np
from scipy.special import j0

# The shadow of a ball is 1 - exp(-a sqrt(1 - rho^2)): a = mu d = 10.1/cm x 3 mm, 316L steel at 60 keV [physics.md].
_BALL_DEPTH = 3.0
# Distance from the rim in blur sigmas, and blur in radii: the table is smooth in both.
T_FIRST, T_STEP, T_COUNT = -6.0, 0.125, 97
Q_STEP, Q_COUNT = 0.025, 48  # sigma / radius 0.025 ... 1.2


def _sharp(rho: np.ndarray, ball: bool) -> np.ndarray:
    inside = rho < 1
    if not ball:
        return inside.astype(float)
    chord = np.sqrt(np.clip(1 - rho**2, 0, None))
    return np.where(inside, (1 - np.exp(-_BALL_DEPTH * chord)) / (1 - np.exp(-_BALL_DEPTH)), 0.0)


@cache
def profile_table(ball: bool) -> np.ndarray:
    """(Q_COUNT, T_COUNT) profile of a disc (or a ball) of radius 1 blurred by a Gaussian of sigma q.

    Column t is at radius 1 + t q; radii below 0 hold the value at 0. Computed through the Hankel transform.
    """
    q = Q_STEP * (1 + np.arange(Q_COUNT))
    rho, weight = np.polynomial.legendre.leggauss(600)
    angle = (rho + 1) * np.pi / 4  # rho = sin(angle) resolves the square root at the rim
    node, weight = np.sin(angle), weight * np.pi / 4 * np.cos(angle)
    k, k_weight = np.polynomial.legendre.leggauss(600)
    k_max = 6.0 / Q_STEP
    k, k_weight = (k + 1) * k_max / 2, k_weight * k_max / 2
    spectrum = j0(np.outer(k, node)) @ (_sharp(node, ball) * node * weight)
    t = T_FIRST + T_STEP * np.arange(T_COUNT)
    radius = np.clip(1 + np.outer(q, t), 0, None)
    table = np.empty(radius.shape)
    for row, sigma in enumerate(q):
        table[row] = j0(np.outer(radius[row], k)) @ (spectrum * k * k_weight * np.exp(-((k * sigma) ** 2) / 2))
    np.clip(table, 0.0, 1.0, out=table)
    table.flags.writeable = False
    return table
