"""What ROS 2 is shown, as plain values: metres, frames, pinholes, and nothing that is in doubt."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation
from tests.case.test_live import FAILED
from tests.case.test_watch import ENTRY_END_MM, planned_view, shown

from sightline.calibration.maps.undistort import undistort
from sightline.case.live import LIVE, LiveState, ShownImage
from sightline.case.live_ros2 import LiveTopics, broadcast, picture_of
from sightline.errors import SetUpError, UnusableInputError
from sightline.planning.bone.registered import RegisteredBone
from sightline.robot.igtl import Image, Status
from sightline.robot.ros2_values import ERROR, OK, WARN, Diagnosis, FramePose, ImageCamera, Picture

EXAMPLES = Path(__file__).parents[2] / "examples"
GO: dict[str, Any] = {"wire_mm": ENTRY_END_MM, "verdict": "GO"}


def pose(seed: int) -> RigidTransform:
    """Off the grid, with a rotation that is no quarter turn."""
    rng = np.random.default_rng(seed)
    return RigidTransform.from_components(rng.uniform(-300.0, 300.0, 3), Rotation.random(rng=rng))


def bone(*checks: Any) -> RegisteredBone:
    return RegisteredBone(pose(1).as_matrix(), np.zeros(3), np.eye(6), checks, (), "")


def live() -> ShownImage:
    return ShownImage(shown(), planned_view(), 1_700_000_000.25)


def topics(**state: Any) -> dict[str, Any]:
    return LiveTopics(lambda: LiveState(**state))()


def frames(found: dict[str, Any]) -> dict[str, tuple[str, RigidTransform]]:
    """Return parent and pose, mm, of each frame."""
    return {place.frame: (place.parent, back(place)) for place in found.get("/tf", ())}


def back(place: FramePose) -> RigidTransform:
    return RigidTransform.from_components(1000.0 * place.position_m, Rotation.from_quat(place.quaternion))


def parts(found: dict[str, Any]) -> dict[str, Diagnosis]:
    return {part.name.removeprefix("sightline: "): part for part in found["/diagnostics"]}


def test_frames_and_poses_are_in_metres_below_cfcs_and_cfcs_in_the_patient() -> None:
    """Millimetres, a transposed rotation, w before x, parent and child exchanged, or the wire's entry are seen."""
    found = topics(bone=bone(), T_cfcs_tool=pose(2).as_matrix(), side="right", **GO)
    assert found.keys() == {"target", "tool", "/tf", "/diagnostics"}
    seen = frames(found)
    assert {frame: parent for frame, (parent, _) in seen.items()} == {
        "ct": "cfcs", "tool": "cfcs", "wire": "cfcs", "cfcs": "patient_ras",
    }  # fmt: skip
    for frame, true in (("ct", pose(1)), ("tool", pose(2))):
        np.testing.assert_allclose(seen[frame][1].as_matrix(), true.as_matrix(), atol=1e-9)
    # Of a right hip +X is lateral, the patient's right; +Y caudal; +Z anterior.
    np.testing.assert_allclose(seen["cfcs"][1].apply(np.eye(3)), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-9)
    length = np.linalg.norm(ENTRY_END_MM[1] - ENTRY_END_MM[0])
    for wire in (back(found["target"]), seen["wire"][1]):
        np.testing.assert_allclose(wire.apply([[0.0, 0.0, -length], [0.0, 0.0, 0.0]]), ENTRY_END_MM, atol=1e-9)
    np.testing.assert_allclose(back(found["tool"]).as_matrix(), pose(2).as_matrix(), atol=1e-9)
    assert found["target"].parent == found["tool"].parent == "cfcs"


def test_what_is_not_known_or_not_trusted_is_not_published() -> None:
    found = topics(verdict="NO-GO (gap)", bone=bone(FAILED))
    assert found.keys() == {"/diagnostics"}
    assert {name: part.level for name, part in parts(found).items()} == {"plan": ERROR, "ct": ERROR}
    assert parts(found)["plan"].text == "NO-GO (gap)"
    assert frames(topics(verdict="NO-GO (gap)", T_cfcs_tool=np.eye(4))).keys() == {"tool"}


def test_a_point_in_space_is_seen_by_the_pinhole_where_the_view_sees_it() -> None:
    """Half a pixel, rows for columns, or the pose of the plate instead of the source are seen."""
    found, view, image = topics(images={LIVE: live()}), planned_view(), shown()
    camera, picture = found["live/camera_info"], found["live/image/compressed"]
    plane = undistort(image.pixels, view.plane_map, view.hull)
    pixels = cv2.imdecode(np.frombuffer(picture.png, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(pixels, plane.pixels)
    assert (picture.encoding, picture.camera, camera.shape) == ("mono16", camera, pixels.shape)
    assert (camera.frame, camera.stamped_s) == ("live_optical_frame", 1_700_000_000.25)
    parent, T_cfcs_optical = frames(found)[camera.frame]
    assert parent == "cfcs"
    xyz_mm = np.random.default_rng(3).uniform(-40.0, 40.0, (50, 3))
    seen = (T_cfcs_optical.inv().apply(xyz_mm)) @ camera.matrix.T
    column, row = (seen[:, :2] / seen[:, 2:]).T
    uv_px = [map_coordinates(plane.uv_px[..., k], [row, column], order=1) for k in (0, 1)]
    np.testing.assert_allclose(np.transpose(uv_px), view.project(xyz_mm), atol=0.03)  # of the splines, and linear here


@pytest.mark.parametrize("against", [False, True])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_the_image_stands_as_the_source_sees_it(against: bool, kind: Any) -> None:
    """A plate whose normal points against the beam: its rows run upwards in the image of the plate."""
    pixels = np.random.default_rng(4).integers(0, 200, (20, 33)).astype(kind)
    placed = pose(5)  # of the plate; all below is in its coordinates
    matrix = np.array([[0.4, 0, 0, 7.3], [0, 0.4, 0, -2.9], [0, 0, 1, 11.1], [0, 0, 0, 1]])
    image = Image(pixels[None], placed.as_matrix() @ matrix)
    turned = Rotation.from_euler("x", 180.0 if against else 0.0, degrees=True)
    source = np.array([1.7, 3.1, 611.1 if against else -588.9])
    camera = RigidTransform.from_components(source, turned)
    given = ShownImage(SimpleNamespace(white=1000.0), None)
    picture = picture_of("3-d", given, image, (placed * camera).as_matrix())
    found = cv2.imdecode(np.frombuffer(picture.png, np.uint8), cv2.IMREAD_UNCHANGED)
    for row, column in ((0, 0), (3, 30), (19, 5)):
        at_mm = np.array([7.3 + 0.4 * (column - 16), -2.9 + 0.4 * (row - 9.5), 11.1])
        u, v, w = picture.camera.matrix @ camera.inv().apply(at_mm)
        assert w > 0
        assert [u / w, v / w] == pytest.approx(np.round([u / w, v / w]), abs=1e-6)
        expected = pixels[row, column] * (65.535 if kind is np.float32 else 1)
        assert found[round(v / w), round(u / w)] == pytest.approx(expected, abs=0.5)
    assert picture.encoding == ("mono8" if kind is np.uint8 else "mono16")
    assert (picture.camera.frame, picture.camera.stamped_s) == ("_3_d_optical_frame", 0.0)


def test_an_image_is_encoded_once_and_anew_when_another_comes() -> None:
    first, second = live(), replace(live(), image=shown(0.0, 1))
    states = iter([first, first, second])
    made = LiveTopics(lambda: LiveState(images={LIVE: next(states)}))
    before, again, after = (made()["live/image/compressed"] for _ in range(3))
    assert again is before
    assert after is not before


def test_diagnostics_tell_verdict_statuses_and_failed_checks() -> None:
    view = replace(planned_view(), checks=(FAILED, replace(FAILED, passed=True, figure=0.5)))
    robot = Status(18, "FAULT", "the drill is hot", 7)
    statuses = {"status": Status(1, "", "still"), "robot": robot}
    found = parts(topics(statuses=statuses, images={LIVE: replace(live(), view=view)}, bone=bone(), **GO))
    assert {name: part.level for name, part in found.items()} == {
        "plan": OK, "status": OK, "robot": ERROR, "view live": ERROR, "ct": OK,
    }  # fmt: skip
    assert (found["status"].text, found["robot"].text) == ("still", "FAULT: the drill is hot")
    assert found["view live"].text == FAILED.sentence
    assert dict(found["view live"].values) == {"gap": "failed 2 mm at most 1 mm"}
    assert parts(topics())["plan"].level == WARN


# ROS 2 itself judges these in tests/robot/test_ros2.py.
GOOD, BAD = ("/a", "/or/_1", "/a__b_/C9"), ("", "/", "a", "/a b", "/1a", "/a//b", "/a/", "/ä", "/a-b", "/a\n")


@pytest.mark.parametrize("namespace", BAD)
def test_a_bad_namespace_is_refused(namespace: str) -> None:
    with pytest.raises(UnusableInputError, match=r"not a namespace of ROS 2: .* such as ros2:/sightline"):
        broadcast(f"ros2:{namespace}", LiveState)


@pytest.mark.parametrize("namespace", GOOD)
def test_without_ros_2_a_sentence_says_what_to_install(namespace: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    with pytest.raises(SetUpError, match=r"needs ROS 2 with rclpy, tf2_msgs and diagnostic_msgs .* setup\.bash"):
        broadcast(f"ros2:{namespace}", LiveState)


def test_rviz_is_shown_what_is_published() -> None:
    found = topics(images={LIVE: live()}, T_cfcs_tool=np.eye(4), **GO)
    kinds = {"rviz_default_plugins/Pose": FramePose, "rviz_default_plugins/Image": Picture}
    manager = yaml.safe_load((EXAMPLES / "sightline.rviz").read_text())["Visualization Manager"]
    asked = [(each["Class"], each["Topic"]["Value"]) for each in manager["Displays"] if "Topic" in each]
    assert [topic for _, topic in asked] == [
        f"/sightline/{name}" for name in ("target", "tool", "live/image/compressed")
    ]
    for kind, topic in asked:
        assert isinstance(found[topic.removeprefix("/sightline/")], kinds[kind])
    fixed = {manager["Global Options"]["Fixed Frame"], manager["Views"]["Current"]["Target Frame"]}
    assert fixed == {parent for parent, _ in frames(found).values()} == {"cfcs"}
    assert isinstance(found["live/camera_info"], ImageCamera)
