"""`sightline plan --bone`: the checks of a registration enter the plan of the same images, and its case."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from tests.cli.picked import LANDMARKS_MM, WIRE_MM, picks_file, place, wire

import sightline as sl
from sightline.case.views import NAMES, calibrate_pair, see_pair
from sightline.common.checks import Check
from sightline.imaging import write_dicom
from sightline.planning.bone.registered import BoneView, RegisteredBone
from sightline.twin import hip_scene, render
from sightline.twin.objects.things import guide_wire

MOVED = "The bone's poses in the single views differ by 7.0 standard deviations: it moved between the images."


@pytest.fixture(scope="module")
def registered(pair: dict[str, Path], frame: sl.Frame) -> Callable[[bool], RegisteredBone]:
    """What a registration in both images leaves: of a bone at rest, or one that moved."""
    return lambda rest: registration(pair, frame, RigidTransform.identity(), rest=rest)


def registration(
    files: Mapping[str, Path], frame: sl.Frame, pose: RigidTransform, *, rest: bool = True
) -> RegisteredBone:
    """What a registration in both images leaves, known to 0.1 mm and 0.06° (1 s.d.)."""
    images = calibrate_pair(see_pair(files["pa"], files["lateral"], frame), frame, "smooth")
    views = tuple(
        BoneView(image.name, image.view.focal_point_mm, sl.read_image(files[image.name]).pixels_sha256, np.eye(4), 1.5)
        for image in images
    )
    of_views = [check.of_view(image.name) for image in images for check in image.view.checks]
    movement = Check("bone movement", rest, 1.1 if rest else 7.0, 5.2, "s.d.", MOVED)
    covariance = np.diag(np.repeat([1e-6, 0.01], 3))
    return RegisteredBone(pose.as_matrix(), pose.translation, covariance, (*of_views, movement), views, "0" * 64)


@pytest.fixture(scope="module")
def plan(pair: dict[str, Path], setup: Any, tmp_path_factory: pytest.TempPathFactory) -> list[object]:
    """A command that gives a GO."""
    folder = tmp_path_factory.mktemp("picks")
    marks = [place(setup, xyz_mm) for xyz_mm in LANDMARKS_MM]
    picks = picks_file(folder, wires={"wire": wire(setup, list(WIRE_MM))}, landmarks=marks, pick_sd_px=0.1)
    return ["plan", *(pair[name] for name in NAMES), "--picks", picks, "--procedure", "free-wire"]


def test_a_bone_that_moved_is_no_go_in_the_case_and_its_replay(run, plan, registered, tmp_path: Path) -> None:
    case, moved, rest = tmp_path / "case", tmp_path / "moved.json", tmp_path / "rest.json"
    sl.save(registered(False), moved)
    sl.save(registered(True), rest)
    still = run(*plan, "--bone", rest, "--case", case, "--json")
    assert still.code == 0, still.err
    assert still.document["go"]
    ran = run(*plan, "--bone", moved, "--case", case, "--out", tmp_path / "out", "--json")
    assert ran.code == 3, ran.err
    assert ran.document["verdict"] == "no-go"
    assert ran.failing == {"bone movement"}
    assert MOVED in (tmp_path / "out" / "plan.json").read_text()
    moved.unlink()  # the case holds what it needs
    outcomes = run("case", "replay", case, "--json").document["entries"]
    assert {one["outcome"] for one in outcomes} == {"same to the bit"}
    assert run("case", "check", case).code == 0


def test_a_bone_of_another_image_is_refused(run, plan, pair, registered, tmp_path: Path) -> None:
    file = sl.save(registered(True), tmp_path / "bone-pose.json")
    pixels = np.array(sl.read_image(pair["lateral"]).pixels)
    pixels[-1, -1] ^= 1  # where no bead is: the same geometry, and yet another image
    other = write_dicom(sl.Radiograph(pixels, sl.read_image(pair["lateral"]).white), tmp_path / "other.dcm")
    ran = run(*(other if part == pair["lateral"] else part for part in plan), "--bone", file)
    assert ran.code == 2
    assert "registered in another lateral image" in ran.said
    ran = run(*plan, "--bone", file, "--method", "localized")
    assert ran.code == 2
    assert "another calibration of it" in ran.said


def test_files_that_are_no_bone_of_these_images_are_refused(run, plan, beads_csv, registered, tmp_path: Path) -> None:
    file = sl.save(registered(False), tmp_path / "bone-pose.json")
    ran = run(*(beads_csv if str(part).endswith(".dcm") else part for part in plan), "--bone", file)
    assert ran.code == 2
    assert "a table of beads shows no bone" in ran.said
    file.write_text(file.read_text().replace('"passed": false', '"passed": true'))
    ran = run(*plan, "--bone", file)
    assert ran.code == 2
    assert "changed after it was written" in ran.said
    ran = run(
        *plan,
        "--bone",
        sl.save(sl.view_from_matrix(np.column_stack([np.eye(3), [0, 0, 600.0]])), tmp_path / "view.json"),
    )
    assert ran.code == 2
    assert "not a RegisteredBone" in ran.said


AFTER = RigidTransform.from_components([4.3, -3.7, 5.1], Rotation.from_rotvec(np.deg2rad([2.3, -1.7, 1.9])))


@pytest.mark.slow
def test_a_check_shot_in_the_bone_finds_the_wire_that_moved_with_it(
    run, plan, setup, frame, registered, tmp_path
) -> None:
    case, rng = tmp_path / "case", np.random.default_rng(8)
    before = sl.save(registered(True), tmp_path / "before.json")
    assert run(*plan, "--bone", before, "--case", case).code == 0
    scene = hip_scene(setup, rng).scene + guide_wire(AFTER.apply(WIRE_MM))
    files = {view: write_dicom(render(setup, view, scene, rng), tmp_path / f"{view}.dcm") for view in NAMES}
    now = sl.save(registration(files, frame, AFTER), tmp_path / "now.json")
    shot = ["check-shot", *files.values(), "--case", case]
    found = run(*shot, "--bone", now, "--json")
    assert found.code == 0, found.out
    off, error = found.document["deviation"], found.document["error_95"]
    assert off["entry_mm"] < error["entry_mm"] < 1.0
    assert off["tip_mm"] < error["tip_mm"] < 1.0
    without = run(*shot, "--json")
    assert without.code in (2, 3)
    assert "deviation" not in without.document or without.document["deviation"]["tip_mm"] > 3.0
    outcomes = run("case", "replay", case, "--json").document["entries"]
    assert {one["outcome"] for one in outcomes} == {"same to the bit"}
    other = run(*shot, "--bone", before)
    assert other.code == 2
    assert "registered in another pa image" in other.said
