"""Burnt-in annotations are distinguished from the X-ray image, and detection ignores them."""

import cv2
import numpy as np
import pytest

import sightline as sl
from sightline.imaging import Radiograph
from sightline.twin import hip_scene, render

WORDS = ("R 0o8 PA", "OOO 12:30", "o.o: 88")
HALO_PX = 3  # letters are found to this; the mask is wider than them


@pytest.fixture(scope="module")
def clean(setup) -> Radiograph:
    rng = np.random.default_rng(8)
    return render(setup, "pa", hip_scene(setup, rng).scene, rng)


@pytest.fixture(scope="module")
def beads(clean: Radiograph) -> sl.Detections:
    return sl.detect(clean)


def inked(image: Radiograph, ink: np.ndarray, value: int) -> Radiograph:
    """Return the image with `value` where `ink` (H, W) is 1, and a mixture where it is between 0 and 1."""
    mixed = image.pixels * (1 - ink) + value * ink
    return Radiograph(np.rint(mixed).astype(image.pixels.dtype), image.white)


def lettering(shape: tuple[int, int], places: np.ndarray, *, smooth: bool) -> np.ndarray:
    """Return ink (H, W), 0 to 1, of words at places (N, 2), px."""
    ink = np.zeros(shape, np.uint8)
    for i, (u, v) in enumerate(places):
        at = (round(u), round(v))
        cv2.putText(ink, WORDS[i % len(WORDS)], at, cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2, cv2.LINE_AA)
    share = ink / 255.0
    return share if smooth else np.rint(share)


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))


def test_an_image_without_writing_has_no_marks(clean: Radiograph) -> None:
    assert clean.burnt_in is None
    assert Radiograph((clean.pixels >> 4).astype(np.uint8), 255.0).burnt_in is None


@pytest.mark.parametrize("gain", [2.0, 4.0, 8.0])
def test_what_is_clipped_is_no_mark(clean: Radiograph, gain: float) -> None:
    """In an over-exposed image, the open beam ends at beads within one pixel."""
    bright = np.clip(clean.pixels * gain, 0, 4095).astype(np.uint16)
    assert (bright == 4095).mean() > 0.05
    assert Radiograph(bright, 4095.0).burnt_in is None
    dark = np.clip(clean.pixels * 2.0 - 1200.0, 0, 4095).astype(np.uint16)
    assert Radiograph(dark, 4095.0).burnt_in is None


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("value", [4095, 0, 3500])
def test_letters_cover_no_bead_but_those_they_lie_on_and_look_like_none(
    clean: Radiograph, beads: sl.Detections, value: int, smooth: bool
) -> None:
    rng = np.random.default_rng(5)
    places = beads.uv_px[rng.choice(len(beads), 12, replace=False)] + rng.uniform(-30, 12, (12, 2))
    ink = lettering(clean.shape, places, smooth=smooth)
    image = inked(clean, ink, value)
    mask = image.burnt_in
    assert mask is not None
    strong = (ink > 0.9) & (abs(clean.pixels.astype(float) - value) > 1500) & clean.field_mask
    assert mask[strong].mean() > 0.95
    near = cv2.dilate((ink > 0).astype(np.uint8), np.ones((2 * HALO_PX + 1,) * 2, np.uint8)) > 0
    assert not mask[~near].any()

    found = sl.detect(image)
    distance = apart(found.uv_px, beads.uv_px)
    assert distance.min(axis=1).max() < 1.0  # nothing new: each is one of the beads without letters
    from_ink = cv2.distanceTransform(1 - (ink > 0).astype(np.uint8), cv2.DIST_L2, 5)
    u, v = np.rint(beads.uv_px).astype(int).T
    untouched = from_ink[v, u] > beads.radius_px + 5  # nothing of the letters or of the mask on the bead or its rim
    assert untouched.sum() > 0.5 * len(beads)
    assert distance.min(axis=0)[untouched].max() < 0.1
    touched = distance.min(axis=0)[~untouched]
    assert np.median(touched[touched < 1.0]) < 0.1  # those partly covered are measured by what is left


def test_logos_arrows_and_lines_are_found(clean: Radiograph) -> None:
    ink = np.zeros(clean.shape, np.uint8)
    cv2.rectangle(ink, (300, 300), (340, 315), 1, -1)
    cv2.arrowedLine(ink, (600, 300), (700, 380), 1, 2, cv2.LINE_8)
    cv2.line(ink, (200, 700), (800, 640), 1, 2, cv2.LINE_8)
    for value in (3900, 200):  # a wide block of white or black could be open beam or an opaque ball
        mask = inked(clean, ink.astype(float), value).burnt_in
        assert mask is not None
        seen = (ink > 0) & (abs(clean.pixels.astype(float) - value) > 800)
        assert mask[seen].mean() > 0.99


def test_writing_outside_the_field_changes_neither_field_nor_beads(clean: Radiograph, beads: sl.Detections) -> None:
    ink = lettering(clean.shape, np.array([[2.0, 30.0], [820.0, 1010.0]]), smooth=False)
    ink[clean.field_mask] = 0
    assert ink.sum() > 100
    image = inked(clean, ink, 4095)
    np.testing.assert_array_equal(image.field_mask, clean.field_mask)
    np.testing.assert_array_equal(sl.detect(image).uv_px, beads.uv_px)
