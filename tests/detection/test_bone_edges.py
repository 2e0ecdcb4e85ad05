"""Edges of round and straight bones with a cortex, in images drawn from chords of tangent rays."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sightline.detection.bone_edges import NoBoneEdgeError, find_bone_edge
from sightline.imaging import Radiograph

SIZE, FINE = 320, 3  # px; samples per pixel along each axis
SEEDS = range(14)


def _chord(beside_px: np.ndarray, radius_px: float) -> np.ndarray:
    """Length in a ball or a cylinder of rays at a distance from its middle."""
    return 2 * np.sqrt(np.clip(radius_px**2 - beside_px**2, 0.0, None))


def _image(bone: np.ndarray, blur_px: float, rng: np.random.Generator) -> Radiograph:
    """Light behind lengths in bone on the fine grid, with a background that is not even, blur and noise."""
    light = np.exp(-bone).reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3))
    u, v = np.meshgrid(np.arange(SIZE) / SIZE, np.arange(SIZE) / SIZE)
    light = gaussian_filter(light, blur_px) * (1 + 0.2 * u - 0.15 * v * v)
    return Radiograph(np.rint(20000 * light + 150 * rng.standard_normal(light.shape)).astype(np.uint16), 65535.0)


def _places() -> tuple[np.ndarray, np.ndarray]:
    at = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5
    return np.meshgrid(at, at)


def _bone(beside_px: np.ndarray, radius_px: float, rng: np.random.Generator) -> np.ndarray:
    """Attenuation by a cortex around weaker bone."""
    cortex = rng.uniform(5.0, 12.0)
    return 3e-3 * (_chord(beside_px, radius_px) - 0.7 * _chord(beside_px, radius_px - cortex))


@cache
def _ball(seed: int) -> tuple[Radiograph, np.ndarray, float]:
    rng = np.random.default_rng(seed)
    centre, radius = SIZE / 2 + rng.uniform(-4, 4, 2), rng.uniform(85, 105)
    u, v = _places()
    return (
        _image(_bone(np.hypot(u - centre[0], v - centre[1]), radius, rng), rng.uniform(1.0, 2.5), rng),
        centre,
        radius,
    )


def _fitted(image: Radiograph, centre: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Centre and radius (3,) by generalised least squares from the edge, and their covariance."""
    turns = 2 * np.pi * np.arange(int(2 * np.pi * radius)) / int(2 * np.pi * radius)
    outward = np.column_stack([np.cos(turns), np.sin(turns)])
    forms = np.column_stack([outward, np.ones(len(turns))])
    oval = np.column_stack([np.cos(2 * turns), np.sin(2 * turns)])
    edge = find_bone_edge(image, centre + radius * outward, -outward, forms, oval)
    by_variance = np.linalg.solve(edge.covariance_px2, forms[edge.at])
    covariance = np.linalg.inv(forms[edge.at].T @ by_variance)
    return np.append(centre, radius) - covariance @ by_variance.T @ edge.offset_px, covariance


def test_a_ball_s_edge_is_where_tangent_rays_touch_it_and_the_error_is_as_stated() -> None:
    """Drawn 4 px off. The steepest place lies 1 to 3 px further inside: who takes it is found out by the radius."""
    normalised = []
    for seed in SEEDS:
        image, centre, radius = _ball(seed)
        rng = np.random.default_rng(100 + seed)
        found, covariance = _fitted(image, centre + rng.uniform(-3, 3, 2), radius + rng.uniform(-3, 3))
        error = found - [*centre, radius]
        normalised.append(error / np.sqrt(np.diag(covariance)))
        assert np.abs(error).max() < 1.0
    u, v, r = np.sqrt(np.mean(np.square(normalised), axis=0))
    assert 0.85 < np.hypot(u, v) / np.sqrt(2) < 1.2
    assert 0.4 < r < 1.2  # its stated error is mostly that of real cortices, which are less even than this one


def test_both_borders_of_a_shaft_are_found_along_a_line(seed: int = 4) -> None:
    """Drawn 3 px beside it and tilted."""
    rng = np.random.default_rng(seed)
    u, _ = _places()
    image = _image(_bone(u - 155.3, 60.0, rng), 1.4, rng)
    along = np.linspace(-1.0, 1.0, 221)
    for way in (-1.0, 1.0):
        uv = np.column_stack([155.3 + way * 60.0 + 3.0 + 2.0 * along, 160 + 110 * along])
        inward = np.column_stack([np.full(221, -way), np.zeros(221)])
        edge = find_bone_edge(image, uv, inward, np.column_stack([np.ones(221), along]), along[:, None] ** 2 - 1 / 3)
        off = uv[edge.at, 0] - way * edge.offset_px - (155.3 + way * 60.0)
        assert np.abs(off).max() < 1.0
        assert np.abs(off).mean() < 3 * np.sqrt(edge.covariance_px2[0, 0])


@pytest.mark.parametrize("off_px", [-7.0, 7.0])
def test_an_edge_a_whole_number_of_pixels_away_has_no_other_edge_beyond_the_reach(off_px: float) -> None:
    """7 px beside the drawing, 5 px are left of the reach: as many as another edge must be apart. There is no place to
    look for one; a program that looks for it there ends with an error of its own."""
    rng = np.random.default_rng(6)
    u, _ = _places()
    image = _image(_bone(u - 160.0, 60.0, rng), 1.4, rng)
    along = np.linspace(-1.0, 1.0, 221)
    uv = np.column_stack([np.full(221, 100.0 - off_px), 160 + 110 * along])
    straight = np.column_stack([np.ones(221), along])
    edge = find_bone_edge(image, uv, np.tile([1.0, 0.0], (221, 1)), straight, along[:, None] ** 2 - 1 / 3)
    assert np.abs(edge.offset_px - off_px).mean() < 1.0
    assert 0.02 < edge.fall < 0.5


def test_an_edge_that_is_not_there_or_is_there_twice_is_refused() -> None:
    image, centre, radius = _ball(1)
    flat = Radiograph(np.full((SIZE, SIZE), 20000) + np.random.default_rng(3).normal(0, 150, (SIZE, SIZE)), 65535.0)
    with pytest.raises(NoBoneEdgeError, match=r"no edge|too little"):
        _fitted(flat, centre, radius)
    with pytest.raises(NoBoneEdgeError):
        _fitted(image, centre, radius - 40)
    rng = np.random.default_rng(5)
    u, v = _places()
    away = np.hypot(u - 160, v - 160)
    ring = 2e-3 * (_chord(away, 104.0) - _chord(away, 98.0))
    both = _image(3e-3 * (_chord(away, 90.0) - 0.7 * _chord(away, 84.0)) + 1.6 * ring, 1.2, rng)
    with pytest.raises(NoBoneEdgeError, match="two edges"):
        _fitted(both, np.full(2, 160.0), 96.0)
