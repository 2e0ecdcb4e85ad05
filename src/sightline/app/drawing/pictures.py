"""What the browser is sent of an image and its view: grey values, maps for image-matching curves, where the head is."""

from collections import deque
from typing import Any

import cv2
import numpy as np

from sightline.app.drawing.xray import Window, XrayPicture
from sightline.app.plan.decisions import Side
from sightline.app.session.seen import SeenImage
from sightline.app.web.transfers import Images
from sightline.calibration import BeadView
from sightline.calibration.maps.hull import MAX_OUTSIDE
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.planning.points.picks import DEFAULT_PICK_SD_PX

_MAX_PICTURES = 16  # [calc] more than twice the seven of a case, for undo: planning, oblique, check and shot
_MAX_LIVE = 20  # live pictures kept: two seconds of them
_FIELD_PX = DEFAULT_PICK_SD_PX  # tolerance of the field's polygon
# Percentiles of the field's grey levels between black and white [ours]: the open beam and dead pixels are left out.
_WINDOW = (0.5, 96.0)
_PRESETS = {"bone": (0.5, 75.0), "metal": (0.0, 12.0), "beads": (0.1, 99.9)}  # metal is darkest, beads lie anywhere


class Pictures:
    """Published pictures, by the number of their acquisition."""

    def __init__(self, images: Images) -> None:
        self._images = images
        self._pictures: dict[tuple[int, bool], XrayPicture] = {}  # by number, and whether it is inverted
        self._sights: dict[BeadView, str] = {}
        self._live: deque[tuple[Radiograph, XrayPicture]] = deque()

    def live(self, image: Radiograph) -> XrayPicture:
        """Return the picture of a live image; a few are kept for pages that are late."""
        known = next((picture for passing, picture in self._live if passing is image), None)
        if known is not None:
            return known
        self._live.append((image, self._published(image)))
        if len(self._live) > _MAX_LIVE:
            self._images.forget(self._live.popleft()[1].url)
        return self._live[-1][1]

    def _published(self, image: Radiograph) -> XrayPicture:
        pixels = as_u16(image)
        inside = image.field_mask[::4, ::4]
        levels = pixels[::4, ::4][inside]
        presets = tuple((name, _window(levels, between)) for name, between in _PRESETS.items())
        height, width = pixels.shape
        return XrayPicture(
            self._images.publish(pixels), width, height, _window(levels, _WINDOW), _field(image), presets
        )

    def forget(self) -> None:
        """Publish none of them any more."""
        pictures = (*(picture for _, picture in self._live), *self._pictures.values())
        for url in (*(picture.url for picture in pictures), *self._sights.values()):
            self._images.forget(url)

    def sight(self, view: BeadView, picture: XrayPicture) -> str:
        """Return the address of the map of a view (`sight`), whose image is `picture`."""
        if view not in self._sights:
            self._sights[view] = self._images.publish_json(sight(view, (picture.height, picture.width)))
            while len(self._sights) > _MAX_PICTURES:
                self._images.forget(self._sights.pop(next(iter(self._sights))))
        return self._sights[view]

    def of(self, seen: SeenImage) -> XrayPicture:
        """Return the picture of an image of the case."""
        key = seen.acquired.number, seen.image.is_inverted
        if key not in self._pictures:
            self._pictures[key] = self._published(seen.image)
            while len(self._pictures) > _MAX_PICTURES:
                self._images.forget(self._pictures.pop(next(iter(self._pictures))).url)
        return self._pictures[key]


def as_u16(radiograph: Radiograph) -> np.ndarray:
    """Return pixels (H, W) uint16 for the eye; floating-point pixels are scaled to 65535."""
    pixels = radiograph.pixels
    if pixels.dtype != np.float32:
        return pixels.astype(np.uint16)
    lowest, highest = float(pixels.min()), float(pixels.max())
    share = (pixels.astype(np.float64) - lowest) / ((highest - lowest) or 1.0)  # a uniform image becomes black
    return (share * 65535.0).round().astype(np.uint16)


def _window(levels: np.ndarray, percentiles: tuple[float, float]) -> Window:
    low, high = np.percentile(levels, percentiles)
    return Window(float(low + high) / 2.0, float(max(high - low, 1.0)))


def _field(image: Radiograph) -> tuple[tuple[float, float], ...] | None:
    """Return the corners (u, v) of the field, clockwise on screen; None if X-rays reach the whole image."""
    mask = image.field_mask
    if mask.all():
        return None
    (whole, *_) = sorted(cv2.findContours(mask.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0], key=len)[
        ::-1
    ]
    corners = cv2.approxPolyDP(cv2.convexHull(whole), _FIELD_PX, True)[:, 0].astype(np.float64)
    u, v = corners.T
    if u @ np.roll(v, -1) < v @ np.roll(u, -1):
        corners = corners[::-1]
    return tuple((float(u), float(v)) for u, v in corners)


NODES = 33  # per axis: cubic interpolation between them agrees with the map to 0.02 px (tests) [ours]
_PAD = 2  # nodes beyond the region, for interpolation at its border
_ROUNDED_MM, _ROUNDED_PX = 5, 4  # decimals


def sight(view: BeadView, image_shape: tuple[int, int]) -> dict[str, Any]:
    """Return the map of a view (`Sight` in xray_sight.js) as JSON types.

    `focal`, `origin`, `axes`, mm: focal point and reference plane. `toPlane`: grid from pixels to the plane, `toImage`:
    grid from the plane to pixels, null where there is none; both cover the image as far as the view is calibrated:
    where the distance from all `sides` (normal, offset) of the beads' convex hull is at most `reach`, px.
    """
    hull = view.hull
    reach = MAX_OUTSIDE * hull.radius_px
    low = np.maximum(hull.corners_px.min(axis=0) - reach, -0.5)
    high = np.minimum(hull.corners_px.max(axis=0) + reach, np.array(image_shape[::-1]) - 0.5)
    pixels = _Grid(low, high)
    xy = view.plane_map.to_plane(pixels.nodes)
    near = xy[hull.is_near(pixels.nodes)]
    shadows = _Grid(near.min(axis=0), near.max(axis=0))
    uv = np.full((len(shadows.nodes), 2), np.nan)
    found_px, is_found = view.plane_map.find_image(shadows.nodes)
    uv[is_found] = found_px
    return {
        "focal": view.focal_point_mm.tolist(),
        "origin": view.plane.origin_mm.tolist(),
        "axes": view.plane.axes.tolist(),
        "toPlane": pixels.document(xy, _ROUNDED_MM),
        "toImage": shadows.document(uv, _ROUNDED_PX),
        "sides": hull.equations.tolist(),
        "reach": reach,
    }


class _Grid:
    """NODES x NODES nodes evenly over a rectangle, and _PAD more beyond each side. `nodes` (N, 2): row by row."""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self.step = (high - low) / (NODES - 1)
        self.start = low - _PAD * self.step
        self.count = NODES + 2 * _PAD
        x, y = (self.start[k] + self.step[k] * np.arange(self.count) for k in range(2))
        self.nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def document(self, values: np.ndarray, decimals: int) -> dict[str, Any]:
        """Return values (N, 2) at the nodes as JSON types."""
        known = [None if np.isnan(pair[0]) else pair.round(decimals).tolist() for pair in values]
        return {"start": self.start.tolist(), "step": self.step.tolist(), "count": self.count, "values": known}


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
