"""A block on an arm's flange, by images of a C-arm at rest: its place, its error, and what is left out or refused."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.scenes.held import SD, c_arm, error, seen, true_mount
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from sightline.calibration.solids.held import calibrate_held
from sightline.common.checks import failed
from sightline.errors import CalibrationRefusedError, ObservationsError, RobotRefusedError
from sightline.frame import Frame
from sightline.from_images.arm import calibrated_on_arm
from sightline.rehearsal.arm_images import BlockOnArm, sample_block

BLOCK = sample_block()


def drawn(seed: int):
    """The set-up, its images, and the stated poses as a list."""
    rng = np.random.default_rng(seed)
    held = BlockOnArm.draw(rng, BLOCK)
    return held, seen(held, rng), list(held.stated)


def found(held, images, poses, frame=BLOCK, known=True):
    return calibrate_held(images, frame, RigidTransform.concatenate(poses), SD, c_arm(held) if known else None)


def knocked(pose, mm=1.0):
    return pose * RigidTransform.from_translation([0.0, 0.6 * mm, 0.8 * mm])


def squares(seeds) -> list[float]:
    """Squared lengths of the mounts' errors over their covariance."""
    lengths = []
    for seed in seeds:
        held, images, poses = drawn(seed)
        done = found(held, images, poses)
        assert not done.bad
        assert not failed(done.checks)
        pose, covariance = done.fit.mount()
        twist, mm, deg = error(true_mount(held), pose)
        assert mm < 0.2
        assert deg < 0.04
        lengths.append(twist @ np.linalg.solve(covariance, twist))
    return lengths


def test_the_block_s_place_is_found_within_its_stated_error():
    """Four set-ups; 24 numbers in 99.98 % of cases lie in this interval."""
    assert chi2.ppf(1e-4, 24) < sum(squares(range(4))) < chi2.ppf(1 - 1e-4, 24)


def test_nothing_need_be_known_of_the_c_arm():
    held, images, poses = drawn(11)
    pose, _ = found(held, images, poses, known=False).fit.mount()
    assert error(true_mount(held), pose)[1] < 0.2


def test_the_c_arm_is_found_in_the_base():
    """Its source is within 5 mm; the C-arm's nominal distance has an error of 10 mm."""
    held, images, poses = drawn(12)
    done = calibrated_on_arm(images, BLOCK, RigidTransform.concatenate(poses), SD, c_arm(held))
    start = RigidTransform.from_matrix((held.true[0] * held.mount * held.motion(0).inv()).as_matrix())
    true = start.apply(held.setup.views["pa"].focal_point_mm)
    assert np.linalg.norm(done.T_base_camera.translation - true) < 5.0


@pytest.mark.parametrize("spoil", ["knock", "far", "turn", "exchange"])
def test_images_at_wrong_poses_are_left_out_and_named(spoil):
    held, images, poses = drawn(13)
    wrong = ["image 4"]
    if spoil == "exchange":
        poses[3], poses[8], wrong = poses[8], poses[3], ["image 4", "image 9"]
    elif spoil == "turn":
        poses[3] = poses[3] * RigidTransform.from_exp_coords([0.0, 0.0, 0.7, 0.0, 0.0, 0.0])
    else:
        poses[3] = knocked(poses[3], 0.3 if spoil == "knock" else 50.0)
    done = found(held, images, poses)
    assert sorted(done.bad) == wrong
    assert not failed(done.checks)
    pose, covariance = done.fit.mount()
    twist = error(true_mount(held), pose)[0]
    assert twist @ np.linalg.solve(covariance, twist) < chi2.ppf(0.9999, 6)
    if spoil == "knock":
        assert done.bad["image 4"].shift_mm == pytest.approx(0.3, abs=0.15)


def test_a_ball_at_a_wrong_place_is_left_out_and_named():
    held, images, poses = drawn(14)
    uv = images[5].uv_px.copy()
    uv[7] += 3.0
    images[5] = replace(images[5], uv_px=uv)
    done = found(held, images, poses)
    assert done.balls == {"image 6": [images[5].ids[7]]}
    assert not done.bad


@pytest.mark.parametrize("spoil", ["half", "end", "inaccurate", "cyclic", "metres"])
def test_what_contradicts_itself_is_refused(spoil):
    held, images, poses = drawn(15)
    if spoil == "half":  # a knock between images 6 and 7
        poses[6:] = [knocked(pose) for pose in poses[6:]]
    elif spoil == "end":  # only the first ten agree: the block is elsewhere now
        poses[10:] = [knocked(pose) for pose in poses[10:]]
    elif spoil == "inaccurate":
        noise = 4 * SD * np.random.default_rng(1).standard_normal((len(poses), 6))
        poses = [pose * RigidTransform.from_exp_coords(twist) for pose, twist in zip(poses, noise, strict=True)]
    elif spoil == "cyclic":
        poses = [*poses[1:], poses[0]]
    else:
        poses = [RigidTransform.from_components(pose.translation / 1000, pose.rotation) for pose in poses]
    with pytest.raises(CalibrationRefusedError, match="the last image" if spoil == "end" else "contradict"):
        found(held, images, poses)


@pytest.mark.parametrize("turned, size", [(3, 1.0), (0, 1.02)])
def test_another_block_is_refused(turned, size):
    """Balls of the same names at other places, or of a larger block."""
    held, images, poses = drawn(16)
    other = BLOCK.with_beads_at(size * np.roll(BLOCK.xyz_mm, turned, axis=0))
    with pytest.raises(CalibrationRefusedError):
        found(held, images, poses, frame=replace(other, name="other"))


def test_poses_that_rotate_about_one_axis_are_refused():
    held, images, poses = drawn(18)
    rotated = [
        RigidTransform.from_components(pose.translation, RigidTransform.from_exp_coords([0, 0, a, 0, 0, 0]).rotation)
        for pose, a in zip(poses, np.linspace(-0.5, 0.5, len(poses)), strict=True)
    ]
    with pytest.raises(RobotRefusedError, match="too alike"):
        calibrated_on_arm(images, BLOCK, RigidTransform.concatenate(rotated), SD, c_arm(held))


def test_too_few_images_and_plates_are_refused():
    held, images, poses = drawn(19)
    with pytest.raises(ObservationsError, match="8 images"):
        found(held, images[:7], poses[:7])
    with pytest.raises(CalibrationRefusedError, match="plates"):
        found(held, images, poses, frame=Frame.load("gamma"))
    images[2] = replace(images[2], image_shape=(1024, 1024))
    with pytest.raises(ObservationsError, match="size"):
        found(held, images, poses)
