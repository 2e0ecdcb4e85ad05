"""What the page asks of eyes: words that are read, and nothing that is cut, covered or off the screen."""

from pathlib import Path
from typing import Any

from playwright.sync_api import Page
from tests.app.colour import GRAPHIC, TEXT, contrast, over

EYES, GEOMETRY = (Path(__file__).with_name(name).read_text("utf-8") for name in ("eyes.js", "geometry.js"))
LARGE_PX, LARGE_BOLD_PX = 24.0, 18.66  # 18 pt, 14 pt bold: WCAG 2.2, 1.4.3
SMALLEST_PX = 11.0  # on a screen of 1280 pixels [ours]
# No dialog is coming or going: its classes change before and after its animation too.
_AT_REST = (
    "document.getAnimations().every(({ playState }) => playState === 'finished') && "
    "!document.querySelector('[class*=q-transition--]')"
)


def wrong(page: Page, *, scrolls: bool) -> list[str]:
    """Return what is wrong with the page's geometry, once it has come to rest. `scrolls`: the column may."""
    page.wait_for_function(_AT_REST)
    return page.evaluate(GEOMETRY, scrolls)


def written(page: Page) -> list[dict[str, Any]]:
    """Return all text on the page, once no animation is running."""
    page.wait_for_function(_AT_REST)
    return page.evaluate(EYES)


def unread(words: list[dict[str, Any]]) -> list[str]:
    """Return what is written too small, or in too little contrast."""
    bad = []
    for word in words:
        large = word["size"] >= LARGE_PX or (word["bold"] and word["size"] >= LARGE_BOLD_PX)
        for image in ("rgb(0, 0, 0)", "rgb(255, 255, 255)"):
            grounds = [image if ground == "image" else ground for ground in word["grounds"]]
            below = over(*grounds)
            seen = word["opacity"] * over(word["colour"], *grounds) + (1.0 - word["opacity"]) * below
            ratio = contrast(seen, below)
            if ratio < (GRAPHIC if large else TEXT) or word["size"] < SMALLEST_PX:
                bad.append(f"{word['text']!r}: {ratio:.2f}:1, {word['size']:.0f} px, {word['colour']} on {grounds}")
    return bad
