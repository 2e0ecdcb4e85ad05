"""Kinds of trajectory in a real browser: a pair of holes, and a wire that the page proposes and a person changes."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.hands import Hands, Pixels, by_image, rehearsal, truth

from sightline.app.plan.marks import marks_of
from sightline.case.views import NAMES
from sightline.imaging import write_dicom
from sightline.twin.anatomy.femur import to_cfcs

pytestmark = pytest.mark.slow
SEEN_PX = 1.2  # a click is a whole pixel of the screen, the image drawn at 0.45: half of one over that
SIDE = "right"
HOLES_APART_MM = 25.0
_BESIDE = re.compile(r"position AP\s*-?[1-9]")  # mm from the head's centre, where it was 0.0


@pytest.fixture(scope="module")
def server(serve: Callable[..., Server], tmp_path_factory: pytest.TempPathFactory) -> Server:
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet"]
    return serve(*command, "--case", str(tmp_path_factory.mktemp("case")))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Images of a hip as a person's own: a simulated patient takes no plan of a nail that it does not have."""
    folder = tmp_path_factory.mktemp("hip")
    return [write_dicom(rehearsal().images[name], folder / f"{name}.dcm") for name in NAMES]


@pytest.fixture
def hands(server: Server, files: list[Path], open_page: Callable[..., Page]) -> Hands:
    person = Hands(open_page(server.url))
    if "done" not in person.see("step-images").inner_text():
        person.load(files, SIDE)
    person.step("Plan")
    return person


def _choose(hands: Hands, kind: str) -> None:
    hands.see("kind").click()
    hands.page.get_by_role("option", name=kind, exact=True).click()
    expect(hands.see("kind")).to_contain_text(kind)


def _from_base(xyz_mm: list[list[float]]) -> np.ndarray:
    """(2, N, 2): where both images show points (N, 3), anatomical, from where the axes of neck and shaft meet."""
    patient = rehearsal()
    return patient.pixels(to_cfcs(patient.hip.femur.base_mm + np.array(xyz_mm), SIDE, patient.hip.head_mm))


def _holes(up_mm: float = 0.0) -> dict[str, Pixels]:
    """The walls of a hole, one behind the other as the lateral image sees them, and the nail's landmarks."""
    uv = _from_base([[5.7, 6.3 - up_mm, 0.4], [-5.3, 6.1 - up_mm, 0.2], [0.3, 41.7, 0.6], [2.1, 21.3, 3.9]])
    names = ("entry", "end", "landmark-nail-tip", "landmark-other-hole")
    return by_image({name: uv[:, k] for k, name in enumerate(names)})


def test_a_pair_of_holes_is_planned_beside_a_hip_screw(hands: Hands, shoot) -> None:
    _choose(hands, "Interlocking holes")
    known = _holes()
    assert set(known) <= {one.name for one in marks_of("interlocking")}
    expect(hands.see("wire-distal")).to_contain_text("not placed")
    button = hands.see("wire-distal").element_handle()
    for view in NAMES:
        for name in ("entry", "end"):
            hands.place(name, view, known[name][view])
    for name in ("landmark-nail-tip", "landmark-other-hole"):
        for view in NAMES:
            hands.place(name, view, known[name][view])
    for name, where in known.items():
        for view in NAMES:
            assert np.hypot(*np.subtract(hands.placed(name, view), where[view])) < 2 * SEEN_PX, (name, view)
    expect(hands.see("verdict")).to_contain_text("INCOMPLETE")
    expect(hands.see("wire-distal")).to_contain_text("GO")
    assert button.evaluate("(button) => button.isConnected")  # a button that is built again loses a click
    hands.press("wire-proximal")
    for view in NAMES:
        for name in ("entry", "end"):
            hands.place(name, view, _holes(HOLES_APART_MM)[name][view])
    expect(hands.see("verdict")).to_contain_text("Every check passed")
    expect(hands.see("propose-others")).to_have_count(0)
    expect(hands.see("figures")).not_to_contain_text("Tip to joint")  # it does not belong to a hip screw
    expect(hands.see("propose")).to_have_count(1)  # by the drawn rims
    shoot(hands.page, "interlocking")
    _choose(hands, "Hip screw")  # it had no points, and the nail's do not belong to a hip
    expect(hands.see("verdict")).to_contain_text("To do: Entry point, End point, Centre of the head")
    expect(hands.see("row-head-centre")).to_contain_text("○ PA")
    hands.page.keyboard.press("Control+z")
    expect(hands.see("kind")).to_contain_text("Interlocking holes")
    expect(hands.see("verdict")).to_contain_text("Every check passed")
    hands.page.keyboard.press("Control+y")
    expect(hands.see("verdict")).to_contain_text("To do: Entry point, End point, Centre of the head")


def _drawn() -> dict[str, Pixels]:
    """Clicks of head, shaft and lateral cortex."""
    rim = {name: where for name, where in truth().items() if name.startswith("head-")}
    along = _from_base([[0.0, down, 0.0] for down in (12.0, 44.0)])
    cortex = _from_base([[rehearsal().hip.femur.shaft_radius_mm, 30.0, 0.0]])
    shaft = by_image({f"shaft-{k + 1}": along[:, k] for k in range(2)})
    return rim | shaft | {"cortex-1": {"pa": (float(cortex[0, 0, 0]), float(cortex[0, 0, 1]))}}


def test_a_proposed_wire_is_by_the_rule_and_a_persons_to_change(hands: Hands, shoot) -> None:
    """135° to the shaft, through the head's centre, 8 mm under its surface: by the page's own measurements."""
    _choose(hands, "Hip screw")
    hands.press("propose")
    expect(hands.see("message")).to_contain_text("No wire can be proposed: the head is not drawn")
    known = _drawn()
    for aid in ("head", "shaft", "cortex"):
        hands.aid(aid, known)
    hands.details()
    hands.press("propose")
    expect(hands.see("metrics")).to_contain_text("135.0")
    figures = _figures(hands)
    assert figures["wire to shaft"] == pytest.approx(135.0, abs=0.06)  # as it is rounded
    assert figures["tip to bone along wire"] == pytest.approx(8.0, abs=0.06)
    assert figures["tip to bone nearest"] == pytest.approx(8.0, abs=0.06)  # through the centre
    shoot(hands.page, "proposed")
    proposed = {(name, view): hands.placed(name, view) for name in ("entry", "end") for view in NAMES}
    hands.page.keyboard.press("Escape")  # nothing is to be placed now
    hands.until("pa", "core.state.placing === null")
    x, y = hands.on_screen("pa", proposed["end", "pa"])
    mouse = hands.page.mouse
    mouse.move(x, y)
    mouse.down()
    mouse.move(x + 2, y - 9, steps=3)
    mouse.up()
    expect(hands.see("metrics")).to_contain_text(_BESIDE)
    changed = hands.placed("end", "pa")
    hands.page.keyboard.press("Control+z")
    expect(hands.see("metrics")).to_contain_text("135.0")
    hands.press("redo")
    expect(hands.see("metrics")).to_contain_text(_BESIDE)
    assert hands.placed("end", "pa") == changed
    hands.press("propose")  # again: what a person changed is replaced, and comes back by undo
    expect(hands.see("metrics")).to_contain_text("135.0")
    for (name, view), at in proposed.items():
        assert hands.placed(name, view) == pytest.approx(at, abs=1e-6)
    hands.press("undo")
    expect(hands.see("metrics")).to_contain_text(_BESIDE)
    assert hands.placed("end", "pa") == changed


def _figures(hands: Hands) -> dict[str, float]:
    """Values of the figures by their names."""
    rows = [row.inner_text().split("\t") for row in hands.see("metrics").locator("tr").all()]
    return {row[0].strip(): float(row[1].split()[0].rstrip("°")) for row in rows if "±" in row[1] and row[0].strip()}
