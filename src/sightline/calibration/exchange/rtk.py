"""RTK's `ThreeDCircularProjectionGeometry` (XML, version 3) with the projection as MetaImage, which fixes its pixels.

RTK's detector axes and the direction from detector to source are right-handed, so its second axis runs against v: the
image is written bottom row first. RTK: documentation/docs/Geometry.md of its repository.
"""

from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.calibration.exchange import reading, xml_safe
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
# RTK compares the matrix of a file with its parameters; so do we [ours]: 0.001 px at 0.2 mm.
_AGREE_MM = 2e-4


def parameters(pinhole: Pinhole) -> dict[str, float]:
    """RTK's nine, degrees and mm; the isocentre is the CFCS origin. The image's first written pixel is at 0, 0 mm.

    Raises UnusableInputError.
    """
    sdd, across, down = pinhole.detector_mm()
    height, _ = pinhole.stated_shape()
    if pinhole.mirrored:
        raise UnusableInputError("RTK has no mirrored image: flip the image's columns, and give the geometry of that")
    axes = _TO_RTK @ pinhole.rotation
    in_plane, out_of_plane, gantry = Rotation.from_matrix(axes).as_euler("ZXY", degrees=True, suppress_warnings=True)
    source = axes @ pinhole.focal_point_mm
    cu, cv = pinhole.camera_matrix[:2, 2]
    offset = source[:2] - [cu * across, (height - 1 - cv) * down]
    values = (source[2], sdd, *(-angle % 360.0 for angle in (gantry, out_of_plane, in_plane)), *source[:2], *offset)
    return dict(zip(_NAMES, map(float, values), strict=True))


def matrix_mm(given: dict[str, float]) -> np.ndarray:
    """(3, 4) RTK's matrix: isocentre mm to detector mm, for its nine parameters."""
    sid, sdd, gantry, out_of_plane, in_plane, sx, sy, px, py = (given.get(name, 0.0) for name in _NAMES)
    turn = Rotation.from_euler("ZXY", [-in_plane, -out_of_plane, -gantry], degrees=True).as_matrix()
    shift = np.array([[1.0, 0.0, sx - px], [0.0, 1.0, sy - py], [0.0, 0.0, 1.0]])
    magnify = np.array([[-sdd, 0.0, 0.0, 0.0], [0.0, -sdd, 0.0, 0.0], [0.0, 0.0, 1.0, -sid]])
    move = np.eye(4)
    move[:2, 3] = -sx, -sy
    rotate = np.eye(4)
    rotate[:3, :3] = turn
    return shift @ magnify @ move @ rotate


def write(pinhole: Pinhole, pixels: np.ndarray | None = None) -> dict[str, bytes]:
    """The geometry, and the image (H, W) where there is one. Raises UnusableInputError."""
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
    out = {f"{stem}.xml": _HEAD + tostring(root)}
    return out | {f"{stem}.mha": header + image}


def _image(pinhole: Pinhole, pixels: np.ndarray | None) -> tuple[bytes, bytes]:
    """Header and pixels, bottom row first; zeros where there is no image."""
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
    """From the XML of one projection and the first bytes of its MetaImage. Raises UnusableInputError.

    RTK's geometry is in mm on the detector: without the image no pixel is known.
    """
    root = xml_safe.parse(data)
    projections = root.findall("Projection")
    if root.tag != _ROOT or len(projections) != 1:
        raise UnusableInputError(f"the file must be RTK's geometry of one projection; it has {len(projections)}")
    if image_header is None:
        raise UnusableInputError(
            "RTK's geometry says nothing of pixels; put the projection's .mha beside it, same name"
        )
    stated = {**_values(root), **_values(projections[0])}
    missing = [n for n in _NEEDED if n not in stated]
    if missing or stated.get("RadiusCylindricalDetector") or not stated["SourceToDetectorDistance"]:
        raise UnusableInputError(
            f"a flat detector and a point source are needed; missing: {', '.join(missing) or 'none'}"
        )
    mm = matrix_mm(stated)
    _agree(projections[0].findtext("Matrix"), mm)
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


def _agree(written: str | None, computed: np.ndarray) -> None:
    if written is None:
        return
    values = [_float(word, "an entry of the matrix") for word in written.split()[:13]]
    stated = reading.array(values, (12,), "the matrix").reshape(3, 4)
    scale = np.abs(computed[2]).max()
    if np.abs(stated / np.abs(stated[2]).max() - computed / scale).max() > _AGREE_MM:
        raise UnusableInputError("the file's matrix and its parameters state two geometries; export it again")


def _geometry(header: bytes) -> tuple[tuple[int, int], tuple[float, float], tuple[float, float]]:
    """(width, height), spacing and offset mm, of a MetaImage's header."""
    lines = header.split(b"ElementDataFile")[0][:4096].decode("ascii", "replace").splitlines()
    stated = {key.strip(): value.split() for key, _, value in (line.partition("=") for line in lines)}

    def pair(key: str) -> list[float]:
        words = stated.get(key, [])
        if len(words) < 2:
            raise UnusableInputError(f"the image's header does not state {key}; write it as MetaImage (.mha)")
        return [_float(word, key) for word in words[:2]]

    if stated.get("TransformMatrix", [])[:5] not in ([], ["1", "0", "0", "0", "1"], ["1", "0", "0", "1"]):
        raise UnusableInputError("the image's axes are turned (TransformMatrix); write it with the identity")
    width, height = pair("DimSize")
    u, v = (reading.positive(s, "ElementSpacing") for s in pair("ElementSpacing"))
    rows, columns = reading.image_shape(height, width)
    x, y = pair("Offset")
    return (columns, rows), (u, v), (x, y)
