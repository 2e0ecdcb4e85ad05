"""The bead fit: covariance by sampling, touching pairs, structure under a bead."""

import numpy as np
import pytest
from bead_images import Bead, grid, normalised, quanta, radiograph
from scipy.ndimage import gaussian_filter

from sightline.detection.beads import refine
from sightline.detection.beads.bead import BeadStatus, centre_covariances, centres
from sightline.detection.beads.noise import estimate_noise

SIZE = 320


def answers(
    beads: list[Bead],
    open_quanta: np.ndarray,
    rng: np.random.Generator,
    scatter: float | np.ndarray = 0.4,
    hidden: np.ndarray | None = None,
) -> np.ndarray:
    """Return fits (N,) with initial errors of 0.3 px and 5 %; `hidden` pixels (H, W) do not count."""
    image = radiograph(quanta(beads, open_quanta, scatter), rng)
    light = np.log(np.maximum(image.pixels, 0.5)).astype(np.float32)
    usable = np.ones(light.shape, bool)
    noise = estimate_noise(light, usable)
    assert noise is not None
    truth = np.array([(b.u, b.v) for b in beads])
    radius = np.array([b.radius * rng.uniform(0.95, 1.05) for b in beads])
    rows = refine.start(truth + rng.uniform(-0.3, 0.3, truth.shape), radius, np.full(len(beads), -0.9))
    out = refine.BeadFitter(light, usable if hidden is None else ~hidden, noise)(rows)
    assert (out["status"] == BeadStatus.FITTED).all()
    return out


def errors(beads: list[Bead], fits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, 2) and covariances (N, 2, 2) of fits."""
    return centres(fits) - np.array([(b.u, b.v) for b in beads]), centre_covariances(fits)


def test_stated_covariance_holds_where_half_a_bead_is_hidden() -> None:
    """With few pixels and correlated noise, the fit absorbs a large part of the noise."""
    rng = np.random.default_rng(24)
    y, x = np.mgrid[:SIZE, :SIZE]
    chi2, residual = [], []
    while len(chi2) < 200:
        beads, hidden = [Bead(u, v, 8.0) for u, v in grid(60, SIZE, rng)], np.zeros((SIZE, SIZE), bool)
        for bead, angle in zip(beads, rng.uniform(0, 2 * np.pi, len(beads)), strict=True):
            beyond = (x - bead.u) * np.cos(angle) + (y - bead.v) * np.sin(angle) > 2.0
            hidden |= beyond & (np.hypot(x - bead.u, y - bead.v) < 20)
        out = answers(beads, np.full((SIZE, SIZE), 120.0), rng, hidden=hidden)
        chi2 += list(normalised(*errors(beads, out)))
        residual += list(out["chi2"])
    assert 0.8 < np.mean(chi2) < 1.2  # standard error 0.07; 0.08 for the noise estimate
    assert 0.9 < np.mean(residual) < 1.15  # 0.02; 0.08 for the noise estimate


@pytest.mark.parametrize(
    ("radius", "depth", "level", "scatter"), [(9.3, 3.0, 120.0, 0.4), (12.7, 1.8, 120.0, 0.4), (9.3, 1.8, 480.0, 1.0)]
)
def test_beads_that_touch_are_fitted_together(radius: float, depth: float, level: float, scatter: float) -> None:
    """Also where the neighbour absorbs another share of the light."""
    rng = np.random.default_rng(22)
    chi2 = []
    for _ in range(4):
        places = grid(62, SIZE, rng)
        angle = rng.uniform(0, 2 * np.pi, len(places))
        reach = radius - 9.3 + rng.uniform(15.0, 18.0, len(places))
        beads = [Bead(u, v, 8.0) for u, v in places]
        beads += [
            Bead(u + r * np.cos(a), v + r * np.sin(a), radius, depth)
            for (u, v), r, a in zip(places, reach, angle, strict=True)
        ]
        chi2 += list(normalised(*errors(beads, answers(beads, np.full((SIZE, SIZE), level), rng, scatter))))
    assert 0.7 < np.mean(chi2) < 1.3


def test_a_bone_edge_under_a_bead_shows_in_its_covariance() -> None:
    rng = np.random.default_rng(23)
    x = np.arange(SIZE) + np.zeros((SIZE, 1))
    chi2 = []
    for _ in range(4):
        places = grid(50, SIZE, rng)
        edges = 0.4 * np.sqrt(np.clip(1 - ((x % 50 - 25) / 22) ** 2, 0, None))
        beads = [Bead(u, v, 8.0) for u, v in places]
        chi2 += list(normalised(*errors(beads, answers(beads, 120.0 * np.exp(-edges), rng))))
    assert np.median(chi2) < 1.5 * np.log(2)
    assert np.mean(chi2) < 2.0


@pytest.mark.parametrize("width_px", [38.0, np.inf])  # 8 mm at 0.21 mm/px, and even
def test_scatter_that_follows_the_background_pulls_no_centre(width_px: float) -> None:
    """Centres stay within their covariance, without a bias along the background's slope."""
    rng = np.random.default_rng([37, 2000])
    y, x = np.mgrid[:SIZE, :SIZE]
    error, cov, slope = [], [], []
    for turn in range(4):
        wave = 2 * np.pi / rng.uniform(90, 140) * np.array([np.cos(turn), np.sin(turn)])  # a thigh, or a wide bone
        primary = 500.0 * np.exp(0.5 * np.sin(wave[0] * x + wave[1] * y + turn))
        wide = primary.mean() if np.isinf(width_px) else gaussian_filter(primary, width_px, mode="reflect")
        beads = [Bead(u, v, rng.uniform(6.5, 9.5)) for u, v in grid(40, SIZE, rng)]
        e, c = errors(beads, answers(beads, primary, rng, 0.7 * wide * np.ones_like(primary)))
        phase = np.array([wave @ (bead.u, bead.v) + turn for bead in beads])
        error.append(e)
        cov.append(c)
        slope.append(0.5 * np.cos(phase)[:, None] * wave)
    error, cov, slope = np.concatenate(error), np.concatenate(cov), np.concatenate(slope)
    chi2 = normalised(error, cov)
    weight = slope / np.trace(cov, axis1=1, axis2=2)[:, None]
    along = 0.01 * (weight * error).sum() / (weight * slope).sum()  # px where the background changes by 1 % per px
    assert 0.8 < np.sqrt(chi2.mean()) < 1.15  # standard error 0.04; the noise estimate is good to 15 % in variance
    assert abs(along) < 0.002  # standard error 0.0009; 0.007 where scatter is taken for level


def test_the_larger_of_two_sizes_is_a_large_ball() -> None:
    """Not the balls of one size that lie nearer to the source, and appear larger by a fifth."""
    radius = np.array([8.0, 8.0, 8.1, 9.6, 13.3, 15.0])
    rows = refine.start(np.zeros((6, 2)), radius, np.full(6, -0.9))
    np.testing.assert_array_equal(rows["large"], [0.0, 0.0, 0.0, 0.0, 1.0, 1.0])
    assert refine.start(np.zeros((0, 2)), np.zeros(0), np.zeros(0)).shape == (0,)


def test_a_large_ball_half_before_clipped_light_is_where_it_is() -> None:
    """With the profile of a small ball, whose rim is less steep, it is off by more than twice as much."""
    small, large = [Bead(60.3 + 70 * k, 70.6, 8.0) for k in range(3)], Bead(160.4, 200.7, 13.5, depth=5.0)
    slope = np.exp(0.004 * np.tile(np.arange(SIZE) - 160.0, (SIZE, 1)))
    expected = quanta([*small, large], 400.0 * slope, np.full((SIZE, SIZE), 160.0))
    noisy = np.log(radiograph(expected, np.random.default_rng(33)).pixels.astype(np.float32))
    noise = estimate_noise(noisy, np.ones((SIZE, SIZE), bool))
    assert noise is not None
    light = np.log(radiograph(expected, None, level=0.05).pixels)
    light = np.minimum(light, light[120, 150])  # clips more than half of the large ball's background
    fit = refine.BeadFitter(light, np.ones(light.shape, bool), noise)
    places, radii = np.array([(b.u, b.v) for b in (*small, large)]), np.array([8.0, 8.0, 8.0, 13.5])
    rows = refine.start(places, radii, np.full(4, -0.9))
    as_small = rows.copy()
    as_small["large"] = 0.0
    off, off_as_small = (np.hypot(*(centres(fit(each))[3] - (large.u, large.v))) for each in (rows, as_small))
    assert off < 0.03
    assert off_as_small > 2 * off
