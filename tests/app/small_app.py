"""A small page behind the real guard and server, for tests: prints what it is as a line of JSON, then serves.

python -m tests.app.small_app PORT [TOKEN]
"""

import asyncio
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from nicegui import core, ui
from starlette.routing import BaseRoute, Mount

from sightline.app.web.serve import ServedApp, serve
from sightline.app.web.transfers import DropZone, Upload
from sightline.imaging import Radiograph, read_image

PIXELS = np.arange(32 * 16, dtype=np.uint16).reshape(16, 32) * 100


def page(site: ServedApp) -> None:
    async def on_upload(upload: Upload) -> None:
        radiograph = await asyncio.to_thread(image_of, upload)
        said.set_text(f"{upload.suffix}|{radiograph.shape}")

    DropZone(site.uploads, {"PA image": on_upload, "Lateral image": on_upload})
    said = ui.label("nothing yet").props("data-testid=said")
    ui.label("<img src=x onerror='window.hacked=1'>").props("data-testid=hostile")
    ui.button("again", on_click=lambda: said.set_text("clicked"))


def image_of(upload: Upload) -> Radiograph:
    with TemporaryDirectory() as folder:
        file = Path(folder) / f"image{upload.suffix}"
        file.write_bytes(upload.data)
        return read_image(file)


def echo(upload: Upload) -> None:
    last.append(upload)


def paths(routes: list[BaseRoute], before: str = "") -> list[str]:
    found = []
    for route in routes:
        path = before + str(getattr(route, "path", "")).rstrip("/")
        found += paths(route.routes or [], path) or [path] if isinstance(route, Mount) else [path]
    return found


def ready(site: ServedApp) -> None:
    told = {
        "url": site.url,
        "port": site.port,
        "image": site.images.publish(PIXELS),
        "upload": site.uploads.open(echo),
        "routes": sorted({*paths(core.app.routes), site.images.route.path, site.uploads.route.path}),
    }
    print(json.dumps(told), flush=True)


last: list[Upload] = []
if __name__ == "__main__":
    port, *token = sys.argv[1:]
    serve(page, port=int(port), token=token[0] if token else None, on_ready=ready)
    print("ended in order")
