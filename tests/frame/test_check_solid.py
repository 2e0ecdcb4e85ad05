"""The checks of a solid: the built-in blocks pass, and a block broken in one way fails the check meant for it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.common.checks import failed
from sightline.errors import FrameError
from sightline.frame import Fiducial, Frame, RigidBody
from sightline.frame.check import check_frame
from sightline.frame.drawings.part import parts_of
from sightline.frame.drawings.picture import frame_png
from sightline.frame.drawings.workshop import meshes_of
from sightline.frame.solid_shape import FIELDS_MM, clear_beads, clear_of_each_other, offset_mm, radius_mm

BLOCKS = ("block30", "block60", "cube120")
BLOCK = Frame.load("block60")


def block(change) -> Frame:
    """The block with its coordinates (16, 3) changed."""
    balls = zip(BLOCK.solid.fiducials, change(BLOCK.solid.xyz_mm), strict=True)
    moved = tuple(dataclasses.replace(f, xyz_mm=tuple(at)) for f, at in balls)
    return dataclasses.replace(BLOCK, solid=RigidBody(moved))


def few() -> Frame:
    return dataclasses.replace(BLOCK, solid=RigidBody(BLOCK.solid.fiducials[:8]))


def repeated_id() -> Frame:
    first, second, *others = BLOCK.solid.fiducials
    return dataclasses.replace(BLOCK, solid=RigidBody((first, dataclasses.replace(second, id=first.id), *others)))


def touching() -> Frame:
    def change(xyz):
        out = xyz.copy()
        out[1] = out[0] + [0.0, 6.5, 0.0]
        return out

    return block(change)


def lattice() -> Frame:
    """Four sheets of four by four balls, whose rows hide one another along many directions."""
    grid = np.stack(np.meshgrid(*3 * [13.0 * np.arange(3)]), axis=-1).reshape(-1, 3)
    return Frame("lattice", {}, solid=RigidBody(tuple(Fiducial(f"k{n}", tuple(at), 5.0) for n, at in enumerate(grid))))


@pytest.mark.parametrize("name", BLOCKS)
def test_built_in_blocks_pass(name):
    checks = check_frame(Frame.load(name))
    assert failed(checks) == ()
    assert {
        "frame-ids",
        "bead-overlap",
        "solid-beads",
        "solid-extent",
        "solid-clear",
        "solid-worst",
        "solid-field",
    } <= {check.name for check in checks}


@pytest.mark.parametrize("name", BLOCKS)
def test_balls_of_built_in_blocks_lie_as_the_search_puts_them(name):
    """3.5 mm under one face, on whole millimetres along it, 6 mm or more between the surfaces of any two."""
    solid = Frame.load(name).solid
    face = np.abs(solid.xyz_mm) == np.ptp(solid.xyz_mm, axis=0) / 2
    assert (face.sum(axis=1) == 1).all()
    along = solid.xyz_mm[~face]
    assert (along == np.round(along)).all()
    (gap,) = [check.figure for check in check_frame(Frame.load(name)) if check.name == "bead-overlap"]
    assert gap >= 6.0


@pytest.mark.parametrize(
    ("broken", "name"),
    [
        (few, "solid-beads"),
        (repeated_id, "frame-ids"),
        (lambda: block(lambda xyz: xyz * [1, 1, 0.1]), "solid-extent"),
        (touching, "bead-overlap"),
        (lambda: block(lambda xyz: 0.35 * xyz), "solid-clear"),
        (lattice, "solid-worst"),
        (lattice, "solid-symmetry"),
        (lambda: block(lambda xyz: 2.1 * xyz), "solid-field"),
    ],
)
def test_a_broken_block_fails_the_check_meant_for_it(broken, name):
    assert name in {check.name for check in failed(check_frame(broken()))}


def with_its_image(matrix: np.ndarray, shift_mm: float) -> Frame:
    """Eight balls of the block and their images under a symmetry, one of these moved."""
    half = np.add(BLOCK.solid.xyz_mm[:8], (1.0, 2.0, 3.0))
    both = np.concatenate([half, half @ matrix.T])
    both[-1, 0] += shift_mm
    balls = (Fiducial(f"k{n}", tuple(at), 3.0) for n, at in enumerate(both.tolist()))
    return Frame("double", {}, solid=RigidBody(tuple(balls)))


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([-1.0, -1.0, 1.0]), "double, rotated by 180° about z: "),
        (np.diag([1.0, -1.0, 1.0]), "double, reflected in the plane perpendicular to y: "),
        (-np.eye(3), "double, reflected through its middle: "),
    ],
)
def test_a_symmetric_solid_is_refused_by_the_name_of_its_symmetry(matrix, words):
    """A ball 0.5 mm from its image does not remove the symmetry, one 4 mm from it does."""
    for shift, count in ((0.0, 1.0), (0.5, 1.0), (4.0, 0.0)):
        found = {check.name: check for check in check_frame(with_its_image(matrix, shift))}["solid-symmetry"]
        assert (found.figure, found.passed) == (count, count == 0)
        assert found.sentence.startswith(words) == (count == 1)


def test_balls_are_clear_where_their_shadows_are_a_millimetre_apart():
    """Two balls 10 mm apart along x hide each other along x and are clear along y; at an angle, by hand."""
    xyz, radius = np.array([(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (0.0, 0.0, 40.0)]), np.array([1.5, 2.5, 1.5])
    angles = np.arcsin((4.0 + np.array([0.9, 1.1])) / 10)  # between the direction and x: shadows 0.9 and 1.1 mm apart
    directions = [(1, 0, 0), (0, 1, 0), *((np.cos(a), np.sin(a), 0) for a in angles)]
    assert clear_of_each_other(xyz, radius, np.array(directions)).tolist() == [1, 3, 1, 3]


def test_counts_do_not_depend_on_how_the_block_is_turned():
    """The lattice of directions has no preferred one: the mean is that of the turned block, to its scatter."""
    turned = block(lambda xyz: xyz[:, [1, 2, 0]] * [1, -1, -1])
    assert clear_beads(turned.solid).mean() == pytest.approx(clear_beads(BLOCK.solid).mean(), abs=0.2)


@pytest.mark.parametrize("name", BLOCKS)
def test_at_the_stated_offset_every_ball_is_just_in_the_image(name):
    """Random turns of the block at the limit: no ball leaves the cone of the field, and one comes within 3 %."""
    solid, rng = Frame.load(name).solid, np.random.default_rng(3)
    middle = (solid.xyz_mm.min(axis=0) + solid.xyz_mm.max(axis=0)) / 2
    for field in FIELDS_MM.values():
        if (offset := offset_mm(solid, field)) < 0:
            assert (name, field) == ("cube120", 140.0)
            continue
        slope = field / 2 / 620.0
        outermost = 0.0
        for _ in range(2000):
            q, r = np.linalg.qr(rng.standard_normal((3, 3)))
            at = (solid.xyz_mm - middle) @ (q * np.sign(np.diag(r))) + [offset, 0.0, 620.0]
            # Distance of a ball's centre from the cone, positive inside.
            inside = (slope * at[:, 2] - np.hypot(at[:, 0], at[:, 1])) / np.hypot(1, slope)
            left = inside - [f.diameter_mm / 2 for f in solid.fiducials]
            assert left.min() > -1e-9
            outermost = max(outermost, radius_mm(solid) - left.min())
        assert outermost > 0.97 * radius_mm(solid)


@pytest.mark.slow
@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), flatten=st.sampled_from([0.0, 1e-9, 1.0]), repeat=st.booleans())
def test_every_solid_that_a_file_can_hold_is_judged_and_drawn_or_refused(seed, flatten, repeat):
    """Balls anywhere, in a plane or on each other, of any size: checks and a picture come back, parts or a sentence."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(6, 30))
    xyz = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-2, 3) * rng.choice([0, flatten, 1], size=3)
    xyz = np.repeat(xyz[::2], 2, axis=0)[:count] if repeat else xyz
    sizes = rng.choice([0.5, 3.0, 5.0, 40.0], size=count)
    balls = (Fiducial(f"k{n}", tuple(at), float(d)) for n, (at, d) in enumerate(zip(xyz, sizes, strict=True)))
    frame = Frame("any", {}, solid=RigidBody(tuple(balls)))
    for check in check_frame(frame):
        assert (check.figure is not None and np.isfinite(check.figure)) or not check.passed
    if seed % 50 == 0:
        assert frame_png(frame).startswith(b"\x89PNG")
    try:
        meshes_of(parts_of(frame))
    except FrameError as refused:
        assert "move a ball" in str(refused)
