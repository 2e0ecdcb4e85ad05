"""Acquire one frame of a source, or the mean of several, as a file, with a record of how it was made."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sightline.case.acquire.acquirer import Acquirer, Taken
from sightline.case.acquire.robot import PoseNow
from sightline.common.atomic import scratch_folder
from sightline.errors import MovedRefusedError
from sightline.imaging import Radiograph, SourceFrame, write_png
from sightline.imaging.average import average
from sightline.imaging.defects import MOVED, comb, field_of

FIELDS = ("first", "second")


def take_frames(
    acquirer: Acquirer,
    frames: Sequence[SourceFrame],
    *,
    field: str | None = None,
    interlaced: bool = False,
    pose: PoseNow | None = None,
    how: Mapping[str, Any] | None = None,
) -> Taken:
    """Acquire the mean of one or more frames as PNG (as NumPy file if they are floats), with what is known of them.

    `field`: use only this one of FIELDS, for interlaced video. `interlaced`: refuse frames whose two fields show
    movement. Raises MovedRefusedError, ImageError, CaseError.
    """
    combs = [comb(frame.image) for frame in frames] if interlaced else []
    if combs and field is None and max(combs) > MOVED:
        raise MovedRefusedError(
            f"something moved between the two fields of the video (comb {max(combs):.2f}, limit {MOVED:g}); hold "
            "still and take the image again, or use one field of it (--field first)"
        )
    images = [frame.image if field is None else field_of(frame.image, FIELDS.index(field)) for frame in frames]
    image = images[0] if len(images) == 1 else average(images)
    last = frames[-1]
    known: dict[str, Any] = {
        "source": last.source,
        "arrival": last.number,
        "received_s": last.stamped_s,
        "sender_s": last.sender_s,
        "averaged": len(frames),
        "comb": max(combs) if combs else None,
        "field": field,
        "pixel_aspect": last.pixel_aspect,
        "robot": None if pose is None else pose.document(),
        **(how or {}),
    }
    return acquirer.take(*_file_of(image), how={key: value for key, value in known.items() if value is not None})


def _file_of(image: Radiograph) -> tuple[bytes, str]:
    """Return the image as the bytes of a file, and the file's suffix."""
    if image.pixels.dtype == np.float32:
        buffer = io.BytesIO()
        np.save(buffer, image.pixels)
        return buffer.getvalue(), ".npy"
    with scratch_folder() as folder:
        return write_png(image, folder / "image.png").read_bytes(), ".png"
