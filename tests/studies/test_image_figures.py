"""Each figure on images whose answer is known."""

import cv2
import numpy as np
import pytest

from sightline.detection import Detections
from sightline.detection.lattice import Lattice, grow
from sightline.imaging import Radiograph
from sightline.studies.comparison import measures as measure
from sightline.studies.comparison.measures import NotMeasurableError

OFF = np.array([0.31, -0.27])  # off the grid
MIDDLE, RADIUS = np.array([511.5, 511.5]), 500.0


def beads_at(uv: np.ndarray, radius: np.ndarray, contrast: float = -1.0, kind: str = "ball") -> Detections:
    n = len(uv)
    return Detections(
        uv, radius, np.repeat(0.01 * np.eye(2)[None], n, 0), (kind,) * n, np.full(n, contrast), (256, 256)
    )


def hexagonal(pitch: float, reach: float) -> np.ndarray:
    index = np.stack(np.meshgrid(np.arange(-60, 61), np.arange(-60, 61)), -1).reshape(-1, 2)
    xy = pitch * index @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
    return xy[np.linalg.norm(xy, axis=1) < reach]


def distorted(xy: np.ndarray, share: float, turn: float) -> np.ndarray:
    """Outwards by `share` and turned by `turn` at RIM, both as the square of the radius."""
    u2 = (np.linalg.norm(xy, axis=1) / (measure.RIM * RADIUS)) ** 2
    z = (xy @ [1, 1j]) * (1 + share * u2) * np.exp(1j * turn * u2)
    return MIDDLE + np.stack([z.real, z.imag], 1)


def round_image(values: np.ndarray) -> Radiograph:
    """uint16 pixels of a round field about the middle of a square image."""
    size = values.shape[0]
    away = np.hypot(*(np.indices(values.shape) - (size - 1) / 2))
    return Radiograph(np.where(away < 0.49 * size, np.clip(values, 1, 65535), 0).astype(np.uint16), 65535.0)


def test_a_distorted_hexagonal_plate_is_numbered_whole_and_strays_are_left_out() -> None:
    rng = np.random.default_rng(1)
    uv = distorted(hexagonal(14.3, 470.0) + OFF, 0.06, 0.03)
    strays = rng.uniform(200, 800, (12, 2))
    clear = np.linalg.norm(strays[:, None] - uv, axis=2).min(axis=1) > 0.45 * 14.3
    found = grow(np.concatenate([uv, strays[clear]]))
    assert found is not None
    assert clear.any()
    assert sorted(found.members) == list(range(len(uv)))
    np.testing.assert_allclose(np.linalg.norm(found.axes, axis=1), 1.0)
    assert found.axes[0] @ found.axes[1] == pytest.approx(0.5)


def test_a_square_grid_is_square() -> None:
    index = np.stack(np.meshgrid(np.arange(9), np.arange(7)), -1).reshape(-1, 2)
    turned = index @ np.array([[0.92, 0.39], [-0.39, 0.92]]) * 31.0 + 77.3
    found = grow(np.delete(turned, [5, 40], axis=0))
    assert found is not None
    assert len(found) == 61
    np.testing.assert_allclose(found.axes, np.eye(2))


def test_what_stands_on_no_lattice_has_no_distortion() -> None:
    scattered = np.random.default_rng(2).uniform(0, 1000, (60, 2))
    with pytest.raises(NotMeasurableError, match="on one lattice"):
        measure.lattice_of(beads_at(scattered, np.full(60, 4.0)))
    with pytest.raises(NotMeasurableError, match="no beads"):
        measure.lattice_of(None)


@pytest.mark.parametrize(("share", "turn"), [(0.053, 0.021), (-0.031, -0.013)])
def test_pincushion_and_turn_are_those_that_were_put_in(share: float, turn: float) -> None:
    rng = np.random.default_rng(3)
    uv = distorted(hexagonal(14.3, 460.0) + OFF, share, turn)
    found = grow(uv + 0.05 * rng.standard_normal(uv.shape))
    assert found is not None
    seen = measure.distortion(found, MIDDLE, RADIUS)
    assert seen.pincushion == pytest.approx(share, abs=0.002)  # of the radius: degree 5, 0.05 px, 3,000 points
    assert seen.turn_rad == pytest.approx(turn, abs=0.002)


def test_residuals_are_the_noise_once_the_degree_holds_the_map() -> None:
    rng = np.random.default_rng(4)
    xy = hexagonal(20.0, 460.0)
    bent = xy + 3.0 * np.stack([(xy[:, 0] / RADIUS) ** 3, -((xy[:, 1] / RADIUS) ** 2)], 1)
    # The map from pixels to the plate is the polynomial here, so the plate's points are bent and the pixels are not.
    uv = MIDDLE + xy + 0.2 * rng.standard_normal(xy.shape)
    index = bent @ np.linalg.inv(20.0 * np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]]))
    plate = Lattice(np.arange(len(xy)), uv, index, np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]]), 20.0)
    left = measure.distortion(plate, MIDDLE, RADIUS).residual_px
    assert left[1] > 2 * left[3]
    for degree in (3, 4, 5, 7):
        assert left[degree] == pytest.approx(0.2 * np.sqrt(2), rel=0.06)  # 1,900 points: 1.6 % s.d. of an rms


def test_few_points_leave_the_higher_degrees_out() -> None:
    index = np.stack(np.meshgrid(np.arange(6), np.arange(6)), -1).reshape(-1, 2)
    found = grow(60.0 * index + 200.0 + np.random.default_rng(5).normal(0, 0.1, (36, 2)))
    assert found is not None
    assert list(measure.distortion(found, MIDDLE, RADIUS).residual_px) == [1, 2, 3, 4]


def ball_image(blur: float, noise: float, ball: bool) -> tuple[Radiograph, Detections]:
    """Nine opaque balls or clear holes off the grid, four times oversampled, blurred, summed over pixels."""
    rng, fine = np.random.default_rng(6), 4
    places = np.array([(x, y) for x in (60.0, 150.0, 240.0) for y in (60.0, 150.0, 240.0)]) + rng.uniform(
        -0.5, 0.5, (9, 2)
    )
    side = (np.arange(300 * fine) + 0.5) / fine - 0.5
    light = np.full((len(side), len(side)), 1.0 if ball else 0.3)
    for u, v in places:
        r2 = (side - u) ** 2 + ((side - v) ** 2)[:, None]
        if ball:
            light *= 0.4 + 0.6 * np.exp(-3.0 * np.sqrt(np.maximum(1 - r2 / 9.0**2, 0)))
        else:
            light[r2 < 9.0**2] = 1.0
    soft = cv2.GaussianBlur(light, (0, 0), blur * fine)
    pixels = 20000 * soft.reshape(300, fine, 300, fine).mean(axis=(1, 3)) + noise * rng.standard_normal((300, 300))
    kind = "ball" if ball else "hole"
    return Radiograph(pixels.astype(np.uint16), 65535.0), beads_at(places, np.full(9, 9.3), kind=kind)


@pytest.mark.slow
@pytest.mark.parametrize("ball", [True, False])
@pytest.mark.parametrize("blur", [0.8, 1.3])
def test_the_edge_spread_is_blur_and_pixel_together(blur: float, ball: bool) -> None:
    spread, number = measure.edge_spread(*ball_image(blur, 150.0, ball))
    assert number == 9
    assert spread == pytest.approx(np.sqrt(blur**2 + 1 / 12), rel=0.05)


def test_no_rim_no_edge_spread() -> None:
    image, beads = ball_image(0.8, 150.0, True)
    with pytest.raises(NotMeasurableError, match="no beads"):
        measure.edge_spread(image, None)
    with pytest.raises(NotMeasurableError, match="stands free"):
        measure.edge_spread(image, beads_at(beads.uv_px, np.full(9, 1.9)))
    flat = Radiograph(np.random.default_rng(7).normal(9000, 300, (300, 300)).astype(np.uint16), 65535.0)
    with pytest.raises(NotMeasurableError, match="explains"):
        measure.edge_spread(flat, beads)


def test_noise_is_that_of_counts_behind_a_blur() -> None:
    rng, level = np.random.default_rng(8), np.linspace(150.0, 450.0, 512)
    counts = rng.poisson(np.broadcast_to(level, (512, 512))).astype(np.float64)
    model, levels = measure.noise(round_image(30 * cv2.GaussianBlur(counts, (0, 0), 1.0)), None)
    assert model.slope == pytest.approx(1.0, abs=0.25)
    middle = np.exp(levels[2]) / 30
    assert middle == pytest.approx(300, rel=0.03)
    # A Gaussian blur of 1 px leaves 1 / (4 pi) of the variance of white noise.
    assert np.sqrt(model.variance(levels[2])) == pytest.approx(1 / np.sqrt(middle * 4 * np.pi), rel=0.1)
    np.testing.assert_allclose(model.correlation[1:3], np.exp(-(np.arange(1, 3) ** 2) / 4), atol=0.05)


def test_a_plate_has_no_flat_block_for_noise() -> None:
    uv = hexagonal(14.0, 200.0) + 256.0
    plate = beads_at(uv, np.full(len(uv), 4.0), 0.7, "hole")
    with pytest.raises(NotMeasurableError, match="holes everywhere"):
        measure.noise(round_image(np.full((512, 512), 9000.0)), plate)


def test_contrast_is_that_of_the_balls_of_the_usual_size() -> None:
    uv = np.random.default_rng(9).uniform(0, 256, (12, 2))
    beads = beads_at(uv, np.array([9.5] * 10 + [16.0, 16.0]), -1.25)
    assert measure.ball_contrast(beads) == (-1.25, 9.5, 10)
    with pytest.raises(NotMeasurableError, match="5 balls"):
        measure.ball_contrast(beads_at(uv[:5], np.full(5, 9.5)))
    with pytest.raises(NotMeasurableError, match="no usual size"):
        measure.ball_contrast(beads_at(uv, 3.0 * 1.4 ** np.arange(12)))


def test_vignetting_is_the_brightness_that_was_taken_from_the_rim() -> None:
    rng = np.random.default_rng(10)
    away = np.hypot(*(np.indices((600, 600)) - 299.5)) / 294.0
    image = round_image(20000 * (1 - 0.2 * away**2) + 100 * rng.standard_normal((600, 600)))
    uv = np.array([[200.0, 220.0], [390.0, 310.0]])
    seen = measure.vignetting(image, beads_at(uv, np.full(2, 9.0)))
    assert len(seen.radius) >= 9
    np.testing.assert_allclose(seen.brightness, 1 - 0.2 * seen.radius**2, atol=0.01)


def test_vignetting_of_a_perforated_plate_is_that_of_its_means() -> None:
    uv = hexagonal(14.0, 300.0) + 299.5
    holes = np.zeros((600, 600), np.float32)
    for u, v in uv:
        if min(u, v) > 3 and max(u, v) < 596:
            cv2.circle(holes, (round(16 * u), round(16 * v)), 16 * 4, 1.0, -1, cv2.LINE_8, 4)
    away = np.hypot(*(np.indices((600, 600)) - 299.5)) / 294.0
    # As every X-ray image has: what is constant to the last digit counts as written into the image.
    noise = np.random.default_rng(4).normal(0.0, 30.0, (600, 600))
    image = round_image((4000 + 16000 * holes) * (1 - 0.2 * away**2) + noise)
    seen = measure.vignetting(image, beads_at(uv, np.full(len(uv), 4.0), 0.7, "hole"))
    np.testing.assert_allclose(seen.brightness, 1 - 0.2 * seen.radius**2, atol=0.01)


def test_what_shades_one_side_has_no_vignetting_and_is_no_open_beam() -> None:
    rng = np.random.default_rng(11)
    pixels = 20000 + 100 * rng.standard_normal((600, 600))
    assert measure.open_beam(round_image(pixels), None)
    pixels[:, :300] /= 4
    with pytest.raises(NotMeasurableError, match="shades"):
        measure.vignetting(round_image(pixels), None)
    assert not measure.open_beam(round_image(pixels), None)
