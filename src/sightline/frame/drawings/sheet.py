"""The drawing of a plate or a face, 1:1 in mm, origin at the datum corner: DXF R2010 for machines, SVG for people."""

from collections import Counter
from collections.abc import Sequence
from io import StringIO

from ezdxf.addons.drawing.config import BackgroundPolicy, Configuration
from ezdxf.addons.drawing.frontend import Frontend
from ezdxf.addons.drawing.layout import Margins, Page, Settings, Units
from ezdxf.addons.drawing.properties import RenderContext
from ezdxf.addons.drawing.svg import SVGBackend
from ezdxf.document import Drawing
from ezdxf.enums import TextEntityAlignment
from ezdxf.filemanagement import new
from ezdxf.fonts import fonts
from ezdxf.layouts.layout import Modelspace
from ezdxf.units import MM
from matplotlib import get_data_path

from sightline.frame.drawings.part import SCREW_INSET_MM, SCREW_MM, Part

# Layer: colour of the AutoCAD index, width of its lines in 0.01 mm (ISO 128).
LAYERS = {
    "OUTLINE": (7, 50), "BORES": (5, 25), "DATUM_BORES": (1, 25), "SCREWS": (34, 25), "NUMBERS": (7, 13),
    "DIMENSIONS": (7, 13), "DATUMS": (7, 25), "TABLE": (7, 13), "NOTES": (7, 13),
}  # fmt: skip
_ROW_MM, _TEXT_MM, _TITLE_MM, _GAP_MM = 4.0, 2.2, 4.0, 30.0
_COLUMNS_MM = (0.0, 8.0, 50.0, 67.0, 84.0, 108.0)
_TABLE_MM = 125.0  # width of one column of the table
_MIN_ROWS = 50  # of a column of the table: a plate of 160 mm with its notes is as high
_HEADS = ("no.", "ball", "X", "Y", "diameter H8", "depth")
_FONT = "DejaVuSans.ttf"  # matplotlib brings it
_SVG_STEPS_PER_MM = 100  # resolution of the SVG's coordinates


def plate_dxf(part: Part, frame: str) -> bytes:
    """Return the drawing of one plate or face of the frame called `frame`, as DXF."""
    stream = StringIO()
    _drawing(part, frame).write(stream)
    return stream.getvalue().encode()


def plate_svg(part: Part, frame: str) -> str:
    """Return the same drawing as SVG; text is drawn as outlines, so that it looks the same everywhere."""
    document = _drawing(part, frame)
    backend = SVGBackend()
    config = Configuration(background_policy=BackgroundPolicy.WHITE)
    Frontend(RenderContext(document), backend, config=config).draw_layout(document.modelspace())
    page = Page(0, 0, Units.mm, Margins.all(10))  # as large as the drawing
    box = backend.player().bbox()
    steps = _SVG_STEPS_PER_MM * (max(box.size.x, box.size.y) + 20)
    return backend.get_string(page, settings=Settings(fit_page=False, output_coordinate_space=steps))


def _drawing(part: Part, frame: str) -> Drawing:
    document = new("R2010", setup=["linetypes", "dimstyles"], units=MM)
    document.styles.get("Standard").dxf.font = _FONT
    if not fonts.font_manager.has_font(_FONT):
        fonts.font_manager.build([f"{get_data_path()}/fonts/ttf"])
    for name, (colour, width) in LAYERS.items():
        document.layers.add(name, color=colour, lineweight=width)
    space = document.modelspace()
    _front(space, part)
    _side(space, part)
    _table(space, part)
    top = part.height_mm + 20
    _text(space, "NOTES", (0, top), f"{part.title}, frame {frame}", _TITLE_MM)
    facts = f"PMMA, cast, {part.thickness_mm:g} mm. All sizes in mm, scale 1:1, ISO 2768-mK, first-angle projection."
    _text(space, "NOTES", (0, top - 2 * _TEXT_MM), facts)
    looks = f"Front face, looks to {part.front}; right {part.right}, up {part.up} of CFCS. Datums: A, B edges; C front"
    _text(space, "NOTES", (0, top - 4 * _TEXT_MM), looks)
    for row, line in enumerate(_notes(part)):
        _text(space, "NOTES", (0, -30 - _ROW_MM * row), line)
    return document


def _text(
    space: Modelspace, layer: str, at: tuple[float, float], text: str, height: float = _TEXT_MM, *, middle: bool = False
) -> None:
    entity = space.add_text(text, height=height, dxfattribs={"layer": layer})
    entity.set_placement(at, align=TextEntityAlignment.MIDDLE_CENTER if middle else TextEntityAlignment.LEFT)


def _dimension(
    space: Modelspace, start: tuple[float, float], end: tuple[float, float], base: tuple[float, float], angle: float
) -> None:
    look = {"dimtxt": 3.0, "dimasz": 2.5, "dimexe": 1.5, "dimexo": 1.0, "dimgap": 1.0, "dimscale": 1.0, "dimlfac": 1.0}
    space.add_linear_dim(base, start, end, angle=angle, override=look, dxfattribs={"layer": "DIMENSIONS"}).render()


def _datum(space: Modelspace, at: tuple[float, float], letter: str) -> None:
    """Draw a datum's boxed letter (ISO 5459)."""
    x, y = at
    box = ((x - 2.5, y - 2.5), (x + 2.5, y - 2.5), (x + 2.5, y + 2.5), (x - 2.5, y + 2.5))
    space.add_lwpolyline(box, close=True, dxfattribs={"layer": "DATUMS"})
    _text(space, "DATUMS", at, letter, 3.0, middle=True)


def _front(space: Modelspace, part: Part) -> None:
    """Draw the front face with its numbered bores and its dimensions."""
    space.add_lwpolyline(part.outline, close=True, dxfattribs={"layer": "OUTLINE"})
    for at in part.screws:
        space.add_circle(at, SCREW_MM / 2, dxfattribs={"layer": "SCREWS"})
    for bore in part.bores:
        radius, layer = bore.ball.diameter_mm / 2, "DATUM_BORES" if bore.ball.datum else "BORES"
        space.add_circle((bore.x_mm, bore.y_mm), radius, dxfattribs={"layer": layer})
        _text(space, "NUMBERS", (bore.x_mm + 0.7 * radius + 0.5, bore.y_mm + 0.7 * radius + 0.5), str(bore.number))
    _dimension(space, (0.0, 0.0), (part.width_mm, 0.0), (0.0, -14.0), 0)
    _dimension(space, (0.0, 0.0), (0.0, part.height_mm), (-14.0, 0.0), 90)
    _datum(space, (part.width_mm / 3, -4.0), "A")
    _datum(space, (-4.0, part.height_mm / 3), "B")


def _side(space: Modelspace, part: Part) -> None:
    """Draw the part from its left, front face to the right, with a line through most of its balls."""
    left = part.width_mm + 8
    right = left + part.thickness_mm
    corners = ((left, 0.0), (right, 0.0), (right, part.height_mm), (left, part.height_mm))
    space.add_lwpolyline(corners, close=True, dxfattribs={"layer": "OUTLINE"})
    ((from_front, _),) = Counter(b.depth_mm - b.ball.diameter_mm / 2 for b in part.bores).most_common(1)
    balls = right - from_front
    space.add_line(
        (balls, -2), (balls, part.height_mm + 2), dxfattribs={"layer": "DIMENSIONS", "linetype": "CENTER", "ltscale": 5}
    )
    _text(space, "DIMENSIONS", (balls, part.height_mm + 4), "balls", middle=True)
    _dimension(space, (left, 0.0), (right, 0.0), (left, -14.0), 0)
    _datum(space, (right + 3.0, part.height_mm / 3), "C")


def _table(space: Modelspace, part: Part) -> None:
    """Write the table of bores, in as many columns as it needs."""
    rows = max(_MIN_ROWS, int(part.height_mm / _ROW_MM))
    for first in range(0, len(part.bores), rows):
        left = part.width_mm + part.thickness_mm + _GAP_MM + _TABLE_MM * (first // rows)
        _row(space, left, part.height_mm, _HEADS)
        space.add_line(
            (left, part.height_mm - 1.2), (left + _TABLE_MM - 8, part.height_mm - 1.2), dxfattribs={"layer": "TABLE"}
        )
        for row, b in enumerate(part.bores[first : first + rows], 1):
            sized = f"{b.ball.diameter_mm:g} +{b.upper_mm:g}/0"
            cells = (str(b.number), b.ball.id, f"{b.x_mm:.3f}", f"{b.y_mm:.3f}", sized, f"{b.depth_mm:.3f}")
            _row(space, left, part.height_mm - _ROW_MM * row, cells)


def _row(space: Modelspace, left: float, y: float, cells: Sequence[str]) -> None:
    for x, cell in zip(_COLUMNS_MM, cells, strict=True):
        _text(space, "TABLE", (left + x, y), cell)


def _notes(part: Part) -> tuple[str, ...]:
    kinds = Counter((b.ball.diameter_mm, b.ball.datum, b.ball.shape) for b in part.bores)
    counts = ", ".join(
        f"{number} x {diameter:g}{' washers' if shape == 'washer' else ''}{' (datums, red)' if datum else ''}"
        for (diameter, datum, shape), number in sorted(kinds.items())
    )
    where = "the plate's name beside the cut corner of the front face" if part.view else f"{part.front} on this face"
    return (
        f"1. {len(part.bores)} blind bores from the front face, flat-bottomed, depth +-0.02, diameter H8: {counts}.",
        f"2. Every bore within a circle of {2 * part.position_mm:g} about its true position from C, A, B.",
        "3. Flatness of C 0.1; A square to B within 0.05; outline +-0.1. Other dimensions ISO 2768-m.",
        f"4. 4 through holes of {SCREW_MM:g}, {SCREW_INSET_MM:g} from the edges, nylon screws M5; no metal but balls. "
        f"One corner is cut, {part.chamfer_mm:g} x 45 deg."
        if part.screws
        else "4. No holes but these bores, and no metal but balls. Bore every face before balls are put in.",
        "5. Balls of stainless steel, grade G100 or better, pressed to the floor, bonded with a clear UV adhesive.",
        "6. Coordinates hold at 20 C. PMMA expands by 70 ppm/K: measure at 20 +-1 C, part stored dry for two days.",
        f"7. Engrave {where}. Do not wipe with alcohol: PMMA crazes.",
        "8. After bonding measure every ball (inspection.csv): sightline frame fit reads it.",
    )
