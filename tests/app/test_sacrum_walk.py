"""A sacrum by a person who knows only the screen: the plan becomes GO by its words alone."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.eyes import wrong
from tests.app.hands import PATIENCE_MS, Hands, Pixels, by_image

from sightline.app.plan.marks import marks_of
from sightline.case.views import NAMES
from sightline.frame import Frame
from sightline.imaging import write_dicom
from sightline.rehearsal.patient import RehearsedPatient, draw_patient, frame_of

KIND, SEED = "iliosacral-screw", 10
LABELS = ("Inlet image", "Outlet image")


# "3 of 10 · LATERAL · Entry point: slide along its curve and click"
_ORDER = re.compile(r"^(\d+) of (\d+) · (PA|LATERAL|INLET|OUTLET)(?: CHECK)? · ([^:]+): ")
_LINES = "document.body.innerText.split('\\n')"
_ASKED = f"([order, before]) => {_LINES}.find(line => new RegExp(order).test(line) && line !== before)"
_GONE = f"said => !{_LINES}.includes(said)"
_VIEWS = {"PA": "pa", "LATERAL": "lateral", "INLET": "pa", "OUTLET": "lateral"}
# The button in the lower right corner, as [words, whether it can be pressed]; ["", false] where none stands there.
_LAST = """() => {
  const last = document.elementFromPoint(innerWidth - 40, innerHeight - 32)?.closest('button');
  return last ? [last.innerText, !last.disabled] : ['', false];
}"""
_OTHER = (
    f"([before, until]) => {{ const [words, on] = ({_LAST})(); return words === until || (on && words !== before); }}"
)


class Person:
    """A person who knows only the screen: reads its words and presses buttons."""

    def __init__(self, page: Page) -> None:
        self.page, self._hands = page, Hands(page)

    def press(self, words: str) -> None:
        """What shows these words: the last of them on the page, where a question stands."""
        self.page.get_by_text(words, exact=True).locator("visible=true").last.click()

    def type(self, label: str, text: str) -> None:
        """Into the field with this label."""
        self.page.get_by_label(label).fill(text)

    def choose(self, label: str, words: str) -> None:
        """The option that says so, of the choice with this label."""
        self.page.get_by_role("combobox", name=label).click()
        self.page.get_by_role("option", name=words, exact=True).click()

    def load(self, words: str | re.Pattern[str], file: Path) -> None:
        """Choose a file for the place that says so."""
        place = self.page.locator(".drop-in").filter(has_text=words)
        with self.page.expect_file_chooser() as asked:
            place.get_by_text("Choose a file", exact=True).click()
        asked.value.set_files(file)
        expect(place).to_have_count(0, timeout=PATIENCE_MS)

    def read(self, words: str | re.Pattern[str]) -> None:
        """Wait until the page says so."""
        expect(self.page.get_by_text(words).first).to_be_visible(timeout=PATIENCE_MS)

    def place(self, known: Mapping[str, Pixels]) -> int:
        """Click what the page asks for, wherever `known` has it by its name on the page, until it was the last; return
        how many clicks."""
        clicks, said = 0, ""
        while True:
            said = str(self.page.wait_for_function(_ASKED, arg=[_ORDER.pattern, said]).json_value())
            asked = _ORDER.match(said)
            assert asked is not None, said
            number, count, view, name = asked.groups()
            self._hands.click(_VIEWS[view], known[name][_VIEWS[view]])
            clicks += 1
            if number == count:
                self.page.wait_for_function(_GONE, arg=said)
                return clicks
            assert clicks < 50, f"the page asks for {name} again and again"

    def go_on(self, until: str) -> list[str]:
        """Press the button at the lower right until that says `until`; return the words."""
        pressed = [""]
        while True:
            self.page.wait_for_function(_OTHER, arg=[pressed[-1], until], timeout=PATIENCE_MS)
            words = str(self.page.evaluate(_LAST)[0])
            if words == until:
                return pressed[1:]
            assert len(pressed) < 20, pressed
            self.press(words)
            pressed.append(words)


def _known(patient: RehearsedPatient, kind: str) -> dict[str, Pixels]:
    """Where the person sees what the page names."""
    wire = patient.pixels(patient.wires_mm[0])
    at = by_image({"entry": wire[:, 0], "end": wire[:, 1]})
    named = zip(patient.landmark_keys, patient.landmarks.values(), strict=True)
    at |= by_image({f"landmark-{key}": uv for key, uv in named})
    for key, each in patient.aids_px.items():
        for view, uv in zip(NAMES, each, strict=True):
            for k, one in enumerate([] if uv is None else uv):
                at.setdefault(f"{key}-{k + 1}", {})[view] = (float(one[0]), float(one[1]))
    return {spec.label: at[spec.name] for spec in marks_of(kind) if spec.name in at}


@pytest.mark.slow  # images are rendered and calibrated
def test_a_person_who_knows_only_the_screen_plans_the_wire(
    serve: Callable[..., Server], open_page: Callable[..., Page], few_pixels: None, tmp_path: Path, shoot
) -> None:
    """Fails where an image has the name of another procedure's view, where its markers do not tell, where the way to GO
    ends at a button that cannot be pressed, and where a text is cut once its point is placed."""
    patient = draw_patient(KIND, SEED, Frame.load(frame_of(KIND)))
    files = [write_dicom(patient.images[name], tmp_path / f"{name}.dcm") for name in NAMES]
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--frame", frame_of(KIND)]
    server = serve(*command, "--case", str(tmp_path / "case"))
    person = Person(open_page(server.url))
    person.choose("Procedure", "Iliosacral screw")
    for name, file in zip(LABELS, files, strict=True):
        person.load(re.compile(f"Drop the {name} here", re.IGNORECASE), file)
    for name in reversed(LABELS):  # `press` takes the last of two buttons
        person.type(f"{name}: taken, minutes ago", "2")
        person.press("Confirm the time")
        expect(person.page.get_by_label(f"{name}: taken, minutes ago")).to_have_count(0)
    person.press("Right side")
    person.type("Serial on the frame", "none")
    person.press("Confirm serial")
    assert person.go_on("Continue to Drill") == ["Continue to Calibrate", "Continue to Plan"]
    known = _known(patient, KIND)
    assert person.place(known) == 10
    person.go_on("Place corridor of S1")
    assert not wrong(person.page, scrolls=False)
    for aid in ("corridor of S1", "outer cortex of the ilium"):
        person.press(f"Place {aid}")
        person.place(known)
    person.read("Every check passed. A person decides.")
    assert not wrong(person.page, scrolls=False)
    if Frame.load(frame_of(KIND)).solid is not None:
        person.press("3-D")
        person.read("Along Y")  # a block says nothing of the patient
        expect(person.page.locator(".space-label").filter(has_text="cranial")).to_have_count(0)
    shoot(person.page, "sacrum-planned")
