"""Pictures for the browser: published once for all pages, by the image's number in the case."""

from dataclasses import dataclass

import numpy as np

from sightline.app.images import Images, as_u16
from sightline.app.seen import SeenImage
from sightline.app.xray import Window

_MOST = 16  # pictures kept: two planning and two check images, and what undo may bring back [ours]
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

    def of(self, seen: SeenImage) -> Picture:
        """The picture of an image."""
        number = seen.acquired.number
        if number not in self._pictures:
            pixels, _ = as_u16(seen.image)
            inside = seen.image.field_mask[::4, ::4]
            low, high = np.percentile(pixels[::4, ::4][inside], _SHARES)
            window = Window(float(low + high) / 2.0, float(max(high - low, 1.0)))
            height, width = pixels.shape
            self._pictures[number] = Picture(self._images.publish(pixels), width, height, window)
            while len(self._pictures) > _MOST:
                self._images.forget(self._pictures.pop(next(iter(self._pictures))).url)
        return self._pictures[number]
