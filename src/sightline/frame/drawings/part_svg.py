"""The workshop drawing of a plate or of a face: SVG, one A3 sheet, all coordinates in mm on paper."""

from collections.abc import Sequence
from html import escape

import numpy as np

from sightline.frame.drawings.part import SCREW_INSET_MM, SCREW_MM, WASHER_MM, Bore, Part

SHEET_MM = (420.0, 297.0)  # A3, ISO 216
_VIEW_AREA_MM = (193.0, 178.0)  # width available for front and side, and height
_ROWS, _ROW_MM = 50, 3.3  # of a column of the table
_COLUMNS = 2
_MAX_ORDINATES = 24  # [ours] more would overlap
_THIN, _THICK = 0.18, 0.5  # ISO 128 line widths
# ISO 5455 reductions.
_SCALES = (1.0, 0.5, 0.2, 0.1, 0.05)


def plate_svg(part: Part, frame: str) -> str:
    """Return the sheet of one plate or face of the frame called `frame`."""
    sheet = _Sheet()
    scale = next((s for s in _SCALES if _fits(part, s)), _SCALES[-1])
    _view(sheet, part, scale)
    _side(sheet, part, scale)
    _table(sheet, part)
    _details(sheet, part)
    _notes(sheet, part)
    _title(sheet, part, frame, scale)
    return sheet.text()


def _fits(part: Part, scale: float) -> bool:
    return (part.width_mm + part.thickness_mm) * scale <= _VIEW_AREA_MM[0] and part.height_mm * scale <= _VIEW_AREA_MM[
        1
    ]


class _Sheet:
    """SVG marks on a sheet; y runs down."""

    def __init__(self) -> None:
        self._marks: list[str] = []

    def line(self, *points: tuple[float, float], width: float = _THIN, dash: str = "", closed: bool = False) -> None:
        at = " ".join(f"{x:.3f},{y:.3f}" for x, y in points)
        kind = "polygon" if closed else "polyline"
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self._marks.append(f'<{kind} points="{at}" fill="none" stroke="#000" stroke-width="{width}"{dashed}/>')

    def circle(self, x: float, y: float, radius: float, *, width: float = _THIN, fill: str = "none") -> None:
        self._marks.append(
            f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{radius:.3f}" fill="{fill}" stroke="#000" stroke-width="{width}"/>'
        )

    def fill(self, *points: tuple[float, float]) -> None:
        at = " ".join(f"{x:.3f},{y:.3f}" for x, y in points)
        self._marks.append(f'<polygon points="{at}" fill="#000" stroke="none"/>')

    def say(  # noqa: PLR0917
        self, x: float, y: float, text: str, size: float = 2.5, anchor: str = "start", turned: bool = False,
        bold: bool = False,
    ) -> None:  # fmt: skip
        turn = f' transform="rotate(-90 {x:.3f} {y:.3f})"' if turned else ""
        weight = ' font-weight="bold"' if bold else ""
        self._marks.append(
            f'<text x="{x:.3f}" y="{y:.3f}" font-size="{size}" text-anchor="{anchor}"{weight}{turn}>'
            f"{escape(text)}</text>"
        )

    def across(self, x0: float, x1: float, y: float, text: str) -> None:
        """Draw a dimension line along x."""
        self.line((x0, y), (x1, y))
        self._arrows((x0, y), (x1, y), (1, 0))
        self.say((x0 + x1) / 2, y - 0.8, text, anchor="middle")

    def upright(self, x: float, y0: float, y1: float, text: str) -> None:
        """Draw a dimension line along y."""
        self.line((x, y0), (x, y1))
        self._arrows((x, min(y0, y1)), (x, max(y0, y1)), (0, 1))
        self.say(x - 0.8, (y0 + y1) / 2, text, anchor="middle", turned=True)

    def _arrows(self, first: tuple[float, float], second: tuple[float, float], way: tuple[int, int]) -> None:
        for (x, y), sign in ((first, 1), (second, -1)):
            a, b = way[0] * sign * 2.5, way[1] * sign * 2.5
            self.fill((x, y), (x + a + b / 7, y + b + a / 7), (x + a - b / 7, y + b - a / 7))

    def datum(self, x: float, y: float, letter: str) -> None:
        """Draw a datum's boxed letter (ISO 5459)."""
        self.line((x - 4, y - 2), (x, y - 2), (x, y + 2), (x - 4, y + 2), closed=True)
        self.say(x - 2, y + 0.9, letter, anchor="middle")

    def text(self) -> str:
        w, h = SHEET_MM
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:g}mm" height="{h:g}mm" viewBox="0 0 {w:g} {h:g}" '
            'font-family="DejaVu Sans, Arial, sans-serif">\n'
            f'<rect width="{w:g}" height="{h:g}" fill="#fff"/>\n'
            f'<rect x="10" y="10" width="{w - 20:g}" height="{h - 20:g}" fill="none" stroke="#000" '
            'stroke-width="0.7"/>\n' + "\n".join(self._marks) + "\n</svg>\n"
        )


def _corner(part: Part, scale: float) -> tuple[float, float]:
    """Return the datum corner's place on the sheet."""
    return 40.0, 22.0 + part.height_mm * scale


def _view(sheet: _Sheet, part: Part, scale: float) -> None:
    """Draw the front face, with ordinates from the datum corner where the bores form rows."""
    x0, y0 = _corner(part, scale)
    sheet.line(*((x0 + scale * x, y0 - scale * y) for x, y in part.outline), width=_THICK, closed=True)
    for x, y in part.screws:
        _hole(sheet, x0 + scale * x, y0 - scale * y, scale * SCREW_MM / 2, filled=False)
    for bore in part.bores:
        at = x0 + scale * bore.x_mm, y0 - scale * bore.y_mm
        _hole(sheet, *at, scale * bore.ball.diameter_mm / 2, filled=bore.ball.datum)
        reach = scale * bore.ball.diameter_mm / 2 + 0.5
        sheet.say(at[0] + 0.75 * reach, at[1] - 0.75 * reach, str(bore.number), size=1.9, bold=bore.ball.datum)
    right, top = x0 + scale * part.width_mm, y0 - scale * part.height_mm
    for value in _ordinates([bore.x_mm for bore in part.bores]):
        x = x0 + scale * value
        sheet.line((x, y0 + 1), (x, y0 + 5))
        sheet.say(x + 0.9, y0 + 13.5, f"{value:g}", anchor="start", turned=True)
    for value in _ordinates([bore.y_mm for bore in part.bores]):
        y = y0 - scale * value
        sheet.line((x0 - 1, y), (x0 - 5, y))
        sheet.say(x0 - 6, y + 0.9, f"{value:g}", anchor="end")
    sheet.line((x0 - 1, y0), (x0 - 5, y0))
    sheet.say(x0 - 6, y0 + 3.4, "0", anchor="end")
    sheet.say(x0 - 1.2, y0 + 13.5, "0", anchor="start", turned=True)
    sheet.line((x0, y0 + 1), (x0, y0 + 22))
    sheet.line((right, y0 + 1), (right, y0 + 22))
    sheet.across(x0, right, y0 + 20, f"{part.width_mm:g} ±0.1")
    sheet.line((x0 - 1, y0), (x0 - 22, y0))
    sheet.line((x0 - 1, top), (x0 - 22, top))
    sheet.upright(x0 - 19, y0, top, f"{part.height_mm:g} ±0.1")
    a, b = (
        _free([scale * at for at in along]) for along in ([b.x_mm for b in part.bores], [b.y_mm for b in part.bores])
    )
    sheet.fill((x0 + a - 2, y0), (x0 + a + 2, y0), (x0 + a, y0 + 2.8))
    sheet.datum(x0 + a + 2, y0 + 4.8, "A")
    sheet.fill((x0, y0 - b + 2), (x0, y0 - b - 2), (x0 - 2.8, y0 - b))
    sheet.datum(x0 - 2.8, y0 - b, "B")
    if part.chamfer_mm:
        sheet.say(right - 1, top - 1.5, f"{part.chamfer_mm:g} x 45°", anchor="end")
    arrow = x0 + 0.5 * scale * part.width_mm
    says = f"front face, looks to {part.front}; right {part.right}, up {part.up} of CFCS"
    sheet.say(arrow, top - 4.5, says, anchor="middle")


def _free(taken: Sequence[float]) -> float:
    """Return the place of a datum's letter along an edge, mm on paper from the corner, clear of the ordinates."""
    return next(at for at in np.arange(8.0, 500.0, 2.0).tolist() if all(abs(at - other) > 4 for other in taken))


def _ordinates(values: Sequence[float]) -> list[float]:
    """Return the coordinates of the bores' rows; none where they do not form rows."""
    found = sorted({round(value, 2) for value in values})
    return found if len(found) <= _MAX_ORDINATES else []


def _hole(sheet: _Sheet, x: float, y: float, radius: float, *, filled: bool) -> None:
    sheet.circle(x, y, radius, width=0.35, fill="#bbb" if filled else "none")
    cross = radius + 0.8
    sheet.line((x - cross, y), (x + cross, y), width=0.1)
    sheet.line((x, y - cross), (x, y + cross), width=0.1)


def _side(sheet: _Sheet, part: Part, scale: float) -> None:
    """Draw the part from its left, front face to the right (first-angle projection), with a line through its balls."""
    x0, y0 = _corner(part, scale)
    left, thick = x0 + scale * part.width_mm + 12, scale * part.thickness_mm
    top = y0 - scale * part.height_mm
    sheet.line((left, y0), (left + thick, y0), (left + thick, top), (left, top), width=_THICK, closed=True)
    first = part.bores[0]  # most balls of a part lie at one depth
    balls = left + thick - scale * (first.depth_mm - first.ball.diameter_mm / 2)
    sheet.line((balls, y0 + 2), (balls, top - 2), dash="4 1 0.8 1")
    sheet.line((left, y0 + 1), (left, y0 + 9))
    sheet.line((left + thick, y0 + 1), (left + thick, y0 + 9))
    sheet.across(left, left + thick, y0 + 7.5, f"{part.thickness_mm:g}")
    sheet.say(balls, top - 4, "balls", size=2, anchor="middle")
    sheet.fill((left + thick, y0 - 12), (left + thick, y0 - 16), (left + thick + 2.8, y0 - 14))
    sheet.datum(left + thick + 6.8, y0 - 14, "C")


def _table(sheet: _Sheet, part: Part) -> None:
    """Draw the table of bores; those that do not fit are in the CSV."""
    x0, y0, width = 258.0, 20.0, 72.0
    ends = (0.0, 8.0, 29.0, 41.0, 53.0, 62.0, width)
    rows = min(_ROWS, max(1, -(-len(part.bores) // _COLUMNS)))
    shown = part.bores[: _COLUMNS * rows]
    for column in range(-(-len(shown) // rows)):
        x, mine = x0 + column * (width + 3), shown[column * rows : (column + 1) * rows]
        titles = ("no.", "ball", "X", "Y", "ø H8", "depth")
        for row, cells in enumerate([titles, *map(_cells, mine)]):
            y = y0 + _ROW_MM * row
            sheet.line((x, y + 0.9), (x + width, y + 0.9), width=0.35 if row == 0 else 0.08)
            bold = row == 0 or mine[row - 1].ball.datum
            for cell, start, end in zip(cells, ends, ends[1:], strict=False):
                left = cell is cells[1]
                sheet.say(x + (start + 1 if left else end - 1), y, cell, 2.1, "start" if left else "end", bold=bold)
        bottom = y0 + _ROW_MM * len(mine) + 0.9
        for end in ends:
            sheet.line((x + end, y0 - 2.5), (x + end, bottom), width=0.08)
    if len(shown) < len(part.bores):
        sheet.say(
            x0, y0 + _ROW_MM * (rows + 1) + 1, f"bores {len(shown) + 1} to {len(part.bores)}: see {part.name}.csv"
        )


def _cells(bore: Bore) -> tuple[str, ...]:
    return (
        str(bore.number), bore.ball.id[:16], f"{bore.x_mm:.2f}", f"{bore.y_mm:.2f}",
        f"{bore.ball.diameter_mm:g}", f"{bore.depth_mm:.2f}",
    )  # fmt: skip


def _details(sheet: _Sheet, part: Part) -> None:
    """Draw an enlarged section through one bore of each kind."""
    kinds = {(b.ball.diameter_mm, b.ball.shape): b for b in reversed(part.bores)}
    _true_position(sheet, 209.0, 218.0, part)
    # Of a solid, only the material about the bores.
    height = min(part.thickness_mm, max(bore.depth_mm for bore in part.bores) + 2.0)
    scale, x, base = (4.0 if height <= 12 else 2.5 if height <= 20 else 1.0), 216.0, 272.0
    sheet.say(x - 6, base - scale * height - 10, f"sections through bores, {scale:g}:1", bold=True)
    for (diameter, shape), bore in sorted(kinds.items())[:2]:
        half = scale * diameter / 2
        left, right, top = x - half - 6, x + half + 6, base - scale * height
        floor = top + scale * bore.depth_mm
        sheet.line((left, base), (left, top), (x - half, top), (x - half, floor), (x + half, floor), (x + half, top),
                   (right, top), (right, base), width=_THICK)  # fmt: skip
        cut = height < part.thickness_mm
        sheet.line((left, base), (right, base), width=_THIN if cut else _THICK, dash="2 1" if cut else "")
        if shape == "ball":
            sheet.circle(x, floor - half, half, fill="#ddd")
        else:
            lid = floor - scale * WASHER_MM
            sheet.line((x - half, floor), (x + half, floor), (x + half, lid), (x - half, lid), closed=True)
        sheet.line((x, top - 3), (x, base + 2), dash="4 1 0.8 1")
        sheet.say(x, top - 4, f"ø{diameter:g} H8 (+{bore.upper_mm:g}/0)", anchor="middle")
        sheet.upright(right + 5, top, floor, f"{bore.depth_mm:g} ±0.02")
        sheet.line((right, top), (right + 7, top))
        sheet.line((x + half, floor), (right + 7, floor))
        x = right + 14 + 2.5 * scale + 6


def _true_position(sheet: _Sheet, x: float, y: float, part: Part) -> None:
    """Draw the tolerance frame of the bores (ISO 1101)."""
    sheet.say(x, y - 1.5, f"{len(part.bores)} bores, table")
    sheet.circle(x + 3, y + 3, 1.3)
    sheet.line((x + 0.8, y + 3), (x + 5.2, y + 3))
    sheet.line((x + 3, y + 0.8), (x + 3, y + 5.2))
    sheet.say(x + 13, y + 3.9, f"ø{2 * part.position_mm:g}", anchor="middle")
    for start, end, letter in ((0, 6, ""), (6, 20, ""), (20, 26, "C"), (26, 32, "A"), (32, 38, "B")):
        sheet.line((x + start, y), (x + end, y), (x + end, y + 6), (x + start, y + 6), closed=True)
        sheet.say(x + (start + end) / 2, y + 3.9, letter, anchor="middle")


def _notes(sheet: _Sheet, part: Part) -> None:
    kinds = sorted({(b.ball.diameter_mm, b.ball.datum, b.ball.shape) for b in part.bores})
    counts = ", ".join(
        f"{sum((b.ball.diameter_mm, b.ball.datum, b.ball.shape) == kind for b in part.bores)} x ø{kind[0]:g}"
        + (f" {kind[2]}s" if kind[2] == "washer" else "")
        + (" (datums, grey)" if kind[1] else "")
        for kind in kinds
    )
    where = "the plate's name beside the cut corner of the front face" if part.view else f"{part.front} on this face"
    lines = (
        f"1. {len(part.bores)} blind bores from the front face, flat-bottomed: {counts}.",
        f"2. Every bore within ø{2 * part.position_mm:g} of its true position, ±{part.position_mm:g} per axis.",
        "3. Flatness of C 0.1; A square to B within 0.05. Other dimensions ISO 2768-m.",
        f"4. 4 through holes ø{SCREW_MM:g}, {SCREW_INSET_MM:g} from the edges, nylon screws M5; no metal but balls."
        if part.screws
        else "4. No holes but these bores, and no metal but balls. Bore every face before balls are put in.",
        "5. Balls of stainless steel, grade G100 or better, pressed to the floor, bonded with a clear UV adhesive.",
        "6. Coordinates hold at 20 °C. PMMA expands by 70 ppm/K: measure at 20 ±1 °C, part stored dry for two days.",
        f"7. Engrave {where}. Do not wipe with alcohol: PMMA crazes.",
        "8. After bonding measure every ball (inspection.csv): sightline frame fit reads it.",
    )
    for row, line in enumerate(lines):
        sheet.say(15, 247 + 4.1 * row, line, size=2.4)


def _title(sheet: _Sheet, part: Part, frame: str, scale: float) -> None:
    """Draw the title block with the fields of ISO 7200."""
    right, bottom = SHEET_MM[0] - 10, SHEET_MM[1] - 10
    left, rows = right - 118, (bottom - 40, bottom - 27, bottom - 17, bottom - 8.5, bottom)
    sheet.line((left, rows[0]), (right, rows[0]), (right, bottom), (left, bottom), width=_THICK, closed=True)
    for y in rows[1:-1]:
        sheet.line((left, y), (right, y))
    for x in (left + 44, left + 80):
        sheet.line((x, rows[1]), (x, rows[-1]))
    size = "1:1" if scale == 1 else f"1:{1 / scale:g}"
    sheet.say(left + 2, rows[0] + 3.2, "part", size=1.8)
    sheet.say(left + 2, rows[0] + 9.8, f"{part.title}, frame {frame}", size=4.5, bold=True)
    fields = (
        (("material", f"PMMA, cast, {part.thickness_mm:g} mm"), ("scale", size), ("sheet", "A3, 1 of 1")),
        (("units", "mm"), ("projection", "first angle, ISO 5456"), ("general tolerances", "ISO 2768-mK")),
        (("drawn", ""), ("checked", ""), ("date", "")),
    )
    for y, row in zip(rows[1:], fields, strict=False):
        for x, (name, value) in zip((left, left + 44, left + 80), row, strict=True):
            sheet.say(x + 2, y + 2.6, name, size=1.8)
            sheet.say(x + 2, y + 6.6, value, size=2.7)
