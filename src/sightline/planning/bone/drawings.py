"""Planes, cylinders, tubes and pairs of rims that are drawn on images, in space."""

from collections.abc import Callable

import numpy as np

from sightline.common.geometry.covariance import response
from sightline.common.geometry.lines import NearestApproach, nearest_approach
from sightline.errors import ReconstructionRefusedError
from sightline.planning.bone.axis import MIN_ANGLE_RAD
from sightline.planning.bone.directions import across, unit
from sightline.planning.bone.tube import Tube, cylinder, refuse_borders, refuse_oval
from sightline.planning.points.lines_of_sight import Sights

# Drawings of one thing in two images show its middle on lines of sight that pass each other by less than this [ours].
MAX_GAP_MM = 5.0

Rays = list[tuple[np.ndarray, np.ndarray]]


def find_drawing(sights: Sights, name: str, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (m,) of what is drawn as `name`, and their derivatives (m, n) by its numbers in z.

    `kind`, a type of `Drawing`:

    - "plane": a point, and the unit normal (6)
    - "cylinder": a point of its axis, the axis's direction, its radius (7)
    - "outline tube", "oval tube": for each image the focal point, and the four clicks on its plate (30)
    - "rim pair": the middles of both rims (6)

    Raises ReconstructionRefusedError where the drawing does not determine it.
    """
    at = sights.values[sights.index(name)]
    find = _FINDERS[kind]
    return response(lambda z: find(sights.rays(name, z), name), at)


def _plane(rays: Rays, name: str) -> np.ndarray:
    """Return point and normal (K, 6).

    A round plane, seen obliquely, is an ellipse, whose long axis is drawn: that diameter is perpendicular to the beam.
    So each image shows a direction in the plane, and two of them its normal; one image alone shows the plane edge-on.
    """
    middles = [(points.mean(axis=1), focal[:, 0]) for focal, points in rays]
    beams = [unit(middle - focal) for middle, focal in middles]
    drawn = [unit(across(points[:, 1] - points[:, 0], beam)) for (_, points), beam in zip(rays, beams, strict=True)]
    if len(rays) == 1:
        return np.concatenate([middles[0][0], unit(np.cross(drawn[0], beams[0]))], axis=1)
    normal = np.cross(drawn[0], drawn[1])
    if np.linalg.norm(normal[0]) < np.sin(MIN_ANGLE_RAD):
        raise ReconstructionRefusedError(
            f"the normal of the {name} lies in the plane of both beams, where these two images do not determine it; "
            "rotate the C-arm for one of them"
        )
    return np.concatenate([_middle(rays, name), unit(normal)], axis=1)


def _cylinder(rays: Rays, name: str) -> np.ndarray:
    tube = _tube_of(rays, name)
    return cylinder(tube, _nearest(rays).middle_mm, name)


def _tube(rays: Rays, name: str) -> np.ndarray:
    return _tube_of(rays, name).reshape(len(rays[0][0]), -1)


def _tube_of(rays: Rays, name: str) -> Tube:
    tube = _clicks(rays, name)
    for view in tube[0]:
        refuse_borders(view, name)
    return tube


def _oval_tube(rays: Rays, name: str) -> np.ndarray:
    tube = _clicks(rays, name)
    refuse_oval(tube[0, 0], name)
    refuse_borders(tube[0, 1], name)
    _middle(rays, name)
    return tube.reshape(len(tube), -1)


def _rim_pair(rays: Rays, name: str) -> np.ndarray:
    rims = [[(focal, points[:, rim]) for focal, points in rays] for rim in (slice(0, 4), slice(4, 8))]
    return np.concatenate([_middle(rim, name) for rim in rims], axis=1)


def _clicks(rays: Rays, name: str) -> Tube:
    """Return for the first two images the focal point and the clicks (K, 2, 5, 3)."""
    _refuse_one(rays, name)
    return np.stack([np.concatenate([focal, points], axis=1) for focal, points in rays[:2]], axis=1)


def _middle(rays: Rays, name: str) -> np.ndarray:
    """Return the point (K, 3) that the middles of the clicks in the first two images show."""
    _refuse_one(rays, name)
    near = _nearest(rays)
    if near.gap_mm[0] > MAX_GAP_MM:
        raise ReconstructionRefusedError(
            f"the {name} is not the same in both images: the middles of its clicks pass each other at "
            f"{near.gap_mm[0]:.1f} mm (at most {MAX_GAP_MM:.0f} mm); draw it again, each image in its own place"
        )
    return near.middle_mm


def _nearest(rays: Rays) -> NearestApproach:
    """Return the closest approach of the lines of sight through the middles of the clicks in the first two images."""
    (one, a), (other, b) = ((focal[:, 0], points.mean(axis=1) - focal[:, 0]) for focal, points in rays[:2])
    return nearest_approach(one, a, other, b)


def _refuse_one(rays: Rays, name: str) -> None:
    if len(rays) < 2:
        raise ReconstructionRefusedError(f"the {name} is drawn in one image only; draw it in both images")


_FINDERS: dict[str, Callable[[Rays, str], np.ndarray]] = {
    "plane": _plane,
    "cylinder": _cylinder,
    "outline tube": _tube,
    "oval tube": _oval_tube,
    "rim pair": _rim_pair,
}
