"""Built-in frames pass; a frame broken in one way fails exactly the check that is meant for it."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.common.checks import failed
from sightline.errors import FrameError
from sightline.frame import Fiducial, Frame, FrameView, Plate, RigidBody
from sightline.frame.check import check_frame, reach_mm
from sightline.frame.designs import BUILTIN, Beam, builtin_design
from sightline.frame.drawings.part import parts_of
from sightline.frame.drawings.picture import frame_png
from sightline.frame.drawings.workshop import meshes_of
from sightline.frame.solid_shape import FIELDS_MM, clear_beads, clear_of_each_other, offset_mm, radius_mm

GAMMA, BLOCK, DETECTOR = (Frame.load(name) for name in ("gamma", "block60", "block40+detector-plate"))
DESIGN = builtin_design("gamma")
BLOCKS = ("block30", "block60", "cube120")


def with_plate(view: str, role: str, plate: Plate, frame: Frame = GAMMA) -> Frame:
    return replace(frame, views={**frame.views, view: replace(frame.views[view], **{role: plate})})


def edited(change, view: str = "pa", role: str = "xrii") -> Frame:
    """The Γ frame with the balls of one plate changed, or left out."""
    balls = (change(f) for f in getattr(GAMMA.views[view], role).fiducials)
    return with_plate(view, role, Plate(tuple(f for f in balls if f is not None)))


def at(f: Fiducial, **where: float) -> Fiducial:
    return replace(f, xyz_mm=tuple((dict(zip("xyz", f.xyz_mm, strict=True)) | where).values()))


def datums(*ids: str) -> Frame:
    return edited(lambda f: replace(f, datum=f.id in ids, diameter_mm=5 if f.id in ids else 3))


def with_pattern(view: str, plate: int, pattern: tuple[tuple[int, int], ...]) -> Frame:
    patterns = {name: list(pair) for name, pair in DESIGN.patterns.items()}
    patterns[view][plate] = pattern
    return Frame.from_design(replace(DESIGN, patterns=patterns))


def designed(**changes) -> Frame:
    return Frame.from_design(replace(DESIGN, **changes))


def block(change) -> Frame:
    """The block with its coordinates (16, 3) changed."""
    return BLOCK.with_beads_at(change(BLOCK.solid.xyz_mm.copy()))


def touching(xyz: np.ndarray) -> np.ndarray:
    xyz[1] = xyz[0] + [0.0, 6.5, 0.0]
    return xyz


def lattice() -> Frame:
    """Three sheets of three by three balls, whose rows hide one another along many directions."""
    grid = np.stack(np.meshgrid(*3 * [13.0 * np.arange(3)]), axis=-1).reshape(-1, 3)
    return Frame("lattice", {}, solid=RigidBody(tuple(Fiducial(f"k{n}", tuple(at), 5.0) for n, at in enumerate(grid))))


PATTERN = DESIGN.patterns["pa"][0]
LEANING = Beam((0.0, 0.0, 1.0), (np.sin(np.radians(25)), 0.0, np.cos(np.radians(25))))
FIRST, SECOND, *OTHERS = BLOCK.solid.fiducials


@pytest.mark.parametrize(("names", "count"), [(BUILTIN, 14), (BLOCKS, 8), ((DETECTOR.name,), 14)])
def test_built_in_frames_pass(names, count):
    for name in names:
        checks = check_frame(Frame.load(name))
        assert (failed(checks), len(checks)) == ((), count)


@pytest.mark.parametrize(
    ("broken", "name"),
    [
        (lambda: replace(GAMMA, views={"pa": GAMMA.views["pa"]}), "frame-views"),
        (lambda: edited(lambda f: replace(f, id="lateral-x-1-1") if f.id == "pa-x-1-1" else f), "frame-ids"),
        (lambda: edited(lambda f: f if f.id[-1] in "147" and f.id[-3] in "147" else None), "plate-beads"),
        (lambda: edited(lambda f: at(f, x=(s := f.xyz_mm[1] + f.xyz_mm[0] / 7), y=s)), "plate-collinear"),
        (lambda: edited(lambda f: at(f, z=303.0) if f.id == "pa-x-3-4" else f), "plate-flat"),
        (lambda: edited(lambda f: at(f, x={"4": 4.0, "5": 8.0}.get(f.id[-1], f.xyz_mm[0])) if f.id[-3] == "4" else f),
         "bead-overlap"),
        (lambda: datums("pa-x-2-1", "pa-x-7-5"), "datum-count"),
        (lambda: datums("pa-x-2-1", "pa-x-2-4", "pa-x-2-6"), "datum-count"),  # on a line
        (lambda: edited(lambda f: replace(f, diameter_mm=3.2) if f.datum else f), "datum-size"),
        (lambda: with_pattern("pa", 0, ((1, 1), (1, 7), (4, 4), (7, 1), (7, 7))), "datum-symmetry"),
        (lambda: with_pattern("lateral", 0, tuple((row, 8 - column) for row, column in PATTERN)), "plate-twin"),
        (lambda: with_pattern("pa", 1, tuple((row + 1, column + 1) for row, column in PATTERN)), "plate-twin"),
        (lambda: designed(source_mm=260.0), "plate-spacing"),
        (lambda: designed(pitch_mm=26.0, beams={**DESIGN.beams, "pa": LEANING}), "plate-tilt"),
        (lambda: designed(pitch_mm=40.0), "plate-field"),
        (lambda: designed(pitch_mm=20.0), "wire-reach"),
    ],
)  # fmt: skip
def test_broken_plates_fail_the_check_meant_for_them(broken, name):
    (check,) = failed(check_frame(broken()))
    assert (check.name, check.figure is not None) == (name, True)


@pytest.mark.parametrize(
    ("broken", "name"),
    [
        (lambda: replace(BLOCK, solid=RigidBody(BLOCK.solid.fiducials[:8])), "solid-beads"),
        (lambda: replace(BLOCK, solid=RigidBody((FIRST, replace(SECOND, id=FIRST.id), *OTHERS))), "frame-ids"),
        (lambda: block(lambda xyz: xyz * [1, 1, 0.1]), "solid-extent"),
        (lambda: block(touching), "bead-overlap"),
        (lambda: block(lambda xyz: 0.35 * xyz), "solid-clear"),
        (lattice, "solid-worst"),
        (lattice, "solid-symmetry"),
        (lambda: block(lambda xyz: 2.1 * xyz), "solid-field"),
    ],
)
def test_broken_blocks_fail_the_check_meant_for_them(broken, name):
    assert name in {check.name for check in failed(check_frame(broken()))}


def test_a_bent_and_a_symmetric_plate_on_the_detector_fail():
    first, *others = DETECTOR.detector.fiducials
    corners = {"d-3-3", "d-3-7", "d-7-3", "d-7-7"}
    square = (replace(f, datum=f.id in corners, diameter_mm=3.0 if f.id in corners else 2.0) for f in (first, *others))
    for balls, name in (((at(first, z=23.0), *others), "plate-flat"), (tuple(square), "datum-symmetry")):
        assert [check.name for check in failed(check_frame(replace(DETECTOR, detector=Plate(balls))))] == [name]


def test_the_sentence_names_the_plate_and_what_to_do():
    (check,) = failed(check_frame(edited(lambda f: f if int(f.id[-1]) > 4 else None, "lateral", "source"))[-1:])
    assert check.sentence.startswith("lateral, source plate: ")
    assert "add rows" in check.sentence


def test_washers_are_known_by_their_shape_not_their_size():
    frame = GAMMA
    for name, role, plate in GAMMA.named_plates:
        balls = (replace(f, shape="washer", diameter_mm=3.0) if f.datum else f for f in plate.fiducials)
        frame = with_plate(name, role, Plate(tuple(balls)), frame)
    checks = check_frame(frame)
    assert failed(checks) == ()
    assert "datum-size" not in [check.name for check in checks]


@pytest.mark.parametrize("pitch_mm", [22.0, 25.0])
def test_reach_of_a_square_plate_by_hand(pitch_mm):
    view = designed(pitch_mm=pitch_mm).view("pa")
    assert reach_mm(view, view.xrii) == pytest.approx(3 * pitch_mm * 620 / 920 - 95 / np.sqrt(8), abs=1e-9)
    far = Plate((*view.source.fiducials, Fiducial("far", (0.0, 0.0, -90000.0), 3.0)))
    assert reach_mm(FrameView(view.xrii, far), far) is None  # a bead behind the source


def test_a_plate_seen_from_its_edge_is_refused():
    frame = edited(lambda f: at(f, x=0.0, z=150.0 + f.xyz_mm[0]), role="source")
    assert {"plate-tilt", "wire-reach"} <= {check.name for check in failed(check_frame(frame))}


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
    ("matrix", "words"),
    [
        (np.diag([-1.0, -1.0, 1.0]), "double, rotated by 180° about z: "),
        (np.diag([1.0, -1.0, 1.0]), "double, reflected in the plane perpendicular to y: "),
        (-np.eye(3), "double, reflected through its middle: "),
    ],
)
def test_a_symmetric_solid_is_refused_by_the_name_of_its_symmetry(matrix, words):
    """A ball 0.5 mm from its image does not remove the symmetry, one 4 mm from it does."""
    half = np.add(BLOCK.solid.xyz_mm[:8], (1.0, 2.0, 3.0))
    for shift, count in ((0.0, 1.0), (0.5, 1.0), (4.0, 0.0)):
        both = np.concatenate([half, half @ matrix.T])
        both[-1, 0] += shift
        balls = tuple(Fiducial(f"k{n}", tuple(at), 3.0) for n, at in enumerate(both.tolist()))
        checks = {check.name: check for check in check_frame(Frame("double", {}, solid=RigidBody(balls)))}
        check = checks["solid-symmetry"]
        assert (check.figure, check.passed) == (count, count == 0)
        assert check.sentence.startswith(words) == (count == 1)


def test_balls_are_clear_where_their_shadows_are_a_millimetre_apart():
    """Two balls 10 mm apart along x hide each other along x and are clear along y; at an angle, by hand."""
    xyz, radius = np.array([(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (0.0, 0.0, 40.0)]), np.array([1.5, 2.5, 1.5])
    angles = np.arcsin((4.0 + np.array([0.9, 1.1])) / 10)  # between the direction and x: shadows 0.9 and 1.1 mm apart
    directions = [(1, 0, 0), (0, 1, 0), *((np.cos(a), np.sin(a), 0) for a in angles)]
    assert clear_of_each_other(xyz, radius, np.array(directions)).tolist() == [1, 3, 1, 3]
    turned = block(lambda xyz: xyz[:, [1, 2, 0]] * [1, -1, -1])  # the lattice of directions has no preferred one
    assert clear_beads(turned.solid).mean() == pytest.approx(clear_beads(BLOCK.solid).mean(), abs=0.2)


@pytest.mark.parametrize("name", BLOCKS)
def test_at_the_stated_offset_every_ball_is_just_in_the_image(name):
    """Random turns of the block at the limit: no ball leaves the cone of the field, and one comes within 3 %."""
    solid, rng = Frame.load(name).solid, np.random.default_rng(3)
    middle = (solid.xyz_mm.min(axis=0) + solid.xyz_mm.max(axis=0)) / 2
    q, r = np.linalg.qr(rng.standard_normal((2000, 3, 3)))
    turned = (solid.xyz_mm - middle) @ (q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None])
    for field in FIELDS_MM.values():
        if (offset := offset_mm(solid, field)) < 0:
            assert (name, field) == ("cube120", 140.0)
            continue
        at, slope = np.add(turned, [offset, 0.0, 620.0]), field / 2 / 620.0
        # Distance of a ball's surface from the cone, positive inside.
        left = (slope * at[..., 2] - np.hypot(at[..., 0], at[..., 1])) / np.hypot(1, slope) - solid.diameter_mm / 2
        assert left.min() > -1e-9
        assert radius_mm(solid) - left.min() > 0.97 * radius_mm(solid)


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), flatten=st.sampled_from([0.0, 1e-9, 1.0]), repeat=st.booleans())
def test_every_frame_that_a_file_can_hold_is_judged(seed, flatten, repeat):
    """Plates anywhere and anyhow, flat or not, beads on top of each other: checks come back, never an error."""
    rng = np.random.default_rng(seed)
    frame = GAMMA
    for view, role, plate in GAMMA.named_plates:
        shape = rng.normal(size=(3, 3)) * rng.choice([0, flatten, 1], size=3)
        xyz = plate.xyz_mm @ shape + rng.choice([0, 100]) * rng.normal(size=3)
        xyz = np.repeat(xyz[::2], 2, axis=0)[: len(xyz)] if repeat else xyz
        moved = (dataclasses.replace(f, xyz_mm=tuple(at)) for f, at in zip(plate.fiducials, xyz, strict=True))
        frame = with_plate(view, role, Plate(tuple(moved)), frame)
    for check in check_frame(frame):
        assert (check.figure is not None and np.isfinite(check.figure)) or not check.passed


@pytest.mark.slow
@settings(deadline=None, max_examples=15)
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
