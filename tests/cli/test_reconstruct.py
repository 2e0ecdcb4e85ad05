"""`sightline reconstruct` on files as XMALab, DLTdv and people write them; truth by numpy's matrices."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tests.planning.test_many import COVARIANCE, MATRICES, _pixels

import sightline as sl
from sightline.calibration.exchange.formats import write_view
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.calibration.exchange.point_table import read_points
from sightline.case.saved import document
from sightline.errors import UnusableInputError

FRAMES, NAMES = 7, ("tip", "base, left", "M3")
XYZ = np.random.default_rng(8).uniform(-50.0, 50.0, (FRAMES, len(NAMES), 3))
UV = np.array([_pixels(m, XYZ.reshape(-1, 3)).reshape(FRAMES, -1, 2) for m in MATRICES[:2]])
UNDISTORTED = ("--points", "undistorted", "--first-pixel", 0)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("views") / "views.json"
    made = zip(MATRICES, COVARIANCE, ("cam1", "cam2"), strict=False)
    path.write_text(json.dumps([document(sl.view_from_matrix(m, c, name), source="") for m, c, name in made]))
    return path


def _wide(uv: np.ndarray, sep: str = " , ", point: str = ".", names: tuple[str, ...] = ("tip", "base", "M3")) -> str:
    header = [f"{name}_cam{k}_{axis}" for name in names for k in (1, 2) for axis in "XY"]
    rows = [["" if x != x else f"{x:.12g}".replace(".", point) for x in row] for row in _flat(uv)]
    return "\n".join(sep.join(row) for row in [header, *rows]) + "\n"


def _flat(uv: np.ndarray) -> list[list[float]]:
    return uv.transpose(1, 2, 0, 3).reshape(len(uv[0]), -1).tolist()


def _long(header: str = "frame,point,view,u_px,v_px") -> list[list[object]]:
    rows = [
        [f + 10, f'"{name}"' if "," in name else name, f"cam{k + 1}", *UV[k, f, p]]
        for k in (1, 0)
        for f in range(FRAMES)
        for p, name in enumerate(NAMES)
    ]
    return [header.split(","), *rows]


def _written(path: Path, rows: list[list[object]]) -> Path:
    path.write_text("\n".join(",".join(map(str, row)) for row in rows) + "\n")
    return path


def _found(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def _xyz(rows: list[dict[str, str]]) -> np.ndarray:
    return np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in rows])


def test_rows_of_our_own_in_any_order_give_a_row_for_each_point_and_frame(run, views: Path, tmp_path: Path) -> None:
    points = _written(tmp_path / "p.csv", _long("Frame,POINT,view,U_px,v_px"))
    ran = run("reconstruct", points, "--views", views, "--out", tmp_path / "xyz.csv", "--json")
    assert ran.code == 0, ran.out
    rows = _found(tmp_path / "xyz.csv")
    at = {(int(row["frame"]), row["point"]): xyz for row, xyz in zip(rows, _xyz(rows), strict=True)}
    for f, p in np.ndindex(FRAMES, len(NAMES)):
        np.testing.assert_allclose(at[f + 10, NAMES[p]], XYZ[f, p], atol=1e-4)  # four decimals are written
    assert all(float(row["zz_mm2"]) > 0.0 and float(row["gap_mm"]) < 1e-3 and not row["reason"] for row in rows)
    assert ran.document["reconstructed"] == len(rows) == FRAMES * len(NAMES)
    assert ran.document["pixels"] == "undistorted"


@pytest.mark.parametrize(("sep", "point"), [(" , ", "."), (",", "."), (";", ","), ("\t", ".")])
def test_the_columns_of_xmalab_give_the_points_and_holes_a_reason(
    run, views: Path, tmp_path: Path, sep: str, point: str
) -> None:
    uv = UV.copy()
    uv[1, 2, 0] = np.nan
    uv[:, 3, 1] = np.nan
    text = _wide(uv, sep, point).replace(f"{sep}{sep}", f"{sep}NaN{sep}", 1)
    (tmp_path / "p.csv").write_text(text)
    ran = run("reconstruct", tmp_path / "p.csv", "--views", views, "--out", tmp_path / "x.csv", *UNDISTORTED, "--json")
    assert ran.code == 0, ran.out
    rows = _found(tmp_path / "x.csv")
    missing = [k for k, row in enumerate(rows) if row["reason"]]
    assert missing == [2 * 3, 3 * 3 + 1]
    assert all(row["reason"] == "seen in fewer than two views" and row["x_mm"] == "" for row in (rows[6], rows[10]))
    kept = [k for k in range(len(rows)) if k not in missing]
    np.testing.assert_allclose(_xyz([rows[k] for k in kept]), XYZ.reshape(-1, 3)[kept], atol=1e-4)
    assert rows[0]["frame"] == "1"


def test_views_of_mayacam_2_files_and_pixels_counted_from_1(run, tmp_path: Path) -> None:
    files = []
    for matrix, name in zip(MATRICES, ("cam1", "cam2"), strict=False):
        for data in write_view(Pinhole.of_matrix(matrix, name, (1024, 1024)), "mayacam2").values():
            (tmp_path / f"{name}.txt").write_bytes(data)  # XMALab's files have any name
            files += ["--views", tmp_path / f"{name}.txt"]
    (tmp_path / "p.csv").write_text(_wide(UV + 1.0))
    given = (tmp_path / "p.csv", *files, "--out", tmp_path / "x.csv", "--points", "undistorted", "--first-pixel", 1)
    ran = run("reconstruct", *given)
    assert ran.code == 0, ran.err
    assert "errors unknown" in ran.out
    rows = _found(tmp_path / "x.csv")
    np.testing.assert_allclose(_xyz(rows), XYZ.reshape(-1, 3), atol=1e-4)
    assert {row["xx_mm2"] + row["gap_sigma"] for row in rows} == {""}


def test_what_the_file_does_not_state_must_be_given_and_agree_with_the_views(
    run, views: Path, beads_csv: Path, observations, setup, tmp_path: Path
) -> None:
    (tmp_path / "p.csv").write_text(_wide(UV))
    plain = ("reconstruct", tmp_path / "p.csv", "--views", views, "--out", tmp_path / "x.csv")
    assert "--points distorted or undistorted, and --first-pixel" in run(*plain).said
    assert run(*plain, "--points", "undistorted").code == 2
    assert "the points are distorted" in run(*plain, "--points", "distorted", "--first-pixel", 0).said
    own = _written(tmp_path / "own.csv", _long())
    assert "count from 0" in run("reconstruct", own, *plain[2:], "--first-pixel", 1).said
    beads = [document(sl.calibrate(seen, setup.frame), source="") for seen in observations.values()]
    (tmp_path / "beads.json").write_text(json.dumps(beads))
    raw = ("reconstruct", tmp_path / "p.csv", "--views", tmp_path / "beads.json", "--out", tmp_path / "x.csv")
    assert "the points are undistorted" in run(*raw, *UNDISTORTED).said
    (tmp_path / "y.csv").write_text(_wide(np.flip(UV, axis=0)))
    assert "cam1 and cam2 are exchanged" in run("reconstruct", tmp_path / "y.csv", *plain[2:], *UNDISTORTED).said
    (tmp_path / "up.csv").write_text(_wide(UV * [1.0, -1.0] + [0.0, 1023.0]))
    assert "y is counted from below" in run("reconstruct", tmp_path / "up.csv", *plain[2:], *UNDISTORTED).said
    assert not (tmp_path / "x.csv").exists()
    (tmp_path / "z.csv").write_text(_wide(np.array([UV[0], UV[1] + [0.0, 40.0]])))
    ran = run("reconstruct", tmp_path / "z.csv", *plain[2:], *UNDISTORTED, "--json")
    assert (ran.code, ran.failing) == (3, {"gap"})


ROW = "1,tip,cam1,10.5,20.5\n"
HEADER = "frame,point,view,u_px,v_px\n"
WIDE = "a_cam1_X,a_cam1_Y,a_cam2_X,a_cam2_Y\n"
BAD = {
    "": "columns frame, point, view",
    HEADER: "no points",
    WIDE: "no points",
    "point,view,u_px,v_px\n": "frame are missing",
    "frame,point,view,u_px,v_px,U_PX\n": "twice",
    HEADER.replace("\n", ",x\n") + ROW: "'x' is unknown",
    HEADER + ROW + ROW: "frame 1 has point 'tip' twice in view cam1",
    HEADER + ROW.replace("cam1", "pa"): "'pa' is not one of cam1, cam2",
    HEADER + ROW + "2,tip,cam1,5\n": "line 3: 4 cells",
    HEADER + "1,tip,cam1,10,5,20,5\n": "line 2: 7 cells",
    HEADER + "1,tip,cam1,10.5,\n": "one coordinate is missing",
    HEADER + "1,tip,cam1,ten,5\n": "write numbers",
    HEADER + "1,tip,cam1,inf,5\n": "at most 100000",
    HEADER + "1.5,tip,cam1,10,5\n": "not a whole number",
    HEADER.replace("\n", ",sd_px\n") + "1,tip,cam1,10,5,0\n": "not above zero",
    HEADER.replace(",", ";") + "1;tip;cam1;10,5;5.25\n1;tip;cam2;1.5;5.25\n": "write all numbers alike",
    WIDE.replace(",a_cam2_Y", "") + "1,2,3\n": "a_cam2_Y is missing",
    "a_cam1_X,a_cam1_Y\n1,2\n": "cameras 1, and there are 2 views",
    WIDE.replace("\n", ",cam2_offset\n") + "1,2,3,4,5\n": "'cam2_offset' is unknown",
    "1,2,3,4\n5,6,7,8\n": "with a header",
    "frame," + WIDE + "1,1,2,3,4\n1,1,2,3,4\n": "number twice",
}


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_a_bad_table_is_refused_with_what_is_wrong(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(UnusableInputError, match=BAD[text]):
        read_points(tmp_path / "p.csv", ["cam1", "cam2"])


def test_a_huge_file_and_one_of_bytes_are_refused(tmp_path: Path) -> None:
    with (tmp_path / "p.csv").open("wb") as file:
        file.truncate(2**28 + 1)
    with pytest.raises(UnusableInputError, match="larger than 256 MiB"):
        read_points(tmp_path / "p.csv", ["a", "b"])
    (tmp_path / "q.csv").write_bytes(HEADER.encode() + b"\xff\xfe,a,b,1,2\n")
    with pytest.raises(UnusableInputError, match="UTF-8"):
        read_points(tmp_path / "q.csv", ["a", "b"])
