"""The magnetic field at a tube that turns with the arm: earth, steel, shield; what it does to the image."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sightline.errors import SetUpError, UnusableInputError
from sightline.twin import Variation, draw_setup
from sightline.twin.xray.distributions import Distortion, Pose
from sightline.twin.xray.presets import preset
from sightline.twin.xray.tubes import PLACES, Site, Steel, Tube, earth_ut, field_at

CHAIN = preset("9in-1k")
MAGNETIC_ONLY = replace(Distortion(), asymmetric_mm=0.0, beyond_degree5_mm=(0.0, 0.0))
UPRIGHT = Pose(
    frame_tilt=0.0, orbit=0.0, in_plane=0.0, hip_offset_mm=0.0, piercing_mm=0.0, sdd_mm=0.0, detector_tilt=0.0
)
PA = np.eye(3)
LATERAL = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def centre_mm(image) -> np.ndarray:
    """Where the middle of the input plane is seen, mm."""
    return (image.to_image(np.zeros(2)) - image.centre_px) * image.chain.pitch_mm


def test_a_turn_by_90_degrees_moves_the_image_as_the_paper_saw(frame):
    """Fig. 13: 2-3 mm at Loughborough, at any heading of the table; 1.0 mm of it in PA, 2.5 in lateral."""
    moves = []
    for k in range(12):
        variation = Variation(UPRIGHT, MAGNETIC_ONLY, Site(heading=0.31 + k * np.pi / 6))
        setup = draw_setup(np.random.default_rng(k), frame, frame_errors=False, variation=variation)
        at = {name: centre_mm(view.intensifier) for name, view in setup.views.items()}
        stretch = 1 / (1 + setup.views["pa"].intensifier.distortion.k1 * 107.5**2)
        assert np.linalg.norm(at["pa"]) == pytest.approx(0.055 * np.hypot(1.3, 18.6) * stretch, rel=0.001)
        moves.append(np.linalg.norm(at["lateral"] - at["pa"]))
    assert 2.0 < np.median(moves) < 3.0
    assert min(moves) > 1.2
    assert max(moves) < 3.6


def test_the_field_turns_the_image_along_the_tube_and_shifts_it_across():
    tube = Tube(CHAIN, 107.5, MAGNETIC_ONLY, 4.4e-6, 1e-3, np.zeros((7, 2)))
    rng = np.random.default_rng(1)
    along = tube.expose(rng, PA, (np.array([0.0, 0.0, 30.0]), np.zeros((3, 3)))).distortion
    assert along.turn == pytest.approx([0.030, 0.0, 0.0])
    assert np.abs(along.shift_mm).max() == 0
    across = tube.expose(rng, PA, (np.array([30.0, 0.0, 0.0]), np.zeros((3, 3)))).distortion
    assert np.abs(across.turn).max() == 0
    assert across.shift_mm[:, 0] == pytest.approx([0.0, 30 * 0.055])  # z x B


def test_turning_tube_and_field_together_changes_nothing():
    site = Site("boston", 0.7, steel=(Steel((310.0, -220.0, 480.0), 120.0),))
    field, gradient = field_at(site, np.array([30.0, 20.0, 380.0]))
    tube = Tube(CHAIN, 107.5, MAGNETIC_ONLY, 4.4e-6, 1e-3, np.zeros((7, 2)))
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    rng = np.random.default_rng(2)
    one = tube.expose(rng, LATERAL, (field, gradient)).distortion
    two = tube.expose(rng, LATERAL @ turn.T, (turn @ field, turn @ gradient @ turn.T)).distortion
    assert two.turn == pytest.approx(one.turn, abs=1e-12)
    assert two.shift_mm == pytest.approx(one.shift_mm, abs=1e-12)
    assert np.abs(one.shift_mm[:, 1:]).max() > 0.01  # uneven: a gradient


def test_the_earth_turns_against_the_table():
    east, north, up = PLACES["sydney"]
    assert earth_ut("sydney", 0.0) == pytest.approx([north, -east, up])  # X to the north, Y to the west
    assert earth_ut("sydney", np.pi / 2) == pytest.approx([east, north, up])  # X to the east, Y to the north


def test_steel_makes_the_field_uneven_as_a_magnetised_ball_does():
    lump = Steel((-260.0, 130.0, -75.0), 150.0)
    site, at, step = Site("loughborough", 1.1, steel=(lump,)), np.array([61.0, -42.0, 378.0]), 0.01
    field, gradient = field_at(site, at)
    numeric = [(field_at(site, at + step * e)[0] - field_at(site, at - step * e)[0]) / (2 * step) for e in np.eye(3)]
    assert gradient == pytest.approx(np.stack(numeric, axis=-1), abs=1e-8)
    assert gradient == pytest.approx(gradient.T, abs=1e-12)
    assert abs(np.trace(gradient)) < 1e-12
    # On the ball's own axis the field outside is three times the earth's at its surface.
    earth = earth_ut("loughborough", 1.1)
    pole = np.array(lump.at_mm) + (150.0 + 1e-6) * earth / np.linalg.norm(earth)
    assert field_at(site, pole)[0] == pytest.approx(3 * earth, rel=1e-6)
    assert 0.5 < np.linalg.norm(field - earth) < 10.0


def test_a_shield_leaves_its_share():
    steel = (Steel((300.0, 0.0, 0.0), 100.0),)
    at = np.array([0.0, 0.0, 380.0])
    bare, held = (field_at(Site("tromso", 0.4, shield, steel), at) for shield in (1.0, 0.25))
    assert held[0] == pytest.approx(0.25 * bare[0])
    assert held[1] == pytest.approx(0.25 * bare[1])


def test_a_site_does_not_move_a_flat_panel(frame):
    variation = Variation(UPRIGHT, MAGNETIC_ONLY, Site("tromso"))
    setup = draw_setup(np.random.default_rng(3), frame, chain="flat-panel", variation=variation)
    assert centre_mm(setup.views["lateral"].intensifier) == pytest.approx([0.0, 0.0])


def test_bad_input():
    with pytest.raises(UnusableInputError, match="loughborough"):
        earth_ut("atlantis", 0.0)
    with pytest.raises(SetUpError, match="share"):
        field_at(Site(shield=1.2), np.zeros(3))
    with pytest.raises(SetUpError, match="outside"):
        field_at(Site(steel=(Steel((0.0, 0.0, 50.0), 60.0),)), np.zeros(3))
