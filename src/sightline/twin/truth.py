"""The truth of simulated images, as a document to be written beside them."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from sightline.atomic import write_whole
from sightline.twin.carm import SetUp, ViewTruth
from sightline.twin.scene import HipScene


def truth_document(setup: SetUp, hip: HipScene) -> dict[str, Any]:
    """What a person may ask of the images of a hip: wire, views, beads. CFCS in mm, pixels as the images have them."""
    document = {
        "frame": setup.frame.key,
        "coordinates": "CFCS",
        "side": setup.side,
        "head_mm": hip.head_mm.tolist(),
        "head_radius_mm": hip.femur.head_radius_mm,
        "entry_mm": hip.wire_mm[0].tolist(),
        "end_mm": hip.wire_mm[1].tolist(),
        "views": {name: _view(setup, view, hip) for name, view in setup.views.items()},
        "beads_mm": {bead.id: list(bead.xyz_mm) for v in setup.true_frame.views.values() for bead in v.fiducials},
    }
    if hip.motions:  # head and wire above are where the bone was before
        document["bone_moved"] = {moment: motion.as_matrix().tolist() for moment, motion in hip.motions.items()}
    return document


def write_truth(path: str | Path, setup: SetUp, hip: HipScene) -> Path:
    """Write `truth_document` as JSON. Raises UnusableInputError where the place cannot be written."""
    return write_whole(path, json.dumps(truth_document(setup, hip), indent=1).encode())


def _view(setup: SetUp, view: ViewTruth, hip: HipScene) -> dict[str, Any]:
    entry, end = view.project(hip.at(view.name).wire_mm)
    beads = setup.true_frame.view(view.name).fiducials
    uv = view.project(np.array([bead.xyz_mm for bead in beads]))
    seen = view.in_field(uv)
    return {
        "focal_point_mm": view.focal_point_mm.tolist(),
        "detector": {"origin_mm": view.detector.origin_mm.tolist(), "axes": view.detector.axes.tolist()},
        "entry_uv_px": entry.tolist(),
        "end_uv_px": end.tolist(),
        "beads_uv_px": {bead.id: at.tolist() for bead, at, kept in zip(beads, uv, seen, strict=True) if kept},
    }
