"""Prior of the map between an image and a plate: a polynomial of degree 5 and a smooth remainder."""

import numpy as np

from sightline.fitting.kernels import squared_exponential
from sightline.kernels import exact_unchecked

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


@exact_unchecked
def features(w):
    """Return monomials to degree 5 of (N, 2) times their prior s.d., and their two derivatives (3, N, 21)."""
    out = np.empty((3, len(w), len(_POWERS)))
    x, y = np.empty(DEGREE + 1), np.empty(DEGREE + 1)
    x[0] = y[0] = 1.0
    for n in range(len(w)):
        for d in range(DEGREE):
            x[d + 1], y[d + 1] = x[d] * w[n, 0], y[d] * w[n, 1]
        for k in range(len(_POWERS)):
            i, j = _POWERS[k, 0], _POWERS[k, 1]
            out[0, n, k] = x[i] * y[j] * _SD[k]
            out[1, n, k] = i * x[i - 1] * y[j] * _SD[k] if i else 0.0
            out[2, n, k] = j * x[i] * y[j - 1] * _SD[k] if j else 0.0
    return out


def map_covariance(phi_a: np.ndarray, phi_b: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Return the prior covariance (N, M) of a map's coordinate between points a and b, in units of the field's radius.

    `phi_a` (N, 21), `phi_b` (M, 21): their `features`; `squares` (N, M): their squared distances.
    """
    return phi_a @ phi_b.T + REMAINDER_SD**2 * squared_exponential(squares, REMAINDER_LENGTH)
