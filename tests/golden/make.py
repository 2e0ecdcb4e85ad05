"""Make the golden data of every stage from a run of the demo: `python tests/golden/make.py out/demo`.

Each stage's input is stored too, so that a changed stage does not affect the others. Run it only when a result is
meant to change, and state the reason in the commit.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

import sightline as sl
from sightline.cli.base import as_json
from sightline.detection.csv_files import read_observations, write_observations
from sightline.imaging import write_png
from sightline.planning import kind, plan

HERE = Path(__file__).parent
CROP_PX = 160  # a few beads; the file stays small


def crop(image: sl.Radiograph, middle_px: np.ndarray) -> sl.Radiograph:
    """Return a square of an image around a pixel."""
    left, top = (int(c) - CROP_PX // 2 for c in middle_px)
    return sl.Radiograph(image.pixels[top : top + CROP_PX, left : left + CROP_PX], image.white)


def answers(picks_px: np.ndarray) -> dict[str, Any]:
    """Return each stage's result for its stored input. `picks_px` (2, 2, 2): entry and end point in PA and lateral."""
    frame = sl.Frame.load("gamma")
    beads = sl.detect(sl.read_image(HERE / "crop.png"))
    order = np.lexsort(beads.uv_px.T)
    labelled = sl.label(sl.Detections(**json.loads((HERE / "detections.json").read_text())), frame)
    seen = read_observations(HERE / "observations.csv")
    views = {
        method: [sl.calibrate(seen[name], frame, method=method) for name in ("pa", "lateral")]
        for method in ("smooth", "polynomial", "localized")
    }
    planned = plan(
        views["smooth"], picks_px[:, 0], picks_px[:, 1], pick_sd_px=0.5, snapped=False, procedure=kind("free-wire")
    )
    return {
        "detect": {"uv_px": beads.uv_px[order], "radius_px": beads.radius_px[order]},
        "label": dict(zip(labelled.ids, labelled.uv_px.tolist(), strict=True)),
        "calibrate": {method: [view.focal_point_mm for view in pair] for method, pair in views.items()},
        "plan": {
            "picks_px": picks_px,
            "xyz_mm": planned.trajectory.points.xyz_mm,
            "covariance_mm2": planned.trajectory.covariance_mm2,
            "go": planned.verdict.go,
        },
    }


def main(demo: Path) -> None:
    """Store inputs and results."""
    image = sl.read_image(demo / "demo_pa.dcm")
    write_png(crop(image, np.array(image.shape[::-1]) / 2), HERE / "crop.png")
    beads = sl.detect(image)
    stored = {name: getattr(beads, name) for name in ("uv_px", "radius_px", "covariance_px2", "kind", "contrast")}
    (HERE / "detections.json").write_text(as_json({**stored, "image_shape": beads.image_shape}))
    write_observations(list(read_observations(demo / "observations.csv").values()), HERE / "observations.csv")
    truth = json.loads((demo / "truth.json").read_text())["views"]
    picks = np.array([[truth[name][f"{end}_uv_px"] for end in ("entry", "end")] for name in ("pa", "lateral")])
    (HERE / "answers.json").write_text(as_json(answers(picks)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
