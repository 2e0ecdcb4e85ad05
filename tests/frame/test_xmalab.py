"""Frame specifications of XMALab are read as they are, and bad ones are refused."""

import numpy as np
import pytest

from sightline.errors import FrameError
from sightline.frame import Frame
from sightline.frame.tables import frame_from_csv

MM = Frame.load("block60").solid.xyz_mm


def written(path, header="x,y,z", xyz=MM, join=","):
    """A file as XMALab reads it."""
    path.write_text("\n".join([header, *(join.join(map(repr, ball)) for ball in xyz.tolist())]) + "\n")
    return path


@pytest.mark.parametrize(
    ("header", "xyz", "join"),
    [
        ("x,y,z", MM, ","),
        ("X,Y,Z", MM / 10, ","),  # cm
        ("x y z", MM / 10, " , "),  # as XMALab writes it
        ("white", MM, ","),
        ("s10,s10,s10,", MM / 10, ","),
        ("s1,s2,s1,white", MM / [1, 2, 1], ","),
    ],
)
def test_a_cube_is_read_in_millimetres_and_numbered_from_1(tmp_path, header, xyz, join):
    frame = Frame.load(written(tmp_path / "my cube.csv", header, xyz, join))
    np.testing.assert_allclose(frame.solid.xyz_mm, MM, atol=1e-9)
    assert frame.solid.ids == tuple(str(n) for n in range(1, 17))
    assert {f.diameter_mm for f in frame.solid.fiducials} == {3.0}
    assert (frame.name, frame.tolerances) == ("my-cube", None)


def test_diameter_and_unit_can_be_stated(tmp_path):
    """A block of 24 mm, 42 mm across, could be one of 24 cm; stated, it is neither guessed nor scaled."""
    file = written(tmp_path / "small.csv", xyz=MM * 24 / 53)
    with pytest.raises(FrameError, match="mm or cm; state it"):
        Frame.load(file)
    frame = frame_from_csv(file, "small", diameter_mm=2.0, unit="mm")
    np.testing.assert_allclose(frame.solid.xyz_mm, MM * 24 / 53, atol=1e-6)
    assert {f.diameter_mm for f in frame.solid.fiducials} == {2.0}
    with pytest.raises(FrameError, match="the unit is 'inch'"):
        frame_from_csv(file, "small", unit="inch")
    with pytest.raises(FrameError, match="above zero"):
        frame_from_csv(file, "small", diameter_mm=-2.0, unit="mm")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no ball below the header"),
        ("x,y,z\n", "no ball below the header"),
        ("1,2,3\n4,5,6\n", "first line is a ball"),
        ("x,y,z\n1,2\n", "line 2: '1,2' is not a ball"),
        ("x,y,z\n0,0,0\n1;2;3\n", "line 3: '1;2;3' is not a ball"),
        ("x,y,z\n1,2,3,4\n", "line 2"),
        ("x,y,z\n1,2,nan\n", "line 2"),
        ("sx,s1,s1,\n1,2,3\n", "factors sx,s1,s1"),
        ("s0,s1,s1,\n1,2,3\n", "above zero"),
        ("x,y,z\n0,0,0\n100,0,0\n0,100,0\n", "has 3 beads"),
        ("x,y,z\n" + "0,0,1e9\n" * 8, "less than or equal to 10000"),
    ],
)
def test_bad_files_are_refused_by_name_and_line(tmp_path, text, words):
    (tmp_path / "cube.csv").write_text(text)
    with pytest.raises(FrameError, match=words) as refused:
        Frame.load(tmp_path / "cube.csv")
    assert str(refused.value).startswith("cube.csv: ")


def test_a_table_of_measured_balls_is_a_solid_without_views_and_plates(tmp_path):
    rows = [f"b{n},{x},{y},{z},3,0.01" for n, (x, y, z) in enumerate(MM.tolist())]
    (tmp_path / "balls.csv").write_text("\n".join(["id,x_mm,y_mm,z_mm,diameter_mm,sd_mm", *rows]))
    frame = frame_from_csv(tmp_path / "balls.csv", "mine")
    np.testing.assert_array_equal(frame.solid.xyz_mm, MM)
    np.testing.assert_allclose(frame.covariance_mm2, 1e-4 * np.eye(48), atol=1e-12)
    with pytest.raises(FrameError, match="leave out --diameter-mm"):
        frame_from_csv(tmp_path / "balls.csv", "mine", diameter_mm=3.0)
    with pytest.raises(FrameError, match="frame new FILE --csv"):
        Frame.load(tmp_path / "balls.csv")
