"""A bone registered in a plan's images: a movement between them that no picks show is the plan's NO-GO."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.registration import balls

import sightline as sl
from sightline.common.checks import CheckCode, failed
from sightline.errors import UnusableInputError
from sightline.from_images.registration import BoneStart
from sightline.planning.bone.registered import RegisteredBone

WIRE_MM = np.array([[14.3, 18.7, -31.9], [-2.6, -6.1, 37.4]])  # of the CT
MARKS_MM = np.array([[3.1, 2.2, 40.7], [-13.8, 15.4, 23.3], [6.9, 14.9, -38.2]])


def moved(along: str) -> balls.Scene:
    """The bone moved before the second image by 8 mm along its beam, which no two images' picks show, or not."""
    lateral = balls.Scene().views[1].focal_point_mm
    by = 8.0 * lateral / np.linalg.norm(lateral) if along == "beam" else np.zeros(3)
    return balls.Scene().moved(RigidTransform.from_translation(by))


@cache
def registered(along: str) -> sl.BonePose:
    scene = moved(along)
    return sl.register_bone(balls.bone(), scene.images(), scene.views, BoneStart(balls.POSE))


def planned(along: str, bone: RegisteredBone | None, views: Sequence[sl.CalibratedView] | None = None) -> sl.Plan:
    """A plan with exact picks of what either image shows."""
    scene = moved(along)
    each = list(zip(scene.views, scene.poses, strict=True))
    entry, end = np.swapaxes([view.project(pose.apply(WIRE_MM)) for view, pose in each], 0, 1)
    marks = np.array([view.project(pose.apply(MARKS_MM)) for view, pose in each])
    on = views or scene.views
    return sl.plan(on, entry, end, procedure="free-wire", landmarks_uv_px=marks, pick_sd_px=0.3, bone=bone)


def test_a_movement_that_no_picks_show_is_no_go_also_after_loading(tmp_path: Path) -> None:
    assert planned("beam", None).verdict.go  # the picks agree
    pose = registered("beam")
    plan = planned("beam", pose)
    (movement,) = (check for check in pose.checks if check.code is CheckCode.BONE_MOVEMENT)
    assert plan.verdict.state == "no-go"
    assert movement in failed(plan.verdict.checks)
    assert set(failed(pose.checks)) <= set(failed(plan.verdict.checks))
    back = sl.load(sl.save(plan, tmp_path / "plan.json"), sl.Plan)
    assert back.verdict.state == "no-go"
    assert failed(back.verdict.checks) == failed(plan.verdict.checks)


def test_a_bone_at_rest_leaves_the_verdict_and_names_its_checks(tmp_path: Path) -> None:
    pose = registered("rest")
    assert pose.trusted, pose
    file = sl.save(pose, tmp_path / "bone-pose.json")
    back = sl.load(file, RegisteredBone)
    assert back.checks == pose.checks
    assert back.matrix == pytest.approx(pose.matrix, abs=0)
    assert back.covariance_at(WIRE_MM) == pytest.approx(pose.covariance_at(WIRE_MM), rel=1e-12)
    assert back.summary() == pose.summary()
    without, plan = planned("rest", None), planned("rest", back)
    assert plan.verdict.go
    assert np.array_equal(plan.trajectory.points.xyz_mm, without.trajectory.points.xyz_mm)
    own = {check.name for check in plan.verdict.checks} - {check.name for check in without.verdict.checks}
    assert own == {"bone fit", "bone shape", "bone elsewhere", "bone in field", "bone movement"}
    names = [(check.name, check.view) for check in plan.verdict.checks]
    assert names.count(("error known", "")) == 1


def test_a_registration_that_is_not_trusted_is_no_go_whatever_failed() -> None:
    pose = registered("rest")
    for name in ("bone fit", "bone shape", "bone elsewhere", "bone in field"):
        checks = tuple(replace(check, passed=check.name != name) for check in pose.checks)
        plan = planned("rest", replace(pose, checks=checks))
        assert plan.verdict.state == "no-go"
        assert {check.name for check in failed(plan.verdict.checks)} == {name}


def test_a_bone_of_other_views_is_refused() -> None:
    pose, pa = registered("rest"), balls.Scene().views[0]
    elsewhere = balls.view("lateral", 86.1)
    with pytest.raises(UnusableInputError, match=r"another image of view lateral.*1\.\d+ mm apart"):
        planned("rest", pose, (pa, elsewhere))
    only = replace(pose, views=pose.views[:1])
    with pytest.raises(UnusableInputError, match="in the views pa, and these are pa, lateral"):
        planned("rest", only)
    more = replace(pose, views=(*pose.views, replace(pose.views[0], view="oblique")))
    with pytest.raises(UnusableInputError, match="in no others"):
        planned("rest", more)


def test_an_edited_file_of_a_bone_is_refused(tmp_path: Path) -> None:
    file = sl.save(registered("beam"), tmp_path / "bone-pose.json")
    file.write_text(file.read_text().replace('"passed": false', '"passed": true'))
    with pytest.raises(UnusableInputError, match="changed after it was written"):
        sl.load(file)
