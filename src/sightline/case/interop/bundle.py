"""The parts of plan.json that let it be exported without the case: geometry of the images, beads, lines of sight."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from sightline.calibration.exchange import opencv
from sightline.case.interop.plate import plate_image
from sightline.case.views import CalibratedImage
from sightline.errors import OutsideRegionError
from sightline.frame import Frame
from sightline.planning import Plan
from sightline.planning.document import SOLID

POINTS = ("entry", "end")
_WIRE_POINTS = 21  # [ours] about 5 mm apart, since distortion bends the drawn wire


def bundle(plan: Plan, images: Sequence[CalibratedImage], frame: Frame) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the keys to add to plan.json, and the undistorted images as files to write beside it."""
    plates, files = {}, {}
    for image in images:
        seen = image.seen.image
        plate = plate_image(image.view, None if seen is None else seen.pixels)
        plates[image.name] = opencv.document(plate.pinhole) | {"file": None}
        if plate.pixels is not None and seen is not None and plate.pixels.dtype in (np.uint8, np.uint16):
            name = f"{image.name}-plate.png"
            files[name] = cv2.imencode(".png", plate.pixels)[1].tobytes()
            plates[image.name] |= {"file": name, "white": seen.white}
    document = {
        "frame": _frame(frame),
        "plates": plates,
        "lines_of_sight": [line for k, image in enumerate(images) for line in _lines(plan, k, image)],
        "drawn": {image.name: _drawn(plan, k, image) for k, image in enumerate(images)},
    }
    return document, files


def _frame(frame: Frame) -> dict[str, Any]:
    bodies = frame.named_plates if frame.solid is None else (("all", SOLID, frame.solid),)  # the rest is not CFCS
    beads = [
        {"id": bead.id, "view": name, "plate": role, "xyz_mm": list(map(float, bead.xyz_mm))}
        for name, role, body in bodies
        for bead in body.fiducials
    ]
    return {"name": frame.name, "serial": frame.serial, "fingerprint": frame.fingerprint, "beads": beads}


def _lines(plan: Plan, k: int, image: CalibratedImage) -> list[dict[str, Any]]:
    uv = np.array([pick[k].uv_px for pick in plan.picks])
    shown = np.isfinite(uv).all(axis=1)
    sight = image.view.lines_of_sight(uv[shown])
    return [
        {
            "point": point,
            "view": image.name,
            "focal_point_mm": sight.focal_point_mm.tolist(),
            "plate_mm": sight.points_mm[i].tolist(),
        }
        for i, point in enumerate(np.array(POINTS)[shown].tolist())
    ]


def _drawn(plan: Plan, k: int, image: CalibratedImage) -> dict[str, Any]:
    """Return the picks of an image, for a point that it was not picked in the point's projection, and its wire."""
    picks = np.array([pick[k].uv_px for pick in plan.picks], dtype=np.float64)
    missed = np.isnan(picks).any(axis=1)
    if missed.any():
        picks[missed] = image.view.project(plan.trajectory.points.xyz_mm[missed])
    entry, end = picks.tolist()
    path = plan.trajectory
    along = path.entry_mm + np.linspace(0, 1, _WIRE_POINTS)[:, None] * (path.end_mm - path.entry_mm)
    try:
        wire = image.view.project(along).tolist()
    except OutsideRegionError:
        wire = []
    return {"entry_px": entry, "end_px": end, "wire_px": wire}
