"""A frame file with a plate on the detector: reading, writing, errors of its balls, checks, drawings."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.common.checks import failed
from sightline.errors import FrameError
from sightline.frame import Frame, InUse, Plate, Tolerances
from sightline.frame.check import check_frame
from sightline.frame.drawings.part import parts_of
from sightline.frame.drawings.workshop import bill_rows, inspection_csv, write_workshop

FRAME = Frame.load("block40+detector-plate")


def test_the_file_is_read_as_it_was_written(tmp_path):
    stated = replace(FRAME, serial="7", tolerances=Tolerances(0.03, 0.0, 0.0, 0.0, 0.0))
    stated.save(tmp_path / "mine.json")
    again = Frame.load(tmp_path / "mine.json")
    assert (again.solid, again.detector, again.serial) == (FRAME.solid, FRAME.detector, "7")
    assert again.fingerprint == stated.fingerprint
    assert again.fiducials_of("anything") == FRAME.solid.fiducials + FRAME.detector.fiducials
    assert again.rows("anything") == slice(0, 3 * (14 + 69))


def test_files_without_a_plate_do_not_change():
    for name in ("gamma", "block60"):
        assert b'"detector"' not in Frame.load(name).to_json() and Frame.load(name).detector is None


def test_balls_share_no_errors_but_each_body_expands_about_its_middle():
    factor = replace(FRAME, in_use=InUse(10.0, 0.0, 0.0)).error_factor
    np.testing.assert_array_equal(factor[:, : len(factor)], 0.02 * np.eye(len(factor)))
    heat = factor[:, len(factor)].reshape(-1, 3)
    for body, own in ((FRAME.solid, heat[:14]), (FRAME.detector, heat[14:])):
        np.testing.assert_allclose(own, 70e-5 * (body.xyz_mm - body.xyz_mm.mean(axis=0)), atol=1e-12)


def test_a_plate_is_added_to_a_solid():
    measured = replace(Frame.load("block60"), covariance_mm2=1e-4 * np.eye(48))
    both = measured.with_plate()
    assert both.name == "block60+detector-plate" and both.covariance_mm2.shape == (3 * 85, 3 * 85)
    np.testing.assert_allclose(np.diag(both.covariance_mm2)[[0, 47, 48, -1]], [1e-4, 1e-4, 4e-4, 4e-4])
    with pytest.raises(FrameError, match="has plates of its own"):
        Frame.load("gamma").with_plate()
    with pytest.raises(FrameError, match="both have a ball 'b1'"):
        FRAME.with_plate(Plate(FRAME.solid.fiducials))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda document: document.pop("solid"), "plates of one view"),
        (lambda document: document.update(detector=document["detector"][:11]), "too few entries"),
        (lambda document: document["detector"][0].update(id="b1"), "'b1' occurs twice"),
    ],
)
def test_impossible_files_are_refused(change, why):
    import json

    document = json.loads(FRAME.to_json())
    change(document)
    with pytest.raises(FrameError, match=why):
        Frame.from_json(json.dumps(document).encode())


def test_plates_of_views_do_not_go_with_one_on_the_detector():
    import json

    document = json.loads(Frame.load("gamma").to_json()) | {"detector": json.loads(FRAME.to_json())["detector"]}
    with pytest.raises(FrameError, match='goes with a "solid"'):
        Frame.from_json(json.dumps(document).encode())


def test_checks_pass_and_find_a_bent_and_a_symmetric_plate():
    assert not failed(check_frame(FRAME))
    balls = list(FRAME.detector.fiducials)
    bent = replace(balls[0], xyz_mm=(*balls[0].xyz_mm[:2], 23.0))
    names = [check.name for check in failed(check_frame(replace(FRAME, detector=Plate((bent, *balls[1:])))))]
    assert names == ["plate-flat"]
    corners = {"d-3-3", "d-3-7", "d-7-3", "d-7-7"}
    square = tuple(replace(f, datum=f.id in corners, diameter_mm=3.0 if f.id in corners else 2.0) for f in balls)
    names = [check.name for check in failed(check_frame(replace(FRAME, detector=Plate(square))))]
    assert names == ["datum-symmetry"]


def test_the_workshop_gets_the_plate_too(tmp_path):
    parts = parts_of(FRAME)
    assert [part.name for part in parts if part.view is not None] == ["detector-plate"]
    assert len(parts[-1].bores) == 69
    assert {item for item, *_ in bill_rows(parts)} >= {"block", "plate detector-plate", "ball ø2 mm, fiducial"}
    assert len(inspection_csv(FRAME).splitlines()) == 1 + 14 + 69
    names = {path.name for path in write_workshop(FRAME, tmp_path / "shop")}
    assert {"detector-plate.svg", "detector-plate.stl", "solid.stl", "assembly.png", "bill.md"} <= names
