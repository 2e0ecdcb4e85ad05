"""Tables of the radial profile of a blurred bead: 1 in the middle of the sharp shape, 0 far outside."""

from functools import cache

import numpy as np
from scipy.special import j0, roots_legendre

# The shadow of a ball is 1 - exp(-a sqrt(1 - rho^2)): a = mu d = 10.1/cm x 3 and 5 mm, 316L steel at 60 keV
# [physics.md]. These are the diameters of the small and the large balls of the built-in frames.
_SMALL_DEPTH, _LARGE_DEPTH = 3.0, 5.0
# The table's axes are the distance from the rim in blur sigmas and the blur in radii; it is smooth in both. Further in
# than the first column it is taken as flat, although the shadow of the largest balls still deepens by 2 %.
T_FIRST, T_STEP, T_COUNT = -30.0, 0.125, 289
Q_STEP, Q_COUNT = 0.0125, 96  # sigma / radius 0.0125 ... 1.2
_NODES = 600  # of the quadratures: eight per period of the fastest wave
_RADII = 1200  # of the transform: 1.3 % apart in their distance from the rim
_AT_ONCE = 100  # rows of Bessel functions held at a time: all of them would take 12 MB


def _sharp(rho: np.ndarray, depth: float) -> np.ndarray:
    chord = np.sqrt(np.clip(1 - rho**2, 0, None))
    return np.where(rho < 1, np.expm1(-depth * chord) / np.expm1(-depth), 0.0)


def profile_table(ball: bool) -> np.ndarray:
    """Return the profiles (K, Q_COUNT, T_COUNT) of radius 1 blurred by a Gaussian of sigma q, read-only.

    Of a small and a large ball (K = 2), or of a disc (K = 1). Column t is at radius 1 + t q; radii below 0 have the
    value at 0. Computed by a Hankel transform.
    """
    return _tables()[:2] if ball else _tables()[2:]


@cache
def _tables() -> np.ndarray:
    """Return the tables (3, Q_COUNT, T_COUNT) of both balls and a disc, which share the Bessel functions."""
    q = Q_STEP * (1 + np.arange(Q_COUNT))
    t = T_FIRST + T_STEP * np.arange(T_COUNT)
    rho, rho_weight = roots_legendre(_NODES)
    angle = (rho + 1) * np.pi / 4  # rho = sin(angle) resolves the square root at the rim
    node, weight = np.sin(angle), rho_weight * np.pi / 4 * np.cos(angle)
    k_max = 6.0 / Q_STEP
    k, k_weight = (rho + 1) * k_max / 2, rho_weight * k_max / 2
    sharp = _sharp(node, _SMALL_DEPTH), _sharp(node, _LARGE_DEPTH), np.ones(_NODES)
    shapes = np.stack([values * node * weight for values in sharp], axis=1)
    spectra = _transformed(k, node, shapes).T * k * k_weight
    furthest = q[-1] * t[-1]
    from_rim = 1e-3 * np.sinh(np.linspace(-np.arcsinh(1e3), np.arcsinh(1e3 * furthest), _RADII))
    blur = np.exp(-0.5 * np.outer(k, q) ** 2)
    blurred = _transformed(1 + from_rim, k, np.concatenate([blur * spectrum[:, None] for spectrum in spectra], axis=1))
    out = np.empty((len(spectra), Q_COUNT, T_COUNT))
    for table, values in zip(out, np.split(blurred, len(spectra), axis=1), strict=True):
        table[:] = np.stack([np.interp(t * sigma, from_rim, values[:, i]) for i, sigma in enumerate(q)])
    np.clip(out, 0.0, 1.0, out=out)
    out.flags.writeable = False
    return out


def _transformed(at: np.ndarray, nodes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return J0(at nodes) @ weights (N, C): a Hankel transform of order zero at `at` (N,), by `weights` (M, C)."""
    parts = np.split(at, range(_AT_ONCE, len(at), _AT_ONCE))
    return np.concatenate([j0(np.outer(part, nodes)) @ weights for part in parts])
