"""An arm calibrated by images: the commands of the page, and lists that are refused."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.scenes.held import error, true_mount
from scipy.spatial.transform import RigidTransform
from tests.cli.test_robot import run
from tests.robot.arms import SIX

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.from_images.arm import ArmImages
from sightline.rehearsal.arm_images import START, BlockOnArm, sample_block

POSE = START.as_matrix().tolist()
LISTED: dict[str, Any] = {
    "schema": "sightline-arm-images/1",
    "robot_serial": "R-1",
    "frame": "block60",
    "measured_on": "2026-11-29T10:00:00Z",
    "pose_sd": {"mm": 0.03, "rad": 1e-4},
    "images": [{"file": f"{k}.dcm", "T_base_flange": POSE} for k in range(8)],
}


def listed(folder: Path, **changes) -> Path:
    file = folder / "images.json"
    file.write_text(json.dumps(LISTED | changes))
    return file


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"schema": "sightline-arm-images/9"}, "schema"),
        ({"images": LISTED["images"][:7]}, "images"),
        ({"images": [*LISTED["images"][:7], LISTED["images"][0]]}, "lists an image twice"),
        ({"images": [{"file": "0.dcm", "T_base_flange": [[2, 0, 0, 0], *POSE[1:]]}] * 8}, "not a rigid motion"),
        ({"images": [{"file": f"{k}.dcm", "q": [0.0] * 6} for k in range(8)]}, "q of each image and the arm"),
        ({"arm": "six-axis"}, "q of each image and the arm"),
        ({"pose_sd": {"mm": 0.0, "rad": 1e-4}}, "pose_sd.mm"),
        ({"pose_sd": {"mm": 0.03}}, "pose_sd.rad"),
    ],
)
def test_a_list_that_is_wrong_is_refused(tmp_path, changes, said):
    with pytest.raises(UnusableInputError, match=said):
        ArmImages.read(listed(tmp_path, **changes))


def test_a_list_reads_its_poses(tmp_path):
    read = ArmImages.read(listed(tmp_path))
    assert read.poses_in(tmp_path).as_matrix() == pytest.approx(np.array([POSE] * 8))
    assert read.frame_in(tmp_path).name == "block60"
    at = [{"file": f"{k}.dcm", "q": [0.1 * k, -1.0, 0.4, 0.3, 0.2, 0.1]} for k in range(8)]
    poses = ArmImages.read(listed(tmp_path, arm="six-axis", images=at)).poses_in(tmp_path)
    assert poses[3].as_matrix() == pytest.approx(SIX.T_mcs_flange(np.array(at[3]["q"])).as_matrix())
    in_degrees = [{**image, "q": np.rad2deg(image["q"]).tolist()} for image in at]
    with pytest.raises(RobotRefusedError, match=r"joints in rad and mm.*at 0\.dcm joint 2 is at -3282\.8°"):
        ArmImages.read(listed(tmp_path, arm="six-axis", images=in_degrees)).poses_in(tmp_path)
    with pytest.raises(UnusableInputError, match=r"\(\.\.\., 6\)"):
        ArmImages.read(listed(tmp_path, arm="six-axis", images=[{**i, "q": i["q"][:5]} for i in at])).poses_in(tmp_path)


def test_one_source_is_asked_for(tmp_path):
    assert run("calibrate").exit_code == 2
    both = run("calibrate", listed(tmp_path), "--simulated", tmp_path)
    assert "--from-images or --simulated" in both.output.replace("\n", " ")


@pytest.fixture(scope="module")
def sample(few_pixels: None, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("arm")
    assert run("calibrate", "--simulated", folder).exit_code == 0
    return folder


@pytest.mark.slow
def test_the_sample_images_give_the_mount(sample, tmp_path):
    out = tmp_path / "mount.json"
    done = run("calibrate", "--from-images", sample / "images.json", "--out", out, "--json")
    assert done.exit_code == 0, done.output
    found = json.loads(out.read_text())
    held = BlockOnArm.draw(np.random.default_rng(1), sample_block())
    pose = RigidTransform.from_matrix(found["T_flange_cfcs"])
    twist, mm, _ = error(true_mount(held), pose)
    assert twist @ np.linalg.solve(np.array(found["covariance"]), twist) < 27.9  # 99.99 %, 6 degrees of freedom
    assert mm < 2 * found["error_95"]["middle_mm"]
    assert found["frame"]["serial"] == "SN-7"
    assert all(image["used"] for image in found["images"].values())


@pytest.mark.slow
def test_bad_images_are_named_and_a_knock_writes_nothing(sample, tmp_path):
    document = json.loads((sample / "images.json").read_text())
    stated = ArmImages.read(sample / "images.json").poses_in(sample)
    del document["arm"]
    for image, pose in zip(document["images"], stated, strict=True):
        shutil.copy(sample / image["file"], tmp_path)
        del image["q"]
        image["T_base_flange"] = pose.as_matrix().tolist()
    shutil.copy(sample / "block.json", tmp_path)
    poses = [image["T_base_flange"] for image in document["images"]]
    poses[2], poses[7] = poses[7], poses[2]
    file, out = listed(tmp_path, **document), tmp_path / "mount.json"
    for image, pose in zip(document["images"], poses, strict=True):
        image["T_base_flange"] = pose
    np.save(tmp_path / "empty.npy", np.full((1536, 1536), 30000, np.uint16))
    document["images"][4]["file"] = "empty.npy"
    file.write_text(json.dumps(document))
    done = run("calibrate", "--from-images", file, "--out", out)
    assert done.exit_code == 0, done.output
    for name in ("image-03.dcm", "image-08.dcm"):
        assert f"{name}" in done.output
    found = json.loads(out.read_text())
    assert {name for name, image in found["images"].items() if not image["used"]} == {"image-03.dcm", "image-08.dcm"}
    assert list(found["unseen"]) == ["empty.npy"]
    assert found["joints"] is None
    out.unlink()
    for image in document["images"][9:]:
        image["T_base_flange"][2][3] += 1.0
    file.write_text(json.dumps(document))
    assert run("calibrate", "--from-images", file, "--out", out).exit_code == 3
    assert not out.exists()
