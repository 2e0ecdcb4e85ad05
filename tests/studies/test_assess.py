"""The paper's Table 1 for test points of one's own."""

import json
from dataclasses import replace

import numpy as np
import pytest

import sightline as sl
from sightline.calibration import BeadView
from sightline.detection import Detections, Observations
from sightline.errors import RefusedError, UnusableInputError
from sightline.frame import Frame, Tolerances
from sightline.studies.assess import MeasuredPoints, Statistics, assess, find_balls, read_points
from sightline.twin import SetUp, bead_images, draw_setup

VIEWS = ("pa", "lateral")
HEADER = "name,x_mm,y_mm,z_mm"
PIXELS = ",pa_u_px,pa_v_px,lateral_u_px,lateral_v_px"
POINTS = MeasuredPoints(
    ("T1", "T2", "T3", "T4"),
    np.array([[10.2, 4.9, -7.7], [-12.1, 15.3, 6.6], [3.3, -18.8, 12.4], [-9.6, -6.5, -14.9]]),
)


@pytest.fixture(scope="module")
def setup() -> SetUp:
    frame = replace(Frame.load("gamma"), tolerances=Tolerances(0.02, 0.0, 0.0, 0.0, 0.0))
    return draw_setup(np.random.default_rng(21), frame)


@pytest.fixture(scope="module")
def observations(setup: SetUp) -> list[Observations]:
    rng = np.random.default_rng(4)
    images = [(name, *bead_images(setup, name, rng, 0.1)) for name in VIEWS]
    return [
        Observations(name, ids, uv, np.broadcast_to(0.01 * np.eye(2), (len(ids), 2, 2))) for name, ids, uv in images
    ]


@pytest.fixture(scope="module")
def views(setup: SetUp, observations: list[Observations]) -> list[BeadView]:
    return [sl.calibrate(one, setup.frame) for one in observations]


@pytest.fixture(scope="module")
def picked(setup: SetUp) -> np.ndarray:
    true = np.array([setup.views[name].project(POINTS.xyz_mm) for name in VIEWS])
    return true + np.random.default_rng(5).normal(0.0, 0.1, true.shape)


PICK_PX2 = np.broadcast_to(0.01 * np.eye(2), (2, 4, 2, 2))


def test_errors_are_small_predicted_and_tabulated(views, picked):
    made = assess(views, POINTS, picked, PICK_PX2)
    assert made.absolute_mm.max() < 0.15
    assert ((made.predicted_95_mm > 0.02) & (made.predicted_95_mm < 0.3)).all()
    np.testing.assert_allclose(made.points.xyz_mm, POINTS.xyz_mm + made.error_mm)
    position, distance, angle = made.table()
    assert (position.number, distance.number, angle.number) == (4, 6, 6)
    assert position.largest == made.absolute_mm.max()
    assert position.mean == pytest.approx(made.absolute_mm.mean())
    assert 0.0 < angle.mean < 1.0
    assert angle.unit == "°"
    assert made.checks[0].passed
    assert json.loads(json.dumps(made.document()))["points"][2]["name"] == "T3"


def test_normalised_error_is_the_mahalanobis_length(views, picked):
    made = assess(views, POINTS, picked, PICK_PX2)
    for i in range(4):
        expected = np.sqrt(made.error_mm[i] @ np.linalg.inv(made.points.covariance_mm2[i]) @ made.error_mm[i])
        assert made.normalised[i] == pytest.approx(expected)


def test_points_measured_wrongly_fail_the_check(views, picked):
    moved = replace(POINTS, xyz_mm=POINTS.xyz_mm + np.array([0.0, 0.6, 0.0]))
    made = assess(views, moved, picked, PICK_PX2)
    assert not made.checks[0].passed
    assert "check the measured coordinates" in made.checks[0].sentence


def test_statistics_of_known_numbers():
    row = Statistics.of("position", "mm", np.array([0.78, 0.42, 0.88, 0.84]))  # the paper's Table 1, Γ localized
    assert (row.mean, row.largest) == (pytest.approx(0.73), 0.88)
    assert row.sd == pytest.approx(0.2108, abs=1e-4)
    assert Statistics.of("position", "mm", np.array([0.5])).sd is None


def test_table_of_points_is_read(tmp_path):
    file = tmp_path / "points.csv"
    file.write_text(HEADER + "\nT1,1.5,2.5,-3.5\n\nT2,4,5,6\n")
    points = read_points(file)
    assert points.names == ("T1", "T2")
    np.testing.assert_array_equal(points.xyz_mm, [[1.5, 2.5, -3.5], [4, 5, 6]])
    assert points.uv_px is None
    file.write_text(HEADER + PIXELS + "\nT1,1,2,3,10,20,30,40\nT2,4,5,6,11,21,31,41\n")
    np.testing.assert_array_equal(read_points(file).uv_px, [[[10, 20], [11, 21]], [[30, 40], [31, 41]]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1"),
        ("name,x,y,z\nT1,1,2,3\n", "line 1"),
        (HEADER + "\n", "no points"),
        (HEADER + "\nT1,1,2\n", "line 2: 3 cells"),
        (HEADER + "\nT1,1,2,nan\n", "line 2: .*not a finite number"),
        (HEADER + "\nT1,1,2,x\n", "line 2: .*not a finite number"),
        (HEADER + "\nT1,1,2,3\nT1,4,5,6\n", "line 3.*twice"),
        (b"\xff\xfe\x00\x01", "not a text file in UTF-8"),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, message):
    file = tmp_path / "points.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UnusableInputError, match=message):
        read_points(file)


def test_points_without_pixels_are_refused(views):
    with pytest.raises(UnusableInputError, match="states no pixels"):
        assess(views, POINTS)


def _detections(observed: Observations, more_px: np.ndarray) -> Detections:
    uv = np.vstack([observed.uv_px, more_px])
    n = len(uv)
    noise = np.broadcast_to(0.01 * np.eye(2), (n, 2, 2))
    return Detections(uv, np.full(n, 7.0), noise, ("ball",) * n, np.full(n, -0.5), (1024, 1024))


def test_balls_are_found_among_the_detections(views, observations, picked):
    uv, covariance = find_balls(views[0], _detections(observations[0], picked[0]), observations[0], POINTS)
    np.testing.assert_array_equal(uv, picked[0])
    np.testing.assert_array_equal(covariance, PICK_PX2[0])


def test_balls_missing_or_doubled_are_refused(views, observations, picked):
    for seen, count in ((picked[0][1:], "0 balls"), (np.vstack([picked[0], picked[0][:1] + 5.0]), "2 balls")):
        with pytest.raises(RefusedError, match=f"{count}.*T1"):
            find_balls(views[0], _detections(observations[0], seen), observations[0], POINTS)
