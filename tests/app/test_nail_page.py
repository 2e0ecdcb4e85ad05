"""A whole plan of a nail's holes by mouse, against the command line on the same strokes; restarted, kept, replayed."""

import asyncio
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.hands import Hands
from typer.testing import CliRunner

from sightline.app.plan.marks import NAIL_EDGES
from sightline.app.session.reporting import report_files
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.app.texts import XRAY
from sightline.case.contents import PlanRequest
from sightline.case.journal import Case, Kind
from sightline.case.replay import ReplayOutcome, replay
from sightline.case.views import NAMES
from sightline.cli import commands
from sightline.frame import Frame
from sightline.imaging import write_dicom
from sightline.rehearsal.patient import NAILED, RehearsedPatient, draw_patient

KEYS = ("distal", "proximal")
Placed = dict[str, list[tuple[float, float]]]
pytestmark = pytest.mark.slow  # images of a nail are rendered; a server and a browser


@pytest.fixture(scope="module")
def patient() -> RehearsedPatient:
    return draw_patient(NAILED, 14, Frame.load("block60"))


@pytest.fixture(scope="module")
def files(patient: RehearsedPatient, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("nail")
    return [write_dicom(patient.images[name], folder / f"{name}.dcm") for name in NAMES]


def _choose(hands: Hands, what: str, name: str) -> None:
    hands.see(what).click()
    hands.page.get_by_role("option", name=name, exact=True).click()
    expect(hands.see(what)).to_contain_text(name)


def _draw(hands: Hands, asked: PlanRequest) -> Placed:
    """Strokes, holes and landmarks as the page asks for them; return where each lies in both images."""
    nail, marks = asked.nail, asked.landmarks_uv_px
    assert nail is not None and marks is not None
    where = {spec.name: nail.strokes_px[:, n // 2, n % 2] for n, spec in enumerate(NAIL_EDGES)}
    where |= {f"hole-{key}": nail.clicks_px[key] for key in KEYS}
    for k, image in enumerate(NAMES):
        for n, (name, uv) in enumerate(where.items(), 1):
            expect(hands.see("instruction")).to_contain_text(f"{6 * k + n} of 20")
            hands.place(name, image, tuple(uv[k]))
    expect(hands.see("verdict")).to_contain_text("To do: Tip of the nail")
    for n, name in enumerate(asked.landmark_names):
        hands.press(f"place-{name}")
        for k, image in enumerate(NAMES):
            hands.place(f"landmark-{name}", image, tuple(marks[k, n]))
    return {
        name: [hands.placed(name, image) for image in NAMES]
        for name in (*where, *(f"landmark-{name}" for name in asked.landmark_names))
    }


def _look_closely(hands: Hands, placed: Placed) -> None:
    """Zoom with the wheel at the holes of each image, to look at the rims as found, and take the pointer away."""
    for k, image in enumerate(NAMES):
        uv = np.mean([placed[f"hole-{key}"][k] for key in KEYS], axis=0)
        hands.page.mouse.move(*hands.on_screen(image, (float(uv[0]), float(uv[1]))))
        hands.page.mouse.wheel(0.0, -850.0)
        hands.until(image, "!core.display.fitted")
    hands.page.mouse.move(5.0, 5.0)
    hands.page.wait_for_function("document.getAnimations().every(({ playState }) => playState === 'finished')")


def _written(places: list[list[tuple[float, float]]]) -> str:
    """Points by image: the first point's pixels in both images, then the next point's."""
    return " ".join(f"{image}:{','.join(repr(x) for at in places for x in at[k])}" for k, image in enumerate(NAMES))


def _by_command(placed: Placed, files: list[Path], case: Path) -> dict[str, Any]:
    """The plan of the command line on the same strokes and clicks."""
    given = ["--nail", "steel-10", "--nail-edges", _written([placed[spec.name] for spec in NAIL_EDGES])]
    for key in KEYS:
        given += ["--hole", f"{key} {_written([placed[f'hole-{key}']])}"]
    for name in (name for name in placed if name.startswith("landmark-")):
        given += ["--landmark", f"{name.removeprefix('landmark-')} {_written([placed[name]])}"]
    given += ["--frame", "block60", "--procedure", NAILED, "--side", "right", "--case", str(case), "--json"]
    ran = CliRunner().invoke(commands, ["plan", *map(str, files), *given])
    assert ran.exit_code == 0, ran.output
    return json.loads(ran.stdout)


async def _restarted(folder: Path, worker: WorkerProcess) -> dict[str, Any]:
    """Open the page's case again, keep the plans of both holes in it, and return them by wire."""
    planning = Session.open(folder, None, None, worker).planning
    await planning.start()
    while planning.nail.found is None:
        await asyncio.sleep(0.01)
    known = planning.planned
    assert known is not None and known.wires is not None and known.wires.verdict.state == "go"
    for _ in range(2):
        planning.keep_plan()  # once
    planning.case.close()
    return known.wires.document()["wires"]


def _asked(case: Path) -> list[Any]:
    """What the entries of both plans hold of strokes, clicks, sizes and landmarks."""
    with Case.open(case, read_only=True) as opened:
        entries = [entry.content for entry in opened.entries(Kind.PLANNED)]
    keys = (
        "nail",
        "entry_uv_px",
        "end_uv_px",
        "snapped",
        "others",
        "landmarks_uv_px",
        "landmark_names",
        "kind",
        "side",
    )
    return [{key: one["asked"][key] for key in keys} | {"hole": one["hole"]} for one in entries]


def test_holes_planned_by_mouse_are_those_of_the_command_line(
    serve: Callable[..., Server],
    open_page: Callable[..., Page],
    shoot: Callable[..., None],
    patient: RehearsedPatient,
    files: list[Path],
    tmp_path: Path,
) -> None:
    case = tmp_path / "page"
    command = ["sightline", "app", "--port", "{port}", "--no-browser", "--quiet", "--frame", "block60"]
    server = serve(*command, "--case", str(case))
    hands = Hands(open_page(server.url))
    hands.load(files)
    hands.step("Plan")
    _choose(hands, "kind", "Interlocking holes")
    expect(hands.see("instruction")).to_contain_text("Choose the nail on the right")
    _choose(hands, "nail", "Nail: 10 mm, steel")
    placed = _draw(hands, patient.asked(patient.generator("picks"), 0.5)[0])
    expect(hands.see("verdict")).to_contain_text("Every check passed")
    expect(hands.see("turns")).to_contain_text("PA orbit +")
    titles = "[...core.state.layers.values()].flatMap((one) => one.shapes).map((one) => one.title)"
    for image in NAMES:
        drawn = hands.core(image, titles)
        assert drawn.count("the nail's edge, as found in the image") == 2
        assert drawn.count("rim of the hole, as found in the image") == 4
    _look_closely(hands, placed)
    shoot(hands.page, "nail")
    for image in NAMES:
        hands.see(f"xray-{image}").get_by_role("button", name=XRAY["fit"], exact=True).click()
    errors = [hands.see("figures").inner_text()]

    _choose(hands, "nail", "Nail: 12 mm, titanium")  # which these images do not show
    expect(hands.see("verdict")).to_contain_text("INCOMPLETE")
    expect(hands.see("verdict")).to_contain_text("hole")
    expect(hands.see("continue")).to_be_disabled()
    hands.press("undo")
    expect(hands.see("verdict")).to_contain_text("Every check passed")
    hands.page.get_by_test_id("xray-pa").get_by_test_id("point-hole-distal").press("Delete")
    expect(hands.see("verdict")).to_contain_text("To do: Distal hole")
    hands.until("pa", "core.state.placing === value", "hole-distal")
    hands.page.get_by_test_id("xray-pa").get_by_role("application").press("Enter")  # the cross-hair is beside the nail
    expect(hands.see("verdict")).to_contain_text("Distal hole: ")
    for _ in range(2):
        hands.page.keyboard.press("Control+z")
    expect(hands.see("verdict")).to_contain_text("Every check passed")
    hands.step("Images")
    hands.press("side-left")
    hands.step("Plan")
    expect(hands.see("verdict")).to_contain_text("the holes are exchanged")
    hands.press("undo")
    expect(hands.see("verdict")).to_contain_text("Every check passed")
    hands.page.close()
    server.stop()

    made = _by_command(placed, files, tmp_path / "command")
    worker = WorkerProcess()
    with ThreadPoolExecutor(1) as pool:  # Playwright holds an event loop in this thread
        again = pool.submit(lambda: asyncio.run(_restarted(case, worker))).result()
    worker.close()
    for key in KEYS:
        one, other = again[key], made["wires"][key]
        assert one["trajectory"] == other["trajectory"] and one["hole"] == other["hole"]
    path = made["wires"]["distal"]["trajectory"]["error_95"]
    assert f"{path['entry_mm']:.2f} mm" in errors[0] and f"{path['end_mm']:.2f} mm" in errors[0]
    assert _asked(case) == _asked(tmp_path / "command")
    assert all("rim of the hole" in page.decode() for name, page in report_files(case).items() if name.endswith("html"))
    with Case.open(case, read_only=True) as opened:
        outcomes = {one.outcome for one in replay(opened)}
    assert outcomes <= {ReplayOutcome.SAME, ReplayOutcome.RECORDED} and ReplayOutcome.SAME in outcomes
