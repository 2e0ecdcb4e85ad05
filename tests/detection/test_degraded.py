"""Compressed, quantised and partly constant images give beads within their errors, or a refusal with the reason."""

import re
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from degraded_images import banded, blocks, in_8_bits, interlaced, jpeg, levels, torn
from tests.detection.bead_images import normalised
from tests.detection.frame_images import FRAME, SIZE, beads, image

from sightline.common.checks import failed
from sightline.detection import Observations, detect, label, look_again
from sightline.detection.beads.noise import LAGS, NoiseModel
from sightline.detection.causes import cause_of
from sightline.detection.common_shape import MAX_BLUR_PX, MAX_COPY_PX, CommonShape, common_shape
from sightline.errors import DetectionRefusedError, LabellingRefusedError, SightlineError
from sightline.from_images.pipeline import find_beads, label_beads
from sightline.imaging import Radiograph, image_checks
from sightline.imaging.defects import Tear
from sightline.imaging.defects import interlaced as interlaced_image
from sightline.imaging.defects import torn as tear_of

TRUTH = beads()
CLEAN = in_8_bits(image(TRUTH, 5))
NOISE = np.random.default_rng(2).normal(0.0, 2.0, CLEAN.shape)
SHARP, SOFT = (cv2.add(one, NOISE, dtype=cv2.CV_8U) for one in (CLEAN, cv2.GaussianBlur(CLEAN, (0, 0), 1.5)))


def labelled(pixels: np.ndarray) -> Observations:
    one = Radiograph(pixels, 255.0)
    found = detect(one)
    return look_again(one, found, label(found, FRAME), FRAME)


def squares(found: Observations) -> np.ndarray:
    """Return half the squared normalised errors (N,)."""
    assert found.covariance_px2 is not None
    return normalised(found.uv_px - [(TRUTH[name].u, TRUTH[name].v) for name in found.ids], found.covariance_px2)


@pytest.mark.parametrize("quality", [20, 50, 95])
def test_beads_of_compressed_images_are_within_their_errors(quality: int) -> None:
    found = labelled(jpeg(CLEAN, quality))
    assert len(found) > 0.5 * len(TRUTH)
    assert np.median(squares(found)) / np.log(2) < 1.5


@pytest.mark.parametrize(("side", "quality"), [(2, 10), (4, 10), (8, 10), (4, 30), (8, 30), (8, 1)])
def test_whatever_compression_and_blocks_leave_is_measured_or_refused(side: int, quality: int) -> None:
    try:
        found = labelled(jpeg(blocks(CLEAN, side), quality))
    except SightlineError:
        return
    assert np.median(squares(found)) / np.log(2) < 4  # blocks move rims by a share of their side


@pytest.mark.parametrize(
    "change", [lambda pixels: levels(pixels, 64), lambda pixels: levels(pixels, 32), lambda pixels: banded(pixels, 100)]
)
def test_few_grey_levels_and_constant_areas_leave_the_other_beads(change: Callable[[np.ndarray], np.ndarray]) -> None:
    found = labelled(change(CLEAN))
    assert len(found) > 0.5 * len(TRUTH)
    assert np.median(squares(found)) / np.log(2) < 1.5


def test_an_image_of_few_grey_levels_is_refused_as_such() -> None:
    with pytest.raises(DetectionRefusedError, match=r"most of its field is constant \(2 grey levels"):
        detect(Radiograph(np.where(np.indices(CLEAN.shape)[1] > 255, 150, 50).astype(np.uint8), 255.0))
    with pytest.raises(DetectionRefusedError, match="fewer than 8192 px"):
        detect(Radiograph(CLEAN[:64, :64], 255.0))


@pytest.mark.parametrize("correlation", [-0.2, 0.0, 0.9])
def test_a_broad_mean_has_noise_whatever_the_correlation(correlation: float) -> None:
    noise = NoiseModel(0.0, 1.0, np.array([1.0] + LAGS * [correlation]))
    assert noise.broad == pytest.approx(max(1 + 2 * LAGS * correlation, 0.1))


@pytest.mark.parametrize(("at", "shift"), [(139, -12), (256, 5), (371, 40)])
def test_a_torn_image_is_refused_as_such(at: int, shift: int) -> None:
    assert tear_of(Radiograph(torn(CLEAN, at, shift), 255.0)) == Tear(at, shift, rows=True)
    assert tear_of(Radiograph(torn(CLEAN, at, shift).T.copy(), 255.0)) == Tear(at, shift, rows=False)
    # Also beyond the balls of a block, which take up a small part of its image.
    assert [check.name for check in failed(image_checks(Radiograph(torn(CLEAN, at, shift), 255.0)))] == ["image rows"]
    said = cause_of(Radiograph(torn(CLEAN, at, shift), 255.0), np.zeros((0, 3)), ())
    assert said is not None and f"torn: from row {at} on it is shifted by {abs(shift)} columns" in said


def test_a_tear_is_found_where_half_of_its_line_shows_little_structure() -> None:
    smooth = cv2.GaussianBlur(CLEAN, (0, 0), 8) + np.random.default_rng(1).normal(0.0, 3.0, CLEAN.shape)
    half = np.hstack([CLEAN[:, :256], np.rint(smooth[:, 256:]).astype(np.uint8)])
    assert tear_of(Radiograph(torn(half, 371, 40), 255.0)) == Tear(371, 40, rows=True)
    assert tear_of(Radiograph(half, 255.0)) is None
    assert tear_of(Radiograph(torn(SOFT, 371, 2), 255.0)) == Tear(371, 2, rows=True)


def test_a_tear_between_two_exposures_is_found() -> None:
    """The two fields have independent noise."""
    later = in_8_bits(image(TRUTH, 6))
    both = np.concatenate([CLEAN[:240], np.roll(later, (3, 15), axis=(0, 1))[240:]])
    tear = tear_of(Radiograph(both, 255.0))
    assert tear is not None
    assert (tear.at, tear.rows, abs(tear.shift_px - 15) <= 2) == (240, True, True)
    assert tear_of(Radiograph(np.concatenate([CLEAN[:240], later[240:]]), 255.0)) is None  # nothing moved


@pytest.mark.parametrize(("down", "right"), [(0, 2), (0, -5), (2, 0), (6, 3)])
def test_an_interlaced_image_of_something_that_moved_is_refused_as_such(down: int, right: int) -> None:
    with pytest.raises(DetectionRefusedError, match="interlaced"):
        detect(Radiograph(interlaced(CLEAN, down, right), 255.0))


def test_whole_images_have_no_line_defect() -> None:
    enlarged = [np.kron(CLEAN, np.ones((2, 2), np.uint8)), cv2.resize(CLEAN, None, fx=1.5, fy=1.5, interpolation=0)]
    compressed = [jpeg(CLEAN, 50), *(jpeg(SHARP, quality) for quality in (5, 8, 11))]
    for one in (CLEAN, levels(CLEAN, 32), cv2.GaussianBlur(CLEAN, (0, 0), 3), *enlarged, *compressed):
        assert interlaced_image(Radiograph(one, 255.0)) is None
        assert tear_of(Radiograph(one, 255.0)) is None


def refusal(pixels: np.ndarray) -> str:
    one = Radiograph(pixels, 255.0)
    with pytest.raises((DetectionRefusedError, LabellingRefusedError)) as refused:
        label_beads(one, detect(one), FRAME)
    return str(refused.value)


def test_an_inverted_image_is_refused_as_such_and_read_inverted() -> None:
    inverted = Radiograph(255 - CLEAN, 255.0)
    assert refusal(255 - CLEAN).startswith("inverted: ")
    assert "--invert" in refusal(255 - CLEAN)
    np.testing.assert_array_equal(detect(inverted.inverted()).uv_px, detect(Radiograph(CLEAN, 255.0)).uv_px)


def test_beads_of_a_frame_are_found_in_the_inverse_of_an_image_that_shows_them_bright() -> None:
    one = Radiograph(CLEAN, 255.0)
    for given, inverted in ((one, False), (one.inverted(), False), (Radiograph(255 - CLEAN, 255.0), True)):
        read, found = find_beads(given)
        assert read.is_inverted is inverted
        np.testing.assert_array_equal(read.pixels, CLEAN)
        np.testing.assert_array_equal(found.uv_px, detect(one).uv_px)
        assert [check.name for check in image_checks(read)] == ["clipped pixels", *["inversion"] * inverted]


@pytest.mark.parametrize(("enlarged", "sigma_px"), [(1, 3), (1, 4), (2, 8)])  # of the last, most fits move away
def test_a_blurred_image_is_refused_as_such(enlarged: int, sigma_px: int) -> None:
    blurred = cv2.GaussianBlur(cv2.resize(CLEAN, None, fx=enlarged, fy=enlarged), (0, 0), sigma_px)
    found = re.search(r"the image is blurred: (\d+) spots", refusal(blurred))
    assert found is not None and int(found[1]) > 0.4 * len(TRUTH)


def smeared(pixels: np.ndarray, length_px: float, angle_deg: float) -> np.ndarray:
    """Return an image moved along a line during the exposure, with the noise of the whole exposure."""
    kernel = np.zeros((31, 31), np.float32)
    way = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))]) * length_px / 2
    ends = [tuple(round(16 * (15 + sign * part)) for part in way) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1, cv2.LINE_AA, 4)
    noise = np.random.default_rng(3).normal(0.0, 2.0, pixels.shape)
    return np.clip(cv2.filter2D(pixels.astype(np.float32), -1, kernel / kernel.sum()) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("length_px", "angle_deg"), [(9, 0), (9, 90), (12, 40), (15, 130)])
def test_an_image_smeared_by_movement_is_refused_as_such_and_says_in_which_direction(
    length_px: float, angle_deg: float
) -> None:
    said = re.search(r"smeared by movement at about (\d+)° to its rows", refusal(smeared(CLEAN, length_px, angle_deg)))
    assert said is not None
    assert abs((float(said[1]) - angle_deg + 90) % 180 - 90) < 15


def test_noise_blur_and_stripes_are_not_taken_for_movement() -> None:
    blur = cv2.GaussianBlur(CLEAN, (0, 0), 3.5)
    noise = np.clip(CLEAN + np.random.default_rng(4).normal(0.0, 40.0, CLEAN.shape), 0, 255).astype(np.uint8)
    stripes = np.clip(blur * (1 + 0.2 * np.sin(np.arange(len(blur)) / 2))[:, None], 0, 255).astype(np.uint8)
    for pixels in (blur, noise, stripes):
        assert "smeared" not in refusal(pixels)


def moved(shift: tuple[float, float], share: float) -> np.ndarray:
    """Return an image through which an earlier frame shines, `shift` away, with its own noise."""
    earlier = in_8_bits(image({i: replace(b, u=b.u + shift[0], v=b.v + shift[1]) for i, b in TRUTH.items()}, 7))
    return np.rint((1 - share) * CLEAN.astype(float) + share * earlier).astype(np.uint8)


def shape_of(pixels: np.ndarray) -> CommonShape:
    one = Radiograph(pixels, 255.0)
    found = detect(one)
    shape = common_shape(one, found.uv_px, found.radius_px)
    assert shape is not None
    return shape


@pytest.mark.parametrize(("share", "shift"), [(0.1, (3.0, 0.0)), (0.15, (-2.1, 1.4)), (0.3, (2.0, -2.2))])
def test_an_earlier_frame_that_shines_through_fails_a_check_that_says_how_strong_and_where(
    share: float, shift: tuple[float, float]
) -> None:
    shape = shape_of(moved(shift, share))
    assert next(check.name for check in failed(shape.checks())) == "double image"
    apart = np.arctan2(*shape.copy_px) - np.arctan2(*shift)
    assert abs((apart + np.pi) % (2 * np.pi) - np.pi) < np.deg2rad(20)
    assert 0.5 * share < shape.copy_share < 3 * share  # a copy at a listed shift stands for one between two of these


@pytest.mark.parametrize(("share", "shift"), [(0.5, (2.2, 0.0)), (0.5, (-2.0, 2.0)), (0.4, (-3.0, 2.0))])
def test_two_nearly_equal_exposures_fail_a_check_that_names_the_direction(
    share: float, shift: tuple[float, float]
) -> None:
    shape = shape_of(moved(shift, share))
    assert "movement blur" in [check.name for check in failed(shape.checks())]
    assert abs((shape.blur_deg - np.rad2deg(np.arctan2(shift[1], shift[0])) + 90) % 180 - 90) < 15


def test_few_beads_before_bones_show_two_exposures_too() -> None:
    """Fails for a background that counts as part of a shadow's shape, and for a standard error that one bead sets."""
    v, u = np.indices(CLEAN.shape)
    edges = sum(np.sin((np.cos(angle) * u + np.sin(angle) * v) / 12) for angle in (0.4, 1.3, 2.5))
    for pixels, blurred in ((CLEAN, False), (moved((-3.0, 2.0), 0.4), True), (moved((2.0, -2.2), 0.3), True)):
        one = Radiograph(np.clip(pixels * (1 - 0.1 * edges), 0, 255).astype(np.uint8), 255.0)
        found = detect(one)
        shape = common_shape(one, found.uv_px[:12], found.radius_px[:12])  # as many as a block's
        assert shape is not None and (shape.blur_px > MAX_BLUR_PX) is blurred


@pytest.mark.parametrize("change", [lambda p: p, lambda p: cv2.GaussianBlur(p, (0, 0), 1.0), lambda p: jpeg(p, 50)])
def test_one_exposure_has_neither_copies_nor_a_blur_of_one_direction(
    change: Callable[[np.ndarray], np.ndarray],
) -> None:
    for seed in range(20, 22):
        shape = shape_of(change(in_8_bits(image(TRUTH, seed))))
        assert shape.copy_moves_px < 0.5 * MAX_COPY_PX
        assert shape.blur_px < 0.8 * MAX_BLUR_PX


@pytest.mark.parametrize("aspect", [0.75, 0.9, 1.12, 1.33])
def test_pixels_that_are_not_square_are_named_with_their_sides(aspect: float) -> None:
    said = cause_of_detected(cv2.resize(CLEAN, None, fx=aspect, fy=1.0, interpolation=cv2.INTER_AREA))
    assert said is not None
    found = re.search(r"pixels are not square: its beads are (\S+) times as wide as high", said)
    assert found is not None
    assert float(found[1]) == pytest.approx(aspect, rel=0.03)


def test_an_image_of_too_few_pixels_is_named_as_such() -> None:
    said = cause_of_detected(cv2.resize(CLEAN, None, fx=0.42, fy=0.42, interpolation=cv2.INTER_AREA))
    assert said is not None and "too few pixels" in said


def cause_of_detected(pixels: np.ndarray) -> str | None:
    one = Radiograph(pixels, 255.0)
    try:
        found = detect(one)
    except DetectionRefusedError as refused:
        return str(refused)
    return cause_of(one, np.column_stack([found.uv_px, found.radius_px]), found.rejected)


def test_edges_of_other_images_are_not_taken_for_smeared_beads() -> None:
    """Strokes of two directions, one more often than the other, of which 0.3 are common."""
    rng, strokes = np.random.default_rng(6), np.full((SIZE, SIZE), 150, np.uint8)
    for k, (u, v) in enumerate(rng.uniform(40, SIZE - 40, (120, 2))):
        along = np.deg2rad(rng.normal(20 if k % 3 else 110, 25))
        cv2.line(
            strokes, (int(u), int(v)), (int(u + 24 * np.cos(along)), int(v + 24 * np.sin(along))), 90, 6, cv2.LINE_AA
        )
    noisy = np.clip(cv2.GaussianBlur(strokes, (0, 0), 1.2) + rng.normal(0, 3, strokes.shape), 0, 255).astype(np.uint8)
    assert "smeared" not in refusal(noisy)


@pytest.mark.parametrize("gain", [3, 6, 20])
def test_a_saturated_image_is_refused_as_such(gain: int) -> None:
    assert "the image is saturated" in refusal(np.clip(CLEAN.astype(int) * gain, 0, 255).astype(np.uint8))


def test_another_frame_in_a_good_image_is_not_blamed_on_the_image() -> None:
    assert "the image is" not in refusal(np.ascontiguousarray(CLEAN[:, :180]))
