"""Only regular files are read: a pipe would be waited for without end, a device may have no end."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.systems import needs_posix

import sightline as sl
from sightline.case.deidentify import Deidentifier
from sightline.case.interop.dicom import ReferencedImage
from sightline.case.interop.plan_file import PlanFile
from sightline.case.journal.originals import anonymous_name
from sightline.common.bounded import read_bounded, regular_file
from sightline.detection.csv_files import read_detections, read_observations
from sightline.errors import UnusableInputError
from sightline.frame.tables import frame_from_csv, read_measurements
from sightline.imaging import frames_in
from sightline.imaging.volumes.ct import read_ct
from sightline.imaging.volumes.meshes import read_mesh
from sightline.studies.assess import read_points

READERS: dict[str, Callable[[Path], object]] = {
    "image.dcm": sl.read_image,
    "run.dcm": frames_in,
    "original.dcm": Deidentifier().clean,
    "referred.dcm": ReferencedImage.read,
    "frame.json": sl.Frame.load,
    "frame.csv": lambda path: frame_from_csv(path, "mine"),
    "balls.csv": read_measurements,
    "beads.csv": read_observations,
    "detections.csv": read_detections,
    "points.csv": read_points,
    "view.opencv.json": sl.read_view,
    "view.rtk.xml": sl.read_view,
    "plan": PlanFile.read,
    "bone.stl": read_mesh,
    "scan.nii": read_ct,
    "scan.nrrd": read_ct,
}


@pytest.mark.parametrize("name", READERS)
def test_a_device_is_no_file_of_any_kind(tmp_path: Path, name: str) -> None:
    """A link to /dev/null reads as an empty file, which is reported as empty or damaged."""
    place = tmp_path / name
    if name == "plan":
        place.mkdir()
        (place / "plan.json").symlink_to(os.devnull)
    else:
        place.symlink_to(os.devnull)
    with pytest.raises(UnusableInputError, match=r"not a file|not a regular file|there is no|is not a DICOM image"):
        READERS[name](place)


@needs_posix
def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "beads.csv")
    with pytest.raises(OSError, match="a pipe, not a file"), regular_file(tmp_path / "beads.csv"):
        pass
    with pytest.raises(OSError, match="a pipe, not a file"):
        anonymous_name(tmp_path / "beads.csv")
    with pytest.raises(UnusableInputError, match=r"cannot read beads.csv: it is a folder, a device or a pipe"):
        read_bounded(tmp_path / "beads.csv", 10, UnusableInputError, "")


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"0123456789")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    assert read_bounded(tmp_path / "link", 10, UnusableInputError, "") == b"0123456789"
    with pytest.raises(UnusableInputError, match="larger than 0 KiB; give less"):
        read_bounded(tmp_path / "link", 9, UnusableInputError, "give less")
