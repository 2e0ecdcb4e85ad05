"""The test for a rim: of a disc in an image without noise; medians by a sorting network; values between pixels."""

import numpy as np
import pytest

from sightline.detection.beads import rim

CENTRE, RADIUS, STEP = np.array([60.3, 58.6]), 10.0, 0.5
LINE = np.array([-9.0, 0.0], np.float32)  # of the noise: 1 % of the light


@pytest.mark.parametrize("seed", range(3))
def test_the_sorting_network_finds_the_median(seed: int) -> None:
    """A network that lacks a comparison fails, also one that fails only where values are equal."""
    rng = np.random.default_rng(seed)
    scratch = np.empty(16, np.float32)
    for values in (rng.normal(size=(200, 16)), rng.integers(0, 3, size=(200, 16))):
        for row in values.astype(np.float32):
            assert rim._median(row, scratch) == pytest.approx(float(np.median(row)), abs=1e-7)


def test_values_between_pixels_are_bilinear_and_the_border_repeats() -> None:
    """On a plane bilinear values are exact, to float32; a program that mixes up rows and columns fails."""
    v, u = np.mgrid[:40, :60]
    image = (2.0 * u - 3.0 * v).astype(np.float32)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-5, 65, 500).astype(np.float32), rng.uniform(-5, 45, 500).astype(np.float32)
    expected = 2.0 * np.clip(x, 0, 58.99) - 3.0 * np.clip(y, 0, 38.99)
    values = np.empty(500, np.float32)
    sampler = rim._Sampler(image.reshape(-1), image.shape, x.copy(), y.copy(), np.empty(500, np.uint32), values)
    rim._interpolate(sampler, 500)
    np.testing.assert_allclose(values, expected, atol=1e-3)


def judged_from(
    away: float, direction: float, radius_px: float = RADIUS, step: float = STEP, line: np.ndarray = LINE
) -> np.void:
    """Return the candidate from an extremum so many radii away from the disc's centre."""
    v, u = np.mgrid[:120, :120]
    inside = np.clip(RADIUS + 0.5 - np.hypot(u - CENTRE[0], v - CENTRE[1]), 0.0, 1.0)
    start = CENTRE + away * RADIUS * np.array([np.cos(direction), np.sin(direction)])
    extremum = np.zeros(1, rim.EXTREMUM)
    extremum["u_px"], extremum["v_px"], extremum["radius_px"], extremum["contrast"] = *start, radius_px, -step
    return rim.judged((8.0 - step * inside).astype(np.float32), extremum, line)[0]


@pytest.mark.parametrize("direction", np.arange(0.3, 6.3, 0.7))
def test_a_disc_is_found_from_where_half_of_it_is_seen(direction: float) -> None:
    found = judged_from(0.45, direction)
    assert found["score"] > 0
    assert (found["u_px"], found["v_px"], found["radius_px"]) == pytest.approx((*CENTRE, RADIUS), abs=0.15)
    assert found["contrast"] == pytest.approx(-STEP, rel=0.25)


@pytest.mark.parametrize("direction", np.arange(0.3, 6.3, 0.7))
def test_a_disc_is_not_that_of_an_extremum_at_its_rim(direction: float) -> None:
    assert judged_from(1.05, direction)["radius_px"] == 0


@pytest.mark.parametrize("radius_px", [0.4 * RADIUS, 2.3 * RADIUS])
def test_a_disc_is_not_that_of_an_extremum_of_another_size(radius_px: float) -> None:
    assert judged_from(0.0, 0.0, radius_px)["radius_px"] == 0


@pytest.mark.parametrize(("step", "found"), [(1.15 * rim.FAINTEST, True), (0.85 * rim.FAINTEST, False)])
def test_the_faintest_disc_is_found(step: float, found: bool) -> None:
    assert (judged_from(0.1, 1.0, step=step)["radius_px"] > 0) == found


@pytest.mark.parametrize(("share", "found"), [(1.15, True), (0.85, False)])
def test_noise_hides_a_disc_as_far_as_the_mean_of_its_pixels(share: float, found: bool) -> None:
    step = 0.3
    sd = step * RADIUS / (share * rim.MIN_STEP_SNR)
    line = np.array([2.0 * np.log(sd), 0.0], np.float32)
    assert (judged_from(0.1, 1.0, step=step, line=line)["radius_px"] > 0) == found
