"""Pixels and maps for the browser at addresses that cannot be guessed, and files uploaded by it, limited in size;
images are recognised by their content, others by their names.
The drop zone: buttons in place, and the whole page while a file is dragged over it.
"""

import json
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from nicegui import ui
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from sightline.common.bounded import MAX_PIXELS
from sightline.errors import ImageError, SightlineError
from sightline.imaging.formats import FORMAT_NAMES, HEADER_BYTES, SUFFIXES, format_of

IMAGES_PATH = "/image/"
_TYPES = {".u16": "application/octet-stream", ".json": "application/json"}


class Images:
    """What the browser may fetch: `publish` and `publish_json` return an address, `forget` removes it."""

    def __init__(self) -> None:
        self._served: dict[str, bytes] = {}  # by address
        self.route = Route(IMAGES_PATH + "{name}", self._answer, methods=["GET"])

    def publish(self, pixels: np.ndarray) -> str:
        """Publish `pixels` (H, W) uint16, served little-endian by rows, and return their address. Raises ImageError for
        another type or shape."""
        if pixels.ndim != 2 or pixels.dtype != np.uint16:
            raise ImageError(f"the browser shows (H, W) uint16, not {pixels.dtype} of shape {pixels.shape}")
        return self._publish(pixels.astype("<u2", copy=False).tobytes(), ".u16")

    def publish_json(self, document: dict[str, Any]) -> str:
        """Publish a document of JSON types and return its address."""
        return self._publish(json.dumps(document).encode(), ".json")

    def forget(self, address: str) -> None:
        """Stop serving `address`; an unknown address is not an error."""
        self._served.pop(address, None)

    def _publish(self, content: bytes, ending: str) -> str:
        address = f"{IMAGES_PATH}{secrets.token_urlsafe(18)}{ending}"
        self._served[address] = content
        return address

    async def _answer(self, request: Request) -> Response:
        name = request.path_params["name"]
        content = self._served.get(IMAGES_PATH + name)
        if content is None:
            return PlainTextResponse("no such image", 404)
        # Not compressed: 2 MiB over the loopback take 17 ms raw and 118 ms compressed.
        headers = {"Content-Encoding": "identity", "Cache-Control": "private, max-age=31536000, immutable"}
        return Response(content, media_type=_TYPES[name[name.rindex(".") :]], headers=headers)


MAX_UPLOAD_BYTES = 4 * MAX_PIXELS + 2**20  # [calc] the largest image as float32, with a header
MAX_AT_ONCE = 2  # [calc] as many as a plan has views; limits the memory that uploads use
UPLOADS_PATH = "/upload/"


@dataclass(frozen=True)
class Upload:
    """An uploaded file. `suffix`: the file type by its content, for example ".dcm"; of another file than an image that
    of its name."""

    suffix: str
    data: bytes = field(repr=False)


OnUpload = Callable[[Upload], Awaitable[None] | None]
NAME_HEADER = "x-file-name-end"


@dataclass(frozen=True)
class FileTypes:
    """Files that are recognised by their names. `suffixes`: the longest first; `most`: at a time; `smaller`: what to do
    with one that is too large."""

    suffixes: tuple[str, ...]
    most: int
    smaller: str

    def suffix_of(self, name: str) -> str:
        """Return the suffix of a name; empty for another one."""
        return next((suffix for suffix in self.suffixes if name.lower().endswith(suffix)), "")


class Uploads:
    """Upload addresses: `open` returns an address for one purpose, `close` removes it."""

    def __init__(self) -> None:
        self._receivers: dict[str, tuple[OnUpload, FileTypes | None]] = {}
        self._at_once = 0
        self.route = Route(UPLOADS_PATH + "{key}", self._answer, methods=["POST"])

    def open(self, on_upload: OnUpload, types: FileTypes | None = None) -> str:
        """Return a new address whose images, or files of these `types`, go to `on_upload`; a SightlineError raised
        there is shown in the browser."""
        address = UPLOADS_PATH + secrets.token_urlsafe(18)
        self._receivers[address] = on_upload, types
        return address

    def close(self, address: str) -> None:
        """Stop accepting files at `address`."""
        self._receivers.pop(address, None)

    async def _answer(self, request: Request) -> Response:
        if request.url.path not in self._receivers:
            return _refuse(404, "reload the page: it is no longer open")
        if self._at_once >= MAX_AT_ONCE:
            return _refuse(503, "try again later: other files are still being received")
        on_upload, types = self._receivers[request.url.path]
        self._at_once += 1
        try:
            named = request.headers.get(NAME_HEADER, "")
            pending = on_upload(await receive(request.stream(), types, named))
            if pending is not None:
                await pending
        except SightlineError as error:
            return _refuse(422, str(error))
        except ClientDisconnect:
            return _refuse(400, "send the file again: it did not arrive completely")
        finally:
            self._at_once -= 1
        return JSONResponse({})


async def receive(chunks: AsyncIterator[bytes], types: FileTypes | None = None, named: str = "") -> Upload:
    """Return the upload in `chunks`, whose size the guard limits. `types`: of the files that are taken, by the end of
    its name, `named`; None: images. Raises ImageError if it is empty or of another type.

    A file of another type is still read to its end, because a browser shows no response before it has sent all.
    """
    data, known = bytearray(), "" if types is None else types.suffix_of(named)
    async for chunk in chunks:
        if known or len(data) < HEADER_BYTES:  # of a file of another type keep only the first bytes
            data += chunk
            if not known and types is None and (found := format_of(bytes(data[:HEADER_BYTES]))) is not None:
                known = found.suffixes[0]
    if not data:
        raise ImageError("export it again: the file is empty")
    if not known and types is not None:
        raise ImageError(f"give a file whose name ends with {', '.join(types.suffixes)}")
    if not known:
        raise ImageError(f"give {FORMAT_NAMES}: the file is not an image that can be read")
    return Upload(known, bytes(data))


def _refuse(status: int, sentence: str) -> Response:
    return JSONResponse({"error": sentence}, status)


class DropZone(ui.element, component=Path(__file__).parent / "drop.js"):
    """Accepts files for named targets; each goes to its target's `on_upload`, run in this element's slot."""

    def __init__(
        self,
        uploads: Uploads,
        targets: dict[str, OnUpload],
        boxes: Mapping[str, ui.element] = MappingProxyType({}),
        types: FileTypes | None = None,
    ) -> None:
        """`boxes`: by target the part of the page that takes its files; while nothing is in it, it says so. `types`:
        of the files; None: images."""
        self._uploads = uploads
        self._addresses = {label: uploads.open(self._here(on_upload), types) for label, on_upload in targets.items()}
        super().__init__()
        self._props["targets"] = [{"label": label, "address": where} for label, where in self._addresses.items()]
        for target in self._props["targets"]:
            box = boxes.get(target["label"])
            target["box"] = None if box is None else f"c{box.id}"
        self._props["maxBytes"] = MAX_UPLOAD_BYTES
        self._props["most"] = len(targets) if types is None else types.most
        self._props["smaller"] = "export a single image" if types is None else types.smaller
        self._props["accept"] = ",".join((*SUFFIXES, "application/dicom") if types is None else types.suffixes)

    def tell(self, states: Mapping[str, str], names: Mapping[str, str], labels: Mapping[str, str]) -> None:
        """Say what each target shows: "empty", "here", or "failed"; targets that are not named take nothing now.
        `names`: of their images, as in a sentence; `labels`: of their buttons, where not the target's own."""
        self.run_method("tell", dict(states), dict(names), dict(labels))

    def _here(self, on_upload: OnUpload) -> OnUpload:
        async def run(upload: Upload) -> None:
            with self:  # so that elements it adds, such as a notification, go to this page
                pending = on_upload(upload)
                if pending is not None:
                    await pending

        return run

    def _handle_delete(self) -> None:
        for address in self._addresses.values():
            self._uploads.close(address)
        super()._handle_delete()
