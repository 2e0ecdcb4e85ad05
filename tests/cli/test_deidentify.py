"""`sightline export deidentify`: clean files under names that tell nothing, or none."""

from pathlib import Path

import numpy as np
import pytest
from pydicom import dcmread

from sightline.imaging import Radiograph, read_image, write_dicom


@pytest.fixture
def pair(tmp_path: Path) -> list[Path]:
    """Images with a patient's name within and on the file."""
    rng, files = np.random.default_rng(3), []
    for name in ("pa", "lateral"):
        pixels = rng.integers(200, 4000, (40, 30)).astype(np.uint16)
        files.append(write_dicom(Radiograph(pixels, 4095.0), tmp_path / f"MILLER_ANNA_{name}.dcm"))
        data = dcmread(files[-1])
        data.PatientName = "MILLER^ANNA"
        data.save_as(files[-1])
    return files


def test_images_come_out_clean_under_numbers_and_with_the_same_pixels(run, pair, tmp_path: Path) -> None:
    out = tmp_path / "clean"
    data = dcmread(pair[1])
    data.BurnedInAnnotation = "YES"
    data.save_as(pair[1])
    said = " ".join(run("export", "deidentify", *pair, "--out", tmp_path / "said").err.split())
    assert "burnt-in annotation is not removed; annotation found in image-002.dcm" in said
    ran = run("export", "deidentify", *pair, "--out", out, "--json")
    assert ran.code == 0, ran.out
    written = sorted(out.glob("[!.]*"))
    assert [file.name for file in written] == ["image-001.dcm", "image-002.dcm"]
    assert [one["file"] for one in ran.document["images"]] == [str(file) for file in written]
    assert "MILLER" not in ran.out.replace(str(tmp_path), "")
    for file, before in zip(written, pair, strict=True):
        assert b"MILLER" not in file.read_bytes().upper()
        np.testing.assert_array_equal(read_image(file).pixels, read_image(before).pixels)
