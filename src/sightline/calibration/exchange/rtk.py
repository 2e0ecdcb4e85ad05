"""RTK's `ThreeDCircularProjectionGeometry` (XML, version 3) with its projections as one MetaImage, which defines the
pixels: slice k is projection k.

RTK's detector axes and the direction from detector to source are right-handed, so its second axis runs against v, and
the image is written bottom row first. See documentation/docs/Geometry.md in RTK's repository.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
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
_ELEMENTS = {"uint8": "MET_UCHAR", "uint16": "MET_USHORT", "float32": "MET_FLOAT"}
_LOCAL = b"ElementDataFile = LOCAL\n"  # the header's last line: the pixels follow
_MAX_HEADER = 4096  # [ours] bytes; RTK writes 300
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
    return _files(pinhole.name, [pinhole], [_own(pinhole, pixels)])


def write_stack(pinholes: Sequence[Pinhole], pixels: Sequence[np.ndarray | None]) -> dict[str, bytes]:
    """Return the files `views.rtk.xml` and `.mha` of several views: one projection and one slice each, in their order.

    All slices have one size and one pixel size. Smaller images are padded with zeros at the right and below. A view of
    another pixel size has its detector moved parallel to itself, to where a pixel has the size of the first view's:
    every line of sight stays. Raises UnusableInputError.
    """
    images = [_own(pinhole, image) for pinhole, image in zip(pinholes, pixels, strict=True)]
    height, width = np.max([image.shape for image in images], axis=0).tolist()
    padded = [np.pad(image, ((0, height - image.shape[0]), (0, width - image.shape[1]))) for image in images]
    alike = [replace(pinhole, shape=(height, width), pixel_mm=pinholes[0].pixel_mm) for pinhole in pinholes]
    return _files("views", alike, padded)


def _own(pinhole: Pinhole, pixels: np.ndarray | None) -> np.ndarray:
    return pinhole.own_image(np.zeros(pinhole.stated_shape(), np.uint8) if pixels is None else np.asarray(pixels))


def _files(name: str, pinholes: Sequence[Pinhole], images: Sequence[np.ndarray]) -> dict[str, bytes]:
    root = Element(_ROOT, version="3")
    for pinhole in pinholes:
        root.append(Comment(f"view {pinhole.name}, mm, isocentre and axes: CFCS; {pinhole.note}".replace("--", "-")))
        given = parameters(pinhole)
        projection = SubElement(root, "Projection")
        for key in _NAMES:
            SubElement(projection, key).text = repr(given[key])
        rows = matrix_mm(given)
        SubElement(projection, "Matrix").text = "\n" + "".join(" ".join(map(repr, map(float, r))) + "\n" for r in rows)
    indent(root, " ")
    stem = f"{name}.rtk"
    return {f"{stem}.xml": _HEAD + tostring(root), f"{stem}.mha": _image(pinholes[0], np.stack(images))}


def _image(pinhole: Pinhole, stack: np.ndarray) -> bytes:
    """Return images (N, H, W) as MetaImage, bottom row first."""
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
        "DimSize = " + " ".join(map(str, stack.shape[::-1])),
        f"ElementType = {_ELEMENTS[stack.dtype.name]}",
    )
    little = stack[:, ::-1].astype(stack.dtype.newbyteorder("<"), copy=False)
    return ("\n".join(lines) + "\n").encode() + _LOCAL + little.tobytes()


def read(data: bytes, name: str, image_header: bytes | None = None) -> Pinhole:
    """Return the only projection of an XML file, or of several the one called `name` ("proj-001").

    `image_header`: the first bytes of the MetaImage: RTK's geometry is in mm on the detector, and the image defines the
    pixels. Raises UnusableInputError.
    """
    root, names = _named(data)
    if image_header is None:
        raise UnusableInputError(
            "put the projections' .mha beside the XML, with the same name: RTK's geometry does not state the pixels"
        )
    if name not in names and (len(names) != 1 or name.startswith("proj-")):
        raise UnusableInputError(
            f"the geometry has no projection {name!r}; name one of its {len(names)}: {', '.join(names[:3])}"
        )
    return _view(root, names.index(name) if name in names else 0, name, _grid(image_header, len(names)))


def read_stack(data: bytes, image: bytes) -> list[tuple[Pinhole, np.ndarray]]:
    """Return the views "proj-000", ... of an XML file, and their images (H, W), top row first, of its MetaImage.

    Raises UnusableInputError.
    """
    root, names = _named(data)
    grid = _grid(image, len(names))
    elements = {element: np.dtype(kind).newbyteorder("<") for kind, element in _ELEMENTS.items()}
    stated, (head, local, _) = _header(image), image[:_MAX_HEADER].partition(_LOCAL)
    element = " ".join(stated.get("ElementType", []))[:20]
    dtype, start, shape = elements.get(element), len(head) + len(local), (len(names), *grid.shape)
    packed = {" ".join(stated.get(key, [])).lower() for key in ("CompressedData", "BinaryDataByteOrderMSB")}
    if not local or dtype is None or "true" in packed or len(image) - start != prod(shape) * dtype.itemsize:
        raise UnusableInputError(
            f"the .mha holds {len(image) - start} bytes of {element or 'no type'}; write all pixels into it, "
            f"uncompressed and little-endian, as {', '.join(elements)}"
        )
    stack = np.ascontiguousarray(np.frombuffer(image, dtype, offset=start).reshape(shape)[:, ::-1])
    return [(_view(root, k, name, grid), stack[k]) for k, name in enumerate(names)]


def _named(data: bytes) -> tuple[Element, list[str]]:
    """Return the geometry, and the names of its projections. Raises UnusableInputError."""
    root = parsed_xml(data)
    count = len(root.findall("Projection"))
    if root.tag != _ROOT or not count:
        raise UnusableInputError("give RTK's geometry of one projection or more; this file has none")
    return root, [f"proj-{k:03d}" for k in range(count)]


@dataclass(frozen=True)
class _Grid:
    """The pixels of all projections: height and width, and spacing and place of the first stored pixel, mm."""

    shape: tuple[int, int]
    spacing_mm: tuple[float, float]
    offset_mm: tuple[float, float]


def _view(root: Element, k: int, name: str, grid: _Grid) -> Pinhole:
    projection = root.findall("Projection")[k]
    stated = {**_values(root), **_values(projection)}
    missing = [n for n in _NEEDED if n not in stated]
    if missing or stated.get("RadiusCylindricalDetector") or not stated["SourceToDetectorDistance"]:
        raise UnusableInputError(
            f"give the geometry of a flat detector and a point source; missing: {', '.join(missing) or 'none'}"
        )
    mm = matrix_mm(stated)
    _refuse_other_matrix(projection.findtext("Matrix"), mm)
    (u, v), (x, y) = grid.spacing_mm, grid.offset_mm
    to_px = np.array([[1 / u, 0.0, -x / u], [0.0, -1 / v, grid.shape[0] - 1 + y / v], [0.0, 0.0, 1.0]])
    return Pinhole.of_matrix(to_px @ mm, name, grid.shape, grid.spacing_mm)


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


def _header(image: bytes) -> dict[str, list[str]]:
    """Return the words of each line of a MetaImage's header."""
    lines = image[:_MAX_HEADER].split(b"ElementDataFile")[0].decode("ascii", "replace").splitlines()
    return {key.strip(): value.split() for key, _, value in (line.partition("=") for line in lines)}


def _grid(image: bytes, count: int) -> _Grid:
    """Return the pixels of a MetaImage of `count` slices, from its first bytes. Raises UnusableInputError."""
    stated = _header(image)

    def pair(key: str) -> list[float]:
        words = stated.get(key, [])
        if len(words) < 2:
            raise UnusableInputError(f"write the image as MetaImage (.mha): its header does not state {key}")
        return [_float(word, key) for word in words[:2]]

    if stated.get("TransformMatrix", [])[:5] not in ([], ["1", "0", "0", "0", "1"], ["1", "0", "0", "1"]):
        raise UnusableInputError("write the image with the identity as TransformMatrix: its axes are rotated")
    width, height = pair("DimSize")
    slices = _float(" ".join(stated["DimSize"][2:]) or "1", "DimSize")
    if slices != count:
        raise UnusableInputError(
            f"the .mha has {slices:g} slices, the geometry {count} projections; give both of the same images"
        )
    u, v = (reading.positive(s, "ElementSpacing") for s in pair("ElementSpacing"))
    x, y = pair("Offset")
    return _Grid(reading.image_shape(height, width), (u, v), (x, y))


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
