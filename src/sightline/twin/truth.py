"""The truth of simulated images as JSON."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sightline.atomic import write_whole
from sightline.twin.carm import SetUp, ViewTruth
from sightline.twin.scene import HipScene

Points = Mapping[str, np.ndarray]


def truth_document(setup: SetUp, hip: HipScene) -> dict[str, Any]:
    """Return the truth of the images of a hip: wire, landmarks, views, beads. Points in CFCS, mm, and in pixels of the
    images."""
    document: dict[str, Any] = {
        **points_document(setup, hip.landmarks_mm, {name: hip.at(name).landmarks_mm for name in setup.views}),
        "head_mm": hip.head_mm.tolist(),
        "head_radius_mm": hip.femur.head_radius_mm,
        "entry_mm": hip.wire_mm[0].tolist(),
        "end_mm": hip.wire_mm[1].tolist(),
    }
    for name, view in setup.views.items():
        entry, end = view.project(hip.at(name).wire_mm)
        document["views"][name] |= {"entry_uv_px": entry.tolist(), "end_uv_px": end.tolist()}
    if hip.motions:  # the points above are those before any motion
        document["bone_moved"] = {moment: motion.as_matrix().tolist() for moment, motion in hip.motions.items()}
    return document


def points_document(
    setup: SetUp, points_mm: Points, when_seen_mm: Mapping[str, Points] | None = None
) -> dict[str, Any]:
    """Return the truth of any set-up: named points (3,), CFCS, and their pixels, views, beads.

    `when_seen_mm`: the points at the time of each view, if they move. Beads whose centre lies outside a view's field
    have no pixel in it.
    """
    when = when_seen_mm or dict.fromkeys(setup.views, points_mm)
    return {
        "frame": setup.frame.key,
        "coordinates": "CFCS",
        "side": setup.side,
        "points_mm": {name: xyz.tolist() for name, xyz in points_mm.items()},
        "views": {name: _view(setup, view, when[name]) for name, view in setup.views.items()},
        "beads_mm": {bead.id: list(bead.xyz_mm) for bead in setup.true_frame.fiducials},
    }


def write_truth(path: str | Path, setup: SetUp, hip: HipScene) -> Path:
    """Write `truth_document` as JSON. Raises UnusableInputError if the file cannot be written."""
    return write_whole(path, json.dumps(truth_document(setup, hip), indent=1).encode())


def _view(setup: SetUp, view: ViewTruth, points_mm: Points) -> dict[str, Any]:
    beads = setup.frame_in(view.name).fiducials_of(view.name)
    uv = view.project(np.array([bead.xyz_mm for bead in beads]))
    seen = view.in_field(uv)
    return {
        "focal_point_mm": view.focal_point_mm.tolist(),
        "detector": {"origin_mm": view.detector.origin_mm.tolist(), "axes": view.detector.axes.tolist()},
        "points_uv_px": {name: view.project(xyz).tolist() for name, xyz in points_mm.items()},
        "beads_uv_px": {bead.id: at.tolist() for bead, at, kept in zip(beads, uv, seen, strict=True) if kept},
    }
