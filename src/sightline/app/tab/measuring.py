"""What the ruler says of clicks in one image."""

from collections.abc import Sequence

import numpy as np

from sightline.app.plan.decisions import Pixel
from sightline.app.session.planning import Planning
from sightline.app.texts import RULER_ANGLE, RULER_LENGTH, RULER_NEEDS_WIRE, RULER_PLANE, RULER_PLANE_ANGLE
from sightline.errors import SightlineError
from sightline.planning.ruler import measured_in_plane


def measured(planning: Planning, image: str | None, clicks: Sequence[Pixel]) -> tuple[str, str]:
    """Return length or angle with its error, empty where it cannot be measured, and what it means: it holds in the
    plane through the middle of the planned wire, parallel to the plate."""
    known, seen = planning.planned, None if image is None else planning.seen(image)
    if known is None or known.plan is None or seen is None or seen.view is None:
        return "", RULER_NEEDS_WIRE
    path = known.plan.trajectory
    try:
        found = measured_in_plane(seen.view, np.array(clicks), (path.entry_mm + path.end_mm) / 2.0)
    except SightlineError as error:
        return "", str(error)
    if len(clicks) == 2:
        off = "" if found.error_95 is None else f" ± {found.error_95:.1f}"
        return RULER_LENGTH.format(value=found.value, off=off), RULER_PLANE.format(percent=1000.0 * found.per_mm)
    off = "" if found.error_95 is None else f" ± {np.rad2deg(found.error_95):.1f}°"
    return RULER_ANGLE.format(value=np.rad2deg(found.value), off=off), RULER_PLANE_ANGLE
