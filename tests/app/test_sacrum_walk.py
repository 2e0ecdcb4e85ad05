"""A sacrum by a person who knows only the screen: the plan becomes GO by its words alone."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.eyes import wrong
from tests.app.hands import Hands, Pixels, by_image
from tests.app.person import Person

from sightline.app.plan.marks import marks_of
from sightline.case.views import NAMES
from sightline.frame import Frame
from sightline.imaging import write_dicom
from sightline.rehearsal.patient import RehearsedPatient, draw_patient, frame_of

KIND, SEED = "iliosacral-screw", 10
LABELS = ("Inlet image", "Outlet image")


@dataclass(frozen=True)
class _Exactly:
    """A view whose places on the screen are known exactly: on this screen a pixel of it is three of a block's image,
    which a person would enlarge."""

    hands: Hands
    view: str

    def at(self, uv: tuple[float, float]) -> tuple[float, float]:
        return self.hands.on_screen(self.view, uv)


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
    serve: Callable[..., Server], open_page: Callable[..., Page], tmp_path: Path, shoot
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
    person.know({view: _Exactly(Hands(person.page), view) for view in NAMES})
    known = _known(patient, KIND)
    assert person.place(known) == 10
    person.go_on("Place corridor of S1")
    assert not wrong(person.page, scrolls=False)
    person.press("Place corridor of S1")
    person.place(known)
    person.read("Every check passed. A person decides.")
    assert not wrong(person.page, scrolls=False)
    if Frame.load(frame_of(KIND)).solid is not None:
        person.press("3-D")
        person.read("Along Y")  # a block says nothing of the patient
        expect(person.page.locator(".space-label").filter(has_text="cranial")).to_have_count(0)
    shoot(person.page, "sacrum-planned")
