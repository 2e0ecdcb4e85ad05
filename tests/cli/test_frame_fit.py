import csv

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.common.geometry.rigid import rigid_fit
from sightline.frame import Frame
from sightline.twin.xray.setup import with_errors

GAMMA = Frame.load("gamma")
TRUE = with_errors(GAMMA, np.random.default_rng(4))


@pytest.fixture
def table(tmp_path):
    """Two series of a frame with its own errors, 0.005 mm, from two stands."""
    rng = np.random.default_rng(3)
    rows = []
    for series in ("morning", "evening"):
        pose = RigidTransform.from_components(rng.uniform(-500, 500, 3), Rotation.random(rng=rng))
        for ball in TRUE.fiducials:
            at = pose.apply(np.array(ball.xyz_mm)) + 0.005 * rng.standard_normal(3)
            rows.append([series, ball.id, *at.round(5).tolist(), 0.005])

    def write(change=lambda rows: rows):
        with (tmp_path / "m.csv").open("w", newline="") as file:
            csv.writer(file).writerows([["series", "id", "x_mm", "y_mm", "z_mm", "sd_mm"], *change(rows)])
        return tmp_path / "m.csv"

    return write


@pytest.mark.slow
def test_a_measured_frame_is_written_and_passes_its_checks(run, table, tmp_path):
    out = tmp_path / "measured.json"
    ran = run(
        *("frame", "fit", table(), "--frame", "gamma", "--out", out, "--serial", "03", "--measured-on", "2024-05-17"),
        *("--temperature-c", 20, "--use-temperature-c", 25, "--json"),
    )
    assert ran.code == 0, ran.out
    assert ran.document["fle_mm"]["instrument_per_axis"] == pytest.approx(0.005, rel=0.1)
    nominal, true = (np.array([f.xyz_mm for f in one.fiducials]) for one in (GAMMA, TRUE))
    apart = rigid_fit(true, nominal).apply(true) - nominal
    rms = np.sqrt((apart**2).sum(axis=1).mean())
    assert ran.document["fle_mm"]["from_nominal_rms"] == pytest.approx(rms, abs=0.001)
    assert len(ran.document["balls"]) == 226
    frame = Frame.load(out)
    assert (frame.serial, frame.measured_on, frame.temperature_c) == ("03", "2024-05-17", 25.0)
    assert frame.covariance_mm2 is not None
    assert run("frame", "check", out, "--quiet").code == 0
    said = run("frame", "fit", table(), "--frame", "gamma", "--out", tmp_path / "again.json").out
    assert "FLE: the balls are" in said and "the repeated measurements show an instrument error of 0.0" in said


def test_exchanged_balls_end_with_3_and_write_nothing(run, table, tmp_path):
    def exchange(rows):
        rows[3][1], rows[4][1] = rows[4][1], rows[3][1]
        return rows

    ran = run("frame", "fit", table(exchange), "--frame", "gamma", "--out", tmp_path / "m.json", "--json")
    assert ran.code == 3
    assert ran.document["file"] is None
    assert ran.document["series"][0]["renamed"] == {"pa-x-1-5": "pa-x-1-4", "pa-x-1-4": "pa-x-1-5"}
    assert not (tmp_path / "m.json").exists()
    said = run("frame", "fit", tmp_path / "m.csv", "--frame", "gamma", "--out", tmp_path / "m.json").out
    assert "measured as" in said


def test_a_plate_numbered_from_another_corner_is_told_as_one_thing(run, table, tmp_path):
    def turn(rows):
        for row in rows:
            if row[1].startswith("pa-s-"):
                r, c = row[1].split("-")[2:]
                row[1] = f"pa-s-{9 - int(r)}-{c}"
        return rows

    ran = run("frame", "fit", table(turn), "--frame", "gamma", "--out", tmp_path / "m.json", "--json")
    assert ran.code == 3
    (check,) = ran.document["checks"]
    assert "the pa source plate is numbered from another corner" in check["sentence"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--frame", "delta"), "delta"),
        (("--frame", "gamma", "--covariance", "no.csv"), "cannot read no.csv"),
        (("--frame", "gamma", "--use-temperature-c", "20"), "together with"),
        (("--frame", "gamma", "--drift-mm", "9"), "drift"),
    ],
)
def test_unusable_arguments_end_with_2(run, table, tmp_path, arguments, words):
    ran = run("frame", "fit", table(), "--out", tmp_path / "m.json", *arguments)
    assert ran.code == 2
    assert words in ran.err
    assert not (tmp_path / "m.json").exists()


def test_a_measured_block_becomes_a_frame_file(run, tmp_path):
    rows = ["id,x_mm,y_mm,z_mm,sd_mm"]
    rng = np.random.default_rng(9)
    for f in Frame.load("block30").fiducials:
        x, y, z = np.array(f.xyz_mm) + 0.02 * rng.standard_normal(3)
        rows.append(f"{f.id},{y:.4f},{z:.4f},{x:.4f},0.005")  # the instrument's axes are other ones
    (tmp_path / "measured.csv").write_text("\n".join(rows))
    ran = run("frame", "fit", tmp_path / "measured.csv", "--frame", "block30", "--out", tmp_path / "b.json", "--json")
    assert ran.code == 0, ran.err
    (body,) = ran.document["plates"]
    assert (body["view"], body["measured"], body["across_rms_mm"]) == ("solid", 12, None)
    assert Frame.load(tmp_path / "b.json").covariance_mm2.shape == (36, 36)
    told = run("frame", "fit", tmp_path / "measured.csv", "--frame", "block30", "--out", tmp_path / "c.json").out
    assert "Solid, measured minus frame file" in told
