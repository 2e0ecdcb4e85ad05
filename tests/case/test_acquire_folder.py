"""A folder of images: whole files are taken, half-written ones wait, and none is named."""

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydicom import dcmread
from pydicom.uid import UID, XRayAngiographicImageStorage, XRayRadiationDoseSRStorage

from sightline.case.acquire import Acquirer, News
from sightline.case.acquire.folder import GIVE_UP_S, SETTLED_S, Folder
from sightline.case.journal import Case
from sightline.common.bounded import MAX_FILE_BYTES
from sightline.errors import CaseError, UnusableInputError
from sightline.imaging import Radiograph, write_dicom, write_png


def image(seed: int) -> Radiograph:
    return Radiograph(np.random.default_rng(seed).integers(0, 4096, (32, 40), dtype=np.uint16), 4095.0)


class Watched:
    """A folder, the case that its images go into, what is told, and a clock to be put on."""

    def __init__(self, tmp_path: Path) -> None:
        self.folder, self.news, self.now_s = tmp_path / "in", [], 0.0
        self.folder.mkdir()
        self.case = Case.create(tmp_path / "case")
        self.watch = Folder(self.folder, Acquirer(self.case), self.news.append)

    def after(self, seconds: float) -> list[str]:
        """What is told at a scan so much later."""
        self.now_s += seconds
        told = len(self.news)
        self.watch.scan(self.now_s)
        return [news.kind for news in self.news[told:]]

    def texts(self) -> str:
        return " ".join(news.text for news in self.news)


@pytest.fixture
def watched(tmp_path: Path) -> Watched:
    return Watched(tmp_path)


def test_every_image_of_a_folder_is_taken_and_the_rest_is_told_of(watched: Watched) -> None:
    (watched.folder / "sub").mkdir()
    write_dicom(image(1), watched.folder / "Doe^Jane")
    write_png(image(2), watched.folder / "sub" / "Doe.tif.bak")
    write_dicom(image(1), watched.folder / "the same again.dcm")
    (watched.folder / "Doe.txt").write_text("Jane Doe, born 1950")
    (watched.folder / "empty.dcm").touch()
    (watched.folder / "a.jpg").write_bytes(cv2.imencode(".jpg", image(4).pixels.astype(np.uint8))[1].tobytes())
    (watched.folder / ".hidden.dcm").write_bytes(b"x")
    (watched.folder / "half.dcm").write_bytes(write_dicom(image(3), watched.folder / "sub" / "z").read_bytes()[:1500])
    watched.watch.take_all()
    kinds = [news.kind for news in watched.news]
    assert [kinds.count(kind) for kind in ("kept", "already", "refused", "note")] == [4, 1, 3, 0]
    assert len(watched.case.entries()) == 4
    assert watched.case.problems == ()
    assert "Doe" not in watched.texts()
    assert "half" not in watched.texts()
    assert watched.watch.unusable == 2  # half.dcm and empty.dcm


@pytest.mark.parametrize(
    ("sop_class", "kept_bytes", "unusable"),
    [(XRayAngiographicImageStorage, 900, 1), (XRayRadiationDoseSRStorage, None, 0), (None, 900, 1)],
)
def test_a_broken_image_is_unusable_and_a_dose_report_is_not(
    watched: Watched, sop_class: UID | None, kept_bytes: int | None, unusable: int
) -> None:
    """The broken image has lost its size, so that by its header it is not an image either; at last it is removed."""
    file = write_dicom(image(1), watched.folder / "IM1")
    held = dcmread(file)
    held.file_meta.MediaStorageSOPClassUID = held.SOPClassUID = sop_class or UID("1.2.840.99999.1")
    for name in ("Rows", "Columns", "PixelData"):
        delattr(held, name)
    held.save_as(file)
    file.write_bytes(file.read_bytes()[:kept_bytes])
    watched.watch.take_all()
    assert [news.kind for news in watched.news] == ["refused"]
    assert watched.watch.unusable == unusable
    file.unlink()
    watched.watch.take_all()
    assert watched.watch.unusable == 0


def test_a_file_is_taken_once_it_has_settled(watched: Watched) -> None:
    data = write_dicom(image(1), watched.folder / "a.dcm").read_bytes()
    (watched.folder / "a.dcm").write_bytes(data[:700])
    assert watched.after(0.0) == []
    assert watched.after(2 * SETTLED_S) == []  # settled and no whole image: it waits
    with (watched.folder / "a.dcm").open("ab") as file:
        file.write(data[700:])
    assert watched.after(0.1) == []
    assert watched.watch.waiting == 1
    assert watched.after(1.1 * SETTLED_S) == ["kept"]
    assert watched.after(100.0) == []
    assert watched.watch.waiting == 0


def test_a_file_that_never_becomes_whole_is_told_of_once_and_taken_when_it_does(watched: Watched) -> None:
    data = write_dicom(image(1), watched.folder / "Doe.dcm").read_bytes()
    (watched.folder / "Doe.dcm").write_bytes(data[:700])
    told = [watched.after(seconds) for seconds in (0.0, 2.0, GIVE_UP_S, 5.0, 50.0)]
    assert told == [[], [], ["refused"], [], []]
    assert "700 bytes" in watched.texts()
    (watched.folder / "Doe.dcm").write_bytes(data)
    assert watched.after(1.0) == []
    assert watched.after(2.0) == ["kept"]
    assert "Doe" not in watched.texts()


def test_a_huge_file_is_told_of_and_never_read(watched: Watched) -> None:
    with (watched.folder / "huge.dcm").open("wb") as file:
        file.write(bytes(128) + b"DICM")
        file.truncate(MAX_FILE_BYTES + 1)  # takes no room on the disk
    write_dicom(image(1), watched.folder / "one.dcm")
    tracemalloc.start()
    try:
        watched.after(0.0)
        assert watched.after(SETTLED_S) == ["kept"]
        assert watched.after(GIVE_UP_S) == ["refused"]
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()
    assert "the limit is" in watched.texts()


def test_a_file_that_goes_away_is_forgotten(watched: Watched) -> None:
    (watched.folder / "a.dcm").write_bytes(b"x")
    watched.after(0.0)
    (watched.folder / "a.dcm").unlink()
    assert watched.after(100.0) == []
    assert watched.watch.waiting == 0


def test_a_full_disk_is_told_of_once_and_the_image_taken_when_there_is_room(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_dicom(image(1), watched.folder / "a.dcm")
    watched.after(0.0)

    def full(*_: object) -> str:
        raise CaseError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(watched.case, "keep", full)
        assert watched.after(2.0) == ["refused"]
        assert watched.after(2.0) == []
    assert "the disk is full" in watched.texts()
    assert watched.after(2.0) == ["kept"]


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    told: list[News] = []
    with pytest.raises(UnusableInputError, match="no such folder"):
        Folder(tmp_path / "absent", Acquirer(Case.create(tmp_path / "case")), told.append)
