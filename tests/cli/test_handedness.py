"""A left-handed frame file calibrates as well as the right one, and mirrors every point: the images tell."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.cli.picked import picks_file, typed

from sightline.calibration import calibrate
from sightline.case import stages
from sightline.case.journal import Actor, Case
from sightline.errors import FrameError
from sightline.frame import Frame, FrameView, Plate
from sightline.frame.model import is_mirror_image
from sightline.planning import plan

WIRE_MM = np.array([[24.0, 20.0, -8.0], [-22.0, -18.0, 10.0]])
FLIP = np.array([-1.0, 1.0])
WIDTH_PX = 1023.0


def moved(frame: Frame, move: Callable[[np.ndarray], np.ndarray]) -> Frame:
    """The frame's file with each bead elsewhere."""

    def plate(one: Plate) -> Plate:
        places = (tuple(move(xyz_mm).tolist()) for xyz_mm in one.xyz_mm)
        return Plate(tuple(dataclasses.replace(f, xyz_mm=xyz) for f, xyz in zip(one.fiducials, places, strict=True)))

    views = {name: FrameView(plate(view.xrii), plate(view.source)) for name, view in frame.views.items()}
    return dataclasses.replace(frame, views=views)


def mirrored(frame: Frame, axis: int) -> Frame:
    """The frame's file with one axis turned round: left-handed."""
    return moved(frame, lambda xyz_mm: np.where(np.arange(3) == axis, -1.0, 1.0) * xyz_mm)


def failing(checks) -> set[str]:
    return {check.name for check in checks if not check.passed}


def against(verdict) -> set[str]:
    """What stands against a plan, but for what nobody drew here."""
    return failing(verdict.checks) - {check.name for check in verdict.unmade}


def planned(observations, setup, frame: Frame, flipped: tuple[str, ...] = (), display: bool | None = None):
    """A plan through images whose displays are mirrored for the views `flipped`; a person says `display` of those."""
    views, uv = [], []
    for name in ("pa", "lateral"):
        flip = FLIP if name in flipped else np.ones(2)
        seen = observations[name]
        shown = dataclasses.replace(seen, uv_px=seen.uv_px * flip + (1 - flip) / 2 * WIDTH_PX)
        views.append(calibrate(shown, frame, mirrored_display=display if name in flipped else None))
        uv.append(setup.views[name].project(WIRE_MM) * flip + (1 - flip) / 2 * WIDTH_PX)
    return plan(views, np.array(uv)[:, 0], np.array(uv)[:, 1])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_left_handed_file_is_no_go_from_points(observations, setup, frame, axis: int) -> None:
    made = planned(observations, setup, mirrored(frame, axis))
    assert made.verdict.state == "no-go"
    # Mirrored along its beam, a view seems to be taken from the other side of the patient.
    assert against(made.verdict) == {"frame handedness"} | (set() if axis == 1 else {"view directions"})
    assert failing(made.seen.checks) == {"frame handedness"}


@pytest.mark.parametrize(
    ("flipped", "display", "go"),
    [
        ((), None, True),
        (("pa",), None, True),
        (("lateral",), None, True),
        (("pa", "lateral"), None, False),
        (("pa", "lateral"), True, True),
    ],
)
def test_mirrored_displays_are_legitimate(observations, setup, frame, flipped, display, go) -> None:
    """One view that is not mirrored shows that the file is right-handed; two that are need a person's word."""
    made = planned(observations, setup, frame, flipped, display)
    assert against(made.verdict) == (set() if go else {"frame handedness"})
    if go:
        assert np.linalg.norm(made.seen.xyz_mm - WIRE_MM, axis=1).max() < 1.0


def test_one_view_is_enough_where_a_person_says_how_it_is_displayed(observations, frame) -> None:
    """What was said and what the beads show must agree, for either handedness of the file."""
    for file, display, agrees in (
        (frame, False, True),
        (frame, True, False),
        (mirrored(frame, 0), False, False),
        (mirrored(frame, 0), True, True),  # a person who is wrong cannot be found out
    ):
        view = calibrate(observations["pa"], file, mirrored_display=display)
        assert ("frame handedness" in failing(view.checks)) != agrees
        assert view.lines_of_sight(np.array([[512.0, 512.0]])).upright == agrees


def test_the_command_line_refuses_until_it_is_confirmed(run, beads_csv: Path, setup, frame, tmp_path: Path) -> None:
    left = tmp_path / "left.json"
    mirrored(frame, 0).save(left)
    command = ["plan", beads_csv, beads_csv, *typed(setup, WIRE_MM), "--frame", left, "--json"]
    ran = run(*command)
    assert ran.code == 3
    assert ran.document["verdict"] == "no-go"
    assert "frame handedness" in ran.failing
    assert [view["mirrored"] for view in ran.document["views"]] == [True, True]
    ran = run(*command, "--picks", picks_file(tmp_path, mirrored=["lateral"]))  # said wrongly
    assert ran.document["verdict"] == "no-go"  # the lateral beam still comes from the medial side
    assert "view directions" in ran.failing and "frame handedness" not in ran.failing
    alone = ["calibrate", beads_csv, "--view", "pa", "--frame", left]
    assert run(*alone).code == 0
    ran = run(*alone, "--no-mirrored")
    assert ran.code == 3
    assert "mirror image of the frame" in " ".join(ran.out.split())


def test_a_file_is_compared_with_the_one_before_it(run, frame, tmp_path: Path) -> None:
    """The file measured again, moved as a whole and by a little each, passes. Its mirror image does not."""
    rng, turn = np.random.default_rng(0), np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    before, left = dataclasses.replace(frame, serial="03"), dataclasses.replace(mirrored(frame, 0), serial="03")
    measured = moved(before, lambda xyz_mm: turn @ xyz_mm + (12.0, -3.0, 40.0) + rng.normal(0.0, 0.05, 3))
    for name, one in (("before", before), ("left", left), ("measured", measured)):
        one.save(tmp_path / f"{name}.json")
    assert is_mirror_image(left.xyz_mm_by_id, before.xyz_mm_by_id)
    assert not is_mirror_image(measured.xyz_mm_by_id, before.xyz_mm_by_id)
    with pytest.raises(FrameError, match="mirror image"):
        Frame.load(tmp_path / "left.json", before=[before])
    for allowed in (measured, dataclasses.replace(left, serial="04")):
        allowed.save(tmp_path / "allowed.json")
        assert Frame.load(tmp_path / "allowed.json", before=[before]).key == allowed.key
    ran = run("frame", "check", tmp_path / "left.json", "--before", tmp_path / "before.json", "--json")
    told = {check["name"]: check for check in json.loads(ran.out)["checks"]}["frame-before"]
    assert ran.code == 3
    assert not told["passed"]
    assert "mirror image" in told["sentence"]
    good = run("frame", "check", tmp_path / "before.json", "--before", tmp_path / "before.json", "--json")
    assert {check["name"]: check["passed"] for check in json.loads(good.out)["checks"]}["frame-before"]


def test_beads_in_one_plane_are_their_own_mirror_image(frame) -> None:
    plate = frame.view("pa").xrii
    flat = dataclasses.replace(frame, views={"pa": FrameView(plate, plate)})
    assert not is_mirror_image(mirrored(flat, 0).xyz_mm_by_id, flat.xyz_mm_by_id)


def test_a_case_refuses_the_mirror_image_of_its_frame(frame, tmp_path: Path) -> None:
    own = dataclasses.replace(frame, name="own", serial="03")
    with Case.create(tmp_path / "case") as case:
        stages.record_changed(case, "frame", stages.keep_frame(case, own), by=Actor.APP)
        with pytest.raises(FrameError, match="mirror image"):
            stages.keep_frame(case, mirrored(own, 1))
        assert stages.keep_frame(case, own) == stages.keep_frame(case, own)
