"""Halves of rims that disagree, in linear adjustments whose answer is known."""

import numpy as np
import pytest

from sightline.planning.nail.hole import rims_disagree

ENDS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 11.0])
POINTS = 40
RIMS = list(np.arange(POINTS).reshape(4, 10))


def disagreement(rng: np.random.Generator, offset: np.ndarray, sd: float = 1.0) -> tuple[float, np.ndarray, float]:
    """Return it for a line through points (K,), its error (4,) and the squared length of that in its s.d."""
    design = rng.standard_normal((POINTS, 4))
    residual = offset + sd * rng.standard_normal(POINTS)  # about a true line of zeros
    own = np.linalg.inv(design.T @ design)
    gain4 = own @ design.T
    redundant = np.eye(POINTS) - design @ gain4
    to_ends = np.zeros((6, 4))
    to_ends[[0, 1, 3, 4], range(4)] = 1.0
    ends = to_ends @ own @ to_ends.T + np.diag([0.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    error = gain4 @ residual
    square = float(error @ np.linalg.solve(own, error))
    return rims_disagree(ENDS, ends, to_ends @ gain4, redundant @ residual, redundant, RIMS), error, square


def test_halves_that_differ_by_chance_disagree_by_one():
    rng = np.random.default_rng(1)
    values = [disagreement(rng, np.zeros(POINTS))[0] for _ in range(400)]
    assert np.mean(values) == pytest.approx(1.0, abs=0.08)  # 4 s.d. of the mean: a value has an s.d. of 0.4
    half_sd = [disagreement(rng, np.zeros(POINTS), 0.5)[0] for _ in range(400)]
    assert np.mean(half_sd) == pytest.approx(0.25, abs=0.02)


def test_a_half_that_is_wrong_as_a_whole_shows():
    """Each point is wrong by 3 s.d.: a fit that drops points one by one, beyond 4, keeps them and its stated error."""
    rng = np.random.default_rng(2)
    offset = np.zeros(POINTS)
    offset[RIMS[2][5:]] = 3.0
    values = np.array([disagreement(rng, offset)[0] for _ in range(400)])
    assert np.mean(values > 1.0) > 0.85
    assert np.mean(values) > 1.8


def test_the_change_is_that_of_an_adjustment_without_the_half():
    rng = np.random.default_rng(3)
    design, residual = rng.standard_normal((POINTS, 4)), rng.standard_normal(POINTS)
    own = np.linalg.inv(design.T @ design)
    gain, to_ends = own @ design.T, np.zeros((6, 4))
    to_ends[[0, 1, 3, 4], range(4)] = 1.0
    redundant = np.eye(POINTS) - design @ gain
    ends = to_ends @ own @ to_ends.T
    seen = expected = 0.0
    for half in np.split(np.arange(POINTS), 8):
        rest = np.setdiff1d(np.arange(POINTS), half)
        without = np.linalg.inv(design[rest].T @ design[rest])
        change = without @ design[rest].T @ residual[rest] - gain @ residual
        seen += change @ np.linalg.solve(own, change)
        expected += np.trace(np.linalg.solve(own, without - own))
    found = rims_disagree(ENDS, ends, to_ends @ gain, redundant @ residual, redundant, RIMS)
    assert found == pytest.approx(seen / expected, rel=1e-9)


def test_rims_without_points_say_nothing():
    empty = [np.zeros(0, dtype=int)] * 4
    assert rims_disagree(ENDS, np.eye(6), np.zeros((6, 0)), np.zeros(0), np.zeros((0, 0)), empty) == 1.0
