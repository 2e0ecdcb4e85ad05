"""`sightline export bone`: read back by pyigtl's own reader, and by the formulas of ROS and 3D Slicer."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pyigtl.messages import MessageBase, message_type_to_class_constructor
from scipy.spatial.transform import Rotation

import sightline as sl
from sightline.calibration.exchange.pose_file import read_pose
from sightline.common.checks import Check
from sightline.planning.bone.registered import BoneView, RegisteredBone

MATRIX = np.eye(4)
MATRIX[:3, :3] = Rotation.from_rotvec([0.41, -1.34, 0.27]).as_matrix()
MATRIX[:3, 3] = [104.7, -62.9, 17.3]
POINT_MM = np.array([78.3, -85.1, 42.6, 1.0])  # of the CT, LPS
FLIP = np.array([-1.0, -1.0, 1.0, 1.0])  # LPS to RAS, and back
FLOAT32_MM = 2e-5  # TRANSFORM has 32 bits


@pytest.fixture
def pose(tmp_path: Path) -> Callable[..., Path]:
    def made(*, passed: bool = True) -> Path:
        check = Check("bone movement", passed, 1.0, 5.3, "s.d.", "Moved." if not passed else "At rest.")
        views = tuple(
            BoneView(name, np.array([1.0, 2.0, 620.0]), "0" * 64, np.eye(4), 1.5) for name in ("pa", "lateral")
        )
        bone = RegisteredBone(MATRIX, MATRIX[:3, 3], np.eye(6), (check,), views, "1" * 64)
        return sl.save(bone, tmp_path / "bone-pose.json")

    return made


def read_by_pyigtl(file: Path) -> tuple[str, np.ndarray, dict[str, str]]:
    data = file.read_bytes()
    header = MessageBase.parse_header(data[: MessageBase.IGTL_HEADER_SIZE])
    message = message_type_to_class_constructor[header["message_type"]]()
    message.unpack(header, data[MessageBase.IGTL_HEADER_SIZE :])
    return message.device_name, message.matrix, message.metadata


def test_every_format_takes_a_point_of_the_ct_to_the_same_place(run: Callable, pose: Callable, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ran = run("export", "bone", pose(), "--to", "slicer, igtl,ros2", "--out", out, "--json")
    assert ran.code == 0, ran.err
    assert ran.document["trusted"] and len(ran.document["files"]) == 4
    true = MATRIX @ POINT_MM
    name, matrix, metadata = read_by_pyigtl(out / "igtl" / "ct.igtl")
    assert name == "ct-to-cfcs" and (metadata["units"], metadata["coordinates"]) == ("mm", "CFCS")
    assert np.abs(matrix @ POINT_MM - true).max() < FLOAT32_MM
    name, matrix, _ = read_by_pyigtl(out / "igtl" / "ct-ras.igtl")
    assert name == "ct-ras-to-cfcs"
    assert np.abs(FLIP * (matrix @ (FLIP * POINT_MM)) - true).max() < FLOAT32_MM
    placed = read_pose(out / "slicer" / "bone-pose.tfm").inv()
    assert placed.apply(POINT_MM[:3]) == pytest.approx(true[:3], abs=1e-9)
    message = json.loads((out / "ros2" / "ct.yaml").read_text())
    assert (message["header"]["frame_id"], message["child_frame_id"]) == ("cfcs", "ct")
    at, turn = message["transform"]["translation"], message["transform"]["rotation"]
    assert set(at) == set("xyz") and set(turn) == set("xyzw")
    vector, point_m = np.array([turn["x"], turn["y"], turn["z"]]), 1e-3 * POINT_MM[:3]
    across = np.cross(vector, point_m)
    moved_m = point_m + 2 * (turn["w"] * across + np.cross(vector, across)) + [at["x"], at["y"], at["z"]]
    assert moved_m == pytest.approx(1e-3 * true[:3], abs=1e-12)


@pytest.mark.parametrize("to", ["igtl", "ros2", "slicer,ros2"])
def test_a_pose_that_is_not_to_be_trusted_is_no_message(run: Callable, pose: Callable, tmp_path: Path, to: str) -> None:
    ran = run("export", "bone", pose(passed=False), "--to", to, "--out", tmp_path / "out")
    assert ran.code == 2 and "bone movement" in ran.said
    assert not (tmp_path / "out").exists()


def test_a_transform_of_an_untrusted_pose_says_so(run: Callable, pose: Callable, tmp_path: Path) -> None:
    ran = run("export", "bone", pose(passed=False), "--out", tmp_path / "out")
    assert ran.code == 3
    assert "NOT TO BE TRUSTED, checks failed: bone movement" in (tmp_path / "out/slicer/bone-pose.tfm").read_text()


def test_unknown_formats_and_edited_poses_are_refused(run: Callable, pose: Callable, tmp_path: Path) -> None:
    ran = run("export", "bone", pose(), "--to", "igtl,itk", "--out", tmp_path / "out")
    assert ran.code == 2 and "there is no format of a bone 'itk'; there are: slicer, igtl, ros2" in ran.said
    edited = pose()
    edited.write_text(edited.read_text().replace("104.7", "105.7"))
    ran = run("export", "bone", edited, "--out", tmp_path / "out")
    assert ran.code == 2 and not (tmp_path / "out").exists()
