"""A radiograph: pixels and metadata."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from typing import Any

import numpy as np

from sightline.common.show import Plotted
from sightline.errors import ImageError
from sightline.imaging.burnt_in import burnt_in
from sightline.imaging.collimation import field_mask
from sightline.imaging.formats import non_negative

_STRETCH = (0.5, 99.5)  # [ours] percentiles that become black and white: dead pixels and writing do not set the range


@dataclass(frozen=True)
class GeometryTags:
    """Geometry stated by a file; None where it is not. Never required, never trusted.

    DICOM (0018,1110) mm, (0018,1164) mm at the detector (row, column), (0018,1162) mm,
    (0018,1510) and (0018,1511) degrees.
    """

    source_detector_mm: float | None = None
    imager_pixel_spacing_mm: tuple[float, float] | None = None
    intensifier_size_mm: float | None = None
    primary_angle_deg: float | None = None
    secondary_angle_deg: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Radiograph(Plotted):
    """One X-ray image.

    `pixels` (H, W): uint8, uint16 or float32, read-only; larger values are brighter and mean more X-rays at the
    detector (MONOCHROME1 has been inverted). `white`: the largest value that the source can store, so
    `pixels >= white` are saturated. `lossy`: the file was compressed with loss. `is_inverted`: the pixels are the
    negative of the file's. Raises ImageError on anything but a finite two-dimensional array, and on negative
    values but padding, noise about black, and few.

    >>> image = sl.Radiograph(np.full((512, 512), 900, np.uint16), white=4095.0)
    >>> image
    Radiograph: 512 x 512 px, uint16
      values 900 to 900, white 4095
    """

    pixels: np.ndarray
    white: float
    tags: GeometryTags = field(default_factory=GeometryTags)
    lossy: bool = False
    is_inverted: bool = False

    def __post_init__(self) -> None:
        pixels = np.asarray(self.pixels)
        if pixels.ndim != 2 or min(pixels.shape, default=0) < 16:
            raise ImageError(f"an image has two dimensions of at least 16 pixels, not the shape {pixels.shape}")
        if pixels.dtype not in (np.uint8, np.uint16):
            pixels = pixels.astype(np.float32)
            if not np.isfinite(pixels).all():
                raise ImageError("the image holds values that are not finite; export it again without them")
            pixels, _ = non_negative(pixels, None, "the image")
        pixels = pixels.view()
        pixels.flags.writeable = False
        object.__setattr__(self, "pixels", pixels)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def pixels_sha256(self) -> str:
        """SHA-256 of the pixels, in hexadecimal."""
        return sha256(self.pixels.tobytes()).hexdigest()

    def summary(self) -> str:
        """Return size, type and range of the pixels, and the geometry that the file states."""
        pixels = self.pixels
        lines = [
            f"Radiograph: {self.shape[1]} x {self.shape[0]} px, {pixels.dtype}",
            f"  values {pixels.min():g} to {pixels.max():g}, white {self.white:g}",
        ]
        known = [f"{name} {value}" for name, value in vars(self.tags).items() if value is not None]
        lines += [f"  the file states {', '.join(known)}"] if known else []
        lines += ["  compressed with loss"] if self.lossy else []
        return "\n".join([*lines, "  inverted, white for black"] if self.is_inverted else lines)

    def _draw(self, ax: Any) -> None:
        from sightline.common import draw

        draw.image(ax, self.pixels, self.shape, np.zeros((0, 2)), f"{self.shape[1]} x {self.shape[0]} px")

    def inverted(self) -> "Radiograph":
        """Return the negative of the image."""
        now = not self.is_inverted
        if self.pixels.dtype != np.float32:
            return replace(self, pixels=(self.white - self.pixels).astype(self.pixels.dtype), is_inverted=now)
        pixels = np.float32(self.white) - self.pixels
        white = float(np.nextafter(pixels.max(), np.float32(np.inf)))
        return replace(self, pixels=pixels, white=white, is_inverted=now)

    def binned(self, factor: int) -> "Radiograph":
        """Return the sums of `factor` x `factor` pixels, float32; incomplete rows and columns are dropped."""
        height, width = (side // factor for side in self.shape)
        whole = self.pixels[: height * factor, : width * factor].astype(np.float32)
        sums = whole.reshape(height, factor, width, factor).sum(axis=(1, 3))
        spacing = self.tags.imager_pixel_spacing_mm
        tags = replace(self.tags, imager_pixel_spacing_mm=spacing and (spacing[0] * factor, spacing[1] * factor))
        return replace(self, pixels=sums, white=self.white * factor**2, tags=tags)

    @cached_property
    def field_mask(self) -> np.ndarray:
        """(H, W) bool, True inside the round or octagonal collimation."""
        return field_mask(self.pixels)

    @cached_property
    def burnt_in(self) -> np.ndarray | None:
        """(H, W) bool, True on burnt-in annotations; None where there are none."""
        return burnt_in(self.pixels, self.white, self.field_mask)


def stretched(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return float values (H, W) as uint8 for display, stretched over the percentiles of the `known` ones (N,)."""
    low, high = np.percentile(known, _STRETCH)
    return np.clip((values - low) / max(float(high - low), 1e-6) * 255, 0, 255).astype(np.uint8)
