"""A frame broken in one way fails exactly the check that is meant for it."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.common.checks import failed
from sightline.frame import Fiducial, Frame, FrameView, Plate
from sightline.frame.check import check_frame, reach_mm
from sightline.frame.designs import Beam, builtin_design

GAMMA = Frame.load("gamma")
Change = Callable[[Fiducial], Fiducial | None]


def with_plate(view: str, role: str, plate: Plate, frame: Frame = GAMMA) -> Frame:
    changed = dataclasses.replace(frame.views[view], **{role: plate})
    return dataclasses.replace(frame, views={**frame.views, view: changed})


def edited(change: Change, view: str = "pa", role: str = "xrii") -> Frame:
    """The Γ frame with the balls of one plate changed, or left out."""
    balls = (change(f) for f in getattr(GAMMA.views[view], role).fiducials)
    return with_plate(view, role, Plate(tuple(f for f in balls if f is not None)))


def at(f: Fiducial, **where: float) -> Fiducial:
    xyz = dict(zip("xyz", f.xyz_mm, strict=True)) | where
    return dataclasses.replace(f, xyz_mm=(xyz["x"], xyz["y"], xyz["z"]))


def one_view() -> Frame:
    return dataclasses.replace(GAMMA, views={"pa": GAMMA.views["pa"]})


def repeated_id() -> Frame:
    return edited(lambda f: dataclasses.replace(f, id="lateral-x-1-1") if f.id == "pa-x-1-1" else f)


def few_beads() -> Frame:
    return edited(lambda f: f if f.id[-1] in "147" and f.id[-3] in "147" else None)


def collinear() -> Frame:
    return edited(lambda f: at(f, x=f.xyz_mm[1] + f.xyz_mm[0] / 7, y=f.xyz_mm[1] + f.xyz_mm[0] / 7))


def not_flat() -> Frame:
    return edited(lambda f: at(f, z=303.0) if f.id == "pa-x-3-4" else f)


def overlapping() -> Frame:
    return edited(lambda f: at(f, x=4.0) if f.id == "pa-x-4-4" else at(f, x=8.0) if f.id == "pa-x-4-5" else f)


def two_datums() -> Frame:
    return edited(
        lambda f: dataclasses.replace(
            f, datum=f.id in ("pa-x-2-1", "pa-x-7-5"), diameter_mm=5 if f.id in ("pa-x-2-1", "pa-x-7-5") else 3
        )
    )


def datums_on_a_line() -> Frame:
    on_line = ("pa-x-2-1", "pa-x-2-4", "pa-x-2-6")
    return edited(lambda f: dataclasses.replace(f, datum=f.id in on_line, diameter_mm=5 if f.id in on_line else 3))


def small_datums() -> Frame:
    return edited(lambda f: dataclasses.replace(f, diameter_mm=3.2) if f.datum else f)


def with_pattern(view: str, plate: int, pattern: tuple[tuple[int, int], ...]) -> Frame:
    design = builtin_design("gamma")
    patterns = {name: list(pair) for name, pair in design.patterns.items()}
    patterns[view][plate] = pattern
    return Frame.from_design(dataclasses.replace(design, patterns=patterns))


def symmetric() -> Frame:
    return with_pattern("pa", 0, ((1, 1), (1, 7), (4, 4), (7, 1), (7, 7)))


def mirror_image() -> Frame:
    pattern = builtin_design("gamma").patterns["pa"][0]
    return with_pattern("lateral", 0, tuple((row, 8 - column) for row, column in pattern))


def shifted_copy_on_the_other_plate() -> Frame:
    pattern = builtin_design("gamma").patterns["pa"][0]
    return with_pattern("pa", 1, tuple((row + 1, column + 1) for row, column in pattern))


def too_close() -> Frame:
    return Frame.from_design(dataclasses.replace(builtin_design("gamma"), source_mm=260.0))


def leaning() -> Frame:
    design = builtin_design("gamma")
    leaning = Beam((0.0, 0.0, 1.0), (np.sin(np.radians(25)), 0.0, np.cos(np.radians(25))))
    return Frame.from_design(dataclasses.replace(design, pitch_mm=26.0, beams={**design.beams, "pa": leaning}))


def out_of_the_field() -> Frame:
    return Frame.from_design(dataclasses.replace(builtin_design("gamma"), pitch_mm=40.0))


def short_reach() -> Frame:
    return Frame.from_design(dataclasses.replace(builtin_design("gamma"), pitch_mm=20.0))


@pytest.mark.parametrize(
    ("broken", "name"),
    [
        (one_view, "frame-views"),
        (repeated_id, "frame-ids"),
        (few_beads, "plate-beads"),
        (collinear, "plate-collinear"),
        (not_flat, "plate-flat"),
        (overlapping, "bead-overlap"),
        (two_datums, "datum-count"),
        (datums_on_a_line, "datum-count"),
        (small_datums, "datum-size"),
        (symmetric, "datum-symmetry"),
        (mirror_image, "plate-twin"),
        (shifted_copy_on_the_other_plate, "plate-twin"),
        (too_close, "plate-spacing"),
        (leaning, "plate-tilt"),
        (out_of_the_field, "plate-field"),
        (short_reach, "wire-reach"),
    ],
)
def test_a_broken_frame_fails_the_check_meant_for_it(broken, name):
    (check,) = failed(check_frame(broken()))
    assert check.name == name
    assert check.figure is not None


def test_the_sentence_names_the_plate_and_what_to_do():
    (check,) = failed(check_frame(edited(lambda f: f if int(f.id[-1]) > 4 else None, "lateral", "source"))[-1:])
    assert check.sentence.startswith("lateral, source plate: ")
    assert "add rows" in check.sentence


def test_a_bead_behind_the_source_leaves_the_reach_unmeasured():
    view = GAMMA.views["pa"]
    far = Plate((*view.source.fiducials, Fiducial("far", (0.0, 0.0, -90000.0), 3.0)))
    assert reach_mm(FrameView(view.xrii, far), far) is None


def test_washers_are_known_by_their_shape_not_their_size():
    def washers(plate: Plate) -> Plate:
        return Plate(
            tuple(dataclasses.replace(f, shape="washer", diameter_mm=3.0) if f.datum else f for f in plate.fiducials)
        )

    views = {name: FrameView(washers(view.xrii), washers(view.source)) for name, view in GAMMA.views.items()}
    checks = check_frame(dataclasses.replace(GAMMA, views=views))
    assert failed(checks) == ()
    assert "datum-size" not in [check.name for check in checks]


@pytest.mark.parametrize(
    ("pitch_mm", "expected"), [(22.0, 66 * 620 / 920 - 95 / np.sqrt(8)), (25.0, 75 * 620 / 920 - 95 / np.sqrt(8))]
)
def test_reach_of_a_square_plate_by_hand(pitch_mm, expected):
    view = Frame.from_design(dataclasses.replace(builtin_design("gamma"), pitch_mm=pitch_mm)).view("pa")
    assert reach_mm(view, view.xrii) == pytest.approx(expected, abs=1e-9)


@settings(deadline=None, max_examples=80)
@given(seed=st.integers(0, 2**32 - 1), flatten=st.sampled_from([0.0, 1e-9, 1.0]), repeat=st.booleans())
def test_every_frame_that_a_file_can_hold_is_judged(seed, flatten, repeat):
    """Plates anywhere and anyhow, flat or not, beads on top of each other: checks come back, never an error."""
    rng = np.random.default_rng(seed)
    frame = GAMMA
    for view in GAMMA.views:
        for role in ("xrii", "source"):
            plate = getattr(frame.views[view], role)
            shape = rng.normal(size=(3, 3)) * rng.choice([0, flatten, 1], size=3)
            xyz = plate.xyz_mm @ shape + rng.choice([0, 100]) * rng.normal(size=3)
            xyz = np.repeat(xyz[::2], 2, axis=0)[: len(xyz)] if repeat else xyz
            moved = (dataclasses.replace(f, xyz_mm=tuple(at)) for f, at in zip(plate.fiducials, xyz, strict=True))
            frame = with_plate(view, role, Plate(tuple(moved)), frame)
    for check in check_frame(frame):
        assert (check.figure is not None and np.isfinite(check.figure)) or not check.passed


def test_a_plate_seen_from_its_edge_is_refused():
    def turned(f: Fiducial) -> Fiducial:
        x, y, _ = f.xyz_mm
        return dataclasses.replace(f, xyz_mm=(0.0, y, 150.0 + x))

    assert {"plate-tilt", "wire-reach"} <= {check.name for check in failed(check_frame(edited(turned, role="source")))}
