"""Contrast and colour blindness, computed from the sheets and tables that the page itself uses."""

import re
from importlib.resources import files
from itertools import combinations

import numpy as np
import pytest
from tests.app.colour import DICHROMATS, DISTINCT, GRAPHIC, TEXT, contrast, distance, over, parsed

from sightline.app.panels.verdict import SOURCES

APP = files("sightline.app")
COLOURS: dict[str, str] = dict(
    re.findall(r'^  "?([\w-]+)"?: "(#[0-9a-f]{6})",', (APP / "drawing/colours.js").read_text("utf-8"), re.M)
)
GROUNDS = ("ground", "panel", "raised", "chosen", "go", "no-go")
WORDS = ("text", "quiet", "sky", "green", "orange", "vermillion")
SAME = {("pa", "left"), ("lateral", "right")}  # the first and the second view of a frame
HUES = ("sky", "green", "orange", "vermillion", "yellow", "purple", "text", "quiet", "edge")
IMAGES = ("#000000", "#ffffff")  # what lies under a view's panels: an image is anything between
SHEETS = {
    name: (APP / name).read_text("utf-8")
    for name in ("page.css", "drawing/xray/xray_chrome.js", "drawing/space/space.js")
}


def rgb(name: str) -> np.ndarray:
    return over(COLOURS[name])


def rules(sheet: str) -> list[tuple[str, dict[str, str]]]:
    """Selector and declarations of every rule, with its colours resolved."""
    plain = re.sub(r"/\*.*?\*/", "", sheet, flags=re.S)
    found = re.findall(r"([^{}`]+)\{([^{}]*)\}", plain)
    split = [(who.strip(), dict(one.split(":", 1) for one in what.split(";") if ":" in one)) for who, what in found]
    look = lambda value: re.sub(r"var\(--([\w-]+)\)", lambda m: COLOURS.get(m[1], m[0]), value).strip()  # noqa: E731
    return [(who, {key.strip(): look(value) for key, value in what.items()}) for who, what in split]


def is_colour(value: str) -> bool:
    try:
        parsed(value)
    except ValueError:
        return False
    return True


def test_every_colour_is_named_once() -> None:
    assert len(COLOURS) > 20 and len(set(COLOURS.values())) == len(COLOURS)
    assert set(WORDS) | set(HUES) | set(GROUNDS) <= set(COLOURS)
    for path in ("page.css", "web/drop.js", "drawing/xray", "drawing/space"):
        inside = APP / path
        for file in [inside] if inside.is_file() else [f for f in inside.iterdir() if f.name.endswith(".js")]:
            stray = set(re.findall(r"#[0-9a-f]{3,8}\b", file.read_text("utf-8"))) - {"#ffffff"}  # lamps of the scene
            assert not stray, (file.name, stray)
            used = re.findall(r"var\(--([\w-]+)\)|COLOURS\.(\w+)", file.read_text("utf-8"))
            own = {"size", "xray-top", "xray-right"}  # of page.css
            assert {css or js for css, js in used} - own <= set(COLOURS), file.name


@pytest.mark.parametrize("word", WORDS)
def test_words_are_read_on_every_ground(word: str) -> None:
    for ground in GROUNDS:
        assert contrast(rgb(word), rgb(ground)) >= TEXT, ground


@pytest.mark.parametrize("hue", HUES)
def test_graphics_stand_out_from_every_ground(hue: str) -> None:
    for ground in ("stage", "ground", "panel", "raised"):
        assert contrast(rgb(hue), rgb(ground)) >= GRAPHIC, ground


@pytest.mark.parametrize("sheet", SHEETS)
def test_rules_that_set_words_and_their_ground(sheet: str) -> None:
    """Panels over an image let a part of it through: the worst image counts."""
    found = 0
    for who, what in rules(SHEETS[sheet]):
        colour, ground = what.get("color", COLOURS["text"]), what.get("background", "")
        if not is_colour(ground) or not is_colour(colour) or "-bar " in who:  # a bar has no words
            continue
        found += 1
        for image in IMAGES:
            assert contrast(over(colour), over(ground, image)) >= TEXT, (who, image)
    assert found > 2


def styles(file: str) -> dict[str, dict[str, str]]:
    """The table of looks of a canvas: its colour as "#rrggbb", all else as it is written."""
    table = re.search(r"export const STYLES = \{\n(.*?)\n\};", (APP / file).read_text("utf-8"), re.S)
    assert table
    out = {}
    for name, what in re.findall(r'^  "?([\w-]+)"?: \{ (.*) \},$', table[1], re.M):
        values = dict(re.findall(r"(\w+): (\[.*?\]|[^,]+)", what))
        out[name] = values | {"colour": COLOURS[values["colour"].removeprefix("COLOURS.")]}
    assert len(out) == len(table[1].splitlines()) > 5
    return out


def test_lines_over_an_image_stand_out_from_their_casing() -> None:
    casing = re.search(r'const CASING = "(.*?)"', (APP / "drawing/xray/xray_paint.js").read_text("utf-8"))
    assert casing
    for name, look in styles("drawing/xray/xray_paint.js").items():
        for image in IMAGES:
            assert contrast(over(look["colour"]), over(casing[1], image)) >= GRAPHIC, (name, image)
    curves = [styles("drawing/xray/xray_paint.js")[name]["colour"] for name in ("entry", "end")]
    for image in IMAGES:
        for words in (COLOURS["text"], *curves):  # names of points, and of their curves
            assert contrast(over(words), over(casing[1], image)) >= TEXT


def test_things_in_space_stand_out_from_the_ground() -> None:
    for name, look in styles("drawing/space/space_objects.js").items():
        assert contrast(over(look["colour"]), rgb("ground")) >= GRAPHIC, name


@pytest.mark.parametrize("sight", DICHROMATS)
def test_what_looks_alike_to_the_colour_blind_has_another_cue(sight: str) -> None:
    """The cue: mark, dashes, filling or opacity. A band, a line and its ticks differ by shape."""
    for file, cues in (
        ("drawing/xray/xray_paint.js", ("mark", "dash", "fill")),
        ("drawing/space/space_objects.js", ("dash", "opacity")),
    ):
        for (one, look), (other, beside) in combinations(styles(file).items(), 2):
            if (one, other) in SAME:
                continue
            cue = [[of.get(key) for key in cues] for of in (look, beside)]
            far = distance(look["colour"], beside["colour"], DICHROMATS[sight])
            assert far >= DISTINCT or cue[0] != cue[1], (one, other, far)


@pytest.mark.parametrize("sight", DICHROMATS)
def test_sources_of_error_are_told_apart(sight: str) -> None:
    used = [COLOURS[name] for name in SOURCES.values()]
    assert min(distance(*pair, DICHROMATS[sight]) for pair in combinations(used, 2)) >= DISTINCT


def test_the_measures_themselves() -> None:
    assert contrast(over("#000000"), over("#ffffff")) == pytest.approx(21.0)
    assert contrast(over("#777777"), over("#ffffff")) == pytest.approx(
        4.48, abs=0.005
    )  # WCAG's own example of a failure
    red, green = "#c00000", "#5a7000"  # of the same lightness: distinguished by red and green cones only
    assert distance(red, green, np.eye(3)) > 5 * DISTINCT
    assert distance("#ffffff", "#ffffff", DICHROMATS["protanopia"]) == 0.0
    assert distance(red, green, DICHROMATS["deuteranopia"]) < distance(red, green, np.eye(3)) / 2
    for sight in DICHROMATS.values():
        np.testing.assert_allclose(sight @ np.ones(3), 1.0, atol=2e-6)  # greys stay grey
    with pytest.raises(ValueError, match="no colour"):
        parsed("transparent")
