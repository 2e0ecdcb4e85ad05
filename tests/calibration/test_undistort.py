"""An image resampled to the plane shows the plane as it is."""

import numpy as np
import pytest

from sightline.calibration import fit_map
from sightline.calibration.maps.hull import Hull
from sightline.calibration.maps.undistort import undistort
from sightline.errors import UnusableInputError

SHAPE = (400, 420)


def distorted(xy_mm: np.ndarray) -> np.ndarray:
    """Plane to image: rotated, scaled by 3 px/mm, with 4 % pincushion at the rim."""
    c, s = np.cos(0.2), np.sin(0.2)
    turned = xy_mm @ np.array([[c, s], [-s, c]])
    return np.array([208.3, 199.1]) + 3.0 * turned * (1 + 1.6e-5 * (xy_mm**2).sum(-1, keepdims=True))


@pytest.fixture(scope="module")
def fitted():
    x, y = np.meshgrid(np.linspace(-45, 45, 9), np.linspace(-45, 45, 9))
    xy_mm = np.stack([x.ravel(), y.ravel()], axis=1)
    uv_px = distorted(xy_mm)
    return fit_map(uv_px, xy_mm, method="smooth", noise_px=0.02), Hull.of(uv_px)


def dots(uv_px: np.ndarray) -> np.ndarray:
    """An image of dark Gaussian spots."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = sum(np.exp(-((u - a) ** 2 + (v - b) ** 2) / 18.0) for a, b in uv_px)
    return (3000 - 2000 * np.clip(depth, 0, 1)).astype(np.uint16)


def test_spots_come_to_lie_where_they_are_on_the_plane(fitted) -> None:
    plane_map, hull = fitted
    xy_mm = np.array([[-31.3, -28.7], [4.4, 2.1], [33.9, -11.2], [-12.6, 37.5]])
    image = undistort(dots(distorted(xy_mm)), plane_map, hull)
    assert image.pixels.dtype == np.uint16
    for x, y in xy_mm:
        column, row = np.round((np.array([x, y]) - image.origin_mm) / image.spacing_mm).astype(int)
        patch = 3000.0 - image.pixels[row - 12 : row + 13, column - 12 : column + 13]
        i, j = np.mgrid[row - 12 : row + 13, column - 12 : column + 13]
        centre = np.array([(patch * j).sum(), (patch * i).sum()]) / patch.sum()
        np.testing.assert_allclose(image.origin_mm + image.spacing_mm * centre, [x, y], atol=0.02)


def test_the_returned_map_is_the_plane_map(fitted) -> None:
    plane_map, hull = fitted
    image = undistort(np.zeros(SHAPE, np.uint16), plane_map, hull, spacing_mm=0.37)
    rows, columns = (np.random.default_rng(4).integers(0, n, 300) for n in image.uv_px.shape[:2])
    xy_mm = image.origin_mm + image.spacing_mm * np.stack([columns, rows], axis=1)
    np.testing.assert_allclose(image.uv_px[rows, columns], plane_map.to_image(xy_mm), atol=0.01)


@pytest.mark.parametrize("spacing_mm", [-1.0, np.nan, 1e-4])
def test_a_spacing_that_gives_no_image_is_refused(fitted, spacing_mm: float) -> None:
    plane_map, hull = fitted
    with pytest.raises(UnusableInputError, match="spacing"):
        undistort(np.zeros(SHAPE, np.uint16), plane_map, hull, spacing_mm)
