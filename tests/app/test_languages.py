"""Languages of the page: complete files, what is refused, which one a page speaks, and that the page shows no text
that is not from the list."""

import ast
import json
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect
from tests.app.hands import SEED, Hands

from sightline.app import texts
from sightline.app.plan.marks import GUIDE, marks_of
from sightline.app.plan.robot_wire import ROBOT_WIRE
from sightline.checks import Check
from sightline.errors import UnusableInputError
from sightline.planning.procedures import procedures

ROOT = Path(__file__).parents[2]
TEXTS = Path(str(files("sightline.app") / "texts"))
SHIPPED = sorted(file.stem for file in TEXTS.glob("*.json"))
# Sections of docs/refusals.md whose checks the page can show.
SHOWN = ("a view", "an image", "a plan", "wires", "confirms", "a check shot", "a robot's target")
CHECK = Check("entry error", False, 2.0, 1.0, "mm", "The 95 % error of the entry point, 2.00 mm, is above its limit.")


def document(name: str) -> dict[str, Any]:
    return json.loads((TEXTS / f"{name}.json").read_text("utf-8"))


def keys(value: Any, where: str = "") -> set[str]:
    """The places of all texts in a value."""
    if isinstance(value, str):
        return {where}
    parts = value.items() if isinstance(value, dict) else enumerate(value)
    return set().union(*(keys(part, f"{where}.{key}") for key, part in parts))


def names_below() -> set[str]:
    """What the page shows of procedures and of the robot's wire, as the rooms below name it."""
    ways: list[dict[str, bool]] = [{}, {"of_nail": True}, {"borders": True}]
    marks = [*GUIDE, *ROBOT_WIRE, *(spec for kind in procedures() for way in ways for spec in marks_of(kind, **way))]
    found = {name for spec in marks for name in (spec.label, spec.sentence)}
    for one in procedures().values():
        found |= {one.document.name, one.document.purpose, one.wire.name}
        if one.document.catalogue is not None and one.document.catalogue.along_wire:
            found.add(one.document.catalogue.implants)
    return found


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_language_has_every_text_name_and_check(name: str) -> None:
    given, language = document(name), texts.load(name)  # which refuses other keys and other placeholders
    assert keys(given["texts"]) == keys(texts.ENGLISH.texts)
    with texts.spoken(language):
        same = {text for text in names_below() if texts.word(text) == text}  # in both languages, or not translated
    assert {text for text in same if text.lower() not in given["words"]} == set()
    sections = re.split(r"^## ", (ROOT / "docs" / "refusals.md").read_text("utf-8"), flags=re.MULTILINE)[1:]
    shown = [one for one in sections if any(part in one.partition("\n")[0] for part in SHOWN)]
    assert len(shown) == len(SHOWN)
    named = set(re.findall(r"^### (.+)$", "".join(shown), flags=re.MULTILINE))
    assert named - set(language.checks) == set()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"language": "xx", "texts": {"STALE": "alt"}}, "STALE needs the placeholders age:.1f"),
        ({"language": "xx", "texts": {"STALE": "{age:.3f}"}}, "STALE needs"),  # as many digits as in English
        ({"language": "xx", "texts": {"SEND": "{x}"}}, "SEND needs the placeholders none"),
        ({"language": "xx", "texts": {"SENT": "x"}}, "texts has no part SENT"),
        ({"language": "xx", "texts": {"STEPS": {"paln": "x"}}}, "STEPS has no part paln"),
        ({"language": "xx", "texts": {"UNDO": ["x"]}}, "UNDO has another shape"),
        ({"language": "xx", "text": {}}, "text is not a key of a language file"),
        ({}, "language is missing"),
    ],
)
def test_a_language_file_that_would_fail_on_the_page_is_refused(tmp_path: Path, given: Any, said: str) -> None:
    file = tmp_path / "xx.json"
    file.write_text(json.dumps(given))
    with pytest.raises(UnusableInputError, match=said):
        texts.load(str(file))


def test_what_a_file_lacks_is_english(tmp_path: Path) -> None:
    file = tmp_path / "xx.json"
    file.write_text(json.dumps({"language": "xx", "texts": {"STEPS": {"plan": "X"}}, "words": {"end point": "X y"}}))
    with texts.spoken(texts.load(str(file))):
        assert (texts.STEPS["plan"], texts.STEPS["drill"], texts.SEND) == ("X", "Drill", "Send the plan")
        assert (texts.word("End point"), texts.word("entry point")) == ("X y", "entry point")
        assert texts.said(CHECK) == CHECK.sentence
    assert texts.STEPS["plan"] == "Plan"
    with pytest.raises(UnusableInputError, match="no language yy: give en, de, or a language file"):
        texts.load("yy")


def test_names_keep_their_number_and_their_capital() -> None:
    with texts.spoken(texts.load("de")):
        assert texts.word("entry point") == "Eintrittspunkt"
        assert texts.word("Femoral head 3") == "Hüftkopf 3"
        assert texts.word("Far hole") == "Fernes Loch" and texts.word("far hole") == "fernes Loch"
        assert texts.word("a name of a user's procedure 4") == "a name of a user's procedure 4"


def test_a_card_in_another_language_names_the_point_of_a_gap() -> None:
    """Fails where a German surgeon is told to set "the point" again, without its name."""
    gap = "The lines of sight of {} pass 3.10 mm apart, 4.20 times the limit: pick again."
    with texts.spoken(texts.load("de")):
        for name, point in (("the spinous process", "Dornfortsatz"), ("the entry point", "Eintrittspunkt")):
            told = texts.said(Check("gap", False, 4.2, 3.3, "σ", gap.format(name)))
            assert told.startswith(f"Abstand der Sichtlinien ({point}): den Punkt neu setzen") and not texts.tag(told)
        assert texts.said(Check("gap", False, 4.2, 3.3, "σ", gap.format("landmark 4"))).count("(landmark 4)") == 1


def test_sentences_that_no_list_holds_are_marked_as_english() -> None:
    assert texts.tag(CHECK.sentence) == ""  # in English
    with texts.spoken(texts.load("de")):
        assert texts.tag(CHECK.sentence) == "en"
        for listed in (
            texts.said(CHECK),
            texts.ONLY_GO,
            texts.IMAGE_BEADS.format(image="PA", width=1, height=2, beads=3),
        ):
            assert texts.tag(listed) == "", listed


@pytest.mark.parametrize(
    ("header", "tag"),
    [("de-CH,de;q=0.9,en;q=0.8", "de"), ("en-GB,de;q=0.5", "en"), ("xx,de", "de"), ("../de", "en"), (None, "en")],
)
def test_a_page_speaks_what_its_browser_prefers(header: str | None, tag: str) -> None:
    assert texts.language_of(header).tag == tag


def test_no_text_is_looked_up_when_a_module_is_imported() -> None:
    """It would stay in English on a page of another language."""
    for source in TEXTS.parent.rglob("*.py"):
        if source.parent == TEXTS:
            continue
        tree = ast.parse(source.read_text("utf-8"))
        imported = [
            one for one in ast.walk(tree) if isinstance(one, ast.ImportFrom) and one.module == "sightline.app.texts"
        ]
        assert not [name.name for one in imported for name in one.names if name.name.isupper()], source
        for statement in tree.body:
            if isinstance(statement, ast.Assign | ast.AnnAssign):
                assert "texts." not in ast.unparse(statement), f"{source}: {ast.unparse(statement)}"


# Text, and names of what has none, that is shown outside parts marked as English.
_SHOWN_TEXT = """() => {
  const out = [], skip = "script, style, [lang=en], .q-icon, .nicegui-error-popup"; // the last is NiceGUI's own
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const at = walker.currentNode.parentElement;
    if (!at.closest(skip)) out.push(walker.currentNode.textContent);
  }
  for (const key of ["aria-label", "title", "placeholder"])
    for (const at of document.querySelectorAll(`[${key}]`)) if (!at.closest(skip)) out.push(at.getAttribute(key));
  return [document.documentElement.lang, out];
}"""
_UNITS = {
    "X",
    "Y",
    "Z",
    "mm",
    "N",
    "s",
    "px",
    "σ",
    "χ²",
    "s.d.",
    "STOP",
    "C",
    "W",
    "none",
}  # and the robot's button, the window, a serial


@pytest.mark.slow
def test_nothing_on_the_page_is_not_from_the_list(serve, open_page, tmp_path: Path) -> None:
    """In a language whose every text is in brackets, no letter is outside them."""
    german = document("de")

    def bracketed(value: Any) -> Any:
        if isinstance(value, str):
            return f"⟦{value}⟧" if value else value
        if isinstance(value, dict):
            return {key: bracketed(part) for key, part in value.items()}
        return [bracketed(part) for part in value]

    made = {"language": "xx", "texts": bracketed(texts.ENGLISH.texts)}
    made["words"] = {word: f"⟦{word}⟧" for word in german["words"]}
    made["checks"] = {name: [f"⟦{name}⟧", "⟦do⟧"] for name in german["checks"]}
    file = tmp_path / "xx.json"
    file.write_text(json.dumps(made))
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--language", str(file)]
    server = serve(*command, "--case", str(tmp_path / "1"), "--rehearse", str(SEED), "--fast-robot")
    hands = Hands(open_page(server.url))

    def look(where: str) -> None:
        tag, shown = hands.page.evaluate(_SHOWN_TEXT)
        assert tag == "xx"
        outside = {text: _outside(text) for text in shown}
        assert {text: left for text, left in outside.items() if left} == {}, where

    hands.wait_for_step("calibrate", "done")
    look("images")
    hands.confirm("right", "none")
    for step in texts.STEPS:
        hands.step(step)
        hands.details()
        look(step)
        hands.details()
    hands.plan()
    hands.details()
    look("planned")
    for sheet in ("shortcuts", "cases"):
        hands.press(sheet)
        expect(hands.see(f"{sheet}-sheet")).to_be_visible()
        look(sheet)
        hands.press(f"{sheet}-close")
    hands.details()
    hands.press("space-toggle")
    hands.page.wait_for_function("window.sightlineSpace?.renders > 0")
    hands.step("drill")
    hands.press("start-robot")
    hands.press("send")
    look("question")
    hands.press("send-yes")
    expect(hands.see("align")).to_be_enabled()
    look("sent")


def _outside(text: str) -> list[str]:
    """Words outside the brackets, but units and what has digits, such as the number of the case."""
    before = ""
    while before != text:
        before, text = text, re.sub(r"⟦[^⟦⟧]*⟧", "", text)
    return [word for word in re.findall(r"[^\W\d_][\w-]*", text) if word not in _UNITS and not re.search(r"\d", word)]
