"""Detection against images with known truth."""

from dataclasses import replace

import numpy as np
import pytest
from bead_images import Bead, grid, normalised, quanta, radiograph

from sightline.detection import Detections, Observations, detect
from sightline.errors import DetectionRefusedError, ObservationsError

SIZE = 320


def matched(found: Detections, truth: np.ndarray, within_px: float = 2.0) -> np.ndarray:
    """Return the row of the detection nearest to each true place; fails if one has none."""
    apart = np.linalg.norm(found.uv_px[None] - truth[:, None], axis=-1)
    assert (apart.min(axis=1) < within_px).all(), truth[apart.min(axis=1) >= within_px]
    return apart.argmin(axis=1)


def flat(level: float = 400.0) -> np.ndarray:
    return np.full((SIZE, SIZE), level)


@pytest.mark.parametrize("radius", [2.2, 4.0, 7.5, 12.0, 24.0])
def test_centres_of_balls_have_no_bias_over_subpixel_phases(radius: float) -> None:
    rng = np.random.default_rng(1)
    places = grid(max(5 * radius, 40), SIZE, rng)
    expected = quanta([Bead(u, v, radius) for u, v in places], flat(4e5))
    found = detect(radiograph(expected, rng))
    error = found.uv_px[matched(found, places)] - places
    assert len(found) == len(places)
    assert np.abs(error).max() < 0.02  # px; a million quanta leave 0.001-0.005
    assert np.abs(error.mean(axis=0)).max() < 0.004
    assert set(found.kind) == {"ball"}


def test_radius_and_contrast_of_a_ball_are_those_of_the_model() -> None:
    places = grid(40, SIZE, np.random.default_rng(2))
    expected = quanta([Bead(u, v, 6.0) for u, v in places], flat(4e5), scatter=0.0)
    found = detect(radiograph(expected, np.random.default_rng(3)))
    assert found.radius_px == pytest.approx(6.0, abs=0.1)
    assert found.contrast == pytest.approx(-3.0, abs=0.3)


def test_bright_holes_are_found_and_named() -> None:
    rng = np.random.default_rng(4)
    places = grid(16, SIZE, rng)
    expected = quanta([Bead(u, v, 4.2, depth=-0.7, ball=False) for u, v in places], flat())
    found = detect(radiograph(expected, rng))
    error = found.uv_px[matched(found, places, within_px=1.0)] - places
    assert len(found) == len(places)
    assert set(found.kind) == {"hole"}
    assert np.sqrt((error**2).mean()) < 0.06


@pytest.mark.parametrize("inner", [0.45, 0.5, 0.55])
def test_washers_are_measured_at_their_outer_rim(inner: float) -> None:
    rng = np.random.default_rng(13)
    places = grid(50, SIZE, rng)
    washers = np.arange(len(places)) % 3 == 0
    beads = [
        Bead(u, v, 13.0, depth=1.0, ball=False, inner=13.0 * inner) if hollow else Bead(u, v, 8.0)
        for (u, v), hollow in zip(places, washers, strict=True)
    ]
    found = detect(radiograph(quanta(beads, flat()), rng))
    at = matched(found, places)
    assert len(found) == len(places)
    assert [found.kind[k] for k in at] == ["washer" if hollow else "ball" for hollow in washers]
    assert found.radius_px[at][washers] == pytest.approx(13.0, abs=0.8)
    error = found.uv_px[at][washers] - places[washers]
    assert np.sqrt((error**2).mean()) < 0.08


def test_a_faint_round_texture_among_beads_is_not_a_bead_but_a_thin_washer_is() -> None:
    rng = np.random.default_rng(14)
    places = grid(50, SIZE, rng)
    beads = [Bead(u, v, 8.0) for u, v in places]
    texture, washer = (places[7] + 25.0).tolist(), (places[16] + 25.0).tolist()
    beads += [Bead(*texture, 6.5, depth=0.35, ball=False), Bead(*washer, 10.0, depth=0.35, ball=False, inner=5.0)]
    found = detect(radiograph(quanta(beads, flat(2000.0)), rng))
    apart = np.linalg.norm(found.uv_px - texture, axis=1)
    assert apart.min() > 10
    assert len(found) == len(places) + 1
    assert found.kind[np.linalg.norm(found.uv_px - washer, axis=1).argmin()] == "washer"
    reasons = [r.reason for r in found.rejected if np.hypot(*np.subtract(r.uv_px, texture)) < 2]
    assert reasons == ["much fainter than the other beads"]


@pytest.mark.parametrize("level", [20.0, 120.0, 500.0])
def test_stated_covariance_is_that_of_blurred_noise(level: float) -> None:
    rng = np.random.default_rng(6)
    squares = []
    for _ in range(6):
        places = grid(40, SIZE, rng)
        expected = quanta([Bead(u, v, rng.uniform(5, 6)) for u, v in places], flat(level))
        found = detect(radiograph(expected, rng))
        at = matched(found, places)
        squares.append(normalised(found.uv_px[at] - places, found.covariance_px2[at]))
    # The standard error is 1 / sqrt(294) = 0.06 here. The noise is the image's own estimate, good to 15 % in variance.
    assert 0.75 < np.concatenate(squares).mean() < 1.25
    # White-noise formulas state a variance 2.9-8 times too small [physics.md]: the mean would be 3 and more.


def test_beads_over_a_bone_edge_a_wire_and_vignetting_are_found() -> None:
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:SIZE, :SIZE]
    bone = 0.5 * np.sqrt(np.clip(1 - ((x - 150) / 60.0) ** 2, 0, None)) + 1.5 * (np.abs(y - 0.3 * x - 60) < 3)
    fall = 1 - 0.25 * np.hypot(x - SIZE / 2, y - SIZE / 2) ** 2 / (SIZE / 2) ** 2 / 2
    places = grid(40, SIZE, rng)
    places = places[np.abs(places[:, 1] - 0.3 * places[:, 0] - 60) > 14]
    expected = quanta([Bead(u, v, 5.5) for u, v in places], 300 * np.exp(-bone) * fall)
    found = detect(radiograph(expected, rng))
    error = found.uv_px[matched(found, places)] - places
    assert len(found) == len(places)
    assert np.sqrt((error**2).mean()) < 0.08


def test_beads_before_a_saturated_background_are_found() -> None:
    rng = np.random.default_rng(8)
    places = grid(45, SIZE, rng)
    expected = quanta([Bead(u, v, 6.0) for u, v in places], flat())
    found = detect(radiograph(expected, rng, level=1.05))
    error = found.uv_px[matched(found, places)] - places
    assert len(found) == len(places)
    assert np.sqrt((error**2).mean()) < 0.06


def test_beads_inside_a_round_field_are_found_and_its_edge_is_not() -> None:
    rng = np.random.default_rng(9)
    y, x = np.mgrid[:SIZE, :SIZE]
    from_middle = np.hypot(x - SIZE / 2, y - SIZE / 2)
    places = grid(36, SIZE, rng)
    places = places[np.hypot(*(places - SIZE / 2).T) < 130]
    expected = quanta([Bead(u, v, 5.5) for u, v in places], np.where(from_middle < 150, 300.0, 0.0))
    found = detect(radiograph(expected, rng))
    matched(found, places)
    assert len(found) == len(places)


def test_overlapping_beads_are_refused_or_within_their_covariance() -> None:
    rng = np.random.default_rng(10)
    places = grid(60, SIZE, rng)
    beads = [Bead(u, v, 6.0) for u, v in places] + [Bead(u + 8.0, v + 3.0, 7.0) for u, v in places[::3]]
    found = detect(radiograph(quanta(beads, flat()), rng))
    truth = np.array([(b.u, b.v) for b in beads])
    error = np.linalg.norm(found.uv_px[:, None] - truth[None], axis=-1).min(axis=1)
    assert (error < 5 * np.sqrt(np.trace(found.covariance_px2, axis1=1, axis2=2)) + 0.05).all()
    alone = np.setdiff1d(np.arange(len(places)), np.arange(0, len(places), 3))
    matched(found, places[alone])


@pytest.mark.parametrize(("level", "seed"), [(20.0, 12), (400.0, 12), (400.0, None)])
def test_an_image_without_beads_is_refused(level: float, seed: int | None) -> None:
    """Of noise, or blank."""
    rng = None if seed is None else np.random.default_rng(seed)
    with pytest.raises(DetectionRefusedError, match=None if rng is None else "no bead was found"):
        detect(radiograph(flat(level), rng))


def test_results_do_not_hold_covariances_that_are_not_positive_definite() -> None:
    found = detect(radiograph(quanta([Bead(160.2, 159.7, 8.0)], flat()), np.random.default_rng(8)))
    for covariance in (np.zeros((2, 2)), np.array([[0.01, 0.02], [0.02, 0.01]]), -np.eye(2), [[1.0, 0.0], [1.0, 1.0]]):
        for make in (lambda c: replace(found, covariance_px2=c), lambda c: Observations("pa", ("a",), found.uv_px, c)):
            with pytest.raises(ObservationsError, match="1 of 1 beads are not positive definite"):
                make(np.array([covariance]))
