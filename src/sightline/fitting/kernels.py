"""The covariance of a smooth process at points of a plane."""

import numpy as np


def squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the squared distances (N, M) between points (N, 2) and (M, 2)."""
    out = a @ (-2.0 * b.T)
    out += np.einsum("ik,ik->i", a, a)[:, None]
    out += np.einsum("ik,ik->i", b, b)
    return out


def squared_exponential(squares: np.ndarray, length: float) -> np.ndarray:
    """Return exp(-d² / 2 length²) of squared distances d²: the covariance of a process of unit variance."""
    return np.exp(squares * (-0.5 / length**2))
