"""A person before the planning page: looks, clicks, drags, types. What they know of the patient is the twin's truth."""

from functools import cache
from typing import Any

import numpy as np
from playwright.sync_api import Locator, Page, expect

from sightline.app.plan.marks import marks_of
from sightline.case.views import NAMES
from sightline.frame import Frame
from sightline.rehearsal.rehearsal import Rehearsal

SEED = 9
KIND = "hip-screw"
LANDMARKS = ("head centre", "lesser trochanter", "greater trochanter")  # as the twin names the kind's, in its order
AIDS = ("neck", "shaft", "cortex")  # what is drawn besides the head
PATIENCE_MS = 120_000  # for images that are taken and calibrated on a busy machine
Pixels = dict[str, tuple[float, float]]


@cache
def rehearsal() -> Rehearsal:
    """The patient whom the page rehearses on."""
    return Rehearsal.draw(SEED, Frame.load("gamma"))


def truth() -> dict[str, Pixels]:
    """Where each mark of the kind belongs, by image."""
    patient = rehearsal()
    found = {name: patient.pixels(patient.hip.wire_mm)[:, k] for k, name in enumerate(("entry", "end"))}
    asked = [one.name for one in marks_of(KIND) if one.group == "landmark"]
    found |= {name: patient.landmarks[known] for name, known in zip(asked, LANDMARKS, strict=True)}
    return by_image(found | _rim(patient)) | aids(patient)


def aids(patient: Rehearsal) -> dict[str, Pixels]:
    """Where the clicks on neck, shaft and cortex belong, by image."""
    drawn = {key: dict(zip(NAMES, patient.aids_px[key], strict=True)) for key in AIDS}
    return {
        f"{key}-{k + 1}": {view: tuple(uv[k].tolist()) for view, uv in each.items() if uv is not None}
        for key, each in drawn.items()
        for k in range(len(next(uv for uv in each.values() if uv is not None)))
    }


def by_image(uv_px: dict[str, np.ndarray]) -> dict[str, Pixels]:
    """Pixels (2, 2), a row for each view, of each mark."""
    return {name: dict(zip(NAMES, map(tuple, uv.tolist()), strict=True)) for name, uv in uv_px.items()}


def _rim(patient: Rehearsal) -> dict[str, np.ndarray]:
    """Three points of the head's silhouette in each view."""
    rim = patient.head_rim
    return {f"head-{n + 1}": rim[:, n] for n in range(rim.shape[1])}


def _ask(expression: str) -> str:
    return f"([name, value]) => {{ const core = window.sightlineXray?.[name]; return core && ({expression}); }}"


class Hands:
    """What a person does on a page, and waits to see."""

    def __init__(self, page: Page) -> None:
        self.page = page

    def see(self, testid: str) -> Locator:
        """A part of the page."""
        return self.page.get_by_test_id(testid)

    def press(self, testid: str) -> None:
        """Click a button."""
        self.see(testid).click()

    def step(self, name: str) -> None:
        """Go to a step, by its key or its name in English."""
        self.press(f"step-{name.lower()}")
        expect(self.see(f"step-{name.lower()}")).to_have_attribute("aria-current", "step")

    def details(self) -> None:
        """Open the drawer, or close it."""
        self.press("details")

    def wait_for_step(self, name: str, standing: str) -> None:
        """Until a step is done, or what it shall be."""
        expect(self.see(f"step-{name.lower()}")).to_contain_text(standing, timeout=PATIENCE_MS)

    def core(self, image: str, expression: str, value: Any = None) -> Any:
        """Ask the view that shows an image."""
        return self.page.evaluate(_ask(expression), [image, value])

    def until(self, image: str, expression: str, value: Any = None, timeout_ms: float = PATIENCE_MS) -> None:
        """Wait until the view that shows an image says yes."""
        self.page.wait_for_function(_ask(expression), arg=[image, value], timeout=timeout_ms)

    def on_screen(self, view: str, uv: tuple[float, float]) -> tuple[float, float]:
        """Where a pixel of a view's image is on the screen."""
        self._until_shown(view)
        before, x, y = None, 0.0, 0.0
        while before != (x, y):  # until the page has come to rest
            before = x, y
            x, y = self.core(view, "core.toScreen(value)", list(uv))
            self.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return x, y

    def _until_shown(self, view: str) -> None:
        self.until(view, "core.state.image && core.state.image.url === core.url")

    def click(self, view: str, uv: tuple[float, float]) -> None:
        """Click at a pixel."""
        self.page.mouse.click(*self.on_screen(view, uv))

    def place(self, name: str, view: str, uv: tuple[float, float]) -> None:
        """Click where a mark belongs, and wait until it is there."""
        self.until(view, "core.state.placing === value", name)
        self.click(view, uv)
        self.until(view, "core.state.placing !== value", name)

    def has(self, name: str, view: str) -> bool:
        """Whether a mark is placed in a view."""
        return bool(self.core(view, "core.state.points.get(value)?.uv", name))

    def placed(self, name: str, view: str) -> tuple[float, float]:
        """Where a mark is in a view."""
        self._until_shown(view)
        uv = self.core(view, "core.state.points.get(value).uv", name)
        return uv[0], uv[1]

    def confirm(self, side: str = "right", serial: str = "none") -> None:
        """Side and serial."""
        self.step("Images")
        self.press(f"side-{side}")
        self.page.locator("input[data-testid=serial], [data-testid=serial] input").fill(serial)
        self.press("confirm-serial")
        self.wait_for_step("Images", "done")

    def plan(self, known: dict[str, Pixels] | None = None, *, head: bool = True) -> None:
        """Wire and landmarks, in the order that the page asks for them; then the head's rim. `known`: where each
        belongs, if not where the twin has it. What is placed already stays: a failed test leaves half a plan."""
        known = truth() if known is None else known
        self.step("Plan")
        landmarks = [one.name for one in marks_of(KIND) if one.group == "landmark"]
        asked = [(name, view) for view in NAMES for name in ("entry", "end")]
        for name, view in asked + [(name, view) for name in landmarks for view in NAMES]:
            if not self.has(name, view):
                self.place(name, view, known[name][view])
        expect(self.see("row-greater-trochanter").locator(".placed")).to_have_count(2)
        if head:
            for key in ("head", *AIDS):
                self.aid(key, known)
            expect(self.see("figures")).to_contain_text("±")  # the tip-apex distance with its error

    def aid(self, key: str, known: dict[str, Pixels]) -> None:
        """The clicks of an aid: all in the first image, then in the other."""
        self.press(f"place-{key}")
        for view in NAMES:
            for name in (name for name in known if name.startswith(f"{key}-") and view in known[name]):
                if not self.has(name, view):
                    self.place(name, view, known[name][view])
