"""`sightline assess` on the twin: errors as predicted, wrong coordinates found out."""

from pathlib import Path

import numpy as np
import pytest

POINTS_MM = np.array([[-18.0, -16.0, -12.0], [20.0, -12.0, 14.0], [-14.0, 20.0, 16.0], [16.0, 18.0, -15.0]])
PIXELS = ",pa_u_px,pa_v_px,lateral_u_px,lateral_v_px"


def table(path: Path, setup, xyz_mm: np.ndarray) -> Path:
    """Pixels of the true places with 0.1 px of noise, beside the coordinates that are claimed."""
    rng = np.random.default_rng(4)
    uv = [setup.views[view].project(POINTS_MM) + rng.normal(0, 0.1, (4, 2)) for view in ("pa", "lateral")]
    lines = [
        ",".join([f"ball{i}", *(f"{v:.4f}" for v in (*xyz_mm[i], *uv[0][i], *uv[1][i]))]) for i in range(len(POINTS_MM))
    ]
    path.write_text("\n".join([f"name,x_mm,y_mm,z_mm{PIXELS}", *lines]) + "\n")
    return path


def test_errors_are_as_predicted_unless_a_coordinate_is_wrong(run, beads_csv: Path, setup, tmp_path: Path) -> None:
    truth = table(tmp_path / "points.csv", setup, POINTS_MM)
    ran = run("assess", beads_csv, beads_csv, "--truth", truth, "--pick-sd", "0.1", "--json")
    assert ran.code == 0, ran.out
    document = ran.document
    assert [p["name"] for p in document["points"]] == ["ball0", "ball1", "ball2", "ball3"]
    for point in document["points"]:
        assert point["error_mm"] == pytest.approx(
            np.linalg.norm(np.subtract(point["reconstructed_mm"], point["measured_mm"]))
        )
        assert point["error_mm"] < 1.5 * point["predicted_95_mm"]  # a fixed seed
    assert document["largest_mm"] == max(p["error_mm"] for p in document["points"])
    assert [row["what"].split()[0] for row in document["table"]] == ["position", "distance", "angle"]
    wrong = table(tmp_path / "wrong.csv", setup, POINTS_MM + 3.0 * (np.arange(12).reshape(4, 3) == 6))
    ran = run("assess", beads_csv, beads_csv, "--truth", wrong, "--pick-sd", "0.1")
    assert ran.code == 3
    for words in ("ball2", "After ASTM F2554", "errors as predicted", "FAIL"):
        assert words in ran.out


def test_a_point_whose_gap_failed_gets_no_predicted_error(run, beads_csv: Path, setup, tmp_path: Path) -> None:
    """One lateral pick 25 px aside, to where a gap opens."""
    truth = table(tmp_path / "points.csv", setup, POINTS_MM)
    lines = truth.read_text().splitlines()
    cells = lines[3].split(",")
    cells[-2:] = [str(float(cells[-2]) + 17.7), str(float(cells[-1]) + 17.7)]
    truth.write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:]]) + "\n")
    ran = run("assess", beads_csv, beads_csv, "--truth", truth, "--pick-sd", "0.1", "--json")
    assert ran.code == 3
    assert [p["predicted_95_mm"] is None for p in ran.document["points"]] == [False, False, True, False]
    assert [p["normalised"] is None for p in ran.document["points"]] == [False, False, True, False]
    gaps = [check for check in ran.document["checks"] if check["name"] == "gap"]
    assert [check["passed"] for check in gaps] == [True, True, False, True]
    assert "ball2" in gaps[2]["sentence"]
