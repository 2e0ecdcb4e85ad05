"""What is saved comes back; what was damaged, edited or is something else is refused in a sentence."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.worked import Worked

import sightline as sl
from sightline.case.interop.plan_file import PlanFile, sealed
from sightline.case.saved import document
from sightline.case.saved.models import PUBLISHED, schema_text
from sightline.common.checks import Check
from sightline.errors import UnusableInputError

SCHEMAS = Path(__file__).parents[2] / "docs" / "schemas"
MATRIX = np.array([[1000.0, 0.0, 512.0, 0.0], [0.0, 1000.0, 512.0, 0.0], [0.0, 0.0, 1.0, 600.0]])


@pytest.fixture(scope="module")
def results(worked: Worked) -> dict[str, Any]:
    bare = sl.Observations("pa", worked.observations.ids, worked.observations.uv_px)
    matrices = [sl.view_from_matrix(MATRIX), sl.view_from_matrix(MATRIX[:, [2, 1, 0, 3]], 1e-8 * np.eye(12), "other")]
    unknown = sl.reconstruct(matrices, np.full((2, 1, 2), 520.0), np.broadcast_to(np.eye(2), (2, 1, 2, 2)))
    return {
        "detections": worked.beads,
        "observations": worked.observations,
        "bare observations": bare,
        "view": worked.views[0],
        "localized": sl.calibrate(worked.observations, "gamma", method="localized", plate="source"),
        "polynomial": sl.calibrate(worked.observations, "gamma", method="polynomial", degree=4, mirrored_display=False),
        "of an arm": sl.calibrate(bare, "gamma", c_arm=sl.CArm(1000.0, 0.2)),
        "matrix": matrices[1],
        "points": worked.plan.seen,
        "points of unknown error": unknown,
        "trajectory": worked.plan.trajectory,
        "plan": worked.plan,
        "snapped plan": sl.plan(
            worked.views, worked.wire_px[:, 0], worked.wire_px[:, 1], snapped=(True, False)
        ).related((Check("parallel", False, 1.3, 1.0, "°", "Between two wires the angle is 1.3°."),)),
        "check shot": worked.shot,
    }


@pytest.fixture(scope="module")
def files(results: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("saved")
    return {name: sl.save(result, folder / f"{name}.json") for name, result in results.items()}


def assert_same(one: Any, other: Any) -> None:
    """Of beads, points and trajectories: to the last bit in every field but the image and what comes from it again."""
    for field in fields(one):
        mine, yours = getattr(one, field.name), getattr(other, field.name)
        if field.name in ("pixels", "shadows"):
            assert yours is None
        elif isinstance(mine, np.ndarray):
            assert np.ma.allequal(mine, yours) and np.array_equal(np.ma.getmaskarray(mine), np.ma.getmaskarray(yours))
        elif isinstance(mine, dict):
            assert all(np.array_equal(mine[key], yours[key]) for key in mine)
        elif isinstance(mine, sl.SpacePoints):
            assert_same(mine, yours)
        else:
            assert mine == yours


@pytest.mark.parametrize(
    "name",
    [
        "detections", "observations", "bare observations", "points", "points of unknown error", "trajectory",
    ],
)  # fmt: skip
def test_beads_points_and_trajectories_come_back(results, files, name: str) -> None:
    back = sl.load(files[name], type(results[name]))
    assert_same(results[name], back)


@pytest.mark.parametrize("name", ["view", "localized", "polynomial", "of an arm"])
def test_a_view_comes_back_as_it_was(results, files, name: str) -> None:
    view, back = results[name], sl.load(files[name])
    assert back.focal_point_mm == pytest.approx(view.focal_point_mm, abs=1e-9)
    assert (back.method, back.frame_key, back.image_shape) == (view.method, view.frame_key, view.image_shape)
    assert back.checks == view.checks
    assert (back.mirrored_display, back.c_arm) == (view.mirrored_display, view.c_arm)
    at = view.residuals.uv_px[view.residuals.used].mean(axis=0)[None]
    one, other = view.lines_of_sight(at), back.lines_of_sight(at)
    assert other.points_mm == pytest.approx(one.points_mm, abs=1e-9)
    assert sum(other.covariance.values()) == pytest.approx(sum(one.covariance.values()), rel=1e-6)
    assert np.array_equal(other.beads_near, one.beads_near)


def test_a_view_is_small_and_of_the_same_frame(results, files, worked: Worked) -> None:
    assert files["view"].stat().st_size < 120_000  # pickled it has 7 MB
    back = sl.load(files["view"])
    again = sl.reconstruct([back, worked.views[1]], worked.wire_px, np.broadcast_to(0.25 * np.eye(2), (2, 2, 2, 2)))
    assert again.xyz_mm == pytest.approx(worked.points.xyz_mm, abs=1e-9)


def test_a_matrix_s_view_comes_back(results, files) -> None:
    view, back = results["matrix"], sl.load(files["matrix"])
    xyz = np.array([[10.0, 20.0, 30.0]])
    assert back.project(xyz) == pytest.approx(view.project(xyz), abs=1e-9)
    one, other = (sum(v.lines_of_sight(view.project(xyz)).covariance.values()) for v in (view, back))
    assert other == pytest.approx(one, rel=1e-6)


@pytest.mark.parametrize("name", ["plan", "snapped plan"])
def test_a_plan_comes_back_with_its_verdict(results, files, name: str) -> None:
    plan, back = results[name], sl.load(files[name], sl.Plan)
    assert back.trajectory.points.xyz_mm == pytest.approx(plan.trajectory.points.xyz_mm, abs=1e-9)
    assert back.trajectory.covariance_mm2 == pytest.approx(plan.trajectory.covariance_mm2, rel=1e-6)
    assert [c.name for c in back.verdict.checks] == [c.name for c in plan.verdict.checks]
    assert back.verdict.state == plan.verdict.state
    assert back.landmark_names == plan.landmark_names and back.relations == plan.relations


def test_a_plan_s_file_is_a_plan_json_for_exports_and_robots(files, worked: Worked) -> None:
    read = PlanFile.read(files["plan"])
    assert read.go and read.side == worked.plan.side
    assert read.points_mm == pytest.approx(worked.plan.trajectory.points.xyz_mm)
    assert set(read.plates) == {"pa", "lateral"}
    assert len(read.document.lines_of_sight) == 4


def test_a_check_shot_comes_back(results, files) -> None:
    shot, back = results["check shot"], sl.load(files["check shot"], sl.CheckShot)
    read, known = back.document(), shot.document()
    moved, as_known = (np.array(one.pop("bone_moved")) for one in (read, known))
    assert json.dumps(read) == json.dumps(known)
    assert moved == pytest.approx(as_known, rel=0, abs=1e-15)  # a rotation is normalised when it is read
    assert np.array_equal(back.covariance_mm2, shot.covariance_mm2)


def test_the_demo_s_form_of_several_views_is_read(results, worked: Worked, tmp_path: Path) -> None:
    file = tmp_path / "views.json"
    file.write_text(json.dumps([document(view, source="1a2b.dcm") for view in worked.views]))
    assert [view.name for view in sl.load(file)] == ["pa", "lateral"]
    PUBLISHED["views"].model_validate_json(file.read_bytes())


def test_a_frame_is_saved_as_its_own_file(tmp_path: Path) -> None:
    frame = sl.Frame.load("gamma")
    assert sl.Frame.load(sl.save(frame, tmp_path / "frame.json")).fingerprint == frame.fingerprint


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_the_published_schemas_are_those_of_the_code(name: str) -> None:
    published = SCHEMAS / f"{name}.schema.json"
    assert published.read_text() == schema_text(name), "python -m sightline.case.saved docs/schemas"


def test_a_saved_trajectory_keeps_the_published_schema(files) -> None:
    PUBLISHED["trajectory"].model_validate_json(files["trajectory"].read_bytes())


def changed(file: Path, tmp_path: Path, change, *, seal: bool = True) -> Path:
    given = json.loads(file.read_text())
    change(given)
    out = tmp_path / "changed.json"
    out.write_text(json.dumps(sealed(given) if seal else given))
    return out


@pytest.mark.parametrize(
    ("name", "key", "value", "words"),
    [
        ("view", "schema", "sightline-view/2", "not one that this version reads"),
        ("view", "schema", "sightline-plan/1", "go: Field required"),
        ("view", "focal_point_mm", [0.0, 0.0, -600.0], "calibrate the image again"),
        ("view", "view", "lateral", "calibrate the image again"),
        ("view", "made_from", None, "made_from"),
        ("detections", "radius_px", [1.0], "differ in length"),
        ("detections", "kind", ["cube"], "kind"),
        ("observations", "ids", ["a"], "differ in length"),
        ("points", "xyz_mm", [[1.0, 2.0, 3.0]], "differ in number"),
        ("points", "joint_covariance_mm2", [[1.0]], "the covariance must be 15 x 15"),
        ("plan", "verdict", "no-go", "plan again"),
        ("plan", "asked", {"kind": "hip-screw"}, "not that of sightline-plan/1"),
        ("check shot", "length_mm", 0.0, "length_mm"),
        ("matrix", "matrix", [[1.0, 0.0, 0.0, 0.0]] * 3, "matrix"),
    ],
)
def test_what_does_not_hold_together_is_refused(files, tmp_path, name, key, value, words: str) -> None:
    file = changed(files[name], tmp_path, lambda given: given.update({key: value}))
    with pytest.raises(UnusableInputError, match=words):
        sl.load(file)


def test_a_file_that_was_edited_is_refused(files, tmp_path: Path) -> None:
    for name in files:
        file = changed(files[name], tmp_path, lambda given: given.update(added=1), seal=False)
        with pytest.raises(UnusableInputError, match="changed after it was written"):
            sl.load(file)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not JSON"),
        ("{", "not JSON"),
        ("[" * 100, "nested too deeply"),
        ("7", "does not name its form"),
        ("{}", "does not name its form"),
        ('{"schema": "sightline-view/1", "focal_point_mm": [NaN, 0, 0]}', "NaN is not a number; export it again"),
        ('{"schema": 1, "schema": 2}', "'schema' occurs twice"),
        ('{"schema": ["sightline-view/1"]}', "not one that this version reads"),
        ('[{"schema": "x"}]', "not one that this version reads"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "odd.json"
    file.write_text(text)
    with pytest.raises(UnusableInputError, match=words):
        sl.load(file)


def test_truncated_files_are_refused(files, tmp_path: Path) -> None:
    for name, file in files.items():
        cut = tmp_path / f"{name}.json"
        cut.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        with pytest.raises(UnusableInputError, match="not JSON"):
            sl.load(cut)


def test_another_kind_than_asked_for_is_refused(files) -> None:
    with pytest.raises(UnusableInputError, match=r"holds a Trajectory, not a Plan"):
        sl.load(files["trajectory"], sl.Plan)


def test_what_cannot_be_saved_is_said(worked: Worked, tmp_path: Path) -> None:
    with pytest.raises(UnusableInputError, match="a list cannot be saved"):
        sl.save([worked.views], tmp_path / "no.json")
    with pytest.raises(UnusableInputError, match="a Radiograph cannot be saved"):
        sl.save(worked.image, tmp_path / "no.json")
    assert not (tmp_path / "no.json").exists()
