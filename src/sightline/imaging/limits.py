"""Limits on image files."""

from sightline.errors import ImageError

MAX_FILE_BYTES = 2**30  # [ours] a run of 500 frames of 1024² at 16 bit
MAX_PIXELS = 2**25  # [ours] twice a 43 cm flat panel at 0.105 mm
MIN_SIDE = 16  # as `Radiograph`


def check_size(height: int, width: int, name: str) -> None:
    """Raise ImageError where an image is too small or too large."""
    if min(height, width) < MIN_SIDE:
        raise ImageError(f"{name} has {width} x {height} pixels; an X-ray image has at least {MIN_SIDE} a side")
    if height * width > MAX_PIXELS:
        raise ImageError(f"{name} has {width} x {height} pixels; the limit is {MAX_PIXELS} in all: crop or reduce it")
