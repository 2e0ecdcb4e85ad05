"""The nail's mesh against the volume of its parts and against rays through it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sightline.errors import SetUpError
from sightline.imaging.volumes.volume import Volume
from sightline.twin.anatomy.nailed_femur import REACH_MM, SPACING_MM, TIP_MM, DistalNail
from sightline.twin.robot.drilling import Bone, Wire

NAIL = DistalNail(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, 0.0]), np.array([0.6, 0.0, 0.8]))


@pytest.mark.parametrize("bore_mm", [0.0, 4.0, 6.0])
def test_volume_is_tube_less_holes(bore_mm):
    x, z = np.meshgrid(*2 * [(np.arange(1000) + 0.5) / 1000 * 5.0 - 2.5])
    inside = x**2 + z**2 < 2.5**2
    walls = np.sqrt(5.5**2 - x**2) - np.sqrt(np.maximum((bore_mm / 2) ** 2 - x**2, 0.0))
    removed = 2 * 2 * walls[inside].sum() * 0.005**2
    tube = np.pi * (5.5**2 - (bore_mm / 2) ** 2) * (REACH_MM + SPACING_MM + TIP_MM)
    assert replace(NAIL, bore_mm=bore_mm).mesh().volume_mm3 == pytest.approx(tube - removed, rel=1e-3)  # 128 segments


def test_second_hole_follows_the_bend():
    nail = replace(NAIL, bend=np.deg2rad(2.0), bend_angle=0.0)
    (_, first), (at, second) = nail.holes
    assert np.rad2deg(np.arccos(first @ second)) == pytest.approx(2.0 * SPACING_MM / 100.0, rel=1e-3)
    assert (at - nail.hole_mm) @ nail.axis == pytest.approx(SPACING_MM**2 / 2 * np.deg2rad(2.0) / 100.0, rel=1e-3)


def test_holes_along_the_nail_are_refused():
    with pytest.raises(SetUpError):
        replace(NAIL, axis=NAIL.along)


def test_metal_is_where_the_bent_nail_has_it_and_not_in_its_holes():
    nail = DistalNail(
        np.array([3.1, -2.3, 7.7]),
        np.array([0.0, 0.8, 0.6]),
        np.array([-1.0, 0.0, 0.0]),
        bend=np.deg2rad(2.0),
        bend_angle=0.7,
    )
    rng = np.random.default_rng(4)
    own = rng.uniform([-7.0, -7.0, -30.0], [7.0, 7.0, 46.0], (4000, 3))
    rho, s = np.hypot(own[:, 0], own[:, 1]), own[:, 2]
    wall = (rho > 2.5) & (rho < 5.5) & (s < SPACING_MM + TIP_MM)
    bored = np.minimum(np.hypot(own[:, 0], s), np.hypot(own[:, 0], s - SPACING_MM)) < 2.5
    clear = np.abs(rho - 2.5) > 1e-6  # as near as both maps agree
    np.testing.assert_array_equal(nail.inside(nail.placed(own))[clear], (wall & ~bored)[clear])
    assert 0.3 < wall.mean() < 0.6
    assert (wall & bored).sum() > 20


@pytest.mark.parametrize(("aside_mm", "touches"), [(0.0, False), (0.4, False), (0.6, True)])
def test_a_drill_of_4_mm_passes_a_hole_of_5_mm_or_is_stopped_by_its_wall(aside_mm: float, touches: bool):
    """As the force tells: metal is not cut, so the thrust rises by 100 N for each mm of feed."""
    nail = DistalNail(np.array([0.0, 0.0, 20.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    shaft = Volume(np.ones((20, 20, 6)), np.array([-10.0, -10.0, 5.0]), np.full(3, 1.0))
    wire = Wire(Bone((shaft,), RigidTransform.identity(), nail.inside), 4.0)
    felt = {}
    for feed in np.arange(0.0, 30.0, 0.02):
        felt[feed] = wire.step(np.array([aside_mm, 0.0, feed]), np.eye(3), feed, True, 0.02)
    in_nail = [force for feed, force in felt.items() if 14.0 < feed < 16.5]
    assert (max(in_nail) > 80.0) is touches
    if not touches:
        assert max(force for feed, force in felt.items() if feed > 14.0) == 0.0
        assert wire.tip_mm[2] > 29.0
