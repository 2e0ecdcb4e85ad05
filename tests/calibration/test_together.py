"""The joint adjustment of a solid's images: derivatives, stated errors, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.calibration.solid_scenes import C_ARM, SHAPE, built, camera, seen

import sightline as sl
from sightline.calibration import calibrate
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.common.checks import failed
from sightline.common.geometry.planes import Plane
from sightline.detection import Observations
from sightline.errors import CalibrationRefusedError, ObservationsError
from sightline.frame import Frame, Tolerances
from sightline.planning.points.lines_of_sight import LineResiduals

BLOCK = Frame.load("block60")
TARGET_MM = np.array([[-61.3, 37.4, 33.7]])  # 80 mm from the middle of the block
AIM_MM = (-30.0, 19.0, 17.0)
VIEWS = ("pa", "lateral")


def _pair(rng, frame=BLOCK, sd_px=0.1, aim=AIM_MM):
    """Two cameras, their views and the solid as built."""
    cameras = [camera(rng, name, aim_mm=aim) for name in VIEWS]
    xyz = built(rng, frame)
    given = [seen(rng, frame, xyz, one, name, sd_px) for name, one in zip(VIEWS, cameras, strict=True)]
    return cameras, given, xyz


def _pixels(camera, xyz_mm):
    return camera.shadows(xyz_mm, np.zeros(len(xyz_mm)))[0]


@pytest.mark.parametrize("mirrored", [False, True])
def test_derivatives_of_the_camera_are_those_of_differences(mirrored):
    rng = np.random.default_rng(1)
    one = camera(rng, "lateral", mirrored=mirrored)
    xyz, radius = rng.uniform(-40.0, 40.0, (7, 3)), rng.uniform(1.0, 3.0, 7)
    plane = Plane.across(one.rotation[2], np.array([1.0, 2.0, 3.0]))
    uv, by_parameters, by_point = one.shadows(xyz, radius)

    def lines(camera):
        return np.append(camera.focal_point_mm, camera.plane_map(plane).to_plane(uv).ravel())

    by_lines = one.lines_by_parameters(plane, uv)
    for k, size in enumerate((1e-6, 1e-6, 1e-6, 1e-3, 1e-3, 1e-3, 1e-6, 1e-3, 1e-3)):
        step = size * np.eye(9)[k]
        there, back = one.moved(step), one.moved(-step)
        moved = (there.shadows(xyz, radius)[0] - back.shadows(xyz, radius)[0]) / (2 * size)
        np.testing.assert_allclose(by_parameters[:, :, k], moved, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(by_lines[:, k], (lines(there) - lines(back)) / (2 * size), rtol=1e-5, atol=1e-4)
    for axis in range(3):
        step = 1e-4 * np.eye(3)[axis]
        moved = (one.shadows(xyz + step, radius)[0] - one.shadows(xyz - step, radius)[0]) / 2e-4
        np.testing.assert_allclose(by_point[:, :, axis], moved, rtol=1e-6, atol=1e-6)


def test_a_shadow_is_centred_where_the_outline_of_the_ball_is():
    """Rays that touch the ball: their images' middle, from the outline's ends along and across."""
    one, ball, radius = camera(np.random.default_rng(2), "pa"), np.array([55.0, -48.0, 20.0]), 6.0
    at, focal = ball - one.focal_point_mm, one.focal_point_mm
    distance = np.linalg.norm(at)
    across = np.linalg.svd(at[None])[2][1:]
    angle = np.linspace(0.0, 2 * np.pi, 4000, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ across
    touching = focal + at + radius / np.sqrt(1 - (radius / distance) ** 2) * ring
    outline = _pixels(one, touching)
    middle = (outline.max(axis=0) + outline.min(axis=0)) / 2  # of an ellipse: its centre
    (centre,), _, _ = one.shadows(ball[None], np.array([radius]))
    np.testing.assert_allclose(centre, middle, atol=2e-3)
    assert np.abs(middle - _pixels(one, ball[None])[0]).max() > 0.02  # the ball's centre is elsewhere


def _line_variance_mm2(view, truth):
    """(2, 2): covariance of the target's residual in a view, mm² at the reference plane, and that residual (2,)."""
    lines = view.lines_of_sight(_pixels(truth, TARGET_MM))
    at = LineResiduals.at(lines, TARGET_MM)
    return at.to_line @ np.sum(list(lines.covariance.values()), axis=0) @ at.to_line.T, at.xy_mm[0]


@pytest.mark.slow
def test_a_view_alone_states_its_error_too():
    """60 views: the squared Mahalanobis length of two coordinates is 2 on average."""
    rng, squares = np.random.default_rng(5), []
    for _ in range(30):
        cameras, given, _ = _pair(rng)
        for one, truth in zip(given, cameras, strict=True):
            covariance, residual = _line_variance_mm2(calibrate(one, BLOCK, c_arm=C_ARM), truth)
            squares.append(residual @ np.linalg.solve(covariance, residual))
    assert abs(np.mean(squares) - 2.0) < 4 * np.sqrt(4.0 / 60)


def test_adjusting_together_is_better_than_each_alone():
    """Loose balls: two views of them tell where they are, one does not. Views calibrated alone are adjusted later."""
    frame, rng = replace(BLOCK, tolerances=Tolerances(0.2, 0.0, 0.0, 0.0, 0.0)), np.random.default_rng(4)
    cameras, given, _ = _pair(rng, frame, sd_px=0.03)
    both = calibrate_together(given, frame, [C_ARM, C_ARM])
    each = [calibrate(one, frame, c_arm=C_ARM) for one in given]
    for together, alone, truth in zip(both, each, cameras, strict=True):
        variances = [np.trace(_line_variance_mm2(view, truth)[0]) for view in (together, alone)]
        assert variances[0] < 0.95 * variances[1]
    picks = np.stack([_pixels(one, TARGET_MM) for one in cameras])
    found, later = sl.reconstruct(both, picks), sl.reconstruct(each, picks)
    np.testing.assert_array_equal(found.xyz_mm, later.xyz_mm)
    np.testing.assert_array_equal(found.joint_covariance_mm2, later.joint_covariance_mm2)


def test_without_c_arm_the_balls_alone_tell_the_focal_length():
    rng = np.random.default_rng(6)
    cameras, given, _ = _pair(rng)
    for view, one in zip(calibrate_together(given, BLOCK), cameras, strict=True):
        assert not failed(view.checks)
        off = np.abs(view.focal_point_mm - one.focal_point_mm)
        assert (off < 4 * view.focal_point_sd_mm).all()


def test_a_mirrored_image_is_seen_as_such_and_fails_until_a_person_says_so():
    rng = np.random.default_rng(7)
    one = camera(rng, "pa", aim_mm=AIM_MM, mirrored=True)
    given = seen(rng, BLOCK, built(rng, BLOCK), one, "pa")
    view = calibrate(given, BLOCK, c_arm=C_ARM)
    assert view.mirrored and not view.upright
    assert calibrate(given, BLOCK, c_arm=C_ARM, mirrored_display=True).upright


def test_few_balls_without_a_known_c_arm_are_never_taken_for_their_mirror_image():
    """Eight balls of a small block: the mirror image must be fitted to its minimum, or its misfit is overstated."""
    frame = replace(Frame.load("block30"), tolerances=Tolerances(0.1, 0.0, 0.0, 0.0, 0.0))
    refused = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        rows = np.sort(rng.permutation(12)[:8])
        turned = Rotation.random(rng=rng).apply(frame.xyz_mm + 0.1 * rng.standard_normal((12, 3)))
        turned += np.array([0.0, 0.0, 700.0])
        uv = 511.5 + 5000 * turned[:, :2] / turned[:, 2:] + 0.1 * rng.standard_normal((12, 2))
        ids, noise = tuple(frame.fiducials[k].id for k in rows), np.broadcast_to(0.01 * np.eye(2), (8, 2, 2))
        try:
            assert not calibrate(Observations("pa", ids, uv[rows], noise, image_shape=(1024, 1024)), frame).mirrored
        except CalibrationRefusedError as error:
            assert "mirror image fits as well" in str(error)
            refused.append(seed)
    assert refused == [6]  # chi-square of its mirror image is 24 above the image's; stopped early, 52


def _one(checks, name):
    return next(check for check in checks if check.name == name)


def test_a_solid_that_moved_between_the_images_is_found():
    """By 0.3 mm or 0.2°: a part of it is the pose of the C-arm, which is free; balls and target moved alike."""
    rng = np.random.default_rng(8)
    frame = replace(BLOCK, tolerances=Tolerances(0.02, 0.0, 0.0, 0.0, 0.0))
    cameras, given, xyz = _pair(rng, frame)
    views = calibrate_together(given, frame, [C_ARM, C_ARM])
    picks = np.stack([_pixels(one, TARGET_MM) for one in cameras])
    still = sl.reconstruct(views, picks)
    moved = [given[0], seen(rng, frame, xyz + np.array([0.0, 0.3, 0.0]), cameras[1], "lateral")]
    after = sl.reconstruct(calibrate_together(moved, frame, [C_ARM, C_ARM]), picks)
    assert still.gap_sigma[0] < 3.3 < after.gap_sigma[0]


def test_a_wrong_ball_is_left_out_and_named():
    rng = np.random.default_rng(9)
    _, given, xyz = _pair(rng)
    uv = given[1].uv_px.copy()
    uv[4] += (3.0, -2.0)
    views = calibrate_together([given[0], replace(given[1], uv_px=uv)], BLOCK, [C_ARM, C_ARM])
    assert views[1].residuals.left_out == ("b5",) and views[0].residuals.left_out == ()
    assert 18.0 < views[1].residuals.sigma[4] < 36.0  # 3.6 px of 0.1 px, and of the ball's own 0.02 mm, 0.17 px
    assert len(xyz) == 16


def test_balls_that_err_more_than_stated_fail_chi_square():
    rng = np.random.default_rng(10)
    loose = replace(BLOCK, tolerances=Tolerances(0.3, 0.0, 0.0, 0.0, 0.0))
    stated = replace(BLOCK, tolerances=Tolerances(0.1, 0.0, 0.0, 0.0, 0.0))
    noticed = 0
    for _ in range(20):
        _, given, _ = _pair(rng, loose)
        try:
            noticed += not _one(calibrate_together(given, stated, [C_ARM, C_ARM])[0].checks, "chi-square").passed
        except CalibrationRefusedError:
            noticed += 1
    assert noticed == 20


def test_an_intensifier_s_image_fails_the_check_of_distortion():
    rng = np.random.default_rng(11)
    _, given, _ = _pair(rng)
    middle = (np.array(SHAPE) - 1) / 2
    off = given[0].uv_px - middle
    bent = replace(given[0], uv_px=given[0].uv_px + 1.2e-7 * off * (off**2).sum(axis=1, keepdims=True))  # 5 % at 650 px
    try:
        views = calibrate_together([bent, given[1]], BLOCK, [C_ARM, C_ARM])
    except CalibrationRefusedError:
        return
    assert not _one(views[0].checks, "panel distortion").passed
    assert _one(views[1].checks, "panel distortion").passed


def test_what_cannot_be_calibrated_is_refused():
    rng = np.random.default_rng(12)
    _, given, _ = _pair(rng)
    few = Observations("pa", given[0].ids[:5], given[0].uv_px[:5], image_shape=SHAPE)
    with pytest.raises(CalibrationRefusedError, match="shows 5 balls"):
        calibrate(few, BLOCK)
    with pytest.raises(CalibrationRefusedError, match="image size"):
        calibrate(replace(given[0], image_shape=None), BLOCK)
    with pytest.raises(ObservationsError, match="same view"):
        calibrate_together([given[0], given[0]], BLOCK)
    with pytest.raises(ObservationsError, match="no fiducial 'x'"):
        calibrate(replace(given[0], ids=("x", *given[0].ids[1:])), BLOCK)
    with pytest.raises(CalibrationRefusedError, match="has plates"):
        calibrate_together([given[0]], "gamma")
    swapped = replace(given[0], ids=given[0].ids[::-1])
    with pytest.raises(CalibrationRefusedError):
        calibrate(swapped, BLOCK, c_arm=C_ARM)


def test_a_saved_view_of_a_solid_is_read_again(tmp_path):
    rng = np.random.default_rng(13)
    _, given, _ = _pair(rng)
    views = [calibrate(one, BLOCK, c_arm=C_ARM) for one in given]
    for view in views:
        again = sl.load(sl.save(view, tmp_path / f"{view.name}.json"), sl.calibration.BeadView)
        np.testing.assert_array_equal(again.focal_point_mm, view.focal_point_mm)
        assert again.method == "solid" and again.checks == view.checks
