"""`sightline compare` measures a folder of images beside the twin's, and says what it cannot."""

import json
from pathlib import Path

import numpy as np
import pytest

from sightline.imaging import Radiograph, write_png


@pytest.mark.slow
def test_an_image_of_beads_is_measured_beside_its_twin(run, pair, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    (folder / "beads.dcm").write_bytes(pair["pa"].read_bytes())
    (folder / "notes.txt").write_text("not an image")
    ran = run("compare", folder, "--out", tmp_path / "out", "--json")
    assert ran.code == 0, ran.out
    (image,) = ran.document["images"]
    figures = {f["name"]: f for f in image["figures"]}
    # The image is itself one of the twin's: blur and noise must agree with those of the twin that is made beside it.
    assert abs(figures["edge spread"]["twin_over_real"] - 1) < 0.1
    assert abs(figures["noise at the median level"]["twin_over_real"] - 1) < 0.2
    assert figures["pincushion"]["real"] is None
    assert "lattice" in figures["pincushion"]["real_not_measurable"]
    (passed,) = ran.document["passed_over"]
    assert "notes.txt" in passed
    page = (tmp_path / "out" / "compare.html").read_text()
    assert "only one image" in page
    assert "notes.txt" in page
    assert 'src="data:image/jpeg;base64,' in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert json.loads((tmp_path / "out" / "compare.json").read_text())["images"] == ran.document["images"]


@pytest.mark.slow
def test_an_image_of_nothing_says_why_each_figure_is_missing(run, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    pixels = np.random.default_rng(1).normal(20000, 200, (300, 300)).astype(np.uint16)
    write_png(Radiograph(pixels, 65535.0), folder / "open.png")
    ran = run("compare", folder, "--out", tmp_path / "out", "--json")
    assert ran.code == 0, ran.out
    figures = {f["name"]: f for f in ran.document["images"][0]["figures"]}
    assert figures["edge spread"]["real"] is None
    assert figures["edge spread"]["real_not_measurable"] == "no beads or holes"
    assert figures["noise at the median level"]["real"] is not None
    assert ran.document["images"][0]["twin_shows"] == "open beam"
