"""`sightline calibrate` from an image and from observations, on a set-up whose truth is known."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sightline.imaging import Radiograph, read_image, write_png


@pytest.mark.parametrize("method", ["smooth", "localized", "polynomial"])
def test_observations_give_the_view_with_its_residuals_and_checks(run, beads_csv: Path, setup, method: str) -> None:
    ran = run("calibrate", beads_csv, "--view", "lateral", "--method", method, "--json")
    assert ran.code in (0, 3), ran.err
    document = ran.document
    assert (document["view"], document["method"], document["coordinates"]) == ("lateral", method, "CFCS")
    failed = [check["name"] for check in document["checks"] if not check["passed"]]
    assert (ran.code == 3) == bool(failed)
    if method == "smooth":
        assert not failed
        truth = setup.views["lateral"].focal_point_mm
        np.testing.assert_allclose(document["focal_point_mm"], truth, atol=12.0)  # along the beam it is ill determined
        assert document["leave_one_out_rms_mm"] < 0.15
    first = document["beads"][0]
    assert set(first) >= {"id", "uv_px", "residual_mm", "leave_one_out_mm", "used"}


def test_an_image_gives_the_same_view_as_its_observations_written_as_csv(run, pair, tmp_path: Path) -> None:
    files = ("--csv", tmp_path / "pa.csv", "--picture", tmp_path / "pa.png")
    image = run("calibrate", pair["pa"], "--frame", "gamma", "--view", "pa", *files, "--json")
    assert image.code in (0, 3), image.out
    again = run("calibrate", tmp_path / "pa.csv", "--json")
    assert again.code == image.code
    np.testing.assert_allclose(again.document["focal_point_mm"], image.document["focal_point_mm"], rtol=1e-9)
    assert again.document["set_up"] is None  # a table does not say where its image ended
    picture = cv2.imread(str(tmp_path / "pa.png"))
    assert min(picture.shape[:2]) > 500
    assert (np.ptp(picture, axis=2) > 60).mean() > 0.001  # arrows in colour over a grey image


@pytest.mark.slow
def test_an_image_that_cuts_the_plates_says_what_to_move(run, pair, tmp_path: Path) -> None:
    """A third of the field is shuttered: the beads there are lost, and the frame can be moved out of the shadow."""
    image = read_image(pair["pa"])
    pixels = np.array(image.pixels)
    pixels[:, : pixels.shape[1] // 3] = 0
    path = write_png(Radiograph(pixels, image.white), tmp_path / "cut.png")
    whole, cut = (run("calibrate", p, "--json").document["set_up"] for p in (pair["pa"], path))
    assert sum(cut["outside"].values()) > 0.2 + sum(whole["outside"].values())
    assert "outside the field: move the frame" in cut["sentences"][0]
    assert sum(cut["outside_after"].values()) < sum(cut["outside"].values())
    assert "move the frame" in run("calibrate", path).out


def test_people_read_the_focal_point_the_residuals_and_the_checks(run, beads_csv: Path) -> None:
    ran = run("calibrate", beads_csv, "--view", "pa", "--all")
    assert ran.code == 0, ran.err
    for text in ("view pa", "focal point", "leave-one-out", "bead coverage"):
        assert text in ran.out


def test_the_frame_is_said_first_and_the_balls_tell_another(run, beads_csv: Path, pair) -> None:
    assert run("calibrate", beads_csv, "--view", "pa").out.startswith("frame: gamma (assumed; --frame names another)\n")
    ran = run("calibrate", pair["pa"], "--frame", "biplane")
    assert ran.code == 3 and ran.out.startswith("frame: biplane\n")
    assert "the image shows the frame gamma, not biplane: give --frame gamma. With biplane: " in ran.said


def test_exchanged_images_of_a_measured_frame_are_not_called_another_frame(run, pair, frame, tmp_path: Path) -> None:
    own = tmp_path / "own.json"
    own.write_bytes(replace(frame, name="own").to_json())
    ran = run("calibrate", pair["pa"], "--frame", own, "--view", "lateral")
    assert ran.code == 3 and "are the two images exchanged" in ran.said
    assert "give --frame" not in ran.said


def test_datum_markers_given_by_hand_tell_the_beads_apart(run, pair, setup, frame) -> None:
    """The person gives those that can be seen: some lie behind other balls."""
    seen = np.array([bead["uv_px"] for bead in run("detect", pair["pa"], "--json").document["beads"]])
    markers = [f for f in frame.view("pa").fiducials if f.datum]
    uv_px = setup.views["pa"].project(np.array([f.xyz_mm for f in markers]))
    clear = np.linalg.norm(seen[None] - uv_px[:, None], axis=2).min(axis=1) < 2.0
    assert clear.sum() >= 8
    given = [f"--datum={f.id}={u:.1f},{v:.1f}" for f, (u, v), c in zip(markers, uv_px, clear, strict=True) if c]
    ran = run("calibrate", pair["pa"], *given, "--json")
    assert ran.code in (0, 3), ran.out
    assert ran.document["view"] == "pa", ran.out


def test_detections_without_names_calibrate_like_their_image(run, pair, tmp_path: Path) -> None:
    beads = tmp_path / "beads.csv"
    assert run("detect", pair["pa"], "--csv", beads).code == 0
    ran, of_image = run("calibrate", beads, "--json"), run("calibrate", pair["pa"], "--json")
    assert ran.document["view"] == "pa"
    apart = np.subtract(ran.document["focal_point_mm"], of_image.document["focal_point_mm"])
    assert np.abs(apart).max() < 10.0  # the image is looked at again for beads that were missed; the file is not
    assert run("calibrate", beads, "--frame-index", "0").code == 2


@pytest.mark.parametrize(
    ("options", "failing"),
    [
        (["--sid", "1000", "--pixel", "0.21"], []),
        (["--sid", "700"], ["source distance"]),
        (["--sid", "1000", "--pixel", "0.42"], ["focal length"]),
    ],
)
def test_the_c_arms_distance_is_held_against_the_view(run, beads_csv: Path, options, failing) -> None:
    ran = run("calibrate", beads_csv, "--view", "pa", *options, "--json")
    assert ran.code == (3 if failing else 0)
    assert sorted(ran.failing) == failing
    made = {check["name"] for check in ran.document["checks"]}
    assert ("focal length" in made) == ("--pixel" in options)


def test_a_mirror_image_is_found_and_said(run, pair, tmp_path: Path) -> None:
    """Its geometry is as good as any other; the person must know before picking a side."""
    image = read_image(pair["pa"])
    path = write_png(Radiograph(image.pixels[:, ::-1].copy(), image.white), tmp_path / "mirrored.png")
    ran = run("calibrate", path, "--json")
    assert ran.code in (0, 3)
    assert "mirror" in ran.document["error"]["message"] if "error" in ran.document else ran.document["mirrored"] is True
