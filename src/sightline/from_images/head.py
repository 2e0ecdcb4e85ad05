"""Fits the drawn circles of a femoral head to the edges that the images show."""

from collections.abc import Sequence

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.detection.edges.bone import REACH_PX, UNEVEN, NoBoneEdgeError, find_bone_edge
from sightline.errors import OutsideRegionError, ReconstructionRefusedError, UnusableInputError
from sightline.imaging import Radiograph
from sightline.planning.bone.aids import Circle
from sightline.planning.bone.head import find_head

_MIN_RADIUS_PX = 4 * REACH_PX  # so that a circle is far from its other side


def fit_head(
    views: Sequence[CalibratedView], images: Sequence[Radiograph], drawn: tuple[Circle, Circle]
) -> tuple[tuple[Circle, Circle], dict[str, str]]:
    """Return the head's circles fitted to the edges that the images show within 12 px of them, and what was kept.

    Its covariances are those of the fits. A circle is kept where its image shows no clear edge, or two, and both where
    they are not of one sphere: the reason stands at the view's name. `views`, `images`: PA and lateral first.
    """
    fitted, kept = [], {}
    for view, image, circle in zip(views[:2], images[:2], drawn, strict=True):
        try:
            fitted.append(_circle(image, circle))
        except NoBoneEdgeError as why:
            kept[view.name] = str(why)
            fitted.append(circle)
    head = fitted[0], fitted[1]
    if len(kept) < 2 and (why := _no_sphere(views, head)):
        return drawn, dict.fromkeys([view.name for view in views[:2]], why)
    return head, kept


def _no_sphere(views: Sequence[CalibratedView], head: tuple[Circle, Circle]) -> str:
    """Return why outlines are not those of one sphere; "" where they are."""
    try:
        agreement = find_head(views, head)[2]
    except (ReconstructionRefusedError, OutsideRegionError) as why:
        return str(why)
    return "" if agreement is None or agreement.passed else "the edges near both drawings are not those of one sphere"


def _circle(image: Radiograph, drawn: Circle) -> Circle:
    """Return points of the rim on its edge. They need not lie on a circle: the head is fitted to them in space."""
    by_circle = np.column_stack([2 * drawn.uv_px, np.ones(len(drawn.uv_px))])
    u, v, rest = np.linalg.lstsq(by_circle, (drawn.uv_px**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(rest + u * u + v * v))
    if radius < _MIN_RADIUS_PX:
        raise NoBoneEdgeError(f"its radius is {radius:.0f} px (at least {_MIN_RADIUS_PX:.0f} px are needed)")
    turns = 2 * np.pi * np.arange(int(2 * np.pi * radius)) / int(2 * np.pi * radius)
    outward = np.column_stack([np.cos(turns), np.sin(turns)])
    oval = np.column_stack([np.cos(2 * turns), np.sin(2 * turns)])  # as the image of a sphere may be
    uv = [u, v] + radius * outward
    edge = find_bone_edge(image, uv, -outward, np.column_stack([np.ones(len(turns)), outward]), oval)
    own = outward[edge.at]
    uneven = (UNEVEN * radius) ** 2 * own @ own.T
    at, covariance = _moved(uv[edge.at], -own, edge.offset_px, edge.covariance_px2 + uneven)
    # Three numbers of it measure the sphere: what else the edge shows, such as its flatness, is the bone's own.
    return Circle(at, covariance, np.linalg.pinv(np.column_stack([own, np.ones(len(at))])))


def _moved(
    uv_px: np.ndarray, inward: np.ndarray, offset_px: np.ndarray, covariance_px2: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (K, 2) moved inwards by offsets (K,), and the covariance (2K, 2K) of theirs across the edge.

    Along the edge their place is chosen, not measured: it has no error.
    """
    across = np.einsum("ij,ik->ikj", np.eye(len(uv_px)), inward).reshape(2 * len(uv_px), len(uv_px))
    return uv_px + offset_px[:, None] * inward, across @ covariance_px2 @ across.T


def refuse_tables(images: Sequence[Radiograph | None]) -> list[Radiograph]:
    """Return the images. Raises UnusableInputError where a view has none."""
    shown = [image for image in images if image is not None]
    if len(shown) < len(images):
        raise UnusableInputError("head and shaft are fitted to edges of images; a table of beads shows no edge")
    return shown
