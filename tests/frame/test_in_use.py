from dataclasses import replace

import numpy as np
import pytest
from fit_scenes import FRAME, measured

from sightline.errors import FrameError
from sightline.frame import Frame, InUse, Tolerances
from sightline.frame.measured.fit import Circumstances, fit_frame
from sightline.twin.xray.setup import Handling, in_use, with_errors

EXACT = replace(Frame.load("gamma"), tolerances=Tolerances(0.0, 0.0, 0.0, 0.0, 0.0))


def places(frame: Frame) -> np.ndarray:
    return np.array([f.xyz_mm for f in frame.fiducials])


@pytest.mark.parametrize(
    ("told", "befell"),
    [
        (InUse(warmer_k=5.0), Handling(warmer_k=5.0)),
        (InUse(water_share=0.004), Handling(water_share=0.004)),
    ],
)
def test_heat_and_water_move_balls_as_the_twin_moves_them(told, befell):
    """One standard deviation along the factor's single direction, and along no other."""
    factor = replace(EXACT, in_use=told).error_factor
    values, vectors = np.linalg.eigh(factor @ factor.T)
    moved = (places(in_use(EXACT, befell)) - places(EXACT)).ravel()
    assert np.sqrt(values[-1]) == pytest.approx(np.linalg.norm(moved), rel=1e-9)
    assert values[-2] < 1e-12 * values[-1]
    np.testing.assert_allclose(np.abs(vectors[:, -1] @ moved), np.linalg.norm(moved), rtol=1e-9)


def test_drapes_move_the_plates_of_a_view_as_one():
    frame = replace(EXACT, in_use=InUse(drape_n=20.0))
    factor = frame.error_factor.reshape(226, 3, -1)
    pa = factor[:113]
    shift = pa.mean(axis=0)
    np.testing.assert_allclose(np.sqrt((shift**2).sum(axis=1)), 0.1, rtol=1e-9)  # 20 N: twice 0.05 mm, per axis
    distance = np.linalg.norm(places(EXACT)[0] - places(EXACT)[60])
    way = (places(EXACT)[0] - places(EXACT)[60]) / distance
    np.testing.assert_allclose(way @ (pa[0] - pa[60]), 0.0, atol=1e-12)  # rigid: no distance changes
    assert np.abs(factor[:113].reshape(339, -1) @ factor[113:].reshape(339, -1).T).max() < 1e-12


def test_it_adds_to_tolerances_and_to_a_stated_covariance_alike():
    told = InUse(5.0, 0.002, 10.0)
    default = Frame.load("gamma")
    covariance = default.error_factor @ default.error_factor.T
    stated = replace(default, covariance_mm2=covariance)
    for frame in (default, stated):
        factor = replace(frame, in_use=told).error_factor
        alone = replace(EXACT, in_use=told).error_factor
        np.testing.assert_allclose(factor @ factor.T, covariance + alone @ alone.T, atol=1e-10)


def test_the_file_keeps_it():
    frame = replace(Frame.load("gamma"), in_use=InUse(4.0, 0.001, 12.5))
    assert Frame.from_json(frame.to_json()).in_use == InUse(4.0, 0.001, 12.5)
    assert Frame.from_json(Frame.load("gamma").to_json()).in_use is None


@pytest.mark.parametrize(
    "text",
    [
        '{"warmer_k": -1, "water_share": 0, "drape_n": 0}',
        '{"warmer_k": 5}',
        '{"warmer_k": 1, "water_share": 0.5, "drape_n": 1}',
        '{"warmer_k": 1, "water_share": 0.001, "drape_n": 1, "wind": 3}',
        '{"warmer_k": 1e999, "water_share": 0, "drape_n": 0}',
    ],
)
def test_what_no_frame_bears_is_refused(text):
    whole = Frame.load("gamma").to_json().decode().replace('"units"', f'"in_use": {text}, "units"', 1)
    with pytest.raises(FrameError, match=r"in_use|finite"):
        Frame.from_json(whole.encode())


def test_a_measured_frame_keeps_what_use_adds_and_counts_it_once():
    rng = np.random.default_rng(1)
    told = InUse(5.0, 0.0, 0.0)
    series = [measured(np.array([f.xyz_mm for f in with_errors(FRAME, rng).fiducials]), rng)]
    plain = fit_frame(FRAME, series, Circumstances()).frame
    used = fit_frame(replace(FRAME, in_use=told), series, Circumstances()).frame
    assert plain is not None
    assert used is not None
    assert used.in_use == told
    np.testing.assert_allclose(used.covariance_mm2, plain.covariance_mm2, atol=1e-12)
