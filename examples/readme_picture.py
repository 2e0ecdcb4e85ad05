"""Draw the picture of the README from the results of `sightline demo`.

`python examples/readme_picture.py out/demo docs/pictures/plan.svg`
"""

import base64
import json
import sys
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np

import sightline as sl
from sightline.case.report import radiographs, svg
from sightline.case.views import NAMES
from sightline.detection.csv_files import read_observations
from sightline.planning import Plan, kind, plan

SIDE, GAP = 1024, 24
SHOWN = 560  # px of the embedded image: a small file, sharp at half size


def picture(folder: Path) -> str:
    """Return both images side by side with beads by residual, matching curves, and the wire between the true points."""
    frame = sl.Frame.load("gamma")
    seen = read_observations(folder / "observations.csv")
    truth = json.loads((folder / "truth.json").read_text())["views"]
    views = [sl.calibrate(seen[name], frame) for name in NAMES]
    ends = [np.array([truth[name][f"{point}_uv_px"] for name in NAMES]) for point in ("entry", "end")]
    made = plan(views, *ends, snapped=True, procedure=kind("free-wire"))
    panels = [_panel(folder, k, view, made) for k, view in enumerate(views)]
    style = (files("sightline.case.report") / "templates" / "report.css").read_text("utf-8")
    body = svg.element("style", style.replace("</", "<\\/"))
    words = (
        "PA and lateral X-ray image of a femur behind bead plates, with the planned guide wire and its matching curves"
    )
    return svg.figure((0, 0, 2 * SIDE + GAP, SIDE), words, [body, *panels])


def _panel(folder: Path, k: int, view: sl.CalibratedView, made: Plan) -> str:
    left = view.residuals
    sizes = np.linalg.norm(left.residual_mm, axis=1)
    curves = [made.entry_curve, made.end_curve] if k else []
    overlays = [
        radiographs.beads(left, np.full(len(sizes), 10.0), float(np.quantile(sizes, 0.95))),
        *(radiographs.curve(curve, "PA pick") for curve in curves),
        radiographs.wire(view, made.trajectory),
    ]
    parts = [_pixels(folder / f"demo_{view.name}.dcm"), *overlays]
    return svg.element("svg", *parts, class_="radiograph", x=k * (SIDE + GAP), width=SIDE, height=SIDE)


def _pixels(path: Path) -> str:
    small = cv2.resize(radiographs.grey(sl.read_image(path)), (SHOWN, SHOWN), interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()
    href = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
    return svg.element("image", href=href, x=-0.5, y=-0.5, width=SIDE, height=SIDE)


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(picture(Path(sys.argv[1])), "utf-8")
