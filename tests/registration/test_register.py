"""Registration of a bone of hollow balls, whose images are exact."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from tests.registration import balls

from sightline.calibration.exchange.pinhole import Pinhole
from sightline.common.checks import CheckCode, failed
from sightline.errors import ErrorUnknownError, UnusableInputError
from sightline.from_images.registration import BonePose, BoneStart, ScannedBone, register_bone
from sightline.from_images.registration.align import moved
from sightline.from_images.registration.clicks import AxisStart

CHI2_999 = 16.27  # of three numbers
CODES = {CheckCode.BONE_FIT, CheckCode.BONE_SHAPE, CheckCode.BONE_MOVEMENT, CheckCode.BONE_ELSEWHERE}


def start(seed: int) -> BoneStart:
    """Return a start that is off by up to 10 mm and 10° per axis."""
    off = np.random.default_rng(seed).uniform(-1, 1, 6) * np.repeat([np.deg2rad(10.0), 10.0], 3)
    return BoneStart(moved(balls.POSE, off, balls.POSE.apply(np.zeros(3))))


@cache
def found(scene: balls.Scene | None = None, seed: int = 3, **scanned: float) -> BonePose:
    scene = scene or balls.Scene()
    return register_bone(balls.bone(**scanned), scene.images(), scene.views, start(seed))


def errors_mm(pose: BonePose) -> np.ndarray:
    return np.linalg.norm(pose.at(balls.CENTRES_MM) - balls.POSE.apply(balls.CENTRES_MM), axis=1)


def codes(pose: BonePose) -> set[CheckCode]:
    return {check.code for check in failed(pose.checks)}


def test_a_start_of_two_clicks_beside_the_bone_reaches_every_rotation_about_their_axis() -> None:
    about = AxisStart(pose=balls.POSE, ends_mm=balls.POSE.apply([[60.0, 0.0, -20.0], [60.0, 0.0, 20.0]]))
    assert all(about.reaches(pose, balls.bone()) for pose in about.turned(balls.bone()))


def test_a_bone_is_found_and_its_error_is_the_stated_one() -> None:
    pose = found()
    assert pose.trusted, pose
    assert errors_mm(pose).max() < 0.15
    off = (pose.at(balls.HEAD_MM) - balls.POSE.apply(balls.HEAD_MM))[0]
    assert off @ np.linalg.solve(pose.covariance_at(balls.HEAD_MM), off) < CHI2_999
    assert 0.01 < pose.error_95_mm < 0.3


@pytest.mark.slow
def test_no_start_is_needed() -> None:
    scene = balls.Scene()
    pose = register_bone(balls.bone(), scene.images(), scene.views)
    assert pose.trusted, pose
    assert errors_mm(pose).max() < 0.3


def test_each_view_alone_states_its_error_along_the_beam() -> None:
    pose = found()
    for view in pose.views:
        own, truth = (matrix.apply(np.zeros(3)) for matrix in (RigidTransform.from_matrix(view.own_matrix), balls.POSE))
        beam = (truth - view.focal_point_mm) / np.linalg.norm(truth - view.focal_point_mm)
        assert abs((own - truth) @ beam) < 2 * view.along_beam_95_mm
        assert pose.error_95_mm < view.along_beam_95_mm < 8.0, pose


def test_three_views_are_as_good_as_two() -> None:
    scene = balls.Scene((*balls.Scene().views, balls.view("oblique", 45.0)), (balls.POSE,) * 3)
    pose = register_bone(balls.bone(), scene.images(), scene.views, start(3))
    assert pose.trusted, pose
    assert errors_mm(pose).max() < 0.15


@pytest.mark.parametrize(("share", "noticed"), [(0.4, False), (1.6, True)])
def test_movement_along_a_beam_is_noticed_from_where_the_check_states(share: float, noticed: bool) -> None:
    """No picks show it."""
    check = next(check for check in found().checks if check.code is CheckCode.BONE_MOVEMENT)
    hidden_mm = check.limit / found().apart.sigma_per_mm
    assert f"a shift of {hidden_mm:.0f} mm along a beam may not be noticed" in check.sentence
    focal = balls.Scene().views[1].focal_point_mm
    way = share * hidden_mm * focal / np.linalg.norm(focal)
    pose = found(balls.Scene().moved(RigidTransform.from_translation(way)))
    assert (CheckCode.BONE_MOVEMENT in codes(pose)) is noticed, pose


def test_movement_across_both_beams_is_noticed() -> None:
    beams = [view.focal_point_mm / np.linalg.norm(view.focal_point_mm) for view in balls.Scene().views]
    pose = found(balls.Scene().moved(RigidTransform.from_translation(1.5 * np.cross(*beams))))
    assert CheckCode.BONE_MOVEMENT in codes(pose), pose


def test_the_other_side_is_refused() -> None:
    assert codes(found(mirrored=True)) & CODES


def test_a_scan_of_another_size_is_refused_or_inside_the_stated_error() -> None:
    pose = found(size=1.03)
    assert CheckCode.BONE_MOVEMENT in codes(pose), pose


def test_an_image_of_something_else_is_refused() -> None:
    scene = balls.Scene()
    other = balls.Scene(poses=(RigidTransform.from_translation([0, 500.0, 0]),) * 2)
    pose = register_bone(balls.bone(), other.images(), scene.views, start(3))
    assert CheckCode.BONE_FIT in codes(pose), pose


def test_without_a_covariance_of_the_views_the_error_is_unknown() -> None:
    views = Pinhole.of_matrix(balls.view("pa", 3.0).matrix, "pa"), balls.Scene().views[1]
    pose = register_bone(balls.bone(), balls.Scene().images(), views, start(3))
    assert codes(pose) == {CheckCode.ERROR_KNOWN}
    with pytest.raises(ErrorUnknownError, match="covariance"):
        pose.covariance_at(balls.HEAD_MM)


def test_what_cannot_be_registered_is_refused_with_its_cause() -> None:
    scene, bone = balls.Scene(), balls.bone()
    images = scene.images()
    with pytest.raises(UnusableInputError, match="two images or more"):
        register_bone(bone, images[:1], scene.views[:1])
    far = BoneStart(RigidTransform.from_translation([0.0, 0.0, -5000.0]))
    with pytest.raises(UnusableInputError, match="place of the start"):
        register_bone(bone, images, scene.views, far)
    beside = RigidTransform.from_translation([24.0, 0.0, 0.0]) * balls.POSE  # further than the start says
    with pytest.raises(UnusableInputError, match="within 20 mm of the start"):
        register_bone(bone, images, scene.views, BoneStart(beside))
    soft = balls.scan()
    soft.hu[:] = 30
    with pytest.raises(UnusableInputError, match="no bone"):
        ScannedBone.of_ct(soft)
