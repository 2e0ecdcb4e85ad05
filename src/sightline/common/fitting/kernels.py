"""Distances between points of a plane, and the covariance of a smooth process at them."""

import numpy as np


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distances (N, M) between points (N, 2) and (M, 2)."""
    return np.hypot(a[:, 0, None] - b[:, 0], a[:, 1, None] - b[:, 1])


def exact_squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the squared distances (N, M) between points (N, 2) and (M, 2), exact also for close ones."""
    x, y = a[:, 0, None] - b[:, 0], a[:, 1, None] - b[:, 1]
    x *= x
    y *= y
    x += y
    return x


def squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the squared distances (N, M), by a matrix product: fast, but inexact for points close to each other."""
    out = a @ (-2.0 * b.T)
    out += np.einsum("ik,ik->i", a, a)[:, None]
    out += np.einsum("ik,ik->i", b, b)
    return out


def squared_exponential(squares: np.ndarray, length: float) -> np.ndarray:
    """Return exp(-d² / 2 length²) of squared distances d²: the covariance of a process of unit variance."""
    out = squares * (-0.5 / length**2)
    return np.exp(out, out=out)
