"""A bone registered in a plan's images: a movement between them that no picks show is the plan's NO-GO.

Registered again after drilling, it tells where the wire is in the bone.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from tests.planning.shots import Wire
from tests.registration import balls

import sightline as sl
from sightline.common.checks import CheckCode, failed
from sightline.errors import UnusableInputError
from sightline.from_images.registration import BoneStart
from sightline.planning.bone.registered import RegisteredBone
from sightline.planning.check.shot import check_shot
from sightline.planning.check.wires import STILL, by_bone

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


# How bone and wire move together between the plan and the check; how far the wire is drilled beside its plan.
AFTER = RigidTransform.from_components([5.3, -3.7, 4.1], Rotation.from_rotvec(np.deg2rad([2.3, -1.7, 1.9])))
ASIDE_MM, DEEPER_MM, SD_PX = np.array([0.63, -0.41]), 1.37, 0.1
CHI2_999 = 20.5  # of five numbers


@cache
def registered_after() -> sl.BonePose:
    views = balls.view("pa", -2.0), balls.view("lateral", 83.0)
    scene = balls.Scene(views, (AFTER * balls.POSE,) * 2)
    return sl.register_bone(balls.bone(), scene.images(2), views, BoneStart(AFTER * balls.POSE))


def drilled(plan: sl.Plan, views: Sequence[sl.CalibratedView]) -> list[Wire]:
    """What the check images show of a straight wire beside the plan in the bone, which moved with it."""
    entry, end = balls.POSE.apply(WIRE_MM)
    axes = np.linalg.svd((end - entry)[None])[2][1:]
    length = np.linalg.norm(end - entry)
    along = np.linspace(-5.0, length + DEEPER_MM, 60)[:, None]
    line = AFTER.apply(entry + ASIDE_MM @ axes + along * (end - entry) / length)
    noise = np.random.default_rng(4)
    wires = []
    for view in views:
        uv = view.project(line) + noise.normal(0.0, SD_PX, (len(line), 2))
        wires.append(Wire(uv[:-1], np.full(len(line) - 1, SD_PX**2), uv[-1], SD_PX**2))
    return wires


def test_a_wire_is_compared_with_its_plan_in_the_bone_however_that_moved() -> None:
    before, now = registered("rest"), registered_after()
    views = [shot.view for shot in now.shots]
    plan = planned("rest", before)
    wires, ends = drilled(plan, views), plan.trajectory.points.xyz_mm
    true = np.array([*ASIDE_MM, *ASIDE_MM, DEEPER_MM])
    shot = check_shot(plan.to_check(), views, wires, known=by_bone(before, now, ends, views))
    off = shot.deviation_mm - true
    assert np.abs(off).max() < 0.3
    assert off @ np.linalg.solve(shot.covariance_mm2, off) < CHI2_999
    assert shot.tip_error_95_mm < 0.6  # known well enough for a limit of 1 mm
    assert {check.name for check in failed(shot.checks)} == {"wire tip"}  # it is 1.6 mm off
    assert "bone landmarks" not in {check.name for check in shot.checks}
    without = check_shot(plan.to_check(), views, wires, known=STILL)
    assert np.linalg.norm(without.deviation_mm - true) > 4.0


def test_a_registration_that_failed_fails_the_check_shot() -> None:
    before, now = registered("rest"), registered_after()
    views = [shot.view for shot in now.shots]
    plan = planned("rest", before)
    for which in ("plan", "check"):
        bones = [
            replace(bone, checks=tuple(replace(c, passed=c.name != "bone fit" or name != which) for c in bone.checks))
            for name, bone in (("plan", before), ("check", now))
        ]
        known = by_bone(bones[0], bones[1], plan.trajectory.points.xyz_mm, views)
        shot = check_shot(plan.to_check(), views, drilled(plan, views), known=known)
        assert {check.name for check in failed(shot.checks)} == {"wire tip", "bone fit"}


def test_the_error_of_the_movement_is_that_of_both_registrations() -> None:
    """The covariance is that of drawn errors; 4,000 draws tell it to 0.02 of the variances (1 s.d.)."""
    rng = np.random.default_rng(5)
    at, scale = balls.POSE.apply(WIRE_MM).mean(axis=0), np.repeat([1e-3, 0.3], 3)
    before, now = (
        replace(pose, covariance=np.outer(scale, scale) * spread, centre_mm=centre)
        for pose, spread, centre in zip(
            (registered("rest"), registered_after()),
            (np.cov(rng.normal(size=(6, 12))) for _ in range(2)),
            ([31.0, -12.0, 8.0], [-9.0, 44.0, 17.0]),
            strict=True,
        )
    )
    movement, covariance = before.movement_to(now, at)
    poses = []
    for bone in (before, now):
        assert bone.covariance is not None
        step = rng.multivariate_normal(np.zeros(6), bone.covariance, 4000)
        about = RigidTransform.from_translation(bone.centre_mm)
        wrong = RigidTransform.from_components(step[:, 3:], Rotation.from_rotvec(step[:, :3]))
        poses.append(about * wrong * about.inv() * bone.pose)
    wrong = poses[1] * poses[0].inv()
    turned = (wrong * movement.inv()).rotation.as_rotvec()
    drawn = np.hstack([turned, wrong.apply(at) - movement.apply(at)])
    sd = np.sqrt(np.diag(covariance))
    assert np.cov(drawn.T) / np.outer(sd, sd) == pytest.approx(covariance / np.outer(sd, sd), abs=0.08)


def test_a_bone_of_another_scan_or_of_other_images_tells_no_movement() -> None:
    before, now = registered("rest"), registered_after()
    ends, views = balls.POSE.apply(WIRE_MM), [shot.view for shot in now.shots]
    with pytest.raises(UnusableInputError, match="another CT or mesh"):
        by_bone(replace(before, volume_sha256=balls.bone(size=1.01).sha256), now, ends, views)
    with pytest.raises(UnusableInputError, match="another image of view pa"):
        by_bone(before, before, ends, views)
    with pytest.raises(UnusableInputError, match="plan again with it"):
        by_bone(None, now, ends, views)
    assert balls.bone().sha256 == now.volume_sha256 != balls.bone(mirrored=True).sha256
