"""The app's server, tried from outside over real connections: what the guard keeps out, and images sent to it: what is
taken, what is refused with which words, and what a hostile name can do."""

import asyncio
import json
import re
import socket
import zlib
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from tests.app.browser import Server
from tests.app.small_app import image_of
from tests.systems import needs_posix
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from sightline.app.drawing.pictures import as_u16
from sightline.app.panels import section
from sightline.app.web.guard import MAX_BODY_BYTES, MAX_SOCKETS, Guard, is_loopback
from sightline.app.web.serve import MAX_PAGES, MAX_WAITING, Pages
from sightline.app.web.serve import serve as start
from sightline.app.web.transfers import MAX_UPLOAD_BYTES, FileTypes, Images, Upload, receive
from sightline.errors import ImageError, UnusableInputError
from sightline.imaging import Radiograph, write_dicom, write_png

TOKEN = "correct-horse-battery"  # noqa: S105
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
POLLING = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"


@dataclass
class App:
    """The address that the small app reported."""

    url: str
    port: int
    image: str
    upload: str
    routes: list[str]

    @property
    def base(self) -> str:
        return f"http://127.0.0.1:{self.port}"


def told(server: Server) -> App:
    return App(**json.loads(server.log.read_text().partition("\n")[0]))


@pytest.fixture(scope="module")
def open_app(serve: Callable[..., Server]) -> App:
    return told(serve("tests.app.small_app", "{port}"))


@pytest.fixture(scope="module")
def locked(serve: Callable[..., Server], tmp_path_factory: pytest.TempPathFactory) -> Server:
    return serve("tests.app.small_app", "{port}", TOKEN, cwd=tmp_path_factory.mktemp("locked"))


@pytest.fixture(scope="module")
def locked_app(locked: Server) -> App:
    return told(locked)


def ask(app: App, path: str, **headers: str) -> httpx.Response:
    return httpx.get(app.base + path, headers=headers)


def post(app: App, content: bytes | Iterator[bytes], path: str = "", **headers: str) -> httpx.Response:
    """The answer to an upload, or to what is sent to a path."""
    return httpx.post(app.base + (path or app.upload), content=content, headers=headers, timeout=60)


def socket_url(app: App) -> str:
    return f"ws://127.0.0.1:{app.port}{SOCKET}"


def raw(port: int, *lines: str, body: bytes = b"") -> bytes:
    """The first bytes answered to a request written by hand."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode() + body)
        return connection.recv(4096)


def test_the_page_is_served_with_headers_that_keep_it_to_itself(open_app: App) -> None:
    answer = ask(open_app, "/")
    assert answer.status_code == 200
    policy = answer.headers["content-security-policy"]
    assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
    assert "'unsafe-inline'" not in re.search(r"script-src [^;]*", policy)[0]  # type: ignore[index]
    nonce = re.search(r"'nonce-([^']+)'", policy)[1]  # type: ignore[index]
    scripts = re.findall(r"<script[^>]*>", answer.text)
    assert len(scripts) > 5 and all(f'nonce="{nonce}"' in script for script in scripts)
    assert "https://" not in policy and nonce not in ask(open_app, "/").text
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["cross-origin-opener-policy"] == "same-origin"
    assert "access-control-allow-origin" not in ask(open_app, POLLING).headers
    assert "server" not in answer.headers


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LocalHost"])
def test_it_answers_to_loopback_names(open_app: App, name: str) -> None:
    assert ask(open_app, "/", host=f"{name}:{open_app.port}").status_code == 200


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:{port}",
        "127.0.0.1.evil.example:{port}",
        "127.0.0.1:1",
        "127.0.0.1",
        "10.0.0.1:{port}",
        "",
        "a:b:{port}",
        "127.0.0.1:{port}:1",
        "127.0.0.1:{port}@evil.example",
    ],
)
def test_it_answers_to_no_other_name(open_app: App, host: str) -> None:
    host = host.format(port=open_app.port)
    assert ask(open_app, "/", host=host).status_code == 421
    assert raw(open_app.port, "GET / HTTP/1.0").startswith(b"HTTP/1.1 421")


def test_two_host_headers_are_refused(open_app: App) -> None:
    own = f"Host: 127.0.0.1:{open_app.port}"
    assert b" 200 " in raw(open_app.port, f"GET {open_app.image} HTTP/1.1", own)[:20]
    assert b" 200 " not in raw(open_app.port, f"GET {open_app.image} HTTP/1.1", own, "Host: evil.example")[:20]


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "http://127.0.0.1:{port}.evil.example",
        "null",
        "https://127.0.0.1:{port}",
        "http://127.0.0.1:1",
        "file://",
    ],
)
def test_a_foreign_origin_gets_nothing(open_app: App, origin: str) -> None:
    origin = origin.format(port=open_app.port)
    assert ask(open_app, open_app.image, origin=origin).status_code == 403
    assert ask(open_app, POLLING, origin=origin).status_code == 403
    assert post(open_app, b"x", origin=origin).status_code == 403
    with pytest.raises(InvalidStatus, match="403"), connect(socket_url(open_app), origin=origin):  # type: ignore[arg-type]
        pass


def test_what_changes_something_must_have_an_origin(open_app: App) -> None:
    assert post(open_app, b"x").status_code == 403
    with pytest.raises(InvalidStatus, match="403"), connect(socket_url(open_app)):
        pass


def test_a_picture_asked_for_by_a_foreign_page_is_refused(open_app: App) -> None:
    foreign = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}
    assert ask(open_app, open_app.image, **foreign).status_code == 403
    followed_link = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert ask(open_app, "/", **followed_link).status_code == 200


def test_only_the_methods_in_use(open_app: App) -> None:
    for method in ("PUT", "DELETE", "OPTIONS", "PATCH"):
        answer = httpx.request(method, open_app.base, headers={"origin": open_app.base})
        assert answer.status_code == 405


def test_a_forwarded_prefix_is_not_believed(open_app: App) -> None:
    assert "/elsewhere" not in ask(open_app, "/", **{"x-forwarded-prefix": "/elsewhere"}).text


def test_every_route_asks_for_the_token(locked_app: App) -> None:
    assert len(locked_app.routes) > 8
    for route in locked_app.routes:
        path = re.sub(r"\{[^}]*\}", "x", route)
        for method in ("GET", "POST", "HEAD"):
            answer = httpx.request(method, locked_app.base + path, headers={"origin": locked_app.base})
            assert answer.status_code == 401, (method, path)
    for path in ("/", locked_app.image, POLLING, "/no-such-page"):
        assert ask(locked_app, path).status_code == 401
    with pytest.raises(InvalidStatus, match="403"), connect(socket_url(locked_app), origin=locked_app.base):  # type: ignore[arg-type]
        pass


def test_the_token_becomes_a_cookie_and_leaves_the_address(locked_app: App) -> None:
    assert TOKEN in locked_app.url
    entered = httpx.get(locked_app.url)
    assert entered.status_code == 303 and entered.headers["location"] == "/"
    cookie = entered.headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and TOKEN not in cookie
    own = {"cookie": cookie.partition(";")[0]}
    assert ask(locked_app, "/", **own).status_code == 200
    assert ask(locked_app, locked_app.image, **own).status_code == 200
    with connect(socket_url(locked_app), origin=locked_app.base, additional_headers=own) as opened:  # type: ignore[arg-type]
        assert opened.recv(timeout=20)


@pytest.mark.parametrize("wrong", ["", "wrong", TOKEN[:-1], TOKEN + "x", "\u00fc"])
def test_a_wrong_token_opens_nothing(locked_app: App, wrong: str) -> None:
    answer = httpx.get(locked_app.base, params={"token": wrong})
    assert answer.status_code == 401 and "set-cookie" not in answer.headers
    assert ask(locked_app, "/", cookie=f"sightline-{locked_app.port}={wrong.encode().hex()}").status_code == 401


@pytest.mark.parametrize("kind", ["polling", "upload"])
def test_a_body_is_bounded_while_it_streams(open_app: App, kind: str) -> None:
    if kind == "polling":
        session = re.search(r'"sid":"([^"]+)"', ask(open_app, POLLING).text)[1]  # type: ignore[index]
        path, limit = f"{POLLING}&sid={session}", MAX_BODY_BYTES
    else:
        path, limit = open_app.upload, MAX_UPLOAD_BYTES

    def too_much() -> Iterator[bytes]:  # without a Content-Length
        yield from [b"\x93NUMPY" + bytes(2**20)] * (limit // 2**20 + 1)

    assert post(open_app, too_much(), path, origin=open_app.base).status_code == 413
    assert ask(open_app, "/").status_code == 200


def test_a_body_announced_too_large_is_not_read(open_app: App) -> None:
    own = [f"Host: 127.0.0.1:{open_app.port}", f"Origin: {open_app.base}", f"Content-Length: {MAX_BODY_BYTES + 1}"]
    assert raw(open_app.port, f"POST {POLLING} HTTP/1.1", *own).startswith(b"HTTP/1.1 413")


def test_a_message_on_a_socket_is_bounded(open_app: App) -> None:
    with connect(socket_url(open_app), origin=open_app.base) as opened:  # type: ignore[arg-type]
        opened.recv(timeout=20)
        with pytest.raises(ConnectionClosed):
            opened.send("4" + "x" * 2 * MAX_BODY_BYTES)
            opened.recv(timeout=20)
    assert ask(open_app, "/").status_code == 200


def test_sockets_are_counted(open_app: App) -> None:
    with ExitStack() as opened:
        for _ in range(MAX_SOCKETS):
            opened.enter_context(connect(socket_url(open_app), origin=open_app.base))  # type: ignore[arg-type]
        with pytest.raises(InvalidStatus, match="403"), connect(socket_url(open_app), origin=open_app.base):  # type: ignore[arg-type]
            pass


def test_pixels_arrive_as_they_are(open_app: App) -> None:
    answer = ask(open_app, open_app.image)
    assert np.array_equal(np.frombuffer(answer.content, "<u2"), np.arange(512) * 100)
    assert answer.headers["content-encoding"] == "identity"
    assert answer.headers["cache-control"].startswith("private")
    assert ask(open_app, "/image/guessed.u16").status_code == 404


def test_a_port_that_cannot_be_had_is_refused_with_advice(open_app: App) -> None:
    with pytest.raises(UnusableInputError, match="another --port"):
        start(lambda site: None, port=open_app.port)
    with pytest.raises(UnusableInputError, match="65535"):
        start(lambda site: None, port=open_app.port + 65536)


def test_others_are_let_in_by_token_alone() -> None:
    async def app(scope: object, receive: object, send: object) -> None: ...

    Guard(app, "127.0.0.1", 80)
    Guard(app, "0.0.0.0", 80, TOKEN)  # noqa: S104
    with pytest.raises(UnusableInputError, match="token"):
        Guard(app, "192.168.1.5", 80)
    with pytest.raises(UnusableInputError, match="longer"):
        Guard(app, "127.0.0.1", 80, "short")


ALONE = ["127.0.0.1", "127.9.9.9", "::1", "localhost"]
REACHABLE = ["0.0.0.0", "::", "10.0.0.1", "localhost.evil.example"]  # noqa: S104


@pytest.mark.parametrize("host", [*ALONE, *REACHABLE])
def test_which_addresses_are_this_machine_alone(host: str) -> None:
    assert is_loopback(host) == (host in ALONE)


# How many pages the program builds and keeps at once.

OTHERS = ("/image/", "/_nicegui")


class _App:
    """Builds pages that wait until they are let go; counts those that are built at the same time."""

    def __init__(self) -> None:
        self.go_on = asyncio.Event()
        self.built = self.at_once = self.most = 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http" and not scope["path"].startswith(OTHERS):
            self.at_once += 1
            self.most = max(self.most, self.at_once)
            await self.go_on.wait()
            self.at_once -= 1
            self.built += 1
        await send({"type": "http.response.start", "status": 200, "headers": []})


async def _status(pages: Pages, path: str = "/", kind: str = "http") -> int:
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": kind, "method": "GET", "path": path}
    await pages(scope, lambda: asyncio.sleep(0), send)  # pyright: ignore[reportArgumentType]
    return sent[0]["status"]


def test_two_hundred_page_loads_at_once_build_a_few_and_hold_nothing_else_up() -> None:
    async def flood() -> None:
        app = _App()
        pages = Pages(app, OTHERS, lambda: 0)
        loads = [asyncio.create_task(_status(pages, f"/{n}")) for n in range(200)]
        await asyncio.sleep(0)
        refused = [one for one in loads if one.done()]
        assert len(refused) == 200 - 1 - MAX_WAITING  # refused at once, without waiting
        assert {one.result() for one in refused} == {503}
        assert await _status(pages, "/image/a.u16") == 200
        assert await _status(pages, kind="websocket") == 200
        app.go_on.set()
        assert sorted(await asyncio.gather(*loads)) == [200] * (1 + MAX_WAITING) + [503] * len(refused)
        assert (app.built, app.most) == (1 + MAX_WAITING, 1)
        assert await _status(pages) == 200  # and then the next

    asyncio.run(flood())


def test_pages_that_are_open_are_counted() -> None:
    async def one_more(there: int) -> int:
        app = _App()
        app.go_on.set()
        return await _status(Pages(app, OTHERS, lambda: there))

    assert asyncio.run(one_more(MAX_PAGES - 1)) == 200
    assert asyncio.run(one_more(MAX_PAGES)) == 503


# Images.

PIXELS = (np.arange(40 * 30, dtype=np.uint16) * 37).reshape(30, 40)
HOSTILE = "<img src=x onerror='window.hacked=1'>.png"


@pytest.fixture(scope="module")
def png(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_png(Radiograph(PIXELS, 65535.0), tmp_path_factory.mktemp("images") / "pa.png")


def take(*chunks: bytes, types: FileTypes | None = None, named: str = "") -> Upload:
    async def stream() -> AsyncIterator[bytes]:
        for chunk in chunks:
            yield chunk

    return asyncio.run(receive(stream(), types, named))


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


def test_another_file_is_known_by_the_end_of_its_name() -> None:
    types = FileTypes((".nii.gz", ".nii", ".stl"), 2, "crop it")
    for named, suffix in {"hip.NII.gz": ".nii.gz", "a.stl.nii": ".nii", "evil/../x.stl": ".stl"}.items():
        assert take(b"abc", b"def", types=types, named=named) == Upload(suffix, b"abcdef")
    for named in ("", "x.stl.exe", "stl", "hip.nrrd"):
        with pytest.raises(ImageError, match=r"ends with \.nii\.gz, \.nii, \.stl"):
            take(b"\x89PNG\r\n\x1a\n" * 20, types=types, named=named)
    with pytest.raises(ImageError, match="empty"):
        take(types=types, named="a.stl")


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


def test_refusals_come_back_as_sentences(open_app: App, png: Path) -> None:
    assert post(open_app, png.read_bytes(), origin=open_app.base).json() == {}
    refused = post(open_app, b"no image at all", origin=open_app.base)
    assert refused.status_code == 422
    assert "give DICOM" in refused.json()["error"]


def test_floating_point_pixels_are_scaled_for_the_eye() -> None:
    eight = Radiograph(np.arange(256, dtype=np.uint8).reshape(16, 16), 255.0)
    pixels = as_u16(eight)
    assert pixels.dtype == np.uint16 and pixels.max() == 255
    pixels = as_u16(Radiograph(np.linspace(1.0, 9.0, 256, dtype=np.float32).reshape(16, 16), 9.1))
    assert (pixels.min(), pixels.max()) == (0, 65535)
    assert (as_u16(Radiograph(np.ones((16, 16), np.float32), 2.0)) == 0).all()


def test_only_grey_pixels_are_published_and_only_once_each() -> None:
    images = Images()
    assert images.publish(PIXELS) != images.publish(PIXELS)
    for wrong in (PIXELS.astype(np.uint8), PIXELS[0], PIXELS.astype(float)):
        with pytest.raises(ImageError, match="uint16"):
            images.publish(wrong)


def test_a_chosen_file_reaches_its_target(
    open_app: App, open_page: Callable[..., Page], png: Path, tmp_path: Path
) -> None:
    page = open_page(open_app.base, allow=("422",))
    page.get_by_test_id("drop-PA image").set_input_files(png)
    expect(page.get_by_test_id("said")).to_have_text(".png|(30, 40)")
    expect(page.get_by_test_id("drop-message")).to_have_text("")  # the view shows that it came
    page.get_by_test_id("drop-Lateral image").set_input_files({"name": HOSTILE, "mimeType": "", "buffer": b"nothing"})
    expect(page.get_by_test_id("drop-message")).to_contain_text(f"{HOSTILE}: give DICOM, PNG")
    expect(page.get_by_test_id("hostile")).to_contain_text("<img")
    assert page.evaluate("window.hacked") is None


def test_the_whole_page_takes_a_drop(open_app: App, open_page: Callable[..., Page], png: Path) -> None:
    page = open_page(open_app.base)
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


# HTML of a section in the browser: set anew, but for the elements that were there before.

SCRIPT = Path(section.__file__).with_name("html_section.js").read_text("utf-8")
# Sets the first HTML, then the second; returns what is shown, and whether the first element is the same one.
SHOW = """async ([source, first, second, anew = false]) => {
  const { default: { methods } } = await import("data:text/javascript," + encodeURIComponent(source));
  const section = { $el: document.createElement("section") };
  methods.show.call(section, first);
  const before = section.$el.firstElementChild;
  methods.show.call(section, second, anew);
  return [section.$el.innerHTML, before !== null && before === section.$el.firstElementChild];
}"""
FIGURE = '<div class="figure {}"><b>{}</b><i style="width: {}%;"></i></div>'
HTML = (
    "",
    FIGURE.format("passed", "0.41 mm", 40),
    FIGURE.format("failed", "1.20 mm", 95),
    '<div class="figure open" lang="de">–<!-- none --></div>',
    "<p>no wire: a &lt; b</p>",
    '<div><div lang="en">GO</div></div><p>two</p>',
)


@pytest.fixture(scope="module")
def page(browser: Browser) -> Iterator[Page]:
    """An empty page."""
    page = browser.new_page()
    yield page
    page.close()


def test_what_is_shown_is_the_newest_html(page: Page) -> None:
    """Catches a text, an attribute or an element of the HTML before that stays, or a new one that is left out."""
    for first, second in permutations(HTML, 2):
        assert page.evaluate(SHOW, [SCRIPT, first, second])[0] == second


def test_elements_stay_where_only_texts_and_attributes_differ(page: Page) -> None:
    """Catches elements built anew by each message of a drag, which the browser lays out anew."""
    assert page.evaluate(SHOW, [SCRIPT, HTML[1], HTML[2]])[1]
    assert not page.evaluate(SHOW, [SCRIPT, HTML[1], HTML[4]])[1]


def test_a_notice_that_is_repeated_is_built_anew(page: Page) -> None:
    """A screen reader announces what is put into a live region: fails where a second, identical notice changes
    nothing."""
    assert page.evaluate(SHOW, [SCRIPT, HTML[4], HTML[4], True]) == [HTML[4], False]


# Last, because it ends the server.


@needs_posix
def test_it_ends_in_order_and_leaves_nothing(locked: Server, locked_app: App) -> None:
    cookie = httpx.get(locked_app.url).headers["set-cookie"].partition(";")[0]
    with connect(socket_url(locked_app), origin=locked_app.base, additional_headers={"cookie": cookie}):  # type: ignore[arg-type]
        assert locked.terminate() == 0
    assert locked.log.read_text().splitlines()[1:] == ["ended in order"]
    assert list(locked.cwd.iterdir()) == []
