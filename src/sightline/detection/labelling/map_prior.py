"""Prior of the map between an image and a plate: a polynomial of degree 5 and a smooth remainder."""

import numpy as np

from sightline.common.fitting import squared_exponential

DEGREE = 5
# Prior s.d. of what a map adds to a similarity, per degree, as a share of the field's radius: position, tilt and scale,
# perspective of a 20° tilt, 9 % pincushion with 4° S-shape, and their higher terms (physics.md, Distortion) [ours].
PRIOR = np.array([0.3, 0.15, 0.06, 0.10, 0.03, 0.03])
# The remainder beyond degree 5, in shares of the field's radius: 0.11-0.13 mm rms and 30-60 mm of 107 (physics.md).
REMAINDER_SD, REMAINDER_LENGTH = 0.0013, 0.4
# S.d. of a centre's error in addition to its stated noise, from uneven background and overlap [ours]. In 78 rendered
# images at high dose, the estimated noise is 1.7 times the stated variance with it, 2.1 times without it.
CENTRE_PX = 0.05

_POWERS = np.array([(d - k, k) for d in range(DEGREE + 1) for k in range(d + 1)])
_SD = PRIOR[_POWERS.sum(axis=1)]


def features(w: np.ndarray) -> np.ndarray:
    """Return monomials to degree 5 of (N, 2) times their prior s.d., and their two derivatives (3, N, 21)."""
    x, y = (np.vander(values, DEGREE + 1, increasing=True) for values in w.T)
    i, j = _POWERS.T
    by_x, by_y = i * x[:, np.maximum(i - 1, 0)] * y[:, j], j * x[:, i] * y[:, np.maximum(j - 1, 0)]
    return np.stack([x[:, i] * y[:, j], by_x, by_y]) * _SD


def map_covariance(phi_a: np.ndarray, phi_b: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Return the prior covariance (N, M) of a map's coordinate between points a and b, in units of the field's radius.

    `phi_a` (N, 21), `phi_b` (M, 21): their `features`; `squares` (N, M): their squared distances.
    """
    return phi_a @ phi_b.T + REMAINDER_SD**2 * squared_exponential(squares, REMAINDER_LENGTH)
