"""Pixels and maps for the browser: raw 16-bit grey values, and JSON, at addresses that cannot be guessed."""

import json
import secrets
from typing import Any

import numpy as np
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from sightline.errors import ImageError

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
