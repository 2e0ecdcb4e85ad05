"""Where the patient's head is in an image, for its default orientation."""

import numpy as np

from sightline.app.plan.decisions import Side
from sightline.calibration import BeadView
from sightline.frame import Frame

_STEP_MM = 10.0  # far more than a pixel


def head_in(view: BeadView | None, frame: Frame, side: Side | None) -> int | None:
    """Return the direction of the patient's head in an image as it is stored: degrees clockwise from up, to the nearest
    quarter turn. None where it is unknown: no side confirmed, not calibrated, or a block, which may stand anyhow."""
    if view is None or side is None or frame.solid is not None:
        return None
    to_head = _STEP_MM if side == "left" else -_STEP_MM  # +Y: caudal for a right hip, cranial for a left one
    uv, seen = view.project_seen(np.array([[0.0, 0.0, 0.0], [0.0, to_head, 0.0]]))
    if not seen.all():
        return None
    right, down = uv[1] - uv[0]
    return round(np.degrees(np.arctan2(right, -down)) / 90.0) % 4 * 90


def head_up(head: int | None) -> int:
    """Return the clockwise rotation of the display, degrees, that shows the head up; 0 where it is unknown."""
    return 0 if head is None else (360 - head) % 360
