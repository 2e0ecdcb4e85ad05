"""How a drilled wire is judged, and a whole insertion of the plastic femur."""

import numpy as np
import pytest

from sightline.rehearsal.operation import Outcome
from sightline.robot.manipulator import imaging_yaw, nominal_manipulator
from sightline.studies.study_fig15 import Figure15

IDEAL = np.array([[40.0, 30.0, -5.0], [-30.0, -35.0, 7.0]])


def test_a_wire_on_its_line_errs_by_nothing_but_its_depth():
    along = (IDEAL[1] - IDEAL[0]) / np.linalg.norm(IDEAL[1] - IDEAL[0])
    found = Outcome.of(np.stack([IDEAL[0] - 12.0 * along, IDEAL[1] + 0.4 * along]), IDEAL)
    assert found.entry_mm == pytest.approx(0.0, abs=1e-9)
    assert found.end_mm == pytest.approx(0.4)
    assert found.angle_rad == pytest.approx(0.0, abs=1e-9)


def test_a_turned_wire_errs_as_it_is_turned():
    along = (IDEAL[1] - IDEAL[0]) / np.linalg.norm(IDEAL[1] - IDEAL[0])
    across = np.cross(along, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    length = np.linalg.norm(IDEAL[1] - IDEAL[0])
    found = Outcome.of(np.stack([IDEAL[0], IDEAL[1] + 0.01 * length * across]), IDEAL)
    assert found.entry_mm == pytest.approx(0.0, abs=1e-9)
    assert found.end_mm == pytest.approx(0.01 * length)
    assert found.angle_rad == pytest.approx(np.arctan(0.01))


def test_the_frame_stands_square_at_its_nominal_yaw():
    assert np.rad2deg([imaging_yaw("right"), imaging_yaw("left")]) == pytest.approx([45.0, -45.0])
    for side in ("right", "left"):
        turned = nominal_manipulator(side).T_mcs_cfcs(np.array([0.0, 0.0, imaging_yaw(side), 0.0, 0.0])).rotation
        assert turned.apply([1.0, 0.0, 0.0]) == pytest.approx([-1.0, 0.0, 0.0], abs=1e-12)  # lateral: to the robot


@pytest.mark.slow
def test_a_wire_is_inserted_into_the_bore():
    """The paper's limits, by one trial of the study: images, plan, link, physics."""
    pytest.importorskip("mujoco")
    values = Figure15().trial(np.random.default_rng(5))
    assert set(values) == set(Figure15().methods)
    best = values["smooth"]
    assert "refused" not in best, values
    assert best["entry"] < 1.0
    assert best["angle"] < 0.6
    assert best["stated_entry"] < 1.0
    summary = Figure15().summary([values, {"refused": "SetUpError: no"}])
    assert "1 of 2 insertions" in summary.findings[0]
    assert summary.tables[1].rows[-1][2] == "refused"
