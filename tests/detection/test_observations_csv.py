"""Observations go through a file unchanged, and a bad file is refused with its line."""

from pathlib import Path

import numpy as np
import pytest

from sightline.detection.csv_files import read_observations, write_observations
from sightline.detection.results import Observations
from sightline.errors import ObservationsError

HEADER = "view,id,u_px,v_px\n"
FULL = "view,id,u_px,v_px,suu_px2,suv_px2,svv_px2\n"


def observed(view: str, *, covariance: bool, radius: bool = False) -> Observations:
    rng = np.random.default_rng(5)
    uv_px = rng.uniform(0, 1000, (7, 2))
    factor = rng.normal(size=(7, 2, 2))
    noise = factor @ factor.transpose(0, 2, 1) + 0.01 * np.eye(2) if covariance else None
    radius_px = rng.uniform(3.0, 9.0, 7) if radius else None
    return Observations(view, tuple(f"{view}-{i}" for i in range(7)), uv_px, noise, radius_px=radius_px)


@pytest.mark.parametrize("radius", [True, False])
@pytest.mark.parametrize("covariance", [True, False])
def test_what_is_written_is_read_again_to_the_last_bit(tmp_path: Path, covariance: bool, radius: bool) -> None:
    views = [observed(name, covariance=covariance, radius=radius) for name in ("pa", "lateral")]
    back = read_observations(write_observations(views, tmp_path / "beads.csv"))
    assert list(back) == ["pa", "lateral"]
    for view in views:
        assert back[view.view].ids == view.ids
        np.testing.assert_array_equal(back[view.view].uv_px, view.uv_px)
        if covariance:
            np.testing.assert_array_equal(back[view.view].covariance_px2, view.covariance_px2)
        else:
            assert back[view.view].covariance_px2 is None
        assert (back[view.view].radius_px is not None) == radius
        if radius:
            np.testing.assert_array_equal(back[view.view].radius_px, view.radius_px)


def test_a_covariance_that_one_view_lacks_is_written_for_none(tmp_path: Path) -> None:
    views = [observed("pa", covariance=True), observed("lateral", covariance=False)]
    back = read_observations(write_observations(views, tmp_path / "beads.csv"))
    assert back["pa"].covariance_px2 is None


def test_a_spreadsheet_s_byte_order_mark_and_empty_lines_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "beads.csv"
    path.write_bytes(b"\xef\xbb\xbf" + (HEADER + "\npa, b1 ,1.5,2.5\n\n").encode())
    assert read_observations(path)["pa"].ids == ("b1",)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1"),
        (HEADER, "no observations"),
        ("view;id;u_px;v_px\npa;b1;1,5;2.5\n", "write all numbers alike"),
        ("view,id,u,v\npa,b1,1,2\n", "u_px"),
        (HEADER + "pa,b1,1\n", "line 2: 3 cells"),
        (HEADER + "pa,b1,1,2\npa,b2,nan,2\n", "line 3.*finite"),
        (HEADER + "pa,b1,1,inf\n", "finite"),
        (HEADER + "pa,b1,1,two\n", "not a finite number"),
        (HEADER + "pa,b1,1,2\npa,b1,3,4\n", "twice.*b1"),
        (HEADER + "pa,,1,2\n", "name"),
        (HEADER + 'pa,"b1,1,2\n', "comma-separated"),
        (HEADER + f"pa,{'b' * 65},1,2\n", "64 characters"),
        (FULL + "pa,b1,1,2,0.01,0.02,0.01\n", "positive definite"),
        (FULL + "pa,b1,1,2,0,0,0\n", "positive definite"),
        (FULL[:-1] + ",radius_px\npa,b1,1,2,0.01,0.02,0.01,5\n", "positive definite"),
        (FULL[:-1] + ",radius_px\npa,b1,1,2,0.01,0,0.01,0\n", "line 2.*radius"),
        (HEADER[:-1] + ",radius_px\npa,b1,1,2,-5\n", "line 2.*radius"),
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "beads.csv"
    path.write_text(text)
    with pytest.raises(ObservationsError, match=says):
        read_observations(path)


def test_a_file_that_is_no_text_too_large_or_absent_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "beads.csv"
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ObservationsError, match="not a text file"):
        read_observations(path)
    path.write_bytes(b"x" * (2**22 + 1))
    with pytest.raises(ObservationsError, match="larger"):
        read_observations(path)
    with pytest.raises(ObservationsError, match="cannot read"):
        read_observations(tmp_path / "absent.csv")


def test_observations_are_themselves_alone() -> None:
    """Arrays have no one truth: equal content would end a comparison, and a set of results."""
    first, second = (Observations("pa", ("a", "b"), [[1.0, 2.0], [3.0, 4.0]]) for _ in range(2))
    assert len({first, second, first}) == 2
