import csv
import io
import xml.etree.ElementTree as ET
from dataclasses import replace

import ezdxf
import numpy as np
import pytest
import trimesh

from sightline.errors import FrameError
from sightline.frame import Fiducial, Frame, FrameView, Plate, RigidBody
from sightline.frame.drawings.part import CHAMFER_MM, SCREW_MM, parts_of
from sightline.frame.drawings.sheet import plate_dxf, plate_svg
from sightline.frame.drawings.workshop import (
    FACETS,
    bill_csv,
    bill_page,
    bill_rows,
    drape_envelopes,
    inspection_csv,
    meshes_of,
    plate_mesh,
    solid_mesh,
    write_workshop,
)
from sightline.frame.measured.fit import Circumstances, fit_frame
from sightline.frame.tables import read_measurements

FRAMES = ("gamma", "stereo")
BLOCKS = ("block30", "cube120")
GAMMA = Frame.load("gamma")
DETECTOR = Frame.load("block40+detector-plate")


def changed(ball: int, **what) -> Frame:
    """The Γ frame with one ball of the PA XRII plate changed."""
    view = GAMMA.view("pa")
    balls = list(view.xrii.fiducials)
    balls[ball] = replace(balls[ball], **what)
    return replace(GAMMA, views={**GAMMA.views, "pa": replace(view, xrii=Plate(tuple(balls)))})


def filled(path, rows: list[dict]):
    """The inspection sheet with these rows, written."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.mark.parametrize("name", FRAMES)
def test_bores_put_the_balls_where_the_frame_has_them(name):
    """Sheet coordinates, rotated back by the sheet's stated axes, are the frame's, to the drawing's 0.001 mm."""
    frame = Frame.load(name)
    for part, (_, _, plate) in zip(parts_of(frame), frame.named_plates, strict=True):
        at = np.array([[b.x_mm, b.y_mm, part.thickness_mm - b.depth_mm + b.ball.diameter_mm / 2] for b in part.bores])
        true = np.array([b.ball.xyz_mm for b in part.bores])
        assert {b.ball.id for b in part.bores} == set(plate.ids)
        axes = np.array([_unit(text) for text in (part.right, part.up, part.front)])
        np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-12)
        np.testing.assert_allclose((at - at[0]) @ axes, true - true[0], atol=2e-3)
        np.testing.assert_allclose(at[:, 2], part.thickness_mm / 2, atol=1e-9)


def _unit(text: str) -> np.ndarray:
    if text[0] == "(":
        return np.array([float(x) for x in text.strip("()").split(",")])
    return np.eye(3)["XYZ".index(text[1])] * (1 if text[0] == "+" else -1)


@pytest.mark.parametrize("name", FRAMES)
def test_solids_are_closed_and_of_the_right_volume(name):
    circle = FACETS / 2 * np.sin(2 * np.pi / FACETS)  # area of the polygon in a unit circle
    parts = parts_of(Frame.load(name))
    meshes = meshes_of(parts)
    for part in parts:
        mesh = trimesh.load(io.BytesIO(meshes[f"{part.name}.stl"]), file_type="stl")
        mesh.merge_vertices()
        assert mesh.is_watertight
        bores = sum(circle * (b.ball.diameter_mm / 2) ** 2 * b.depth_mm for b in part.bores)
        screws = 4 * circle * (SCREW_MM / 2) ** 2 * part.thickness_mm
        sheet = (part.width_mm * part.height_mm - CHAMFER_MM**2 / 2) * part.thickness_mm
        assert mesh.volume == pytest.approx(sheet - bores - screws, rel=1e-5)
        np.testing.assert_allclose(mesh.bounds[1], (part.width_mm, part.height_mm, part.thickness_mm), atol=1e-4)


def test_a_solid_has_its_bores_where_they_are():
    """A point on the axis of a bore, half-way down, is outside; the same depth between bores is inside."""
    part = parts_of(GAMMA)[0]
    mesh = plate_mesh(part)
    areas = {}
    for bore in part.bores:
        floor = part.thickness_mm - bore.depth_mm
        centre = mesh.triangles_center
        near = np.linalg.norm(centre[:, :2] - (bore.x_mm, bore.y_mm), axis=1) < bore.ball.diameter_mm / 2
        on_floor = near & (np.abs(centre[:, 2] - floor) < 1e-9) & (mesh.face_normals[:, 2] > 0.5)
        areas[bore.number] = mesh.area_faces[on_floor].sum() / (np.pi * bore.ball.diameter_mm**2 / 4)
    np.testing.assert_allclose(list(areas.values()), FACETS / (2 * np.pi) * np.sin(2 * np.pi / FACETS), rtol=1e-9)


@pytest.mark.parametrize("name", FRAMES)
def test_dxf_holds_every_bore_at_its_true_diameter_in_mm(name):
    for part in parts_of(Frame.load(name)):
        document = ezdxf.read(io.StringIO(plate_dxf(part, name).decode()))
        assert not document.audit().errors
        assert (document.dxfversion, document.header["$INSUNITS"]) == ("AC1024", 4)
        found = {}
        for circle in document.modelspace().query('CIRCLE[layer=="BORES" | layer=="DATUM_BORES"]'):
            at = circle.dxf.center
            found[round(at.x, 3), round(at.y, 3)] = (2 * circle.dxf.radius, circle.dxf.layer == "DATUM_BORES")
        assert found == {(b.x_mm, b.y_mm): (b.ball.diameter_mm, b.ball.datum) for b in part.bores}
        said = {text.dxf.text for text in document.modelspace().query('TEXT[layer=="TABLE"]')}
        assert {b.ball.id for b in part.bores} <= said
        measured = sorted(d.get_measurement() for d in document.modelspace().query("DIMENSION"))
        assert measured == pytest.approx(sorted((part.width_mm, part.height_mm, part.thickness_mm)))
        notes = " ".join(text.dxf.text for text in document.modelspace().query('TEXT[layer=="NOTES"]'))
        for words in (
            f"{part.title}, frame {name}",
            f"looks to {part.front}",
            f"{len(part.bores)} blind bores",
            "0.08",
        ):
            assert words in notes


def test_svg_is_the_same_drawing_at_its_true_size_whatever_the_frame_is_called():
    part = parts_of(GAMMA)[0]
    root = ET.fromstring(plate_svg(part, 'a<b>&"c'))  # noqa: S314 - our own
    wide, high = (float(root.get(side).removesuffix("mm")) for side in ("width", "height"))
    assert part.width_mm + 150 < wide < part.width_mm + 230  # beside the plate: its side and the table
    assert part.height_mm + 60 < high < part.height_mm + 120  # above and below: title, dimension, notes
    box = [float(number) for number in root.get("viewBox").split()]
    assert box[2] / wide == pytest.approx(100, abs=1)
    assert len(list(root.iter("{http://www.w3.org/2000/svg}path"))) > len(part.bores)


def test_washers_get_a_pocket_and_large_balls_a_thicker_plate():
    washer = parts_of(changed(3, shape="washer", diameter_mm=6.0, datum=True))[0]
    bore = next(b for b in washer.bores if b.ball.shape == "washer")
    assert (bore.ball.diameter_mm, bore.depth_mm, washer.thickness_mm) == (6.0, 4.75, 8.0)
    plate_mesh(washer)
    thick = parts_of(changed(3, diameter_mm=8.0))[0]
    assert thick.thickness_mm == 11.0
    assert max(b.depth_mm for b in thick.bores) == 9.5


def test_a_ball_off_the_plane_is_bored_less_deep_and_one_far_off_is_refused():
    near = parts_of(changed(24, xyz_mm=(0.0, 0.0, 300.5)))[0]
    depth = {b.ball.id: b.depth_mm for b in near.bores}
    others = np.median([d for i, d in depth.items() if i != "pa-x-4-4"])
    assert others - depth["pa-x-4-4"] == pytest.approx(0.5, abs=0.02)  # the plane follows it a little
    with pytest.raises(FrameError, match="pa-x-4-4 lies"):
        parts_of(changed(24, xyz_mm=(0.0, 0.0, 305.0)))


def test_bores_that_would_break_into_each_other_are_refused():
    x, y, z = GAMMA.view("pa").xrii.fiducials[24].xyz_mm
    with pytest.raises(FrameError, match="at least 1 mm"):
        parts_of(changed(23, xyz_mm=(x + 3.9, y, z)))


@pytest.mark.parametrize("name", BLOCKS)
def test_the_bores_of_a_block_put_each_ball_where_the_frame_has_it(name):
    """A ball on the floor of its bore, placed by the face's directions as drawn, is at its place in the frame."""
    solid, parts = Frame.load(name).solid, parts_of(Frame.load(name))
    found = {}
    for part in parts:
        axes = np.array([_unit(text) for text in (part.right, part.up, part.front)])
        np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-12)
        for bore in part.bores:
            below = bore.ball.diameter_mm / 2 - bore.depth_mm
            found[bore.ball.id] = part.corner_mm + np.array([bore.x_mm, bore.y_mm, below]) @ axes
            assert bore.depth_mm == 3.5 + bore.ball.diameter_mm / 2
    np.testing.assert_allclose([found[i] for i in solid.ids], solid.xyz_mm, atol=1e-9)


@pytest.mark.parametrize("name", BLOCKS)
def test_the_mesh_of_a_block_is_closed_with_every_bore_open_to_its_face(name):
    parts = parts_of(Frame.load(name))
    mesh = trimesh.load(io.BytesIO(meshes_of(parts, clearance_mm=0.2)["solid.stl"]), file_type="stl")
    mesh.merge_vertices()
    assert mesh.is_watertight
    edges = np.ptp(Frame.load(name).solid.xyz_mm, axis=0) + 7
    np.testing.assert_allclose(mesh.bounds, [-edges / 2, edges / 2], atol=1e-4)
    circle = FACETS / 2 * np.sin(2 * np.pi / FACETS)
    bores = sum(circle * (b.ball.diameter_mm / 2 + 0.1) ** 2 * b.depth_mm for part in parts for b in part.bores)
    assert mesh.volume == pytest.approx(np.prod(edges) - bores, rel=1e-6)
    centres = np.array([b.ball.xyz_mm for part in parts for b in part.bores])
    outwards = np.array([part.axes[2] for part in parts for _ in part.bores])
    whole = solid_mesh(parts)
    assert not inside(whole, centres).any() and not inside(whole, centres + 3.4 * outwards).any()
    assert inside(whole, centres - 3 * outwards).all()


def test_the_mesh_of_a_measured_block_is_closed():
    """Coordinates of six decimals, none of which is a face's."""
    block = Frame.load("block30")
    off = np.random.default_rng(1).normal(0, 0.05, (12, 3))
    balls = zip(block.solid.fiducials, (block.solid.xyz_mm + off).round(6).tolist(), strict=True)
    moved = RigidBody(tuple(replace(f, xyz_mm=tuple(at)) for f, at in balls))
    assert solid_mesh(parts_of(replace(block, solid=moved))).volume == pytest.approx(30 * 30 * 50, rel=0.05)


def inside(mesh, points: np.ndarray) -> np.ndarray:
    """Whether points lie inside a closed mesh: the solid angle of its triangles is 4 pi or 0."""
    out = []
    for point in points:
        a, b, c = (mesh.triangles - point).swapaxes(0, 1)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        out.append(2 * np.arctan2((a * np.cross(b, c)).sum(1), below).sum() > 2 * np.pi)
    return np.array(out)


def test_a_solid_that_cannot_be_bored_is_refused_with_the_balls_names():
    """A ball behind another one under one face; two balls at an edge, bored from its two faces."""
    block = Frame.load("block60")
    balls = [replace(f, xyz_mm=(9.0, 16.0, 9.0)) if f.id == "b8" else f for f in block.solid.fiducials]
    with pytest.raises(FrameError, match=r"face \+Y: the wall between b8 and b11 is -3.00 mm"):
        parts_of(replace(block, solid=RigidBody(tuple(balls))))
    balls = [replace(f, xyz_mm=(26.5, 24.0, 21.0)) if f.id == "b8" else f for f in block.solid.fiducials]
    balls = [replace(f, xyz_mm=(24.0, 26.5, 20.0)) if f.id == "b11" else f for f in balls]
    with pytest.raises(FrameError, match=r"face \+X and face \+Y: the wall between b(8|11) and b(8|11)"):
        parts_of(replace(block, solid=RigidBody(tuple(balls))))


def test_a_block_folder_holds_its_faces_and_its_filled_sheet_is_read_back(tmp_path):
    block = Frame.load("block60")
    names = {file.name for file in write_workshop(block, tmp_path / "shop")}
    faces = {f"face{sign}{axis}.{kind}" for sign in "+-" for axis in "xyz" for kind in ("svg", "dxf", "csv")}
    rest = {"solid.stl", "assembly.png", "bill.md", "bill.csv", "inspection.csv", "frame.json"}
    assert names == faces | rest
    page = (tmp_path / "shop" / "bill.md").read_text()
    assert "60 x 60 x 60 mm" in page and "arms" not in page and "{" not in page
    rows = list(csv.DictReader(io.StringIO((tmp_path / "shop" / "inspection.csv").read_text())))
    assert len(rows) == 16 and {row["plate"] for row in rows} >= {"face+x", "face-z"}
    for row in rows:
        row.update({f"{axis}_mm": row[f"nominal_{axis}_mm"] for axis in "xyz"}, sd_mm="0.004")
    fitted = fit_frame(block, read_measurements(filled(tmp_path / "filled.csv", rows)), Circumstances())
    np.testing.assert_allclose(fitted.frame.solid.xyz_mm, block.solid.xyz_mm, atol=1e-6)


def test_an_empty_face_has_no_drawing(tmp_path):
    balls = [(20, 0, 10), (20, 15, -12), (20, -15, 0), (-20, 3, 14), (-20, 20, 0), (-20, -20, -20)]
    flat = tuple(Fiducial(f"k{n}", (float(x), float(y), float(z)), 3.0) for n, (x, y, z) in enumerate(balls))
    names = {file.name for file in write_workshop(Frame("flat", {}, solid=RigidBody(flat)), tmp_path / "shop")}
    assert {"face+x.svg", "face-x.svg", "solid.stl"} <= names
    assert not any(name.startswith(("face+y.", "face-z.")) for name in names)


def test_the_bill_counts_and_its_values_are_those_of_pmma():
    parts = parts_of(GAMMA)
    rows = {row["item"]: row for row in csv.DictReader(io.StringIO(bill_csv(parts).decode()))}
    assert rows["ball ø3 mm, fiducial"]["number"] == "202"
    assert rows["ball ø5 mm, datum marker"]["number"] == "24"
    page = bill_page(GAMMA, parts)
    assert "(162 mm) by 0.11 mm for 10 K" in page  # 162 x 70e-6 x 10
    assert "0.32 mm wider" in page  # 162 x 0.2 x 0.01
    assert "{" not in page


def test_covers_have_room_and_leave_the_patient_out():
    boxes = dict(drape_envelopes(GAMMA, parts_of(GAMMA)))
    np.testing.assert_allclose(boxes["pa, both plates"], (222.0, 222.0, 218.0))
    np.testing.assert_allclose(boxes["pa source plate"], (202.0, 202.0, 68.0))
    biplane = Frame.load("biplane")
    assert len(drape_envelopes(biplane, parts_of(biplane))) == 4


def test_the_inspection_sheet_filled_in_is_read_back(tmp_path):
    rows = list(csv.DictReader(io.StringIO(inspection_csv(GAMMA).decode())))
    rng = np.random.default_rng(1)
    for row in rows[2:]:
        for axis in "xyz":
            row[f"{axis}_mm"] = f"{float(row[f'nominal_{axis}_mm']) + 0.02 * rng.standard_normal():.4f}"
        row |= {"sd_mm": "0.004", "diameter_mm": row["nominal_diameter_mm"], "remark": "ok"}
    fitted = fit_frame(GAMMA, read_measurements(filled(tmp_path / "filled.csv", rows)), Circumstances())
    assert fitted.frame is not None
    assert fitted.missing == ("pa-x-1-1", "pa-x-1-2")
    with pytest.raises(FrameError, match="no measured ball"):
        (tmp_path / "empty.csv").write_bytes(inspection_csv(GAMMA))
        read_measurements(tmp_path / "empty.csv")


def test_a_folder_holds_it_all_and_an_own_frame_is_drawn_too(tmp_path):
    balls = [(-40.0, -30.5), (38.0, -36.0), (41.5, 33.0), (-35.0, 37.0), (4.5, 2.0)]

    def plate(name: str, z: float) -> Plate:
        return Plate(tuple(Fiducial(f"{name}{k}", (x, y, z), 4.0, k < 3) for k, (x, y) in enumerate(balls)))

    own = Frame("own", {"front": FrameView(plate("a", 200.0), plate("b", -120.0))})
    files = write_workshop(own, tmp_path / "shop")
    names = {file.name for file in files}
    assert names == {file.name for file in (tmp_path / "shop").glob("[!.]*")}
    assert {f"front-{role}.{kind}" for role in ("xrii", "source") for kind in ("svg", "dxf", "stl", "csv")} <= names
    assert [f.id for f in Frame.load(tmp_path / "shop" / "frame.json").fiducials] == [f.id for f in own.fiducials]


def test_the_workshop_gets_the_plate_too():
    parts = parts_of(DETECTOR)
    assert [part.name for part in parts if part.view is not None] == ["detector-plate"]
    assert len(parts[-1].bores) == 69
    assert {item for item, *_ in bill_rows(parts)} >= {"block", "plate detector-plate", "ball ø2 mm, fiducial"}
    assert len(inspection_csv(DETECTOR).splitlines()) == 1 + 14 + 69
    assert set(meshes_of(parts)) == {"detector-plate.stl", "solid.stl"}
