"""Images that the browser sends: bounded on the way in, known by their content, read by the one image reader."""

import secrets
import unicodedata
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from urllib.parse import unquote

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sightline.atomic import scratch_folder
from sightline.errors import ImageError, SightlineError
from sightline.imaging import Radiograph, read_image, suffix_of
from sightline.imaging.limits import MAX_PIXELS

MAX_UPLOAD_BYTES = 4 * MAX_PIXELS + 2**20  # [calc] the largest image as float32, and a header
MAX_AT_ONCE = 2  # [ours] two views; bounds what uploads hold in memory
MAX_NAME_CHARACTERS = 80  # [ours] what a line of the page shows
UPLOADS_PATH = "/upload/"

_KINDS = {".dcm": "DICOM", ".png": "PNG", ".tif": "TIFF", ".bmp": "BMP", ".npy": "NumPy"}  # for people, by suffix
_MARKED_BYTES = 132  # that tell what a file is


@dataclass(frozen=True)
class Upload:
    """An image file as it arrived: `name` is text to show and never a path, `kind` was read from the content."""

    name: str
    kind: str
    data: bytes = field(repr=False)

    @property
    def suffix(self) -> str:
        """How a file of its kind ends, ".dcm" say."""
        return next(suffix for suffix, kind in _KINDS.items() if kind == self.kind)

    def read(self, frame_index: int | None = None) -> Radiograph:
        """The image; takes a while, so not on the event loop. Raises ImageError, as `read_image`."""
        with scratch_folder() as folder:
            file = folder / "the image"  # what a refusal calls it
            file.write_bytes(self.data)
            return read_image(file, frame_index)


OnUpload = Callable[[Upload], Awaitable[None] | None]


class Uploads:
    """Where the browser may send an image: `open` gives an address for one purpose, `close` ends it."""

    def __init__(self) -> None:
        self._receivers: dict[str, OnUpload] = {}
        self._at_once = 0
        self.route = Route(UPLOADS_PATH + "{key}", self._answer, methods=["POST"])

    def open(self, on_upload: OnUpload) -> str:
        """The address whose images go to `on_upload`; a SightlineError raised there is shown as its sentence."""
        address = UPLOADS_PATH + secrets.token_urlsafe(18)
        self._receivers[address] = on_upload
        return address

    def close(self, address: str) -> None:
        """Nothing is taken at `address` any more."""
        self._receivers.pop(address, None)

    async def _answer(self, request: Request) -> Response:
        on_upload = self._receivers.get(request.url.path)
        if on_upload is None:
            return _refuse(404, "the page is no longer open; reload it")
        if self._at_once >= MAX_AT_ONCE:
            return _refuse(503, "other images are still being received; try again when they are done")
        self._at_once += 1
        try:
            name = shown_name(request.headers.get("x-file-name", ""))
            upload = await receive(request.stream(), name)
            pending = on_upload(upload)
            if pending is not None:
                await pending
        except SightlineError as error:
            return _refuse(422, str(error))
        except ClientDisconnect:
            return _refuse(400, "the image did not arrive whole; send it again")
        finally:
            self._at_once -= 1
        return JSONResponse({})


async def receive(chunks: AsyncIterator[bytes], name: str) -> Upload:
    """The upload that `chunks` make up; the guard bounds their size. Raises ImageError on what is empty or no image.

    A file that is no image is still read to its end, because a browser shows no answer before it has sent all.
    """
    data, kind = bytearray(), None
    async for chunk in chunks:
        if kind is not None or len(data) < _MARKED_BYTES:  # of what is no image, nothing more is kept
            data += chunk
            kind = kind or kind_of(data)
    if not data:
        raise ImageError("the file is empty; export the image again")
    if kind is None:
        raise ImageError("the file is not an image that can be read; give DICOM, PNG, TIFF, BMP or NumPy (.npy)")
    return Upload(name, kind, bytes(data))


def kind_of(data: bytes | bytearray) -> str | None:
    """What the first bytes of a file say it is; None for what is no image we read."""
    suffix = suffix_of(bytes(data[:_MARKED_BYTES]))
    return None if suffix is None else _KINDS[suffix]


def shown_name(given: str) -> str:
    """A percent-encoded file name as harmless text: without folders, control or direction characters, and short."""
    last = unquote(given, errors="replace").replace("\\", "/").rsplit("/", 1)[-1]
    text = "".join(c for c in last if not unicodedata.category(c).startswith("C")).strip()
    return text if len(text) <= MAX_NAME_CHARACTERS else text[: MAX_NAME_CHARACTERS - 1] + "…"


def _refuse(status: int, sentence: str) -> Response:
    return JSONResponse({"error": sentence}, status)
