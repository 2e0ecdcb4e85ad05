"""The scene in space: what it is made of, computed here, and what a real browser does with it."""

from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2
from tests.app.browser import Server, Tab
from tests.app.space_page import GROUPS, HOSTILE

from sightline.app.drawing import space
from sightline.app.drawing.space import (
    CELL_MM,
    bone_objects,
    frame_objects,
    outer_surface,
    robot_objects,
    side_objects,
    view_objects,
    wire_objects,
)
from sightline.app.session.rehearsing import Patient
from sightline.frame import Frame
from sightline.imaging import Radiograph
from sightline.imaging.volumes.volume import Volume
from sightline.rehearsal.patient import NAILED
from sightline.rehearsal.rehearsal import Rehearsal
from sightline.robot.kinematics.designs import PITCH, YAW, nominal_manipulator, six_axis
from sightline.twin.anatomy.femur import Femur, voxelise


def of_kind(objects: list[dict], kind: str) -> list[dict]:
    return [one for one in objects if one["kind"] == kind]


@pytest.fixture(scope="module")
def gamma() -> Frame:
    return Frame.load("gamma")


def test_balls_have_their_true_place_and_size(gamma: Frame) -> None:
    balls = of_kind(frame_objects(gamma), "spheres")
    drawn = {(tuple(at), r) for ball in balls for at, r in zip(ball["at"], ball["radius"], strict=True)}
    true = {(f.xyz_mm, f.diameter_mm / 2) for view in gamma.views.values() for f in view.fiducials}
    assert drawn == true


def test_ellipsoids_hold_95_percent() -> None:
    rng = np.random.default_rng(3)
    factor = rng.normal(0.0, 0.1, (6, 6))
    joint = factor @ factor.T
    points = SimpleNamespace(covariance_mm2=np.stack([joint[:3, :3], joint[3:, 3:]]))
    entry, tip = np.array([31.3, 28.9, -9.7]), np.array([-30.1, -27.7, 8.3])
    path = SimpleNamespace(points=points, entry_mm=entry, end_mm=tip, error_stated=True)
    objects = wire_objects(path, 2.5)  # type: ignore[arg-type]
    assert of_kind(objects, "cylinder")[0]["radius"] == 1.25
    times = float(of_kind(objects, "note")[0]["text"].rpartition(", ")[2].split()[0])
    for one, part in zip(of_kind(objects, "ellipsoid"), (factor[:3], factor[3:]), strict=True):
        axes = np.array(one["axes"]) / times
        held = np.linalg.norm(rng.normal(size=(20000, 6)) @ part.T @ np.linalg.inv(axes), axis=1) < 1
        assert abs(held.mean() - 0.95) < 0.005  # 3 s.d. of a share of 20,000
        np.testing.assert_allclose(axes.T @ axes, chi2.ppf(0.95, 3) * part @ part.T, atol=1e-3)  # rounded for the page
    path.error_stated = False
    unknown = wire_objects(path, 2.5)  # type: ignore[arg-type]
    assert not of_kind(unknown, "ellipsoid") and "unknown" in of_kind(unknown, "note")[0]["text"]


def test_an_image_falls_where_its_pixels_are_seen(gamma: Frame) -> None:
    plate = gamma.view("lateral").xrii
    focus = np.array([-620.0, 13.0, -7.0])

    def project_seen(xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        uv = xyz_mm[:, [1, 2]] * [2.0, -2.0] + [100.0, 250.0]
        seen = uv[:, 1] > 150.0
        return uv[seen], seen

    view = SimpleNamespace(name="lateral", focal_point_mm=focus, project_seen=project_seen)
    image = Radiograph(np.tile(np.arange(300, dtype=np.uint16), (500, 1)), 4095.0)
    [picture] = of_kind(view_objects(view, plate, image), "picture")  # type: ignore[arg-type]
    nodes, triangles = np.array(picture["vertices"]), np.array(picture["triangles"])
    used = np.unique(triangles)
    uv = np.array(picture["uv"])[used] * [300, 500] - 0.5
    np.testing.assert_allclose(uv, nodes[used][:, [1, 2]] * [2.0, -2.0] + [100.0, 250.0], atol=0.05)  # rounding
    assert (uv[:, 1] > 150.0).all() and (uv >= -0.5).all() and (uv[:, 0] <= 299.5).all()
    a, b, c = np.moveaxis(nodes[triangles], 1, 0)
    assert (np.cross(b - a, c - a) @ [1.0, 0.0, 0.0] < 0).all()  # it faces the source, which is at -X
    assert (picture["image"]["width"], picture["image"]["height"]) == (154, 256)


def test_the_robot_stands_where_its_joints_are() -> None:
    robot, q = nominal_manipulator(), np.array([21.3, -33.1, 0.0, 0.0, 71.7])
    q[YAW], q[PITCH] = 0.61, -0.23
    T_mcs_cfcs = RigidTransform.from_exp_coords([0.1, -0.2, 2.9, 480.0, -40.0, 380.0])
    wire = next(one for one in robot_objects(robot, q, T_mcs_cfcs) if one["style"] == "tool")
    tool = T_mcs_cfcs.inv() * robot.T_mcs_tool(q)
    np.testing.assert_allclose(wire["to"], tool.translation, atol=0.006)  # rounded to 0.01
    behind = np.array(wire["from"]) - wire["to"]
    np.testing.assert_allclose(behind / np.linalg.norm(behind), -tool.apply([0, 0, 1]) + tool.translation, atol=1e-4)
    assert np.linalg.norm(behind) == pytest.approx(200.0, abs=0.02)


def test_an_arm_is_drawn_in_one_piece_from_its_base_to_the_mouth_of_the_guide_that_it_holds() -> None:
    """Upper arm and forearm of this one lie beside the lines between their joints: by 138 and 7 mm."""
    robot, q = six_axis(), np.array([0.3, -1.9, -2.1, -2.3, -1.2, 0.4])
    T_mcs_cfcs = RigidTransform.from_exp_coords([0.1, -0.2, 2.9, 480.0, -40.0, 380.0])
    drawn = robot_objects(robot, q, T_mcs_cfcs)
    bodies = of_kind(drawn, "cylinder")
    mouth, behind = robot.T_mcs_tool(q).apply([[0.0, 0.0, 0.0], [0.0, 0.0, -120.0]])
    [guide] = [one for one in bodies if one["style"] == "tool"]
    np.testing.assert_allclose([guide["to"], guide["from"]], T_mcs_cfcs.inv().apply([mouth, behind]), atol=0.006)
    ends = [np.array([one["from"], one["to"]]) for one in bodies]
    reached, left = [T_mcs_cfcs.inv().translation], list(range(len(ends)))
    while left:
        near = [k for k in left if np.linalg.norm(ends[k][:, None] - np.array(reached), axis=-1).min() < 8.0]
        assert near  # forearm and wrist meet within 7 mm
        reached += [at for k in near for at in ends[k]]
        left = [k for k in left if k not in near]
    lengths = sorted(np.linalg.norm(end[1] - end[0]) for end in ends)
    assert lengths[-4:] == pytest.approx([138.0, 162.5, 392.2, 425.0], abs=0.03)


@pytest.mark.parametrize(("side", "sign"), [("right", 1), ("left", -1)])
def test_the_words_of_the_sides(side: str, sign: int) -> None:
    words = {one["text"]: np.array(one["at"]) for one in of_kind(side_objects(side, np.zeros(3)), "label")}
    assert words["caudal"][1] * sign > 0 > words["cranial"][1] * sign
    assert words["anterior"][2] > 0 and words["lateral"][0] > 0
    unknown = {one["text"] for one in of_kind(side_objects(None, np.zeros(3)), "label")}
    assert unknown == {"anterior", "posterior", "lateral", "medial"}


def enclosed_mm3(vertices: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_the_surface_of_a_hollow_ball_is_its_outer_one() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(64.0)] * 3, indexing="ij"), axis=-1)
    radius = np.linalg.norm(grid - [31.3, 30.7, 32.1], axis=-1)
    shell = ((radius < 24) & (radius > 20)).astype(np.float32)
    turn = RigidTransform.from_exp_coords([0.3, -0.2, 0.5, 0, 0, 0]).rotation.as_matrix()
    volume = Volume(shell, np.array([5.0, -7.0, 11.0]), np.full(3, 1.0), turn)
    vertices, triangles = outer_surface(volume)
    centre = np.array([5.0, -7.0, 11.0]) + np.array([31.3, 30.7, 32.1]) @ turn
    distance = np.linalg.norm(vertices - centre, axis=1)
    assert abs(distance.mean() - 24) < 1.0 and np.ptp(distance) < CELL_MM
    assert enclosed_mm3(vertices, triangles) > 0  # facing outwards
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    forth, back = ({tuple(edge) for edge in way} for way in (edges.tolist(), edges[:, ::-1].tolist()))
    assert forth == back  # closed


def test_a_femur_is_light_enough_to_send() -> None:
    femur = Femur(socket=False)
    [mesh] = bone_objects(voxelise(femur, "left", np.array([3.0, -4.0, 5.0]), None))  # a mirrored one
    vertices, triangles = np.array(mesh["vertices"]), np.array(mesh["triangles"])
    assert 2000 < len(triangles) < 20000
    head = np.linalg.norm(vertices - [3.0, -4.0, 5.0], axis=1)
    assert abs(np.percentile(head, 1) - femur.head_radius_mm) < CELL_MM
    assert enclosed_mm3(vertices, triangles) > 0


def test_a_bone_with_a_nail_is_shown_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails for a scene that asks every patient for a hip."""
    patient = Patient(2, procedure=NAILED)
    grid = np.linalg.norm(np.indices((24, 24, 24)) - 11.7, axis=0)
    volume = Volume((grid < 8.0).astype(np.float32), np.zeros(3), np.full(3, 3.0))
    rehearsed = Rehearsal(2, None, SimpleNamespace(bone=SimpleNamespace(volumes=(volume,))), NAILED)  # type: ignore[arg-type]
    monkeypatch.setattr(space, "rehearsal_of", lambda _: rehearsed)
    assert [one["kind"] for one in space.rehearsed_bone(patient)] == ["mesh"]


@pytest.fixture(scope="module")
def tab(browser: Browser, serve: Callable[..., Server]) -> Iterator[Tab]:
    """One page for all tests, in their order; no graphics card: fewer pixels, less time."""
    made = Tab(browser, serve("tests.app.space_page", "{port}").url, viewport={"width": 900, "height": 560})
    made.page.wait_for_function(
        "window.sightlineSpace?.groups.size === 7 && !sightlineSpace.asked && sightlineSpace.renders"
    )
    yield made
    made.close()


@pytest.fixture
def page(tab: Tab) -> Iterator[Page]:
    yield tab.page
    tab.check()


def ask(page: Page, expression: str) -> object:
    return page.evaluate(f"(() => {{ const core = window.sightlineSpace; return {expression}; }})()")


def settle(page: Page) -> None:
    page.wait_for_function("!sightlineSpace.asked")


def test_it_opens_on_wire_and_bone(page: Page) -> None:
    """Fails for a view of the whole frame, in which the wire is a dot, or behind it."""
    settle(page)
    assert ask(page, "['frame', 'views', 'bone', 'wire'].map((name) => core.groups.get(name).visible)") == [
        *(False, False),
        *(True, True),
    ]
    ends = ask(
        page,
        "core.objects.wire.filter(({ kind, style }) => kind === 'cylinder' && style === 'wire')"
        ".flatMap(({ from, to }) => [core.toScreen(from), core.toScreen(to)])",
    )
    assert np.linalg.norm(np.subtract(*ends)) > 0.3 * 560.0  # type: ignore[arg-type, misc]


def test_it_draws_when_something_changes_and_not_otherwise(page: Page) -> None:
    before = ask(page, "core.renders")
    page.evaluate(  # thirty frames of the page
        """new Promise((done) => {
            let left = 30;
            const next = () => (left-- ? requestAnimationFrame(next) : done());
            next();
        })"""
    )
    assert ask(page, "core.renders") == before
    ask(page, "[1, 2, 3].map(() => core.look('side')) && null")
    settle(page)
    assert ask(page, "core.renders") == before + 1


def test_words_from_outside_stay_words(page: Page) -> None:
    expect(page.locator(".space-label", has_text="onerror")).to_have_text(HOSTILE)
    assert page.locator(".space-label img").count() == 0
    assert page.evaluate("window.hacked") is None


def test_labels_do_not_cover_each_other(page: Page) -> None:
    boxes = [label.bounding_box() for label in page.locator(".space-label").all() if label.is_visible()]
    assert len(boxes) > 5
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            assert a is not None and b is not None
            apart = abs(a["y"] - b["y"]) >= min(a["height"], b["height"]) - 1
            assert apart or a["x"] + a["width"] <= b["x"] + 1 or b["x"] + b["width"] <= a["x"] + 1


def test_views_keys_and_pointer_move_the_camera(page: Page) -> None:
    def towards_viewer() -> np.ndarray:
        settle(page)
        return np.array(ask(page, "core.camera.position.clone().sub(core.controls.target).normalize().toArray()"))

    for where, direction in (("side", [1, 0, 0]), ("above", [0, 0, 1]), ("feet", [0, 1, 0])):  # a right hip's feet: +Y
        page.get_by_test_id(f"space-look-{where}").click()
        np.testing.assert_allclose(towards_viewer(), direction, atol=0.01)
    canvas = page.locator(".space canvas")
    canvas.focus()
    page.keyboard.press("ArrowRight")
    turned = np.arctan2(towards_viewer()[0], towards_viewer()[1])
    assert abs(abs(turned) - np.deg2rad(5)) < 1e-3
    distance = ask(page, "core.camera.position.distanceTo(core.controls.target)")
    page.keyboard.press("+")
    assert ask(page, "core.camera.position.distanceTo(core.controls.target)") == pytest.approx(distance / 1.15)  # type: ignore[operator]
    before, box = towards_viewer(), canvas.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 300, box["y"] + 300)
    page.mouse.down()
    page.mouse.move(box["x"] + 400, box["y"] + 260, steps=4)
    page.mouse.up()
    assert np.linalg.norm(towards_viewer() - before) > 0.1


def test_everything_is_there_and_can_be_hidden(page: Page) -> None:
    assert ask(page, "[...core.groups.keys()].sort()") == sorted(GROUPS)
    assert ask(page, "core.groups.get('bone').children[0].geometry.index.count / 3") > 2000  # type: ignore[operator]
    assert ask(page, "core.renderer.getContext().getError()") == 0
    button = page.get_by_test_id("space-show-bone")
    expect(button).to_have_attribute("aria-pressed", "true")
    button.click()
    expect(button).to_have_attribute("aria-pressed", "false")
    expect(button).to_be_focused()
    assert ask(page, "core.groups.get('bone').visible") is False
    expect(page.locator(".space-notes")).to_contain_text("95 %")
    page.get_by_test_id("space-show-wire").click()
    expect(page.locator(".space-notes")).to_have_text("")


def test_a_changed_group_replaces_what_was_there(page: Page) -> None:
    count = "core.groups.get('rays').children.map((one) => one.geometry.attributes.position.count)"
    assert ask(page, count) == [4, 4]  # two picks a view, two ends a line
    page.get_by_test_id("one-pick").click()
    page.wait_for_function("sightlineSpace.objects.rays[0].lines.length === 1")
    assert ask(page, count) == [2, 2]
    page.get_by_test_id("fewer").click()
    expect(page.get_by_test_id("space-show-rays")).to_have_count(0)
    expect(page.locator(".space-label")).to_have_count(0)  # not left behind in the page
    expect(page.get_by_test_id("space-show-frame")).to_be_visible()


def test_without_webgl_it_says_so(page: Page) -> None:
    said = page.evaluate(
        """async (texts) => {
            HTMLCanvasElement.prototype.getContext = () => null;
            console.error = () => {}; // three.js complains, as it should
            const { SpaceCore } = await import("space");
            const box = document.createElement("div");
            const core = new SpaceCore(box, { label: "x", groups: {}, texts });
            core.update("frame", [{ kind: "label", at: [0, 0, 0], text: "x" }]);
            core.orient("right"); core.look("side"); core.fit("hip"); core.show("frame", false);
            const words = box.textContent;
            core.destroy();
            return words;
        }""",
        {"none": "no 3-D here"},
    )
    assert said == "no 3-D here"
