"""3D Slicer markups (`.mrk.json`, schema 1.0.3): lines and points, LPS, mm."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sightline.calibration.exchange.writing import json_bytes

# Slicer compares this identifier; it does not fetch the address.
_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
GREEN, RED, YELLOW, BLUE = (0.2, 0.8, 0.3), (0.9, 0.1, 0.1), (0.95, 0.85, 0.2), (0.3, 0.6, 1.0)


def markup_bytes(
    kind: str,
    name: str,
    points_lps_mm: np.ndarray,
    labels: Sequence[str],
    *,
    colour: tuple[float, float, float],
    description: str,
    labelled: bool = True,
) -> bytes:
    """Return a markup file. `kind`: "Line" (two points) or "Fiducial"; each control point carries the description."""
    points: list[dict[str, Any]] = [
        {
            "id": str(k + 1),
            "label": label,
            "description": description,
            "position": [float(x) + 0.0 for x in place],
            "selected": True,
            "locked": True,
            "visibility": True,
            "positionStatus": "defined",
        }
        for k, (label, place) in enumerate(zip(labels, points_lps_mm, strict=True))
    ]
    markup = {
        "type": kind,
        "name": name,
        "description": description,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "fixedNumberOfControlPoints": True,
        "controlPoints": points,
        "display": {
            "visibility": True,
            "color": list(colour),
            "selectedColor": list(colour),
            "pointLabelsVisibility": labelled,
        },
    }
    return json_bytes({"@schema": _SCHEMA, "markups": [markup]})
