"""Shadows of a volume against exact integrals, and their derivatives against differences."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.registration import balls

from sightline.from_images.registration.align import moved
from sightline.from_images.registration.cast import RayBundle, shadow, shadow_and_derivatives
from sightline.imaging.volumes.volume import Volume


@pytest.fixture(scope="module")
def rays() -> RayBundle:
    rng = np.random.default_rng(5)
    seen = balls.view("pa", 11.0)
    return RayBundle(seen.focal_point_mm, seen.lines_of_sight(rng.uniform(90.0, 230.0, (400, 2))).directions)


def test_shadows_are_the_exact_integrals_but_for_the_walls_rims(rays: RayBundle) -> None:
    """Voxels of 0.5 mm blur the edges of the walls: 1.5 % of the longest chord, rms; 1 mm by 2.2 %."""
    exact = balls.chords(balls.POSE.apply(balls.CENTRES_MM) - rays.focal, rays.along) * balls.DENSE_PER_MM
    drawn = shadow(rays, balls.bone(voxel_mm=0.5).volume, balls.POSE)
    assert np.abs(np.median(drawn - exact)) < 0.002 * exact.max()
    assert np.sqrt(np.mean((drawn - exact) ** 2)) < 0.015 * exact.max()


def test_rays_beside_the_volume_see_nothing(rays: RayBundle) -> None:
    away = RigidTransform.from_translation([0.0, 400.0, 0.0]) * balls.POSE
    assert not shadow(rays, balls.bone().volume, away).any()


def test_derivatives_are_those_of_the_shadow(rays: RayBundle) -> None:
    """Of a smooth volume with anisotropic voxels and oblique axes, between whose samples 3 % of the rms are left.
    Shifts along the beam, which change little, count as those across it; rotations likewise."""
    at = np.stack(np.indices((60, 50, 40)), axis=-1)
    blobs = [np.exp(-(((at - m) / s) ** 2).sum(axis=-1)) for m, s in (([25, 20, 22], [9, 7, 6]), ([36, 30, 17], 6.0))]
    volume = Volume(sum(blobs), np.array([-40.0, -35.0, -38.0]), np.array([1.3, 1.4, 1.9]), balls.CT_AXES)
    centre = balls.POSE.apply([1.0, 2.0, -3.0])
    _, by_pose = shadow_and_derivatives(rays, volume, balls.POSE, centre)
    rms = np.sqrt((by_pose**2).mean(axis=0)).reshape(2, 3).max(axis=1).repeat(3)
    for k, step in enumerate([0.01, 0.01, 0.01, 0.3, 0.3, 0.3]):
        way = np.zeros(6)
        way[k] = step
        ahead, behind = (shadow(rays, volume, moved(balls.POSE, sign * way, centre)) for sign in (1, -1))
        difference = (ahead - behind) / (2 * step)
        assert np.sqrt(np.mean((difference - by_pose[:, k]) ** 2)) < 0.03 * rms[k], k
