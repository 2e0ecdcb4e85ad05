"""Candidates: all beads, with good initial values, and few others."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from bead_images import Bead, grid, quanta, radiograph

from sightline.detection.beads.candidates import Candidates, distinct, find_candidates
from sightline.detection.beads.noise import estimate_noise
from sightline.detection.beads.rim import EXTREMUM
from sightline.detection.log_image import field_inset, log_image
from sightline.imaging import Radiograph

SIZE = 320


def candidates(image: Radiograph) -> Candidates:
    mask = field_inset(image)
    logs = log_image(image, mask)
    noise = estimate_noise(logs, mask)
    assert noise is not None
    return find_candidates(logs, mask, noise)


def nearest(found: Candidates, places: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found.uv_px[found.round][None] - places[:, None], axis=-1).argmin(axis=1)


@pytest.mark.parametrize("radius", [2.2, 5.0, 11.0, 24.0])
def test_starts_are_good_to_a_fraction_of_a_pixel_at_any_radius(radius: float) -> None:
    rng = np.random.default_rng(1)
    places = grid(max(5 * radius, 40), SIZE, rng)
    image = radiograph(quanta([Bead(u, v, radius) for u, v in places], np.full((SIZE, SIZE), 400.0)), rng)
    found = candidates(image)
    at = nearest(found, places)
    assert np.count_nonzero(found.round) <= 1.3 * len(places)
    assert np.abs(found.uv_px[found.round][at] - places).max() < 0.3
    assert found.radius_px[found.round][at] == pytest.approx(radius, rel=0.05, abs=0.4)


@pytest.mark.parametrize("radius", [6.0, 9.0, 14.0])
def test_a_ball_starts_from_the_depth_of_its_shadow(radius: float) -> None:
    """A program that takes the step at the rim for the depth, 0.6 to 0.9 of it, fails."""
    places = grid(60, SIZE, np.random.default_rng(5))
    image = radiograph(
        quanta([Bead(u, v, radius) for u, v in places], np.full((SIZE, SIZE), 4e4)), np.random.default_rng(6)
    )
    assert candidates(image).response == pytest.approx(np.log((np.exp(-3.0) + 0.4) / 1.4), rel=0.1)


def test_among_holes_a_dark_spot_is_not_taken_for_a_ball() -> None:
    """A program that deepens it hides the holes beside it: of a perforated plate a third of the holes was lost."""
    places = grid(60, SIZE, np.random.default_rng(5))
    beads = [Bead(u, v, 6.0, depth=-0.7, ball=False) for u, v in places[1:]]
    beads.append(Bead(*places[0], 6.0, depth=0.25))
    found = candidates(radiograph(quanta(beads, np.full((SIZE, SIZE), 4e4)), np.random.default_rng(6)))
    (dark,) = found.response[found.response < 0]
    assert dark == pytest.approx(-0.085, abs=0.02)  # its step; the depth, 0.17, would be estimated as 0.15


@pytest.mark.parametrize("gap", [2.0, 0.0, -2.0, -4.0])
def test_both_beads_of_a_touching_pair_are_candidates(gap: float) -> None:
    rng = np.random.default_rng(2)
    places = grid(64, SIZE, rng)
    turn = rng.uniform(0, 2 * np.pi, len(places))
    beside = places + (7.5 + 9 + gap) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    beads = [Bead(u, v, 7.5) for u, v in places] + [Bead(u, v, 9.0) for u, v in beside]
    found = candidates(radiograph(quanta(beads, np.full((SIZE, SIZE), 400.0)), rng))
    for truth, radius in ((places, 7.5), (beside, 9.0)):
        at = nearest(found, truth)
        assert np.linalg.norm(found.uv_px[found.round][at] - truth, axis=1).max() < 1.0
        assert found.radius_px[found.round][at] == pytest.approx(radius, rel=0.12)


def test_distinct_keeps_the_better_of_a_repetition_and_both_signs() -> None:
    spots = [(50.0, 50, 9, -1), (52, 50, 8, -1), (56, 50, 8, -1), (50, 50, 4, 1), (300, 300, 9, -1)]
    assert distinct(np.array(spots, EXTREMUM)).tolist() == [True, False, True, True, True]


def test_candidates_do_not_depend_on_the_images_searched_before_or_beside() -> None:
    """A program whose smoothed images are shared by threads, or are those of an image of another size, fails."""
    rng, images = np.random.default_rng(3), []
    for size, radius in ((SIZE, 5.0), (SIZE, 8.0), (SIZE - 31, 6.0), (SIZE, 11.0)):
        beads = [Bead(u, v, radius) for u, v in grid(60, size, rng)]
        images.append(radiograph(quanta(beads, np.full((size, size), 400.0)), rng))
    alone = []
    for image in images:
        with ThreadPoolExecutor(1) as new:
            alone.append(new.submit(candidates, image).result())
    with ThreadPoolExecutor(4) as both:
        together = list(both.map(candidates, images * 8))
    for k, found in enumerate(together):
        assert np.array_equal(found.uv_px, alone[k % 4].uv_px)
        assert np.array_equal(found.sizes, alone[k % 4].sizes)


@pytest.mark.parametrize("width", [313, 316, 319])
def test_beads_beside_the_right_border_are_found_at_any_width(width: int) -> None:
    """A search that looks at whole groups of eight pixels alone misses the last ones."""
    places = np.array([[width - 13.3, v] for v in (60.2, 120.7, 180.4, 240.9)])
    light, rng = np.full((SIZE, SIZE), 400.0), np.random.default_rng(7)
    image = radiograph(quanta([Bead(u, v, 5.0) for u, v in places], light), rng)
    found = candidates(Radiograph(np.ascontiguousarray(image.pixels[:, :width]), image.white))
    assert np.abs(found.uv_px[found.round][nearest(found, places)] - places).max() < 0.3
