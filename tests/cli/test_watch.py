"""`sightline watch` over folders of images: a line of JSON for each frame, a last one, exit codes."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from tests.detection.frame_images import SIZE, beads, image

from sightline.case.live import LIVE
from sightline.case.watch.analyser import BLIND_TO, Watched
from sightline.errors import LinkError
from sightline.imaging import Radiograph, write_png
from sightline.imaging.sources import open_source
from sightline.robot.igtl import Message, String
from sightline.robot.transport import BlockingClient
from sightline.robot.transport.broadcast import Broadcast


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    for k in range(4):
        write_png(image(beads(), k), folder / f"{k}.png")
    (folder / "notes.txt").write_text("no image")
    return folder


def test_every_frame_is_a_line_and_the_last_line_says_how_it_went(run, frames: Path) -> None:
    ran = run("watch", frames, "--json")
    assert ran.code == 0, ran.err
    *each, whole = [json.loads(line) for line in ran.out.splitlines()]
    assert each[0]["reason"] == ""
    assert each[0]["view"]["name"] == "pa"
    assert each[0]["view"]["beads"] > 60
    assert each[0]["plan"] is None
    assert each[-1]["number"] == whole["frames"] == 4
    assert whole["worked_on"] + whole["dropped"] == 4
    assert (whole["moved"], whole["without_view"]) == (False, 0)
    assert whole["blind_to"] == BLIND_TO


def test_a_source_can_be_inverted(frames: Path) -> None:
    plain, inverted = (next(iter(open_source(str(frames), invert=invert))).image for invert in (False, True))
    assert inverted.is_inverted
    np.testing.assert_array_equal(inverted.pixels, plain.white - plain.pixels)


def test_frame_9_comes_before_frame_10(tmp_path: Path) -> None:
    for k in (8, 9, 10, 11, 100):
        write_png(Radiograph(np.full((16, 16), k, np.uint16), 4095), tmp_path / f"frame{k}.png")
    assert [frame.image.pixels[0, 0] for frame in open_source(str(tmp_path))] == [8, 9, 10, 11, 100]


def test_a_person_is_told_what_the_alarm_cannot_see(run, frames: Path) -> None:
    ran = run("watch", frames, "--planned", frames / "0.png")
    assert ran.code == 0
    assert "cannot detect that the bone moves" in ran.said


def test_images_without_beads_are_refused(run, tmp_path: Path) -> None:
    write_png(Radiograph(np.full((SIZE, SIZE), 2000, np.uint16), 4095), tmp_path / "0.png")
    ran = run("watch", tmp_path)
    assert ran.code == 3
    assert "none of 1 frames" in ran.err


class Known(Broadcast):
    """A server that a test can find."""

    all: ClassVar[list[Broadcast]] = []

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.all.append(self)


@pytest.mark.parametrize(
    ("address", "reason"), [("igtl:x", "igtl:PORT"), ("ros2:x", "a namespace"), ("ros2:/x", "needs ROS 2")]
)
def test_what_cannot_be_served_is_refused(
    run, frames: Path, address: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sightline.robot.transport.broadcast.Broadcast", Known)
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    ran = run("watch", frames, "--serve", "igtl:0", "--serve", address)
    assert ran.code == 2
    assert reason in ran.said
    with pytest.raises(LinkError):  # what was served before has ended
        BlockingClient(port=Known.all[-1].port)


@pytest.mark.parametrize("go", [True, False])
def test_readers_are_sent_image_view_plan_and_status(
    run, frames: Path, monkeypatch: pytest.MonkeyPatch, go: bool
) -> None:
    said, side = ("GO", "left") if go else ("NO-GO (failed: gap)", None)
    points = np.array([[-20.3, 11.2, -9.7], [22.1, -14.6, 13.4]])
    plan = SimpleNamespace(go=go, verdict=said, side=side, of_solid=False, points_mm=points, trajectory=None)
    came: dict[str, Message] = {}

    def follow(watching: Any, *_: object) -> list[Watched]:
        """In place of the loop that prints: read until the live image has come."""
        with BlockingClient(port=Known.all[-1].port) as reader:
            while LIVE not in came:
                event = reader.receive(20.0)
                assert isinstance(event, Message)
                came[event.device_name] = event
        return [watching.latest()]

    monkeypatch.setattr("sightline.robot.transport.broadcast.Broadcast", Known)
    monkeypatch.setattr("sightline.cli.watch._planned", lambda *_: plan)
    monkeypatch.setattr("sightline.cli.watch._follow", follow)
    ran = run("watch", frames, "--serve", "igtl:0", "--plan", frames)
    assert ran.code == 0, ran.err
    assert f"127.0.0.1:{Known.all[-1].port}" in ran.out
    always = {"live", "live-to-cfcs", "plan", "verdict", "status"}
    assert came.keys() == always | ({"wire-to-cfcs", "cfcs-to-ras"} if go else set())
    assert came["verdict"].body == String(said)
    assert len(came["plan"].body.paths) == int(go)
    with pytest.raises(LinkError):
        BlockingClient(port=Known.all[-1].port)
