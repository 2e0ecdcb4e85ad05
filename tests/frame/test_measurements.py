import numpy as np
import pytest

from sightline.errors import FrameError
from sightline.frame.tables import read_measurements

ROWS = ["px0,1.5,2.25,-3,0.01", "px1,4,5,6,0.02", "px2,7,8,9.125,0.01"]


@pytest.fixture
def table(tmp_path):
    def write(header: str, *rows: str):
        (tmp_path / "m.csv").write_text("\n".join([header, *rows]))
        return tmp_path / "m.csv"

    return write


@pytest.mark.parametrize("header", ["id,x_mm,y_mm,z_mm,sd_mm", "ID,x,y,z,sd_mm", "id, X [mm] ,Y (mm),z mm,sd_mm"])
def test_a_table_is_read_whatever_its_header_is_called(table, header):
    (series,) = read_measurements(table(header, *ROWS))
    assert series.ids == ("px0", "px1", "px2")
    np.testing.assert_array_equal(series.xyz_mm[[0, 2]], [[1.5, 2.25, -3.0], [7.0, 8.0, 9.125]])
    assert series.covariance_mm2 is not None
    np.testing.assert_allclose(np.diag(series.covariance_mm2), np.repeat([1e-4, 4e-4, 1e-4], 3))
    assert np.isnan(series.diameter_mm).all()


def test_errors_per_axis_and_as_covariances(table):
    (series,) = read_measurements(table("id,x,y,z,sd_x_mm,sd_y_mm,sd_z_mm", "a,0,0,0,0.01,0.02,0.03"))
    np.testing.assert_allclose(series.covariance_mm2, np.diag([1e-4, 4e-4, 9e-4]))
    header = "id,x,y,z,xx_mm2,xy_mm2,xz_mm2,yy_mm2,yz_mm2,zz_mm2"
    (series,) = read_measurements(table(header, "a,0,0,0,4,1,0,3,-1,9", "b,0,0,1,1,0,0,1,0,1"))
    assert series.covariance_mm2 is not None
    np.testing.assert_allclose(series.covariance_mm2[:3, :3], [[4, 1, 0], [1, 3, -1], [0, -1, 9]])
    np.testing.assert_allclose(series.covariance_mm2[:3, 3:], 0)


def test_series_stand_apart_and_empty_rows_are_no_measurement(table):
    first, second = read_measurements(
        table("series,id,x,y,z,sd_mm,diameter_mm", "a,p,0,0,0,1,3.01", "b,p,1,1,1,2,", "a,q,,,,,", "a,r,2,2,2,1,5")
    )
    assert (first.name, first.ids, second.name, second.ids) == ("a", ("p", "r"), "b", ("p",))
    assert second.covariance_mm2 is not None
    np.testing.assert_allclose(second.covariance_mm2, 4 * np.eye(3))
    np.testing.assert_array_equal(first.diameter_mm, [3.01, 5.0])


def test_a_covariance_file_joins_the_balls(table, tmp_path):
    root = np.random.default_rng(1).standard_normal((6, 9))
    whole = root @ root.T
    np.savetxt(tmp_path / "c.csv", whole, delimiter=",")
    (series,) = read_measurements(table("id,x,y,z", "a,0,0,0", "b,1,2,3"), tmp_path / "c.csv")
    np.testing.assert_allclose(series.covariance_mm2, whole, rtol=1e-12)


@pytest.mark.parametrize(
    ("header", "row", "words"),
    [
        ("id,x_m,y_m,z_m,sd_mm", ROWS[0], "in m "),
        ("id,x [in],y [in],z [in],sd_mm", ROWS[0], r"in in \(column 'x \[in\]'\)"),
        ("id,x,y,sd_mm", "a,1,2,1", "lacks the columns z_mm"),
        ("id,x,y,z,z_mm", "a,1,2,3,3", "a column twice"),
        ("id,x,y,z,weight", "a,1,2,3,1", "unknown column 'weight'"),
        ("id,x,y,z,sd_mm", "a,1,2,3", "line 2: the number of cells differs"),
        ("id,x,y,z,sd_mm", "a,1,2,,0.1", "fill in all of x, y and z"),
        ("id,x,y,z,sd_mm", "a,1,2,3;5,0.1", "'3;5', not a number"),
        ("id,x,y,z,sd_mm", "a,1,2,inf,0.1", "not finite"),
        ("id,x,y,z,sd_mm", "a,1,2,nan,0.1", "not finite"),
        ("id,x,y,z,sd_mm", "a,1,2,3,0", "an error above zero"),
        ("id,x,y,z,sd_mm", "a,1,2,3,-1", "an error above zero"),
        ("id,x,y,z,sd_x_mm,sd_y_mm,sd_z_mm", "a,1,2,3,1,,1", "in one way"),
        ("id,x,y,z,sd_mm,sd_x_mm,sd_y_mm,sd_z_mm", "a,1,2,3,1,1,1,1", "in one way"),
        ("id,x,y,z,xx_mm2,xy_mm2,xz_mm2,yy_mm2,yz_mm2,zz_mm2", "a,1,2,3,1,2,0,1,0,1", "an error above zero"),
        ("id,x,y,z,diameter_mm", "a,1,2,3,0", "give a diameter above zero"),
        ("id,x,y,z,sd_mm", "a,,,,", "has no measured ball"),
    ],
)
def test_bad_tables_are_refused(table, header, row, words):
    with pytest.raises(FrameError, match=words):
        read_measurements(table(header, row))


def test_a_ball_twice_and_errors_for_some_are_refused(table):
    with pytest.raises(FrameError, match="has ball 'a' twice"):
        read_measurements(table("id,x,y,z", "a,1,2,3", "a,1,2,3"))
    with pytest.raises(FrameError, match="some do not"):
        read_measurements(table("id,x,y,z,sd_mm", "a,1,2,3,0.1", "b,1,2,3,"))


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.eye(5), "6 x 6"),
        (np.diag([1, 1, 1, 1, 1, 0]), "not positive definite"),
        (np.eye(6) + np.eye(6, k=1), "symmetric"),
        (np.full((6, 6), np.nan), "finite"),
        (np.diag([1, 1, 1, 1, 1, np.inf]), "finite"),
        (1e3 * np.eye(6), "between 1e-05 and 10 mm"),
        (np.diag([1e-11, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5]), "not positive definite|between 1e-05 and 10 mm"),
    ],
)
def test_bad_covariance_files_are_refused(table, tmp_path, matrix, words):
    np.savetxt(tmp_path / "c.csv", matrix, delimiter=",")
    with pytest.raises(FrameError, match=words):
        read_measurements(table("id,x,y,z", "a,0,0,0", "b,1,2,3"), tmp_path / "c.csv")


def test_errors_may_not_be_stated_twice_nor_shared_by_series(table, tmp_path):
    np.savetxt(tmp_path / "c.csv", np.eye(6) + 0.1, delimiter=",")
    with pytest.raises(FrameError, match="give one of them"):
        read_measurements(table("id,x,y,z,sd_mm", "a,0,0,0,1", "b,1,2,3,1"), tmp_path / "c.csv")
    with pytest.raises(FrameError, match="correlates different series"):
        read_measurements(table("series,id,x,y,z", "1,a,0,0,0", "2,b,1,2,3"), tmp_path / "c.csv")
    (tmp_path / "words.csv").write_text("one,two")
    with pytest.raises(FrameError, match="only numbers"):
        read_measurements(table("id,x,y,z", "a,0,0,0", "b,1,2,3"), tmp_path / "words.csv")


@pytest.mark.parametrize("data", [b"", b"\xff\xfe\x00", b'id,x,y,z\n"a,1'])
def test_files_that_are_no_table(tmp_path, data):
    (tmp_path / "m.csv").write_bytes(data)
    with pytest.raises(FrameError, match=r"m\.csv"):
        read_measurements(tmp_path / "m.csv")
    with pytest.raises(FrameError, match="cannot read"):
        read_measurements(tmp_path / "none.csv")
