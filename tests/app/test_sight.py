"""Curves that the browser draws from the maps of two views, against the server's: the script itself runs in Node.js."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.app.given import observed
from tests.app.node import XRAY, run_node
from tests.three import draw_three

from sightline.app.drawing.pictures import sight
from sightline.calibration import BeadView, calibrate
from sightline.calibration.solids.calibrate_together import calibrate_together
from sightline.case.views import NAMES
from sightline.errors import OutsideRegionError
from sightline.frame import Frame
from sightline.planning import matching_curve, snap
from sightline.twin import draw_setup

AGREES_PX = 0.05  # what is asked of the browser: a tenth of a careful click's error
SHAPE = (1024, 1024)
SNAP_PX = 5.0  # a click beside the curve
_SCRIPT = f"""
import {{ readFileSync }} from "node:fs";
import {{ Sight, matchingCurve, nearest, pixelAt }} from "{(XRAY / "xray_sight.js").as_uri()}";
const {{ sights, picks, clicks }} = JSON.parse(readFileSync(0, "utf-8"));
const [from, to] = sights.map((one) => new Sight(one));
const curves = picks.map((uv) => matchingCurve(from, uv, to));
const slid = curves.map((curve, k) => curve && pixelAt(curve, nearest(curve, clicks[k])));
console.log(JSON.stringify({{ curves, slid }}));
"""


def _views(frame: str) -> tuple[BeadView, ...]:
    """Both views of a drawn set-up: of plates before a distorting intensifier, of a block before a flat panel."""
    rng = np.random.default_rng(17)
    if frame == "block60":
        setup = draw_three(rng, "flat-panel-0.3")[0]
        return calibrate_together([observed(setup, name, rng) for name in NAMES], setup.frame)
    setup = draw_setup(rng, Frame.load(frame))
    return tuple(calibrate(observed(setup, name, rng), setup.frame, view=name) for name in NAMES)


def _visible(uv: np.ndarray) -> np.ndarray:
    return ((uv > -0.5) & (uv < np.array(SHAPE[::-1]) - 0.5)).all(axis=1)


@pytest.mark.parametrize("frame", ["gamma", "block60"])
def test_the_browser_draws_the_curves_of_the_server(frame: str) -> None:
    views = _views(frame)
    rng, picks, expected, clicks = np.random.default_rng(18), [], [], []
    while len(picks) < 30:
        uv = rng.uniform(100.0, 924.0, 2)
        try:
            curve = matching_curve(views[0], uv, views[1])
        except OutsideRegionError:
            continue
        shown = np.flatnonzero(_visible(curve.uv_px))
        if len(shown) < 20:
            continue
        middle = shown[len(shown) // 2]
        clicks.append(curve.uv_px[middle] + SNAP_PX * curve.across_px[middle])
        picks.append(uv)
        expected.append(curve)
    given = {
        "sights": [sight(view, SHAPE) for view in views],
        "picks": np.array(picks).tolist(),
        "clicks": np.array(clicks).tolist(),
    }
    drawn = json.loads(run_node("--input-type=module", "--eval", _SCRIPT, text=json.dumps(given)))
    for curve, own, slid, click in zip(expected, drawn["curves"], drawn["slid"], clicks, strict=True):
        rows = np.flatnonzero(_visible(curve.uv_px))
        at = {depth: k for k, depth in enumerate(own["depth"])}
        browser = np.array([own["uv"][at[depth]] for depth in curve.depth_mm[rows]])  # no visible sample is missing
        assert np.linalg.norm(browser - curve.uv_px[rows], axis=1).max() < AGREES_PX
        assert np.linalg.norm(snap(curve, click).uv_px - slid) < AGREES_PX
        snap(curve, np.array(slid))  # the server takes the place to which the point slid


def test_a_map_is_small_and_valid_json() -> None:
    view = _views("gamma")[0]
    written = json.dumps(sight(view, SHAPE), allow_nan=False)
    assert len(written) < 100_000  # its image has 2 MB


def test_units_of_the_scripts() -> None:
    """Geometry, gestures and the order of moves (xray.test.mjs)."""
    run_node("--test", str(Path(__file__).with_name("xray.test.mjs")))
