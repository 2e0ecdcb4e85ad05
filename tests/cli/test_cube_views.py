"""A cube of XMALab, two of its images, and tracked points: from the command line to places in space."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

SHAPE, FOCAL_PX, RADIUS_MM = (1024, 1024), 4900.0, 1.5
CUBE_MM = np.random.default_rng(21).uniform(-35.0, 35.0, (60, 3))


def _spread(points: np.ndarray, apart_mm: float) -> np.ndarray:
    """The points that are so far from all before them."""
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.linalg.norm(point - other) > apart_mm for other in kept):
            kept.append(point)
    return np.array(kept[:22])


BALLS_MM = _spread(CUBE_MM, 13.0)


def _matrix(angle_deg: float) -> np.ndarray:
    rotation = Rotation.from_euler("yxz", [angle_deg, 4.7, 2.3], degrees=True).as_matrix()
    inner = np.array([[FOCAL_PX, 0.0, 509.2], [0.0, FOCAL_PX, 514.6], [0.0, 0.0, 1.0]])
    return inner @ np.column_stack([rotation, [1.3, -2.1, 640.0]])


MATRICES = {"cam1": _matrix(1.9), "cam2": _matrix(-83.7)}


def _image(matrix: np.ndarray, balls: np.ndarray) -> np.ndarray:
    """Beer's law through the balls along the ray of each pixel near them, with quantum noise."""
    source = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    path = np.zeros(SHAPE)
    for ball in balls:
        u, v, w = matrix @ np.append(ball, 1.0)
        rows, columns = (np.arange(int(x / w) - 30, int(x / w) + 31) for x in (v, u))
        uu, vv = np.meshgrid(columns, rows)
        rays = np.linalg.solve(matrix[:, :3], np.stack([uu, vv, np.ones_like(uu)], -1).reshape(-1, 3).T).T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        off2 = (np.cross(ball - source, rays) ** 2).sum(axis=1)
        chord = 2.0 * np.sqrt(np.maximum(RADIUS_MM**2 - off2, 0.0)).reshape(uu.shape)
        path[np.ix_(rows, columns)] += chord
    photons = cv2.GaussianBlur(4000.0 * np.exp(-0.45 * path), (0, 0), 0.9)
    return np.clip(np.random.default_rng(2).poisson(photons) * 12.0, 0, 65535).astype(np.uint16)


@pytest.fixture(scope="module")
def cube(run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with cube.csv as XMALab has it, and views.json of two calibrated images of it."""
    folder = tmp_path_factory.mktemp("cube")
    rows = ["x , y , z", *(" , ".join(f"{x:.4f}" for x in ball) for ball in BALLS_MM)]
    (folder / "cube.csv").write_text("\n".join(rows) + "\n")
    for name, matrix in MATRICES.items():
        cv2.imwrite(str(folder / f"{name}.png"), _image(matrix, BALLS_MM))
        given = (folder / f"{name}.png", "--frame", folder / "cube.csv", "--view", name)
        ran = run("calibrate", *given, "--views", folder / "views.json", "--json")
        assert ran.code == 0, ran.out
    return folder


def test_two_images_of_a_cube_and_tracked_points_give_their_places(run, cube: Path) -> None:
    xyz = np.random.default_rng(5).uniform(-30.0, 30.0, (12, 3))
    columns = []
    for matrix in MATRICES.values():
        image = np.column_stack([xyz, np.ones(len(xyz))]) @ matrix.T
        columns.append(image[:, :2] / image[:, 2:])
    lines = ["tip_cam1_X,tip_cam1_Y,tip_cam2_X,tip_cam2_Y", *(",".join(map(str, row)) for row in np.hstack(columns))]
    (cube / "p.csv").write_text("\n".join(lines) + "\n")
    given = ("--views", cube / "views.json", "--points", "undistorted", "--first-pixel", 0, "--sd", 0.1)
    ran = run("reconstruct", cube / "p.csv", *given, "--out", cube / "xyz.csv", "--json")
    assert ran.code == 0, ran.out
    with (cube / "xyz.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    off = np.array([[float(row[f"{a}_mm"]) for a in "xyz"] for row in rows]) - xyz
    sd = np.array([[float(row[f"{a}{a}_mm2"]) ** 0.5 for a in "xyz"] for row in rows])
    assert np.abs(off).max() < 0.25  # balls are found to 0.05 px, 0.006 mm, and their magnification in depth
    assert (np.abs(off) < 4.0 * sd).all()


def test_exported_views_give_the_same_places_and_errors(run, cube: Path, tmp_path: Path) -> None:
    ran = run("export", "views", cube / "views.json", "--to", "xmalab,opencv", "--out", tmp_path / "cameras")
    assert ran.code == 0, ran.said
    seen = [matrix @ [11.3, -7.2, 5.9, 1.0] for matrix in MATRICES.values()]
    cells = ",".join(f"{x / w},{y / w}" for x, y, w in seen)
    (tmp_path / "p.csv").write_text(f"tip_cam1_X,tip_cam1_Y,tip_cam2_X,tip_cam2_Y\n{cells}\n")
    pixels = ("--points", "undistorted", "--first-pixel", 0)
    found = []
    for form in (None, "mayacam2.txt", "opencv.json"):
        files = [cube / "views.json"] if form is None else [tmp_path / "cameras" / f"{v}.{form}" for v in MATRICES]
        given = [word for file in files for word in ("--views", file)]
        run("reconstruct", tmp_path / "p.csv", *given, *pixels, "--out", tmp_path / "xyz.csv")
        with (tmp_path / "xyz.csv").open(encoding="utf-8", newline="") as stream:
            (row,) = csv.DictReader(stream)
        found.append(row)
    own, mayacam, opencv = found
    for axis in ("x_mm", "y_mm", "z_mm"):
        for other in (mayacam, opencv):  # as written, to 0.0001 mm
            assert float(other[axis]) == pytest.approx(float(own[axis]), abs=1.5e-4)
    assert mayacam["xx_mm2"] == ""  # the format states no errors
    assert float(opencv["zz_mm2"]) == pytest.approx(float(own["zz_mm2"]), rel=0.03)
    told = run("export", "views", cube / "views.json", cube / "cam2.png", "--out", tmp_path / "cameras")
    assert told.code == 2 and "leave out other images" in told.said


BODY_MM = np.array([[0.0, 0.0, 0.0], [17.3, 2.1, -1.4], [4.8, 21.9, 3.3], [-6.2, 8.7, 14.1]])
POSES = [Rotation.from_euler("xyz", [15.0 * k - 20.0, 9.0 * k, 31.0], degrees=True) for k in range(3)]


@pytest.mark.parametrize("learnt", [True, False])
def test_a_body_is_followed_and_a_frame_with_a_hidden_ball_has_no_pose(
    run, cube: Path, tmp_path: Path, *, learnt: bool
) -> None:
    shift = np.array([[3.1, -5.2, 4.4], [4.7, -3.9, 2.8], [6.0, -2.2, 1.1]])
    for name, matrix in MATRICES.items():
        (tmp_path / name).mkdir()
        for k, (turn, middle) in enumerate(zip(POSES, shift, strict=True)):
            balls = (turn.apply(BODY_MM) + middle)[1 if (k, name) == (1, "cam2") else 0 :]
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), _image(matrix, balls))
    rows = ["id,x_mm,y_mm,z_mm,sd_mm", *(f"b{k},{x},{y},{z},0.02" for k, (x, y, z) in enumerate(BODY_MM))]
    (tmp_path / "body.csv").write_text("\n".join(rows) + "\n")
    given = (tmp_path / "cam1", tmp_path / "cam2", "--views", cube / "views.json", "--out", tmp_path / "poses.csv")
    ran = run("balls", *given, *(() if learnt else ("--body", tmp_path / "body.csv")), "--json")
    assert ran.code == 0, ran.out
    with (tmp_path / "poses.csv").open(encoding="utf-8", newline="") as stream:
        found = list(csv.DictReader(stream))
    assert [row["reason"] for row in found] == ["", "a ball is hidden", ""]
    assert found[1]["x_mm"] == ""
    turns = [Rotation.from_quat([float(row[q]) for q in ("qx", "qy", "qz", "qw")]) for row in (found[0], found[2])]
    moved = POSES[2] * POSES[0].inv()
    assert (turns[1] * turns[0].inv() * moved.inv()).magnitude() < 0.01  # 0.1 mm over 14 mm, and much to spare
    middles = np.array([[float(row[f"{a}_mm"]) for a in "xyz"] for row in (found[0], found[2])])
    truth = np.array([POSES[k].apply(BODY_MM).mean(axis=0) + shift[k] for k in (0, 2)])
    np.testing.assert_allclose(middles, truth, atol=0.2)  # the depth of the views, from balls of one size
    assert ran.document["poses"] == 2 and ran.document["precision_mm"] < 0.043
    (tmp_path / "cam2" / "2.png").unlink()
    assert "fewer frames" in run("balls", *given).said
    cv2.imwrite(str(tmp_path / "cam2" / "0.png"), np.full((900, 1024), 3000, np.uint16))
    assert "1024 x 900 pixels, view cam2 is of 1024 x 1024" in run("balls", *given).said


def test_a_view_of_the_same_name_is_replaced_and_another_file_kept(run, cube: Path, tmp_path: Path) -> None:
    views = tmp_path / "views.json"
    views.write_bytes((cube / "views.json").read_bytes())
    given = ("calibrate", cube / "cam1.png", "--frame", cube / "cube.csv", "--view", "cam1", "--views")
    assert "views.json holds cam1, cam2" in run(*given, views).out
    other = tmp_path / "other.json"
    other.write_text("{}")
    assert "holds no views" in run(*given, other).said
    assert other.read_text() == "{}"
    alone = tmp_path / "alone.json"
    run(*given, alone)
    (tmp_path / "p.csv").write_text("a_cam1_X,a_cam1_Y\n1,2\n")
    ran = run("reconstruct", tmp_path / "p.csv", "--views", alone, "--out", tmp_path / "x.csv")
    assert "give two or more" in ran.said
