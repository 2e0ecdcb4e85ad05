"""A whole procedure by a person who knows only the screen: words lead from step to step, pictures to the bone."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page
from tests.app.browser import Server
from tests.app.hands import LANDMARKS, SEED, by_image, rehearsal, truth
from tests.app.person import Person
from tests.app.test_screen import wrong

from sightline.app.plan.decisions import Decisions
from sightline.case.journal import Case, Kind
from sightline.case.views import NAMES
from sightline.robot.link.simulated import SimulatedWire

CLICK_PX = 2.2  # half a pixel of the screen along both axes, and a third for the eye; one is 2.1 px of the image
# What the page calls the points that the person knows.
WORDS = {
    "Entry point": "entry",
    "End point": "end",
    "Centre of the head": "landmark-head-centre",
    "Lesser trochanter": "landmark-lesser-trochanter",
    "Greater trochanter": "landmark-greater-trochanter",
    "Femoral head 1": "head-1",
    "Femoral head 2": "head-2",
    "Femoral head 3": "head-3",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("case")


@pytest.fixture(scope="module")
def server(serve: Callable[..., Server], folder: Path) -> Server:
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--fast-robot"]
    return serve(*command, "--case", str(folder), "--rehearse", str(SEED))


@pytest.mark.slow  # images are rendered and calibrated, twice
def test_a_person_who_knows_only_the_screen_plans_drills_and_checks_a_wire(
    server: Server, open_page: Callable[..., Page], folder: Path, shoot
) -> None:
    """Fails where a step does not say what is next or its button does not lead there, where a picture is not shown, is
    mirrored or stands below the other's name, and where a click lands beside what the picture shows there."""
    person = Person(open_page(server.url))
    person.read("Confirm the patient's side and the frame's serial")
    person.press("Right side")
    person.type("Serial on the frame", "none")
    person.press("Confirm serial")
    assert person.go_on("Continue to Drill") == ["Continue to Calibrate", "Continue to Plan"]
    known = {words: truth()[name] for words, name in WORDS.items()}
    person.find(rehearsal().images, dict(zip(NAMES, ("PA image", "Lateral image"), strict=True)))
    assert person.place(known) == 10
    person.read("INCOMPLETE")
    assert person.go_on("Continue to Drill") == ["Place femoral head"]
    assert person.place(known) == 6
    person.read("Every check passed. A person decides.")
    shoot(person.page, "by-sight-plan")
    steps = ["Continue to Drill", "Start the simulated robot", "Send the plan", "Align", "Drill", "Continue drilling"]
    assert person.go_on("Place landmarks") == [*steps, "Continue to Verify", "Take both check images"]
    with Case.open(folder, read_only=True) as case:
        made = Decisions.of(case.latest(Kind.CHANGED, where={"what": "edit"}).content["to"])
        drilled = case.latest(Kind.DRILLED)
    for words, where in known.items():
        for view in NAMES:
            at = made.mark(WORDS[words]).places[view]
            assert np.hypot(*np.subtract(at, where[view])) < CLICK_PX, (words, view)
    assert drilled is not None
    check = rehearsal().check_images(SimulatedWire.of(drilled.content["simulated_wire"]))
    person.find(check.images, dict(zip(NAMES, ("PA check image", "Lateral check image"), strict=True)))
    points = np.stack([check.landmarks_mm[name] for name in LANDMARKS])
    uv_px = np.stack([check.setup.views[view].project(points) for view in NAMES])
    marks = list(WORDS)[2:5]
    assert person.place(by_image(dict(zip(marks, uv_px.swapaxes(0, 1), strict=True)))) == 6
    person.read("PASSED")
    person.read("The wire was measured in two check images and lies as planned.")
    assert not wrong(person.page, scrolls=True)
    shoot(person.page, "by-sight-verify")
