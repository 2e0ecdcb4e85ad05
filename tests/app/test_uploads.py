"""Images sent to the app: what is taken, what is refused with which words, and what a hostile name can do."""

import asyncio
import json
import zlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import httpx
import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.small_app import image_of

from sightline.app.drawing.pictures import as_u16
from sightline.app.web.transfers import Images, Upload, receive
from sightline.errors import ImageError
from sightline.imaging import Radiograph, write_dicom, write_png

PIXELS = (np.arange(40 * 30, dtype=np.uint16) * 37).reshape(30, 40)
HOSTILE = "<img src=x onerror='window.hacked=1'>.png"


@pytest.fixture(scope="module")
def png(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_png(Radiograph(PIXELS, 65535.0), tmp_path_factory.mktemp("images") / "pa.png")


@pytest.fixture(scope="module")
def app(serve: Callable[..., Server]) -> Server:
    return serve("tests.app.small_app", "{port}")


def post(app: Server, body: bytes) -> httpx.Response:
    address = json.loads(app.log.read_text().partition("\n")[0])["upload"]
    return httpx.post(app.url.rstrip("/") + address, content=body, headers={"origin": app.url.rstrip("/")})


def take(*chunks: bytes) -> Upload:
    async def stream() -> AsyncIterator[bytes]:
        for chunk in chunks:
            yield chunk

    return asyncio.run(receive(stream()))


def test_an_image_arrives_byte_by_byte(png: Path) -> None:
    upload = take(*(bytes([b]) for b in png.read_bytes()))
    assert upload.suffix == ".png" and upload.data == png.read_bytes()
    assert np.array_equal(image_of(upload).pixels, PIXELS)


def test_the_content_tells_the_kind(tmp_path: Path, png: Path) -> None:
    dicom = write_dicom(Radiograph(PIXELS, 65535.0), tmp_path / "misnamed.png").read_bytes()
    np.save(tmp_path / "pixels.npy", PIXELS)
    kinds = {".dcm": dicom, ".png": png.read_bytes(), ".npy": (tmp_path / "pixels.npy").read_bytes()}
    for suffix, data in kinds.items():
        upload = take(data[:100], data[100:])
        assert upload.suffix == suffix
        assert np.array_equal(image_of(upload).pixels, PIXELS)
    for data in (b"GIF89a", b"<html>", b"PK\x03\x04", bytes(200), b"MZ" + bytes(200), b"DICM"):
        with pytest.raises(ImageError, match="give DICOM"):
            take(data)


def test_what_is_no_image_is_refused_and_not_kept() -> None:
    with pytest.raises(ImageError, match="give DICOM, PNG"):
        take(b"<svg onload=alert(1)>" * 100, b"\x89PNG\r\n\x1a\n")
    with pytest.raises(ImageError, match="empty"):
        take(b"", b"")


def test_a_picture_far_larger_than_its_file_is_refused() -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4) + kind + data + zlib.crc32(kind + data).to_bytes(4)

    size = 60000
    header = size.to_bytes(4) * 2 + bytes([16, 0, 0, 0, 0])
    start = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header)
    bomb = start + chunk(b"IDAT", zlib.compress(bytes(10000))) + chunk(b"IEND", b"")
    with pytest.raises(ImageError, match="the limit is"):
        image_of(take(bomb))


def test_refusals_come_back_as_sentences(app: Server, png: Path) -> None:
    assert post(app, png.read_bytes()).json() == {}
    refused = post(app, b"no image at all")
    assert refused.status_code == 422
    assert "give DICOM" in refused.json()["error"]


def test_floating_point_pixels_are_scaled_for_the_eye() -> None:
    eight = Radiograph(np.arange(256, dtype=np.uint8).reshape(16, 16), 255.0)
    pixels = as_u16(eight)
    assert pixels.dtype == np.uint16 and pixels.max() == 255
    pixels = as_u16(Radiograph(np.linspace(-3.0, 5.0, 256, dtype=np.float32).reshape(16, 16), 5.1))
    assert (pixels.min(), pixels.max()) == (0, 65535)
    assert (as_u16(Radiograph(np.ones((16, 16), np.float32), 2.0)) == 0).all()


def test_only_grey_pixels_are_published_and_only_once_each() -> None:
    images = Images()
    assert images.publish(PIXELS) != images.publish(PIXELS)
    for wrong in (PIXELS.astype(np.uint8), PIXELS[0], PIXELS.astype(float)):
        with pytest.raises(ImageError, match="uint16"):
            images.publish(wrong)


def test_a_chosen_file_reaches_its_target(
    app: Server, open_page: Callable[..., Page], png: Path, tmp_path: Path
) -> None:
    page = open_page(app.url, allow=("422",))
    page.get_by_test_id("drop-PA image").set_input_files(png)
    expect(page.get_by_test_id("said")).to_have_text(".png|(30, 40)")
    expect(page.get_by_test_id("drop-message")).to_have_text("")  # the view shows that it came
    page.get_by_test_id("drop-Lateral image").set_input_files({"name": HOSTILE, "mimeType": "", "buffer": b"nothing"})
    expect(page.get_by_test_id("drop-message")).to_contain_text(f"{HOSTILE}: give DICOM, PNG")
    expect(page.get_by_test_id("hostile")).to_contain_text("<img")
    assert page.evaluate("window.hacked") is None


def test_the_whole_page_takes_a_drop(app: Server, open_page: Callable[..., Page], png: Path) -> None:
    page = open_page(app.url)
    data = page.evaluate_handle(
        """bytes => { const data = new DataTransfer();
                      data.items.add(new File([new Uint8Array(bytes)], "dropped.png")); return data; }""",
        list(png.read_bytes()),
    )
    page.dispatch_event("body", "dragenter", {"dataTransfer": data})
    expect(page.get_by_test_id("drop-page")).to_be_visible()
    page.dispatch_event("[data-testid='drop-panel-Lateral image']", "drop", {"dataTransfer": data})
    expect(page.get_by_test_id("said")).to_have_text(".png|(30, 40)")
    expect(page.get_by_test_id("drop-page")).to_have_count(0)
