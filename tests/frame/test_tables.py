import csv

import numpy as np
import pytest

from sightline.errors import FrameError
from sightline.frame import Frame, Tolerances
from sightline.frame.tables import frame_from_csv, read_measurements

GAMMA = Frame.load("gamma")
COVARIANCE = {"xx_mm2": 4e-4, "xy_mm2": 1e-4, "xz_mm2": 0, "yy_mm2": 3e-4, "yz_mm2": -1e-4, "zz_mm2": 9e-4}
ROWS = ["px0,1.5,2.25,-3,0.01", "px1,4,5,6,0.02", "px2,7,8,9.125,0.01"]


def rows_of_gamma(**more) -> list[dict]:
    return [
        {"view": name, "plate": role, "id": f.id, "x_mm": f.xyz_mm[0], "y_mm": f.xyz_mm[1], "z_mm": f.xyz_mm[2]}
        | {"diameter_mm": f.diameter_mm, "datum": str(f.datum).lower()}
        | more
        for name, role, plate in GAMMA.named_plates
        for f in plate.fiducials
    ]


@pytest.fixture
def balls(tmp_path):
    def write(rows: list[dict]):
        with (tmp_path / "balls.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        return tmp_path / "balls.csv"

    return write


@pytest.fixture
def table(tmp_path):
    def write(header: str, *rows: str):
        (tmp_path / "m.csv").write_text("\n".join([header, *rows]))
        return tmp_path / "m.csv"

    return write


def test_a_table_of_the_gamma_frame_is_the_gamma_frame_in_any_order(balls):
    frame = frame_from_csv(balls(rows_of_gamma()), "mine")
    assert (frame.name, frame.views) == ("mine", GAMMA.views)
    assert (frame.tolerances, frame.covariance_mm2) == (None, None)
    frame = frame_from_csv(balls(rows_of_gamma()[::-1]), "mine")
    assert list(frame.views) == ["lateral", "pa"]
    assert set(frame.views["pa"].xrii.fiducials) == set(GAMMA.views["pa"].xrii.fiducials)


@pytest.mark.parametrize(
    ("columns", "block"),
    [
        ({"sd_mm": 0.05}, 0.05**2 * np.eye(3)),
        (COVARIANCE, np.array([[4e-4, 1e-4, 0], [1e-4, 3e-4, -1e-4], [0, -1e-4, 9e-4]])),
    ],
)
def test_stated_errors_replace_the_bead_tolerance_and_no_other(balls, columns, block):
    frame = frame_from_csv(balls(rows_of_gamma(**columns)), "mine")
    default = GAMMA.error_factor @ GAMMA.error_factor.T
    beads = Tolerances().bead_mm ** 2 * np.eye(len(default))
    expected = default - beads + np.kron(np.eye(len(default) // 3), block)
    np.testing.assert_allclose(frame.covariance_mm2, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("columns", "first", "words"),
    [
        ({}, {"plate": "top"}, "line 2: the plate is 'top'; write xrii or source"),
        ({}, {"x_mm": "1,5"}, "line 2: x_mm is '1,5', not a finite number"),
        ({}, {"x_mm": "nan"}, "line 2: x_mm is 'nan', not a finite number"),
        ({}, {"id": "pa-x-1-2"}, "'pa-x-1-2' occurs twice"),
        ({}, {"diameter_mm": "-1"}, "above zero"),
        ({}, {"datum": "perhaps"}, "line 2: datum is 'perhaps'"),
        ({"sd_mm": 0.01}, {"sd_mm": ""}, "some balls state an error and some do not"),
        ({"sd_mm": 0.01}, {"sd_mm": -0.01}, "line 2: sd_mm is -0.01"),
        ({"sd_mm": 0.01} | COVARIANCE, {}, "line 2: state a ball's error in one way"),
        (COVARIANCE, {"zz_mm2": ""}, "line 2: state a ball's error in one way, with all of its columns"),
        (COVARIANCE, {"zz_mm2": -1}, "not positive semi-definite"),
        (COVARIANCE, {"zz_mm2": "inf"}, "not a finite number"),
        ({"weight": 1}, {}, "unknown column 'weight'"),
    ],
)
def test_bad_frames_are_refused(balls, columns, first, words):
    rows = rows_of_gamma(**columns)
    rows[0] |= first
    with pytest.raises(FrameError, match=words):
        frame_from_csv(balls(rows), "mine")


def test_missing_columns_and_a_missing_plate_are_named(balls):
    with pytest.raises(FrameError, match="lacks the columns diameter_mm"):
        frame_from_csv(balls([{k: v for k, v in row.items() if k != "diameter_mm"} for row in rows_of_gamma()]), "mine")
    with pytest.raises(FrameError, match=r"views\.pa\.source has too few entries"):
        frame_from_csv(balls([r for r in rows_of_gamma() if (r["view"], r["plate"]) != ("pa", "source")]), "mine")


@pytest.mark.parametrize("read", [lambda path: frame_from_csv(path, "mine"), read_measurements])
@pytest.mark.parametrize(
    "data", [b"", b"\xff\xfe\x00\x01", b'view,plate\n"pa', b'id,x,y,z\n"a,1', b"view;plate\npa;1\n"]
)
def test_files_that_are_no_table(tmp_path, read, data):
    (tmp_path / "m.csv").write_bytes(data)
    with pytest.raises(FrameError, match=r"m\.csv"):
        read(tmp_path / "m.csv")
    with pytest.raises(FrameError, match="cannot read"):
        read(tmp_path / "none.csv")


def test_a_table_of_a_spreadsheet_has_semicolons_or_tabs_and_decimal_commas(table):
    header, rows = "id,x_mm,y_mm,z_mm,sd_mm", [*ROWS, "px3,-.5,1.5e-3,0,0.01"]
    (expected,) = read_measurements(table(header, *rows))
    for mark in ";\t":
        other = [line.replace(",", mark).replace(".", ",") for line in (header, *rows)]
        (series,) = read_measurements(table(*other))
        np.testing.assert_array_equal(series.xyz_mm, expected.xyz_mm)
        np.testing.assert_array_equal(series.covariance_mm2, expected.covariance_mm2)
    with pytest.raises(FrameError, match=r"1,5 has a decimal comma and 0\.01 a point; write all numbers alike"):
        read_measurements(table(header.replace(",", ";"), "a;1,5;2;3;0.01"))


@pytest.mark.parametrize("header", ["id,x_mm,y_mm,z_mm,sd_mm", "ID,x,y,z,sd_mm", "id, X [mm] ,Y (mm),z mm,sd_mm"])
def test_measurements_are_read_whatever_their_header_is_called(table, header):
    (series,) = read_measurements(table(header, *ROWS))
    assert (series.name, series.ids) == ("1", ("px0", "px1", "px2"))
    np.testing.assert_array_equal(series.xyz_mm[[0, 2]], [[1.5, 2.25, -3.0], [7.0, 8.0, 9.125]])
    np.testing.assert_allclose(np.diag(series.covariance_mm2), np.repeat([1e-4, 4e-4, 1e-4], 3))
    assert np.isnan(series.diameter_mm).all()


def test_errors_per_axis_and_as_covariances(table):
    (series,) = read_measurements(table("id,x,y,z,sd_x_mm,sd_y_mm,sd_z_mm", "a,0,0,0,0.01,0.02,0.03"))
    np.testing.assert_allclose(series.covariance_mm2, np.diag([1e-4, 4e-4, 9e-4]))
    header = f"id,x,y,z,{','.join(COVARIANCE)}"
    (series,) = read_measurements(table(header, "a,0,0,0,4,1,0,3,-1,9", "b,0,0,1,1,0,0,1,0,1"))
    np.testing.assert_allclose(series.covariance_mm2[:3, :3], [[4, 1, 0], [1, 3, -1], [0, -1, 9]])
    np.testing.assert_allclose(series.covariance_mm2[:3, 3:], 0)


def test_series_stand_apart_and_empty_rows_are_no_measurement(table):
    first, second = read_measurements(
        table("series,id,x,y,z,sd_mm,diameter_mm", "a,p,0,0,0,1,3.01", "b,p,1,1,1,2,", "a,q,,,,,", "a,r,2,2,2,1,5")
    )
    assert (first.name, first.ids, second.name, second.ids) == ("a", ("p", "r"), "b", ("p",))
    np.testing.assert_allclose(second.covariance_mm2, 4 * np.eye(3))
    np.testing.assert_array_equal(first.diameter_mm, [3.01, 5.0])


@pytest.mark.parametrize(
    ("header", "row", "words"),
    [
        ("id,x_m,y_m,z_m,sd_mm", ROWS[0], "in m "),
        ("id,x [in],y [in],z [in],sd_mm", ROWS[0], r"in in \(column 'x \[in\]'\)"),
        ("id,x,y,sd_mm", "a,1,2,1", "lacks the columns z_mm"),
        ("id,x,y,z,z_mm", "a,1,2,3,3", "a column twice"),
        ("id,x,y,z,weight", "a,1,2,3,1", "unknown column 'weight'"),
        ("id,x,y,z,sd_mm", "a,1,2,3", "line 2: . cells"),
        ("id,x,y,z", "a,1,2,3,4", "line 2: . cells"),
        ("id,x,y,z,sd_mm", "a,1,2,,0.1", "fill in all of x, y and z"),
        ("id,x,y,z,sd_mm", "a,1,2,3;5,0.1", "'3;5', not a finite number"),
        ("id,x,y,z,sd_mm", "a,1,2,inf,0.1", "not a finite number"),
        ("id,x,y,z,sd_mm", "a,1,2,3,nan", "not a finite number"),
        ("id,x,y,z,sd_mm", "a,1,2,3,0", "an error above zero"),
        ("id,x,y,z,sd_x_mm,sd_y_mm,sd_z_mm", "a,1,2,3,1,,1", "in one way"),
        ("id,x,y,z,sd_mm,sd_x_mm,sd_y_mm,sd_z_mm", "a,1,2,3,1,1,1,1", "in one way"),
        ("id,x,y,z,xx_mm2,xy_mm2,xz_mm2,yy_mm2,yz_mm2,zz_mm2", "a,1,2,3,1,2,0,1,0,1", "an error above zero"),
        ("id,x,y,z,diameter_mm", "a,1,2,3,0", "give a diameter above zero"),
        ("id,x,y,z,sd_mm", "a,,,,", "has no measured ball"),
        ("id,x,y,z", "a,1,2,3\na,1,2,3", "has ball 'a' twice"),
        ("id,x,y,z,sd_mm", "a,1,2,3,0.1\nb,1,2,3,", "some do not"),
    ],
)
def test_bad_measurements_are_refused(table, header, row, words):
    with pytest.raises(FrameError, match=words):
        read_measurements(table(header, row))


def test_a_covariance_file_joins_the_balls(table, tmp_path):
    root = np.random.default_rng(1).standard_normal((6, 9))
    np.savetxt(tmp_path / "c.csv", root @ root.T, delimiter=",")
    (series,) = read_measurements(table("id,x,y,z", "a,0,0,0", "b,1,2,3"), tmp_path / "c.csv")
    np.testing.assert_allclose(series.covariance_mm2, root @ root.T, rtol=1e-12)


@pytest.mark.parametrize(
    ("header", "matrix", "words"),
    [
        ("", np.eye(5), "6 x 6"),
        ("", np.diag([1, 1, 1, 1, 1, 0]), "not positive definite"),
        ("", np.eye(6) + np.eye(6, k=1), "symmetric"),
        ("", np.full((6, 6), np.nan), "finite"),
        ("", 1e3 * np.eye(6), "between 1e-05 and 10 mm"),
        ("", np.diag([1e-11, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5]), "not positive definite|between 1e-05 and 10 mm"),
        ("", np.array([["one", "two"]]), "only numbers"),
        (",sd_mm", np.eye(6) + 0.1, "give one of them"),
        (",series", np.eye(6) + 0.1, "correlates different series"),
    ],
)
def test_bad_covariance_files_are_refused(table, tmp_path, header, matrix, words):
    np.savetxt(tmp_path / "c.csv", matrix, delimiter=",", fmt="%s")
    last = (",1", ",2") if header else ("", "")
    with pytest.raises(FrameError, match=words):
        read_measurements(table(f"id,x,y,z{header}", f"a,0,0,0{last[0]}", f"b,1,2,3{last[1]}"), tmp_path / "c.csv")
