"""What the ruler says of clicks in one image, or in both."""

from collections.abc import Mapping, Sequence

import numpy as np

from sightline.app import texts
from sightline.app.plan.decisions import Pixel
from sightline.app.session.planning import Planning
from sightline.errors import SightlineError
from sightline.planning.points.ruler import Measured, measured_in_plane, measured_in_space

Clicks = Sequence[Pixel]


def measured_in_both(planning: Planning, clicks: Mapping[str, Clicks]) -> tuple[str, str] | None:
    """Return what `measured` returns of as many clicks in both images, by the images' names: of the places in space.
    None where the images do not show the same places."""
    views = [seen.view for seen in map(planning.seen, clicks) if seen is not None and seen.view is not None]
    if len(views) < 2 or len({len(each) for each in clicks.values()}) > 1:
        return None
    try:
        uv = np.array(list(clicks.values()))
        return _label(measured_in_space(views, uv), angle=uv.shape[1] == 3), texts.RULER_SPACE
    except SightlineError:
        return None


def measured(planning: Planning, image: str | None, clicks: Clicks) -> tuple[str, str]:
    """Return length or angle with its error, empty where it cannot be measured, and what it means: it holds in the
    plane through the middle of the planned wire, parallel to the plate."""
    known, seen = planning.planned, None if image is None else planning.seen(image)
    if known is None or known.plan is None or seen is None or seen.view is None:
        return "", texts.RULER_NEEDS_WIRE
    path = known.plan.trajectory
    try:
        found = measured_in_plane(seen.view, np.array(clicks), (path.entry_mm + path.end_mm) / 2.0)
    except SightlineError as error:
        return "", str(error)
    plane = (
        (
            "Measured in the plane of the wire, parallel to the image: "
            f"{1000.0 * found.per_mm:.1f} % more or less for each 10 mm before or behind it. "
            "Error: 95 %."
        )
        if len(clicks) == 2
        else "Measured between lines parallel to the image. Error: 95 %."
    )
    return _label(found, angle=len(clicks) == 3), plane


def _label(found: Measured, *, angle: bool) -> str:
    """Return length or angle with its error."""
    if angle:
        off = "" if found.error_95 is None else f" ± {np.rad2deg(found.error_95):.1f}°"
        return f"{np.rad2deg(found.value):.1f}°{off}"
    off = "" if found.error_95 is None else f" ± {found.error_95:.1f}"
    return f"{found.value:.1f}{off} mm"
