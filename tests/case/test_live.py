"""What other programs are shown: beads of the plate where the frame has them, poses, and nothing that is in doubt."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.case.test_watch import EMPTY, ENTRY_END_MM, seen_by, shown
from tests.detection.frame_images import FOCAL_MM, FRAME

from sightline.case.live import LIVE, STATUS, LiveMessages, LiveState, shown_of, status_of
from sightline.case.watch.analyser import LiveAnalyser, Watched, aged
from sightline.common.checks import Check
from sightline.errors import OutsideRegionError
from sightline.planning.bone.registered import RegisteredBone
from sightline.robot.igtl import Image, Message, Status, String, Trajectories, Transform, encode, timestamp_of

FAILED = Check("gap", False, 2.0, 1.0, "mm", "It is too large.")


@pytest.fixture(scope="module")
def watched() -> list[Watched]:
    """Of two images of one scene and of one after a movement of 4 mm."""
    return seen_by(LiveAnalyser(FRAME, None, ()), [shown(), shown(0.0, 1), shown(4.0)])


def made(**state: Any) -> dict[str, Message]:
    messages = LiveMessages(lambda: LiveState(**state))()
    found = {message.device_name: message for message in messages}
    assert len(found) == len(messages)  # each has a name of its own
    for message in messages:
        encode(message)
    return found


def test_beads_of_the_plate_lie_where_the_frame_has_them(watched: list[Watched]) -> None:
    """A matrix of the corner instead of the centre, or with rows for columns, is millimetres off."""
    message = made(images=shown_of(watched[0]))[LIVE]
    body = message.body
    assert isinstance(body, Image)
    assert message.timestamp == timestamp_of(watched[0].stamped_s)
    assert dict(message.metadata) == {"units": "mm", "coordinates": "CFCS"}
    pixels, matrix, view = body.pixels[0].astype(float), body.matrix, watched[0].view
    height, width = pixels.shape
    assert matrix[:3, 0] @ matrix[:3, 0] == pytest.approx(matrix[:3, 1] @ matrix[:3, 1])
    assert np.linalg.det(matrix[:3, :3]) > 0
    plates = {f.id: np.array(f.xyz_mm) for f in FRAME.view("pa").fiducials if f.id in view.residuals.ids}
    on_plate = {k: at for k, at in plates.items() if abs(view.plane.height_mm(at)) < 0.3}
    errors = []
    for at in on_plate.values():
        i, j = np.linalg.solve(matrix[:3, :3], at - matrix[:3, 3])[:2] + np.array([width - 1, height - 1]) / 2
        if not (12 < i < width - 13 and 12 < j < height - 13):
            continue
        left, top = round(i) - 6, round(j) - 6
        dark = np.clip(np.median(pixels) - 300 - pixels[top : top + 13, left : left + 13], 0, None)
        v, u = np.mgrid[:13, :13]
        errors.append([left + (dark * u).sum() / dark.sum() - i, top + (dark * v).sum() / dark.sum() - j])
    assert len(errors) > 15
    # Pixels of 0.4 mm; of a few beads the patch shows one of the other plate, too.
    np.testing.assert_allclose(np.median(errors, axis=0), 0.0, atol=0.15)
    assert np.median(np.abs(errors)) < 0.15


def test_the_view_is_at_the_source_and_looks_along_the_beam(watched: list[Watched]) -> None:
    body = made(images=shown_of(watched[0]))["live-to-cfcs"].body
    assert isinstance(body, Transform)
    pose = body.rigid()
    np.testing.assert_allclose(pose.translation, FOCAL_MM, atol=2.0)
    beam, across = pose.rotation.apply(np.eye(3)[[2, 0]])
    assert beam[2] > 0.99  # the PA beam runs along +Z
    assert abs(across @ watched[0].view.plane.axes[0]) == pytest.approx(1.0)


def test_an_image_is_made_once_and_resampled_anew_only_where_the_view_moved(watched: list[Watched]) -> None:
    states = iter([watched[0], watched[0], watched[1], watched[2]])
    messages = LiveMessages(lambda: LiveState(images=shown_of(next(states))))
    first, again, second, moved = ({m.device_name: m for m in messages()}[LIVE] for _ in range(4))
    assert again is first
    assert second is not first
    np.testing.assert_array_equal(second.body.matrix, first.body.matrix)
    alone = made(images=shown_of(watched[1]))[LIVE].body
    whole = np.asarray(second.body.pixels[0, 60:-60, 60:-60], float)
    shift = alone.matrix[:3, 3] - second.body.matrix[:3, 3]
    assert np.linalg.norm(shift) < 1.0  # of the bounding box, by the noise of its corners
    assert np.std(whole) > 0
    assert not np.array_equal(whole, first.body.pixels[0, 60:-60, 60:-60])
    assert np.abs(moved.body.matrix - first.body.matrix).max() > 0.01


def test_a_plan_that_is_go_is_a_path_and_a_pose_at_its_tip() -> None:
    found = made(wire_mm=ENTRY_END_MM, verdict="GO", side="right")
    path = found["plan"].body.paths[0]
    np.testing.assert_allclose([path.entry_mm, path.target_mm], ENTRY_END_MM)
    pose = found["wire-to-cfcs"].body.rigid()
    length = np.linalg.norm(ENTRY_END_MM[1] - ENTRY_END_MM[0])
    np.testing.assert_allclose(pose.apply([[0.0, 0.0, -length], [0.0, 0.0, 0.0]]), ENTRY_END_MM, atol=1e-5)
    assert found["verdict"].body == String("GO")
    # Of a right hip +X is lateral, the patient's right; +Y caudal; +Z anterior.
    axes = found["cfcs-to-ras"].body.rigid().apply(np.eye(3))
    np.testing.assert_allclose(axes, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)


def test_what_is_not_known_or_not_trusted_is_not_sent() -> None:
    bone = RegisteredBone(np.eye(4), np.zeros(3), np.eye(6), (FAILED,), (), "")
    found = made(verdict="NO-GO (gap)", bone=bone)
    assert found.keys() == {"verdict", "plan"}
    assert found["plan"].body == Trajectories(())  # takes away a plan that was sent before
    trusted = made(bone=replace(bone, checks=()), T_cfcs_tool=np.diag([1.0, -1.0, -1.0, 1.0]))
    assert trusted.keys() == {"verdict", "plan", "ct-to-cfcs", "tool-to-cfcs"}


def test_an_image_that_cannot_be_resampled_is_a_status(watched: list[Watched], monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OutsideRegionError("too far outside")

    monkeypatch.setattr("sightline.case.live.undistort", refused)
    assert made(images=shown_of(watched[0]))[LIVE].body == Status(13, "NO_IMAGE", "too far outside")


def test_the_status_says_why_a_live_image_must_not_be_trusted(watched: list[Watched]) -> None:
    fresh, late = aged(watched[0], watched[0].came_s), aged(watched[0], watched[0].came_s + 1.0)
    (empty,) = seen_by(LiveAnalyser(FRAME, None, ()), [EMPTY])
    empty = aged(empty, empty.came_s)
    alarm = replace(fresh, movement=SimpleNamespace(moved=True, text="moved since rest"))
    still = replace(fresh, movement=SimpleNamespace(moved=False, text="still"))
    said = [status_of(one) for one in (None, fresh, late, empty, alarm, replace(alarm, stale=True), still)]
    assert [one.error_name for one in said] == ["WAITING", "", "STALE", "NO_VIEW", "MOVED", "MOVED", ""]
    assert [one.code == 1 for one in said] == [False, True, False, False, False, False, True]
    assert said[-1].text == "still"
    assert shown_of(empty) == shown_of(None) == {}
    assert made(statuses={STATUS: said[0]})[STATUS].body == said[0]
