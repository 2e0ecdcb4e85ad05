"""The short way: from images to a view in one call, with what a person has at hand."""

from pathlib import Path

import numpy as np
import pytest

import sightline as sl
from sightline.errors import FrameError, ImageError, UnusableInputError
from sightline.imaging import as_radiograph


@pytest.fixture(scope="module")
def image(demo_folder: Path) -> sl.Radiograph:
    return sl.read_image(demo_folder / "demo_pa.dcm")


@pytest.fixture(scope="module")
def view(image: sl.Radiograph) -> sl.CalibratedView:
    return sl.calibrate_image(image, sl.Frame.load("gamma"))


def test_it_is_the_four_steps(image: sl.Radiograph, view: sl.CalibratedView) -> None:
    frame = sl.Frame.load("gamma")
    beads = sl.detect(image)
    seen = sl.look_again(image, beads, sl.label(beads, frame), frame)
    assert np.array_equal(view.focal_point_mm, sl.calibrate(seen, frame).focal_point_mm)
    assert view.name == "pa"


def test_a_path_an_array_and_a_frame_by_name_give_the_same_view(
    demo_folder: Path, image: sl.Radiograph, view: sl.CalibratedView
) -> None:
    path = demo_folder / "demo_pa.dcm"
    for given in (path, str(path)):
        assert np.array_equal(sl.calibrate_image(given, "gamma").focal_point_mm, view.focal_point_mm)
    from_array = sl.calibrate_image(image.pixels, "gamma", "pa", white=image.white)
    assert np.array_equal(from_array.focal_point_mm, view.focal_point_mm)


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32, np.float64])
def test_arrays_of_other_types_show_the_same_beads(image: sl.Radiograph, dtype: type) -> None:
    beads, ours = sl.detect(image.pixels.astype(dtype), white=image.white), sl.detect(image)
    assert beads.uv_px == pytest.approx(ours.uv_px, abs=0.01)


def test_white_is_the_type_s_largest_value_unless_given() -> None:
    pixels = np.zeros((32, 32))
    assert as_radiograph(pixels.astype(np.uint8)).white == 255
    assert as_radiograph(pixels.astype(np.uint16)).white == 65535
    assert as_radiograph(pixels.astype(np.int16)).white == 32767
    assert as_radiograph(pixels.astype(np.uint16), 4095).white == 4095


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda im, b: sl.detect(np.zeros((32, 32))), UnusableInputError, "give white="),
        (lambda im, b: sl.detect(np.zeros((32, 32), bool)), UnusableInputError, "give white="),
        (lambda im, b: sl.detect([[1, 2], [3, 4]]), UnusableInputError, "not list"),
        (lambda im, b: sl.detect(np.zeros((32, 32, 3), np.uint8)), ImageError, "two dimensions"),
        (lambda im, b: sl.detect(im, white=4095), UnusableInputError, "belongs to an array"),
        (lambda im, b: sl.label(im, "gamma"), UnusableInputError, "Detections of `detect`, not Radiograph"),
        (lambda im, b: sl.label(b, "delta"), FrameError, "delta"),
        (lambda im, b: sl.label(b, 7), UnusableInputError, "gamma"),
        (lambda im, b: sl.calibrate(b, "gamma"), UnusableInputError, "Observations of `label`"),
        (lambda im, b: sl.calibrate(im, "gamma"), UnusableInputError, "calibrate_image"),
        (lambda im, b: sl.calibrate_image(im, None), UnusableInputError, "not NoneType"),
    ],
)
def test_what_it_does_not_take_is_told_in_a_sentence(call, error: type, words: str, image: sl.Radiograph) -> None:
    with pytest.raises(error, match=words):
        call(image, sl.detect(image))
