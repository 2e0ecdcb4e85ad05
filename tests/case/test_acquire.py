"""Images into a case: once each, on the disk first, and nothing of what is no image."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pydicom import dcmread

from sightline.case import stages
from sightline.case.acquire import Acquirer, news_of
from sightline.case.acquire.robot import PoseNow
from sightline.case.journal import Actor, Case, Kind
from sightline.case.replay import replay
from sightline.errors import CaseError, ImageError
from sightline.imaging import Radiograph, write_dicom, write_png


def image(seed: int = 0) -> Radiograph:
    return Radiograph(np.random.default_rng(seed).integers(0, 4096, (32, 40), dtype=np.uint16), 4095.0)


def run(tmp_path: Path, frames: int) -> bytes:
    """A run of frames, the last all 7."""
    header = dcmread(write_dicom(image(), tmp_path / "one.dcm"))
    pixels = np.random.default_rng(1).integers(0, 4096, (frames, 32, 40), dtype=np.uint16)
    pixels[-1] = 7
    header.NumberOfFrames, header.PixelData = frames, pixels.tobytes()
    header.save_as(tmp_path / "run.dcm")
    return (tmp_path / "run.dcm").read_bytes()


@pytest.fixture
def case(tmp_path: Path) -> Iterator[Case]:
    with Case.create(tmp_path / "case") as case:
        yield case


def test_an_image_is_kept_once_and_can_be_replayed(case: Case, tmp_path: Path) -> None:
    data = write_dicom(image(), tmp_path / "Doe^Jane.dcm").read_bytes()
    first = Acquirer(case).take(data, ".dcm", how={"source": "folder"})
    assert first.new
    assert case.original(first.entry.content["original"]).read_bytes() == data
    np.testing.assert_array_equal(stages.image_of(case, first.entry).pixels, image().pixels)
    again = Acquirer(case).take(data, ".dcm")  # another program's
    assert not again.new
    assert again.entry.number == first.entry.number
    assert [one.differences for one in replay(case)] == [()]
    assert case.problems == ()
    assert "Doe" not in news_of(first).text
    assert first.entry.content["original"][:12] in news_of(first).text
    assert first.entry.by is Actor.RECEIVER


def test_two_programs_that_take_the_same_images_at_once_enter_each_once(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other program takes the image while this one has looked back and not yet recorded: the worst moment."""
    from sightline.case.acquire import acquirer as acquire

    data = [write_png(image(seed), tmp_path / f"{seed}.png").read_bytes() for seed in range(3)]
    looked_at, others = acquire._read_content, []

    def meanwhile(*arguments, **options):
        if not others or others[-1] is not None:
            others.append(None)  # the other one's own look
            with Case.open(case.folder) as same:
                others[-1] = Acquirer(same).take(data[1], ".png")
        return looked_at(*arguments, **options)

    monkeypatch.setattr(acquire, "_read_content", meanwhile)
    acquirer = Acquirer(case)
    taken = [acquirer.take(one, ".png") for one in (data[1], data[0], data[2])]
    assert [one.new for one in taken] == [False, True, True]
    assert taken[0].entry.number == others[0].entry.number == 1
    assert len({entry.content["original"] for entry in case.entries()}) == len(case.entries()) == 3


def test_a_run_is_kept_whole_and_entered_by_its_last_frame(case: Case, tmp_path: Path) -> None:
    data, acquirer = run(tmp_path, 5), Acquirer(case)
    taken = acquirer.take(data, ".dcm")
    last = taken.entry
    assert last.settings == {"frame_index": 4, "acquisition": {"frames": 5}}
    assert (stages.image_of(case, last).pixels == 7).all()
    assert "a run of 5 frames" in news_of(taken).text
    assert not acquirer.take(data, ".dcm").new
    assert len(case.entries(Kind.ACQUIRED)) == 1
    assert len(list((case.folder / "originals").iterdir())) == 1


def test_what_is_no_image_is_refused_without_its_name_and_leaves_nothing(case: Case, tmp_path: Path) -> None:
    data = write_dicom(image(), tmp_path / "one.dcm").read_bytes()
    acquirer = Acquirer(case)
    for bad in (data[:900], b"\0" * 128 + b"DICM", b"no image at all"):
        with pytest.raises(ImageError, match="the image"):
            acquirer.take(bad, ".dcm")
    with pytest.raises(CaseError):
        acquirer.take(b"MZ", ".exe")
    assert case.entries() == []
    assert list((case.folder / "originals").iterdir()) == []


def test_the_robots_pose_of_an_arrival_is_stamped_as_such_and_a_stale_one_is_not(case: Case, tmp_path: Path) -> None:
    """A source that knows the pose of its own moment says it itself."""
    poses = [PoseNow((1.0, 2.0, 0.1, 0.2, 3.0), 0.05), PoseNow((1.0, 2.0, 0.1, 0.2, 3.0), 7.0)]
    acquirer = Acquirer(case, arrival_pose=lambda: poses.pop(0))
    told = [{"source": "dicom"}, {"source": "dicom"}, {"source": "video", "robot": {"joints": None}}]
    data = [write_dicom(image(seed), tmp_path / f"{seed}.dcm").read_bytes() for seed in range(3)]
    entries = [acquirer.take(one, ".dcm", how=how).entry for one, how in zip(data, told, strict=True)]
    fresh, stale, own = (entry.settings["acquisition"]["robot"] for entry in entries)
    assert fresh == {"joints": [1.0, 2.0, 0.1, 0.2, 3.0], "age_s": 0.05, "fresh": True, "moment": "arrival"}
    assert stale == {"joints": None, "age_s": 7.0, "fresh": False, "moment": "arrival"}
    assert own == {"joints": None}
