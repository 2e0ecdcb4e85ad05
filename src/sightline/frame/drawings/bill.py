"""Bill of material of a frame, notes on the material, and the inspection sheet of its balls."""

import csv
from collections import Counter
from collections.abc import Iterable, Sequence
from io import StringIO

import numpy as np

from sightline.frame.drawings.part import SIGMAS, Part, parts_of
from sightline.frame.model import Frame
from sightline.frame.tolerances import EXPANSION_PER_K, MOISTURE_EXPANSION

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
    return _csv(("item", "number", "material", "remark"), bill_rows(parts))


def holes_csv(part: Part) -> bytes:
    """Return the bores of one plate as CSV, for a machine tool."""
    head = ("no", "id", "x_mm", "y_mm", "diameter_mm", "upper_mm", "depth_mm", "position_tolerance_mm")
    return _csv(
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
    return _csv(SHEET_COLUMNS, rows)


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
    out = [(part.title, np.array([part.width_mm, part.height_mm, part.thickness_mm])) for part in parts]
    for name, view in frame.views.items():
        own = [part for part in parts if part.view == name]
        near, far = view.source.xyz_mm.mean(axis=0), view.xrii.xyz_mm.mean(axis=0)
        if near @ far > 0:
            length = np.linalg.norm(far - near) + max(part.thickness_mm for part in own)
            across = max(part.width_mm for part in own), max(part.height_mm for part in own)
            out.append((f"{name}, both plates", np.array([*across, length])))
    return [(name, box + 2 * DRAPE_CLEARANCE_MM) for name, box in out]


def _csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return text.getvalue().encode()


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
