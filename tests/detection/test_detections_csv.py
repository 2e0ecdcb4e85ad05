"""Unlabelled beads from a file are labelled like those of the image; a bad file is refused with its line."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks.scenes.plates import Hiding, draw_scene

from sightline.detection import Detections
from sightline.detection.csv_files import are_detections, label_csv, read_detections
from sightline.detection.labelling import label
from sightline.errors import ObservationsError


@pytest.fixture(scope="module")
def beads(frame) -> Detections:
    return draw_scene(np.random.default_rng(21), frame, "lateral", Hiding(most=0.15)).detections


def written(beads: Detections, file: Path, columns: str) -> Path:
    of = {
        "u_px": beads.uv_px[:, 0],
        "v_px": beads.uv_px[:, 1],
        "radius_px": beads.radius_px,
        "sd_px": np.sqrt(beads.covariance_px2[:, 0, 0]),
        "suu_px2": beads.covariance_px2[:, 0, 0],
        "suv_px2": beads.covariance_px2[:, 0, 1],
        "svv_px2": beads.covariance_px2[:, 1, 1],
        "contrast": beads.contrast,
    }
    names = columns.split(",")
    rows = [",".join(b if n == "kind" else repr(float(of[n][i])) for n in names) for i, b in enumerate(beads.kind)]
    file.write_text("\n".join([columns, *rows]) + "\n")
    return file


@pytest.mark.parametrize(
    ("columns", "known"),
    [
        ("u_px,v_px,radius_px", False),
        ("u_px,v_px,radius_px,sd_px", True),
        ("u_px,v_px,radius_px,suu_px2,suv_px2,svv_px2,kind,contrast", True),  # as `sightline detect --csv` writes
    ],
)
def test_they_are_told_apart_as_those_of_the_image(beads, frame, tmp_path: Path, columns: str, known: bool) -> None:
    file = written(beads, tmp_path / "beads.csv", columns)
    assert are_detections(file)
    found, wanted = label_csv(file, frame), label(beads, frame)
    at = dict(zip(wanted.ids, wanted.uv_px, strict=True))
    assert found.view == "lateral"
    assert len(found.ids) >= len(wanted.ids) - 2
    assert all(np.array_equal(at[name], uv) for name, uv in zip(found.ids, found.uv_px, strict=True) if name in at)
    assert (found.covariance_px2 is not None) == known
    assert found.image_shape is None


def test_observations_are_not_taken_for_them(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("view,id,u_px,v_px\npa,x,1,2\n")
    assert not are_detections(tmp_path / "a.csv")
    assert not are_detections(tmp_path / "missing.csv")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("u_px,v_px\n1,2\n", "does not state radius_px.*name each bead"),
        ("u_px,v_px,radius_px\n", "holds no beads"),
        ("u_px,v_px,radius_px,x\n1,2,3,4\n", "the columns are"),
        ("u_px,v_px,radius_px,suu_px2\n1,2,3,4\n", "the columns are"),
        ("u_px,v_px,radius_px,radius_px\n1,2,3,4\n", "a column twice"),
        ("u_px,v_px,radius_px\n1,2,3\n1,nan,3\n", "line 3"),
        ("u_px,v_px,radius_px\n1,2\n", "line 2"),
        ("u_px,v_px,radius_px\n1,2,3,4\n", "line 2"),
        ("u_px,v_px,radius_px\n1,2,0\n", "line 2: a radius above zero"),
        ("u_px,v_px,radius_px\n1e9,2,3\n", "line 2"),
        ("u_px,v_px,radius_px,sd_px\n1,2,3,-0.1\n", "line 2: the error is not positive"),
        ("u_px,v_px,radius_px,suu_px2,suv_px2,svv_px2\n1,2,3,1,2,1\n", "line 2: the error is not positive"),
        ("u_px,v_px,radius_px,kind\n1,2,3,star\n", "line 2"),
        ('u_px,v_px,radius_px\n"1,2,3\n', "plain comma-separated"),
    ],
)
def test_what_cannot_be_read_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "beads.csv").write_text(text)
    with pytest.raises(ObservationsError, match=words):
        read_detections(tmp_path / "beads.csv")
