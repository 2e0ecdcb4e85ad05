"""Pairs of views from files: what is recognised, and what is refused."""

from copy import copy
from pathlib import Path

import numpy as np
import pytest

from sightline.calibration import CArm
from sightline.case.report.content import Compared
from sightline.case.views import ImageSlot, calibrate_pair, see_pair, stated_view, view_document
from sightline.detection.csv_files import write_observations
from sightline.errors import ObservationsError, UnusableInputError
from sightline.from_images.pipeline import known_arm
from sightline.imaging import GeometryTags, Radiograph


@pytest.fixture
def csv(pair, tmp_path: Path) -> Path:
    return write_observations([one.observations for one in pair], tmp_path / "beads.csv")


def test_one_csv_may_hold_both_views(csv, frame, pair) -> None:
    pa, lateral = see_pair(csv, csv, frame)
    assert (pa.observations.view, lateral.observations.view) == ("pa", "lateral")
    np.testing.assert_array_equal(pa.observations.uv_px, pair[0].observations.uv_px)
    assert pa.image is None


def test_a_csv_without_the_view_names_those_it_has(pair, frame, tmp_path: Path) -> None:
    only = write_observations([pair[0].observations], tmp_path / "pa.csv")
    with pytest.raises(ObservationsError, match=r"pa\.csv holds no observations of view 'lateral'; it has: pa"):
        see_pair(only, only, frame)


@pytest.mark.parametrize(
    ("order", "words"),
    [
        (("lateral", "pa"), "swapped"),
        (("pa", "pa"), "given as the lateral view"),
        (("lateral", "lateral"), "as the pa"),
    ],
)
def test_images_in_the_wrong_place_are_recognised_by_their_plates(pair, frame, monkeypatch, order, words) -> None:
    by_name = {one.observations.view: one for one in pair}
    monkeypatch.setattr("sightline.case.views.see", lambda path, frame, view, *, invert: by_name[path.stem])
    with pytest.raises(UnusableInputError, match=words):
        see_pair(Path(f"{order[0]}.dcm"), Path(f"{order[1]}.dcm"), frame)


def test_a_view_as_json_holds_every_bead(report) -> None:
    document = view_document(report.images[0])
    assert document["view"] == "pa"
    assert [b["id"] for b in document["beads"]] == list(report.images[0].view.residuals.ids)
    assert 0.0 < document["residual_rms_mm"] < document["leave_one_out_rms_mm"]


def test_what_is_given_of_the_c_arm_comes_before_what_a_file_says() -> None:
    pixels = np.zeros((32, 32), np.uint8)

    def image(distance, spacing) -> Radiograph:
        tags = GeometryTags(source_detector_mm=distance, imager_pixel_spacing_mm=spacing)
        return Radiograph(pixels, 255.0, tags)

    assert known_arm(image(1000.0, (0.2, 0.2))) == CArm(1000.0, 0.2)
    assert known_arm(image(1000.0, (0.2, 0.2)), 980.0, 0.4) == CArm(980.0, 0.4)
    assert known_arm(image(1000.0, None)) == CArm(1000.0)
    assert known_arm(image(None, (0.2, 0.2)), 980.0) == CArm(980.0, 0.2)
    assert known_arm(image(1000.0, (0.2, 0.3))) == CArm(1000.0)  # no one focal length belongs to it
    assert known_arm(image(None, (0.2, 0.2))) is None
    assert known_arm(None, 980.0) == CArm(980.0)


def test_both_views_are_held_against_the_c_arm(pair, frame) -> None:
    for distance, passes in ((1000.0, True), (800.0, False)):
        for image in calibrate_pair(pair, frame, "smooth", source_detector_mm=distance):
            assert image.view.c_arm == CArm(distance)
            assert [c.passed for c in image.view.checks if c.name == "source distance"] == [passes]


def test_errors_against_the_truth(report, truth) -> None:
    one = Compared("smooth", "by hand", report.plan.trajectory, truth)
    entry, tip = one.errors_mm
    assert entry == pytest.approx(np.linalg.norm(report.plan.trajectory.entry_mm - truth.xyz_mm[0]))
    assert tip < 2.0
    # The direction turns by no more than the two ends' errors over the length.
    assert one.direction_error_rad <= np.arcsin((entry + tip) / report.plan.trajectory.length_mm)
    assert one.document()["within_bounds"] == one.within_bounds


@pytest.mark.parametrize(
    ("primary", "secondary", "view"),
    [
        (0.0, None, "pa"),
        (-24.0, 5.0, "pa"),
        (178.0, 0.0, "pa"),
        (90.0, -10.0, "lateral"),
        (-70.0, 0.0, "lateral"),
        (45.0, 0.0, "oblique"),
        (0.0, 40.0, "oblique"),  # tilted to the head
        (28.0, 0.0, None),
        (63.0, 0.0, None),
        (None, 0.0, None),
    ],
)
def test_the_angles_of_the_c_arm_name_a_view_where_it_is_near_to_one(primary, secondary, view) -> None:
    tags = GeometryTags(primary_angle_deg=primary, secondary_angle_deg=secondary)
    assert stated_view(Radiograph(np.zeros((64, 64), np.uint16), white=1.0, tags=tags)) == view


@pytest.mark.parametrize(("view", "purpose"), [("pa", ""), ("lateral", "check"), ("oblique", "shot")])
def test_a_slot_is_its_name_in_files_and_comes_back_from_it_and_from_a_copy(view: str, purpose: str) -> None:
    slot = ImageSlot(view, purpose)
    assert slot == (f"{purpose}-{view}" if purpose else view)
    for again in (ImageSlot.read(str(slot)), copy(slot)):
        assert (again, again.view, again.purpose) == (slot, view, purpose)
