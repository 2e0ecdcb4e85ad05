"""The short way: from images to a view in one call, with what a person has at hand."""

from pathlib import Path

import numpy as np
import pytest
from tests.worked import Worked

import sightline as sl
from sightline.errors import FrameError, ImageError, UnusableInputError
from sightline.imaging import as_radiograph


@pytest.fixture(scope="module")
def view(worked: Worked) -> sl.CalibratedView:
    return worked.views[0]


def test_it_is_the_four_steps(worked: Worked, view: sl.CalibratedView) -> None:
    frame = sl.Frame.load("gamma")
    seen = sl.look_again(worked.image, worked.beads, sl.label(worked.beads, frame), frame)
    assert np.array_equal(view.focal_point_mm, sl.calibrate(seen, frame).focal_point_mm)


def test_a_path_an_array_and_a_frame_by_name_give_the_same_view(worked: Worked, view: sl.CalibratedView) -> None:
    from_path = sl.calibrate_image(str(worked.demo / "demo_pa.dcm"), sl.Frame.load("gamma"))
    assert np.array_equal(from_path.focal_point_mm, view.focal_point_mm)
    assert from_path.name == "pa"  # by its datum markers
    from_array = sl.calibrate_image(worked.image.pixels, "gamma", "pa", white=worked.image.white)
    assert np.array_equal(from_array.focal_point_mm, view.focal_point_mm)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.float32, np.float64])
def test_arrays_of_other_types_show_the_same_beads(worked: Worked, tmp_path: Path, dtype: type) -> None:
    """As arrays and as files; the noise of eight bits moves a centre by a tenth of a pixel."""
    shift = 16 if dtype is np.uint8 else 1
    pixels, white = (worked.image.pixels // shift).astype(dtype), worked.image.white // shift
    beads, ours = sl.detect(pixels, white=white), worked.beads
    near = np.linalg.norm(ours.uv_px[:, None] - beads.uv_px, axis=2).min(axis=1)
    assert np.quantile(near, 0.9) < (0.01 if shift == 1 else 0.15)
    seen = sl.label(beads, "gamma")
    assert len(sl.look_again(pixels, beads, seen, "gamma", white)) >= len(seen) - 5
    if dtype is np.int32:
        return  # as a file it does not tell what its largest value is
    np.save(tmp_path / "image.npy", pixels)
    again = sl.detect(tmp_path / "image.npy")
    assert abs(len(again) - len(beads)) <= 1  # the file does not state the white of a camera with fewer bits


@pytest.mark.parametrize("dtype", [bool, np.complex64, np.int32])
def test_files_of_other_numbers_are_refused(tmp_path: Path, dtype: type) -> None:
    np.save(tmp_path / "image.npy", np.zeros((32, 32), dtype))
    with pytest.raises(ImageError, match="save them as 8-bit"):
        sl.read_image(tmp_path / "image.npy")


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
        (lambda im, b: sl.detect(np.zeros((2, 32, 32, 3), np.uint8)), ImageError, r"give one image \(H, W\)"),
        (lambda im, b: sl.detect(im, white=4095), UnusableInputError, "belongs to an array"),
        (lambda im, b: sl.label(im, "gamma"), UnusableInputError, "Detections of `detect`, not Radiograph"),
        (lambda im, b: sl.label(b, "delta"), FrameError, "delta"),
        (lambda im, b: sl.label(b, 7), UnusableInputError, "gamma"),
        (lambda im, b: sl.look_again(7, b, sl.label(b, "gamma"), "gamma"), UnusableInputError, "not int"),
        (lambda im, b: sl.calibrate(b, "gamma"), UnusableInputError, "Observations of `label`"),
        (lambda im, b: sl.calibrate(im, "gamma"), UnusableInputError, "calibrate_image"),
        (lambda im, b: sl.calibrate_image(im, None), UnusableInputError, "not NoneType"),
    ],
)
def test_what_it_does_not_take_is_told_in_a_sentence(call, error: type, words: str, worked: Worked) -> None:
    with pytest.raises(error, match=words):
        call(worked.image, worked.beads)
