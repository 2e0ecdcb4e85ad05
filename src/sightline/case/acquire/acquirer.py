"""Images into a case: each is looked at, kept and entered, once, and on the disk before anybody is told of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal

from sightline.atomic import scratch_folder
from sightline.case import contents
from sightline.case.journal import Actor, Case, Entry, Kind, originals
from sightline.errors import CaseError, ImageError, OvertakenError
from sightline.imaging import frames_in, read_image

if TYPE_CHECKING:
    from sightline.case.acquire.robot import PoseNow


@dataclass(frozen=True)
class Taken:
    """An image's entry; `new` is False where the case held it already."""

    entry: Entry
    new: bool


@dataclass(frozen=True)
class News:
    """What a source tells of: an image `kept` or held `already` (with its entry), something `refused`, a `note`.

    `text` names no file, peer or person.
    """

    kind: Literal["kept", "already", "refused", "note"]
    text: str
    entry: Entry | None = None


Tell = Callable[[News], None]


class Acquirer:
    """The one way of images into a case; sources of several threads take turns, so one image is in memory at a time."""

    def __init__(
        self, case: Case, arrival_pose: "Callable[[], PoseNow] | None" = None, *, invert: bool = False
    ) -> None:
        """`arrival_pose` tells the robot's pose of now, for images whose source says none of its own. `invert`: the
        files show the balls bright; their entries say so, and whoever reads them inverts them."""
        self._case, self._lock, self._arrival_pose, self._invert = case, Lock(), arrival_pose, invert
        self._held: dict[str, Entry] = {}  # by the original's name
        self._shown: dict[str, int] = {}  # by the pixels, the number of the first entry
        self._seen = 0

    def take(self, data: bytes, suffix: str, *, how: Mapping[str, Any] | None = None) -> Taken:
        """An image as it came; its entry is on the disk when this returns. The same bytes twice make one entry. Other
        bytes with the same pixels, which an archive makes by changing a header, are kept too, and their entry says
        whose pixels these are.

        A run of several frames is kept whole; its entry is of the last frame, the one that a C-arm goes on showing.
        `how` is what is known of the acquisition, for the entry's settings. Raises ImageError if it is not an image:
        nothing of it is kept; CaseError on a disk write error.
        """
        stamped = dict(how or {})
        if self._arrival_pose is not None and "robot" not in stamped:  # before it waits for others
            stamped["robot"] = {**self._arrival_pose().document(), "moment": "arrival"}
        name = originals.name_of(data, suffix)
        with self._lock:
            if (held := self._look_back(name)) is not None:
                return Taken(held, new=False)
            content, index, frames = _looked_at(data, name, suffix, invert=self._invert)
            self._case.keep(data, suffix)
            while True:
                acquisition = {**stamped, **({"frames": frames} if frames > 1 else {})}
                if (before := self._shown.get(content["pixels_sha256"])) is not None:
                    acquisition["same_pixels_as"] = before
                settings = {"frame_index": index, "acquisition": acquisition}
                if self._invert:
                    settings["inverted"] = True
                try:
                    entry = self._case.record(
                        Kind.ACQUIRED, content, by=Actor.RECEIVER, settings=settings, expect=self._seen
                    )
                except OvertakenError:  # another program's entry, perhaps of this very image
                    if (held := self._look_back(name)) is not None:
                        return Taken(held, new=False)
                else:
                    self._note(entry)
                    return Taken(entry, new=True)

    def _look_back(self, name: str) -> Entry | None:
        """Read the entries that others made; return that of this original, if there is one."""
        for entry in self._case.entries(after=self._seen):
            self._note(entry)
        return self._held.get(name)

    def _note(self, entry: Entry) -> None:
        self._seen = entry.number
        if entry.kind is not Kind.ACQUIRED:
            return
        self._held.setdefault(entry.content["original"], entry)
        self._shown.setdefault(entry.content.get("pixels_sha256", ""), entry.number)  # a table of beads has none


def news_of(taken: Taken) -> News:
    """What to tell of it."""
    entry, number = taken.entry, taken.entry.number
    short = entry.content["original"][:12]
    if not taken.new:
        return News("already", f"entry {number}: came again, {short}", entry)
    acquisition = entry.settings["acquisition"]
    frames, before = acquisition.get("frames"), acquisition.get("same_pixels_as")
    run = f", a run of {frames} frames of which the entry is frame {entry.settings['frame_index']}" if frames else ""
    same = f"; its pixels are those of entry {before}, so it is no new exposure" if before is not None else ""
    return News("kept", f"entry {number}: kept, {short}{run}{same}", entry)


def _looked_at(data: bytes, name: str, suffix: str, *, invert: bool) -> tuple[dict[str, Any], int | None, int]:
    """The entry's content, its frame, and how many there are. Raises ImageError, which calls it "the image"."""
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
            f"there is no room to look at an image ({error.strerror}); free some space for temporary files"
        ) from error
