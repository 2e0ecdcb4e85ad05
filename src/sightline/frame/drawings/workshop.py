"""The files that a workshop needs to make a frame: bill of material, inspection sheet, bores, and meshes (STL)."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import Delaunay
from trimesh import Trimesh
from trimesh.exchange.stl import export_stl

from sightline.common.atomic import whole_folder, write_files
from sightline.common.tables import csv_bytes
from sightline.errors import FrameError
from sightline.frame.drawings.part import SCREW_MM, SIGMAS, Part, parts_of
from sightline.frame.drawings.picture import frame_png
from sightline.frame.drawings.sheet import plate_dxf, plate_svg
from sightline.frame.model import Frame
from sightline.frame.tolerances import EXPANSION_PER_K, MOISTURE_EXPANSION


def write_workshop(frame: Frame, folder: str | Path, clearance_mm: float = 0.0) -> tuple[Path, ...]:
    """Write drawings (SVG, DXF), bores (CSV) and meshes (STL) of every part, bill, inspection sheet and frame file.

    `assembly.png` shows where the balls go. `clearance_mm` is added to the bores' diameters in the STL. Return the
    files written. Raises FrameError for a frame that cannot be made, UnusableInputError where the folder cannot be
    written.
    """
    parts = parts_of(frame)
    files: dict[str, bytes] = {
        "bill.md": bill_page(frame, parts).encode(),
        "bill.csv": bill_csv(parts),
        "inspection.csv": inspection_csv(frame),
        "assembly.png": frame_png(frame),
    }
    for part in parts:
        if part.bores:
            files[f"{part.name}.svg"] = plate_svg(part, frame.name).encode()
            files[f"{part.name}.dxf"] = plate_dxf(part, frame.name)
            files[f"{part.name}.csv"] = holes_csv(part)
    files |= meshes_of(parts, clearance_mm)
    with whole_folder(folder) as scratch:
        write_files(scratch, files)
        frame.save(scratch / "frame.json")
    return tuple(Path(folder) / name for name in sorted([*files, "frame.json"]))


DRAPE_CLEARANCE_MM = 30.0  # [ours] on all sides, so that no drape pulls on a plate
SHEET_COLUMNS = (
    "series", "id", "view", "plate", "nominal_x_mm", "nominal_y_mm", "nominal_z_mm", "tolerance_mm",
    "nominal_diameter_mm", "x_mm", "y_mm", "z_mm", "sd_mm", "diameter_mm", "remark",
)  # fmt: skip


def bill_rows(parts: Sequence[Part]) -> list[tuple[str, int, str, str]]:
    """Return (item, number, material, remark) of everything that is bought or made."""
    if parts[0].view is None:
        rows = [("block", 1, "PMMA, cast", f"{_edges(parts)} mm, bored from six faces, drawings face*.svg")]
    else:
        rows = []
    rows += [
        (
            f"plate {part.name}",
            1,
            f"PMMA, cast sheet, {part.thickness_mm:g} mm",
            f"{part.width_mm:g} x {part.height_mm:g} mm, {len(part.bores)} bores, drawing {part.name}.svg",
        )
        for part in parts
        if part.view is not None
    ]
    balls = Counter((b.ball.shape, b.ball.diameter_mm, b.ball.datum) for part in parts for b in part.bores)
    for (shape, diameter, datum), number in sorted(balls.items()):
        where = "datum marker" if datum else "fiducial"
        material = "stainless steel 1.4404 (AISI 316L)" + (", grade G100 (ISO 3290-1)" if shape == "ball" else "")
        rows.append((f"{shape} ø{diameter:g} mm, {where}", number, material, "10 % spare"))
    if screws := sum(len(part.screws) for part in parts):
        rows.append(("screw M5", screws, "polyamide", "no metal in the beam"))
    rows.append(("adhesive", 1, "clear, UV-curing, without metal or barium filler", "a drop on the floor of each bore"))
    return rows


def _edges(parts: Sequence[Part]) -> str:
    """Return the lengths of a block's edges along X, Y and Z."""
    across = next(part for part in parts if part.front == "+Z")
    return f"{across.width_mm:g} x {across.height_mm:g} x {across.thickness_mm:g}"


def bill_csv(parts: Sequence[Part]) -> bytes:
    """Return the bill of material as CSV."""
    return csv_bytes(("item", "number", "material", "remark"), bill_rows(parts))


def holes_csv(part: Part) -> bytes:
    """Return the bores of one plate as CSV, for a machine tool."""
    head = ("no", "id", "x_mm", "y_mm", "diameter_mm", "upper_mm", "depth_mm", "position_tolerance_mm")
    return csv_bytes(
        head,
        [
            (b.number, b.ball.id, b.x_mm, b.y_mm, b.ball.diameter_mm, b.upper_mm, b.depth_mm, part.position_mm)
            for b in part.bores
        ],
    )


def inspection_csv(frame: Frame) -> bytes:
    """Return the inspection sheet to be filled in, one row for each ball; `sightline frame fit` reads it."""
    tolerance = round(SIGMAS * frame.effective_tolerances.bead_mm, 3)
    balls = [(view, role, f) for view, role, plate in frame.named_plates for f in plate.fiducials]
    if frame.solid is not None:
        balls = [("", part.name, bore.ball) for part in parts_of(frame) for bore in part.bores]
    rows = [
        ("1", f.id, view, plate, *f.xyz_mm, tolerance, f.diameter_mm, "", "", "", "", "", "")
        for view, plate, f in balls
    ]
    return csv_bytes(SHEET_COLUMNS, rows)


def bill_page(frame: Frame, parts: Sequence[Part]) -> str:
    """Return the bill of material, with notes on the material for maker and user, as Markdown."""
    rows = "\n".join(
        f"| {item} | {number} | {material} | {remark} |" for item, number, material, remark in bill_rows(parts)
    )
    widest = max(max(part.width_mm, part.height_mm) for part in parts)
    sd = frame.effective_tolerances
    if frame.solid is None:
        envelopes = "\n".join(
            f"| {name} | {' x '.join(f'{mm:.0f}' for mm in box)} |" for name, box in drape_envelopes(frame, parts)
        )
        held = _ARMS.format(
            plate=sd.plate_mm,
            plate_mrad=1e3 * sd.plate_rad,
            arm=sd.arm_mm,
            arm_mrad=1e3 * sd.arm_rad,
            bead=sd.bead_mm,
        )
        drapes = _DRAPES.format(clearance=DRAPE_CLEARANCE_MM, envelopes=envelopes)
        whole, parts_named, measured = "widest plate", "plates", "Mount all plates, measure them"
    else:
        held, drapes = _BLOCK.format(bead=sd.bead_mm) + (_ON_DETECTOR if frame.detector is not None else ""), ""
        whole, parts_named, measured = "longest edge", "the block", "Measure all balls"
    return _PAGE.format(
        name=frame.name,
        rows=rows,
        held=held,
        drapes=drapes,
        whole=whole,
        parts=parts_named,
        measured=measured,
        ppm=1e6 * EXPANSION_PER_K,
        widest=widest,
        per_10_k=10 * EXPANSION_PER_K * widest,
        per_percent=0.01 * MOISTURE_EXPANSION * widest,
    )


def drape_envelopes(frame: Frame, parts: Sequence[Part]) -> list[tuple[str, np.ndarray]]:
    """Return (name, (width, height, length along the beam), mm) of each sterile cover.

    One for each plate, and one for both plates of a view where the patient does not lie between them.
    """
    boxes = [(part.title, np.array([part.width_mm, part.height_mm, part.thickness_mm])) for part in parts]
    for name, view in frame.views.items():
        own = [part for part in parts if part.view == name]
        near, far = view.source.xyz_mm.mean(axis=0), view.xrii.xyz_mm.mean(axis=0)
        if near @ far > 0:
            length = np.linalg.norm(far - near) + max(part.thickness_mm for part in own)
            across = max(part.width_mm for part in own), max(part.height_mm for part in own)
            boxes.append((f"{name}, both plates", np.array([*across, length])))
    return [(name, box + 2 * DRAPE_CLEARANCE_MM) for name, box in boxes]


_PAGE = """# Frame {name}: bill of material

| item | number | material | remark |
|---|---|---|---|
{rows}

{held}

## The material

- **Heat.** PMMA expands by {ppm:.0f} ppm/K: the {whole} ({widest:g} mm) by {per_10_k:.2f} mm for 10 K. Measure at
  the temperature of use, or give `sightline frame fit` both temperatures.
- **Water.** PMMA absorbs up to 2 % of its mass; 1 % makes the {whole} {per_percent:.2f} mm wider (moisture
  expansion). Keep {parts} dry, measure as it will be used, and again after a year.
- **Cleaning.** Mild soap and water, wiped dry. Alcohol makes PMMA craze at every bore; so do acetone and most solvents.
- **Sterilisation.** No steam: PMMA softens near 100 °C, an autoclave has 121 to 134 °C. No dry heat. Ethylene oxide
  (with aeration) or low-temperature hydrogen peroxide plasma are usual for PMMA; gamma radiation yellows it and makes
  it brittle. Validate the process with this frame, and measure the frame again afterwards. Where possible, use a
  sterile drape instead.

These values are typical of the material, not of your sheet: ask its manufacturer.

{drapes}## Inspection

`inspection.csv` has a row for each ball. {measured} in one set-up of the instrument, and fill in
`x_mm`, `y_mm`, `z_mm` (in any axes), `sd_mm` (the instrument's error) and `diameter_mm`. Add a second measurement below
as rows with another `series`. Then:

    sightline frame fit inspection.csv --frame frame.json --out measured.json
"""

_ARMS = """\
The arms that hold the plates are not part of the frame file. They must hold the plates where the file has them: plates
to {plate:g} mm and {plate_mrad:g} mrad on their arm, arms to {arm:g} mm and {arm_mrad:g} mrad, balls to {bead:g} mm in
their plate, one standard deviation each; and they must stay out of the beams."""

_BLOCK = """\
Each face has a drawing with its own datum corner; above it stand its directions in CFCS. `assembly.png` shows
which ball goes where. Balls to {bead:g} mm in the block, one standard deviation. A printed block (`solid.stl`) is less
exact: state its tolerance, or measure it.

Clamp or glue the block to what carries it, so that it stays where it is between the images. No metal but the balls."""

_ON_DETECTOR = """

The plate goes in front of the image intensifier's input, marked face towards the X-ray source: in the middle to 3 mm,
its balls 20 mm from the input, straight to 0.3°. There it may stay. Its place need not be known, only the same ball
errors hold for it as for the block."""

_DRAPES = """## Drapes

Loose sterile covers, with {clearance:g} mm of clearance on all sides, so that no weight hangs on a plate:

| cover for | width x height x length along the beam, mm |
|---|---|
{envelopes}

A wet drape of 10 N sags a plate by about as much as its tolerance. Clip drapes to the arms, never to the plates.

"""


FACETS = 48  # [ours] of a rim: the roundness error of a 3 mm bore is 0.003 mm
Surface = tuple[np.ndarray, np.ndarray]  # vertices (M, 3), mm; triangles (T, 3), counter-clockwise from outside


def plate_mesh(part: Part, clearance_mm: float = 0.0) -> Trimesh:
    """Return the plate in its drawing's coordinates, mm, with the bores in the front face, z = thickness.

    `clearance_mm` is added to the bores' diameters. Raises FrameError.
    """
    outline = np.array(part.outline)
    flat, triangles, hole = _triangulated(outline, [(x, y, SCREW_MM / 2) for x, y in part.screws])
    back = np.column_stack([flat, np.zeros(len(flat))]), triangles[hole < 0][:, ::-1]
    edges = [np.column_stack([outline, np.full(len(outline), z)]) for z in (part.thickness_mm, 0.0)]
    side = np.concatenate(edges), _walls(np.arange(len(outline)), len(outline))
    return _closed([_bored(part, clearance_mm), back, side], part.title)


def solid_mesh(faces: Sequence[Part], clearance_mm: float = 0.0) -> Trimesh:
    """Return the solid that has these six faces, CFCS, mm; `clearance_mm` is added to the bores' diameters.

    Raises FrameError.
    """
    surfaces = []
    for face in faces:
        xyz, triangles = _bored(face, clearance_mm)
        surfaces.append((face.corner_mm + (xyz - [0.0, 0.0, face.thickness_mm]) @ face.axes, triangles))
    return _closed(surfaces, "solid")


def meshes_of(parts: Sequence[Part], clearance_mm: float = 0.0) -> dict[str, bytes]:
    """Return the binary STL of each plate, and of the solid with these faces, by the name of its file."""
    faces = [part for part in parts if part.view is None]
    solid = {"solid.stl": export_stl(solid_mesh(faces, clearance_mm))} if faces else {}
    flat = [part for part in parts if part.view is not None]
    return solid | {f"{part.name}.stl": export_stl(plate_mesh(part, clearance_mm)) for part in flat}


def _bored(part: Part, clearance_mm: float) -> Surface:
    """Return the front face of a part, z = thickness, with its bores and the walls of its screw holes."""
    holes = [(b.x_mm, b.y_mm, (b.ball.diameter_mm + clearance_mm) / 2) for b in part.bores]
    holes += [(x, y, SCREW_MM / 2) for x, y in part.screws]
    floors = [part.thickness_mm - b.depth_mm for b in part.bores] + [0.0] * len(part.screws)
    flat, triangles, hole = _triangulated(np.array(part.outline), holes)
    n, m, blind = len(part.outline), len(flat), len(part.bores)
    top = np.column_stack([flat, np.full(m, part.thickness_mm)])
    below = top.copy()
    below[n:, 2] = np.repeat(floors, FACETS)
    faces = [triangles[hole < 0], triangles[(hole >= 0) & (hole < blind)] + m]
    faces += [_walls(n + FACETS * k + np.arange(FACETS)[::-1], m) for k in range(len(holes))]
    return np.concatenate([top, below]), np.concatenate(faces)


def _triangulated(
    outline: np.ndarray, circles: Sequence[tuple[float, float, float]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (M, 2) of outline and circles (x, y, radius), triangles (T, 3), and the circle of each, or -1."""
    angle = 2 * np.pi * np.arange(FACETS) / FACETS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    flat = np.concatenate([outline, *(np.array([x, y]) + radius * ring for x, y, radius in circles)])
    triangles = Delaunay(flat).simplices
    a, b, c = flat[triangles].swapaxes(0, 1)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    triangles = np.where(area[:, None] > 0, triangles, triangles[:, ::-1])
    # A triangle lies in the circle on which all its corners lie.
    owner = np.concatenate([np.full(len(outline), -1), np.repeat(np.arange(len(circles)), FACETS)])[triangles]
    return flat, triangles, np.where((owner == owner[:, :1]).all(axis=1), owner[:, 0], -1)


def _walls(loop: np.ndarray, m: int) -> np.ndarray:
    """Return (2K, 3): triangles of the walls from a loop on the top, with the solid on its left, to the loop below."""
    after = np.roll(loop, -1)
    return np.concatenate([np.column_stack([loop, loop + m, after + m]), np.column_stack([loop, after + m, after])])


def _closed(surfaces: Sequence[Surface], name: str) -> Trimesh:
    """Return the body within surfaces that share their edges. Raises FrameError where it is not closed."""
    starts = np.cumsum([0, *(len(xyz) for xyz, _ in surfaces)])
    triangles = np.concatenate([each + start for (_, each), start in zip(surfaces, starts, strict=False)])
    mesh = Trimesh(np.concatenate([xyz for xyz, _ in surfaces]), triangles, process=False)
    mesh.merge_vertices()
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        raise FrameError(f"the {name} does not give a closed surface; check for bores that touch")
    return mesh
