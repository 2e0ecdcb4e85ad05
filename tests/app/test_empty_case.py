"""The page of a case without images, and with images that cannot be used: what each step shows, and where it leads."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.hands import Hands
from tests.app.test_screen import wrong

from sightline.app.panels.steps import StepStatus, judged
from sightline.case.journal import Actor, Case
from sightline.case.stages import record_acquired
from sightline.checks import Check
from sightline.errors import ImageError
from sightline.imaging import Radiograph, write_dicom
from sightline.planning.points.results import Verdict

_JUNK = b"\0" * 128 + b"DICM" + b"junk"
_MARK = "document.querySelector('[data-testid=show-beads] .q-checkbox__indet').getBoundingClientRect().width"


@pytest.fixture(scope="module")
def server(serve: Callable[..., Server], tmp_path_factory: pytest.TempPathFactory) -> Server:
    """The app on a new case, without images."""
    folder = tmp_path_factory.mktemp("case")
    return serve("sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--case", str(folder))


def test_a_blocked_step_leads_to_what_it_waits_for(server: Server, open_page: Callable[..., Page]) -> None:
    """Fails where its one button is dead."""
    hands = Hands(open_page(server.url))
    for step in ("calibrate", "plan", "drill", "verify"):
        hands.step(step)
        expect(hands.see("back")).to_have_text("Back to Images")
    hands.press("back")
    expect(hands.see("step-images")).to_have_attribute("aria-current", "step")
    expect(hands.see("continue")).to_be_disabled()


def test_an_empty_view_asks_for_its_image_by_name(server: Server, open_page: Callable[..., Page]) -> None:
    """On each step by the name that it has there, without tools that have nothing to work on."""
    hands = Hands(open_page(server.url))
    for step, name in (("images", "image"), ("verify", "check image"), ("images", "image")):
        hands.step(step)
        expect(hands.see("drop-in-PA image")).to_contain_text(f"Drop the PA {name} here")
        expect(hands.see("drop-in-Lateral image")).to_contain_text(f"Drop the lateral {name} here")
        expect(hands.see("xray-pa").locator(".xray-name")).to_have_text(f"PA {name}")
        expect(hands.see("xray-pa").get_by_role("toolbar")).to_be_hidden()
    expect(hands.see("instruction")).to_have_text("Drop the PA image and the lateral image onto the page.")


def test_an_empty_check_box_looks_empty(server: Server, open_page: Callable[..., Page]) -> None:
    """Fails where the page has no direction of text, which the styles of its controls need."""
    hands = Hands(open_page(server.url))
    expect(hands.page.locator("html")).to_have_attribute("dir", "ltr")
    hands.step("plan")
    hands.details()
    expect(hands.see("show-beads")).to_have_attribute("aria-checked", "false")
    assert hands.page.evaluate(_MARK) == 0.0


@pytest.mark.slow
def test_an_image_that_cannot_be_used_says_so_where_it_is_and_what_to_do(
    server: Server, open_page: Callable[..., Page], tmp_path: Path
) -> None:
    """Fails where another thing is asked first, such as the patient's side, or the text leaves its box."""
    hands = Hands(open_page(server.url, allow=("422",)))  # what the browser itself says of a refused upload
    hands.step("images")
    pixels = np.random.default_rng(1).integers(900, 1100, (256, 256)).astype(np.uint16)
    (tmp_path / "junk.dcm").write_bytes(_JUNK)
    inputs = hands.page.locator("input[type=file]")
    inputs.nth(1).set_input_files(tmp_path / "junk.dcm")
    box = hands.see("drop-in-Lateral image")
    expect(box).to_contain_text("junk.dcm: the file is truncated or damaged")
    assert box.evaluate("element => element.scrollWidth <= element.clientWidth")
    for number in range(2):
        inputs.nth(number).set_input_files(write_dicom(Radiograph(pixels + number, 4095), tmp_path / f"{number}.dcm"))
        hands.wait_for_step("Images", "needs attention" if number else "to do")
    expect(hands.see("instruction")).to_contain_text("Load another PA image: this one cannot be used.")
    expect(hands.see("side-right")).to_have_count(0)
    expect(box).to_have_class(re.compile("failed"))
    assert not wrong(hands.page, scrolls=True)


def test_a_damaged_image_is_named_as_a_person_knows_it(tmp_path: Path) -> None:
    """Fails where the message names the kept file, which is called by its digest."""
    with Case.create(tmp_path / "case") as case, pytest.raises(ImageError) as refused:
        record_acquired(case, _JUNK, ".dcm", by=Actor.RADIOGRAPHER)
    assert str(refused.value).startswith("the file is truncated or damaged")


def test_what_is_not_placed_is_left_to_do_and_needs_no_attention() -> None:
    """Fails where a plan without its landmarks is marked as one that failed a check."""
    unmade = Check("head", False, None, None, "", "head.", missing=True)
    failed = Check("entry error", False, None, None, "", "entry error.")
    assert judged(Verdict((unmade,))) == (StepStatus.OPEN, "head.")
    assert judged(Verdict((unmade, failed))) == (StepStatus.ATTENTION, "entry error.")
    assert judged(Verdict(()))[0] is StepStatus.DONE
