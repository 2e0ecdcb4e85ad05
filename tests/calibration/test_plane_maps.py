"""Plane maps: exact where their model holds, inverse of themselves, refusing elsewhere."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.calibration import fit_map
from sightline.calibration.maps.localized import LocalizedMap
from sightline.calibration.maps.smooth import MAX_CONTROLS, FittedSmoothMap, Kernel
from sightline.common.fitting import monomials, terms
from sightline.errors import CalibrationRefusedError, OutsideRegionError, UnusableInputError

SPACING_PX = 90.0


def grid(count: int = 9, seed: int = 0) -> np.ndarray:
    """Controls in an image, off any exact lattice."""
    a, b = np.meshgrid(np.arange(count), np.arange(count))
    jitter = np.random.default_rng(seed).uniform(-0.1, 0.1, (count * count, 2))
    return 100.0 + SPACING_PX * (np.stack([a.ravel(), b.ravel()], axis=1) + jitter)


def bent(uv_px: np.ndarray, degree: int = 3, size: float = 0.02) -> np.ndarray:
    """A plane map of the given degree: 0.21 mm/px with a bend."""
    x = (uv_px - 460.0) / 400.0
    coefficients = np.random.default_rng(degree).standard_normal((terms(degree), 2))
    linear = 84.0 * x @ np.array([[0.9, 0.3], [-0.35, 1.0]])
    return linear + 84.0 * size * monomials(x, degree) @ coefficients


WITHIN = np.random.default_rng(1).uniform(140.0, 780.0, (40, 2))
METHODS = ("smooth", "polynomial", "localized")


@pytest.mark.parametrize("method", METHODS)
def test_every_map_inverts_itself_and_knows_its_slope(method):
    plane_map = fit_map(grid(), bent(grid()), method, degree=4)
    xy = plane_map.to_plane(WITHIN)
    np.testing.assert_allclose(plane_map.to_image(xy), WITHIN, atol=1e-7)
    step = 1e-4
    for axis in range(2):
        ahead = plane_map.to_plane(WITHIN + step * np.eye(2)[axis])
        np.testing.assert_allclose(plane_map.jacobian(WITHIN)[:, :, axis], (ahead - xy) / step, atol=2e-6)


@pytest.mark.parametrize("method", METHODS)
def test_points_without_an_image_hold_no_other_up(method):
    """Points with pixels are mixed with points far outside, whose Newton steps do not converge."""
    plane_map = fit_map(grid(), bent(grid()), method, degree=5)
    far = np.array([[900.0, -700.0], [-3e5, 2e5], [0.0, 600.0]])
    uv, found = plane_map.find_image(np.concatenate([far[:1], plane_map.to_plane(WITHIN), far[1:]]))
    np.testing.assert_array_equal(found, [False, *[True] * len(WITHIN), False, False])
    np.testing.assert_allclose(uv, WITHIN, atol=1e-7)
    with pytest.raises(OutsideRegionError):
        plane_map.to_image(far)
    assert plane_map.find_image(np.zeros((0, 2)))[0].shape == (0, 2)


@pytest.mark.parametrize("degree", [1, 4, 7])
def test_polynomial_is_exact_for_polynomials_of_its_degree(degree):
    plane_map = fit_map(grid(), bent(grid(), degree), "polynomial", degree=degree)
    np.testing.assert_allclose(plane_map.to_plane(WITHIN), bent(WITHIN, degree), atol=1e-8)


def test_smooth_is_exact_for_cubics_whatever_the_prior():
    plane_map = fit_map(grid(), bent(grid()), "smooth")
    np.testing.assert_allclose(plane_map.to_plane(WITHIN), bent(WITHIN), atol=1e-7)


def test_localized_is_the_papers_equation_6():
    uv, xy = np.array([[10.0, 20.0], [110.0, 30.0], [40.0, 140.0]]), np.array([[1.0, 2.0], [22.0, 5.0], [7.0, 29.0]])
    w = np.vstack([xy.T, [0.0, 0.0, 0.0]])
    a = w @ np.linalg.inv(np.vstack([uv.T, [1.0, 1.0, 1.0]]))
    expected = (a @ np.array([50.0, 60.0, 1.0]))[:2]
    np.testing.assert_allclose(LocalizedMap.fit(uv, xy).to_plane(np.array([[50.0, 60.0]]))[0], expected, atol=1e-12)


def test_localized_takes_the_containing_triangle_not_the_nearest_three():
    # The three nearest fiducials of a square grid's edge point lie on one line; the containing triangle does not.
    uv = np.stack(np.meshgrid([0.0, 100.0, 200.0], [0.0, 100.0, 200.0]), axis=-1).reshape(-1, 2)
    plane_map = LocalizedMap.fit(uv, 0.2 * uv)
    np.testing.assert_allclose(plane_map.to_plane(np.array([[100.0, 1.0]])), [[20.0, 0.2]], atol=1e-12)


def test_localized_does_not_extrapolate():
    plane_map = fit_map(grid(), bent(grid()), "localized")
    with pytest.raises(OutsideRegionError, match="in no triangle"):
        plane_map.to_plane(np.array([[20.0, 20.0]]))
    with pytest.raises(OutsideRegionError, match="outside the region"):
        plane_map.to_image(np.array([[500.0, 500.0]]))


def test_localized_refuses_slivers():
    uv = np.array([[0.0, 0.0], [100.0, 0.0], [50.0, 3.0], [50.0, 100.0]])
    plane_map = LocalizedMap.fit(uv, 0.2 * uv)
    with pytest.raises(OutsideRegionError):
        plane_map.to_plane(np.array([[50.0, 1.0]]))
    with pytest.raises(CalibrationRefusedError, match="nearly on one line"):
        LocalizedMap.fit(uv[:3], 0.2 * uv[:3])
    with pytest.raises(CalibrationRefusedError, match="triangle"):
        LocalizedMap.fit(np.column_stack([np.arange(5.0), np.arange(5.0)]), np.zeros((5, 2)))


@settings(max_examples=30, deadline=None)
@given(st.floats(150, 770), st.floats(150, 770))
def test_linear_maps_weigh_their_controls_to_one(u, v):
    for method in ("localized", "polynomial"):
        plane_map = fit_map(grid(), bent(grid()), method)
        weights = plane_map.weights(np.array([[u, v]]))  # type: ignore[attr-defined]
        assert abs(weights.sum() - 1) < 1e-9
        np.testing.assert_allclose(weights @ bent(grid()), plane_map.to_plane(np.array([[u, v]])), atol=1e-8)


def test_smooth_shrinks_to_a_homography_on_a_flat_panel():
    # design.md: a cubic is within 0.0013 mm of a homography at 20 degrees of tilt.
    focal, tilt = 1000.0, np.deg2rad(20.0)
    x = np.stack(np.meshgrid(*2 * [np.linspace(-75.0, 75.0, 8)]), axis=-1).reshape(-1, 2)

    def pixels(xy):
        return 511.5 + (xy @ np.diag([np.cos(tilt), 1.0])) / (1 + xy[:, :1] * np.sin(tilt) / focal) / 0.21

    plane_map = fit_map(pixels(x), x, "smooth", noise_px=0.1)
    between = np.random.default_rng(2).uniform(-70.0, 70.0, (200, 2))
    miss = np.linalg.norm(plane_map.to_plane(pixels(between)) - between, axis=1)
    assert miss.max() < 0.0013


def test_smooth_states_its_error_as_sampling_shows_it():
    # Fields drawn from the kernel itself, beyond a cubic: a fit that learns amplitude and length anew each time
    # must state the error it makes. 60 fields of 40 points: the mean of z² is 1 within 15 %.
    rng, uv, noise_px = np.random.default_rng(5), grid(8), 0.1
    kernel, at = Kernel(np.array([0.3**2]), np.array([0.4]), 0.15**2), np.concatenate([uv, WITHIN])
    unit = (at - 415.0) / 445.0
    factor = np.linalg.cholesky(kernel(unit, unit) + 1e-10 * np.eye(len(at)))
    z = []
    for _ in range(60):
        xy = bent(at, size=0.005) + factor @ rng.standard_normal((len(at), 2))
        seen = uv + noise_px * rng.standard_normal(uv.shape)
        plane_map = FittedSmoothMap.fit(seen, xy[: len(uv)], noise_px)
        miss = plane_map.to_plane(WITHIN) - xy[len(uv) :]
        z.append(miss / np.sqrt(np.diag(plane_map.covariance_mm2(WITHIN)))[:, None])
    assert 0.85 < np.mean(np.square(z)) < 1.15


def test_smooth_estimates_the_noise_where_none_is_stated():
    rng = np.random.default_rng(6)
    for noise_px in (0.1, 0.8):
        xy, seen = bent(grid()), grid() + noise_px * rng.standard_normal(grid().shape)
        miss = FittedSmoothMap.fit(seen, xy, None)
        stated = np.sqrt(np.diag(miss.covariance_mm2(WITHIN)))[:, None]
        assert 0.7 < np.sqrt(np.mean(((miss.to_plane(WITHIN) - bent(WITHIN)) / stated) ** 2)) < 1.4


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"method": "spline"}, UnusableInputError, "smooth, polynomial, localized"),
        ({"method": "polynomial", "degree": 8}, UnusableInputError, "1 to 7"),
        ({"noise_px": 0.0}, UnusableInputError, "above zero"),
        ({"noise_px": float("nan")}, UnusableInputError, "above zero"),
        ({"uv_px": np.zeros((5, 3))}, UnusableInputError, "shapes"),
        ({"uv_px": np.full((81, 2), np.nan)}, UnusableInputError, "not finite"),
        ({"uv_px": grid()[:5], "xy_mm": bent(grid())[:5]}, CalibrationRefusedError, "5 controls"),
        (
            {"uv_px": grid()[:9], "xy_mm": bent(grid())[:9], "method": "polynomial"},
            CalibrationRefusedError,
            "at least 10",
        ),
        ({"uv_px": np.zeros((81, 2))}, CalibrationRefusedError, "one line"),
        ({"uv_px": grid() * [1, 0]}, CalibrationRefusedError, "one line"),
        ({"uv_px": grid() * [1, 0], "method": "polynomial"}, CalibrationRefusedError, "one line"),
        (
            {
                "uv_px": np.random.default_rng(0).uniform(size=(MAX_CONTROLS + 1, 2)),
                "xy_mm": np.random.default_rng(1).uniform(size=(MAX_CONTROLS + 1, 2)),
            },
            CalibrationRefusedError,
            "thin them out",
        ),
    ],
)
def test_what_cannot_be_mapped_is_refused(change, error, words):
    with pytest.raises(error, match=words):
        fit_map(**{"uv_px": grid(), "xy_mm": bent(grid()), **change})
