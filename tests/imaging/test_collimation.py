"""The field of view is found for all shapes, also with a dark rim."""

import cv2
import numpy as np
import pytest

from sightline.imaging import Radiograph

H, W = 480, 512
CENTRE, RADIUS = np.array([261.3, 237.8]), 221.7
V, U = np.mgrid[:H, :W]
ROUND = (U - CENTRE[0]) ** 2 + (V - CENTRE[1]) ** 2 < RADIUS**2
TURNS = np.deg2rad(11.0) + np.arange(8) * np.pi / 4
WHOLE = np.ones((H, W), dtype=bool)
FIELDS = {
    "round": ROUND,
    "octagonal": np.all([(U - CENTRE[0]) * np.cos(t) + (V - CENTRE[1]) * np.sin(t) < 201.4 for t in TURNS], axis=0),
    "rectangular": (U > 61.5) & (U < 431.2) & (V > 49.7) & (V < 399.4),
    "with blades": ROUND & (U > 118.4) & (V + 0.3 * U < 455),
    "a strip at one side": ROUND & (U < 150.6),  # the middle of the image is dark
    "blades above and below": (V > 80.3) & (V - 0.1 * U < 380.6),
    "whole": WHOLE,
    "larger than the image": (U - 255.5) ** 2 + (V - 239.5) ** 2 < 290**2,
}


def exposed(field: np.ndarray, *, dark: np.ndarray | None = None, seed: int = 3) -> np.ndarray:
    """Return a noisy 12-bit image: bright with vignetting inside, glare and noise outside."""
    rng = np.random.default_rng(seed)
    light = 2600.0 - 700.0 * ((U - W / 2) ** 2 + (V - H / 2) ** 2) / RADIUS**2
    if dark is not None:
        light = np.where(dark, 12.0, light)
    light = cv2.GaussianBlur(np.where(field, light, 0.0), (0, 0), 1.5) + 8.0
    return np.clip(rng.normal(light, np.sqrt(4 * light)), 0, 4095).astype(np.uint16)


def assert_edge_within(mask: np.ndarray, truth: np.ndarray, tolerance_px: int) -> None:
    """Assert that no pixel farther than the tolerance from the true edge is on the wrong side of the mask's edge."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * tolerance_px + 1,) * 2)
    grown, shrunk = (f(truth.astype(np.uint8), kernel).astype(bool) for f in (cv2.dilate, cv2.erode))
    assert not (mask & ~grown).any()
    assert (mask | ~shrunk).all()


@pytest.mark.parametrize("name", FIELDS)
def test_every_shape_is_found_to_a_hundredth_of_its_radius(name: str) -> None:
    truth = FIELDS[name]
    mask = Radiograph(exposed(truth), 4095.0).field_mask
    assert mask.dtype == bool
    assert not mask.flags.writeable
    assert_edge_within(mask, truth, 3)


def test_an_image_without_collimation_is_field_to_its_last_pixel() -> None:
    assert Radiograph(exposed(WHOLE), 4095.0).field_mask.all()


@pytest.mark.parametrize("name", FIELDS)
def test_a_wide_dark_thing_across_the_rim_is_bridged(name: str) -> None:
    """Metal covers a sector from outside the rim to the middle; in a round field, the circle bridges the gap."""
    bolster = (np.abs(V - CENTRE[1] - 20) < 45) & (U > 300)
    mask = Radiograph(exposed(FIELDS[name], dark=bolster), 4095.0).field_mask
    assert_edge_within(mask, FIELDS[name], 8 if name in ("octagonal", "with blades") else 4)


def test_a_bar_that_cuts_the_field_in_two_does_not_halve_it() -> None:
    bar = np.abs(U - CENTRE[0] + 0.2 * V) < 30
    assert_edge_within(Radiograph(exposed(ROUND, dark=bar), 4095.0).field_mask, ROUND, 4)


def test_one_dark_corner_is_anatomy_not_collimation() -> None:
    corner = U + V < 150
    assert Radiograph(exposed(WHOLE, dark=corner), 4095.0).field_mask.all()


def test_writing_outside_the_field_and_a_line_along_the_border_are_not_field() -> None:
    writing = np.zeros((H, W), np.uint8)
    cv2.putText(writing, "R 12:30", (2, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2)
    cv2.putText(writing, "70 kV", (430, 470), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2)
    pixels = np.where(writing > 0, 4095, exposed(ROUND)).astype(np.uint16)
    pixels[0] = np.linspace(0, 4091, W)
    assert_edge_within(Radiograph(pixels, 4095.0).field_mask, ROUND, 3)


@pytest.mark.parametrize("level", [280, 1900, 3500, 4095])
@pytest.mark.parametrize("name", FIELDS)
def test_a_surround_of_one_grey_level_is_not_field_whatever_its_level_and_shape(name: str, level: int) -> None:
    """A mask around the field, in black bars of a video with writing, compressed or not.

    The picture with its bars is twice as wide as the field, and an edge changes all levels of a block of 8 px of JPEG.
    """
    truth = np.pad(FIELDS[name], ((0, 0), (200, 240)))
    bars = np.pad(np.where(FIELDS[name], exposed(WHOLE), level), ((0, 0), (200, 240)), constant_values=280)
    bars[20:26, 20:180] = 4095
    assert_edge_within(Radiograph(bars.astype(np.uint16), 4095.0).field_mask, truth, 7)
    byte = cv2.imencode(".jpg", (bars / 16).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    mask = Radiograph(cv2.imdecode(byte, cv2.IMREAD_GRAYSCALE), 255.0).field_mask
    assert_edge_within(mask, truth, 10)


def test_clipped_air_is_field_beside_bone_and_around_beads() -> None:
    light = cv2.GaussianBlur(np.where(U + 0.2 * V > 380, 4500.0, 2000.0), (0, 0), 1.5) + np.random.default_rng(
        4
    ).normal(0, 20, (H, W))
    assert Radiograph(np.minimum(light, 4095).astype(np.uint16), 4095.0).field_mask.all()
    for u in range(390, W, 40):
        for v in range(20, H, 40):
            light[np.hypot(U - u, V - v) < 7] = 800
    assert Radiograph(np.minimum(light, 4095).astype(np.uint16), 4095.0).field_mask.all()


@pytest.mark.parametrize(
    "pixels",
    [
        np.zeros((64, 64), np.uint8),
        np.full((64, 64), 255, np.uint8),
        np.zeros((16, 16), np.float32),
        np.eye(17, dtype=np.uint16) * 65535,
        np.ones((40, 4000), np.float32),
    ],
)
def test_a_degenerate_image_gives_a_mask_of_its_shape(pixels: np.ndarray) -> None:
    assert Radiograph(pixels, 65535.0).field_mask.shape == pixels.shape


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_the_pixel_type_does_not_matter(kind: type) -> None:
    pixels = (exposed(FIELDS["octagonal"]) / 16.0).astype(kind)
    assert_edge_within(Radiograph(pixels, 255.0).field_mask, FIELDS["octagonal"], 3)
