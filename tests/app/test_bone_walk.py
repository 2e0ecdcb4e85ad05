"""The bone's CT in a real browser: dropped, its landmarks clicked, registered, looked at and accepted."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from tests.app import program
from tests.app.browser import Server
from tests.app.eyes import wrong
from tests.app.hands import PATIENCE_MS, SEED, Hands, by_image, rehearsal
from tests.worked import Worked

from sightline.imaging.volumes.ct import write_ct
from sightline.twin.scenes.bone_ct import bone_ct

FILES = "drop-CT or mesh, and its landmarks"
OFF_PX = np.array([2.4, -1.7])  # of each click, 1 mm at the bone


@pytest.mark.slow  # a CT of the patient is drawn, and registered
def test_a_bone_is_dropped_clicked_registered_and_accepted(
    serve: Callable[..., Server], open_page: Callable[..., Page], tmp_path: Path, worked: Worked, shoot
) -> None:
    program.prepare(tmp_path, worked.demo)
    (tmp_path / "go").touch()
    command = ("tests.app.program", str(tmp_path), "app", "--port", "{port}", "--no-browser", "--quiet")
    server = serve(*command, "--case", str(tmp_path / "case"), "--rehearse", str(SEED))
    patient = rehearsal()
    scan, pose = bone_ct(patient.scene, patient.setup.side, np.random.default_rng(5))
    write_ct(scan, tmp_path / "bone.nrrd")
    at = {name: pose.inv().apply(xyz) for name, xyz in patient.hip.landmarks_mm.items()}
    rows = [f"{name},LPS,{x},{y},{z}" for name, (x, y, z) in at.items()]
    (tmp_path / "points.csv").write_text("\n".join(["name,coordinates,x_mm,y_mm,z_mm", *rows]))
    (tmp_path / "open.obj").write_text("v 0 0 0\nv 30 0 0\nv 0 30 0\nv 0 0 30\nf 1 3 2\nf 1 2 4\nf 1 4 3\n")

    hands = Hands(open_page(server.url, allow=("422",)))
    page = hands.page
    hands.wait_for_step("Calibrate", "done")
    hands.step("Calibrate")
    hands.see(FILES).set_input_files(tmp_path / "open.obj")
    expect(hands.see("drop-message").last).to_contain_text("open.obj: the mesh is not closed")
    hands.see(FILES).set_input_files([tmp_path / "bone.nrrd", tmp_path / "points.csv"])
    expect(hands.see("instruction")).to_contain_text("1 of 6", timeout=PATIENCE_MS)
    expect(hands.see("bone-register")).to_be_disabled()
    places = by_image({name: patient.landmarks[name] + OFF_PX for name in at})
    for k, (name, each) in enumerate(places.items()):
        for view, uv in each.items():
            hands.place(f"bone-{name}", view, uv)
        if k == 1:
            expect(hands.see("bone-register")).to_be_enabled()
            shoot(page, "bone-clicked")
            assert not wrong(page, scrolls=True)
    hands.press("bone-register")
    expect(hands.see("bone-working")).to_contain_text("Registering the bone")
    shoot(page, "bone-working")
    expect(hands.see("bone-found")).to_contain_text("95 % error", timeout=PATIENCE_MS)
    expect(hands.see("bone-judged")).to_contain_text("checks passed")
    for view in places["head centre"]:
        hands.until(view, "core.state.layers.get('bone').shapes.length > 5")
    shoot(page, "bone-found")
    assert not wrong(page, scrolls=True)
    hands.details()
    expect(hands.see("bone-checks").locator("li.passed").first).to_contain_text("bone fit")
    assert not wrong(page, scrolls=True)
    hands.details()
    hands.press("bone-accept")
    expect(hands.see("bone-accepted")).to_be_visible()
    page.reload()
    hands.step("Calibrate")
    expect(hands.see("bone-accepted")).to_be_visible()
