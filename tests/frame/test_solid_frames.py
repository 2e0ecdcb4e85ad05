"""Frames of one solid: their file, their errors, and what is refused."""

import json

import numpy as np
import pytest

from sightline.errors import FrameError
from sightline.frame import Frame, InUse, Tolerances


def test_a_solid_is_read_back_as_it_was_written(tmp_path):
    frame = Frame.load("block60")
    frame.save(tmp_path / "block.json")
    again = Frame.load(tmp_path / "block.json")
    assert again.solid == frame.solid and again.views == {} and again.name == "block60"
    stated = Frame("mine", {}, solid=frame.solid, tolerances=Tolerances(0.01, 0.0, 0.0, 0.0, 0.0), serial="7")
    stated.save(tmp_path / "mine.json")
    again = Frame.load(tmp_path / "mine.json")
    assert again.tolerances == stated.tolerances and again.key == "mine/7"


def test_beads_of_a_solid_err_alone_and_expand_together():
    frame = Frame.load("block60")
    beads = len(frame.fiducials)
    np.testing.assert_array_equal(frame.error_factor, 0.02 * np.eye(3 * beads))
    assert frame.rows("pa") == frame.rows("any") == slice(0, 3 * beads)
    warm = Frame("warm", {}, solid=frame.solid, in_use=InUse(5.0, 0.0, 0.0)).error_factor
    growth = warm[:, 3 * beads].reshape(beads, 3)
    away = np.array([f.xyz_mm for f in frame.fiducials])
    np.testing.assert_allclose(growth, 5.0 * 70e-6 * (away - away.mean(axis=0)), atol=1e-12)


def test_every_view_shows_the_balls_of_a_solid_which_has_no_plates():
    frame = Frame.load("block60")
    assert frame.fiducials_of("pa") == frame.fiducials_of("oblique") == frame.fiducials
    with pytest.raises(FrameError, match="a solid without plates"):
        frame.view("pa")
    gamma = Frame.load("gamma")
    assert gamma.fiducials_of("pa") == gamma.view("pa").fiducials
    assert gamma.fiducials == gamma.fiducials_of("pa") + gamma.fiducials_of("lateral")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.pop("solid"), "give the plates of one view or more"),
        (lambda d: d.update(views=json.loads(Frame.load("gamma").to_json())["views"]), "not both"),
        (lambda d: d.update(solid=d["solid"][:5]), "has 5 beads"),
        (lambda d: d.update(sd_rad={"plate": 0.0, "arm": 0.0}), "no plates and no arms"),
        (lambda d: d.update(sd_mm={"bead": 0.02, "plate": 0.0, "arm": 0.0}), "no plates and no arms"),
        (lambda d: d["solid"].append(d["solid"][0]), "occurs twice"),
    ],
)
def test_impossible_solids_are_refused(change, said):
    document = json.loads(Frame.load("block60").to_json())
    change(document)
    with pytest.raises(FrameError, match=said):
        Frame.from_json(json.dumps(document).encode())


def test_plates_still_need_all_their_tolerances():
    document = json.loads(Frame.load("gamma").to_json())
    document |= {"sd_mm": {"bead": 0.02, "plate": 0.05}, "sd_rad": {"plate": 0.0, "arm": 0.0}}
    with pytest.raises(FrameError, match=r"sd_mm\.arm is missing"):
        Frame.from_json(json.dumps(document).encode())
