"""The fit: its covariance by sampling, pairs of beads that touch, structure under a bead."""

import numpy as np
import pytest
from bead_images import Bead, grid, quanta, radiograph

from sightline.detection import columns, refine
from sightline.detection.noise import estimate_noise

SIZE = 320


def fitted(beads: list[Bead], open_quanta: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, 2) and covariances (N, 2, 2) of fits started 0.3 px and 5 % off."""
    image = radiograph(quanta(beads, open_quanta), rng)
    light = np.log(np.maximum(image.pixels, 0.5)).astype(np.float32)
    usable = np.ones(light.shape, bool)
    noise = estimate_noise(light, usable)
    assert noise is not None
    truth = np.array([(b.u, b.v) for b in beads])
    radius = np.array([b.radius * rng.uniform(0.95, 1.05) for b in beads])
    rows = refine.start(truth + rng.uniform(-0.3, 0.3, truth.shape), radius, np.full(len(beads), -0.9))
    out = refine.Fit(light, usable, noise)(rows)
    assert (out[:, columns.STATUS] == columns.FITTED).all()
    cov = out[:, [columns.CUU, columns.CUV, columns.CUV, columns.CVV]].reshape(-1, 2, 2)
    return out[:, :2] - truth, cov


def normalised(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error) / 2


@pytest.mark.parametrize(
    ("radius", "level"),
    [
        (7.8, 15.0),
        (7.8, 120.0),
        (7.8, 480.0),
        (15.0, 15.0),
        (15.0, 120.0),
        (15.0, 480.0),
    ],
)
def test_stated_covariance_is_that_of_blurred_noise(radius: float, level: float) -> None:
    rng = np.random.default_rng(21)
    chi2 = []
    while len(chi2) < 200:
        beads = [Bead(u, v, radius) for u, v in grid(3 * radius + 50, SIZE, rng)]
        chi2 += list(normalised(*fitted(beads, np.full((SIZE, SIZE), level), rng)))
    # Half of chi-square with two degrees of freedom: mean 1, standard error here 0.07; 0.08 for the noise estimate.
    assert 0.75 < np.mean(chi2) < 1.25


def test_beads_that_touch_are_fitted_together() -> None:
    rng = np.random.default_rng(22)
    chi2 = []
    for _ in range(4):
        places = grid(62, SIZE, rng)
        angle = rng.uniform(0, 2 * np.pi, len(places))
        reach = rng.uniform(15.0, 18.0, len(places))
        beads = [Bead(u, v, 8.0) for u, v in places]
        beads += [
            Bead(u + r * np.cos(a), v + r * np.sin(a), 9.3) for (u, v), r, a in zip(places, reach, angle, strict=True)
        ]
        chi2 += list(normalised(*fitted(beads, np.full((SIZE, SIZE), 120.0), rng)))
    assert 0.7 < np.mean(chi2) < 1.3


def test_a_bone_edge_under_a_bead_shows_in_its_covariance() -> None:
    rng = np.random.default_rng(23)
    x = np.arange(SIZE) + np.zeros((SIZE, 1))
    chi2 = []
    for _ in range(4):
        places = grid(50, SIZE, rng)
        edges = 0.4 * np.sqrt(np.clip(1 - ((x % 50 - 25) / 22) ** 2, 0, None))
        beads = [Bead(u, v, 8.0) for u, v in places]
        chi2 += list(normalised(*fitted(beads, 120.0 * np.exp(-edges), rng)))
    assert np.median(chi2) < 1.5 * np.log(2)
    assert np.mean(chi2) < 2.0
