"""RTK's `ThreeDCircularProjectionGeometry` (XML, version 3) with the projection as MetaImage, which defines its pixels.

RTK's detector axes and the direction from detector to source are right-handed, so its second axis runs against v, and
the image is written bottom row first. See documentation/docs/Geometry.md in RTK's repository.
"""

from xml.etree.ElementTree import Comment, Element, SubElement, TreeBuilder, indent, tostring
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.calibration.exchange import reading
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.errors import UnusableInputError

_HEAD = b'<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n'
_ROOT = "RTKThreeDCircularGeometry"
_TO_RTK = np.diag([1.0, -1.0, -1.0])  # camera axes (u, v, beam) to RTK's (first, second, towards the source)
_NAMES = (
    "SourceToIsocenterDistance",
    "SourceToDetectorDistance",
    "GantryAngle",
    "OutOfPlaneAngle",
    "InPlaneAngle",
    "SourceOffsetX",
    "SourceOffsetY",
    "ProjectionOffsetX",
    "ProjectionOffsetY",
)
_NEEDED = _NAMES[:3]
# A file's matrix must agree with its parameters to 0.001 px at 0.2 mm, as in RTK [calc].
_MAX_DIFFERENCE_MM = 2e-4


def parameters(pinhole: Pinhole) -> dict[str, float]:
    """Return RTK's nine parameters, degrees and mm.

    The isocentre is the CFCS origin; the image's first written pixel is at (0, 0) mm. Raises UnusableInputError.
    """
    sdd, across, down = pinhole.detector_mm()
    height, _ = pinhole.stated_shape()
    if pinhole.mirrored:
        raise UnusableInputError(
            "flip the image's columns and give the geometry of the flipped image: RTK cannot state a mirrored one"
        )
    axes = _TO_RTK @ pinhole.rotation
    in_plane, out_of_plane, gantry = Rotation.from_matrix(axes).as_euler("ZXY", degrees=True, suppress_warnings=True)
    source = axes @ pinhole.focal_point_mm
    cu, cv = pinhole.camera_matrix[:2, 2]
    offset = source[:2] - [cu * across, (height - 1 - cv) * down]
    values = (source[2], sdd, *(-angle % 360.0 for angle in (gantry, out_of_plane, in_plane)), *source[:2], *offset)
    return dict(zip(_NAMES, map(float, values), strict=True))


def matrix_mm(given: dict[str, float]) -> np.ndarray:
    """Return RTK's matrix (3, 4) for its nine parameters: isocentre mm to detector mm."""
    sid, sdd, gantry, out_of_plane, in_plane, sx, sy, px, py = (given.get(name, 0.0) for name in _NAMES)
    rotation = Rotation.from_euler("ZXY", [-in_plane, -out_of_plane, -gantry], degrees=True).as_matrix()
    shift = np.array([[1.0, 0.0, sx - px], [0.0, 1.0, sy - py], [0.0, 0.0, 1.0]])
    magnify = np.array([[-sdd, 0.0, 0.0, 0.0], [0.0, -sdd, 0.0, 0.0], [0.0, 0.0, 1.0, -sid]])
    move = np.eye(4)
    move[:2, 3] = -sx, -sy
    rotate = np.eye(4)
    rotate[:3, :3] = rotation
    return shift @ magnify @ move @ rotate


def write(pinhole: Pinhole, pixels: np.ndarray | None = None) -> dict[str, bytes]:
    """Return the files of a view by their names: the geometry, and the image (H, W), zeros without one.

    Raises UnusableInputError.
    """
    given = parameters(pinhole)
    root = Element(_ROOT, version="3")
    root.append(Comment(f"view {pinhole.name}, mm, isocentre and axes: CFCS; {pinhole.note}".replace("--", "-")))
    projection = SubElement(root, "Projection")
    for name in _NAMES:
        SubElement(projection, name).text = repr(given[name])
    rows = matrix_mm(given)
    SubElement(projection, "Matrix").text = "\n" + "".join(" ".join(map(repr, map(float, r))) + "\n" for r in rows)
    indent(root, " ")
    header, image = _image(pinhole, pixels)
    stem = f"{pinhole.name}.rtk"
    files = {f"{stem}.xml": _HEAD + tostring(root)}
    return files | {f"{stem}.mha": header + image}


def _image(pinhole: Pinhole, pixels: np.ndarray | None) -> tuple[bytes, bytes]:
    """Return header and pixels of the MetaImage, bottom row first; zeros without an image."""
    height, width = pinhole.stated_shape()
    stored = pinhole.own_image(np.zeros((height, width), np.uint8) if pixels is None else np.asarray(pixels))
    kinds = {"uint8": "MET_UCHAR", "uint16": "MET_USHORT", "float32": "MET_FLOAT"}
    _, across, down = pinhole.detector_mm()
    lines = (
        "ObjectType = Image",
        "NDims = 3",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CompressedData = False",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        "Offset = 0 0 0",
        f"ElementSpacing = {across!r} {down!r} 1",
        f"DimSize = {width} {height} 1",
        f"ElementType = {kinds[stored.dtype.name]}",
        "ElementDataFile = LOCAL",
    )
    little = stored[::-1].astype(stored.dtype.newbyteorder("<"), copy=False)
    return ("\n".join(lines) + "\n").encode(), little.tobytes()


def read(data: bytes, name: str, image_header: bytes | None = None) -> Pinhole:
    """Return the view of one projection's XML and the first bytes of its MetaImage. Raises UnusableInputError.

    RTK's geometry is in mm on the detector; the pixels are defined by the image.
    """
    root = parsed_xml(data)
    projections = root.findall("Projection")
    if root.tag != _ROOT or len(projections) != 1:
        raise UnusableInputError(f"give RTK's geometry of one projection; this file has {len(projections)}")
    if image_header is None:
        raise UnusableInputError(
            "put the projection's .mha beside the XML, with the same name: RTK's geometry does not state the pixels"
        )
    stated = {**_values(root), **_values(projections[0])}
    missing = [n for n in _NEEDED if n not in stated]
    if missing or stated.get("RadiusCylindricalDetector") or not stated["SourceToDetectorDistance"]:
        raise UnusableInputError(
            f"give the geometry of a flat detector and a point source; missing: {', '.join(missing) or 'none'}"
        )
    mm = matrix_mm(stated)
    _refuse_other_matrix(projections[0].findtext("Matrix"), mm)
    (width, height), spacing, offset = _geometry(image_header)
    to_px = np.array(
        [
            [1 / spacing[0], 0.0, -offset[0] / spacing[0]],
            [0.0, -1 / spacing[1], height - 1 + offset[1] / spacing[1]],
            [0.0, 0.0, 1.0],
        ]
    )
    return Pinhole.of_matrix(to_px @ mm, name, (height, width), spacing)


def _values(element: Element) -> dict[str, float]:
    wanted = (*_NAMES, "RadiusCylindricalDetector")
    return {child.tag: _float(child.text, child.tag) for child in element if child.tag in wanted}


def _float(written: str | None, what: str) -> float:
    try:
        return reading.number(float(written or ""), what)
    except ValueError:
        raise UnusableInputError(f"{what} is not a number") from None


def _refuse_other_matrix(written: str | None, computed: np.ndarray) -> None:
    if written is None:
        return
    values = [_float(word, "an entry of the matrix") for word in written.split()[:13]]
    stated = reading.array(values, (12,), "the matrix").reshape(3, 4)
    scale = np.abs(computed[2]).max()
    if np.abs(stated / np.abs(stated[2]).max() - computed / scale).max() > _MAX_DIFFERENCE_MM:
        raise UnusableInputError("export the file again: its matrix disagrees with its parameters")


def _geometry(header: bytes) -> tuple[tuple[int, int], tuple[float, float], tuple[float, float]]:
    """Return (width, height), spacing and offset, mm, of a MetaImage's header. Raises UnusableInputError."""
    lines = header.split(b"ElementDataFile")[0][:4096].decode("ascii", "replace").splitlines()
    stated = {key.strip(): value.split() for key, _, value in (line.partition("=") for line in lines)}

    def pair(key: str) -> list[float]:
        words = stated.get(key, [])
        if len(words) < 2:
            raise UnusableInputError(f"write the image as MetaImage (.mha): its header does not state {key}")
        return [_float(word, key) for word in words[:2]]

    if stated.get("TransformMatrix", [])[:5] not in ([], ["1", "0", "0", "0", "1"], ["1", "0", "0", "1"]):
        raise UnusableInputError("write the image with the identity as TransformMatrix: its axes are rotated")
    width, height = pair("DimSize")
    u, v = (reading.positive(s, "ElementSpacing") for s in pair("ElementSpacing"))
    rows, columns = reading.image_shape(height, width)
    x, y = pair("Offset")
    return (columns, rows), (u, v), (x, y)


def parsed_xml(data: bytes) -> Element:
    """Return the root of an XML text. Raises UnusableInputError.

    A bare `<!DOCTYPE NAME>`, as in RTK, is ignored. Declarations in it are refused: no entity is expanded or fetched.
    """
    builder, depth = TreeBuilder(), 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > reading.MAX_DEPTH:
            raise UnusableInputError("the XML is nested too deeply to be a geometry")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def document_type(_name: str, system: str | None, public: str | None, internal: bool) -> None:
        if system or public or internal:
            raise UnusableInputError(
                "remove everything but the name from the XML's document type: declarations in it are not accepted"
            )

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = builder.data, document_type
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise UnusableInputError(f"the file is not XML: {error}") from None
    return builder.close()
