import csv

import numpy as np
import pytest

from sightline.errors import FrameError
from sightline.frame import Frame, Tolerances
from sightline.frame.plate import ROLES
from sightline.frame.tables import frame_from_csv

GAMMA = Frame.load("gamma")
COVARIANCE = {"xx_mm2": 4e-4, "xy_mm2": 1e-4, "xz_mm2": 0, "yy_mm2": 3e-4, "yz_mm2": -1e-4, "zz_mm2": 9e-4}


def rows_of_gamma(**more) -> list[dict]:
    return [
        {"view": name, "plate": role, "id": f.id, "x_mm": f.xyz_mm[0], "y_mm": f.xyz_mm[1], "z_mm": f.xyz_mm[2]}
        | {"diameter_mm": f.diameter_mm, "datum": str(f.datum).lower()}
        | more
        for name, view in GAMMA.views.items()
        for role in ROLES
        for f in getattr(view, role).fiducials
    ]


@pytest.fixture
def table(tmp_path):
    def write(rows: list[dict]):
        with (tmp_path / "balls.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        return tmp_path / "balls.csv"

    return write


def test_a_table_of_the_gamma_frame_is_the_gamma_frame(table):
    frame = frame_from_csv(table(rows_of_gamma()), "mine")
    assert (frame.name, frame.views) == ("mine", GAMMA.views)
    assert frame.tolerances is None
    assert frame.covariance_mm2 is None


def test_balls_may_stand_in_any_order(table):
    frame = frame_from_csv(table(rows_of_gamma()[::-1]), "mine")
    assert list(frame.views) == ["lateral", "pa"]
    assert set(frame.views["pa"].xrii.fiducials) == set(GAMMA.views["pa"].xrii.fiducials)


@pytest.mark.parametrize(
    ("columns", "block"),
    [
        ({"sd_mm": 0.05}, 0.05**2 * np.eye(3)),
        (COVARIANCE, np.array([[4e-4, 1e-4, 0], [1e-4, 3e-4, -1e-4], [0, -1e-4, 9e-4]])),
    ],
)
def test_stated_errors_replace_the_bead_tolerance_and_no_other(table, columns, block):
    frame = frame_from_csv(table(rows_of_gamma(**columns)), "mine")
    default = GAMMA.error_factor @ GAMMA.error_factor.T
    beads = Tolerances().bead_mm ** 2 * np.eye(len(default))
    expected = default - beads + np.kron(np.eye(len(default) // 3), block)
    np.testing.assert_allclose(frame.covariance_mm2, expected, atol=1e-12)


def test_a_table_with_errors_survives_as_a_frame_file(table, tmp_path):
    frame = frame_from_csv(table(rows_of_gamma(sd_mm=0.01)[::5]), "mine")
    frame.save(tmp_path / "mine.json")
    np.testing.assert_array_equal(Frame.load(tmp_path / "mine.json").covariance_mm2, frame.covariance_mm2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"plate": "top"}, "line 2: the plate is 'top'; write xrii or source"),
        ({"x_mm": "1,5"}, "line 2: x_mm is '1,5', not a number"),
        ({"x_mm": ""}, "line 2: x_mm is '', not a number"),
        ({"x_mm": "nan"}, r"xyz\[0\] is not a finite number"),
        ({"id": "pa-x-1-2"}, "'pa-x-1-2' occurs twice"),
        ({"diameter_mm": "-1"}, "above zero"),
        ({"datum": "perhaps"}, "line 2: datum is 'perhaps'"),
    ],
)
def test_bad_rows_are_refused(table, change, words):
    rows = rows_of_gamma()
    rows[0] |= change
    with pytest.raises(FrameError, match=words):
        frame_from_csv(table(rows), "mine")


@pytest.mark.parametrize(
    ("columns", "first", "words"),
    [
        ({"sd_mm": 0.01}, {"sd_mm": ""}, "some balls state an error and some do not"),
        ({"sd_mm": 0.01}, {"sd_mm": -0.01}, "line 2: sd_mm is -0.01"),
        ({"sd_mm": 0.01} | COVARIANCE, {}, "line 2: state a ball's error in one way"),
        (COVARIANCE, {"zz_mm2": ""}, "line 2: state a ball's error in one way, with all of its columns"),
        (COVARIANCE, {"zz_mm2": -1}, "not positive semi-definite"),
        (COVARIANCE, {"zz_mm2": "inf"}, "not finite"),
        ({"weight": 1}, {}, "unknown column 'weight'"),
    ],
)
def test_bad_errors_are_refused(table, columns, first, words):
    rows = rows_of_gamma(**columns)
    rows[0] |= first
    with pytest.raises(FrameError, match=words):
        frame_from_csv(table(rows), "mine")


def test_missing_columns_and_a_missing_plate_are_named(table):
    with pytest.raises(FrameError, match="lacks the columns diameter_mm"):
        frame_from_csv(table([{k: v for k, v in row.items() if k != "diameter_mm"} for row in rows_of_gamma()]), "mine")
    with pytest.raises(FrameError, match=r"views\.pa\.source has too few entries"):
        frame_from_csv(table([r for r in rows_of_gamma() if (r["view"], r["plate"]) != ("pa", "source")]), "mine")


@pytest.mark.parametrize("text", [b"", b"\xff\xfe\x00\x01", b'view,plate\n"pa', b"view;plate;id\npa;xrii;1\n"])
def test_files_that_are_no_table(tmp_path, text):
    (tmp_path / "balls.csv").write_bytes(text)
    with pytest.raises(FrameError, match=r"balls\.csv"):
        frame_from_csv(tmp_path / "balls.csv", "mine")


def test_a_row_with_too_few_or_too_many_cells(tmp_path, table):
    text = table(rows_of_gamma()).read_text().splitlines()
    for broken in (text[1] + ",1", text[1].rsplit(",", 1)[0]):
        (tmp_path / "broken.csv").write_text("\n".join([text[0], broken, *text[2:]]))
        with pytest.raises(FrameError, match="line 2: the number of cells differs"):
            frame_from_csv(tmp_path / "broken.csv", "mine")


def test_no_such_table(tmp_path):
    with pytest.raises(FrameError, match="cannot read"):
        frame_from_csv(tmp_path / "no.csv", "mine")
