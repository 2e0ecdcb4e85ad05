"""The shape of a shadow is predicted from the others of its plate, with its error."""

import numpy as np
import pytest

from sightline.detection.beads.bead import BEAD
from sightline.detection.labelling.patterns import Pattern, patterns
from sightline.detection.second_look import SHAPE, expected_shapes
from sightline.frame import Frame

NOISE = np.array([0.006, 0.03, 0.005, 0.005])  # of log size, log blur, ellipticities: a low dose


def plate() -> Pattern:
    return next(pattern for pattern in patterns(Frame.load("gamma")) if pattern.view == "pa")


def shapes(pattern: Pattern) -> np.ndarray:
    """Return true fields SHAPE (P, 4) of an oblique, distorted plate: radii differ by a quarter over it."""
    x, y = pattern.xy_mm.T / 100
    size = np.exp(0.96 + 0.11 * x - 0.07 * y + 0.04 * x * x + 0.03 * x * y)
    return np.stack(
        [size * pattern.diameter_mm, np.full(len(x), 1.07), 0.02 + 0.01 * x * y - 0.006 * x, 0.013 * y - 0.004 * x * x],
        axis=1,
    )


def rows(true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return fits (P,) with these shapes and noise."""
    fits, noise = np.zeros(len(true), BEAD), NOISE * rng.standard_normal(true.shape)
    for name, values in zip(SHAPE, np.where(np.arange(4) < 2, true * np.exp(noise), true + noise).T, strict=True):
        fits[name] = values
    return fits


def off(mean: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.concatenate([np.log(mean[:, :2] / true[:, :2]), mean[:, 2:] - true[:, 2:]], axis=1)


@pytest.mark.parametrize("count", [30, 18])
def test_shapes_are_predicted_within_their_stated_error(count: int) -> None:
    """The stated s.d. is of a fit as noisy as the others: the prediction itself is at least as good."""
    pattern, rng = plate(), np.random.default_rng(3)
    true, ratios = shapes(pattern), []
    for _ in range(20):
        seen = np.sort(rng.choice(len(true), count, replace=False))
        mean, sd = expected_shapes(pattern, seen, rows(true, rng)[seen])
        hidden = np.setdiff1d(np.arange(len(true)), seen)
        ratios.append((off(mean, true)[hidden] / sd[hidden]) ** 2)
        inner = hidden[sd[hidden, 0] < 0.012]
        assert abs(off(mean, true)[inner, 0]).max(initial=0.0) < 0.03
    assert (np.sqrt(np.concatenate(ratios).mean(axis=0)) < 1.1).all()


def test_a_tenth_of_wrong_shapes_changes_little() -> None:
    """A pair that was fitted as one ball, or a ball half under metal."""
    pattern, rng = plate(), np.random.default_rng(4)
    true = shapes(pattern)
    fits = rows(true, rng)
    every = np.arange(len(true))
    before = expected_shapes(pattern, every, fits)[0]
    fits["radius_px"][::10] *= 1.3
    after, sd = expected_shapes(pattern, every, fits)
    assert (abs(off(after, before)) < sd).all()


def test_few_beads_give_a_mean_with_the_spread_of_the_plate() -> None:
    """Six parameters through nine beads would look exact."""
    pattern, rng = plate(), np.random.default_rng(5)
    true = shapes(pattern)
    seen = rng.choice(len(true), 9, replace=False)
    mean, sd = expected_shapes(pattern, seen, rows(true, rng)[seen])
    assert np.ptp(mean[:, 0] / pattern.diameter_mm) < 1e-9
    assert sd[:, 0].min() > 0.03
