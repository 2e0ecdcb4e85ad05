from dataclasses import replace

import numpy as np
import pytest

from sightline.common.geometry.rigid import rigid_fit
from sightline.detection.csv_files import write_observations
from sightline.detection.results import Observations
from sightline.frame import Frame, Tolerances
from sightline.twin.xray.setup import bead_images, displaced, draw_setup, with_errors


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Two pairs of views of a frame with one ball displaced by 0.6 mm, each pair a CSV."""
    rng = np.random.default_rng(31)
    frame = Frame.load("gamma")
    moves = np.zeros((226, 3))
    moves[70] = (0.6, 0.0, 0.0)
    true = displaced(with_errors(frame, rng), moves)
    folder, out = tmp_path_factory.mktemp("check"), []
    for k in range(2):
        setup = draw_setup(rng, true, frame_errors=False)
        views = []
        for view in ("pa", "lateral"):
            ids, uv = bead_images(setup, view, rng, 0.1)
            views.append(Observations(view, ids, uv, np.broadcast_to(0.01 * np.eye(2), (len(ids), 2, 2))))
        out.append(write_observations(views, folder / f"{k}.csv"))
    return out


@pytest.mark.slow  # tests/calibration/test_self_check.py proves the estimate
def test_a_displaced_ball_is_named_and_the_frame_written(run, tables, tmp_path):
    ran = run("frame", "self-check", *tables, "--frame", "gamma", "--out", tmp_path / "found.json", "--json")
    assert ran.code == 0, ran.out
    view = Frame.load("gamma").view("pa")
    assert ran.document["misplaced"] == [view.fiducials[70].id]
    assert ran.document["images"] == 4
    seen = {(p["view"], p["motion"]): p["seen"] for p in ran.document["plates"]}
    assert seen["pa", "twist"]
    assert not any(seen["pa", motion] for motion in ("shift 1", "shift 2", "along the beam"))
    assert Frame.load(tmp_path / "found.json").covariance_mm2 is not None
    said = run("frame", "self-check", *tables).out
    assert "not seen" in said and "Images show neither the scale" in said


def test_an_image_is_read_like_any_other(run, pair, tables, tmp_path):
    ran = run("frame", "self-check", pair["pa"], tables[0], "--json")
    assert ran.code == 3
    assert "4 or more" in ran.document["error"]["message"]


def test_one_file_twice_is_refused(run, tables):
    assert run("frame", "self-check", tables[0], tables[0]).code == 2


@pytest.mark.slow
def test_a_printed_block_is_measured_by_six_images_and_a_calliper(run, tmp_path):
    """0.15 mm rms from the drawing before, 0.02 mm from the truth after, as stated."""
    block = replace(Frame.load("block60"), name="printed", tolerances=Tolerances(0.2, 0.0, 0.0, 0.0, 0.0))
    block.save(tmp_path / "printed.json")
    images = []
    for seed in ("1", "2", "3"):
        out = tmp_path / seed
        given = ("object", "--frame", tmp_path / "printed.json", "--frame-errors", "7", "--seed", seed, "--out", out)
        assert run("simulate", *given, "--dose", "high").code == 0
        images += [out / "pa.dcm", out / "lateral.dcm"]
    true = Frame.load(tmp_path / "1/frame-as-made.json").solid.xyz_mm
    distance = f"b1,b4,{np.linalg.norm(true[3] - true[0]) + 0.01:.2f},0.02"
    given = (*images, "--frame", tmp_path / "printed.json", "--distance", distance, "--out", tmp_path / "found.json")
    ran = run("frame", "self-check", *given)
    assert ran.code == 0, ran.err
    found = Frame.load(tmp_path / "found.json")
    off = rigid_fit(true, found.solid.xyz_mm).apply(true) - found.solid.xyz_mm
    stated = np.sqrt(np.trace(found.covariance_mm2) / off.size)
    assert np.sqrt(np.mean((true - block.solid.xyz_mm) ** 2)) > 0.12
    assert np.sqrt(np.mean(off**2)) < min(0.02, 1.5 * stated)
