"""Shaft and neck of the step Plan drawn by both borders, and fitted to the edges of its images: kept, undone, ended."""

import asyncio
import json
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from benchmarks.drawn_necks import neck_clicks
from playwright.sync_api import Page, expect
from tests.app.browser import Server
from tests.app.hands import Hands, Pixels
from tests.planning import bone

from sightline.app.plan.decisions import Decisions, FittedAxis, Mark
from sightline.app.plan.planner import drawn_axis, plan_input, planned
from sightline.app.session.session import Session
from sightline.app.session.worker import WorkerProcess
from sightline.case.views import NAMES
from sightline.errors import CaseError
from sightline.frame import Frame
from sightline.imaging import write_dicom
from sightline.planning import Line
from sightline.twin import HipScene, SetUp, render
from sightline.twin.anatomy.aids import drawn_aids
from sightline.twin.anatomy.bone_model import SphereAid
from sightline.twin.anatomy.femur import to_cfcs
from sightline.twin.scenes.hip_scene import shown_hip_scene

AXIS = ("shaft-1", "shaft-2")
BORDERS = tuple(f"shaft-border-{k}" for k in range(1, 5))
NECK, RIM = tuple(f"neck-border-{k}" for k in range(1, 5)), tuple(f"head-{k}" for k in range(1, 4))
WIDE_PX = 60.0


def _drawn() -> Decisions:
    """The wire, the shaft's axis, and clicks on its borders, in both images; borders are on."""
    decisions = Decisions(side="right", borders=True)
    uv = bone.pixels(bone.views())
    across = np.array([[-WIDE_PX, 0.0], [WIDE_PX, 0.0]])
    marks = {name: [each[k] for each in uv["wire"]] for k, name in enumerate(("entry", "end"))}
    marks |= {name: [each[k] + 3.0 for each in uv["shaft"]] for k, name in enumerate(AXIS)}
    marks |= {name: [each[k % 2] + across[k // 2] for each in uv["shaft"]] for k, name in enumerate(BORDERS)}
    for name, places in marks.items():
        at = {image: (float(u), float(v)) for image, (u, v) in zip(NAMES, places, strict=True)}
        decisions = decisions.with_mark(name, Mark(at))
    return decisions


def _fitted(decisions: Decisions) -> Decisions:
    """Fitted 1 px beside its drawing, in the PA image only."""
    drawn = drawn_axis(decisions, "shaft")
    assert drawn is not None and drawn[0].borders_px is not None
    moved = Line(drawn[0].uv_px + 1.0, drawn[0].sd_px, drawn[0].borders_px + 1.0, 0.7 * np.eye(4))
    return replace(decisions, fitted_shaft=FittedAxis.made((moved, drawn[1]), {"lateral": "no clear edge"}))


def test_an_axis_is_drawn_by_itself_or_by_both_borders_and_the_clicks_of_either_stay() -> None:
    """A program that takes two clicks on one border for the axis fails: they have other names."""
    decisions = _drawn()
    uv = bone.pixels(bone.views())["shaft"]
    by_borders = plan_input(decisions, 2).aids
    assert by_borders is not None and by_borders.shaft is not None
    for line, axis in zip(by_borders.shaft, uv, strict=True):
        assert line.borders_px is not None
        assert np.allclose(line.uv_px, axis)
    itself = plan_input(replace(decisions, borders=False), 2).aids
    assert itself is not None and itself.shaft is not None
    for line, axis in zip(itself.shaft, uv, strict=True):
        assert line.borders_px is None
        assert np.allclose(line.uv_px, axis + 3.0)
    assert drawn_axis(replace(decisions, borders=False), "shaft") is None
    left = decisions.with_mark(BORDERS[3], None)
    assert plan_input(left, 2).aids is not None and plan_input(left, 2).aids.shaft is None  # type: ignore[union-attr]
    asked = {spec.name for spec in decisions.specs}
    assert set(BORDERS) <= asked and not set(AXIS) & asked


def test_older_cases_draw_axes_themselves() -> None:
    document = _drawn().document()
    assert Decisions.of(document).borders
    del document["borders"], document["fitted_shaft"]
    assert not Decisions.of(document).borders and Decisions.of(document).fitted_shaft is None


def test_a_fit_comes_back_from_its_json_and_a_broken_one_is_refused() -> None:
    decisions = _fitted(_drawn())
    document = json.loads(json.dumps(decisions.document()))
    assert Decisions.of(document) == decisions
    document["fitted_shaft"]["lines"][0]["covariance_px2"] = [[1.0]]
    with pytest.raises(CaseError, match="cannot be read"):
        Decisions.of(document)
    document["fitted_shaft"] = {"lines": [{"uv_px": [[1.0, 2.0], [3.0, 4.0]]}] * 2, "kept": {}}
    with pytest.raises(CaseError, match="cannot be read"):
        Decisions.of(document)


def test_a_fit_ends_with_another_click_on_a_border_or_another_image_and_with_nothing_else() -> None:
    """A program that kept it would plan on a shaft that is not the one drawn, or not of this image."""
    decisions = _fitted(_drawn())
    assert decisions.with_mark(BORDERS[2], Mark({"pa": (1.0, 2.0)})).fitted_shaft is None
    assert decisions.with_mark(BORDERS[0], None).fitted_shaft is None
    assert decisions.with_image("lateral", 9, same_pixels=False).fitted_shaft is None
    assert decisions.with_image("lateral", 9, same_pixels=True).fitted_shaft is not None
    assert decisions.with_image("oblique", 9, same_pixels=False).fitted_shaft is not None
    for name in ("entry", "head-1", "neck-border-1", AXIS[0]):
        assert decisions.with_mark(name, Mark({"pa": (1.0, 2.0)})).fitted_shaft is not None


def test_the_verdicts_angle_takes_the_fitted_axis_and_its_error() -> None:
    """A program that kept the error of the clicks would state a quarter of it here."""
    before, after = (planned(one, bone.views()) for one in (_drawn(), _fitted(_drawn())))  # type: ignore[arg-type]
    angles = [next(one for one in each.metrics if one.name == "wire to shaft") for each in (before, after)]
    assert angles[0].value is not None and angles[1].value is not None
    assert angles[0].sd is not None and angles[1].sd is not None
    assert angles[1].value != angles[0].value
    assert angles[1].sd > 1.3 * angles[0].sd
    assert after.anatomy.shaft is not None and after.anatomy.shaft.direction_covariance_rad2 is not None
    assert planned(replace(_fitted(_drawn()), borders=False), bone.views()).fitted_axis("shaft") is None  # type: ignore[arg-type]


SIDE = "right"
BELOW_MM = (54.0, 82.0)  # of the drawn borders, caudal of where the axes of neck and shaft meet
CLICK_PX = 1.5


@cache
def _hip() -> tuple[SetUp, HipScene]:
    return shown_hip_scene(np.random.default_rng(97), Frame.load("block60"), SIDE)


def _clicks() -> dict[str, Pixels]:
    """Clicks on the wire, on both borders of the shaft below the lesser trochanter and of the neck, and on the rim."""
    setup, hip = _hip()
    rng, out = np.random.default_rng(98), {}
    for name, view in setup.views.items():
        source = to_cfcs(view.focal_point_mm - hip.head_mm, SIDE, np.zeros(3))
        at = []
        for way in (1.0, -1.0):
            for mm in BELOW_MM:
                on = hip.femur.base_mm + np.array([0.0, mm, 0.0])
                sideways = way * np.cross(on - source, [0.0, 1.0, 0.0])
                at.append(hip.femur.surface_mm(on, sideways / np.linalg.norm(sideways)))
        uv = view.project(np.vstack([hip.wire_mm, to_cfcs(np.array(at), SIDE, hip.head_mm)]))
        neck = to_cfcs(neck_clicks(hip.femur, source, rng).reshape(4, 3), SIDE, hip.head_mm)
        head = SphereAid(hip.head_mm, hip.femur.head_radius_mm)
        uv = np.vstack([uv, view.project(neck), drawn_aids({"head": head}, {name: view})["head"][name]])
        uv[2:] += CLICK_PX * rng.standard_normal((11, 2))
        for mark, pixel in zip(("entry", "end", *BORDERS, *NECK, *RIM), uv.tolist(), strict=True):
            out.setdefault(mark, {})[name] = (pixel[0], pixel[1])
    return out


def _load(folder: Path, worker: WorkerProcess) -> None:
    """Make a case of the hip's images in `folder / "case"`, with the wire placed."""
    setup, hip = _hip()
    rng = np.random.default_rng(99)
    files = {name: write_dicom(render(setup, name, hip.scene, rng), folder / f"{name}.dcm") for name in NAMES}

    async def work() -> None:
        session = Session.open(folder / "case", "block60", None, worker)
        for name in NAMES:
            assert await session.planning.take(files[name].read_bytes(), ".dcm", image=name) == name
        decisions, clicks = replace(session.planning.decisions, side=SIDE), _clicks()
        for name in ("entry", "end"):
            decisions = decisions.with_mark(name, Mark(clicks[name]))
        session.planning.edit(decisions)
        session.planning.case.close()

    asyncio.run(work())


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case with the hip's images."""
    folder, worker = tmp_path_factory.mktemp("shaft"), WorkerProcess()
    with ThreadPoolExecutor(1) as pool:  # Playwright holds an event loop in this thread
        pool.submit(_load, folder, worker).result()
    worker.close()
    return folder / "case"


@pytest.mark.slow
def test_the_page_fits_the_shaft_states_its_error_and_undoes_it(
    serve: Callable[..., Server], open_page: Callable[..., Page], prepared: Path, shoot
) -> None:
    """On a rendered hip: the angle of wire and shaft is that of the bone, within the error that the page states."""
    server = serve("sightline", "app", "--port", "{port}", "--no-browser", "--case", str(prepared), "--quiet")
    hands = Hands(open_page(server.url))
    hands.wait_for_step("Calibrate", "done")
    hands.step("Plan")
    expect(hands.see("fit-shaft")).to_have_count(0)  # an axis has no edge
    hands.details()
    hands.press("borders")
    hands.details()
    hands.press("fit-shaft")
    expect(hands.page.get_by_text("click two points on each border of the shaft")).to_be_visible()
    hands.aid("shaft", _clicks())
    expect(hands.see("row-shaft").locator(".placed")).to_have_count(2)
    hands.press("fit-shaft")
    expect(hands.see("shaft-fitted")).to_be_visible()
    shoot(hands.page, "shaft-fitted")
    words = hands.see("shaft-fitted").inner_text()
    assert "kept as drawn" not in words
    stated = re.search(r"± ([\d.]+)°, ± ([\d.]+) mm", words)
    assert stated, words
    assert 0.1 < float(stated[1]) < 3.0 and 0.1 < float(stated[2]) < 1.0
    hands.details()
    angle = hands.see("metrics").get_by_role("row").filter(has_text="wire to shaft").inner_text()
    value, error = re.search(r"([\d.]+) ± ([\d.]+)°", angle).groups()  # type: ignore[union-attr]
    assert abs(float(value) - 135.0) <= float(error) + 0.05  # as rounded; the ideal wire's
    hands.details()
    column = hands.page.locator(".step-box")
    assert column.evaluate("box => box.scrollHeight <= box.clientHeight")  # nothing scrolls at 1280 x 800
    hands.page.keyboard.press("Control+z")
    expect(hands.see("shaft-fitted")).to_have_count(0)
    hands.page.keyboard.press("Control+y")
    expect(hands.see("shaft-fitted")).to_have_text(words)
    hands.page.get_by_test_id("xray-pa").get_by_test_id("point-shaft-border-1").focus()
    hands.page.keyboard.press("ArrowRight")
    expect(hands.see("shaft-fitted")).to_have_count(0)
    hands.aid("neck", _clicks())
    hands.press("fit-neck")
    expect(hands.page.get_by_text("click three points on the head's rim")).to_be_visible()
    hands.aid("head", _clicks())
    hands.press("fit-head")
    expect(hands.see("head-fitted")).to_be_visible()
    hands.press("fit-neck")
    expect(hands.see("neck-fitted")).to_be_visible()
    shoot(hands.page, "neck-fitted")
    words = hands.see("neck-fitted").inner_text()  # a lateral image is taken along the neck, not across it
    assert re.search(
        r"± [\d.]+°, ± [\d.]+ mm.*Lateral image: kept as drawn; head and trochanter cover .* at \d+°", words
    )
    hands.page.keyboard.press("Control+z")
    expect(hands.see("neck-fitted")).to_have_count(0)
