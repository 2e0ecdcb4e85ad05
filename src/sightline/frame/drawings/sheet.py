"""The drawing of a plate or a face for machine tools: DXF R2010 in mm, true diameters, origin at the datum corner."""

from io import StringIO

from sightline.frame.drawings.part import SCREW_MM, Part

# Layer: colour of the AutoCAD index.
LAYERS = {"OUTLINE": 7, "BORES": 5, "DATUM_BORES": 1, "SCREWS": 3, "NUMBERS": 8, "DIMENSIONS": 2, "TABLE": 7}
_ROW_MM, _TEXT_MM, _GAP_MM = 4.0, 2.0, 30.0
_COLUMNS_MM = (0.0, 10.0, 45.0, 65.0, 85.0, 105.0, 125.0)


def plate_dxf(part: Part, frame: str) -> bytes:
    """Return the drawing of one plate or face of the frame called `frame`: its front face, and the table of bores."""
    from ezdxf.enums import TextEntityAlignment
    from ezdxf.filemanagement import new
    from ezdxf.units import MM

    document = new("R2010", setup=["linetypes", "dimstyles"], units=MM)
    for name, colour in LAYERS.items():
        document.layers.add(name, color=colour)
    space = document.modelspace()
    space.add_lwpolyline(part.outline, close=True, dxfattribs={"layer": "OUTLINE"})
    for at in part.screws:
        space.add_circle(at, SCREW_MM / 2, dxfattribs={"layer": "SCREWS"})
    for bore in part.bores:
        radius, layer = bore.ball.diameter_mm / 2, "DATUM_BORES" if bore.ball.datum else "BORES"
        space.add_circle((bore.x_mm, bore.y_mm), radius, dxfattribs={"layer": layer})
        beside = (bore.x_mm + radius + 0.5, bore.y_mm + radius + 0.5)
        space.add_text(str(bore.number), height=1.5, dxfattribs={"layer": "NUMBERS"}).set_placement(beside)
    corners = ((0.0, 0.0), (part.width_mm, 0.0)), ((0.0, 0.0), (0.0, part.height_mm))
    for (start, end), base, angle in zip(corners, ((0.0, -12.0), (-12.0, 0.0)), (0, 90), strict=True):
        dimension = space.add_linear_dim(base, start, end, angle=angle, dxfattribs={"layer": "DIMENSIONS"})
        dimension.render()
    left, top = part.width_mm + _GAP_MM, part.height_mm
    heads = ("no", "ball", "X", "Y", "diameter H8", "depth", "position +-")
    cells = [
        (str(b.number), b.ball.id, f"{b.x_mm:.3f}", f"{b.y_mm:.3f}", f"{b.ball.diameter_mm:g} +{b.upper_mm:g}/0",
         f"{b.depth_mm:.3f}", f"{part.position_mm:g}")
        for b in part.bores
    ]  # fmt: skip
    title = f"frame {frame}, {part.title}: PMMA {part.thickness_mm:g} mm, front face (looks to {part.front} of CFCS)"
    texts = [(left, top + 2 * _ROW_MM, title)]
    for row, line in enumerate([heads, *cells]):
        texts += [(left + x, top - _ROW_MM * row, cell) for x, cell in zip(_COLUMNS_MM, line, strict=True)]
    for x, y, text in texts:
        entity = space.add_text(text, height=_TEXT_MM, dxfattribs={"layer": "TABLE"})
        entity.set_placement((x, y), align=TextEntityAlignment.LEFT)
    stream = StringIO()
    document.write(stream)
    return stream.getvalue().encode()
