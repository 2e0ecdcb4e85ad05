"""Ray-casting against lengths known in closed form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.common import threads
from sightline.imaging.volumes.beam import TABLE_PER_CM, attenuation_per_mm
from sightline.imaging.volumes.rays import Rays, volume_integral
from sightline.twin.objects.things import Ball, Rod, SoftTissue, pack
from sightline.twin.xray.projector import box_length, chord

FOCAL = np.array([3.0, -7.0, -600.0])


def rays(side: int = 24, half_mm: float = 40.0) -> Rays:
    x, y = np.meshgrid(np.linspace(-half_mm, half_mm, side), np.linspace(-half_mm, half_mm, side))
    return Rays(FOCAL, np.stack([x, y, np.full_like(x, 300.0)], -1), np.ones((side, side), dtype=bool))


def directions(one: Rays) -> np.ndarray:
    d = one.points - one.focal
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def test_a_uniform_cuboid_has_the_same_length_as_volume_and_as_box():
    values = np.zeros((42, 52, 32), dtype=np.float32)
    values[1:-1, 1:-1, 1:-1] = 1.0
    origin, voxel = np.array([-20.0, -25.0, -15.0]), 1.0
    cast = volume_integral(rays(), values, origin, np.full(3, voxel))
    # A voxel's value falls to zero over one voxel length: the faces lie half a voxel outside the outermost full ones.
    box = box_length(rays(), np.array([[0.5, 0.5, 0.5]]), np.eye(3)[None], np.array([[20.0, 25.0, 15.0]]))
    # Rays that stay a voxel length off the sides.
    deep = box_length(rays(), np.array([[0.5, 0.5, 0.5]]), np.eye(3)[None], np.array([[19.0, 24.0, 15.0]])) > 29.9
    assert deep.sum() > 100
    assert np.abs(cast - box)[deep].max() < 0.05
    assert (cast[box == 0] < 0.6).all()


def test_lengths_are_the_same_to_the_bit_in_any_number_of_threads(monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(11)
    values = rng.uniform(0, 1, (30, 25, 20)).astype(np.float32)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    both = []
    for count in (1, 3):
        monkeypatch.setattr(threads, "THREADS", count)
        threads._pool.cache_clear()  # the next count takes its own
        volume = volume_integral(rays(), values, np.array([-11.0, -9.3, -8.1]), np.array([0.7, 0.8, 0.9]))
        both.append((volume, box_length(rays(), np.array([[0.3, 0.1, 2.0]]), turn[None], np.array([[9.0, 5.0, 7.0]]))))
    threads._pool.cache_clear()
    for one, other in zip(*both, strict=True):
        assert one.max() > 5.0
        np.testing.assert_array_equal(one, other)


def test_a_voxelised_ball_has_its_chord():
    side, voxel = 64, 0.75
    grid = (np.arange(side) - (side - 1) / 2) * voxel
    r = np.sqrt(grid[:, None, None] ** 2 + grid[None, :, None] ** 2 + grid[None, None, :] ** 2)
    values = np.clip((18.0 - r) / voxel + 0.5, 0, 1).astype(np.float32)
    cast = volume_integral(rays(), values, np.full(3, grid[0]), np.full(3, voxel))
    shapes, _ = pack([Ball((0.0, 0.0, 0.0), 18.0)])
    exact = np.array([[chord(FOCAL, d, shapes, 0) for d in row] for row in directions(rays())])
    assert np.abs(cast - exact)[exact > 20].max() < voxel / 3


@settings(max_examples=40, deadline=None)
@given(
    at=st.tuples(*[st.floats(-10, 10)] * 3),
    turn=st.tuples(st.floats(0, 3.1), st.floats(0, 6.2)),
    radius=st.floats(0.5, 6),
    half=st.floats(0.5, 30),
)
def test_a_cylinder_has_the_length_that_sampling_finds(at, turn, radius, half):
    axis = (np.sin(turn[0]) * np.cos(turn[1]), np.sin(turn[0]) * np.sin(turn[1]), np.cos(turn[0]))
    shapes, _ = pack([Rod(at, axis, radius, half, hole_mm=radius / 2)])
    towards = np.array(at) + np.array([0.3, 0.2, 0.1]) - FOCAL
    d = towards / np.linalg.norm(towards)
    t = np.linspace(-45, 45, 90_001) + np.linalg.norm(towards)
    gap = FOCAL + t[:, None] * d - np.array(at)
    along = gap @ axis
    across = np.linalg.norm(gap - along[:, None] * axis, axis=-1)
    sampled = 1e-3 * np.count_nonzero((np.abs(along) <= half) & (across <= radius) & (across >= radius / 2))
    assert chord(FOCAL, d, shapes, 0) == pytest.approx(sampled, abs=5e-3)


def test_a_turned_box_is_met_as_a_straight_one_is():
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    half = np.array([[8.0, 12.0, 3.0]])
    straight = box_length(rays(), np.array([[1.0, 2.0, 3.0]]), np.eye(3)[None], half)
    turned = Rays(turn @ FOCAL, rays().points @ turn.T, rays().inside)
    again = box_length(turned, np.array([turn @ [1.0, 2.0, 3.0]]), turn.T[None], half)
    assert np.allclose(straight, again, atol=1e-4)
    assert straight.max() == pytest.approx(6.0, abs=0.05)


def test_tissue_is_crossed_along_its_axes():
    body = SoftTissue(centre_mm=(-35.0, -5.0), half_mm=(140.0, 105.0))
    up = body.length_mm(np.array([-35.0, 0.0, -600.0]), np.array([[-35.0, 0.0, 300.0], [300.0, 0.0, 300.0]]))
    assert up[0] == pytest.approx(210.0)
    assert up[1] < up[0]
    across = body.length_mm(np.array([-600.0, 0.0, -5.0]), np.array([[300.0, 0.0, -5.0], [300.0, 0.0, 400.0]]))
    assert across[0] == pytest.approx(280.0)
    assert across[1] == 0.0


def test_attenuation_is_the_table_at_its_entries_and_between_them_between():
    for material, (at40, at60, _) in TABLE_PER_CM.items():
        low, middle, high = attenuation_per_mm(material)
        assert low == pytest.approx(at40 / 10)
        assert high == pytest.approx(at60 / 10)
        assert high < middle < low


def test_a_solid_displaces_what_it_is_set_into():
    _, excess = pack([Ball((0.0, 0.0, 0.0), 1.5)])
    assert np.allclose(excess[0], attenuation_per_mm("steel") - attenuation_per_mm("pmma"))
