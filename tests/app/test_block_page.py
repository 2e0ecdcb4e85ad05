"""The page with a block: a third image is dropped, its landmarks are clicked, and the verdict says what they show."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect
from tests.app.block import LANDMARKS, clicks, drawn, in_plane, load
from tests.app.browser import Server
from tests.app.hands import PATIENCE_MS, Hands

from sightline.app.session.worker import WorkerProcess


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case planned on two images, between which the bone moved."""
    three, folder, worker = drawn(), tmp_path_factory.mktemp("block"), WorkerProcess()
    with ThreadPoolExecutor(1) as pool:  # Playwright holds an event loop in this thread
        pool.submit(load, three, folder, worker, clicks(three, in_plane(three))).result()
    worker.close()
    return folder


@pytest.mark.slow  # a server and a browser
def test_a_person_is_led_through_a_third_image(
    serve: Callable[..., Server], open_page: Callable[..., Page], prepared: Path
) -> None:
    server = serve("sightline", "app", "--port", "{port}", "--no-browser", "--case", str(prepared / "case"), "--quiet")
    hands = Hands(open_page(server.url))
    hands.wait_for_step("Calibrate", "done")
    hands.step("Images")
    expect(hands.see("no-oblique")).to_contain_text("shows movements of the patient that two images do not show")
    for name in ("PA image", "Lateral image", "Oblique image (optional)"):
        box = hands.page.get_by_role("button", name=name, exact=True).first.bounding_box()
        assert box is not None and box["height"] < 45.0  # two lines; fails where a word is broken
    hands.see("drop-Oblique image (optional)").set_input_files(prepared / "oblique.dcm")
    hands.details()
    expect(hands.see("show-oblique")).to_be_visible(timeout=PATIENCE_MS)
    hands.wait_for_step("Calibrate", "done")
    hands.step("Calibrate")
    expect(hands.see("checks-oblique")).to_be_visible()
    hands.step("Plan")
    expect(hands.see("instruction")).to_contain_text("OBLIQUE")
    hands.details()
    three = drawn()
    uv = clicks(three, in_plane(three))["oblique"]
    for name in LANDMARKS:
        hands.place(name, "lateral", uv[name])  # the view that shows the oblique image
    expect(hands.see("row-greater-trochanter")).to_contain_text("● obl")
    expect(hands.see("verdict")).to_contain_text("NO-GO")
    hands.details()
    failed = hands.see("verdict-checks").locator("li.failed")
    expect(failed.filter(has_text="The bone seems to have moved between the 3 images")).to_have_count(1)
