"""Acquire images into a case: each is read, kept and recorded once, and is on the disk before it is reported.

Frames of a source, or their mean, become files that are acquired likewise, with a record of how they were made.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sightline.case import contents
from sightline.case.journal import Actor, Case, Entry, Kind, originals
from sightline.common.atomic import scratch_folder
from sightline.errors import CaseError, ImageError, MovedRefusedError, OvertakenError
from sightline.imaging import Radiograph, SourceFrame, frames_in, read_image, write_png
from sightline.imaging.average import average
from sightline.imaging.defects import MOVED, comb, field_of

if TYPE_CHECKING:
    from sightline.case.acquire.robot import PoseNow


@dataclass(frozen=True)
class Taken:
    """An image's entry; `new` is False if the case had the image already."""

    entry: Entry
    new: bool


@dataclass(frozen=True)
class News:
    """A report of a source: an image was `kept` or was there `already` (with its entry), or was `refused`; or a `note`.

    `text` names no file, peer or person.
    """

    kind: Literal["kept", "already", "refused", "note"]
    text: str
    entry: Entry | None = None


Tell = Callable[[News], None]


class Acquirer:
    """Records images in a case. Threads of several sources take turns, so that one image is in memory at a time."""

    def __init__(
        self, case: Case, arrival_pose: "Callable[[], PoseNow] | None" = None, *, invert: bool = False
    ) -> None:
        """`arrival_pose` returns the robot's current pose, for images whose source states none. `invert`: the files
        show the balls bright; their entries say so, and readers of the entries invert the images."""
        self._case, self._lock, self._arrival_pose, self._invert = case, Lock(), arrival_pose, invert
        self._by_original: dict[str, Entry] = {}
        self._by_pixels: dict[str, int] = {}  # number of the first entry with these pixels
        self._last_seen = 0

    def take(self, data: bytes, suffix: str, *, how: Mapping[str, Any] | None = None) -> Taken:
        """Keep and record an image; its entry is on the disk when this returns.

        The same bytes twice make one entry. Other bytes with the same pixels, as an archive makes by changing a header,
        are kept too, and their entry names the earlier entry. A multi-frame run is kept whole; its entry is of the last
        frame, which a C-arm goes on showing. `how`: what is known of the acquisition, for the entry's settings.

        Raises ImageError if it is not an image (then nothing is kept), and CaseError on a disk error.
        """
        stamped = dict(how or {})
        if self._arrival_pose is not None and "robot" not in stamped:  # now, not after the wait for the lock
            stamped["robot"] = {**self._arrival_pose().document(), "moment": "arrival"}
        name = originals.name_of(data, suffix)
        with self._lock:
            if (held := self._find_entry(name)) is not None:
                return Taken(held, new=False)
            content, index, frames = _read_content(data, name, suffix, invert=self._invert)
            self._case.keep(data, suffix)
            while True:
                acquisition = {**stamped, **({"frames": frames} if frames > 1 else {})}
                if (before := self._by_pixels.get(content["pixels_sha256"])) is not None:
                    acquisition["same_pixels_as"] = before
                settings = {"frame_index": index, "acquisition": acquisition}
                if self._invert:
                    settings["inverted"] = True
                try:
                    entry = self._case.record(
                        Kind.ACQUIRED, content, by=Actor.RECEIVER, settings=settings, expect=self._last_seen
                    )
                except OvertakenError:  # another program's entry, perhaps of this image
                    if (held := self._find_entry(name)) is not None:
                        return Taken(held, new=False)
                else:
                    self._note(entry)
                    return Taken(entry, new=True)

    def _find_entry(self, name: str) -> Entry | None:
        """Read entries that other programs made; return the entry of this original, None if there is none."""
        for entry in self._case.entries(after=self._last_seen):
            self._note(entry)
        return self._by_original.get(name)

    def _note(self, entry: Entry) -> None:
        self._last_seen = entry.number
        if entry.kind is not Kind.ACQUIRED:
            return
        self._by_original.setdefault(entry.content["original"], entry)
        self._by_pixels.setdefault(entry.content.get("pixels_sha256", ""), entry.number)  # a table of beads has none


def news_of(taken: Taken) -> News:
    """Return the report of an acquired image."""
    entry, number = taken.entry, taken.entry.number
    short = entry.content["original"][:12]
    if not taken.new:
        return News("already", f"entry {number}: came again, {short}", entry)
    acquisition = entry.settings["acquisition"]
    frames, before = acquisition.get("frames"), acquisition.get("same_pixels_as")
    run = f", a run of {frames} frames of which the entry is frame {entry.settings['frame_index']}" if frames else ""
    same = f"; its pixels are those of entry {before}, so it is not a new exposure" if before is not None else ""
    return News("kept", f"entry {number}: kept, {short}{run}{same}", entry)


def _read_content(data: bytes, name: str, suffix: str, *, invert: bool) -> tuple[dict[str, Any], int | None, int]:
    """Return the entry's content, the index of its frame and the number of frames.

    Raises ImageError, whose message calls the file "the image".
    """
    try:
        with scratch_folder() as folder:
            file = folder / f"image{suffix}"
            file.write_bytes(data)
            frames = frames_in(file)
            index = frames - 1 if frames > 1 else None
            return contents.acquired(name, read_image(file, index, invert=invert)), index, frames
    except ImageError as error:
        raise ImageError(str(error).replace(f"image{suffix}", "the image")) from None
    except OSError as error:
        raise CaseError(
            f"the image cannot be written to a temporary file ({error.strerror}); free some space for temporary files"
        ) from error


FIELDS = ("first", "second")


def take_frames(
    acquirer: Acquirer,
    frames: Sequence[SourceFrame],
    *,
    field: str | None = None,
    interlaced: bool = False,
    pose: "PoseNow | None" = None,
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
