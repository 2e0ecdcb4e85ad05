"""Image data for the browser: published once for all pages, by the image's number in the case."""

from collections import deque

import cv2
import numpy as np

from sightline.app.drawing.sight import sight
from sightline.app.drawing.xray.view import Window, XrayPicture
from sightline.app.session.seen import SeenImage
from sightline.app.web.images import Images
from sightline.calibration import BeadView
from sightline.imaging import Radiograph

_MAX_PICTURES = 16  # pictures kept: two planning and two check images, and those that undo may need [ours]
_MAX_LIVE = 20  # live pictures kept: two seconds of them
_FIELD_PX = 0.5  # tolerance of the field's polygon: less than a click's precision [ours]
# Percentiles of the field's grey levels between black and white [ours]. By default the open beam is left out.
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
        live = [picture.url for _, picture in self._live]
        for url in (*live, *(one.url for one in self._pictures.values()), *self._sights.values()):
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
