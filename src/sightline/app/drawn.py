"""Pictures for the browser: published once for all pages, by the image's number in the case."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from sightline.app.images import Images, as_u16
from sightline.app.seen import SeenImage
from sightline.app.xray import Window
from sightline.imaging import Radiograph

_MOST = 16  # pictures kept: two planning and two check images, and what undo may bring back [ours]
_PASSING = 20  # live pictures kept: two seconds of them
_SHARES = (0.5, 96.0)  # per cent of the field's grey levels: bone, not the open beam, gets the window [ours]


@dataclass(frozen=True)
class Picture:
    """Where the browser gets an image, its size, and the window that shows all it holds."""

    url: str
    width: int
    height: int
    window: Window


class Pictures:
    """Pictures by the number of their acquisition."""

    def __init__(self, images: Images) -> None:
        self._images = images
        self._pictures: dict[int, Picture] = {}
        self._passing: deque[str] = deque()

    def live(self, image: Radiograph) -> Picture:
        """The picture of an image that is seen once; a few of them are kept for pages that are late."""
        picture = self._published(image)
        self._passing.append(picture.url)
        if len(self._passing) > _PASSING:
            self._images.forget(self._passing.popleft())
        return picture

    def _published(self, image: Radiograph) -> Picture:
        pixels, _ = as_u16(image)
        inside = image.field_mask[::4, ::4]
        low, high = np.percentile(pixels[::4, ::4][inside], _SHARES)
        window = Window(float(low + high) / 2.0, float(max(high - low, 1.0)))
        height, width = pixels.shape
        return Picture(self._images.publish(pixels), width, height, window)

    def of(self, seen: SeenImage) -> Picture:
        """The picture of an image."""
        number = seen.acquired.number
        if number not in self._pictures:
            self._pictures[number] = self._published(seen.image)
            while len(self._pictures) > _MOST:
                self._images.forget(self._pictures.pop(next(iter(self._pictures))).url)
        return self._pictures[number]
