"""`sightline watch` over folders of images: a line of JSON for each frame, a last one, exit codes."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.detection.frame_images import SIZE, beads, image

from sightline.case.watch.analyser import BLIND_TO
from sightline.imaging import Radiograph, write_png
from sightline.imaging.sources import open_source


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
